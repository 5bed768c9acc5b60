"""Cameras and space curves at the least squares of the distances of all that was measured of image curves.

Where images show few noisy points of curves, samples of space curves lose what lies between them, and the smooth curve through
the points of an image leaves the true one where a space curve is seen end-on. In space it bends less. So space curves are cubic
B-splines here, and what counts is the distance of each measured point from the nearest point of a spline's image, found anew
each time (variable projection).

Much may be changed that changes nothing or next to nothing, and is held: the frame and the scales of cameras, and in the end
control points along their splines. The bending of splines, in the frame of the start, is weighed by its variance. At first it
draws control points along their splines too: where noise has put them unevenly they would bend a spline as much as noise across
it does, and it would be taken for one that bends.

The valley is long, as far as noise lets curves bend, and distances are not small against how these bend: Gauss-Newton steps go
astray in it, and exact second derivatives end it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.linalg.vectors import across
from torchsfm.motion.many_views.curve_splines import (
    Images,
    Splines,
    control_weights,
    courses,
    nearest,
    spread,
    third_differences,
)
from torchsfm.motion.many_views.curve_stiffness import likeliest_stiffness
from torchsfm.optim.descent import Descent, Options, descend
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, choose, pick

_ROUNDING = 1e-12
"""Distances that are nothing, in image coordinates about 1."""
_STEPS = 5
"""With weights by distances."""
_TRUSTED = 4.5
"""Where the weight lets go, in medians of distances; farther than twice that nothing counts in the end."""


class Normal(NamedTuple):
    """A Hessian of half the sum of squares, nearest points eliminated, and the derivatives."""

    A: Float[Tensor, "p r r"]
    """Of the cameras,"""
    G: Float[Tensor, "p c l l"]
    """of each spline,"""
    W: Float[Tensor, "p c r l"]
    """and between them."""
    by_cameras: Float[Tensor, "p r"]
    by_control: Float[Tensor, "p c l"]


@dataclass(frozen=True)
class SplineSystem:
    """The distances at cameras and splines."""

    x: Splines
    cost: Float[Tensor, "p"]
    seen: Images
    normal: Normal
    """By Gauss and Newton,"""
    exact: Normal
    """and exact where that was asked for."""
    across: Float[Tensor, "p c k d 3"]
    held: Float[Tensor, "p r h"]
    total: Float[Tensor, "p"]
    distance: Float[Tensor, "p v c n"]

    def steepest(self) -> Tensor:
        """The largest derivative."""
        return torch.maximum(self.normal.by_cameras.abs().amax(-1), self.normal.by_control.abs().flatten(1).amax(-1))

    def along(self, delta: tuple[Tensor, Tensor]) -> Tensor:
        """The derivative of the cost along a step of cameras and control points."""
        control = (self.across @ delta[1][..., None]).flatten(2)
        by_cameras = (self.normal.by_cameras * delta[0].flatten(1)).sum(-1)
        return 2 * (by_cameras + (self.normal.by_control * control).sum((-2, -1))) / self.total

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step of cameras and control points, splines eliminated."""
        by = self.normal if exact is None else choose(exact, self.exact, self.normal)
        size = self.normal.G.diagonal(dim1=-2, dim2=-1)
        L, info = torch.linalg.cholesky_ex(_damped(by.G, size, damping[:, None]))
        Z = torch.linalg.solve_triangular(L, torch.cat((by.W.mT, by.by_control[..., None]), -1), upper=False)
        F, g = Z[..., :-1], Z[..., -1:]
        size = self.normal.A.diagonal(dim1=-2, dim2=-1)
        S = _damped(by.A, size, damping) - (F.mT @ F).sum(1)
        right = by.by_cameras[..., None] - (F.mT @ g).sum(1)
        fixed = self.held @ self.held.mT
        free = torch.eye(fixed.shape[-1], dtype=fixed.dtype, device=fixed.device) - fixed
        S = free @ S @ free + size.mean(-1)[:, None, None] * fixed
        factor, wrong = torch.linalg.cholesky_ex(S)
        cameras = -torch.cholesky_solve(free @ right, factor)
        control = torch.linalg.solve_triangular(L.mT, -(g + F @ cameras[:, None]), upper=True)
        control = (control.view(*self.across.shape[:4], 1) * self.across).sum(-2)
        solved = (info == 0).all(-1) & (wrong == 0) & torch.isfinite(cameras).all(-1).all(-1)
        delta = (
            torch.where(solved[:, None, None, None], cameras.reshape(self.x.P.shape), 0),
            torch.where(solved[:, None, None, None], control, 0),
        )
        promise = torch.where(solved, -self.along(delta) / 2, torch.inf)
        none = torch.zeros_like(solved)
        return Step(delta, promise, solved, none, none)


@dataclass(frozen=True)
class SplineDistances(Problem[SplineSystem]):
    """The weighted mean of squared distances of measured points from images of splines."""

    measured: Float[Tensor, "p v c n 2"]
    weight: Float[Tensor, "p v c n"]
    closed: Bool[Tensor, "p c"]
    stiffness: Float[Tensor, "p c"]
    """Weight of the squared third differences of control points."""
    across: Float[Tensor, "p c k d 3"]
    """Directions in which control points move."""
    held: Float[Tensor, "p r h"]
    """Directions in which cameras do not."""

    @property
    def patience(self) -> int:
        """About how many Gauss-Newton steps take the time of a Newton step."""
        return 2

    def pick(self, at: Places) -> "SplineDistances":
        """Some of the problems."""
        fields = (self.measured, self.weight, self.closed, self.stiffness, self.across, self.held)
        return SplineDistances(*(pick(at, t) for t in fields))

    def inside(self, x: Splines) -> Bool[Tensor, "p v c n"]:
        """Points that do not lie beyond the end of an open spline."""
        return self.closed[:, None, :, None] | ((x.t > 0) & (x.t < x.control.shape[2] - 3))

    def advance(self, here: SplineSystem, step: Step) -> SplineSystem:
        """The system where a step leads."""
        return self.linearize(Splines(here.x.P + step.delta[0], here.x.control + step.delta[1], here.x.t))

    def rounding(self, here: SplineSystem) -> Tensor:
        """What rounding makes of the distances."""
        return torch.full_like(here.cost, _ROUNDING**2)

    def linearize(self, x: Splines) -> SplineSystem:
        """The normal equations, at the points nearest to what was measured."""
        x, seen = nearest(x, self.closed, self.measured)
        total = self.weight.sum((-3, -2, -1)).clamp_min(1e-100)
        square = seen.away.square().sum(-1)
        D = third_differences(self.closed, x.control.shape[2]) @ x.control
        bending = (self.stiffness * D.square().sum((-2, -1))).sum(-1)
        cost = ((self.weight * square).sum((-3, -2, -1)) + bending) / total
        cost = torch.where(cost.isfinite(), cost, torch.inf)
        normal = self.normal(x, seen, exact=False)
        return SplineSystem(x, cost, seen, normal, normal, self.across, self.held, total, square.sqrt())

    def curve(self, here: SplineSystem, where: Tensor) -> SplineSystem:
        """The system with the exact Hessian in some problems."""
        return replace(here, exact=choose(where, self.normal(here.x, here.seen, exact=True), here.exact))

    def normal(self, x: Splines, seen: Images, *, exact: bool) -> Normal:
        """The normal equations of cameras and control points."""
        p, v, c, n = seen.slope.shape
        w, depth = self.weight[..., None], seen.y[..., 2:]
        depth = torch.where(depth == 0, 1e-300, depth)
        J = torch.cat(
            (torch.eye(2, dtype=depth.dtype, device=depth.device).expand(p, v, c, n, 2, 2), -seen.points[..., None]), -1
        )
        J = J / depth[..., None]
        by_image = w * (J.mT @ seen.away[..., None])[..., 0]
        H = w[..., None] * (J.mT @ J)
        h = self.weight * (seen.bent if exact else seen.speed)
        if exact:
            a = (by_image / depth)[..., None] * torch.tensor([0.0, 0.0, 1.0], dtype=depth.dtype, device=depth.device)
            H = H - a - a.mT
        moves = torch.where((h > 0) & ~seen.held, 1 / h.clamp_min(1e-300), 0)
        parts = [self._of_curve(x, seen, by_image[:, :, i], H[:, :, i], moves[:, :, i], i, exact) for i in range(c)]
        D = third_differences(self.closed, x.control.shape[2])
        K = self.stiffness[..., None, None] * (D.mT @ D)
        E = self.across
        stiff = torch.einsum("pckl,pckad,pclbd->pckalb", K, E, E).flatten(4, 5).flatten(2, 3)
        pull = (E @ (K @ x.control)[..., None]).flatten(2)
        A = depth.new_zeros(p, v, 12, v, 12)
        A.diagonal(dim1=1, dim2=3).copy_(sum_of(part[0] for part in parts).permute(0, 2, 3, 1))
        G, W, by_control = (torch.stack([part[i] for part in parts], 1) for i in (1, 2, 4))
        by_cameras = sum_of(part[3] for part in parts).flatten(1)
        return Normal(A.reshape(p, 12 * v, 12 * v), G + stiff, W, by_cameras, by_control + pull)

    def _of_curve(
        self, x: Splines, seen: Images, by_image: Tensor, H: Tensor, moves: Tensor, i: int, exact: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What one curve brings; one after the other, which bounds memory.

        A point is X = sum B_k c_k of the control points, and its image moves by dP X + M sum B_k dc_k, with the first three
        columns M of the camera. So all that a point says of control points is said of X itself, by three numbers or three by
        three, and spread by the weights B; with exact second derivatives also of the course B' of the spline there.
        """
        k, E = x.control.shape[2], self.across[:, i]
        weights, index = control_weights(x.t[:, :, i], self.closed[:, None, i], k)
        B, B1 = (spread(b, index, k) for b in weights[:2])
        X, X1 = ((b @ x.control[:, None, i]) for b in (B, B1))
        X, X1 = torch.cat((X, torch.ones_like(X[..., :1])), -1), torch.cat((X1, torch.zeros_like(X1[..., :1])), -1)
        first, M = seen.first[:, :, i], x.P[..., :3]
        HM = (H.flatten(2, 3) @ M).view(H.shape)
        MHM = (HM.mT.flatten(2, 3) @ M).view(H.shape)
        A = (H.flatten(-2).mT @ _products(X, X)).view(*H.shape[:2], 3, 3, 4, 4).transpose(3, 4).reshape(*H.shape[:2], 12, 12)
        both = HM[..., :, None, :] * X[..., None, :, None]
        G = B.flatten(1, 2).mT @ _products(B, MHM.flatten(-2)).flatten(1, 2)
        by_camera, pull = (by_image.mT @ X).flatten(-2), B.mT @ (by_image @ M)
        # The nearest point follows: how the derivative along the spline changes with the camera and with control points.
        turned = (H @ first[..., None])[..., 0]
        camera, control = _products(turned, X), _products(B, turned @ M)
        if exact:
            both = both + by_image[..., None, None] * torch.eye(4, 3, dtype=X.dtype, device=X.device)
            camera, control = camera + _products(by_image, X1), control + _products(B1, by_image @ M)
        moved = (moves[..., None] * camera).mT
        slope = (moves * (by_image * first).sum(-1))[..., None]
        cross = (both.flatten(-3).mT @ B).view(*H.shape[:2], 12, 3, k).transpose(-2, -1)
        cross = cross - (moved @ control).view(cross.shape)
        G = G.view(-1, k, k, 3, 3).transpose(2, 3)
        G = G - (control.flatten(1, 2).mT @ (moves[..., None] * control).flatten(1, 2)).view(G.shape)
        pull = (pull - (control.mT @ slope).view(pull.shape)).sum(1)
        # Control points move in some directions only.
        G = torch.einsum("pkalb,pkda,pleb->pkdle", G, E, E).flatten(3).flatten(1, 2)
        cross = torch.einsum("pvrka,pkea->pvrke", cross, E).flatten(-2).flatten(1, 2)
        by_camera = by_camera - (camera.mT @ slope)[..., 0]
        return A - moved @ camera, G, cross, by_camera, (E @ pull[..., None]).flatten(1)


def _products(a: Float[Tensor, "*b m"], b: Float[Tensor, "*b n"]) -> Float[Tensor, "*b mn"]:
    """All products of the numbers of a and b."""
    return (a[..., :, None] * b[..., None, :]).flatten(-2)


def held_directions(P: Float[Tensor, "p v 3 4"]) -> Float[Tensor, "p r h"]:
    """Orthonormal directions of cameras in which only the frame or scales change, zeros where there are fewer."""
    v = P.shape[1]
    basis = torch.eye(16, dtype=P.dtype, device=P.device).view(16, 4, 4)
    frames = (P[:, None] @ basis[:15, None]).flatten(2)
    scales = (torch.eye(v, dtype=P.dtype, device=P.device)[:, :, None, None] * P[:, None]).flatten(2)
    M = torch.nn.functional.normalize(torch.cat((frames, scales), 1), dim=-1)
    values, vectors, _ = eigh(M @ M.mT)
    root = torch.where(values > 1e-12 * values[:, -1:], values, torch.inf).sqrt()
    return M.mT @ (vectors / root[:, None])


def all_directions(control: Float[Tensor, "p c k 3"]) -> Float[Tensor, "p c k 3 3"]:
    """The three axes, for control points that may move anywhere."""
    return torch.eye(3, dtype=control.dtype, device=control.device).expand(*control.shape, 3)


def directions(control: Float[Tensor, "p c k 3"], closed: Bool[Tensor, "p c"]) -> Float[Tensor, "p c k 2 3"]:
    """Two directions across splines at control points."""
    along = torch.nn.functional.normalize(courses(control, closed), dim=-1)
    return torch.stack(across(along.movedim(-1, 0))).permute(2, 3, 4, 0, 1)


def sum_of(parts: Iterable[Tensor]) -> Tensor:
    """The sum of tensors of one shape."""
    return torch.stack(list(parts)).sum(0)


def approach_splines(problem: SplineDistances, x: Splines) -> tuple[SplineDistances, Splines]:
    """A few steps with weights by distances, and with what these say of the stiffness; control points move anywhere."""
    here = problem.linearize(x)
    problem = _anew(problem, here)
    weighed = replace(problem, weight=problem.weight * _trust(problem, here))
    return problem, descend(weighed, here.x, Options(_STEPS, 1e-10)).x


def fit_splines(problem: SplineDistances, x: Splines, steps: int, tolerance: float) -> Descent:
    """The least squares of what is near the splines."""
    here = problem.linearize(x)
    near = here.distance <= 2 * _TRUSTED * typical_distance(problem, here)[:, None, None, None]
    weight = problem.weight * near * problem.inside(here.x)
    problem = replace(_anew(problem, here), weight=weight, across=directions(here.x.control, problem.closed))
    return descend(problem, here.x, Options(steps, tolerance))


def _trust(problem: SplineDistances, here: SplineSystem) -> Float[Tensor, "p v c n"]:
    """Weights by distances."""
    typical = typical_distance(problem, here)[:, None, None, None]
    return (1 + (here.distance / (_TRUSTED * typical)).square()).reciprocal().square()


def _anew(problem: SplineDistances, here: SplineSystem) -> SplineDistances:
    """The stiffness by which what was measured is likeliest; and what is held from here on."""
    x, closed = here.x, problem.closed
    problem = replace(problem, across=all_directions(x.control), held=held_directions(x.P))
    alone = replace(problem, weight=problem.weight * _trust(problem, here), stiffness=torch.zeros_like(problem.stiffness))
    normal = alone.normal(x, here.seen, exact=False)
    variance = (1.4826 * typical_distance(problem, here)).square()
    number = ((problem.weight > 0) & problem.inside(x)).sum((1, 2, 3)).to(variance.dtype)
    cameras = 11 * x.P.shape[1] - 15
    D = third_differences(closed, x.control.shape[2])
    stiffness = likeliest_stiffness(normal.G, normal.by_control, D, x.control, variance, number, cameras)
    return replace(problem, stiffness=stiffness)


def typical_distance(problem: SplineDistances, here: SplineSystem) -> Float[Tensor, "p"]:
    """The median distance."""
    counts = (problem.weight > 0) & problem.inside(here.x)
    middle = torch.where(counts, here.distance, torch.nan).flatten(1).nanmedian(-1).values
    return middle.nan_to_num(1.0).clamp_min(1e-14)


def _damped(A: Tensor, size: Tensor, damping: Tensor) -> Tensor:
    """With the diagonal enlarged, and what nothing was measured of held."""
    least = 1e-12 * size.amax(-1, keepdim=True).clamp_min(1e-100)
    return A + torch.diag_embed(damping[..., None] * size + least)
