"""What ties views together whatever the scene: bifocal tensors, from cameras and to cameras."""

from torchsfm.tensors.bifocal import (
    RelativePose,
    bifocal_tensors,
    cameras_from_fundamental,
    epipolar_lines,
    epipoles,
    essential_from_fundamental,
    essential_from_pose,
    fundamental_from_cameras,
    fundamental_from_essential,
    fundamental_from_pose,
    pose_from_essential,
    poses_from_essential,
    poses_from_fundamental,
)
from torchsfm.tensors.focals import Focals, focals_from_fundamental

__all__ = [
    "Focals",
    "RelativePose",
    "bifocal_tensors",
    "cameras_from_fundamental",
    "epipolar_lines",
    "epipoles",
    "essential_from_fundamental",
    "essential_from_pose",
    "focals_from_fundamental",
    "fundamental_from_cameras",
    "fundamental_from_essential",
    "fundamental_from_pose",
    "pose_from_essential",
    "poses_from_essential",
    "poses_from_fundamental",
]
