"""Curves after points: edges of photographs are followed through the placed views, then all is adjusted together."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Camera, Pose, rotation_angle
from torchsfm.images import ImageError, read_image
from torchsfm.reconstruction.curves.adjustment import WithCurves, adjust_with_curves
from torchsfm.reconstruction.curves.from_edges import curves_of_edges, curves_of_other_cameras
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.evidence.consistency import excess_scatter
from torchsfm.reconstruction.lines.find_lines import lines_of_cameras
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.masks import Admission
from torchsfm.reconstruction.matching.stages import Arrays
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.lines import Lines

EDGE_SIZE = 1000
"""Longer side, in pixels, to which larger images are scaled down: they have more edges, each with more depths to look at."""
SHORTEST = 16
"""Edge points of the shortest chains."""
_ROUNDS = 4
"""Times, the most, that cameras are adjusted a few steps and samples then brought to the edges by these,"""
_STILL = 0.1
"""as images move by more pixels."""


@dataclass(frozen=True)
class FoundEdges:
    """What `detect_all_edges` found."""

    edges: tuple[ImageEdges, ...]
    """Of each image, in pixels of the size that it was read in; none of one that could not be read."""
    size: Int[Tensor, "v 2"]
    """Width and height of that size."""
    zoom: Float[Tensor, "v 2"]
    """Pixels of the image for one of these, along x and y."""
    focal: Float[Tensor, "v"]
    """Focal length in pixels of the image that each file states, or 0."""

    @classmethod
    def of(cls, arrays: Arrays) -> "FoundEdges":
        """From saved tensors."""
        counts = arrays["count"].tolist()
        parts = zip(*(torch.split(arrays[field.name], counts) for field in fields(ImageEdges)), strict=True)
        return cls(tuple(ImageEdges(*part) for part in parts), *(arrays[name] for name in ("size", "zoom", "focal")))


class _Photograph(NamedTuple):
    """What one file gives."""

    edges: ImageEdges
    size: tuple[int, int]
    zoom: tuple[float, float]
    focal: float


def detect_all_edges(
    files: Sequence[Path], max_pixels: int, progress: Progress, masks: Admission | None = None, *, longest: int = EDGE_SIZE
) -> Arrays:
    """Edges of all files as tensors to save, those of a file after those of the one before; none of what cannot be read."""

    def work(path: Path) -> _Photograph:
        try:
            photo = read_image(path, max_size=longest, max_pixels=max_pixels)
        except ImageError:
            return _Photograph(ImageEdges.none(), (1, 1), (1.0, 1.0), 0.0)
        found = ImageEdges.of(photo.pixels, min_edgels=SHORTEST)
        zoom = photo.size[0] / photo.width, photo.size[1] / photo.height
        if masks is not None:
            found = found.where(masks.admit(path, (found.x + 0.5) * torch.tensor(zoom) - 0.5, photo.size))
        # The focal length is that of the image as it was read.
        focal = (photo.focal or 0.0) * max(photo.size) / max(photo.width, photo.height)
        return _Photograph(found, (photo.width, photo.height), zoom, focal)

    found: list[_Photograph] = []
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        for result in pool.map(work, files):
            found.append(result)
            progress("edges", len(found), len(files))
    joined = {field.name: torch.cat([getattr(f.edges, field.name) for f in found]) for field in fields(ImageEdges)}
    numbers = {
        "count": torch.tensor([len(f.edges) for f in found]),
        "size": torch.tensor([f.size for f in found]),
        "zoom": torch.tensor([f.zoom for f in found], dtype=torch.float64),
        "focal": torch.tensor([f.focal for f in found], dtype=torch.float64),
    }
    return joined | numbers


def find_curves(
    mapping: Mapping,
    found: FoundEdges,
    prior: CameraPrior | None,
    progress: Progress,
    *,
    lines: Lines | None = None,
    lines_agree: bool = True,
    threshold: float = 4.0,
) -> WithCurves:
    """Find the curves in space of a finished model, and adjust cameras, points, lines and curves together.

    Args:
        mapping: The model.
        found: Edges of all its images.
        prior: What is expected of its cameras, where something of them is estimated.
        progress: Called as the work goes on.
        lines: Lines of the model, if it has any.
        lines_agree: Whether they move the cameras, too. Those that points contradict go with the cameras.
        threshold: Largest reprojection error of an observation, pixels.

    Returns:
        The model after the adjustment, its lines, and the curves with the edge points that show them in pixels of the images.
        The model and its lines are as they were where there are no curves, or these contradict the points.
    """
    known = mapping.registered.nonzero()[:, 0]
    zoom, size = found.zoom[known], found.size[known]
    height_width = (int(size[:, 1].amax()), int(size[:, 0].amax())) if len(known) else (8, 8)
    edges = [found.edges[i] for i in known.tolist()]

    def placed(model: Mapping) -> tuple[Camera, Pose]:
        return scaled(model.cameras[model.camera_index[known]], 1 / zoom), model.poses[known]

    points = mapping.X[_seen(mapping)]
    curves = curves_of_edges(edges, height_width, *placed(mapping), points=points, finders_alone=True, progress=progress)
    best = WithCurves(mapping, lines, curves.in_images(known, zoom))
    excess = excess_scatter(mapping, threshold=threshold)
    steps, still = 0, True
    for _ in range(_ROUNDS):
        before = best.mapping
        own = best.lines if lines_agree else None
        better = adjust_with_curves(before, best.curves, prior, own, alone=mapping, excess=excess)
        if better is None:
            break
        # Samples were brought to their edges with cameras that were off, which holds these where they were.
        curves = curves_of_other_cameras(replace(curves, X=better.curves.X), edges, height_width, *placed(better.mapping))
        best = WithCurves(better.mapping, better.lines if lines_agree else lines, curves.in_images(known, zoom))
        adjusted = better.mapping.adjustment
        assert adjusted is not None, "it was"
        steps += adjusted.iterations
        if still := _shift(before, best.mapping) < _STILL:
            break
    if steps and best.mapping.adjustment is not None:
        # Cameras that hardly move any more have come to rest, though samples go on.
        status = Status.OK if still else Status.NOT_CONVERGED
        best = best._replace(
            mapping=replace(best.mapping, adjustment=replace(best.mapping.adjustment, status=status, iterations=steps))
        )
    if lines is not None and not lines_agree and best.mapping is not mapping:
        best = best._replace(lines=lines_of_cameras(best.mapping, lines))
    return best


def _shift(before: Mapping, after: Mapping) -> float:
    """By how many pixels images have moved, the most, as their cameras have turned to each other."""
    own = after.registered
    turn = before.poses.R[own].mT @ after.poses.R[own]
    # What is alike in all is a turn of the world.
    apart = rotation_angle(turn @ turn[:1].mT)
    return float((apart * after.cameras.K[after.camera_index[own], 0, 0]).amax())


def scaled(cameras: Camera, share: Float[Tensor, "v 2"]) -> Camera:
    """Cameras of images that have so many times the pixels along x and y."""
    K = cameras.K.clone()
    # Pixel centres have whole coordinates.
    K[:, :2] *= share[:, :, None].to(K)
    K[:, :2, 2] += ((share - 1) / 2).to(K)
    return replace(cameras, K=K)


def _seen(mapping: Mapping) -> Bool[Tensor, "n"]:
    """Points that views observe."""
    seen = torch.zeros(len(mapping.X), dtype=torch.bool)
    seen[mapping.point[mapping.observations()]] = True
    return seen & mapping.X.isfinite().all(-1)
