"""Poses by the angles between rays and points: data made ready, moments of them, and Gauss-Newton steps.

The residual of a point is the part of its direction across its ray, two numbers whose length is the sine of the angle. It needs
no image plane, so rays may point anywhere.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import rotation_from_rotvec
from torchsfm.linalg import eigvalsh
from torchsfm.optim import attach_optimum

PIECE = 4096
"""Rays at a time: what is in use stays in the cache."""


@dataclass(frozen=True)
class Rays:
    """Problems (b) of n unit rays and points in a world moved and scaled to them; absent ones have weight 0."""

    u: Tensor
    """(b, 3, n)"""
    X: Tensor
    """(b, 3, n)"""
    w: Tensor
    """(b, n)"""
    centre: Tensor
    """(b, 3)"""
    size: Tensor
    """(b)"""
    bad: Tensor
    """Wanted data are not finite (b)."""

    @property
    def number(self) -> Tensor:
        """How many rays count."""
        return (self.w > 0).sum(-1)

    def world(self, R: Tensor, t: Tensor) -> Tensor:
        """`[R | t]` (b, k, 3, 4) in the caller's world from R and t (b, k, 3) in this one."""
        t = t * self.size[:, None, None] - (R @ self.centre[:, None, :, None])[..., 0]
        return torch.cat((R, t[..., None]), -1)


def in_pieces(d: Tensor, X: Tensor, w: Tensor | None, batch: torch.Size) -> Iterator[Rays]:
    """Pieces of the flattened batch; one empty piece where there is nothing."""
    n = d.shape[-2]
    d, X = (a.expand(*batch, n, 3).reshape(-1, n, 3) for a in (d, X))
    w = None if w is None else w.expand(*batch, n).reshape(-1, n)
    step = max(1, PIECE // max(1, n))
    for i in range(0, max(len(d), 1), step):
        yield _ready(d[i : i + step], X[i : i + step], None if w is None else w[i : i + step])


def _ready(d: Tensor, X: Tensor, weights: Tensor | None) -> Rays:
    u, X = d.double().mT, X.double().mT
    w = torch.ones_like(u[:, 0]) if weights is None else weights.double()
    largest = u.abs().amax(1)
    good = torch.isfinite(u).all(1) & torch.isfinite(X).all(1) & torch.isfinite(w) & (largest > 0)
    wanted = ~(w <= 0)
    use = wanted & good
    w = torch.where(use, w, 0.0)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=d.device)[:, None]
    u = torch.where(use[:, None], u / torch.where(largest > 0, largest, 1.0)[:, None], axis)
    u = u * (u * u).sum(1, keepdim=True).rsqrt()
    X = torch.where(use[:, None], X, 0.0)
    total = w.sum(-1)
    centre = (X * w[:, None]).sum(-1) / torch.where(total > 0, total, 1.0)[:, None]
    X = torch.where(use[:, None], X - centre[..., None], 0.0)
    size = X.abs().amax((1, 2))
    size = torch.where(size > 0, size, 1.0)
    return Rays(u, X / size[:, None, None], w, centre, size, (wanted & ~good).any(-1))


def seen(data: Rays, R: Tensor, t: Tensor) -> Tensor:
    """The points in the frames of poses (b, k): (b, k, 3, n)."""
    return R @ data.X[:, None] + t[..., None]


def cost(data: Rays, R: Tensor, t: Tensor) -> Tensor:
    """The weighted sum of squared sines (b, k); a point behind costs more than any in front of the camera."""
    Y = seen(data, R, t)
    u0, u1, u2 = data.u[:, None].unbind(2)
    y0, y1, y2 = Y.unbind(2)
    c0, c1, c2 = y1 * u2 - y2 * u1, y2 * u0 - y0 * u2, y0 * u1 - y1 * u0
    square = (y0 * y0 + y1 * y1 + y2 * y2).clamp_min(1e-300)
    across = (c0 * c0 + c1 * c1 + c2 * c2) / square
    along = y0 * u0 + y1 * u1 + y2 * u2
    return (torch.where(along > 0, across, 2 - across) * data.w[:, None]).sum(-1)


def gauss_newton(data: Rays, R: Tensor, t: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Damped Gauss-Newton steps from poses (b, k).

    Returns:
        The poses, their costs, the last normal matrices (b, k, 6, 6) and what a further step promises.
    """
    e1, e2 = _across(data.u)
    frame = torch.stack((e1, e2), 1)[:, None]
    root = data.w.sqrt()[:, None, None]
    best = cost(data, R, t)
    eye = torch.eye(6, dtype=R.dtype, device=R.device)
    N = eye.expand(*best.shape, 6, 6)
    damping = torch.full_like(best, 1e-9)
    promise = torch.zeros_like(best)
    for step in range(steps + 1):
        Y = seen(data, R, t)
        inverse = (Y * Y).sum(2, keepdim=True).clamp_min(1e-300).rsqrt()
        y = Y * inverse
        r = (frame * y[:, :, None]).sum(3)
        # d r / d Y, of which the turn takes the part across.
        g = (frame - r[:, :, :, None] * y[:, :, None]) * inverse[:, :, None]
        turn = torch.linalg.cross(Y[:, :, None].expand_as(g), g, dim=3)
        J = torch.cat((turn, g), 3) * root[:, :, :, None]
        J = J.transpose(2, 3).flatten(3)
        N = J @ J.mT
        gradient = J @ (r * root).flatten(2)[..., None]
        scale = N.diagonal(dim1=-2, dim2=-1).clamp_min(1e-280).rsqrt()
        scaled = N * scale[..., :, None] * scale[..., None, :] + damping[..., None, None] * eye
        factor, info = torch.linalg.cholesky_ex(scaled)
        fine = (info == 0)[..., None, None]
        factor = torch.where(fine, factor, eye)
        delta = -(torch.cholesky_solve(gradient * scale[..., None], factor) * scale[..., None])[..., 0]
        promise = -(delta * gradient[..., 0]).sum(-1)
        if step == steps:
            break
        new_R, new_t = moved(R, t, torch.where(fine[..., 0] & torch.isfinite(delta), delta, 0.0))
        value = cost(data, new_R, new_t)
        better = value <= best * (1 + 1e-12) + 1e-300
        R, t = torch.where(better[..., None, None], new_R, R), torch.where(better[..., None], new_t, t)
        best = torch.where(better, value, best)
        damping = torch.where(better, damping * 0.1, (damping * 100).clamp_min(1e-3)).clamp(1e-15, 1e6)
    return R, t, best, N, promise


def moved(R: Tensor, t: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """The pose after a step (w, v) from the left."""
    turn = rotation_from_rotvec(delta[..., :3])
    new: Tensor = turn @ R
    return new, (turn @ t[..., None])[..., 0] + delta[..., 3:]


def determined(data: Rays, N: Tensor) -> Tensor:
    """Whether rays differ and normal matrices (b, k, 6, 6) have full rank."""
    scale = N.diagonal(dim1=-2, dim2=-1).clamp_min(1e-280).rsqrt()
    smallest = eigvalsh(N * scale[..., :, None] * scale[..., None, :])[0][..., 0]
    eye = torch.eye(3, dtype=N.dtype, device=N.device)
    total = data.w.sum(-1)[:, None, None]
    spread = eigvalsh(total * eye - (data.u * data.w[:, None]) @ data.u.mT)[0][:, :1]
    full: Tensor = (smallest > 1e-13) & (spread > 1e-14 * total[..., 0])
    return full


def status_of(data: Rays, R: Tensor, t: Tensor, full: Tensor, least: int) -> Tensor:
    """A status for one pose of each problem (b, 1)."""
    along = (seen(data, R, t) * data.u[:, None]).sum(2)[:, 0]
    behind = 2 * torch.where(along > 0, data.w, 0.0).sum(-1) <= data.w.sum(-1)
    status = torch.full(behind.shape, int(Status.OK), dtype=torch.int8, device=R.device)
    for condition, code in (
        (behind, Status.BEHIND),
        (~full, Status.DEGENERATE),
        (data.number < least, Status.TOO_FEW),
        (data.bad, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    return status


def attach(model: Tensor, valid: Tensor, d: Tensor, X: Tensor, w: Tensor | None) -> Tensor:
    """Poses (*batch, 3, 4) in float64, minima of the squared sines, with their derivatives; d and X (*#batch, n, 3)."""
    w = torch.ones_like(d[..., 0]) if w is None else w
    use = (w > 0) & torch.isfinite(d).all(-1) & torch.isfinite(X).all(-1)
    w = torch.where(use, w, 0.0).double()
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=d.dtype, device=d.device)
    d, X = torch.where(use[..., None], d, axis).double(), torch.where(use[..., None], X, 0.0).double()
    R, t = model[..., :3], model[..., 3]

    def objective(delta: Tensor, d: Tensor, X: Tensor, w: Tensor) -> Tensor:
        R1, t1 = moved(R, t, delta)
        Y = X @ R1.mT + t1[..., None, :]
        present = w.detach() > 0
        square = torch.where(present, (Y * Y).sum(-1) * (d * d).sum(-1), 1.0)
        across = torch.linalg.cross(*torch.broadcast_tensors(Y, d), dim=-1)  # type: ignore[no-untyped-call]
        found: Tensor = (w * (across * across).sum(-1) / square).sum(-1)
        return found

    zero = torch.zeros(*model.shape[:-2], 6, dtype=torch.float64, device=d.device)
    delta = attach_optimum(objective, zero, d, X, w, valid=valid)
    R1, t1 = moved(R, t, delta)
    change = torch.cat((R1, t1[..., None]), -1)
    return model + (change - change.detach())


def _across(u: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors orthogonal to unit vectors (b, 3, n) and to each other (Duff et al. 2017)."""
    x, y, z = u.unbind(1)
    s = torch.copysign(torch.ones_like(z), z)
    a = -1 / (s + z)
    b = x * y * a
    return torch.stack((1 + s * x * x * a, s * b, -s * x), 1), torch.stack((b, s + y * y * a, -y), 1)
