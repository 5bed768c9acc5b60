"""Poses and points of projective cameras, once intrinsics and plane at infinity are known."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.autocalibration.plane_at_infinity import metric_upgrade
from torchsfm.autocalibration.projective_input import PreparedCameras
from torchsfm.autocalibration.upgrade_residual import metric_blocks
from torchsfm.linalg import determinant_3x3, nearest_rotation


@dataclass(frozen=True)
class MetricCameras:
    """Poses and points in the frame of the first view, the homography to it, and the share of the observations in front."""

    R: Tensor
    t: Tensor
    X: Tensor
    upgrade: Tensor
    in_front: Tensor


def metric_cameras(ready: PreparedCameras, K: Tensor, p: Tensor) -> MetricCameras:
    """Poses and points for given intrinsics and plane at infinity."""
    inverse = torch.linalg.inv_ex(K).inverse
    M = metric_blocks(ready.P, K, K[:, 0], p)
    size = determinant_3x3(M).abs().clamp_min(1e-300) ** (1 / 3)
    R = nearest_rotation(torch.nan_to_num(M))
    t = (inverse @ ready.P[..., 3:])[..., 0] / size[..., None]
    w = (ready.X * torch.cat((p, torch.ones_like(p[:, :1])), -1)[:, None]).sum(-1)
    seen = ready.visible.any(-2)
    side = torch.where((w.sign() * seen).sum(-1) < 0, -1.0, 1.0)
    distance = (R.mT @ t[..., None]).norm(dim=(-2, -1)) * ready.present
    unit = distance.sum(-1) / (ready.present.sum(-1) - 1).clamp_min(1)
    unit = torch.where((unit > 1e-12) & torch.isfinite(unit), unit, 1.0)
    t = t * (side / unit)[:, None, None]
    H = metric_upgrade(K[:, 0], p)
    H = torch.cat((H[..., :3], H[..., 3:] * (side / unit)[:, None, None]), -1)
    Y = torch.linalg.solve_ex(H, ready.X.mT).result.mT
    finite = (Y[..., 3].abs() > 1e-14 * Y.norm(dim=-1)) & torch.isfinite(Y).all(-1)
    X = torch.where(finite[..., None], Y[..., :3], 0.0) / torch.where(finite, Y[..., 3], 1.0)[..., None]
    depth = (R @ X[:, None, :, :].mT)[..., 2, :] + t[..., 2:]
    front = (depth > 0) & ready.visible & finite[:, None]
    in_front = front.sum((-2, -1)).to(p.dtype) / ready.visible.sum((-2, -1)).clamp_min(1)
    return MetricCameras(R, t, X, torch.nan_to_num(ready.frame @ H), in_front)
