"""The gauge: seven dimensions (place, orientation, size of the world) that image points alone do not determine."""

from typing import Literal

import torch
from torch import Tensor

from torchsfm.bundle.rig import Rig
from torchsfm.geometry import Pose, Similarity

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
