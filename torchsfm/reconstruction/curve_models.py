"""From the frames of a sequence to a model of cameras and curves, where points do not suffice."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.geometry import DISTORTION_MODELS, Camera, intrinsics
from torchsfm.reconstruction.curves.deviations import Deviations, calibration, deviations
from torchsfm.reconstruction.curves.find_curves import FoundEdges, detect_all_edges, scaled
from torchsfm.reconstruction.curves.frames import Frames, as_motion, detect_all_motion
from torchsfm.reconstruction.curves.mapping import CurveMapping
from torchsfm.reconstruction.curves.sequence import Expected, Settled, all_curves, map_sequence
from torchsfm.reconstruction.evidence.doubt import DEVIATIONS, GUESSED_FOCAL, WRONG_ANGLE, Standing
from torchsfm.reconstruction.mapping.camera_prior import PRINCIPAL_POINT_SIGMA
from torchsfm.reconstruction.mapping.cameras import DEFAULT_FOCAL, FOCAL_SIGMA
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.sources import Sources
from torchsfm.reconstruction.matching.stages import Stages, one_thread
from torchsfm.reconstruction.messages import Progress, ReconstructionError
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import ImageReport, Report, SfmResult, pair_report

FRAME_SIZE = 640
"""Longer side, in pixels, to which larger frames are scaled down."""
_BENT = 0.05
"""Standard deviation of the first number of a lens' distortion, and"""
_MORE_BENT = 0.02
"""of others."""
_RESTLESS = 0.5
"""Degrees by which cameras may still turn when samples are found anew."""
_CONTRADICTED = 1.0
"""Degrees between cameras of the model and those of a few frames by themselves, beyond which the model has drifted."""
_FEWEST = 30
"""Samples that a frame must show in the end."""


def reconstruct_from_curves(
    sources: Sources,
    stages: Stages,
    *,
    camera: str,
    K: Float[Tensor, "3 3"] | None,
    max_pixels: int,
    masks: Masks | None,
    progress: Progress,
) -> SfmResult:
    """Reconstruct consecutive frames of one camera from their edges alone.

    Args:
        sources: The frames, in order.
        stages: Timing and saving.
        camera: Name of the distortion model.
        K: Known intrinsics.
        max_pixels: Larger frames are left out.
        masks: Where frames show nothing that counts.
        progress: Called as the work goes on.

    Raises:
        ReconstructionError: Fewer than two frames can be read, or they differ in size.
    """
    found = FoundEdges.of(
        stages.run("edges", lambda: detect_all_edges(sources.files, max_pixels, progress, masks, longest=FRAME_SIZE))
    )
    readable = (found.size > 1).all(-1).nonzero()[:, 0]
    if len(readable) < 2:
        raise ReconstructionError(f"{len(readable)} of {len(sources.files)} files can be read as images")
    size = (found.size * found.zoom).round().long()[readable]
    if len(torch.unique(size, dim=0)) > 1:
        raise ReconstructionError("the frames of a sequence must have one size")
    zoom = found.zoom[readable[0]]
    focal = [f for f in found.focal[readable].tolist() if f > 0]
    expected, source = _expected(camera, K, focal, size[0], zoom)
    width, height = found.size[readable[0]].tolist()
    files = [sources.files[i] for i in readable.tolist()]
    moved = stages.run("motion", lambda: detect_all_motion(files, max_pixels, progress, longest=FRAME_SIZE))
    frames = Frames([found.edges[i] for i in readable.tolist()], as_motion(moved))
    with stages.timed("map"), one_thread():
        settled, reason = map_sequence(frames, (height, width), expected, progress)
    names = [sources.names[i] for i in readable.tolist()]
    with stages.timed("curves"):
        models = tuple(_model(one.mapping, names, size, zoom, progress) for one in settled)
    known = [deviations(one.mapping, one.told) for one in settled]
    standing = [_standing(one, own) for one, own in zip(settled, known, strict=True)]
    images = _reports(sources.names, readable, found, list(zip(settled, standing, strict=True)), reason)
    calibrations = tuple(calibration(one, own, expected, zoom) for one, own in zip(settled, known, strict=True))
    none = torch.zeros(0, dtype=torch.long)
    pairs = pair_report(none.reshape(0, 2), none, none, none, none)
    seconds = dict(stages.seconds)
    report = Report(images, pairs, seconds, (source,), calibrations=calibrations, method="curves", refusal=reason)
    return SfmResult(models, report)


def _expected(
    camera: str, K: Tensor | None, focal: Sequence[float], size: Int[Tensor, "2"], zoom: Float[Tensor, "2"]
) -> tuple[Expected, str]:
    """What is known of the camera, in pixels of the edges, and where its focal length comes from."""
    distortion = DISTORTION_MODELS[camera]
    whole = size.double()
    source = "given" if K is not None else "exif" if focal else "default"
    f = torch.tensor(focal, dtype=torch.float64).median() if focal else DEFAULT_FOCAL * whole.max()
    matrix = K.double() if K is not None else intrinsics(f, (whole - 1) / 2)
    none = distortion.from_parameters(torch.zeros(distortion.num_parameters, dtype=torch.float64))
    seen = scaled(Camera(matrix, none)[(None,)], 1 / zoom[None])[0]
    names = distortion.parameter_names
    sigma = dict.fromkeys(names, _MORE_BENT) | dict.fromkeys(names[:1], _BENT) | {"focal": FOCAL_SIGMA[source]}
    if K is not None:
        return Expected(seen, tuple(names), sigma), source
    sigma["principal_point"] = PRINCIPAL_POINT_SIGMA * float((whole / zoom).max())
    return Expected(seen, ("focal", *names), sigma, held=("principal_point",)), source


def _model(
    mapping: CurveMapping, names: Sequence[str], size: Int[Tensor, "v 2"], zoom: Float[Tensor, "2"], progress: Progress
) -> Reconstruction:
    """The model in pixels of the whole frames."""
    v = len(names)
    x, none = mapping.poses.t.new_zeros(0, 2), torch.zeros(0, dtype=torch.long)
    curves = all_curves(mapping, progress).in_images(torch.arange(v), zoom.expand(v, 2)).detached()
    X = mapping.poses.t[:0]
    return Reconstruction(
        names=tuple(names), image_size=size, cameras=scaled(mapping.camera[(None,)], zoom[None]),
        camera_index=torch.zeros(v, dtype=torch.long), poses=mapping.poses, registered=mapping.registered,
        X=X, color=X, x=x, view=none, point=none, curves=curves,
    )  # fmt: skip


def _standing(settled: Settled, known: Deviations) -> Standing:
    """How well the cameras are known, by the curves."""
    mapping = settled.mapping
    curves = mapping.curves
    seen = torch.bincount(curves.view, minlength=len(mapping.edges))
    depth = (mapping.poses.transform(curves.X)[..., 2]).median(-1).values
    there = mapping.registered
    rotation = torch.where(there, known.rotation, torch.inf)
    position = torch.where(there, known.position / depth.abs(), torch.inf)
    told = settled.apart[settled.apart.isfinite()]
    contradicted = float(told.amax()) if len(told) else 0.0
    focal, zoomed = known.numbers.get("focal", 0.0), settled.zoomed()

    def doubt(i: int) -> str:
        if int(seen[i]) < _FEWEST:
            return f"it shows {int(seen[i])} samples of curves only"
        if not focal < GUESSED_FOCAL:
            return f"curves tell the focal length to {100 * focal:.0f} % only"
        if not settled.apart[i] < torch.inf:
            return "curves followed through the frames around do not tell its camera by themselves"
        if contradicted > _CONTRADICTED:
            return f"cameras turn by {contradicted:.1f} degrees less or more than a few frames by themselves say"
        if zoomed is not None:
            return f"its focal length is {zoomed:.2f} times the one that a few frames at a time say"
        if settled.moved > _RESTLESS:
            return f"cameras still turn by {settled.moved:.1f} degrees when samples are found anew"
        if not DEVIATIONS * rotation[i] < WRONG_ANGLE:
            return f"its rotation is known to {rotation[i]:.1f} degrees only"
        if not DEVIATIONS * torch.atan(position[i]).rad2deg() < WRONG_ANGLE:
            return f"its place is known to {100 * position[i]:.1f} % of its distance from the curves only"
        return ""

    return Standing(rotation, position, tuple(doubt(i) if there[i] else "" for i in range(len(there))))


def _reports(
    names: Sequence[str], readable: Tensor, found: FoundEdges, models: Sequence[tuple[Settled, Standing]], reason: str
) -> tuple[ImageReport, ...]:
    """What became of each file."""
    place = {file: i for i, file in enumerate(readable.tolist())}
    reports = []
    for k, name in enumerate(names):
        i, features = place.get(k), len(found.edges[k])
        own = [] if i is None else [m for m, (one, _) in enumerate(models) if bool(one.mapping.registered[i])]
        if i is None:
            reports.append(ImageReport(name, None, "cannot be read as an image"))
        elif not models:
            reports.append(ImageReport(name, None, reason, features))
        elif not own:
            reports.append(ImageReport(name, None, "its edges do not fit the curves of the frames around", features))
        else:
            standing = models[own[0]][1]
            sigma = {"rotation_sigma": float(standing.rotation_sigma[i]), "position_sigma": float(standing.position_sigma[i])}
            reports.append(ImageReport(name, own[0], "", features, doubt=standing.doubt[i], **sigma))
    return tuple(reports)
