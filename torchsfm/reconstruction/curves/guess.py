"""What the motion of what frames show says of the camera of the next one: where it may be, and whether a pose is right."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import Pose
from torchsfm.reconstruction.curves.frames import Frames, moved_places, rays_of
from torchsfm.reconstruction.curves.mapping import CurveMapping
from torchsfm.resection import estimate_camera
from torchsfm.tensors import essential_from_pose

_NEAR = 4.0
"""Pixels from where the motion has a sample, within which a camera agrees."""
_FEWEST = 15
"""Samples that must agree for a guess, which edges confirm or not."""
_BESIDE = 3.0
"""Pixels from an epipolar line, within which a place agrees with a pose,"""
_SHARE = 0.5
"""and of the places that agree with the best one, how many must."""


def guess_by_motion(mapping: CurveMapping, view: int, frames: Frames) -> Pose | None:
    """The pose of a frame, batch (1); None where neither frame next to it is placed, or too little moves as for any.

    Args:
        mapping: The model.
        view: The frame.
        frames: The motion from each frame to the next, if it was looked for.
    """
    for a in _beside(mapping, view, frames):
        shown = mapping.home == a
        shown[mapping.curves.sample[mapping.curves.view == a]] = True
        X = mapping.curves.X[shown]
        x = mapping.camera.project(mapping.poses[a].transform(X))
        y, sure = frames.motion[min(a, view)].moved(x, back=view < a)
        rays, valid = mapping.camera.unproject(y)
        good = sure & valid & (rays[:, 2] > 0)
        if int(good.sum()) < _FEWEST:
            continue
        K = mapping.camera.K
        flat = (rays[good] / rays[good, 2:]) @ K.mT
        found = estimate_camera(
            flat[:, :2].contiguous(), X[good], K, threshold=_NEAR, generator=torch.Generator().manual_seed(0)
        )
        if int(found.inliers.sum()) >= _FEWEST and bool(found.model.isfinite().all()):
            return Pose.from_matrix(found.model)[None]
    return None


def agrees_with_motion(mapping: CurveMapping, view: int, frames: Frames) -> bool | None:
    """Whether what moves from a frame to those next to it moves along their epipolar lines; None where that is not known.

    Edges are so many that wrong cameras see most of a model next to some, too.
    """
    verdicts = []
    for a in _beside(mapping, view, frames):
        first, second = min(a, view), max(a, view)
        turn = frames.turns[first] if len(frames.turns) else None
        if turn is None:
            continue
        x, y = moved_places(frames.edges[first], frames.motion[first])
        d1, d2 = (rays_of(t, mapping.camera.K) for t in (x, y))
        step = mapping.poses[second] @ mapping.poses[first].inverse()
        near = _BESIDE / float(mapping.camera.K[0, 0])
        own, best = (int((_off(d1, d2, E) < near).sum()) for E in (essential_from_pose(step.R, step.t), turn.E))
        verdicts.append(own >= _SHARE * best)
    return all(verdicts) if verdicts else None


def _beside(mapping: CurveMapping, view: int, frames: Frames) -> list[int]:
    """The frames next to one that are placed, where motions are known."""
    v = len(mapping.edges) if len(frames.motion) else 0
    return [a for a in (view - 1, view + 1) if 0 <= a < v and bool(mapping.registered[a])]


def _off(d1: Float[Tensor, "n 3"], d2: Float[Tensor, "n 3"], E: Float[Tensor, "3 3"]) -> Float[Tensor, "n"]:
    """Distances from epipolar lines, of rays whose third coordinate is 1."""
    lines = d1 @ E.mT
    off: Tensor = (lines * d2).sum(-1).abs() / torch.linalg.vector_norm(lines[:, :2], dim=-1).clamp_min(1e-12)
    return off
