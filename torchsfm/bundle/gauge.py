"""The gauge: seven dimensions (place, orientation, size of the world) that image points alone do not determine."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.bundle.rig import Rig
from torchsfm.geometry import Pose, Similarity, cross_matrix

Gauge = Literal["free", "first"]
"""What is done about the place, turn and size of the world, which no residual tells.

"free": nothing (damping takes the shortest step, so the world stays about where it was). "first": the first pose that moved
comes back to where it was, and the pose farthest from it at the start to its distance from it. Which is chosen changes no
residual: the adjustment itself is free, which converges best, and the world is moved afterwards."""


def restore_gauge(
    before: Pose, poses: Pose, X: Tensor, moved_points: Tensor, rig: Rig | None, keep_size: bool
) -> tuple[Pose, Tensor, Rig | None, Similarity | None]:
    """Move the world so that the first pose that changed is again what it was, and the farthest from it as far away.

    Args:
        before: Poses at the start.
        poses: Poses after the adjustment; those that did not change were not part of it and stay.
        X: Points after the adjustment.
        moved_points: Which points were part of it.
        rig: The rig after the adjustment.
        keep_size: Whether something else gives the size of the world (a rig of known size).

    Returns:
        Poses, points and rig after that, and how the world moved, None if it did not.
    """
    with torch.no_grad():
        moved = ((poses.R != before.R).any(-1).any(-1)) | (poses.t != before.t).any(-1)
        if not bool(moved.any()):
            return poses, X, rig, None
        first = int(moved.to(torch.uint8).argmax())
        away = (before.centre - before.centre[first]).norm(dim=-1)
        far = int(torch.where(moved, away, -1.0).argmax())
    length, now = away[far], (poses.centre[far] - poses.centre[first]).norm()
    good = (length > 0) & (now > 0)
    ratio = torch.where(good, length / torch.where(good, now, 1.0), 1.0)
    scale = torch.ones_like(ratio) if keep_size else ratio
    R = before.R[first].mT @ poses.R[first]
    t = before.centre[first] - scale * (R @ poses.centre[first])
    world = Similarity(scale, R, t)
    new = world.transform_pose(poses)
    here = torch.arange(len(moved), device=X.device) == first
    # The first one is given, not computed.
    R_new = torch.where((moved & ~here)[:, None, None], new.R, before.R)
    t_new = torch.where((moved & ~here)[:, None], new.t, before.t)
    points = torch.where(moved_points[:, None], world.transform(X), X)
    if rig is not None and not keep_size:
        rig = Rig(Pose(rig.cam_from_rig.R, scale * rig.cam_from_rig.t), rig.sensor, rig.frame)
    return Pose(R_new, t_new), points, rig, world


def gauge_motions(rows: Float[Tensor, "v 12"], keep_size: bool) -> Float[Tensor, "v 6 k"]:
    """How poses move, by steps of `RigidMotion`, with a world that shifts, turns and, unless its size is known, grows.

    Samples of curves move across their curves alone and cannot follow a world that moves as a whole. Their residuals then do
    depend on the gauge, a little and by noise only, and steps would lead a free world far along that valley.
    """
    R, t = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    centre = -(R.mT @ t[..., None])[..., 0]
    known = centre.isfinite().all(-1, keepdim=True)
    middle = torch.where(known, centre, 0.0).sum(0) / known.sum().clamp_min(1)
    # About the middle: a far origin would make turns look like shifts.
    shift = torch.cat((torch.zeros_like(R), -R), 1)
    away = (R @ (centre - middle)[..., None])[..., 0]
    turn = torch.cat((-R, cross_matrix(away) @ R), 1)
    grow = torch.cat((torch.zeros_like(t), -away), 1)[..., None]
    motions = torch.cat((shift, turn) if keep_size else (shift, turn, grow), 2)
    return torch.where(known[..., None], motions, 0.0)
