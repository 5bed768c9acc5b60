"""Rays, cameras and points with `depth a = P u`: the least-squares problems behind projective factorisation, many at once.

Points have `r` coordinates: 4 in space; 3 and 2 fit points of a plane and of a line, and views that have one centre.

Two measures of the misfit of a unit ray a and its prediction y = P u, both blind to rotations of the image's frame:

- with a prior on the depths, `|(I - a a') y|^2 + prior (a' y - 1)^2`: bilinear in P and u, so that the points can be eliminated
  exactly (variable projection: Golub & Pereyra 1973; Hong & Zach 2018 for its convergence from anywhere). With `prior = 1` it
  is the factorisation of the rays themselves to rank 4;
- the squared sine of the angle between a and y, which knows no depth.

Both have Hessians `B = alpha I - sum_k q_k q_k'` in y (Gauss-Newton), so one Schur complement serves both. Arrays are
(problem, view, coordinate, point), with the points last.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.linalg import eigh, eigvalsh, qr
from torchsfm.optim.descent import Options, Problem, Step, descend
from torchsfm.optim.pytree import Places, pick


@dataclass(frozen=True)
class Rays:
    """Unit rays in each view, 0 where there is none, and their weights."""

    a: Float[Tensor, "p v 3 n"]
    w: Float[Tensor, "p v n"]


@dataclass(frozen=True)
class Fit:
    """Cameras and points, and the misfit: the mean over the weights is 1 for a perfect miss."""

    P: Float[Tensor, "p v 3 r"]
    u: Float[Tensor, "p r n"]
    cost: Float[Tensor, "p"]


@dataclass(frozen=True)
class _Linearisation:
    """Gradient in y and the Gauss-Newton Hessian `alpha I - sum_k q_k q_k'`, weights included; for unknown P and u."""

    P: Tensor
    u: Tensor
    slope: Float[Tensor, "p v 3 n"]
    alpha: Float[Tensor, "p v n"]
    q: Float[Tensor, "p v k 3 n"]


def core(w: Float[Tensor, "p v n"], enough: int) -> tuple[Bool[Tensor, "p v"], Bool[Tensor, "p n"]]:
    """Views with enough points that at least two such views see, and these points."""
    seen = w > 0
    while True:
        view = seen.sum(-1) >= enough
        point = (seen & view[..., None]).sum(-2) >= 2
        rest = seen & view[..., None] & point[:, None]
        if bool((rest == seen).all()):
            return view, point
        seen = rest


def of_rank(rays: Rays, r: int) -> Float[Tensor, "p v 3 r"]:
    """Cameras whose joint column space, of dimension r, holds most of the rays: the start of everything."""
    p, v, _, n = rays.a.shape
    M = (rays.a * rays.w[:, :, None]).reshape(p, 3 * v, n)
    basis = eigh(M @ M.mT)[1][..., -r:]
    P: Tensor = basis.reshape(p, v, 3, r) * v**0.5
    return P


def fit_with_prior(
    rays: Rays, P: Float[Tensor, "p v 3 r"], prior: float, steps: int, tolerance: float
) -> tuple[Float[Tensor, "p v 3 r"], Float[Tensor, "p r n"], Bool[Tensor, "p"]]:
    """Minimise the misfit with a prior over cameras and points, from given cameras; also, which problems came to an end.

    With `prior = 1` the rays may be any vectors: what is minimised is the sum of `w |a - P u|^2`.
    """
    found = descend(_WithPrior(rays, prior), _balanced(P), Options(steps, tolerance))
    return found.x, _best_points(rays, found.x, prior)[0], found.status == Status.OK


def fit_angles(
    rays: Rays, P: Float[Tensor, "p v 3 r"], u: Float[Tensor, "p r n"], steps: int
) -> tuple[Fit, list[Tensor], Tensor]:
    """Minimise the squared sines over cameras and points; also the cost after each step, and which problems came to an end."""
    start = _unit(P, u)
    history = [sine_cost(rays, *start)]
    found = descend(_Sines(rays), start, Options(steps, 1e-10, progress=lambda _, cost: history.append(cost)))
    P, u = found.x
    return Fit(P, u, found.cost), history, found.status == Status.OK


@dataclass(frozen=True)
class _System:
    """The misfit linearised; `x` is what moves, cameras or both."""

    x: Any
    cost: Tensor
    linear: _Linearisation
    total: Tensor

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
        step, move, solved, promise = _step(self.linear, damping, points=isinstance(self.x, tuple))
        return Step((step, move), torch.where(solved, promise / self.total, torch.inf), solved, torch.zeros_like(solved))


@dataclass(frozen=True)
class _WithPrior(Problem[_System]):
    """The misfit with a prior over balanced cameras; points are where they are best."""

    rays: Rays
    prior: float

    def pick(self, at: Places) -> "_WithPrior":
        """Some of the problems."""
        return replace(self, rays=pick(at, self.rays))

    def linearize(self, x: Tensor) -> _System:
        """The system of cameras alone."""
        rays, prior = self.rays, self.prior
        u, cost = _best_points(rays, x, prior)
        y = x @ u[:, None]
        along = (rays.a * y).sum(2, keepdim=True)
        w = rays.w[:, :, None]
        slope = w * (y - ((1 - prior) * along + prior) * rays.a)
        q = ((1 - prior) * w).sqrt() * rays.a
        return _System(x, cost, _Linearisation(x, u, slope, rays.w, q[:, :, None]), _total(rays))

    def advance(self, here: _System, step: Step) -> _System:
        """The system where a step of the cameras leads."""
        return self.linearize(_balanced(here.x + step.delta[0]))

    def rounding(self, here: _System) -> Tensor:
        """What rounding of the rays makes of the misfit."""
        square = self.rays.a.square().sum(2)
        return (10 * self.epsilon) ** 2 * (self.rays.w * square).sum((-2, -1)) / here.total


@dataclass(frozen=True)
class _Sines(Problem[_System]):
    """The squared sines over cameras and points."""

    rays: Rays

    def pick(self, at: Places) -> "_Sines":
        """Some of the problems."""
        return _Sines(pick(at, self.rays))

    def linearize(self, x: tuple[Tensor, Tensor]) -> _System:
        """The system of cameras and points."""
        return _System(x, sine_cost(self.rays, *x), _angles(self.rays, *x), _total(self.rays))

    def advance(self, here: _System, step: Step) -> _System:
        """The system where a step leads."""
        (P, u), (moved, move) = here.x, step.delta
        return self.linearize(_unit(P + moved, u + move))

    def rounding(self, here: _System) -> Tensor:
        """What rounding makes of the misfit: predictions are products of units that may cancel, steps come of normal equations."""
        return (100 * self.epsilon) ** 2 * here.linear.alpha.sum((-2, -1)) / here.total


def sine_cost(rays: Rays, P: Tensor, u: Tensor) -> Float[Tensor, "p"]:
    """The weighted mean of the squared sines of the angles between rays and predictions."""
    return (rays.w * squared_sines(rays, P, u)).sum((-2, -1)) / _total(rays)


def squared_sines(rays: Rays, P: Tensor, u: Tensor) -> Float[Tensor, "p v n"]:
    """The squared sine of the angle between each ray and its prediction."""
    unit = torch.nn.functional.normalize(P @ u[:, None], dim=2)
    rest = unit - rays.a * (rays.a * unit).sum(2, keepdim=True)
    return rest.square().sum(2)


def information(rays: Rays, fit: Fit) -> Float[Tensor, "p k"]:
    """The eigenvalues, ascending, of the Gauss-Newton Hessian of the sines over the cameras, points eliminated.

    The scale of each camera is held. Of each problem, fifteen are zero: a projective change of space costs nothing.
    """
    S = _reduced(_angles(rays, fit.P, fit.u), torch.zeros_like(fit.cost), points=True)[0]
    return eigvalsh(S)[0]


def with_derivative(rays: Rays, fit: Fit) -> tuple[Tensor, Tensor]:
    """Attach to cameras and points their derivatives with respect to the rays and weights, to first order in the misfit.

    A Gauss-Newton step from the minimum is zero in value and has this derivative.
    """
    with torch.no_grad():
        held = _angles(Rays(rays.a.detach(), rays.w.detach()), fit.P, fit.u)
    system = replace(held, slope=_angles(rays, fit.P, fit.u).slope)
    S, right, F, rest = _reduced(system, torch.zeros_like(fit.cost), points=True)
    values, vectors, _ = eigh(S)
    free = values <= values[:, 14:15].clamp_min(0) + 1e-13 * values[:, -1:]
    inverse = torch.where(free, 0, 1 / torch.where(free, 1, values))
    step = -(vectors * inverse[:, None]) @ (vectors.mT @ right[..., None])
    move = _back(F, rest, step)
    step = step.reshape(fit.P.shape)
    return fit.P + (step - step.detach()), fit.u + (move - move.detach())


def _angles(rays: Rays, P: Tensor, u: Tensor) -> _Linearisation:
    y = P @ u[:, None]
    size = torch.linalg.vector_norm(y, dim=2, keepdim=True).clamp_min(1e-100)
    y = y / size
    cosine = (rays.a * y).sum(2, keepdim=True)
    p = rays.a - cosine * y
    w = rays.w[:, :, None]
    scale = w.sqrt() / size
    return _Linearisation(P, u, -w * cosine * p / size, scale[:, :, 0].square(), torch.stack((scale * y, scale * p), 2))


def _total(rays: Rays) -> Tensor:
    return rays.w.sum((-2, -1)).clamp_min(1e-100)


def _best_points(rays: Rays, P: Tensor, prior: float) -> tuple[Tensor, Tensor]:
    """The points that minimise the misfit with a prior for given cameras, and the misfit."""
    seen = P.mT @ rays.a
    H = _point_hessians(P, rays.w, ((1 - prior) * rays.w).sqrt()[:, :, None] * seen)
    right = prior * (rays.w[:, :, None] * seen).sum(1).mT
    L = torch.linalg.cholesky_ex(_regular(H))[0]
    u = torch.cholesky_solve(right[..., None], L)[..., 0].mT
    y = P @ u[:, None]
    # Both parts as one vector, whose square does not suffer from cancellation.
    along = (rays.a * y).sum(2, keepdim=True)
    misfit = (y - ((1 - prior**0.5) * along + prior**0.5) * rays.a).square().sum(2)
    return u, (rays.w * misfit).sum((-2, -1)) / _total(rays)


def _point_hessians(P: Tensor, alpha: Tensor, m: Tensor) -> Float[Tensor, "p n r r"]:
    """`sum_v alpha P'P - sum_vk m m'` for each point, with m (p, v, k r, n) or (p, v, r, n)."""
    p, v, _, n = m.shape
    r = P.shape[-1]
    G = (P.mT @ P).reshape(p, v, r * r)
    H = (alpha.mT @ G).reshape(p, n, r, r)
    rows = m.reshape(p, m.shape[1] * m.shape[2] // r, r, n).permute(0, 3, 2, 1).contiguous()
    return H - rows @ rows.mT


def _regular(H: Tensor) -> Tensor:
    """Add what rounding may take away; points without rays get the identity."""
    trace = H.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    return H + torch.where(trace > 0, 1e-14 * trace, 1.0) * eye


def _reduced(system: _Linearisation, damping: Tensor, points: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The Schur complement over the cameras, its right-hand side, and what back-substitution needs.

    With `points`, these have a gradient of their own and are damped, and scales of cameras and points are held. Without,
    cameras are balanced.
    """
    P, u, alpha, q = system.P, system.u, system.alpha, system.q
    p, v, k, _, n = q.shape
    r = P.shape[-1]
    m = P.mT[:, :, None] @ q
    H = _point_hessians(P, alpha, m.flatten(2, 3))
    size = H.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(r, dtype=P.dtype, device=P.device)
    if points:
        H = H + size * u.mT[..., :, None] * u.mT[..., None, :] + damping[:, None, None, None] * size * eye
    L = torch.linalg.cholesky_ex(_regular(H))[0]
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


def _step(system: _Linearisation, damping: Tensor, points: bool) -> tuple[Tensor, Tensor, Bool[Tensor, "p"], Tensor]:
    """A damped Gauss-Newton step of cameras and points, and where it could be solved."""
    p, v, _ = system.alpha.shape
    S, right, F, rest = _reduced(system, damping, points)
    if points:
        _hold_frame(S, system.P)
    factor, info = torch.linalg.cholesky_ex(S)
    step = -torch.cholesky_solve(right[..., None], factor)
    solved = (info == 0) & torch.isfinite(step).all(-1).all(-1)
    step = torch.where(solved[:, None, None], step, 0)
    g, move = rest[:, 0], _back(F, rest, step)
    # The model: right' step + step' S step / 2 and what the points alone bring; twice that in units of the cost.
    promise = -(right * step[..., 0]).sum(-1) + g.square().sum((-2, -1))
    return step.reshape(p, v, 3, system.P.shape[-1]), move, solved, promise


def _hold_frame(S: Tensor, P: Tensor) -> None:
    """No change of frame gains anything; what rounding leaves of its slope, divided by the damping, would be all that is promised."""
    p, v, _, r = P.shape
    Q = _orthonormal(P)[0].reshape(p, 3 * v, r)
    size = S.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    S.view(p, 3 * v, r, 3 * v, r).diagonal(dim1=2, dim2=4).add_((size * (Q @ Q.mT))[..., None])


def _back(F: Tensor, rest: Tensor, step: Tensor) -> Float[Tensor, "p r n"]:
    """The step of the points that goes with a step of the cameras."""
    g, inverse = rest[:, 0], rest[:, 1:]
    back = g + (F.mT @ step).reshape(g.shape)
    return -(inverse * back[:, :, None]).sum(1)


def _balanced(P: Tensor) -> Tensor:
    """The same column space with orthonormal columns, of a norm that does not depend on the number of views."""
    balanced: Tensor = _orthonormal(P)[0] * P.shape[1] ** 0.5
    return balanced


def _orthonormal(P: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras with orthonormal joint columns, and what they are to be multiplied by; hardly turned where they nearly were."""
    Q, R, _ = qr(P.flatten(1, 2))
    sign = torch.where(R.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0)
    return (Q * sign[:, None]).reshape(P.shape), R * sign[..., None]


def _unit(P: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The frame in which the cameras' joint columns are orthonormal; then each camera and point of norm 1."""
    P, R = _orthonormal(P)
    u = R @ u
    P = P / torch.linalg.matrix_norm(P)[..., None, None].clamp_min(1e-100)
    return P, torch.nn.functional.normalize(u, dim=1)
