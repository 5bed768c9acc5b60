"""Gauss-Newton steps of cameras and points in bilinear fits `y = P u` by one Schur complement, many at once.

The Hessian in each prediction y is `B = alpha I - sum_k q_k q_k'`. Points are eliminated; for `points`, they have a gradient of
their own. Arrays are (problem, view, coordinate, point), with the points last.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg import qr
from torchsfm.optim.problem import Step


@dataclass(frozen=True)
class Linearisation:
    """Gradient in y and the Gauss-Newton Hessian `alpha I - sum_k q_k q_k'`, weights included; for unknown P and u."""

    P: Tensor
    u: Tensor
    slope: Float[Tensor, "p v 3 n"]
    alpha: Float[Tensor, "p v n"]
    q: Float[Tensor, "p v k 3 n"]


@dataclass(frozen=True)
class BilinearSystem:
    """A cost of predictions linearised; `x` is what moves, cameras or a tuple of these and points."""

    x: Any
    cost: Tensor
    linear: Linearisation
    total: Tensor
    """What the cost's sum was divided by."""

    def steepest(self) -> Tensor:
        """The largest derivative by a prediction."""
        return self.linear.slope.abs().flatten(1).amax(-1)

    def along(self, delta: tuple[Tensor, Tensor]) -> Tensor:
        """The derivative of the cost along a step of cameras and points."""
        step, move = delta
        y = step @ self.linear.u[:, None] + self.linear.P @ move[:, None]
        return 2 * (self.linear.slope * y).sum((-3, -2, -1)) / self.total

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step of cameras and points."""
        points = isinstance(self.x, tuple)
        S, right, F, rest = reduced(self.linear, damping, points)
        if points:
            _hold_frame(S, self.linear.P)
        found = schur_step(S, right, F, rest, self.total)
        return found._replace(delta=(found.delta[0].reshape(self.linear.P.shape), found.delta[1]))


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


def schur_step(S: Tensor, right: Tensor, F: Tensor, rest: Tensor, total: Tensor) -> Step:
    """The step of cameras and points by the Schur complement over the cameras and what back-substitution needs."""
    factor, info = torch.linalg.cholesky_ex(S)
    step = -torch.cholesky_solve(right[..., None], factor)
    solved = (info == 0) & torch.isfinite(step).all(-1).all(-1)
    step = torch.where(solved[:, None, None], step, 0)
    # The model: right' step + step' S step / 2 and what the points alone bring; twice that in units of the cost.
    promise = -(right * step[..., 0]).sum(-1) + rest[:, 0].square().sum((-2, -1))
    promise = torch.where(solved, promise / total, torch.inf)
    none = torch.zeros_like(solved)
    return Step((step[..., 0], back_substituted(F, rest, step)), promise, solved, none, none)


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
