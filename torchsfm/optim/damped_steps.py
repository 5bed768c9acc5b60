"""Damped Gauss-Newton steps for a batch of small problems, each with its own damping, rejections and end.

The damping follows the trust-region rule of Nielsen (1999; Madsen, Nielsen & Tingleff 2004, 3.2), scaled by the diagonal of the
normal equations (Marquardt 1963).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsfm._types import Status, tensor_map
from torchsfm.optim.dense_problem import DenseProblem
from torchsfm.optim.trees import leaves, norm, put, select


@dataclass(frozen=True)
class Options:
    """When to stop, and where the damping starts."""

    max_iterations: int
    function_tolerance: float
    step_tolerance: float
    initial_damping: float


class Found(NamedTuple):
    """Minima, costs, iterations and statuses of a flat batch, as in `LeastSquaresResult`."""

    x: Any
    cost: Tensor
    initial_cost: Tensor
    iterations: Tensor
    status: Tensor


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


def minimise(problem: DenseProblem, x: Any, data: Any, weights: Tensor | None, options: Options) -> Found:
    """Minimise every problem of a batch; finished ones leave it when they are half of those under way."""
    cost, gradient, hessian = problem.normal_equations(x, data, weights)
    count = cost.shape[0]
    iterations = torch.zeros(count, dtype=torch.int32, device=cost.device)
    status = torch.full((count,), int(Status.NOT_CONVERGED), dtype=torch.int8, device=cost.device)
    status[~(cost.isfinite() & gradient.isfinite().all(-1) & hessian.isfinite().all(-1).all(-1))] = int(Status.NOT_FINITE)
    status[problem.too_few(x, data, weights)] = int(Status.TOO_FEW)
    best, best_cost, initial = x, cost, cost
    ones = torch.ones_like(cost)
    index = torch.arange(count, device=cost.device)
    state = _State(index, x, data, weights, cost, gradient, hessian, options.initial_damping * ones, 2 * ones)
    active = status == Status.NOT_CONVERGED
    if not active.all():
        state, active = state.keep(active), active[active]
    for _ in range(options.max_iterations):
        if state.index.numel() == 0:
            break
        step, promise, solved = _solve(state)
        trial = problem.retract(state.x, step.to(leaves(state.x)[0].dtype))
        cost, gradient, hessian = problem.normal_equations(trial, state.data, state.weights)
        ratio = (state.cost - cost) / promise.clamp_min(torch.finfo(cost.dtype).tiny)
        usable = solved & cost.isfinite() & gradient.isfinite().all(-1) & hessian.isfinite().all(-1).all(-1)
        # Below the rounding error of the cost a step is taken on the promise: the last one brings x, not the cost, to its end.
        noise = 1e-14 * state.cost
        rounding = (promise <= 100 * noise) & (cost - state.cost <= noise)
        accepted = usable & (((cost <= state.cost) & (ratio > 1e-4)) | rounding)
        small = solved & (promise <= options.function_tolerance * state.cost)
        small |= accepted & ~rounding & (state.cost - cost <= options.function_tolerance * state.cost)
        small |= solved & (norm(step) <= options.step_tolerance * (norm(state.x) + options.step_tolerance))
        shrink = (1 - (2 * ratio.clamp(0, 1) - 1) ** 3).clamp_min(1 / 3)
        damping = torch.where(accepted, state.damping * shrink, state.damping * state.growth).clamp_min(1e-16)
        growth = torch.where(accepted, 2 * torch.ones_like(damping), 2 * state.growth)
        iterations[state.index] += active.int()
        accepted = accepted & active
        state = _State(
            state.index,
            select(accepted, trial, state.x),
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
            best, best_cost = put(best, state.index, state.x), best_cost.index_copy(0, state.index, state.cost)
            state, active = state.keep(active), active[active]
    best, best_cost = put(best, state.index, state.x), best_cost.index_copy(0, state.index, state.cost)
    return Found(best, best_cost.nan_to_num(nan=torch.inf), initial.nan_to_num(nan=torch.inf), iterations, status)


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
