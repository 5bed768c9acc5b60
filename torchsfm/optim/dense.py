"""The linear algebra of thousands of small problems: normal equations as dense matrices, one for each element of a batch."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.optim.loss import Loss, loss_slope
from torchsfm.optim.problem import Step
from torchsfm.optim.pytree import Places, leaves, norm, pick, places, put

Linearize = Callable[..., tuple[Tensor, Tensor]]
FEW = 1 << 15
"""Numbers, of variables and data in the copies that this takes, for which all columns of a Jacobian are found at once, as calls
cost more than arithmetic on so few."""
FEW_BENT = 1 << 14
"""The same of a Hessian's rows, where a call goes through two derivatives: numbers of residuals, in the copies, which tell its
work better, since covariances among the data are many numbers of which each is hardly used."""


@dataclass(frozen=True)
class DenseSystem:
    """Normal equations in float64, their damping scaled by the diagonal of the Gauss-Newton matrix (Marquardt 1963)."""

    x: Any
    cost: Float[Tensor, "*batch"]
    gradient: Float[Tensor, "*batch k"]
    metric: Float[Tensor, "*batch k k"]
    """The Gauss-Newton matrix, by which steps are measured."""
    hessian: Float[Tensor, "*batch k k"]
    """The exact Hessian where that was wanted."""
    slope: Float[Tensor, "*batch"]
    """The largest absolute derivative, NaN where anything is not finite."""

    def steepest(self) -> Tensor:
        """The largest absolute derivative."""
        return self.slope

    def along(self, delta: Tensor) -> Tensor:
        """The derivative of the cost along a step."""
        return (self.gradient * delta).sum(-1)

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step for a damping."""
        diagonal = self.metric.diagonal(dim1=-2, dim2=-1)
        # A direction that nothing depends on is damped all the same, and so does not move; others each in their own unit.
        floor = 1e-30 * diagonal.amax(-1, keepdim=True) + torch.finfo(diagonal.dtype).tiny
        damped = damping[..., None] * diagonal.clamp_min(floor)
        matrix = self.metric if exact is None else torch.where(exact[..., None, None], self.hessian, self.metric)
        factor, info = torch.linalg.cholesky_ex(matrix + torch.diag_embed(damped))
        solved = info == 0
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        factor = torch.where(solved[..., None, None], factor, eye)
        delta = -torch.cholesky_solve(self.gradient[..., None], factor)[..., 0]
        solved = solved & delta.isfinite().all(-1)
        delta = torch.where(solved[..., None], delta, torch.zeros_like(delta))
        promise = torch.where(solved, (delta * (damped * delta - self.gradient)).sum(-1) / 2, torch.inf)
        none = torch.zeros_like(solved)
        return Step(delta, promise, solved, none, none)


def dense_system(x: Any, cost: Tensor, gradient: Tensor, metric: Tensor) -> DenseSystem:
    """The system of a place, from its cost, gradient and Gauss-Newton matrix."""
    # No entry of a matrix of products exceeds its trace.
    finite = (metric.diagonal(dim1=-2, dim2=-1).sum(-1) + cost).isfinite()
    return DenseSystem(x, cost, gradient, metric, metric, torch.where(finite, gradient.abs().amax(-1), torch.nan))


def passable(there: DenseSystem) -> DenseSystem:
    """A system to which steps may lead: where anything in it is not finite, the cost is not either."""
    return replace(there, cost=torch.where(there.slope < torch.inf, there.cost, torch.inf))


@dataclass(frozen=True)
class DenseProblem:
    """Residuals as a function, derivatives by automatic differentiation unless they are written."""

    residual: Callable[..., Tensor]
    retract: Callable[[Any, Tensor], Any]
    tangent: int
    loss: Loss | None
    written: Linearize | None
    epsilon: float
    data: Any
    weights: Tensor | None
    size: Tensor
    """What the cost would be if residuals were as large as data are."""
    enough: Tensor
    """Where there are as many residuals as parameters."""
    numbers: int
    """Numbers in the residuals of one problem."""
    local_cost: Callable[..., Tensor] | None = None
    """What has the first and second derivatives of the cost, where they take less than those of the residuals."""
    patience: int | None = 0

    def over(self, change: Callable[[Any], Any]) -> "DenseProblem":
        """The problems with another batch, given what makes it of this one."""
        data, weights, size, enough = change((self.data, self.weights, self.size, self.enough))
        return replace(self, data=data, weights=weights, size=size, enough=enough)

    def pick(self, at: Places) -> "DenseProblem":
        """The problems at some places."""
        return self.over(partial(pick, at))

    def cost(self, x: Any) -> Tensor:
        """`sum w rho / 2`, (batch)."""
        residual = self.residual(x, *self.data)
        if self.weights is not None:
            # Left out means left out: a NaN there must not come through.
            residual = torch.where((self.weights > 0)[..., None], residual, 0.0)
        square = residual.square().sum(-1).double()
        rho = square if self.loss is None else self.loss(square)
        if self.weights is not None:
            rho = torch.where(self.weights > 0, rho * self.weights, 0.0)
        return rho.sum(-1) / 2

    def linearize(self, x: Any) -> DenseSystem:
        """Cost, gradient and Gauss-Newton matrix."""
        r, jacobian = self.written(x, *self.data) if self.written is not None else self._differentiate(x)
        r, jacobian = r.double(), jacobian.double()
        square = r.square().sum(-1)
        scale = torch.ones_like(square) if self.loss is None else loss_slope(self.loss, square)
        rho = square if self.loss is None else self.loss(square)
        if self.weights is not None:
            counts = self.weights > 0
            rho = torch.where(counts, rho * self.weights, 0.0)
            scale = torch.where(counts, scale * self.weights, 0.0)
            r = torch.where(counts[..., None], r, 0.0)
            jacobian = torch.where(counts[..., None, None], jacobian, 0.0)
        flat = jacobian.flatten(1, 2)
        weighted = (scale[..., None, None] * jacobian).flatten(1, 2)
        gradient = (weighted * r.flatten(1)[..., None]).sum(1)
        return dense_system(x, rho.sum(-1) / 2, gradient, weighted.mT @ flat)

    def _differentiate(self, x: Any) -> tuple[Tensor, Tensor]:
        """Residual and Jacobian, column by column.

        The pullback is linear in what it pulls back, so its own pullbacks are the columns of the Jacobian. Forward mode would
        do the same, but loading it takes PyTorch seconds.
        """
        some, t = self, self.tangent
        if few := t * sum(v.numel() for v in leaves((x, self.data))) <= FEW:
            # Each problem stands there once for each column, so that one derivative gives them all.
            first = leaves(x)[0]
            copies = (torch.arange(len(first), device=first.device).repeat_interleave(t),)
            some, x = self.pick(copies), pick(copies, x)
        with torch.enable_grad():
            delta = leaves(x)[0].new_zeros((len(leaves(x)[0]), t)).requires_grad_()
            value = some.residual(some.retract(x, delta), *some.data)
            seed = torch.zeros_like(value).requires_grad_()
            (pulled,) = torch.autograd.grad(value, delta, seed, create_graph=True, materialize_grads=True)
            if few:
                own = pulled.view(len(first), t, t).diagonal(dim1=1, dim2=2).sum()
                (column,) = torch.autograd.grad(own, seed, materialize_grads=True)
                return value.detach()[::t], column.view(len(first), t, *column.shape[1:]).movedim(1, -1)
            ones = torch.ones_like(pulled[:, 0])
            columns = [
                torch.autograd.grad(pulled[:, i], seed, ones, retain_graph=True, materialize_grads=True)[0] for i in range(t)
            ]
        return value.detach(), torch.stack(columns, -1)

    def advance(self, here: DenseSystem, step: Step) -> DenseSystem:
        """The system where a step leads."""
        return passable(self.linearize(self.retract(here.x, step.delta.to(leaves(here.x)[0].dtype))))

    def curve(self, here: DenseSystem, where: Tensor) -> DenseSystem:
        """The exact second derivatives of the cost in some elements; not always positive."""
        (at,) = places(where)
        t = self.tangent
        # Few problems stand there once for each row of their Hessians, so that one derivative gives them all.
        together = t if t * len(at) * self.numbers <= FEW_BENT else 1
        copies = (at.repeat_interleave(together),)
        some, x = self.pick(copies), pick(copies, here.x)
        first, rows = leaves(x)[0], []
        with torch.enable_grad():
            delta = first.new_zeros((len(first), t)).requires_grad_()
            moved = self.retract(x, delta)
            cost = (some.cost(moved) if self.local_cost is None else self.local_cost(moved, *some.data)).sum()
            (slope,) = torch.autograd.grad(cost, delta, create_graph=True, materialize_grads=True)
            slope = slope.view(len(at), together, t)
            for i in range(0, t, together):
                along, row = slope[..., i : i + together].diagonal(dim1=1, dim2=2).sum(), torch.zeros_like(delta)
                if along.requires_grad:
                    (row,) = torch.autograd.grad(along, delta, retain_graph=i + together < t, materialize_grads=True)
                rows.append(row.view(len(at), together, t))
        return replace(here, hessian=put((at,), here.hessian, torch.cat(rows, 1).double()))

    def rounding(self, here: DenseSystem) -> Tensor:
        """What rounding of the parameters or of the data makes of the cost, whichever is less."""
        moved = here.metric.diagonal(dim1=-2, dim2=-1).sum(-1) * norm(here.x).square() / 2
        return (10 * self.epsilon) ** 2 * torch.minimum(moved, self.size).nan_to_num(posinf=0.0)

    def is_short(self, here: DenseSystem, delta: Tensor, tolerance: float) -> Tensor:
        """Where a step is shorter than a fraction of the parameters' length."""
        return norm(delta) <= tolerance * (norm(here.x) + tolerance)


def dense_problem(
    residual: Callable[..., Tensor],
    retract: Callable[[Any, Tensor], Any],
    tangent: int,
    loss: Loss | None,
    written: Linearize | None,
    x: Any,
    data: Any,
    weights: Tensor | None,
    shape: tuple[int, ...],
    local_cost: Callable[..., Tensor] | None = None,
) -> DenseProblem:
    """The problems of data and weights in one batch dimension, whose residuals at x are of a shape (n, d)."""
    first = leaves(x)[0]
    number = torch.full(first.shape[:1], shape[0], dtype=torch.float64, device=first.device)
    enough = (number if weights is None else (weights > 0).sum(-1)) * shape[1] >= tangent
    numbers = [d[..., None].flatten(1).double() for d in leaves(data) if d.is_floating_point() and d.numel()]
    squares = [torch.where(d.isfinite(), d, 0.0).square().mean(1) for d in numbers]
    size = (number if weights is None else weights.double().sum(-1)) * sum(squares, torch.zeros_like(number)) / 2
    epsilon = torch.finfo(first.dtype).eps
    every = (loss, written, epsilon, data, weights, size, enough, shape[0] * shape[1], local_cost)
    return DenseProblem(residual, retract, tangent, *every)
