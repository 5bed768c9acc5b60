"""Lines after points: segments are linked over the placed views, then cameras, points and lines are adjusted together."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.bundle import BundleLines, bundle_adjust
from torchsfm.bundle.lines import segment_distances
from torchsfm.optim import Cauchy
from torchsfm.reconstruction.lines.tracks import Cameras, ViewSegments, link_lines, propose_lines
from torchsfm.reconstruction.mappers.incremental import LAST_ITERATIONS, LAST_TOLERANCE
from torchsfm.reconstruction.mapping.adjust import LOSS, about_cameras, as_adjusted, points_agree
from torchsfm.reconstruction.mapping.calibration import measure_noise, observation_weights
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.stages import Arrays
from torchsfm.reconstruction.model.lines import Lines

PAIRS, NEIGHBOURS = 5, 16
"""Views with which each is compared, and views that are asked whether they see its lines, too."""
SHARED = 12
"""Least number of points that neighbours share."""
ANGLE = 0.12
"""Angle between the views of neighbours, radians, beyond which more does not make them better."""
TOLERANCE = 0.0015
"""Largest distance of a segment from the image of its line, over the longer side of the image, and at least two pixels."""
NEAR, FAR = 0.5, 3.0
"""Lines are looked for from this part of the depth of near points to this multiple of that of far ones."""
LEAST_SCALE = 0.2
"""Residuals smaller than this part of what segments' own variances say are no reason to weigh them more."""
LINE_LOSS = Cauchy(1.0)
"""The loss of distances of segments, pixels."""


@dataclass(frozen=True)
class FoundSegments:
    """What `detect_all_segments` found, the segments of a view after those of the one before."""

    ends: Float[Tensor, "n 2 2"]
    weight: Float[Tensor, "n"]
    color: Float[Tensor, "n 3"]
    descriptor: Float[Tensor, "n d"]
    count: Int[Tensor, "v"]

    @classmethod
    def of(cls, arrays: Arrays) -> "FoundSegments":
        """From saved tensors."""
        ends, weight, color, descriptor = (arrays[k].double() for k in ("ends", "weight", "color", "descriptor"))
        return cls(ends, weight, color, descriptor, arrays["count"])


def find_lines(mapping: Mapping, found: FoundSegments, prior: CameraPrior | None) -> tuple[Mapping, Lines]:
    """Find the lines of a finished model, and adjust cameras, points and lines together.

    Args:
        mapping: The model.
        found: Segments of all its images.
        prior: What is expected of its cameras, where something of them is estimated.

    Returns:
        The model after the adjustment, and its lines. Without any, or where points contradict them (`points_agree`), the model
        is as it was, and lines are where its cameras want them.
    """
    segments, sound = _without_lenses(mapping, found)
    cameras = _placed(mapping)
    tolerance = max(2.0, TOLERANCE * float(mapping.graph.image_size.max()))
    ends, reference = propose_lines(segments, cameras, PAIRS)
    tracks = link_lines(ends, reference, segments, cameras, tolerance)
    # Once more by what all their segments say.
    first = torch.unique_consecutive(tracks.line, return_counts=True)[1].cumsum(0).roll(1, 0)
    first[:1] = 0
    tracks = link_lines(tracks.ends, tracks.segment[first], segments, cameras, tolerance)
    number = sound[tracks.segment]
    total = found.color.new_zeros(len(tracks.ends), 3).index_add(0, tracks.line, found.color[number])
    color = total / torch.bincount(tracks.line, minlength=len(tracks.ends))[:, None].clamp_min(1)
    view = segments.view[tracks.segment]
    lines = Lines(tracks.ends, color, found.ends[number], found.weight[number], view, tracks.line)
    if not len(lines):
        return mapping, lines
    moved = adjust_with_lines(mapping, lines, prior)
    return moved if points_agree(mapping, moved[0]) else (mapping, lines_of_cameras(mapping, lines))


def lines_of_cameras(mapping: Mapping, lines: Lines) -> Lines:
    """The lines where the cameras of a model want them, which stay where they are."""
    if not len(lines):
        return lines
    poses, points = (torch.ones(len(some), dtype=torch.bool) for some in (mapping.registered, mapping.X))
    return adjust_with_lines(mapping, lines, None, fixed_poses=poses, fixed_points=points)[1]


def adjust_with_lines(mapping: Mapping, lines: Lines, prior: CameraPrior | None, **limits: Any) -> tuple[Mapping, Lines]:
    """Adjust cameras, points and lines together; of the cameras what the last adjustment of points did.

    Segments count by their own variances and that of points, all scaled so that their distances from the lines are as large as
    these say.
    """
    free = None if mapping.adjustment is None else mapping.adjustment.free
    weights = observation_weights(mapping, LOSS)
    known = about_cameras(mapping, free, prior, weights)
    result = bundle_adjust(
        mapping.problem(),
        structure=[lines_in_a_bundle(mapping, lines, measure_noise(mapping, LOSS, weights))],
        weights=weights,
        loss=LOSS,
        **({"max_iterations": LAST_ITERATIONS, "tolerance": LAST_TOLERANCE} | known | limits),
    )
    (moved,) = result.structure
    assert isinstance(moved, BundleLines), "given"
    return as_adjusted(mapping, result, free, prior), lines.moved_to(moved.L)


def lines_in_a_bundle(mapping: Mapping, lines: Lines, noise: float) -> BundleLines:
    """Lines beside the points of a model, whose observations have that noise, pixels; see `adjust_with_lines`."""
    apart = segment_distances(mapping.poses, mapping.cameras[mapping.camera_index], lines.bundle())
    # Of robust mean size: two distances a segment, less the four numbers of each line.
    redundancy = max(0.1, 1 - 4 * len(lines) / max(apart.numel(), 1))
    scale = float((apart.abs() * lines.weight.sqrt()[:, None]).median()) / 0.6745 / redundancy**0.5
    return lines.bundle(unit=noise / max(scale, LEAST_SCALE), loss=LINE_LOSS)


def _without_lenses(mapping: Mapping, found: FoundSegments) -> tuple[ViewSegments, Tensor]:
    """Segments of placed views as pinhole cameras see them, and their numbers; those that no lens shows are left out."""
    view = torch.arange(len(found.count)).repeat_interleave(found.count)
    cameras = mapping.cameras[mapping.camera_index[view]]
    rays, valid = cameras.unproject(found.ends)
    sound = (mapping.registered[view] & valid.all(1) & (rays[..., 2] > 0).all(1)).nonzero()[:, 0]
    h = rays[sound] @ cameras.K[sound].mT
    count = torch.bincount(view[sound], minlength=len(found.count))
    ends = h[..., :2] / h[..., 2:]
    first = count.cumsum(0) - count
    return ViewSegments(ends, found.descriptor[sound], view[sound], found.weight[sound], first, count), sound


def _placed(mapping: Mapping) -> Cameras:
    """The views with their neighbours and how far they see."""
    node = mapping.observations()
    view, point = mapping.graph.view[node], mapping.point[node]
    _, depth = mapping.project(point, view)
    v = len(mapping.registered)
    reach = torch.full((v, 2), torch.nan, dtype=depth.dtype)
    neighbours: list[list[int]] = [[] for _ in range(v)]
    centres = mapping.poses.centre
    for i in mapping.registered.nonzero()[:, 0].tolist():
        mine = view == i
        if not bool(mine.any()):
            continue
        ordered = depth[mine].sort().values
        low, high = ordered[len(ordered) // 50], ordered[-1 - len(ordered) // 50]
        reach[i] = torch.stack((NEAR * low.clamp_min(0), FAR * high))
        seen = torch.zeros(len(mapping.X), dtype=torch.bool)
        seen[point[mine]] = True
        shared = torch.bincount(view[seen[point]], minlength=v)
        middle = mapping.X[seen].median(0).values
        rays = torch.nn.functional.normalize(middle - centres, dim=-1)
        angle = torch.linalg.vector_norm(torch.linalg.cross(rays, rays[i].expand_as(rays)), dim=-1)
        worth = shared * (angle / ANGLE).clamp_max(1.0)
        worth[(shared < SHARED) | ~mapping.registered] = 0
        worth[i] = 0
        best = worth.sort(descending=True, stable=True)
        neighbours[i] = best.indices[: min(NEIGHBOURS, int((best.values > 0).sum()))].tolist()
    K = mapping.cameras.K[mapping.camera_index]
    return Cameras(K, mapping.poses, reach, neighbours)
