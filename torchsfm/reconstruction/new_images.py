"""Further photographs for a model whose poses and cameras stay as they are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose
from torchsfm.geometry.intrinsic_parameters import camera_from_row, row_from_camera
from torchsfm.reconstruction.held_poses import adjust_held, structure_of_held
from torchsfm.reconstruction.mappers.incremental import MappingOptions, next_images
from torchsfm.reconstruction.mapping.adjust import LOSS, about_cameras
from torchsfm.reconstruction.mapping.calibration import Free, choose_free, measure_noise
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.cameras import focal_uncertainty, group_cameras, guess_cameras
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.register import SURPRISE, TOGETHER, register_images
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.stretched import ANY, STRETCHED

ODD = "aspect", "principal_point"
"""Numbers that the images of a camera tell only of what was done to them after: stretched along one side, or cropped."""
RATIOS = tuple(1.1**k for k in range(-6, 7))
"""How many times as much as along x photographs may have been stretched along y: 16 : 9 resized to a square, and back."""


@dataclass(frozen=True)
class NewCameras:
    """What photographs that are new may have been taken with."""

    own: Bool[Tensor, "g"]
    """Cameras that are not the model's: all of their numbers are estimated that the images determine."""
    like: Int[Tensor, "g"]
    """The model's camera that each one is thought to be, itself for those that nothing is thought of."""
    alike: Int[Tensor, "g"]
    """Cameras of which files do not say that they are two have the same number; -1 for those of the model."""
    odd: dict[str, Bool[Tensor, "g"]]
    """Of which cameras a number may be anything, by the names of `ODD`."""

    @property
    def open_numbers(self) -> tuple[str, ...]:
        """What was open in some camera besides its distortion, by the names that `bundle_adjust` knows."""
        aspect = ("aspect",) * bool(self.odd["aspect"].any())
        return ("focal", *aspect, "principal_point") if bool(self.own.any()) else ()

    def prior(self, mapping: Mapping, options: MappingOptions) -> CameraPrior:
        """What is expected of the cameras, of those whose images were stretched or cropped less."""
        usual, wide = options.prior(mapping), _wide_prior(mapping, options)
        sigma = {name: torch.where(self.odd[name], wide.sigma[name], usual.sigma[name]) for name in ODD}
        return replace(usual, sigma={**usual.sigma, **sigma})


def start_mapping(
    graph: ViewGraph,
    labels: Sequence[str],
    focal: Sequence[float | None],
    poses: Reconstruction,
    place: Int[Tensor, "v"],
    generator: torch.Generator,
) -> tuple[Mapping, MappingOptions, NewCameras]:
    """Photographs with the poses and cameras of a model, without points; and what is thought of the other cameras.

    A photograph has a camera for itself, as it may have been zoomed or cropped, until `place_images` knows better; that of the
    model where its file says so, and one like that where no file tells and it has the size of the model's photographs.

    Args:
        graph: The photographs and their verified matches.
        labels: What their files say of the cameras.
        focal: Focal length in pixels stated in each file.
        poses: The model.
        place: Which of its images each photograph is, or -1.
        generator: Source of randomness.
    """
    group = group_cameras(graph.image_size, labels, None)
    kind = type(poses.cameras.distortion)
    name = next(name for name, model in DISTORTION_MODELS.items() if model is kind)
    guessed, source = guess_cameras(graph, group, model=name, K=None, exif_focal=focal)
    # One after the other: the cameras of the model, and one of each photograph.
    first = len(poses.cameras.K)
    camera = torch.where(place >= 0, poses.camera_index[place.clamp(min=0)], first + torch.arange(len(place)))
    like, row = torch.arange(first + len(place)), torch.cat((torch.arange(first), first + group))
    words = [*("given",) * first, *(source[k] for k in group.tolist())]
    for i in (place < 0).nonzero()[:, 0].tolist():
        same = ((group == group[i]) & (place >= 0)).nonzero()[:, 0]
        if len(same) and focal[i]:
            camera[i] = camera[same[0]]
        elif len(same):
            like[first + i] = row[first + i] = camera[same[0]]
            words[first + i] = "default"
    used, index = torch.unique(camera, return_inverse=True)
    rows = row[used]
    K = torch.cat([poses.cameras.K, guessed.K])[rows]
    both = (poses.cameras, guessed)
    numbers = [one.distortion.parameters().reshape(len(one.K), kind.num_parameters).to(K) for one in both]
    cameras = Camera(K, kind.from_parameters(torch.cat(numbers)[rows]))
    own = (used >= first) & (like[used] == used)
    alike = torch.cat((torch.full((first,), -1), group))[used]
    new = NewCameras(own, torch.searchsorted(used, like[used]), alike, {name: torch.zeros_like(own) for name in ODD})
    sigma = focal_uncertainty(words)[used].to(K.dtype)
    track = build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair])
    mapping = Mapping.start(graph, track, cameras, index)
    known = place >= 0
    chosen = poses.poses[place.clamp(min=0)]
    R = torch.where(known[:, None, None], chosen.R, mapping.poses.R)
    mapping = replace(mapping, poses=Pose(R, torch.where(known[:, None], chosen.t, 0.0)), registered=known)
    return mapping, MappingOptions(free=(), expected=cameras, focal_sigma=sigma, generator=generator), new


def place_images(
    mapping: Mapping, options: MappingOptions, new: NewCameras, progress: Progress
) -> tuple[Mapping, MappingOptions, NewCameras, dict[int, str]]:
    """Poses for the images that have none, and why some get none; with the cameras that are left.

    A photograph that may have been resized to another shape is told by what it shows of the points: nothing else says so.
    """
    given, failed = mapping.registered, dict[int, str]()
    nowhere = torch.zeros_like(given)
    sigma = options.focal_sigma.index_fill(0, mapping.camera_index[given], 0.0)
    thought = new.like != torch.arange(len(new.own))
    while len(images := next_images(mapping, nowhere, failed)):
        before = mapping.registered
        mapping, count, inliers = register_images(
            mapping, images, threshold=options.registration, focal_sigma=sigma, least=SURPRISE * thought,
            ratios=RATIOS, generator=options.generator,
        )  # fmt: skip
        placed = mapping.registered & ~before
        for i, n, k in zip(images.tolist(), count.tolist(), inliers.tolist(), strict=True):
            if not placed[i]:
                failed[i] = f"a pose fits only {k} of the {n} points it sees"
        if bool(placed.any()):
            mapping, new = _with_own_numbers(mapping, options, placed, new, thought)
            other = new.own[mapping.camera_index]
            index = torch.where(placed & ~other, new.like[mapping.camera_index], mapping.camera_index)
            mapping = replace(mapping, camera_index=index)
            sigma = sigma.index_fill(0, mapping.camera_index[placed], 0.0)
            mapping = _adjust_new(mapping, options, mapping.registered & ~given, new)
            mapping = structure_of_held(mapping, options)
            progress("map", int(mapping.registered.sum()), len(given))
    mapping = _adjust_new(mapping, options, mapping.registered & ~given, new)
    mapping, new = _made_one(mapping, options, mapping.registered & ~given, new)
    index = torch.where(mapping.registered, mapping.camera_index, new.like[mapping.camera_index])
    used, index = torch.unique(index, return_inverse=True)
    left = NewCameras(
        new.own[used], torch.arange(len(used)), new.alike[used], {name: mask[used] for name, mask in new.odd.items()}
    )
    choices = replace(options, expected=options.expected[used], focal_sigma=options.focal_sigma[used])
    return replace(mapping, cameras=mapping.cameras[used], camera_index=index), choices, left, failed


def _with_own_numbers(
    mapping: Mapping, options: MappingOptions, placed: Bool[Tensor, "v"], new: NewCameras, thought: Bool[Tensor, "g"]
) -> tuple[Mapping, NewCameras]:
    """What is thought of the cameras of images just placed, with those that explain their image clearly better by own numbers.

    Such cameras, and their images, stand where these numbers were found: steps from elsewhere may not come there. A camera that
    has found another focal length already is not the one it was thought to be.
    """
    there = torch.zeros_like(thought).index_fill(0, mapping.camera_index[placed], True)
    focal = mapping.cameras.K[:, 0, 0]
    odd = {name: mask | (there & _far_off(name, mapping, options)) for name, mask in new.odd.items()}
    own = new.own | (thought & (focal != focal[new.like])) | torch.stack(tuple(odd.values())).any(0)
    own = own | _clearly_better(mapping, options, placed, {}, {"focal": there & thought & ~own})[0]
    asked = there & (own | thought)
    for name in ODD:
        free = {"focal": own & there} | odd
        better, after = _clearly_better(mapping, options, placed, free, free | {"focal": asked, name: asked | odd[name]})
        better = better & _far_off(name, after, options)
        odd[name], own = odd[name] | better, own | better
        moved = placed & better[mapping.camera_index]
        R = torch.where(moved[:, None, None], after.poses.R, mapping.poses.R)
        t = torch.where(moved[:, None], after.poses.t, mapping.poses.t)
        K = torch.where(better[:, None, None], after.cameras.K, mapping.cameras.K)
        mapping = replace(mapping, poses=Pose(R, t), cameras=Camera(K, mapping.cameras.distortion))
    return mapping, replace(new, own=own, odd=odd)


def _far_off(name: str, mapping: Mapping, options: MappingOptions) -> Bool[Tensor, "g"]:
    """Which cameras have another ratio of focal lengths, or another principal point, than images of cameras have."""
    K, expected = mapping.cameras.K, options.expected.K
    if name == "aspect":
        return (K[:, 1, 1] / K[:, 0, 0] * expected[:, 0, 0] / expected[:, 1, 1]).log().abs() > STRETCHED
    shift = (K - expected)[:, :2, 2].square().sum(-1).sqrt()
    return shift > 3 * options.prior(mapping).sigma["principal_point"]


def _clearly_better(
    mapping: Mapping,
    options: MappingOptions,
    placed: Bool[Tensor, "v"],
    free: Free,
    more: Free,
) -> tuple[Bool[Tensor, "g"], Mapping]:
    """Which cameras explain the images just placed clearly better with `more` of their numbers free; with the mapping then."""
    asked = more["focal"]
    if not bool(asked.any()):
        return torch.zeros_like(asked), mapping
    prior = _wide_prior(mapping, options)
    before = adjust_held(mapping, moving=placed, cameras=about_cameras(mapping, free, prior))
    after = adjust_held(before, moving=placed, cameras=about_cameras(before, more, prior))
    return asked & (_gain(before, after, before.camera_index) > TOGETHER * SURPRISE), after


def _gain(before: Mapping, after: Mapping, camera: Int[Tensor, "v"]) -> Float[Tensor, "g"]:
    """By how much images that are said to be of some cameras are likelier after than before, twice the logarithm of it."""
    node = before.observations()
    costs = [LOSS(one.errors(one.point[node], node).clamp_max(1e6).square()) for one in (before, after)]
    gain = torch.zeros(len(before.cameras.K), dtype=costs[0].dtype)
    return gain.index_add(0, camera[before.graph.view[node]], costs[0] - costs[1]) / measure_noise(after, LOSS) ** 2


def _made_one(
    mapping: Mapping, options: MappingOptions, moving: Bool[Tensor, "v"], new: NewCameras
) -> tuple[Mapping, NewCameras]:
    """New cameras of which no file says that they are two, made one where that explains none of their images clearly worse."""
    there = torch.zeros_like(new.own).index_fill(0, mapping.camera_index[moving], True)
    for number in torch.unique(new.alike[new.own & there & (new.alike >= 0)]).tolist():
        members = (new.own & there & (new.alike == number)).nonzero()[:, 0]
        if len(members) < 2:
            continue
        together = torch.isin(mapping.camera_index, members)
        rows = row_from_camera(mapping.cameras)
        rows[members] = rows[members].median(0).values
        camera_index = torch.where(together, members[0], mapping.camera_index)
        cameras = camera_from_row(rows, type(mapping.cameras.distortion))
        odd = {name: mask.index_fill(0, members, bool(mask[members].any())) for name, mask in new.odd.items()}
        one, same = replace(mapping, cameras=cameras, camera_index=camera_index), replace(new, odd=odd)
        one = _adjust_new(one, options, moving, same)
        if float(_gain(one, mapping, mapping.camera_index)[members].max()) <= TOGETHER * SURPRISE:
            mapping, new = one, same
    return mapping, new


def _wide_prior(mapping: Mapping, options: MappingOptions) -> CameraPrior:
    """What is expected of cameras whose images may have been stretched, or cut out of larger ones."""
    return replace(options, cropped=True).prior(mapping).widened("aspect", ANY)


def _adjust_new(mapping: Mapping, options: MappingOptions, moving: Bool[Tensor, "v"], new: NewCameras) -> Mapping:
    """Move all points, the new poses, and of the new cameras what the images determine."""
    if not bool(new.own.any()) or not len(mapping.observations()):
        return adjust_held(mapping, moving=moving)
    prior = new.prior(mapping, options)
    names = (*new.open_numbers, *mapping.cameras.distortion.parameter_names)
    chosen = choose_free(mapping, names, prior, loss=LOSS, faultless=len(mapping.registered))
    free = {name: mask & (new.odd[name] if name == "aspect" else new.own) for name, mask in chosen.items()}
    return adjust_held(mapping, moving=moving, cameras=about_cameras(mapping, free, prior))
