"""Rigs: several cameras that move as one body."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.bundle.projection import Projection, transform, turn_back
from torchsfm.geometry import Pose
from torchsfm.geometry.projection import turn_slopes


@dataclass(frozen=True)
class Rig:
    """Which views were taken together, and where the cameras sit on the body: `cam_from_world = cam_from_rig rig_from_world`.

    Views of one frame share the pose of the rig; views of one sensor share the place on the rig. Several rigs are one `Rig`
    with sensors of their own.

    Example:
        >>> import torch, torchsfm
        >>> right = torchsfm.Pose(torch.eye(3), torch.tensor([-0.1, 0.0, 0.0]))  # 10 cm beside the left one
        >>> sensors = torchsfm.Pose.stack([torchsfm.Pose.identity(), right])
        >>> rig = torchsfm.Rig(sensors, sensor=torch.tensor([0, 1, 0, 1]), frame=torch.tensor([0, 0, 1, 1]))
        >>> rig.view_poses(torchsfm.Pose.identity(2)).centre[:, 0]
        tensor([0.0000, 0.1000, 0.0000, 0.1000])
    """

    cam_from_rig: Pose
    """Camera from rig of each sensor, batch (k,)."""
    sensor: Int[Tensor, "v"]
    """Which sensor took each view."""
    frame: Int[Tensor, "v"]
    """At which pose of the rig it was taken."""

    def __post_init__(self) -> None:
        check_tensors(cam_from_rig=(self.cam_from_rig.R, "k 3 3"), sensor=(self.sensor, "v: int"), frame=(self.frame, "v: int"))

    def view_poses(self, rig_from_world: Pose) -> Pose:
        """Where each view is, `cam_from_world`, for poses of the rig."""
        return self.cam_from_rig[self.sensor] @ rig_from_world[self.frame]

    def frame_poses(self, cam_from_world: Pose) -> Pose:
        """Poses of the rig from those of the views: of each frame, by its first view; the identity where it has none."""
        frames = int(self.frame.max()) + 1 if self.frame.numel() else 0
        views = torch.arange(len(self.frame), device=self.frame.device)
        first = views.new_full((frames,), len(views)).scatter_reduce(0, self.frame, views, "amin")
        known = first < len(views)
        chosen = torch.where(known, first, 0)
        pose = self.cam_from_rig[self.sensor[chosen]].inverse() @ cam_from_world[chosen]
        empty = Pose.identity(frames, dtype=pose.t.dtype, device=pose.t.device)
        return Pose(torch.where(known[:, None, None], pose.R, empty.R), torch.where(known[:, None], pose.t, empty.t))


@dataclass(frozen=True)
class RigProjection:
    """Reprojection through a sensor of a rig: the residual of `Projection` with one motion more."""

    projection: Projection

    def residual(self, pose: Tensor, sensor: Tensor, camera: Tensor, point: Tensor, x: Tensor) -> Tensor:
        """Predicted minus measured image points, pixels."""
        moved = transform(sensor, transform(pose, point).mT)
        return self.projection.residual_of(moved, camera, x)

    def linearize(
        self, pose: Tensor, sensor: Tensor, camera: Tensor, point: Tensor, x: Tensor, out: list[Tensor | None]
    ) -> Tensor:
        """Residuals; `out` gets their derivatives by the steps of rig, sensor, camera numbers and point."""
        in_rig = transform(pose, point)
        moved = transform(sensor, in_rig.mT)
        by_pose, by_sensor, by_intrinsics, by_point = (None if o is None else o.permute(1, 2, 0) for o in out)
        by_camera = torch.empty((2, 3, moved.shape[1]), dtype=moved.dtype, device=moved.device)
        residual = self.projection.linearize_at(moved, camera, x, by_camera, by_intrinsics)
        if by_sensor is not None:
            by_sensor[:, 3:] = by_camera
            turn_slopes(moved, by_camera, by_sensor)
        by_rig = torch.empty_like(by_camera)
        turn_back(sensor, by_camera, by_rig)
        if by_pose is not None:
            by_pose[:, 3:] = by_rig
            turn_slopes(in_rig, by_rig, by_pose)
        if by_point is not None:
            turn_back(pose, by_rig, by_point)
        return residual
