"""Rays, cameras and points with `depth a = P u`: the least-squares problems behind projective factorisation, many at once.

Points have `r` coordinates: 4 in space; 3 and 2 fit points of a plane and of a line, and views that have one centre.

Two measures of the misfit of a unit ray a and its prediction y = P u, both blind to rotations of the image's frame:

- with a prior on the depths, `|(I - a a') y|^2 + prior (a' y - 1)^2`: bilinear in P and u, so that the points can be eliminated
  exactly (variable projection: Golub & Pereyra 1973; Hong & Zach 2018 for its convergence from anywhere). With `prior = 1` it
  is the factorisation of the rays themselves to rank 4;
- the squared sine of the angle between a and y, which knows no depth.

Both have Hessians of one form in y, so one Schur complement serves both (`bilinear_steps`). Arrays are
(problem, view, coordinate, point), with the points last.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.linalg import eigh, eigvalsh
from torchsfm.motion.many_views.bilinear_steps import (
    BilinearSystem,
    Linearisation,
    back_substituted,
    orthonormal,
    point_hessians,
    reduced,
    regular,
)
from torchsfm.optim.descent import Options, descend
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, pick

_FRAMES = 60
"""Steps to the frame in which cameras of norm 1 have orthonormal joint columns: each leaves a fraction of what is missing."""


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
    start = unit_frame(P, u)
    history = [sine_cost(rays, *start)]
    found = descend(_Sines(rays), start, Options(steps, 1e-10, progress=lambda _, cost: history.append(cost)))
    P, u = found.x
    return Fit(P, u, found.cost), history, found.status == Status.OK


@dataclass(frozen=True)
class _WithPrior(Problem[BilinearSystem]):
    """The misfit with a prior over balanced cameras; points are where they are best."""

    rays: Rays
    prior: float

    def pick(self, at: Places) -> "_WithPrior":
        """Some of the problems."""
        return replace(self, rays=pick(at, self.rays))

    def linearize(self, x: Tensor) -> BilinearSystem:
        """The system of cameras alone."""
        rays, prior = self.rays, self.prior
        u, cost = _best_points(rays, x, prior)
        y = x @ u[:, None]
        along = (rays.a * y).sum(2, keepdim=True)
        w = rays.w[:, :, None]
        slope = w * (y - ((1 - prior) * along + prior) * rays.a)
        q = ((1 - prior) * w).sqrt() * rays.a
        return BilinearSystem(x, cost, Linearisation(x, u, slope, rays.w, q[:, :, None]), _total(rays))

    def advance(self, here: BilinearSystem, step: Step) -> BilinearSystem:
        """The system where a step of the cameras leads."""
        return self.linearize(_balanced(here.x + step.delta[0]))

    def rounding(self, here: BilinearSystem) -> Tensor:
        """What rounding of the rays makes of the misfit."""
        square = self.rays.a.square().sum(2)
        return (10 * self.epsilon) ** 2 * (self.rays.w * square).sum((-2, -1)) / here.total


@dataclass(frozen=True)
class _Sines(Problem[BilinearSystem]):
    """The squared sines over cameras and points."""

    rays: Rays

    def pick(self, at: Places) -> "_Sines":
        """Some of the problems."""
        return _Sines(pick(at, self.rays))

    def linearize(self, x: tuple[Tensor, Tensor]) -> BilinearSystem:
        """The system of cameras and points."""
        return BilinearSystem(x, sine_cost(self.rays, *x), _angles(self.rays, *x), _total(self.rays))

    def advance(self, here: BilinearSystem, step: Step) -> BilinearSystem:
        """The system where a step leads."""
        (P, u), (moved, move) = here.x, step.delta
        return self.linearize(unit_frame(P + moved, u + move))

    def rounding(self, here: BilinearSystem) -> Tensor:
        """What rounding makes of it: predictions are products of units that may cancel, steps come from normal equations."""
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
    S = reduced(_angles(rays, fit.P, fit.u), torch.zeros_like(fit.cost), points=True)[0]
    return eigvalsh(S)[0]


def with_derivative(rays: Rays, fit: Fit) -> tuple[Tensor, Tensor]:
    """Attach to cameras and points their derivatives with respect to the rays and weights, to first order in the misfit.

    A Gauss-Newton step from the minimum is zero in value and has this derivative.
    """
    with torch.no_grad():
        held = _angles(Rays(rays.a.detach(), rays.w.detach()), fit.P, fit.u)
    system = replace(held, slope=_angles(rays, fit.P, fit.u).slope)
    S, right, F, rest = reduced(system, torch.zeros_like(fit.cost), points=True)
    values, vectors, _ = eigh(S)
    free = values <= values[:, 14:15].clamp_min(0) + 1e-13 * values[:, -1:]
    inverse = torch.where(free, 0, 1 / torch.where(free, 1, values))
    step = -(vectors * inverse[:, None]) @ (vectors.mT @ right[..., None])
    move = back_substituted(F, rest, step)
    step = step.reshape(fit.P.shape)
    return fit.P + (step - step.detach()), fit.u + (move - move.detach())


def _angles(rays: Rays, P: Tensor, u: Tensor) -> Linearisation:
    y = P @ u[:, None]
    size = torch.linalg.vector_norm(y, dim=2, keepdim=True).clamp_min(1e-100)
    y = y / size
    cosine = (rays.a * y).sum(2, keepdim=True)
    p = rays.a - cosine * y
    w = rays.w[:, :, None]
    scale = w.sqrt() / size
    return Linearisation(P, u, -w * cosine * p / size, scale[:, :, 0].square(), torch.stack((scale * y, scale * p), 2))


def _total(rays: Rays) -> Tensor:
    return rays.w.sum((-2, -1)).clamp_min(1e-100)


def _best_points(rays: Rays, P: Tensor, prior: float) -> tuple[Tensor, Tensor]:
    """The points that minimise the misfit with a prior for given cameras, and the misfit."""
    seen = P.mT @ rays.a
    H = point_hessians(P, rays.w, ((1 - prior) * rays.w).sqrt()[:, :, None] * seen)
    right = prior * (rays.w[:, :, None] * seen).sum(1).mT
    L = torch.linalg.cholesky_ex(regular(H))[0]
    u = torch.cholesky_solve(right[..., None], L)[..., 0].mT
    y = P @ u[:, None]
    # Both parts as one vector, whose square does not suffer from cancellation.
    along = (rays.a * y).sum(2, keepdim=True)
    misfit = (y - ((1 - prior**0.5) * along + prior**0.5) * rays.a).square().sum(2)
    return u, (rays.w * misfit).sum((-2, -1)) / _total(rays)


def _balanced(P: Tensor) -> Tensor:
    """The same column space with orthonormal columns, of a norm that does not depend on the number of views."""
    balanced: Tensor = orthonormal(P)[0] * P.shape[1] ** 0.5
    return balanced


def unit_frame(P: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The frame in which the cameras' joint columns are orthonormal; then each camera and point of norm 1."""
    P, R = orthonormal(P)
    u = R @ u
    P = P / torch.linalg.matrix_norm(P)[..., None, None].clamp_min(1e-100)
    return P, torch.nn.functional.normalize(u, dim=1)


def in_own_frame(fit: Fit, used: Bool[Tensor, "p n"]) -> Fit:
    """The same cameras and points, each of norm 1, in a frame of their own.

    A fit determines them up to a change of space and to scales. A frame that is carried along the search is changed by its way,
    on which rounding grows. Cameras of norm 1 have orthonormal joint columns in one frame and those turned against it (Tyler
    1987 for vectors); of these it is the one whose axes are the principal axes of the points that are used.
    """
    P, u = fit.P, fit.u
    for _ in range(_FRAMES):
        P, u = unit_frame(P, u)
    _, axes, _ = eigh((u * used[:, None]) @ u.mT)
    # Their senses by a moment that no symmetry of the points makes zero.
    moment = axes.mT @ (u * used[:, None]) @ (1 + torch.arange(u.shape[-1], dtype=u.dtype, device=u.device)).reciprocal()
    axes = axes * torch.where(moment < 0, -1.0, 1.0).to(u.dtype)[:, None]
    return Fit(P @ axes[:, None], axes.mT @ u, fit.cost)
