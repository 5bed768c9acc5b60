"""The first two cameras of a model."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Pose
from torchsfm.motion import estimate_essential
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import triangulate_tracks
from torchsfm.reconstruction.matching.view_graph import Verdict
from torchsfm.tensors import pose_from_essential

GOOD_ANGLE = 0.28
"""Median angle between rays, in radians (16 degrees), beyond which a wider baseline is no better as a start."""
MIN_POINTS = 30


@dataclass(frozen=True)
class Start:
    """Two images and the pose of the second from the first."""

    pair: Int[Tensor, "2"]
    cam2_from_cam1: Float[Tensor, "3 4"]
    score: float


def starting_pairs(
    mapping: Mapping,
    unknown_focal: Bool[Tensor, "v"],
    *,
    threshold: float,
    generator: torch.Generator | None,
    candidates: int = 16,
) -> list[Start]:
    """Pairs of unregistered images to start from, the most promising first.

    A good start has many points in front of both cameras, seen under wide angles (Schönberger & Frahm 2016, section 4.2). Pairs
    that a rotation explains are left out: they carry no depth.

    Args:
        mapping: A mapping; its registered images are not considered.
        unknown_focal: Images whose focal length is only a guess.
        threshold: Largest distance of an inlier from the epipolar line in pixels.
        generator: Source of randomness.
        candidates: Number of pairs whose essential matrix is estimated.
    """
    graph = mapping.graph
    K = mapping.cameras.K[mapping.camera_index]
    verdict = graph.verdicts(K, unknown_focal)
    free = ~mapping.registered[graph.pairs].any(-1)
    usable = free & ((verdict == Verdict.GENERAL) | (verdict == Verdict.PLANAR))
    ratio = graph.homography_inliers.double() / graph.fundamental_inliers.clamp(min=1)
    merit = graph.fundamental_inliers * (1.05 - ratio.clamp(max=1))
    order = torch.argsort(torch.where(usable, merit, -1.0), descending=True, stable=True)
    order = order[usable[order]][:candidates]
    if not len(order):
        return []
    a, b = graph.match.unbind(1)
    members = [(graph.match_pair == q).nonzero()[:, 0] for q in order.tolist()]
    slots = max(len(m) for m in members)
    d1, d2 = graph.x.new_zeros(len(order), slots, 3), graph.x.new_zeros(len(order), slots, 3)
    mask = torch.zeros(len(order), slots, dtype=torch.bool)
    for row, member in enumerate(members):
        (r1, v1), (r2, v2) = mapping.rays(a[member]), mapping.rays(b[member])
        d1[row, : len(member)], d2[row, : len(member)], mask[row, : len(member)] = r1, r2, v1 & v2
    focal = K[graph.pairs[order], 0, 0].mean(-1)
    essential = estimate_essential(d1, d2, threshold=(threshold / focal).clamp(max=0.1), mask=mask, generator=generator)
    relative = pose_from_essential(essential.model, d1, d2, essential.inliers.to(d1.dtype))
    R = relative.model[..., :3]
    cosine = torch.nn.functional.cosine_similarity((R[:, None] @ d1[..., None])[..., 0], d2, dim=-1)
    good = essential.inliers & relative.in_front
    starts = []
    for row, q in enumerate(order.tolist()):
        angle = torch.arccos(cosine[row][good[row]].clamp(-1, 1))
        count = int((angle > 0.02).sum())
        if essential.status[row] != Status.OK or count < MIN_POINTS:
            continue
        median = float(angle.median())
        depth_merit = max(1.05 - float(ratio[q]), 0.05)
        starts.append(Start(graph.pairs[q], relative.model[row], count * min(median / GOOD_ANGLE, 1.0) * depth_merit**0.5))
    return sorted(starts, key=lambda start: -start.score)


def place_start(mapping: Mapping, start: Start, *, threshold: float) -> Mapping:
    """Register the two images of a start and triangulate their common tracks."""
    i, j = start.pair.tolist()
    R, t, registered = mapping.poses.R.clone(), mapping.poses.t.clone(), mapping.registered.clone()
    R[i], t[i] = torch.eye(3, dtype=R.dtype), torch.zeros(3, dtype=t.dtype)
    R[j], t[j] = start.cam2_from_cam1[:, :3], start.cam2_from_cam1[:, 3]
    registered[i] = registered[j] = True
    mapping = replace(mapping, poses=Pose(R, t), registered=registered)
    return triangulate_tracks(mapping, threshold=threshold, min_angle=0.02)
