"""Damped steps for a batch of small problems, each with its own damping, rejections and end.

They are Gauss-Newton steps, and Newton steps where these are slow, by the rules of `descent`. The damping follows the
trust-region rule of Nielsen (1999; Madsen, Nielsen & Tingleff 2004, 3.2), scaled by the diagonal of the Gauss-Newton
normal equations (Marquardt 1963).
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsfm._types import Status, tensor_map
from torchsfm.optim.dense_problem import DenseProblem
from torchsfm.optim.descent import LEAST, LIGHT, NEAR, SLOW
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
    size: Tensor
    """What the cost would be if residuals were as large as data are."""
    cost: Tensor
    gradient: Tensor
    metric: Tensor
    """The Gauss-Newton matrix, by which steps are measured."""
    hessian: Tensor
    """The matrix of the model: the exact Hessian where Gauss-Newton steps were slow."""
    exact: Tensor
    damping: Tensor
    growth: Tensor
    last: Tensor
    """What the last step gained."""

    def keep(self, active: Tensor) -> "_State":
        where = active.nonzero()[:, 0]
        return tensor_map(lambda v: v.index_select(0, where), self)


class _Step(NamedTuple):
    """Damped steps, the decrease their model promises, where the system could be solved and where the model was exact."""

    delta: Tensor
    promise: Tensor
    solved: Tensor
    exact: Tensor


def minimise(problem: DenseProblem, x: Any, data: Any, weights: Tensor | None, options: Options) -> Found:
    """Minimise every problem of a batch; finished ones leave it when they are half of those under way."""
    cost, gradient, metric = problem.normal_equations(x, data, weights)
    count = cost.shape[0]
    iterations = torch.zeros(count, dtype=torch.int32, device=cost.device)
    status = torch.full((count,), int(Status.NOT_CONVERGED), dtype=torch.int8, device=cost.device)
    status[~(cost.isfinite() & gradient.isfinite().all(-1) & metric.isfinite().all(-1).all(-1))] = int(Status.NOT_FINITE)
    status[problem.too_few(x, data, weights)] = int(Status.TOO_FEW)
    best, best_cost, initial = x, cost, cost
    ones = torch.ones_like(cost)
    index = torch.arange(count, device=cost.device)
    state = _State(
        index, x, data, weights, problem.size(x, data, weights), cost, gradient, metric, metric, ones < 0,
        options.initial_damping * ones, 2 * ones, torch.inf * ones,
    )  # fmt: skip
    active = status == Status.NOT_CONVERGED
    if not active.all():
        state, active = state.keep(active), active[active]
    eps = torch.finfo(leaves(x)[0].dtype).eps
    for _ in range(options.max_iterations):
        if state.index.numel() == 0:
            break
        step = _solve(state)
        trial = problem.retract(state.x, step.delta.to(leaves(state.x)[0].dtype))
        cost, gradient, metric = problem.normal_equations(trial, state.data, state.weights)
        usable = step.solved & cost.isfinite() & gradient.isfinite().all(-1) & metric.isfinite().all(-1).all(-1)
        gain, near = state.cost - cost, step.promise <= eps**0.5 * state.cost
        # Differences of costs that are rounding errors say nothing: there the slopes at both ends tell what is gained.
        slopes = -(step.delta * (state.gradient + gradient)).sum(-1) / 2
        gain = torch.where(near & (gain >= -(eps**0.5) * state.cost), slopes, gain)
        accepted = active & usable & (gain > LEAST * step.promise)
        least = _least(state, options.function_tolerance, eps)
        left = _left(state, step, least)
        short = near & (norm(step.delta) <= options.step_tolerance * (norm(state.x) + options.step_tolerance))
        # Gauss-Newton steps may promise too little.
        done = (left <= torch.where(step.exact, least, 1e-2 * least)) | (short & (state.damping <= LIGHT))
        # Those that fall as a geometric series have this much still before them.
        rate = gain / state.last
        series = torch.where(rate < 1, gain * rate / (1 - rate), torch.inf)
        done |= accepted & ~step.exact & (torch.stack((gain, left, series)).amax(0) <= least)
        done &= active & step.solved
        slow = accepted & ~done & (step.exact | ((rate > SLOW) & (gain <= NEAR * state.cost)))
        trust = (gain / step.promise.clamp_min(torch.finfo(cost.dtype).tiny)).clamp(0, 1)
        shrink = (1 - (2 * trust - 1) ** 3).clamp_min(1 / 3)
        iterations[state.index] += active.int()
        state = _State(
            state.index,
            select(accepted, trial, state.x),
            state.data,
            state.weights,
            state.size,
            torch.where(accepted, cost, state.cost),
            torch.where(accepted[:, None], gradient, state.gradient),
            torch.where(accepted[:, None, None], metric, state.metric),
            torch.where(accepted[:, None, None], metric, state.hessian),
            torch.where(accepted, slow, state.exact),
            torch.where(accepted, state.damping * shrink, state.damping * state.growth).clamp_min(1e-16),
            torch.where(accepted, 2.0, 2 * state.growth),
            torch.where(accepted, gain, state.last),
        )
        _sharpen(problem, state, slow)
        stuck = active & ~done & (state.damping > 1e16)
        if stuck.any():
            # No step whatever lowers the cost: at a minimum, or where it is not smooth.
            least = _least(state, options.function_tolerance, eps)
            done |= stuck & (_left(state, _solve(state), least) <= least)
        status[state.index[done]] = int(Status.OK)
        active = active & ~done & ~stuck
        if 2 * active.sum() <= active.numel():
            best, best_cost = put(best, state.index, state.x), best_cost.index_copy(0, state.index, state.cost)
            state, active = state.keep(active), active[active]
    best, best_cost = put(best, state.index, state.x), best_cost.index_copy(0, state.index, state.cost)
    return Found(best, best_cost.nan_to_num(nan=torch.inf), initial.nan_to_num(nan=torch.inf), iterations, status)


def _least(state: _State, tolerance: float, eps: float) -> Tensor:
    """The decrease that is nothing: a fraction of the cost, or what rounding of the parameters and of the data makes of it."""
    moved = state.metric.diagonal(dim1=-2, dim2=-1).sum(-1) * norm(state.x).square() / 2
    return tolerance * state.cost + (10 * eps) ** 2 * torch.minimum(moved, state.size).nan_to_num(posinf=0.0)


def _left(state: _State, step: _Step, least: Tensor) -> Tensor:
    """What is left to gain: what steps promise, without the damping that would hide it where the cost is flat."""
    hidden = (step.solved & (step.promise <= least) & (state.damping > LIGHT)).nonzero()[:, 0]
    if not hidden.numel():
        return step.promise
    some = tensor_map(lambda v: v.index_select(0, hidden), replace(state, x=(), data=(), weights=None))
    light = _solve(replace(some, damping=torch.full_like(some.damping, LIGHT)))
    return step.promise.index_copy(0, hidden, torch.where(light.solved, light.promise, torch.inf))


def _sharpen(problem: DenseProblem, state: _State, slow: Tensor) -> None:
    """Put the exact Hessian in the place of the Gauss-Newton matrix where that is slow."""
    where = slow.nonzero()[:, 0]
    if where.numel():
        x, data, weights = tensor_map(lambda v: v.index_select(0, where), (state.x, state.data, state.weights))
        state.hessian = state.hessian.index_copy(0, where, problem.hessian(x, data, weights))


def _solve(state: _State) -> _Step:
    """Steps with the exact Hessian where that is wanted and positive, Gauss-Newton steps elsewhere."""
    diagonal = state.metric.diagonal(dim1=-2, dim2=-1)
    # A direction that nothing depends on gets the damping of the others, and so does not move.
    floor = 1e-9 * diagonal.amax(-1, keepdim=True) + torch.finfo(diagonal.dtype).tiny
    damped = state.damping[:, None] * diagonal.clamp_min(floor)
    factor, info = torch.linalg.cholesky_ex(state.hessian + torch.diag_embed(damped))
    exact = state.exact & (info == 0)
    bent = (state.exact & ~exact).nonzero()[:, 0]
    if bent.numel():
        plain, flaw = torch.linalg.cholesky_ex(state.metric[bent] + torch.diag_embed(damped[bent]))
        factor, info = factor.index_copy(0, bent, plain), info.index_copy(0, bent, flaw)
    solved = info == 0
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    factor = torch.where(solved[:, None, None], factor, eye)
    delta = -torch.cholesky_solve(state.gradient[..., None], factor)[..., 0]
    solved = solved & delta.isfinite().all(-1)
    delta = torch.where(solved[:, None], delta, torch.zeros_like(delta))
    promise = (delta * (damped * delta - state.gradient)).sum(-1) / 2
    return _Step(delta, promise, solved, exact)
