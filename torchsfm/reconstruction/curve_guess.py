"""Where the camera of a frame may be by the motion of what the frame next to it shows of a model."""

from collections.abc import Sequence

import torch

from torchsfm.geometry import Pose
from torchsfm.images import DenseMotion
from torchsfm.reconstruction.curve_mapping import CurveMapping
from torchsfm.resection import estimate_camera

_NEAR = 4.0
"""Pixels from where the motion has a sample, within which a camera agrees."""
_FEWEST = 30
"""Samples that must agree."""


def guess_by_motion(mapping: CurveMapping, view: int, motion: Sequence[DenseMotion]) -> Pose | None:
    """The pose of a frame, batch (1); None where neither frame next to it is placed, or too little moves as for any.

    Args:
        mapping: The model.
        view: The frame.
        motion: From each frame to the next; may be empty.
    """
    for a in (view - 1, view + 1):
        if not 0 <= a < len(mapping.edges) or not bool(mapping.registered[a]) or not len(motion):
            continue
        X = mapping.curves.X[mapping.home == a]
        x = mapping.camera.project(mapping.poses[a].transform(X))
        y, sure = motion[min(a, view)].moved(x, back=view < a)
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
