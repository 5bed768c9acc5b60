"""Levenberg-Marquardt for thousands of small dense least-squares problems at once.

Minimises `sum_i w_i rho(|r_i(x)|^2) / 2` over `x` for every element of a batch. Each problem has its own damping, its own
accepted and rejected steps and its own end; a finished problem leaves the batch. The damping follows the trust-region rule of
Nielsen (1999; Madsen, Nielsen & Tingleff 2004, 3.2), scaled by the diagonal of the normal equations (Marquardt 1963).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, tensor_map
from torchsfm.optim.implicit import attach_optimum, wants_derivative
from torchsfm.optim.loss import Loss, loss_slope

M = TypeVar("M")
Linearize = Callable[..., tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class LeastSquaresResult(Generic[M]):
    """The minima of a batch of least-squares problems.

    `x` is what the parameters came as. `cost` and `initial_cost` are `sum w rho / 2`; `iterations` counts linear solves.
    `status` is `Status.OK` where a tolerance was met or no step lowers the cost any more, `NOT_CONVERGED` where the iteration
    limit came first. It is `TOO_FEW` where there are fewer residuals than parameters and `NOT_FINITE` where the cost or its
    slope at the start is not finite: there `x` is the start, and a cost that is not a number is inf.
    """

    x: M
    cost: Float[Tensor, "*batch"]
    initial_cost: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def levenberg_marquardt(
    residual: Callable[..., Tensor],
    x0: M,
    *data: Any,
    retract: Callable[[M, Tensor], M] | None = None,
    size: int | None = None,
    weights: Float[Tensor, "*#batch n"] | Bool[Tensor, "*#batch n"] | None = None,
    loss: Loss | None = None,
    linearize: Linearize | None = None,
    max_iterations: int = 50,
    function_tolerance: float = 1e-10,
    step_tolerance: float = 1e-10,
    initial_damping: float = 1e-4,
) -> LeastSquaresResult[M]:
    """Minimise many small nonlinear least-squares problems, all in one batch.

    The Jacobian comes from automatic differentiation of `residual` along the tangent directions, or from `linearize`. Where
    `data` or `weights` require a gradient the minimum carries its derivative with respect to them, by the implicit function
    theorem with the exact Hessian; otherwise nothing is spent on it.

    Args:
        residual: `residual(x, *data) -> (*batch, n, d)`: n residuals of d components each, for any number of batch dimensions
            in front of everything; each problem must depend on its own element alone.
        x0: The start, a tensor `(*batch, k)` or nested dataclasses of tensors that all have the batch dimensions in front.
        *data: Tensors, or dataclasses of tensors, with the batch dimensions in front, of size 1 where shared. Anything else
            is handed through.
        retract: `retract(x, delta) -> x` moves `x` by tangent steps `(b, size)`; addition if not given.
        size: Number of tangent directions; the last dimension of `x0` if not given.
        weights: Weight of each of the n residuals' squared norms; 0 or False leaves it out, whatever number it has, NaN too.
        loss: `rho(s)` of squared norms, see `torchsfm.optim.loss`; `s` if not given.
        linearize: `linearize(x, *data) -> (residual (b, n, d), jacobian (b, n, d, size))`, where a hand-written one pays.
        max_iterations: Most linear solves per problem.
        function_tolerance: A problem is done when a step lowers, or promises to lower, its cost by less than this fraction.
        step_tolerance: A problem is done when the step is shorter than this fraction of `|x|`.
        initial_damping: Damping relative to the diagonal of the normal equations, at the start.

    Returns:
        The minima, costs, iterations and a status per element.

    Raises:
        ValueError: `residual` does not return `(*batch, n, d)`, or `size` is missing for parameters that are not one tensor.
    """
    move = retract if retract is not None else _add
    if size is None:
        if not isinstance(x0, Tensor):
            raise ValueError("size: wanted the number of tangent directions, since x0 is not one tensor")
        size = x0.shape[-1]
    leaves = _leaves((data, weights))
    with torch.no_grad():
        batch = _batch_shape(residual, x0, data)
        flat_x = _flatten(tensor_map(torch.Tensor.detach, x0), batch)
        flat_data = _flatten(tensor_map(torch.Tensor.detach, data), batch)
        flat_weights = None if weights is None else _flatten(weights.detach(), batch)
        problem = _Problem(residual, move, size, loss, linearize)
        result = _minimise(
            problem, flat_x, flat_data, flat_weights, max_iterations, function_tolerance, step_tolerance, initial_damping
        )
    x = result.x
    if wants_derivative(*leaves):
        good = (result.status == Status.OK) | (result.status == Status.NOT_CONVERGED)
        x = _attach(problem, x, _flatten(data, batch), None if weights is None else _flatten(weights, batch), good)
    return LeastSquaresResult(
        tensor_map(lambda v: v.reshape(batch + v.shape[1:]), x),
        *(v.reshape(batch) for v in (result.cost, result.initial_cost, result.iterations, result.status)),
    )


@dataclass(frozen=True)
class _Problem:
    residual: Callable[..., Tensor]
    retract: Callable[[Any, Tensor], Any]
    size: int
    loss: Loss | None
    linearize: Linearize | None

    def cost(self, x: Any, data: Any, weights: Tensor | None) -> Tensor:
        square = self.residual(x, *data).square().sum(-1).double()
        rho = square if self.loss is None else self.loss(square)
        if weights is not None:
            # Left out means left out: a NaN there must not come through.
            rho = torch.where(weights > 0, rho * weights, 0.0)
        return rho.sum(-1) / 2

    def normal_equations(self, x: Any, data: Any, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, gradient and Gauss-Newton matrix, in float64."""
        r, jacobian = self.linearize(x, *data) if self.linearize is not None else self._differentiate(x, data)
        r, jacobian = r.double(), jacobian.double()
        square = r.square().sum(-1)
        scale = torch.ones_like(square) if self.loss is None else loss_slope(self.loss, square)
        rho = square if self.loss is None else self.loss(square)
        if weights is not None:
            counts = weights > 0
            rho = torch.where(counts, rho * weights, 0.0)
            scale = torch.where(counts, scale * weights, 0.0)
            r = torch.where(counts[..., None], r, 0.0)
            jacobian = torch.where(counts[..., None, None], jacobian, 0.0)
        flat = jacobian.flatten(1, 2)
        weighted = (scale[..., None, None] * jacobian).flatten(1, 2)
        gradient = (weighted * r.flatten(1)[..., None]).sum(1)
        return rho.sum(-1) / 2, gradient, weighted.mT @ flat

    def _differentiate(self, x: Any, data: Any) -> tuple[Tensor, Tensor]:
        """Residual and Jacobian, column by column.

        The pullback is linear in what it pulls back, so its own pullbacks are the columns of the Jacobian. Forward mode would
        do the same, but loading it takes PyTorch seconds.
        """
        first = _leaves(x)[0]
        with torch.enable_grad():
            delta = first.new_zeros((first.shape[0], self.size)).requires_grad_()
            value = self.residual(self.retract(x, delta), *data)
            seed = torch.zeros_like(value).requires_grad_()
            (pulled,) = torch.autograd.grad(value, delta, seed, create_graph=True, materialize_grads=True)
            ones = torch.ones_like(pulled[:, 0])
            columns = [
                torch.autograd.grad(pulled[:, i], seed, ones, retain_graph=True, materialize_grads=True)[0]
                for i in range(self.size)
            ]
        return value.detach(), torch.stack(columns, -1)


@dataclass
class _State:
    """The problems still under way, with their places in the batch."""

    index: Tensor
    x: Any
    data: Any
    weights: Tensor | None
    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    damping: Tensor
    growth: Tensor

    def keep(self, active: Tensor) -> "_State":
        where = active.nonzero()[:, 0]
        return tensor_map(lambda v: v.index_select(0, where), self)


def _minimise(
    problem: _Problem,
    x: Any,
    data: Any,
    weights: Tensor | None,
    max_iterations: int,
    function_tolerance: float,
    step_tolerance: float,
    initial_damping: float,
) -> LeastSquaresResult[Any]:
    cost, gradient, hessian = problem.normal_equations(x, data, weights)
    count = cost.shape[0]
    iterations = torch.zeros(count, dtype=torch.int32, device=cost.device)
    status = torch.full((count,), int(Status.NOT_CONVERGED), dtype=torch.int8, device=cost.device)
    status[~(cost.isfinite() & gradient.isfinite().all(-1) & hessian.isfinite().all(-1).all(-1))] = int(Status.NOT_FINITE)
    status[_too_few(problem, x, data, weights)] = int(Status.TOO_FEW)
    best, best_cost, initial = x, cost, cost
    ones = torch.ones_like(cost)
    index = torch.arange(count, device=cost.device)
    state = _State(index, x, data, weights, cost, gradient, hessian, initial_damping * ones, 2 * ones)
    active = status == Status.NOT_CONVERGED
    if not active.all():
        state, active = state.keep(active), active[active]
    for _ in range(max_iterations):
        if state.index.numel() == 0:
            break
        step, promise, solved = _solve(state)
        trial = problem.retract(state.x, step.to(_leaves(state.x)[0].dtype))
        cost, gradient, hessian = problem.normal_equations(trial, state.data, state.weights)
        ratio = (state.cost - cost) / promise.clamp_min(torch.finfo(cost.dtype).tiny)
        usable = solved & cost.isfinite() & gradient.isfinite().all(-1) & hessian.isfinite().all(-1).all(-1)
        # Below the rounding error of the cost a step is taken on the promise: the last one brings x, not the cost, to its end.
        noise = 1e-14 * state.cost
        rounding = (promise <= 100 * noise) & (cost - state.cost <= noise)
        accepted = usable & (((cost <= state.cost) & (ratio > 1e-4)) | rounding)
        small = solved & (promise <= function_tolerance * state.cost)
        small |= accepted & ~rounding & (state.cost - cost <= function_tolerance * state.cost)
        small |= solved & (_norm(step) <= step_tolerance * (_norm(state.x) + step_tolerance))
        shrink = (1 - (2 * ratio.clamp(0, 1) - 1) ** 3).clamp_min(1 / 3)
        damping = torch.where(accepted, state.damping * shrink, state.damping * state.growth).clamp_min(1e-16)
        growth = torch.where(accepted, 2 * torch.ones_like(damping), 2 * state.growth)
        iterations[state.index] += active.int()
        accepted = accepted & active
        state = _State(
            state.index,
            _select(accepted, trial, state.x),
            state.data,
            state.weights,
            torch.where(accepted, cost, state.cost),
            torch.where(accepted[:, None], gradient, state.gradient),
            torch.where(accepted[:, None, None], hessian, state.hessian),
            damping,
            growth,
        )
        done = active & (small | (damping > 1e16))
        status[state.index[done]] = int(Status.OK)
        active = active & ~done
        if 2 * active.sum() <= active.numel():
            best, best_cost = _put(best, state.index, state.x), best_cost.index_copy(0, state.index, state.cost)
            state, active = state.keep(active), active[active]
    best, best_cost = _put(best, state.index, state.x), best_cost.index_copy(0, state.index, state.cost)
    return LeastSquaresResult(best, best_cost.nan_to_num(nan=torch.inf), initial.nan_to_num(nan=torch.inf), iterations, status)


def _solve(state: _State) -> tuple[Tensor, Tensor, Tensor]:
    """The damped step, the decrease the linear model promises, and where the system could be solved."""
    diagonal = state.hessian.diagonal(dim1=-2, dim2=-1)
    # A direction that nothing depends on gets the damping of the others, and so does not move.
    floor = 1e-9 * diagonal.amax(-1, keepdim=True) + torch.finfo(diagonal.dtype).tiny
    damped = state.damping[:, None] * diagonal.clamp_min(floor)
    factor, info = torch.linalg.cholesky_ex(state.hessian + torch.diag_embed(damped))
    solved = info == 0
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    factor = torch.where(solved[:, None, None], factor, eye)
    step = -torch.cholesky_solve(state.gradient[..., None], factor)[..., 0]
    solved = solved & step.isfinite().all(-1)
    step = torch.where(solved[:, None], step, torch.zeros_like(step))
    promise = (step * (damped * step - state.gradient)).sum(-1) / 2
    return step, promise, solved


def _too_few(problem: _Problem, x: Any, data: Any, weights: Tensor | None) -> Tensor:
    count, components = problem.residual(x, *data).shape[-2:]
    first = _leaves(x)[0]
    if weights is None:
        return torch.full(first.shape[:1], count * components < problem.size, device=first.device)
    return (weights > 0).sum(-1) * components < problem.size


def _attach(problem: _Problem, x: Any, data: Any, weights: Tensor | None, good: Tensor) -> Any:
    """The minimum with its derivatives with respect to all tensors in data and weights."""
    followed = _leaves((data, weights))
    first = _leaves(x)[0]
    zero = first.new_zeros((first.shape[0], problem.size))

    def objective(delta: Tensor, *tensors: Tensor) -> Tensor:
        replaced = iter(tensors)
        new_data, new_weights = tensor_map(lambda _: next(replaced), (data, weights))
        return problem.cost(problem.retract(x, delta), new_data, new_weights)

    delta = attach_optimum(objective, zero, *followed, valid=good)
    moved = iter(_leaves(problem.retract(x, delta)))
    # The value stays what it was, bit for bit.
    return tensor_map(lambda v: v + (m := next(moved)) - m.detach(), x)


def _batch_shape(residual: Callable[..., Tensor], x0: Any, data: Any) -> torch.Size:
    first = _leaves(x0)[0].shape
    shape = residual(x0, *data).shape
    batch = shape[:-2]
    if len(shape) < 2 or first[: len(batch)] != batch or (isinstance(x0, Tensor) and len(first) != len(batch) + 1):
        raise ValueError(f"residual: wanted (*batch, n, d), the batch in front of x0 {tuple(first)}, got {tuple(shape)}")
    return batch


def _flatten(tree: Any, batch: torch.Size) -> Any:
    """One batch dimension in front of every tensor."""

    def one(v: Tensor) -> Tensor:
        rest = v.shape[len(batch) :]
        if len(batch) == 1:
            return v.expand(batch + rest)
        return v.expand(batch + rest).reshape(batch.numel(), *rest) if batch else v[None]

    return tensor_map(one, tree)


def _leaves(tree: Any) -> list[Tensor]:
    found: list[Tensor] = []

    def collect(v: Tensor) -> Tensor:
        found.append(v)
        return v

    tensor_map(collect, tree)
    return found


def _select(mask: Tensor, a: Any, b: Any) -> Any:
    other = iter(_leaves(b))
    return tensor_map(lambda v: torch.where(mask.reshape(-1, *([1] * (v.ndim - 1))), v, next(other)), a)


def _put(tree: Any, index: Tensor, values: Any) -> Any:
    new = iter(_leaves(values))
    return tensor_map(lambda v: v.index_copy(0, index, next(new)), tree)


def _norm(tree: Any) -> Tensor:
    return torch.stack([v.double().flatten(1).square().sum(-1) for v in _leaves(tree)]).sum(0).sqrt()


def _add(x: Any, delta: Tensor) -> Any:
    return x + delta
