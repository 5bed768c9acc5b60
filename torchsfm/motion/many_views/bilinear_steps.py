"""Gauss-Newton steps of cameras and points in bilinear fits `y = P u` by one Schur complement, many at once.

The Hessian in each prediction y is `B = alpha I - sum_k q_k q_k'`. Points are eliminated; for `points`, they have a gradient of
their own. Arrays are (problem, view, coordinate, point), with the points last.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import qr


@dataclass(frozen=True)
class Linearisation:
    """Gradient in y and the Gauss-Newton Hessian `alpha I - sum_k q_k q_k'`, weights included; for unknown P and u."""

    P: Tensor
    u: Tensor
    slope: Float[Tensor, "p v 3 n"]
    alpha: Float[Tensor, "p v n"]
    q: Float[Tensor, "p v k 3 n"]


def point_hessians(P: Tensor, alpha: Tensor, m: Tensor) -> Float[Tensor, "p n r r"]:
    """`sum_v alpha P'P - sum_vk m m'` for each point, with m (p, v, k r, n) or (p, v, r, n)."""
    p, v, _, n = m.shape
    r = P.shape[-1]
    G = (P.mT @ P).reshape(p, v, r * r)
    H = (alpha.mT @ G).reshape(p, n, r, r)
    rows = m.reshape(p, m.shape[1] * m.shape[2] // r, r, n).permute(0, 3, 2, 1).contiguous()
    return H - rows @ rows.mT


def regular(H: Tensor) -> Tensor:
    """Add what rounding may take away; points without rays get the identity."""
    trace = H.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    return H + torch.where(trace > 0, 1e-14 * trace, 1.0) * eye


def reduced(system: Linearisation, damping: Tensor, points: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The Schur complement over the cameras, its right-hand side, and what back-substitution needs.

    With `points`, these have a gradient of their own and are damped, and scales of cameras and points are held. Without,
    cameras are balanced.
    """
    P, u, alpha, q = system.P, system.u, system.alpha, system.q
    p, v, k, _, n = q.shape
    r = P.shape[-1]
    m = P.mT[:, :, None] @ q
    H = point_hessians(P, alpha, m.flatten(2, 3))
    size = H.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(r, dtype=P.dtype, device=P.device)
    if points:
        H = H + size * u.mT[..., :, None] * u.mT[..., None, :] + damping[:, None, None, None] * size * eye
    L = torch.linalg.cholesky_ex(regular(H))[0]
    inverse = torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False).permute(0, 2, 3, 1)
    # B P, times L^-T over its last index, times u: half of the coupling (3 r v, r n), in one contiguous array.
    BP = alpha[:, :, None, None] * P[..., None]
    for i in range(k):
        BP = BP - q[:, :, i, :, None] * m[:, :, i, None]
    C = sum(BP[:, :, :, None, c] * inverse[:, None, None, :, c] for c in range(r))
    assert isinstance(C, Tensor)
    F = (C[:, :, :, None] * u[:, None, None, :, None]).reshape(p, 3 * r * v, r * n)
    B = alpha[:, :, None, None] * torch.eye(3, dtype=P.dtype, device=P.device)[..., None]
    for i in range(k):
        B = B - q[:, :, i, :, None] * q[:, :, i, None]
    uu = (u[:, :, None] * u[:, None]).reshape(p, r * r, n)
    A = (B.reshape(p, 9 * v, n) @ uu.mT).reshape(p, v, 3, 3, r, r).transpose(3, 4).reshape(p, v, 3 * r, 3 * r)
    scale = A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    if points:
        flat = P.reshape(p, v, 3 * r)
        A = A + 3 * r * scale * flat[..., :, None] * flat[..., None, :]
    A = A + damping[:, None, None, None] * scale.clamp_min(1e-100) * torch.eye(3 * r, dtype=P.dtype, device=P.device)
    S = -(F @ F.mT)
    S.view(p, v, 3 * r, v, 3 * r).diagonal(dim1=1, dim2=3).add_(A.permute(0, 2, 3, 1))
    right = (system.slope @ u.mT[:, None]).reshape(p, 3 * v, r)
    if not points:
        # Where the points are best no change of frame gains anything; what rounding leaves would be all that is promised.
        frame = P.reshape(p, 3 * v, r)
        right = right - frame @ (frame.mT @ right) / v
    right = right.reshape(p, 3 * r * v)
    g = torch.zeros(p, r, n, dtype=P.dtype, device=P.device)
    if points:
        g = (P.mT @ system.slope).sum(1)
        g = (inverse * g[:, None]).sum(2)
        right = right - (F @ g.reshape(p, r * n, 1))[..., 0]
    return S, right, F, torch.stack((g, *inverse.unbind(1)), 1)


def gauss_newton_step(system: Linearisation, damping: Tensor, points: bool) -> tuple[Tensor, Tensor, Bool[Tensor, "p"], Tensor]:
    """A damped Gauss-Newton step of cameras and points, and where it could be solved."""
    p, v, _ = system.alpha.shape
    S, right, F, rest = reduced(system, damping, points)
    if points:
        _hold_frame(S, system.P)
    factor, info = torch.linalg.cholesky_ex(S)
    step = -torch.cholesky_solve(right[..., None], factor)
    solved = (info == 0) & torch.isfinite(step).all(-1).all(-1)
    step = torch.where(solved[:, None, None], step, 0)
    g, move = rest[:, 0], back_substituted(F, rest, step)
    # The model: right' step + step' S step / 2 and what the points alone bring; twice that in units of the cost.
    promise = -(right * step[..., 0]).sum(-1) + g.square().sum((-2, -1))
    return step.reshape(p, v, 3, system.P.shape[-1]), move, solved, promise


def _hold_frame(S: Tensor, P: Tensor) -> None:
    """No change of frame gains anything: what rounding leaves of its slope, over the damping, would be all that is promised."""
    p, v, _, r = P.shape
    Q = orthonormal(P)[0].reshape(p, 3 * v, r)
    size = S.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    S.view(p, 3 * v, r, 3 * v, r).diagonal(dim1=2, dim2=4).add_((size * (Q @ Q.mT))[..., None])


def back_substituted(F: Tensor, rest: Tensor, step: Tensor) -> Float[Tensor, "p r n"]:
    """The step of the points that goes with a step of the cameras."""
    g, inverse = rest[:, 0], rest[:, 1:]
    back = g + (F.mT @ step).reshape(g.shape)
    return -(inverse * back[:, :, None]).sum(1)


def orthonormal(P: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras with orthonormal joint columns, and what they are to be multiplied by; hardly turned where they nearly were."""
    Q, R, _ = qr(P.flatten(1, 2))
    sign = torch.where(R.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0)
    return (Q * sign[:, None]).reshape(P.shape), R * sign[..., None]
