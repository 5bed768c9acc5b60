"""Photographs of which the poses are known: points for them, and poses for further photographs of the same scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust
from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose, similarity_from_points
from torchsfm.images import MAX_PIXELS
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.evidence.doubt import examine
from torchsfm.reconstruction.image_reports import image_reports
from torchsfm.reconstruction.mappers.incremental import LAST_ITERATIONS, LAST_TOLERANCE, MappingOptions, next_images
from torchsfm.reconstruction.mapping.adjust import LOSS, about_cameras, adjust
from torchsfm.reconstruction.mapping.calibration import choose_free, measure_noise
from torchsfm.reconstruction.mapping.cameras import focal_uncertainty, group_cameras, guess_cameras
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.register import SURPRISE, TOGETHER, register_images
from torchsfm.reconstruction.mapping.structure import complete_tracks, filter_points, merge_points, triangulate_tracks
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.sources import Source
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.messages import Progress, ReconstructionError
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.photographs import NEIGHBOURS, MatchedPhotographs, match_photographs
from torchsfm.reconstruction.report import Report, SfmResult, pair_report

ROUNDS = 4
"""Of triangulation, completion and adjustment; little changes after the second."""


@on_the_cpu
def triangulate_photographs(
    images: Source,
    poses: Reconstruction,
    *,
    refine_poses: bool = False,
    register: bool = False,
    sequence: bool = False,
    masks: str | Path | None = None,
    max_features: int = 8192,
    max_pixels: int = MAX_PIXELS,
    neighbours: int = NEIGHBOURS,
    seed: int = 0,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> SfmResult:
    """Find the points that photographs with known cameras and poses show, and place further photographs among them.

    Features are matched as `reconstruct` does; tracks are triangulated with the poses given, and points moved to the least
    robust reprojection error. World frame and scale stay those of the poses.

    Args:
        images: A folder or image files, see `reconstruct`.
        poses: A model with the poses and cameras of these photographs, by their names; its points are not used.
        refine_poses: Adjust the poses together with the points, the cameras held; the result is moved back to where the camera
            centres fit those given best.
        register: Also place the photographs that are not in the model, in the frame that the others make. Those that the files
            say the same camera took as others of the model get its intrinsics, and where files say nothing those of the same
            size, unless another focal length explains them clearly better; the intrinsics of other cameras are estimated.
            The poses and cameras given stay as they are.
        sequence: The images are consecutive frames of a video.
        masks: Folder of masks, see `reconstruct`.
        max_features: Features per image.
        max_pixels: Larger images are left out.
        neighbours: Images each one is matched with when there are many.
        seed: The same seed gives the same model.
        out: Folder in which finished stages are saved.
        resume: Use the stages that an earlier run with the same images and options saved there.
        progress: Called as the work goes on.

    Returns:
        One model of all photographs, unless nothing could be triangulated, and a report.

    Raises:
        ReconstructionError: Wrong input: no such folder, fewer than two photographs that the model has poses for, or
            photographs of other sizes than the model says.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> files = torchsfm.render_sequence(views=4, width=320, height=240, generator=g).save("photos")
        >>> poses = torchsfm.reconstruct("photos").model  # or `torchsfm.read_model` of any program's
        >>> result = torchsfm.triangulate_photographs("photos", poses)
        >>> len(result.model.X) > 100
        True
    """
    report = progress or (lambda stage, done, total: None)
    generator = torch.Generator().manual_seed(seed)
    seen = match_photographs(
        images, sequence=sequence, max_features=max_features, max_pixels=max_pixels, neighbours=neighbours, out=out,
        resume=resume, seed=seed, progress=report, masks=masks,
    )  # fmt: skip
    place = _places(seen, poses)
    reasons = dict.fromkeys((place < 0).nonzero()[:, 0].tolist(), "has no pose in the given model")
    with seen.stages.timed("map"):
        report("map", 0, len(place))
        mapping, options, new = start_mapping(
            seen.graph, seen.points.labels, seen.points.focal, poses.to("cpu", torch.float64), place, generator
        )
        given = mapping
        mapping = _structure(mapping, options)
        if refine_poses:
            for _ in range(2):
                mapping = _structure(adjust(mapping, max_iterations=LAST_ITERATIONS, tolerance=LAST_TOLERANCE), options)
            mapping = _moved_back(mapping, given)
        if register and len(mapping.X):
            mapping, options, new, reasons = place_images(mapping, options, new, report)
        report("map", int(mapping.registered.sum()), len(place))
        result = result_of(mapping, options, new.own, reasons, seen.points.failures, seen.names)
    course = replace(result.report, seconds=dict(seen.stages.seconds), skipped=seen.skipped)
    return replace(result, report=course)


def result_of(
    mapping: Mapping,
    options: MappingOptions,
    own: Bool[Tensor, "g"],
    reasons: dict[int, str],
    failures: dict[str, str],
    order: Sequence[str],
) -> SfmResult:
    """The finished model with what is thought of it.

    Args:
        mapping: The model.
        options: How it was made.
        own: Cameras that were estimated.
        reasons: Why images have no pose, by index.
        failures: Files that could not be read, with the reason.
        order: All files in the order of the input.
    """
    graph = mapping.graph
    names = mapping.cameras.distortion.parameter_names
    standing = examine(mapping, open_numbers=("focal", *names) if bool(own.any()) else (), prior=options.prior(mapping),
                       threshold=options.reprojection)  # fmt: skip
    found = [(mapping.reconstruction(), standing)] if len(mapping.X) else []
    known = torch.zeros(len(graph.names), dtype=torch.bool)
    verdict = graph.verdicts(mapping.cameras.K[mapping.camera_index], known)
    pairs = pair_report(graph.pairs, graph.num_matches, graph.fundamental_inliers, graph.homography_inliers, verdict)
    reports = image_reports(graph, found, reasons, failures, order)
    return SfmResult(tuple(model for model, _ in found), Report(reports, pairs, {}))


def _places(seen: MatchedPhotographs, poses: Reconstruction) -> Int[Tensor, "v"]:
    """Which image of the model each photograph is, or -1; of the model's only those with a pose count.

    Raises:
        ReconstructionError: Fewer than two are there, or one has another size.
    """
    posed = {name: i for i, name in enumerate(poses.names) if bool(poses.registered[i])}
    place = torch.tensor([posed.get(name, -1) for name in seen.points.names], dtype=torch.long)
    for i, name in enumerate(seen.points.names):
        size, wanted = seen.points.image_size[i].tolist(), poses.image_size[place[i]].tolist()
        if place[i] >= 0 and size != wanted:
            sizes = f"{size[0]} x {size[1]} pixels, in the model of the poses {wanted[0]} x {wanted[1]}"
            raise ReconstructionError(f"{name}: {sizes}")
    if int((place >= 0).sum()) < 2:
        first = next(iter(posed), "none")
        raise ReconstructionError(
            f"{int((place >= 0).sum())} of {len(place)} photographs have a pose in the model, two are the least"
            f" (the model has {first!r}, the photographs {seen.points.names[0]!r})"
        )
    return place


@dataclass(frozen=True)
class NewCameras:
    """What photographs that are new may have been taken with."""

    own: Bool[Tensor, "g"]
    """Cameras that are not the model's and are estimated."""
    like: Int[Tensor, "g"]
    """The model's camera that each one is thought to be, itself for those that nothing is thought of."""


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
    new = NewCameras((used >= first) & (used < second), torch.searchsorted(used, rows))
    words = (*("given",) * first, *source, *("default",) * len(place))
    sigma = focal_uncertainty(words)[used].to(K.dtype)
    track = build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair])
    mapping = Mapping.start(graph, track, cameras, index)
    known = place >= 0
    chosen = poses.poses[place.clamp(min=0)]
    R = torch.where(known[:, None, None], chosen.R, mapping.poses.R)
    mapping = replace(mapping, poses=Pose(R, torch.where(known[:, None], chosen.t, 0.0)), registered=known)
    return mapping, MappingOptions(free=(), expected=cameras, focal_sigma=sigma, generator=generator), new


def _structure(mapping: Mapping, options: MappingOptions) -> Mapping:
    """Points of all tracks, with the poses and cameras as they are."""
    for _ in range(ROUNDS):
        before = mapping.point
        mapping = triangulate_tracks(mapping, threshold=options.reprojection, min_angle=options.min_angle)
        mapping = complete_tracks(mapping, threshold=options.reprojection)
        mapping = merge_points(mapping, threshold=options.reprojection)
        mapping = filter_points(mapping, threshold=options.reprojection, min_angle=options.min_angle)
        mapping = _adjust(mapping, moving=torch.zeros_like(mapping.registered))
        mapping = filter_points(mapping, threshold=options.reprojection, min_angle=options.min_angle)
        if int(((before >= 0) != (mapping.point >= 0)).sum()) <= 0.01 * int((before >= 0).sum()):
            break
    return mapping


def _adjust(
    mapping: Mapping,
    *,
    moving: Bool[Tensor, "v"],
    own: Bool[Tensor, "g"] | None = None,
    options: MappingOptions | None = None,
    cameras: dict[str, Any] | None = None,
) -> Mapping:
    """Move all points, some of the poses, and of some cameras what the images determine."""
    node = mapping.observations()
    if not len(node):
        return mapping
    cameras = cameras or {}
    if own is not None and options is not None and bool(own.any()):
        prior = options.prior(mapping)
        names = ("focal", *mapping.cameras.distortion.parameter_names)
        free = {name: mask & own for name, mask in choose_free(mapping, names, prior, loss=LOSS).items()}
        cameras = about_cameras(mapping, free, prior)
    result = bundle_adjust(
        mapping.problem(),
        fixed_poses=~moving,
        loss=LOSS,
        max_iterations=LAST_ITERATIONS,
        tolerance=LAST_TOLERANCE,
        **({"free": ()} | cameras),
    )  # fmt: skip
    if result.status == Status.INTERRUPTED:
        raise KeyboardInterrupt
    return replace(mapping, poses=result.poses, cameras=result.cameras, X=result.X)


def _moved_back(mapping: Mapping, given: Mapping) -> Mapping:
    """The mapping where its camera centres fit the given ones best; as it is where these do not tell."""
    keep = mapping.registered
    back = similarity_from_points(mapping.poses.centre[keep], given.poses.centre[keep])
    if back.status != Status.OK:
        return mapping
    poses = back.transform_pose(mapping.poses)
    R = torch.where(keep[:, None, None], poses.R, mapping.poses.R)
    return replace(mapping, X=back.transform(mapping.X), poses=Pose(R, torch.where(keep[:, None], poses.t, mapping.poses.t)))


def place_images(
    mapping: Mapping, options: MappingOptions, new: NewCameras, progress: Progress
) -> tuple[Mapping, MappingOptions, NewCameras, dict[int, str]]:
    """Poses for the images that have none, and why some get none; with the cameras that are left."""
    given, failed = mapping.registered, dict[int, str]()
    nowhere = torch.zeros_like(given)
    sigma = options.focal_sigma.index_fill(0, mapping.camera_index[given], 0.0)
    own = new.own
    thought = new.like != torch.arange(len(own))
    while len(images := next_images(mapping, nowhere, failed)):
        before = mapping.registered
        mapping, count, inliers = register_images(
            mapping, images, threshold=options.registration, focal_sigma=sigma, least=SURPRISE * thought,
            generator=options.generator,
        )  # fmt: skip
        placed = mapping.registered & ~before
        for i, n, k in zip(images.tolist(), count.tolist(), inliers.tolist(), strict=True):
            if not placed[i]:
                failed[i] = f"a pose fits only {k} of the {n} points it sees"
        if bool(placed.any()):
            # A camera that has found another focal length is not the one it was thought to be.
            focal = mapping.cameras.K[:, 0, 0]
            other = thought & (focal != focal[new.like])
            other = other | _other_focal_lengths(mapping, options, placed, thought & ~other)
            own = own | other
            index = torch.where(placed & ~other[mapping.camera_index], new.like[mapping.camera_index], mapping.camera_index)
            mapping = replace(mapping, camera_index=index)
            sigma = sigma.index_fill(0, mapping.camera_index[placed], 0.0)
            mapping = _adjust(mapping, moving=mapping.registered & ~given, own=own, options=options)
            mapping = _structure(mapping, options)
            progress("map", int(mapping.registered.sum()), len(given))
    mapping = _adjust(mapping, moving=mapping.registered & ~given, own=own, options=options)
    index = torch.where(mapping.registered, mapping.camera_index, new.like[mapping.camera_index])
    used, index = torch.unique(index, return_inverse=True)
    left = NewCameras(own[used], torch.arange(len(used)))
    choices = replace(options, expected=options.expected[used], focal_sigma=options.focal_sigma[used])
    return replace(mapping, cameras=mapping.cameras[used], camera_index=index), choices, left, failed


def _other_focal_lengths(
    mapping: Mapping, options: MappingOptions, placed: Bool[Tensor, "v"], thought: Bool[Tensor, "g"]
) -> Bool[Tensor, "g"]:
    """Which cameras that are thought to be others of the model explain their image clearly better by another focal length."""
    known = _adjust(mapping, moving=placed)
    node = known.observations()
    open_ = thought[known.camera_index] & placed
    if not bool(open_.any()):
        return torch.zeros_like(thought)
    free = torch.zeros_like(thought).index_fill(0, known.camera_index[open_], True)
    other = _adjust(known, moving=placed, cameras=about_cameras(known, {"focal": free}, options.prior(known)))
    noise = measure_noise(other, LOSS)
    costs = [LOSS(one.errors(one.point[node], node).clamp_max(1e6).square()) for one in (known, other)]
    camera = known.camera_index[known.graph.view[node]]
    gain = torch.zeros(len(thought), dtype=costs[0].dtype).index_add(0, camera, costs[0] - costs[1]) / noise**2
    return free & (gain > TOGETHER * SURPRISE)
