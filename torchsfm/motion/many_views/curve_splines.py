"""Cameras and space curves at the least squares of the distances of all that was measured of image curves.

Where images show few noisy points of curves, samples of space curves lose what lies between them, and the smooth curve through
the points of an image leaves the true one where a space curve is seen end-on. In space it bends less. So space curves are cubic
B-splines here, and a row is the distance of a measured point from the nearest point of a spline's image, along its normal. That
point is found anew for each (variable projection).

Space curves are finite in the frame that is used, (problem, view, curve, point) the order of what is measured.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.vectors import across
from torchsfm.motion.many_views.bilinear_steps import hold_frame
from torchsfm.optim.descent import Descent, Options, Problem, Step, descend
from torchsfm.optim.pytree import Places, pick

_NEWTON = 4
"""Steps to the nearest point, from where it was before."""
_LONGEST = 1.0
"""The longest of them, in knots."""
_ROUNDING = 1e-12
"""Distances that are nothing, in image coordinates about 1."""
_STEPS = 5
"""With weights by distances."""
_TRUSTED = 4.5
"""Where the weight lets go, in medians of distances; farther than twice that nothing counts in the end."""


class Splines(NamedTuple):
    """Cameras, space curves, and where on these the measured points are."""

    P: Float[Tensor, "p v 3 4"]
    control: Float[Tensor, "p c k 3"]
    t: Float[Tensor, "p v c n"]
    """In knots: 0 to k - 3 of open splines, any number of closed ones."""


@dataclass(frozen=True)
class SplineSystem:
    """The distances linearised."""

    x: Splines
    cost: Float[Tensor, "p"]
    r: Float[Tensor, "p v c n"]
    across: Float[Tensor, "p c k 2 3"]
    """Directions in which control points move: along their splines these would change next to nothing."""
    A: Float[Tensor, "p r r"]
    """Normal matrix of the cameras,"""
    G: Float[Tensor, "p c l l"]
    """of each spline,"""
    W: Float[Tensor, "p c r l"]
    """and between them."""
    camera_slope: Float[Tensor, "p r"]
    control_slope: Float[Tensor, "p c l"]
    total: Float[Tensor, "p"]

    def steepest(self) -> Tensor:
        """The largest derivative."""
        return torch.maximum(self.camera_slope.abs().amax(-1), self.control_slope.abs().flatten(1).amax(-1))

    def along(self, delta: tuple[Tensor, Tensor]) -> Tensor:
        """The derivative of the cost along a step of cameras and control points."""
        cameras, control = delta[0].flatten(1), (self.across @ delta[1][..., None]).flatten(2)
        return 2 * ((self.camera_slope * cameras).sum(-1) + (self.control_slope * control).sum((-2, -1))) / self.total

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step of cameras and control points, splines eliminated."""
        G = _damped(self.G, damping[:, None])
        L, info = torch.linalg.cholesky_ex(G)
        Z = torch.linalg.solve_triangular(L, torch.cat((self.W.mT, self.control_slope[..., None]), -1), upper=False)
        F, g = Z[..., :-1], Z[..., -1:]
        S = _damped(self.A, damping) - (F.mT @ F).sum(1)
        hold_frame(S, self.x.P)
        factor, wrong = torch.linalg.cholesky_ex(S)
        right = self.camera_slope[..., None] - (F.mT @ g).sum(1)
        cameras = -torch.cholesky_solve(right, factor)
        control = torch.linalg.solve_triangular(L.mT, -(g + F @ cameras[:, None]), upper=True)
        control = (control.view(*self.across.shape[:4], 1) * self.across).sum(-2)
        solved = (info == 0).all(-1) & (wrong == 0) & torch.isfinite(cameras).all(-1).all(-1)
        delta = (
            torch.where(solved[:, None, None, None], cameras.reshape(self.x.P.shape), 0),
            torch.where(solved[:, None, None, None], control, 0),
        )
        promise = torch.where(solved, -self.along(delta) / 2, torch.inf)
        return Step(delta, promise, solved, torch.zeros_like(solved))


@dataclass(frozen=True)
class SplineDistances(Problem[SplineSystem]):
    """The weighted mean of squared distances of measured points from images of splines."""

    measured: Float[Tensor, "p v c n 2"]
    weight: Float[Tensor, "p v c n"]
    closed: Bool[Tensor, "p c"]
    stiffness: Float[Tensor, "p c"]
    """Weight of the squared third differences of control points."""

    def pick(self, at: Places) -> "SplineDistances":
        """Some of the problems."""
        return SplineDistances(*(pick(at, t) for t in (self.measured, self.weight, self.closed, self.stiffness)))

    def inside(self, x: Splines) -> Bool[Tensor, "p v c n"]:
        """Points that do not lie beyond the end of an open spline."""
        return self.closed[:, None, :, None] | ((x.t > 0) & (x.t < x.control.shape[2] - 3))

    def advance(self, here: SplineSystem, step: Step) -> SplineSystem:
        """The system where a step leads."""
        P = here.x.P + step.delta[0]
        P = P / torch.linalg.matrix_norm(P)[..., None, None].clamp_min(1e-100)
        return self.linearize(Splines(P, here.x.control + step.delta[1], here.x.t))

    def rounding(self, here: SplineSystem) -> Tensor:
        """What rounding makes of the distances."""
        return torch.full_like(here.cost, _ROUNDING**2)

    def linearize(self, x: Splines) -> SplineSystem:
        """The normal equations, at the points nearest to what was measured."""
        t = x.t
        for _ in range(_NEWTON):
            p, first, second, *_ = self._images(x._replace(t=t))
            away, speed = p - self.measured, first.square().sum(-1)
            bent = torch.maximum(speed + (away * second).sum(-1), 0.3 * speed)
            t = t - ((away * first).sum(-1) / bent.clamp_min(1e-300)).clamp(-_LONGEST, _LONGEST)
            t = torch.where(self.closed[:, None, :, None], t, t.clamp(0, x.control.shape[2] - 3))
        x = x._replace(t=t)
        p, first, _, inverse, weights, index = self._images(x)
        unit = torch.nn.functional.normalize(first, dim=-1)
        normal = torch.stack((-unit[..., 1], unit[..., 0]), -1)
        r = ((p - self.measured) * normal).sum(-1)
        # The derivative of the distance by the homogeneous image.
        q = torch.cat((normal, -(normal * p).sum(-1, keepdim=True)), -1) * inverse
        root = self.weight.sqrt()
        return self._system(x, r, q * root[..., None], weights, index)

    def _along(self, control: Tensor) -> Float[Tensor, "p c k 3"]:
        """How splines run at control points."""
        ahead, behind = control.roll(-1, 2) - control, control - control.roll(1, 2)
        ends = torch.cat((ahead[:, :, :1], (ahead + behind)[:, :, 1:-1], behind[:, :, -1:]), 2)
        return torch.where(self.closed[..., None, None], ahead + behind, ends)

    def _images(self, x: Splines) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Points of the splines' images with two derivatives, inverse depths, and weights and numbers of control points."""
        k = x.control.shape[2]
        around = self.closed[:, None, :, None]
        knot = torch.where(around, x.t.floor(), x.t.floor().clamp(0, k - 4))
        index = knot.long()[..., None] + torch.arange(4, device=knot.device)
        index = torch.where(around[..., None], index % k, index)
        weights = cubic_weights(x.t - knot)
        own = x.control[:, None].expand(-1, x.t.shape[1], -1, -1, -1)
        picked = index.flatten(3)[..., None].expand(*index.shape[:3], -1, 3)
        own = own.gather(3, picked).view(*index.shape, 3)
        X, X1, X2 = ((w[..., None] * own).sum(-2) for w in weights)
        M, a = x.P[:, :, None, :, :3].mT, x.P[:, :, None, None, :, 3]
        y, y1, y2 = X @ M + a, X1 @ M, X2 @ M
        inverse = 1 / torch.where(y[..., 2:] == 0, 1e-300, y[..., 2:])
        p = y[..., :2] * inverse
        first = (y1[..., :2] - p * y1[..., 2:]) * inverse
        second = (y2[..., :2] - p * y2[..., 2:] - 2 * first * y1[..., 2:]) * inverse
        return p, first, second, inverse, weights[0], index

    def _system(self, x: Splines, r: Tensor, q: Tensor, weights: Tensor, index: Tensor) -> SplineSystem:
        p, v, c, n = r.shape
        k = x.control.shape[2]
        B = q.new_zeros(p, v, c, n, k).scatter_add(-1, index, weights)
        X = torch.cat((B @ x.control[:, None], torch.ones_like(r)[..., None]), -1)
        by_camera = (q[..., :, None] * X[..., None, :]).flatten(-2)
        by_point = (q[..., None, :] @ x.P[:, :, None, None, :, :3])[..., 0, :]
        rest = (r * self.weight.sqrt())[..., None]
        E = torch.stack(across(torch.nn.functional.normalize(self._along(x.control), dim=-1).movedim(-1, 0))).permute(
            2, 3, 4, 0, 1
        )
        blocks = (by_camera.mT @ by_camera).sum(2)
        A = q.new_zeros(p, v, 12, v, 12)
        A.diagonal(dim1=1, dim2=3).copy_(blocks.permute(0, 2, 3, 1))
        G, W, slope = [], [], []
        # Curve by curve, which bounds memory.
        for i in range(c):
            J = (B[:, :, i, :, :, None] * torch.einsum("pvnd,pked->pvnke", by_point[:, :, i], E[:, i])).flatten(-2)
            G.append((J.mT @ J).sum(1))
            W.append((by_camera[:, :, i].mT @ J).flatten(1, 2))
            slope.append((J.mT @ rest[:, :, i]).sum(1)[..., 0])
        D = third_differences(self.closed, k)
        K = self.stiffness[..., None, None] * (D.mT @ D)
        stiff = torch.einsum("pckl,pckad,pclbd->pckalb", K, E, E).flatten(4, 5).flatten(2, 3)
        by_control = torch.stack(slope, 1) + (E @ (K @ x.control)[..., None]).flatten(2)
        total = self.weight.sum((-3, -2, -1)).clamp_min(1e-100)
        cost = ((self.weight * r.square()).sum((-3, -2, -1)) + (x.control * (K @ x.control)).sum((-3, -2, -1))) / total
        cost = torch.where(cost.isfinite(), cost, torch.inf)
        by_cameras = (by_camera.mT @ rest).sum(2)[..., 0].flatten(1)
        A, stiff = A.reshape(p, 12 * v, 12 * v), torch.stack(G, 1) + stiff
        return SplineSystem(x, cost, r, E, A, stiff, torch.stack(W, 1), by_cameras, by_control, total)


def approach_splines(problem: SplineDistances, x: Splines) -> tuple[SplineDistances, Splines]:
    """A few steps with weights by distances, and with what these say of the stiffness."""
    r = problem.linearize(x).r
    typical = typical_distance(problem, x, r)
    trust = (1 + (r / (_TRUSTED * typical[:, None, None, None])).square()).reciprocal().square()
    problem = replace(problem, stiffness=_stiffness(problem, x, typical))
    return problem, descend(replace(problem, weight=problem.weight * trust), x, Options(_STEPS, 1e-10)).x


def fit_splines(problem: SplineDistances, x: Splines, steps: int, tolerance: float) -> tuple[SplineDistances, Descent]:
    """The least squares of what is near the splines; and of what that is."""
    here = problem.linearize(x)
    typical = typical_distance(problem, here.x, here.r)
    near = here.r.abs() <= 2 * _TRUSTED * typical[:, None, None, None]
    weight = problem.weight * near * problem.inside(here.x)
    problem = replace(problem, weight=weight, stiffness=_stiffness(problem, here.x, typical))
    return problem, descend(problem, here.x, Options(steps, tolerance))


def third_differences(closed: Bool[Tensor, "p c"], k: int) -> Float[Tensor, "p c k k"]:
    """What takes third differences of control points, around closed splines."""
    eye = torch.eye(k, dtype=torch.float64, device=closed.device)
    D = eye.roll(-2, -1) - 3 * eye.roll(-1, -1) + 3 * eye - eye.roll(1, -1)
    inner = torch.arange(k, device=closed.device)
    inner = ((inner >= 1) & (inner < k - 2))[:, None]
    return torch.where(closed[..., None, None] | inner, D.mT, 0)


def _stiffness(problem: SplineDistances, x: Splines, typical: Float[Tensor, "p"]) -> Float[Tensor, "p c"]:
    """The variance of distances over that of third differences."""
    D = third_differences(problem.closed, x.control.shape[2])
    rows = (D != 0).any(-1).sum(-1)
    size = (D @ x.control).square().sum((-2, -1)) / (3 * rows).clamp(min=1)
    return (1.4826 * typical[:, None]).square() / size.clamp_min(1e-100)


def typical_distance(problem: SplineDistances, x: Splines, r: Tensor) -> Float[Tensor, "p"]:
    """The median distance."""
    counts = (problem.weight > 0) & problem.inside(x)
    middle = torch.where(counts, r.abs(), torch.nan).flatten(1).nanmedian(-1).values
    return middle.nan_to_num(1.0).clamp_min(1e-14)


def _damped(A: Tensor, damping: Tensor) -> Tensor:
    """With the diagonal enlarged, and what nothing was measured of held."""
    diagonal = A.diagonal(dim1=-2, dim2=-1)
    least = 1e-12 * diagonal.amax(-1, keepdim=True).clamp_min(1e-100)
    return A + torch.diag_embed(damping[..., None] * diagonal + least)


def cubic_weights(t: Float[Tensor, "*b"]) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of the four control points about a share t of the way between knots, and two derivatives, (*b, 4)."""
    s = 1 - t
    weights = (s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3)
    first = (-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2)
    return torch.stack(weights, -1) / 6, torch.stack(first, -1) / 2, torch.stack((s, 3 * t - 2, 3 * s - 2, t), -1)
