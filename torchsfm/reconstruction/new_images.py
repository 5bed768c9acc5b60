"""Further photographs for a model whose poses and cameras stay as they are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose
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

RATIOS = tuple(1.1**k for k in range(-6, 7))
"""How many times as much as along x photographs may have been stretched along y: 16 : 9 resized to a square, and back."""


@dataclass(frozen=True)
class NewCameras:
    """What photographs that are new may have been taken with."""

    own: Bool[Tensor, "g"]
    """Cameras that are not the model's and are estimated."""
    like: Int[Tensor, "g"]
    """The model's camera that each one is thought to be, itself for those that nothing is thought of."""
    stretched: Bool[Tensor, "g"]
    """Cameras whose images were found to have been stretched along one side, so that their pixels are not square."""

    @property
    def open_numbers(self) -> tuple[str, ...]:
        """What was estimated of some camera besides its distortion, by the names that `bundle_adjust` knows."""
        return ("focal",) * bool(self.own.any()) + ("aspect",) * bool(self.stretched.any())


def start_mapping(
    graph: ViewGraph,
    labels: Sequence[str],
    focal: Sequence[float | None],
    poses: Reconstruction,
    place: Int[Tensor, "v"],
    generator: torch.Generator,
) -> tuple[Mapping, MappingOptions, NewCameras]:
    """Photographs with the poses and cameras of a model, without points; and what is thought of the other cameras.

    A photograph of the same size as others, of which no file tells the focal length, has a camera like theirs for itself, until
    `place_images` knows better.

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
    camera = torch.where(place >= 0, poses.camera_index[place.clamp(min=0)], -1)
    first, second = len(poses.cameras.K), len(poses.cameras.K) + len(guessed.K)
    original = torch.arange(second + len(place))
    for i in (place < 0).nonzero()[:, 0].tolist():
        same = ((group == group[i]) & (place >= 0)).nonzero()[:, 0]
        camera[i] = first + group[i]
        if len(same):
            original[second + i] = camera[same[0]]
            camera[i] = camera[same[0]] if focal[i] else second + i
    used, index = torch.unique(camera, return_inverse=True)
    rows = original[used]
    K = torch.cat([poses.cameras.K, guessed.K])[rows]
    both = (poses.cameras, guessed)
    numbers = [one.distortion.parameters().reshape(len(one.K), kind.num_parameters).to(K) for one in both]
    cameras = Camera(K, kind.from_parameters(torch.cat(numbers)[rows]))
    own = (used >= first) & (used < second)
    new = NewCameras(own, torch.searchsorted(used, rows), torch.zeros_like(own))
    words = (*("given",) * first, *source, *("default",) * len(place))
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
            new = _with_own_numbers(mapping, options, placed, new, thought)
            other = new.own[mapping.camera_index]
            index = torch.where(placed & ~other, new.like[mapping.camera_index], mapping.camera_index)
            mapping = replace(mapping, camera_index=index)
            sigma = sigma.index_fill(0, mapping.camera_index[placed], 0.0)
            mapping = _adjust_new(mapping, options, mapping.registered & ~given, new)
            mapping = structure_of_held(mapping, options)
            progress("map", int(mapping.registered.sum()), len(given))
    mapping = _adjust_new(mapping, options, mapping.registered & ~given, new)
    index = torch.where(mapping.registered, mapping.camera_index, new.like[mapping.camera_index])
    used, index = torch.unique(index, return_inverse=True)
    left = NewCameras(new.own[used], torch.arange(len(used)), new.stretched[used])
    choices = replace(options, expected=options.expected[used], focal_sigma=options.focal_sigma[used])
    return replace(mapping, cameras=mapping.cameras[used], camera_index=index), choices, left, failed


def _with_own_numbers(
    mapping: Mapping, options: MappingOptions, placed: Bool[Tensor, "v"], new: NewCameras, thought: Bool[Tensor, "g"]
) -> NewCameras:
    """What is thought of the cameras of images just placed, with those that explain their image clearly better by own numbers.

    A camera that has found another focal length already is not the one it was thought to be.
    """
    there = torch.zeros_like(thought).index_fill(0, mapping.camera_index[placed], True)
    own, focal = new.own, mapping.cameras.K[:, 0, 0]
    stretched = new.stretched | (there & ((_ratio(mapping.cameras) / _ratio(options.expected)).log().abs() > STRETCHED))
    own = own | stretched | (thought & (focal != focal[new.like]))
    own = own | _clearly_better(mapping, options, placed, {}, {"focal": there & thought & ~own})[0]
    asked = there & (own | thought) & ~stretched
    better, after = _clearly_better(mapping, options, placed, {"focal": own & there}, {"focal": asked, "aspect": asked})
    better = better & ((_ratio(after.cameras) / _ratio(options.expected)).log().abs() > STRETCHED)
    return replace(new, own=own | better, stretched=stretched | better)


def _ratio(cameras: Camera) -> Float[Tensor, "g"]:
    """The focal lengths along y over those along x."""
    return cameras.K[:, 1, 1] / cameras.K[:, 0, 0]


def _clearly_better(
    mapping: Mapping,
    options: MappingOptions,
    placed: Bool[Tensor, "v"],
    free: Free,
    more: Free,
) -> tuple[Bool[Tensor, "g"], Mapping]:
    """Which cameras explain the images just placed clearly better with `more` of their numbers free; with the mapping then."""
    asked = next(iter(more.values()))
    if not bool(asked.any()):
        return torch.zeros_like(asked), mapping
    prior = _prior(mapping, options)
    before = adjust_held(mapping, moving=placed, cameras=about_cameras(mapping, free, prior))
    more = {name: mask | free.get(name, torch.zeros_like(mask)) for name, mask in more.items()}
    after = adjust_held(before, moving=placed, cameras=about_cameras(before, more, prior))
    node, noise = before.observations(), measure_noise(after, LOSS)
    costs = [LOSS(one.errors(one.point[node], node).clamp_max(1e6).square()) for one in (before, after)]
    camera = before.camera_index[before.graph.view[node]]
    gain = torch.zeros(len(asked), dtype=costs[0].dtype).index_add(0, camera, costs[0] - costs[1]) / noise**2
    return asked & (gain > TOGETHER * SURPRISE), after


def _prior(mapping: Mapping, options: MappingOptions) -> CameraPrior:
    """What is expected of cameras whose images may have been stretched."""
    return options.prior(mapping).widened("aspect", ANY)


def _adjust_new(mapping: Mapping, options: MappingOptions, moving: Bool[Tensor, "v"], new: NewCameras) -> Mapping:
    """Move all points, the new poses, and of the new cameras what the images determine."""
    if not bool(new.own.any()) or not len(mapping.observations()):
        return adjust_held(mapping, moving=moving)
    prior = _prior(mapping, options)
    names = (*new.open_numbers, *mapping.cameras.distortion.parameter_names)
    whose = {"aspect": new.stretched}
    free = {name: mask & whose.get(name, new.own) for name, mask in choose_free(mapping, names, prior, loss=LOSS).items()}
    return adjust_held(mapping, moving=moving, cameras=about_cameras(mapping, free, prior))
