"""Levenberg-Marquardt for one large sparse problem: terms over variable blocks, one block eliminated (`schur`)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import torch
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.optim.covariance import to_double, usable
from torchsfm.optim.implicit import wants_derivative
from torchsfm.optim.layout import Layout, lay_out
from torchsfm.optim.normal_equations import NormalEquations
from torchsfm.optim.schur import Elimination, Solver, move
from torchsfm.optim.sparse_derivative import Hessian, attach_sparse_optimum, followed
from torchsfm.optim.terms import Block, Term, term_cost, term_residual

SLOW = 0.25
"""Gauss-Newton steps of which each gains more than this fraction of what the last one gained give way to Newton steps."""
NEAR = 1e-2
"""They do so only once they gain less than this fraction of the cost: before, the exact Hessian is rarely positive."""
PATIENCE = 5
"""A Newton step takes the time of about five others: when that many in a row were slow, or the end is near, and at their pace
more than that many would be needed to the end."""
MINIMUM = 1e-13
"""Relative decrease still promised at which a place is the minimum that a derivative belongs to."""
LIGHT = 1e-3
"""Most damping of a step by which the end is told."""
STEEPEST = 1e-6
"""Most damping that is tried to make the exact Hessian positive."""
STRAIGHT = 0.75
"""Steps that lower the cost by less than this part of what they promise left the linear model's reach."""
SETTLED = 1e-8
"""Promises of a smaller part of the cost come from near the minimum, where the model is good and rounding begins to tell."""
POOR = 0.25
"""Of a step that gains less than this fraction of its promise, each eliminated variable takes only what is good for it."""


@dataclass(frozen=True)
class SparseResult:
    """The minimum of a sparse least-squares problem.

    `x` holds every block, `residuals` every term's residuals (m, d) there, `used` (m) which of them count: a residual that is
    not finite at the start, or whose square is not, is left out. `status` is `Status.OK` where a tolerance was met or no step
    lowers the cost any more, `NOT_CONVERGED` where the iteration limit came first, `INTERRUPTED` where it was stopped from
    outside, `TOO_FEW` where nothing is free or observed, `NOT_FINITE` where no residual is finite, or where their sum or its
    derivatives are not: then `x` is the best seen.
    """

    x: dict[str, Tensor]
    cost: float
    initial_cost: float
    residuals: tuple[Tensor, ...]
    used: tuple[Tensor, ...]
    iterations: int
    status: Status


def sparse_levenberg_marquardt(
    blocks: Mapping[str, Block],
    terms: Sequence[Term],
    *,
    eliminate: str | None = None,
    max_iterations: int = 50,
    function_tolerance: float = 1e-6,
    gradient_tolerance: float = 1e-10,
    step_tolerance: float = 1e-10,
    initial_damping: float = 1e-4,
    linear_solver: Solver = "auto",
    hessian: Hessian = "exact",
    progress: Callable[[int, float], bool | None] | None = None,
) -> SparseResult:
    """Minimise a sum of terms over variable blocks.

    Gauss-Newton steps at first. Where these become slow, as with robust losses and large residuals, Newton steps with the
    exact Hessian in the same sparse form take over wherever it is positive (dense systems only), so that the last digits cost
    a few steps. Of a step that turns out bad each eliminated variable takes the part that is good for it. Everything is
    computed in float64; variables come back in the dtype they had. A gauge freedom needs no care: the damping
    takes the shortest step. Fixed and unobserved variables come back bit for bit.

    Args:
        blocks: Variables by name.
        terms: Residuals over them.
        eliminate: The block with the most variables (points); no residual may depend on two of its variables.
        max_iterations: Most accepted or rejected steps.
        function_tolerance: End when no more than this fraction of the cost is left to gain, by the promise of a step or by how
            fast gains fall.
        gradient_tolerance: End when no derivative of the cost is larger.
        step_tolerance: End when the step of every variable is shorter than this fraction of that variable's norm.
        initial_damping: Damping relative to the diagonal of the normal equations, at the start (1 / Ceres' radius).
        linear_solver: "dense" forms the reduced system of the retained variables and factors it; "pcg" solves it by
            preconditioned conjugate gradients without forming it, to a tenth of the decrease the model allows (inexact steps:
            more of them, in memory that grows with the residuals alone); "auto" takes what the size suggests.
        hessian: Used for derivatives of the minimum only: "exact", or "gauss-newton", which leaves out second derivatives of
            the residuals and is some percent off where residuals are large.
        progress: Called with the number of iterations and the cost after each. Returning False ends the minimisation; so does
            an interrupt (Ctrl-C), there or anywhere else in the iterations. Either way the best so far is returned, with
            the status INTERRUPTED: who has more to do after it looks there.

    Returns:
        The minimum. Where data, weights or fixed variables require a gradient, `x` and `residuals` carry their derivatives by
        the implicit function theorem (first derivatives, backwards); otherwise nothing is spent on it. They are those of a
        minimum, so it is then approached until hardly 1e-13 of the cost is left to gain, whatever `function_tolerance` says;
        where the status is not OK it was not reached, and they are not to be trusted.

    Raises:
        ValueError: A term names an unknown block, its tensors disagree in length, an index is out of range, or it depends on
            two eliminated variables.
    """
    _check(blocks, terms, eliminate)
    check_options(linear_solver=(linear_solver, get_args(Solver)), max_iterations=(max_iterations, "int >= 0"))
    check_options(
        function_tolerance=(function_tolerance, "float >= 0"), gradient_tolerance=(gradient_tolerance, "float >= 0"),
        step_tolerance=(step_tolerance, "float >= 0"), initial_damping=(initial_damping, "float >= 0"),
    )  # fmt: skip
    wanted = wants_derivative(*followed(dict(blocks), terms))
    if wanted:
        function_tolerance = min(function_tolerance, MINIMUM)
    options = _Options(max_iterations, function_tolerance, gradient_tolerance, step_tolerance, initial_damping, progress)
    with torch.no_grad():
        double = {name: replace(b, x=b.x.detach().double().mT.contiguous().mT) for name, b in blocks.items()}
        x = {name: b.x for name, b in double.items()}
        plain = [to_double(term) for term in terms]
        used = tuple(usable(term, x) for term in plain)
        counted = [t if bool(u.all()) else t.select(u.nonzero()[:, 0]) for t, u in zip(plain, used, strict=True)]
        layout = lay_out(double, counted, eliminate)
        # A residual of fixed variables is a constant of the cost.
        constant = sum((float(term_cost(t, term_residual(t, x))) for t in layout.still), 0.0)
        state = _Descent(x, 0.0, 0.0)
        if layout.pieces:
            engine = Elimination(double, layout, linear_solver)
            state.cost = state.initial = float(engine.cost(x))
            finite = math.isfinite(state.cost + constant)
            status = _run(engine, state, constant, options) if finite else Status.NOT_FINITE
        else:
            none = any(u.numel() for u in used) and not any(bool(u.any()) for u in used)
            status = Status.NOT_FINITE if none else Status.TOO_FEW
    x = state.x
    if wanted:
        x = attach_sparse_optimum(dict(blocks), terms, x, used, eliminate, hessian)
        plain = [replace(term, data=tuple(_double(d) for d in term.data)) for term in terms]
    residuals = tuple(term_residual(t, x) for t in plain)
    out = {name: x[name].to(b.x.dtype).contiguous() for name, b in blocks.items()}
    cost, initial = state.cost + constant, state.initial + constant
    return SparseResult(out, cost, initial, residuals, used, state.iterations, status)


@dataclass
class _Descent:
    """Where the minimisation stands, at any moment the best so far."""

    x: dict[str, Tensor]
    cost: float
    initial: float
    iterations: int = 0


@dataclass(frozen=True)
class _Options:
    max_iterations: int
    function_tolerance: float
    gradient_tolerance: float
    step_tolerance: float
    initial_damping: float
    progress: Callable[[int, float], bool | None] | None


def _run(engine: Elimination, state: _Descent, constant: float, options: _Options) -> Status:
    """Descend; an interrupt ends it where it is."""
    try:
        return _descend(engine, state, constant, options)
    except KeyboardInterrupt:
        return Status.INTERRUPTED


def _descend(engine: Elimination, state: _Descent, constant: float, options: _Options) -> Status:
    """Damped steps until a tolerance is met; a rejected step keeps the linearisation."""
    system = engine.linearize(state.x)
    exact: NormalEquations | None = None
    damping, growth, slow, dull = options.initial_damping, 2.0, False, 0
    last = promised_last = math.inf
    for iteration in range(1, options.max_iterations + 1):
        slope = float(system.gradient())
        if slope <= options.gradient_tolerance or not math.isfinite(slope):
            return Status.OK if math.isfinite(slope) else Status.NOT_FINITE
        cost = state.cost
        newton = None
        if slow:
            exact = engine.curve(state.x, system) if exact is None else exact
            newton = _newton_step(exact, damping)
            slow = newton is not None
        if newton is not None:
            damping, step, promise = newton
            solved = True
        else:
            step, promised, solvable = system.step(damping)
            solved, promise = bool(solvable), float(promised)
        trial = move(engine.blocks, engine.layout, state.x, step)
        trial_cost = float(engine.cost(trial)) if solved else math.inf
        # Below the rounding error of the cost a step is taken on its promise: it brings x, not the cost, to its end.
        rounding = solved and promise <= 1e-12 * cost and trial_cost - cost <= 1e-14 * cost
        if solved and not rounding and not cost - trial_cost > POOR * promise:
            trial = engine.shorten(state.x, step, trial)
            trial_cost = float(engine.cost(trial))
        if math.isfinite(trial_cost) and promise > SETTLED * cost and cost - trial_cost < STRAIGHT * promise:
            # The linear model reaches no farther than this, but with the eliminated variables settled it may.
            trial = engine.settle(trial)
            trial_cost = float(engine.cost(trial))
        ratio = (cost - trial_cost) / max(promise, 1e-300)
        accepted = rounding or (trial_cost < cost and ratio > 1e-3)
        least = options.function_tolerance * cost
        # A promise far below the tolerance ends it, kept or not: rounding decides whether such a step lowers the cost. What a
        # step promises that damping has cut short says nothing.
        light = damping <= LIGHT
        done = solved and light and promise <= (least if newton is not None else 1e-2 * least)
        done = done or (solved and light and _is_short(step, state.x, engine.layout, options.step_tolerance))
        if accepted:
            gain = cost - trial_cost
            if rounding:
                # Where the cost says nothing any more, promises that do not fall are the end.
                rate = promise / promised_last
                done = done or (light and rate > 0.5 and (newton is not None or engine.clusters is not None))
                slow = engine.clusters is None and rate > SLOW
            elif newton is None:
                # Steps that fall as a geometric series have this much still before them.
                rate = gain / last
                done = done or (light and gain <= least and rate < 1 and gain * rate <= least * (1 - rate))
                dull = dull + 1 if rate > SLOW and gain <= NEAR * cost else 0
                far = gain * rate ** (PATIENCE + 1) > least * (1 - rate)
                slow = engine.clusters is None and far and (dull > PATIENCE or (dull > 0 and gain <= 100 * least))
            last, promised_last = (gain if gain > 0 else math.inf), max(promise, 1e-300)
            state.x, state.cost = trial, trial_cost
            trust = 1.0 if rounding else min(ratio, 1.0)
            damping = max(damping * max(1 / 3, 1 - (2 * trust - 1) ** 3), 1e-16)
            growth = 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        state.iterations = iteration
        if options.progress is not None and options.progress(iteration, state.cost + constant) is False:
            return Status.OK if done else Status.INTERRUPTED
        if done:
            return Status.OK
        # At the largest damping no step whatever lowers the cost.
        if damping > 1e16:
            _, promised, solvable = system.step(LIGHT)
            if not bool(solvable):
                return Status.NOT_FINITE
            return Status.OK if float(promised) <= options.function_tolerance * state.cost else Status.NOT_CONVERGED
        if accepted and iteration < options.max_iterations:
            system, exact = engine.linearize(state.x), None
    return Status.NOT_CONVERGED


def _newton_step(exact: NormalEquations, damping: float) -> tuple[float, dict[str, Tensor], float] | None:
    """A step with the exact Hessian, the damping it took, not less than the one given, and the decrease it promises.

    None where the Hessian is so far from positive that the damping would be the greater part of it.
    """
    while True:
        step, promise, solved = exact.step(damping)
        if bool(solved):
            return damping, step, float(promise)
        damping *= 10
        if damping > STEEPEST:
            return None


def _double(x: Tensor) -> Tensor:
    return x.double() if x.is_floating_point() else x


def _check(blocks: Mapping[str, Block], terms: Sequence[Term], eliminate: str | None) -> None:
    check_options(blocks=(blocks, Mapping), terms=(terms, list | tuple), eliminate=(eliminate, str | None))
    if eliminate is not None and eliminate not in blocks:
        raise ValueError(f"eliminate: wanted one of {sorted(blocks)}, got {eliminate!r}")
    for k, term in enumerate(terms):
        if len(term.blocks) != len(term.index):
            raise ValueError(f"terms[{k}]: wanted one index for each of {term.blocks}, got {len(term.index)}")
        for name in term.blocks:
            if name not in blocks:
                raise ValueError(f"terms[{k}]: wanted blocks among {sorted(blocks)}, got {name!r}")
        weights = () if term.weights is None else (term.weights,)
        lengths = {t.shape[0] for t in (*term.index, *term.data, *weights)}
        if len(lengths) != 1:
            raise ValueError(f"terms[{k}]: wanted index, data and weights of one length, got {sorted(lengths)}")
        for name, index in zip(term.blocks, term.index, strict=True):
            check_tensors(**{f"terms[{k}].index": (index, f"{index.shape[0]}: int")})
            count = blocks[name].x.shape[0]
            if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < count:
                got = f"{int(index.min())} to {int(index.max())}"
                raise ValueError(f"terms[{k}].index: wanted numbers from 0 to {count - 1} for {name!r}, got {got}")


def _is_short(step: dict[str, Tensor], x: dict[str, Tensor], layout: Layout, tolerance: float) -> bool:
    """Whether no variable moves by more than a fraction of its own norm: one that is far away says nothing of the others."""
    norm = torch.linalg.vector_norm
    return all(
        bool((norm(delta, dim=1) <= tolerance * (norm(x[name][layout.free[name]], dim=1) + tolerance)).all())
        for name, delta in step.items()
    )
