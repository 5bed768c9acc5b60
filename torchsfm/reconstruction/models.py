"""From a view graph to finished models: first cameras, tracks, one model per component."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_one_problem, check_options
from torchsfm.geometry import DISTORTION_MODELS
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.adjust import LOSS
from torchsfm.reconstruction.beginning import Beginning, Grown, grow_by
from torchsfm.reconstruction.calibration import Calibration, calibration_of
from torchsfm.reconstruction.cameras import group_cameras
from torchsfm.reconstruction.choose_mapper import choose_mapper
from torchsfm.reconstruction.consistency import PairAgreement
from torchsfm.reconstruction.cropped import crops_of_one_plane, map_cropped, may_be_off_centre
from torchsfm.reconstruction.doubt import Standing, examine
from torchsfm.reconstruction.find_curves import FoundEdges, find_curves
from torchsfm.reconstruction.find_lines import FoundSegments, find_lines
from torchsfm.reconstruction.image_reports import image_reports
from torchsfm.reconstruction.incremental import UNKNOWN_FOCAL, MappingOptions, extend_model
from torchsfm.reconstruction.mapping import Mapping
from torchsfm.reconstruction.projective import projective_start
from torchsfm.reconstruction.reconstruction import Reconstruction
from torchsfm.reconstruction.report import Progress, ReconstructionError, Report, SfmResult, pair_report
from torchsfm.reconstruction.settle import settle
from torchsfm.reconstruction.stages import Stages, one_thread
from torchsfm.reconstruction.track_graph import graph_from_tracks
from torchsfm.reconstruction.tracks import build_tracks
from torchsfm.reconstruction.unfold import Unfolded, hanging_on_copies, unfold
from torchsfm.reconstruction.view_graph import ViewGraph
from torchsfm.reconstruction.zoomed import better_beginning, part_zoomed

METHODS = ("incremental", "projective", "global", "windows", "auto")
MIN_IMAGES = 2
"""Smallest number of images of a model."""
FEW_IMAGES = 60
"""Models of so few images have matrices too small to share between threads."""


def build_models(
    graph: ViewGraph,
    track: Int[Tensor, "n"] | None,
    *,
    labels: Sequence[str],
    exif_focal: Sequence[float | None],
    failures: dict[str, str],
    order: Sequence[str],
    camera: str,
    shared_camera: bool | None,
    K: Float[Tensor, "3 3"] | None,
    free_principal_point: bool,
    method: str,
    generator: torch.Generator,
    stages: Stages,
    progress: Progress,
    segments: Callable[[], FoundSegments] | None = None,
    edges: Callable[[], FoundEdges] | None = None,
    known_cameras: bool = False,
) -> SfmResult:
    """Reconstruct every component of a view graph.

    Args:
        graph: Image points and verified matches.
        track: Track of each image point, or None to build tracks from the matches.
        labels: What the files say of the camera, per image.
        exif_focal: Focal length in pixels stated in each file.
        failures: Files that could not be read, with the reason.
        order: All files in the order of the input.
        camera: Name of the distortion model.
        shared_camera: See `reconstruct`.
        K: Known intrinsics.
        free_principal_point: Whether to estimate the principal point.
        method: "incremental", "projective", "global", "windows", or "auto" for what `choose_mapper` says.
        generator: Source of randomness.
        stages: Timing and saving.
        progress: Called as images are registered.
        segments: Finds the segments of all images where lines are wanted.
        edges: Finds the edges of all images where curves are wanted.
        known_cameras: Whether labels tell for certain which images one camera took.
    """
    if camera not in DISTORTION_MODELS:
        raise ReconstructionError(f"no camera model '{camera}'; there are {', '.join(DISTORTION_MODELS)}")
    if method not in METHODS:
        raise ReconstructionError(f"no method '{method}'; there are {', '.join(METHODS)}")
    if method == "projective" and K is not None:
        raise ReconstructionError("the projective method finds the camera itself; known intrinsics are for the incremental one")
    few = len(graph.names) <= FEW_IMAGES
    with stages.timed("map"), one_thread() if few else nullcontext():
        matched = track is None
        if track is None:
            # Matches of strongly linked pairs come first: they are wrong less often.
            track = build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair])
        free: tuple[str, ...] = () if K is not None else ("focal",)
        free += DISTORTION_MODELS[camera].parameter_names
        free += ("principal_point",) if free_principal_point and K is None else ()
        begin = partial(
            Beginning.of, graph, track, model=camera, K=K, exif_focal=exif_focal, free=free, generator=generator
        )  # fmt: skip
        together = group_cameras(graph.image_size, labels, shared_camera)
        begun = begin(together)
        if method == "auto":
            method = choose_mapper(graph.pairs, graph.fundamental_inliers, begun.options.focal_sigma[together])
        report = lambda n, v: progress("map", n, v)  # noqa: E731
        first: Grown | None = None
        if shared_camera is None and K is None and not known_cameras and method != "projective":
            apart = part_zoomed(graph, together, torch.tensor([focal is not None for focal in exif_focal]))
            if apart is not None:
                begun, first = better_beginning(begun, begin(apart), partial(_settled, method, report))
        empty, options, source = begun.empty, begun.options, begun.source
        cameras, camera_index = empty.cameras, empty.camera_index
        # Of images that do not differ but in size, one camera may have taken all, and some were cropped.
        family = group_cameras(torch.zeros_like(graph.image_size), labels, shared_camera)
        made: list[tuple[Reconstruction, Mapping, MappingOptions, bool, Unfolded | None, PairAgreement | None]] = []
        reasons: dict[int, str] = {}
        autocalibration: list[str] = []
        taken = given_up = empty.registered
        while int((~taken).sum()) >= MIN_IMAGES:
            left_open = False
            if method == "projective":
                start = projective_start(empty, ~taken, threshold=options.reprojection, min_angle=options.min_angle)
                if start is None:
                    break
                autocalibration.append(start.summary)
                if start.mapping is None:
                    # What was refused is not tried again in smaller parts.
                    taken = taken.clone()
                    taken[start.views] = True
                    reasons |= dict.fromkeys(start.views.tolist(), "autocalibration was refused")
                    continue
                source = tuple("autocalibration" for _ in start.focal_sigma)
                metric = replace(options, expected=start.expected(), focal_sigma=start.focal_sigma)
                mapped, known = extend_model(start.mapping, taken, metric, report), metric
            else:
                grow = partial(grow_by, method, taken, report)
                grown, first = first or grow(empty, options), None
                if grown is None:
                    break
                mapped, known = grown, options
                left_open = may_be_off_centre(mapped[0], options)
                if left_open and (cropped := map_cropped(empty, mapped[0], taken, options, family, grow, report)):
                    (mapped, known), left_open = cropped, False
            model, failed = mapped
            model, parted, agreement = settle(model, taken, known, report)
            settled = model
            failed |= parted
            unfolded = None
            if matched and method != "projective":
                unfolded = unfold(empty, model, taken, known, report)
                given_up = given_up | (model.registered & ~unfolded.model.registered)
                model = unfolded.model
                # What is left is mapped without the relations that were given up.
                empty = replace(empty, graph=model.graph, track=model.track)
            lines = None
            if segments is not None:
                with stages.timed("lines"):
                    model, lines = find_lines(model, segments(), known.prior(model))
            curves = None
            if edges is not None:
                with stages.timed("curves"):
                    curves = find_curves(model, edges(), progress)
            if not made:
                reasons |= failed
            taken = taken | model.registered
            finished = replace(model.reconstruction(), lines=lines, curves=curves)
            made.append((finished, model, known, left_open, unfolded, agreement if model is settled else None))
            if stages.folder is not None:
                _save_model(made[-1][0], stages.folder, len(made) - 1)
        found: list[tuple[Reconstruction, Standing, Calibration]] = []
        for finished, model, known, left_open, unfolded, agreement in made:
            prior, threshold = known.prior(model), options.reprojection
            uncertain = None if unfolded is None else unfolded.uncertain
            # Lines move the cameras.
            conflicts = None if unfolded is None or model is not unfolded.model else unfolded.conflicts
            if uncertain is not None and bool(given_up.any()):
                uncertain = uncertain | hanging_on_copies(graph, model, taken & ~model.registered, threshold=threshold)
            # Where nothing tells whether images are cropped, cameras are as uncertain as if they were.
            widest = replace(known, cropped=known.cropped or left_open).prior(model)
            standing = examine(
                model, open_numbers=free, prior=widest, threshold=threshold, uncertain=uncertain, conflicts=conflicts,
                agreement=agreement, elsewhere=matches_across(graph, model.registered, taken & ~model.registered),
                flat=crops_of_one_plane(model, known),
            )  # fmt: skip
            covariance = None if standing.intrinsics is None or left_open else (free, standing.intrinsics)
            found.append((finished, standing, calibration_of(model, prior, loss=LOSS, covariance=covariance)))
        found.sort(key=lambda entry: (-entry[0].num_registered, -entry[0].num_points))
    progress("map", len(graph.names), len(graph.names))
    unknown_focal = (options.focal_sigma >= UNKNOWN_FOCAL)[camera_index]
    verdict = graph.verdicts(cameras.K[camera_index], unknown_focal)
    pairs = pair_report(graph.pairs, graph.num_matches, graph.fundamental_inliers, graph.homography_inliers, verdict)
    images = image_reports(graph, [(model, standing) for model, standing, _ in found], reasons, failures, order)
    calibrations = tuple(calibration for _, _, calibration in found)
    course = Report(
        images, pairs, dict(stages.seconds), source, tuple(autocalibration), calibrations=calibrations, method=method,
        still=graph.still,
    )  # fmt: skip
    return SfmResult(tuple(model for model, _, _ in found), course)


def _settled(
    method: str, progress: Callable[[int, int], None], empty: Mapping, options: MappingOptions
) -> tuple[Grown, Mapping] | None:
    """The first model, and what is left of it without images that contradict it."""
    grown = grow_by(method, empty.registered, progress, empty, options)
    return None if grown is None else (grown, settle(grown[0], empty.registered, options, progress)[0])


def _save_model(model: Reconstruction, folder: Path, number: int) -> None:
    (folder / "stages").mkdir(parents=True, exist_ok=True)
    model.save(folder / "stages" / f"model-{number}.npz")


def matches_across(graph: ViewGraph, registered: Bool[Tensor, "v"], others: Bool[Tensor, "v"]) -> Int[Tensor, "v"]:
    """How many verified matches each image of a model has with images of others."""
    total = torch.zeros(len(registered), dtype=torch.long)
    for own, other in (graph.pairs.unbind(1), graph.pairs.flip(1).unbind(1)):
        across = registered[own] & others[other]
        total.index_add_(0, own[across], graph.fundamental_inliers[across])
    return total


@on_the_cpu
def reconstruct_tracks(
    x: Float[Tensor, "n 2"],
    view: Int[Tensor, "n"],
    track: Int[Tensor, "n"],
    image_size: Int[Tensor, "v 2"],
    *,
    names: Sequence[str] | None = None,
    color: Float[Tensor, "n 3"] | None = None,
    camera: str | None = None,
    shared_camera: bool | None = None,
    K: Float[Tensor, "3 3"] | None = None,
    focal: float | None = None,
    free_principal_point: bool = True,
    method: str = "incremental",
    seed: int = 0,
    progress: Progress | None = None,
) -> SfmResult:
    """Reconstruct from image points whose correspondence is known.

    Args:
        x: Image points in pixels.
        view: Image of each point, from 0.
        track: Scene point of each image point, from 0; wrong ones are sorted out.
        image_size: Width and height of each image in pixels.
        names: Names of the images.
        color: Colours of the image points in [0, 1].
        camera: Distortion model, see `reconstruct`.
        shared_camera: Whether all images of one size share a camera, as they do by default unless pairs and models say that
            their focal lengths differ.
        K: Known intrinsics of all images.
        focal: First guess of the focal length in pixels, which is then adjusted; one that the images refute is not used.
        free_principal_point: Estimate the principal point too.
        method: "incremental", "projective", "global", "windows" or "auto", see `reconstruct`.
        seed: The same seed gives the same model.
        progress: Called as images are registered.

    Returns:
        The models, the largest first, and a report.

    Raises:
        ValueError: Shapes disagree or an index is out of range.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(3, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X).flatten(0, 1)
        >>> view, track = torch.arange(3).repeat_interleave(60), torch.arange(60).repeat(3)
        >>> found = torchsfm.reconstruct_tracks(x, view, track, torch.tensor([[1000, 750]] * 3), K=K)
        >>> found.model.num_registered, found.model.num_points, found.report.images[0].model
        (3, 60, 0)
    """
    check_one_problem(x=(x, "n 2"), view=(view, "n: int"), track=(track, "n: int"), image_size=(image_size, "v 2: int"))
    check_one_problem(color=(color, "?n 3"))
    check_one_problem(K=(K, "?3 3"))
    check_options(
        names=(names, Sequence | None), focal=(focal, "?float > 0"), seed=(seed, "int"), camera=(camera, str | None),
        shared_camera=(shared_camera, bool | None),
    )  # fmt: skip
    v = len(image_size)
    if names is not None and (isinstance(names, str) or len(names) != v or not all(isinstance(n, str) for n in names)):
        raise ValueError(f"names: wanted {v} strings, one an image, got {names!r}")
    if len(view) and not (int(view.min()) >= 0 and int(view.max()) < v):
        raise ValueError(f"view: wanted indices from 0 to {v - 1}, got {int(view.min())} to {int(view.max())}")
    if len(track) and int(track.min()) < 0:
        raise ValueError("track: wanted numbers from 0, got a negative one")
    named = tuple(names) if names is not None else tuple(f"image {i}" for i in range(v))
    generator = torch.Generator().manual_seed(seed)
    finite = x.isfinite().all(-1)
    color = torch.full((len(x), 3), 0.5) if color is None else color
    graph, tracks = graph_from_tracks(
        named,
        image_size,
        x[finite].double(),
        view[finite],
        torch.unique(track[finite], return_inverse=True)[1],
        color[finite].double(),
        generator=generator,
    )
    return build_models(
        graph,
        tracks,
        labels=[""] * v,
        exif_focal=[focal] * v,
        failures={},
        order=named,
        camera=camera or ("pinhole" if K is not None else "radial"),
        shared_camera=shared_camera,
        K=K,
        free_principal_point=free_principal_point,
        method=method,
        generator=generator,
        stages=Stages(None, False, ""),
        progress=progress or (lambda stage, done, total: None),
    )
