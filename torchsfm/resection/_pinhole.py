"""Least squares of reprojection errors, thousands of small problems at once.

The same minimum as by `levenberg_marquardt`, with what makes it fast: coordinates in rows, residuals next to the Jacobian so
that one product gives cost, gradient and normal matrix, and no pass over the points that is not needed.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Pose, rotation_from_rotvec
from torchsfm.geometry.projection import turn_slopes
from torchsfm.resection._reprojection import Inside, camera_frame

_FLAT = 1e-14
"""A problem ends when a step promises to lower its cost by less than this fraction."""
_EXACT = 1e-26
"""Or to less than this, for unit weights in focal lengths."""


class PinholeFit(NamedTuple):
    """The minimum of each problem of a batch."""

    pose: Pose
    theta: Tensor
    cost: Tensor
    iterations: Tensor
    status: Tensor
    normal: Tensor
    """The Gauss-Newton matrix there, float64."""


def minimise_pinhole(
    pose: Pose, theta: Tensor, x: Tensor, X: Tensor, w: Tensor, inside: Inside, max_iterations: int
) -> PinholeFit:
    """Levenberg-Marquardt for poses (b), displacements theta (b, k) and points (b, n), all float64, weights >= 0."""
    rows, columns = X.mT.contiguous(), x.movedim(-1, 0).contiguous()
    root = None if bool((w == 1).all()) else w.sqrt()[:, None, None]
    R, t = pose.R, pose.t
    size = 6 + theta.shape[-1]
    M = x.new_empty(len(x), size + 1, 2, x.shape[-2])
    moments = _moments(M, R, t, theta, columns, rows, root, inside)
    cost = moments[:, size, size]
    count = cost.shape[0]
    status = torch.full((count,), int(Status.NOT_CONVERGED), dtype=torch.int8, device=cost.device)
    status[~torch.isfinite(moments).all(-1).all(-1)] = int(Status.NOT_FINITE)
    status[2 * (w > 0).sum(-1) < size] = int(Status.TOO_FEW)
    active = status == Status.NOT_CONVERGED
    iterations = torch.zeros(count, dtype=torch.int32, device=cost.device)
    damping, growth = torch.full_like(cost, 1e-4), torch.full_like(cost, 2.0)
    f = inside.camera.K[:, 0, 0]
    least = _EXACT * w.sum(-1) * f * f
    eye = torch.eye(size, dtype=cost.dtype, device=cost.device)
    for _ in range(max_iterations):
        if not active.any():
            break
        N, g = moments[:, :size, :size], moments[:, :size, size]
        diagonal = N.diagonal(dim1=-2, dim2=-1)
        # A direction that nothing depends on gets the damping of the others, and so does not move.
        floor = 1e-9 * diagonal.amax(-1, keepdim=True) + 1e-300
        damped = damping[:, None] * torch.maximum(diagonal, floor)
        factor, info = torch.linalg.cholesky_ex(N + torch.diag_embed(damped))
        solved = info == 0
        factor = torch.where(solved[:, None, None], factor, eye)
        step = -torch.cholesky_solve(g[..., None], factor)[..., 0]
        solved = solved & torch.isfinite(step).all(-1)
        step = torch.where((solved & active)[:, None], step, 0.0)
        promise = (step * (damped * step - g)).sum(-1)
        turn = rotation_from_rotvec(step[:, :3])
        new_R, new_t = turn @ R, (turn @ t[..., None])[..., 0] + step[:, 3:6]
        new_theta = theta + step[:, 6:]
        new = _moments(M, new_R, new_t, new_theta, columns, rows, root, inside)
        after = new[:, size, size]
        good = active & solved & torch.isfinite(new).all(-1).all(-1)
        # Below the rounding error of the cost a step is taken on its promise.
        small = promise <= _FLAT * cost + least
        accepted = good & ((after < cost) | (small & (after <= cost * (1 + 1e-12) + least)))
        ratio = ((cost - after) / promise.clamp_min(1e-300)).clamp(0, 1)
        shrink = (1 - (2 * ratio - 1) ** 3).clamp_min(1 / 3)
        damping = torch.where(accepted, damping * shrink, damping * growth).clamp(1e-16, 1e20)
        growth = torch.where(accepted, 2.0, 2 * growth)
        R, t = torch.where(accepted[:, None, None], new_R, R), torch.where(accepted[:, None], new_t, t)
        theta = torch.where(accepted[:, None], new_theta, theta)
        moments = torch.where(accepted[:, None, None], new, moments)
        cost = torch.where(accepted, after, cost)
        iterations += active.int()
        done = active & ((solved & small) | (damping > 1e16))
        status[done] = int(Status.OK)
        active = active & ~done
    return PinholeFit(Pose(R, t), theta, 0.5 * cost, iterations, status, moments[:, :size, :size])


def _moments(
    M: Tensor, R: Tensor, t: Tensor, theta: Tensor, x: Tensor, X: Tensor, root: Tensor | None, inside: Inside
) -> Tensor:
    """The products with each other of the Jacobian's columns and, last, the residual: (b, k + 1, k + 1).

    They are written into M (b, k + 1, 2, n), which is there to be used again.
    """
    ray, out = camera_frame(Pose(R, t), X), M.permute(2, 1, 0, 3)
    pixels = inside.projection.linearize(ray, inside.row(theta), out[:, 3:6], out[:, 6:-1])
    turn_slopes(ray, out[:, 3:6], out)
    torch.sub(pixels, x, out=out[:, -1])
    if root is not None:
        M *= root
    rows = M.flatten(2)
    product: Tensor = rows @ rows.mT
    return product
