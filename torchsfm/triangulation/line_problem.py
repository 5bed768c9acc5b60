"""The least squares of lines in their charts, as problems for `descend`.

A shift of the line moves the foot of an end across the line's image as it moves the image of the axis shifted along, over the
depth; a turn does so by the end's place on the line. So the four derivatives of a residual are the products of two numbers of
the end (`Images.scale`, `Images.moved`) with two of the view, and the normal matrix of a view is a product of two 2x2 matrices.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.rows import add_rows, combine_rows, take_columns
from torchsfm.optim import Loss, loss_slope
from torchsfm.optim.batched_cholesky import backward, factor, forward, place
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, pick, places, put
from torchsfm.triangulation.line_chart import Images, Parameters, images

UPPER = [(i, j) for i in range(4) for j in range(i, 4)]
"""Entries of a symmetric matrix, row by row."""
_DIAGONAL = [UPPER.index((i, i)) for i in range(4)]
Rows = tuple[Tensor, ...]


@dataclass(frozen=True)
class LineSystem:
    """Normal equations, every number of them a tensor (n)."""

    x: Parameters
    cost: Float[Tensor, "n"]
    gradient: Rows
    metric: Rows
    """The Gauss-Newton matrix, as `UPPER` has it,"""
    hessian: Rows
    """and the exact one where that was wanted."""
    slope: Float[Tensor, "n"]

    def steepest(self) -> Tensor:
        """The largest absolute derivative, NaN where anything is not finite."""
        return self.slope

    def along(self, delta: Rows) -> Tensor:
        """The derivative of the cost along a step."""
        return combine_rows(self.gradient, delta)

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step for a damping relative to the diagonal."""
        diagonal = [self.metric[i] for i in _DIAGONAL]
        top = torch.maximum(torch.maximum(diagonal[0], diagonal[1]), torch.maximum(diagonal[2], diagonal[3]))
        least = torch.finfo(top.dtype).tiny + 1e-30 * top
        damped = [damping * torch.maximum(entry, least) for entry in diagonal]
        matrix = self.metric
        if exact is not None:
            matrix = tuple(torch.where(exact, h, m) for h, m in zip(self.hessian, matrix, strict=True))
        V = blocks(matrix, self.gradient)
        for i, more in enumerate(damped):
            V[place(i, i, 4)] = V[place(i, i, 4)] + more
        L, solved = factor(V, 4)
        found = backward(L, forward(L, torch.stack(self.gradient))).neg()
        total = add_rows(found)
        solved = solved & total.isfinite()
        delta = tuple((found if bool(solved.all()) else torch.where(solved, found, 0.0)).unbind(0))
        promise = combine_rows(delta, [m * d - g for m, d, g in zip(damped, delta, self.gradient, strict=True)]) / 2
        none = torch.zeros_like(solved)
        return Step(delta, torch.where(solved, promise, torch.inf), solved, none, none)


@dataclass(frozen=True)
class LineProblem(Problem[LineSystem]):
    """Ends of segments in views of lines, each line with a chart of its own."""

    cameras: Float[Tensor, "4 3 v n"]
    """In the charts."""
    ends: Float[Tensor, "2 2 v n"]
    w: Float[Tensor, "v n"]
    used: Float[Tensor, "v n"]
    """1 for views that count, 0 for others."""
    loss: Loss | None

    @property
    def patience(self) -> int | None:
        """Newton steps are taken as soon as others are slow."""
        return 0

    def images(self, x: Parameters) -> tuple[Images, Tensor, Tensor]:
        """The lines in their views, and the images (3, v, n) of their points (a, b, 0) and of their directions."""
        u, v, d, origin = self.cameras.unbind(0)
        a = torch.addcmul(torch.addcmul(origin, u, x[0]), v, x[1])
        c = torch.addcmul(torch.addcmul(d, u, x[2]), v, x[3])
        return images(a, c, self.ends, self.used), a, c

    def normal_matrix(self, found: Images, weight: Tensor) -> tuple[Rows, Tensor]:
        """The Gauss-Newton matrix for weights (v, n) of squares, and the slopes (2, v, n) of image lines along u and v."""
        g = [combine_rows(found.line, axis) for axis in self.cameras[:2].unbind(0)]
        weighted = torch.stack((weight * g[0], weight * g[1]))
        ends, view = (torch.empty_like(self.cameras[0]) for _ in range(2))
        for row, (p, q) in enumerate(((found.scale, found.scale), (found.scale, found.moved), (found.moved, found.moved))):
            _sum(p, q, out=ends[row])
        for row, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            torch.mul(weighted[i], g[j], out=view[row])
        (s11, s12, s22), (m11, m12, m22), (t11, t12, t22) = (row.unbind(0) for row in _products(ends, view).unbind(0))
        return (s11, s12, m11, m12, s22, m12, m22, t11, t12, t22), weighted

    def linearize(self, x: Parameters) -> LineSystem:
        """Cost, gradient and Gauss-Newton matrix."""
        found, _, _ = self.images(x)
        square = _sum(found.r, found.r)
        rho, weight = square, self.w
        if self.loss is not None:
            rho, weight = self.loss(square), self.w * loss_slope(self.loss, square)
        cost = combine_rows(rho, self.w) / 2
        metric, g = self.normal_matrix(found, weight)
        pulled = torch.empty_like(found.r)
        _sum(found.scale, found.r, out=pulled[0])
        _sum(found.moved, found.r, out=pulled[1])
        gradient = _products(pulled, g).flatten(0, 1).neg_()
        # No entry of a matrix of products exceeds its trace.
        finite = (add_rows([metric[i] for i in _DIAGONAL]) + cost).isfinite()
        slope = gradient.abs().amax(0)
        if not bool(finite.all()):
            slope = torch.where(finite, slope, torch.nan)
        return LineSystem(x, cost, gradient.unbind(0), metric, metric, slope)

    def advance(self, here: LineSystem, step: Step) -> LineSystem:
        """The system where a step leads."""
        x: Parameters = tuple(a + d for a, d in zip(here.x, step.delta, strict=True))
        there = self.linearize(x)
        return replace(there, cost=torch.where(there.slope < torch.inf, there.cost, torch.inf))

    def curve(self, here: LineSystem, where: Tensor) -> LineSystem:
        """The exact second derivatives of the cost in some elements, by automatic differentiation.

        By views and coordinates one by one: what broadcasting adds up, derivatives would in an order that depends on the batch.
        """
        at = places(where)
        some = self.pick(at)
        with torch.enable_grad():
            x = [row.expand(some.w.shape).detach().requires_grad_() for row in pick(at, here.x)]
            rows = list(some.cameras.unbind(1))
            a = tuple(torch.addcmul(torch.addcmul(origin, u, x[0]), v, x[1]) for u, v, _, origin in rows)
            c = tuple(torch.addcmul(torch.addcmul(d, u, x[2]), v, x[3]) for u, v, d, _ in rows)
            found = images(a, c, some.ends, some.used)
            square = _sum(found.r, found.r)
            cost = some.w * (square if self.loss is None else self.loss(square)) / 2
            slopes = torch.autograd.grad(cost.sum(), x, create_graph=True, materialize_grads=True)
            second = [torch.autograd.grad(s.sum(), x, retain_graph=True, materialize_grads=True) for s in slopes]
        return replace(here, hessian=put(at, here.hessian, tuple(add_rows(second[i][j]) for i, j in UPPER)))

    def rounding(self, here: LineSystem) -> Tensor:
        """What rounding of lines, whose charts have the size 1, makes of the cost."""
        return (10 * self.epsilon) ** 2 / 2 * add_rows([here.metric[i] for i in _DIAGONAL]).nan_to_num(posinf=0.0)

    def is_short(self, here: LineSystem, delta: Rows, tolerance: float) -> Tensor:
        """Where a step is shorter than a fraction of the size of a chart and of the parameters."""
        return combine_rows(delta, delta).sqrt() <= tolerance * (1 + combine_rows(here.x, here.x).sqrt())

    def pick(self, at: Places) -> "LineProblem":
        """The problems of some lines."""
        cameras, ends, w, used = (take_columns(t, at[0]) for t in (self.cameras, self.ends, self.w, self.used))
        return replace(self, cameras=cameras, ends=ends, w=w, used=used)


def blocks(matrix: Rows, right: Rows) -> list[Tensor]:
    """Symmetric matrices and right-hand sides as `batched_cholesky` wants them."""
    rows = iter(matrix)
    return [entry for i in range(4) for entry in (*(next(rows) for _ in range(i, 4)), right[i])]


def _sum(a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """Products (2, v, n) of the two ends added (v, n)."""
    return torch.mul(a[0], b[0], out=out).addcmul_(a[1], b[1])


def _products(a: Tensor, b: Tensor) -> Tensor:
    """All products of rows (i, v, n) and (j, v, n), added over the views (i, j, n)."""
    total = a[:, None, 0] * b[None, :, 0]
    for view in range(1, a.shape[1]):
        total.addcmul_(a[:, None, view], b[None, :, view])
    return total
