"""Why views of a board say little of the camera, or contradict each other: from where they are, and which of them does."""

from typing import Any

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration.calibrate_planes import PlaneCalibration, calibrate_planes

DISAGREE = 2.5
"""How many times more than by noise views may disagree before it is worth a remark."""
_LEAST = 4
"""Views that remain."""
_PART = 3
"""One in so many views may be one that does not belong to the others."""
_SOME, _MUCH = 0.9, 0.8
"""What is left of the disagreement at most where it helps to leave out a view, and where the rest agrees as it is."""
_CENTRE = 0.01
"""How far the principal point may be from the middle of the image, of its width."""


def foreign_views(x: Tensor, X: Tensor, found: PlaneCalibration, **options: Any) -> list[int]:
    """The views (v, n, 2) without which the others agree: they are likely of another camera. None where there are no such.

    One after the other is left out, each time the one that contradicts the others most, for as long as that helps.

    Args:
        x: Points of all views.
        X: Those of the board.
        found: The calibration by all of them.
        **options: What it was found with.
    """
    kept = found.used & (found.copy_of == torch.arange(len(x), device=x.device))
    most = int(kept.sum()) // _PART
    out: list[int] = []
    last, left, before = found, float(found.disagreement), float(found.disagreement)
    agree = False
    while int(kept.sum()) > _LEAST and len(out) <= most:
        worst = int(torch.where(kept, last.view_disagreement, -1.0).argmax())
        kept[worst] = False
        last = calibrate_planes(x, X, visible=kept[:, None].expand(x.shape[:2]), **options)
        apart = float(last.disagreement) if last.status in (Status.OK, Status.NOT_CONVERGED) else torch.inf
        if apart > (_MUCH if agree else _SOME) * left:
            break
        left = apart
        out.append(worst)
        agree = left <= min(DISAGREE, before / 2)
    return sorted(out) if agree and len(out) <= most else []


def turn_of_board(found: PlaneCalibration) -> float:
    """The largest angle by which the board turns away between two views, degrees."""
    normals = found.poses.R[found.used][..., 2]
    cosines = (normals @ normals.mT).clamp(-1, 1)
    return float(torch.rad2deg(torch.acos(cosines.min()))) if len(normals) else 0.0


def shift_by_centre(x: Tensor, X: Tensor, found: PlaneCalibration, image_size: tuple[float, float], **options: Any) -> float:
    """How far the focal length moves with the principal point that is held in the middle, were it a little off that."""
    width, height = image_size
    off = 2 * _CENTRE * width
    moved = [calibrate_planes(x, X, image_size=size, **options) for size in ((width + off, height), (width, height + off))]
    return float(torch.stack([other.camera.K[0, 0] - found.camera.K[0, 0] for other in moved]).norm())
