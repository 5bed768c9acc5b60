"""One descent to a minimum: damped Gauss-Newton steps, and Newton steps where these are slow.

Near the minimum, differences of costs are rounding errors; what a step gains is then told by the slopes at its two ends (Hager
& Zhang 2005), and the end by what the next step promises. The damping follows the trust-region rule of Nielsen (1999; Madsen,
Nielsen & Tingleff 2004, 3.2).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim.normal_equations import NormalEquations
from torchsfm.optim.schur import Elimination, move

SLOW = 0.25
"""Gauss-Newton steps of which each gains more than this fraction of what the last one gained give way to Newton steps."""
NEAR = 1e-2
"""They do so only once they gain less than this fraction of the cost: before, the exact Hessian is rarely positive."""
PATIENCE = 5
"""A Newton step takes the time of about five others: when that many in a row were slow, or the end is near, and at their pace
more than that many would be needed to the end."""
MINIMUM = 1e-13
"""Relative decrease still promised at which a place is the minimum that a derivative belongs to."""
LIGHT = 1e-6
"""Most damping of a step by which the end is told: more would hide what is left to gain where the cost is flat."""
STEEPEST = 1e-6
"""Most damping that is tried to make the exact Hessian positive."""
STRAIGHT = 0.75
"""Steps that lower the cost by less than this part of what they promise left the linear model's reach."""
POOR = 0.25
"""Of a step that gains less than this fraction of its promise, each eliminated variable takes only what is good for it."""
LEAST = 1e-3
"""Steps that gain less than this fraction of their promise are not taken."""
SETTLED = 1e-8
"""Promises of a smaller part of the cost come from near the minimum, where slopes tell what a step gains, not costs."""
ROUNDING = 10 * torch.finfo(torch.float64).eps
"""Of data and residuals, relative: no place is known better than to the square of this."""


@dataclass(frozen=True)
class Options:
    """When to stop, where the damping starts, and whom to tell."""

    max_iterations: int
    function_tolerance: float
    gradient_tolerance: float
    step_tolerance: float
    initial_damping: float
    progress: Callable[[int, float], bool | None] | None


@dataclass
class Descent:
    """Where the minimisation stands, at any moment the best so far."""

    x: dict[str, Tensor]
    cost: float
    iterations: int = 0


@dataclass(frozen=True)
class _Step:
    """A step with the decrease that its model promises, and the damping it took.

    The model may be the exact Hessian; where the cost is bent, and the step made as if it were not, that promises nothing.
    """

    delta: dict[str, Tensor]
    promise: float
    damping: float
    exact: bool = False
    bent: bool = False


@dataclass(frozen=True)
class _Trial:
    """Where a step leads, what that gains, and the normal equations there if they told."""

    x: dict[str, Tensor]
    cost: float
    gain: float
    system: NormalEquations | None = None


def descend(engine: Elimination, state: Descent, options: Options, *, rounding: float = 0.0, constant: float = 0.0) -> Status:
    """Damped steps until a tolerance is met; a rejected step keeps the linearisation.

    Args:
        engine: The problem.
        state: The start, and then the best so far, whatever ends it.
        options: See `sparse_levenberg_marquardt`.
        rounding: Decrease of the cost that is nothing, whatever the tolerance.
        constant: What is added to the cost that is told.

    Returns:
        OK at a minimum; `NOT_CONVERGED`, `NOT_FINITE` or `INTERRUPTED` elsewhere.
    """
    system = engine.linearize(state.x)
    curved: NormalEquations | None = None
    damping, growth, last, slow, dull = options.initial_damping, 2.0, math.inf, False, 0
    for iteration in range(1, options.max_iterations + 1):
        slope = float(system.gradient())
        if not math.isfinite(slope):
            return Status.NOT_FINITE
        if slope <= options.gradient_tolerance:
            return Status.OK
        step = None
        if slow:
            curved = engine.curve(state.x, system) if curved is None else curved
            step = _newton_step(curved, damping)
            slow = step is not None
        step = _gauss_newton_step(system, damping) if step is None else step
        damping = step.damping
        least = max(options.function_tolerance, ROUNDING**2) * state.cost + rounding
        left, sure = step.promise, step.exact
        if left <= least and (damping > LIGHT or step.bent):
            # What a heavily damped step promises says nothing, nor what one along which the cost bends down does.
            left, sure = _gauss_newton_step(system, LIGHT).promise, False
        # Gauss-Newton steps may promise too little.
        done = left <= (least if sure else 1e-2 * least)
        if left <= SETTLED * state.cost and damping <= LIGHT:
            done = done or _is_short(engine, state.x, step.delta, options.step_tolerance)
        trial = _try(engine, state, system, step)
        accepted = trial.gain > LEAST * step.promise
        if accepted:
            rate, last = trial.gain / last, trial.gain
            if not step.exact:
                # Steps that fall as a geometric series have this much still before them.
                rate = min(rate, 1.0)
                series = last * rate / (1 - rate) if rate < 1 else math.inf
                done = done or max(last, left, series) <= least
                dull = dull + 1 if rate > SLOW and last <= NEAR * state.cost else 0
                far = last * rate ** (PATIENCE + 1) > least * (1 - rate)
                slow = far and (dull > PATIENCE or (dull > 0 and last <= 100 * least))
            state.x, state.cost, curved = trial.x, trial.cost, None
            damping = max(damping * max(1 / 3, 1 - (2 * min(last / step.promise, 1.0) - 1) ** 3), 1e-16)
            growth = 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        state.iterations = iteration
        if options.progress is not None and options.progress(iteration, state.cost + constant) is False:
            return Status.OK if done else Status.INTERRUPTED
        if done:
            return Status.OK
        if accepted and trial.system is not None:
            system = trial.system
        elif accepted or trial.system is not None:
            system = engine.linearize(state.x)
        if damping > 1e16:
            # No step whatever lowers the cost: at a minimum, or where it is not smooth.
            promise = _gauss_newton_step(system, LIGHT).promise
            if not math.isfinite(promise):
                return Status.NOT_FINITE
            return Status.OK if promise <= least else Status.NOT_CONVERGED
    return Status.NOT_CONVERGED


def _gauss_newton_step(system: NormalEquations, damping: float) -> _Step:
    """A step that promises inf where the system could not be solved, so that it is not taken."""
    delta, promise, solved, _ = system.step(damping)
    return _Step(delta, float(promise) if bool(solved) else math.inf, damping)


def _newton_step(curved: NormalEquations, damping: float) -> _Step | None:
    """A step with the exact Hessian and at least the damping given.

    None where the Hessian is so far from positive that the damping would be the greater part of it.
    """
    while True:
        delta, promise, solved, bent = curved.step(damping)
        if bool(solved):
            return _Step(delta, float(promise), damping, exact=True, bent=bent)
        damping *= 10
        if damping > STEEPEST:
            return None


def _try(engine: Elimination, state: Descent, system: NormalEquations, step: _Step) -> _Trial:
    """Take a step; where the model was good for a part of it only, for eliminated variables take that part."""
    if not math.isfinite(step.promise):
        return _Trial(state.x, state.cost, -math.inf)
    x = move(engine.blocks, engine.layout, state.x, step.delta)
    cost = float(engine.cost(x))
    if not step.promise > SETTLED * state.cost:
        if not cost <= (1 + SETTLED) * state.cost:
            return _Trial(x, cost, -math.inf)
        slope = float(system.along(step.delta))
        there = engine.linearize(x)
        return _Trial(x, cost, -(slope + float(there.along(step.delta))) / 2, there)
    if not state.cost - cost > POOR * step.promise:
        x = engine.shorten(state.x, step.delta, x)
        cost = float(engine.cost(x))
    if math.isfinite(cost) and state.cost - cost < STRAIGHT * step.promise:
        # The linear model reaches no farther than this, but with the eliminated variables settled it may.
        x = engine.settle(x)
        cost = float(engine.cost(x))
    return _Trial(x, cost, state.cost - cost if math.isfinite(cost) else -math.inf)


def _is_short(engine: Elimination, x: dict[str, Tensor], delta: dict[str, Tensor], tolerance: float) -> bool:
    """Whether no variable moves by more than a fraction of its own norm: one that is far away says nothing of the others."""
    norm = torch.linalg.vector_norm
    return all(
        bool((norm(d, dim=1) <= tolerance * (norm(x[name][engine.layout.free[name]], dim=1) + tolerance)).all())
        for name, d in delta.items()
    )
