"""The main job: photographs in, cameras and points out."""

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.images import MAX_PIXELS
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.curve_models import reconstruct_from_curves
from torchsfm.reconstruction.curves.find_curves import FoundEdges, detect_all_edges
from torchsfm.reconstruction.lines.find_lines import FoundSegments
from torchsfm.reconstruction.mappers.growth import METHODS, Given, Wanted
from torchsfm.reconstruction.matching.image_points import ENOUGH, ImagePoints, detect_all
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.match_all import match_all
from torchsfm.reconstruction.matching.overlays import WithoutOverlays
from torchsfm.reconstruction.matching.segments import detect_all_segments
from torchsfm.reconstruction.matching.sources import Source, Sources
from torchsfm.reconstruction.matching.stages import Stages, fingerprint
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.messages import Progress, ReconstructionError
from torchsfm.reconstruction.models import build_models
from torchsfm.reconstruction.report import SfmResult

FROM_CURVES = "curves"
"""The method that goes by edges alone."""
NEIGHBOURS = 20
"""Images each one is matched with when there are many."""


@on_the_cpu
def reconstruct(
    images: Source,
    *,
    sequence: bool = False,
    camera: str | None = None,
    shared_camera: bool | None = None,
    K: Float[Tensor, "3 3"] | None = None,
    free_principal_point: bool = True,
    method: str = "auto",
    lines: bool = False,
    curves: bool = False,
    masks: str | Path | None = None,
    max_features: int = 8192,
    max_pixels: int = MAX_PIXELS,
    neighbours: int = NEIGHBOURS,
    seed: int = 0,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> SfmResult:
    """Reconstruct cameras and 3D points from photographs, with nothing known of the camera.

    The steps: SIFT features, where an image has few also weaker ones; matches between all pairs, of many images between those
    whose best features match (see `preview_matches`), less those of what is fixed to the images, as watermarks, parts of a
    vehicle and the wall behind a turntable are; epipolar geometry of these pairs in one batched call; focal length from Exif
    unless the fundamental matrices refute it, else from these, else a default; structure from motion (`method`) with bundle
    adjustment over poses, points, focal length and distortion. Images that have nothing in common form several models.

    Args:
        images: A folder with its subfolders, image files, a text file with the path of an image on each line, or several of
            these. Names are paths from the folder on. What else in a folder may hold photographs is named in the report with
            the reason why it was not read. For a film see `extract_frames`.
        sequence: The images are consecutive frames of a video: corners are tracked through it, and features are matched
            between frames that are near in time or look alike, instead of between all.
        camera: Name of the distortion model, one of `torchsfm.DISTORTION_MODELS`. By default "pinhole" when `K` is given, else
            "radial", or "fisheye" where that bends the corners strongly and a fisheye explains the images better.
        shared_camera: Whether one camera took all images of the same size. By default it did where they lie in one folder and
            the files name the same camera and focal length, or name none, unless without a focal length pairs and models say
            that there are several.
        K: Known intrinsics of all images, in pixels; they are not adjusted.
        free_principal_point: Estimate the principal point too, of models of four images or more, expected within 1 % of the
            image's size from its centre, instead of holding it there. Where images of different sizes say that they were
            cropped, it is looked for within 10 %, and if one camera may have taken them all, they share its focal length and
            distortion; the report says so (`Calibration.remark`). It also says where pixels are not square: where images
            that were stretched along one side explain much more, the ratio is estimated, too.
        method: "incremental" starts from two images and a first focal length; "projective" reconstructs all images together
            without calibration, by factorisation of the longest tracks, and finds the camera by autocalibration. It refuses
            rather than guesses where the images do not determine the focal length (`report.autocalibration` says why);
            "global" finds the rotations of all images from those of pairs, then all centres and points at once, with a first
            focal length; "windows" is for films: models of forty frames at a time, joined over what they share, also where the
            camera comes back, so that what each adds to the drift is spread over the loop; "auto" is "global" for 500 images or
            more that many pairs hold together and whose focal lengths are roughly known, else "incremental", or "global" where
            that leaves parts of what hangs together and more images are not doubtful then; "curves" goes by
            edges alone, where points do not suffice: smooth things with painted curves. The images are consecutive frames of
            one camera that is a little elsewhere each time, or farther where dense motion tells where what they show is in the
            next one; its principal point is held centred. Curves are followed through a few frames at a time, which tells their
            cameras; these are joined, other frames are placed by the curves in space, and all are adjusted together; where
            nothing joins them there are several models. There are no points then: the curves are in `Reconstruction.curves`.
            `report.refusal` says why where there is no model.
        lines: Find straight lines, too: segments of the photographs, linked over three views or more with the cameras that
            points have given; then cameras, points and lines are adjusted together, unless lines contradict the points.
            They are in `Reconstruction.lines`.
        curves: Find curves in space, too: edges of the photographs, scaled down to a thousand pixels, followed through the
            images around with the cameras that have been found (`reconstruct_curves`); then cameras, points, lines and curves
            are adjusted together, unless curves contradict the points. They are in `Reconstruction.curves`.
        masks: Folder of masks, in which nothing counts that is black: see `Masks` for their names. The mask of `view.jpg` is
            `view.jpg.png` or `view.png`.
        max_features: Features per image.
        max_pixels: Larger images are left out, as a small file can hold more than the memory does.
        neighbours: Images each one is matched with when there are many.
        seed: The same seed gives the same model.
        out: Folder in which finished stages are saved.
        resume: Use the stages that an earlier run with the same images and options saved there.
        progress: Called as the work goes on.

    Returns:
        The models, the largest first, and a report on every image and pair. World frames have arbitrary place, direction and
        scale.

    Raises:
        ReconstructionError: Wrong input: no such folder, fewer than two readable images, an unknown camera model.
        ValueError: An argument has the wrong shape.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> files = torchsfm.render_sequence(views=5, width=320, height=240, generator=g).save("photos")
        >>> result = torchsfm.reconstruct("photos")
        >>> int(result.model.registered.sum())
        5
        >>> result.model.save("model.npz")
    """
    if method not in (*METHODS, FROM_CURVES):
        raise ReconstructionError(f"no method '{method}'; there are {', '.join((*METHODS, FROM_CURVES))}")
    if K is not None and K.shape != (3, 3):
        raise ValueError(f"K: wanted shape (3, 3), got {tuple(K.shape)}")
    report = progress or (lambda stage, done, total: None)
    if method == FROM_CURVES:
        if lines:
            raise ReconstructionError("the method from curves finds no lines")
        lens = Wanted(camera, K=K).lens
        sources = Sources.of(images, without=[folder for folder in (out, masks) if folder is not None])
        admitted = None if masks is None else Masks.of(masks, sources)
        stages = _stages(sources, admitted, {"method": method, "pixels": max_pixels}, out, resume)
        found = reconstruct_from_curves(
            sources, stages, camera=lens, K=K, max_pixels=max_pixels, masks=admitted, progress=report
        )
        return replace(found, report=replace(found.report, skipped=sources.skipped))
    wanted = Wanted(camera, shared_camera, K, free_principal_point, method)
    seen = match_photographs(
        images, sequence=sequence, max_features=max_features, max_pixels=max_pixels, neighbours=neighbours, out=out,
        resume=resume, seed=seed, progress=report, masks=masks,
    )  # fmt: skip
    scene = WithoutOverlays.of(seen.points.files, seen.graph, seen.masks)
    # Overlays are found with the seed.
    after = "" if seen.graph.fixed is None else str(seed)

    def segments() -> FoundSegments:
        find = partial(detect_all_segments, seen.points.files, max_pixels, report, scene)
        return FoundSegments.of(seen.stages.run("segments", find, after=after))

    def edges() -> FoundEdges:
        find = partial(detect_all_edges, seen.points.files, max_pixels, report, scene)
        return FoundEdges.of(seen.stages.run("edges", find, after=after))

    result = build_models(
        Given(seen.graph, seen.points.labels, seen.points.focal),
        wanted,
        order=seen.names,
        failures=seen.points.failures,
        generator=torch.Generator().manual_seed(seed),
        stages=seen.stages,
        progress=report,
        segments=cache(segments) if lines else None,
        edges=cache(edges) if curves else None,
    )
    return replace(result, report=replace(result.report, skipped=seen.skipped))


def _stages(
    sources: Sources, masks: Masks | None, options: dict[str, Any], out: str | Path | None, resume: bool, first: float = 0.0
) -> Stages:
    """Stages of work on photographs with options on which all that is saved depends."""
    options = options | {"names": sources.names}
    if masks is not None:
        options["masks"] = fingerprint([path for file in sources.files if (path := masks.path(file))], {})
    return Stages(None if out is None else Path(out), resume, fingerprint(sources.files, options), first)


@dataclass(frozen=True)
class MatchedPhotographs:
    """What photographs say before any camera is known.

    Attributes:
        names: All files in the order of the input.
        skipped: What was passed over in their folder, with the reason.
        points: The features of those that could be read, and what the files say of the cameras.
        graph: Verified matches.
        stages: Where the time went, and finished stages.
        masks: Where nothing was looked for, if so wished.
    """

    names: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...]
    points: ImagePoints
    graph: ViewGraph
    stages: Stages
    masks: Masks | None


def match_photographs(
    images: Source,
    *,
    sequence: bool,
    max_features: int,
    max_pixels: int,
    neighbours: int,
    out: str | Path | None,
    resume: bool,
    seed: int,
    progress: Progress,
    masks: str | Path | None,
    first: float = 0.0,
) -> MatchedPhotographs:
    """Read photographs, find their features and match them; the arguments are those of `reconstruct`.

    Several processes may do so together into one folder, all with `resume`, each with another `first` (see `Stages`): each does
    a part of the work, and all return the same.

    Raises:
        ReconstructionError: No such folder, or fewer than two readable images.
    """
    sources = Sources.of(images, without=[folder for folder in (out, masks) if folder is not None])
    files, names = sources.files, sources.names
    # What is saved depends on these alone; cameras and models are made from it each time.
    options: dict[str, Any] = {"sequence": sequence, "features": max_features, "pixels": max_pixels, "neighbours": neighbours}
    options["enough"] = ENOUGH
    found = None if masks is None else Masks.of(masks, sources)
    stages = _stages(sources, found, options, out, resume, first)
    points = detect_all(files, names, stages, max_features, max_pixels, progress, found)
    graph = match_all(
        points, stages, progress, seed, sequence=sequence, neighbours=neighbours, max_pixels=max_pixels, masks=found
    )
    return MatchedPhotographs(names, sources.skipped, points, graph, stages, found)
