"""One descent to a minimum: damped Gauss-Newton steps, and Newton steps where these are slow.

Problems come in batches of any shape, each with its own damping, its own accepted and rejected steps and its own end; one large
problem is a batch of none. What they are made of is in `problem`: a `Problem` is linearised at a place, and the `System` found
there gives a step for any damping. Two linear algebras serve it, `dense` for thousands of small problems and `schur` for
one large sparse one; a room with a structure of its own brings a third.

Near the minimum, differences of costs are rounding errors; what a step gains is then told by the slopes at its two ends (Hager
& Zhang 2005), and the end by what the next step promises. The damping follows the trust-region rule of Nielsen (1999; Madsen,
Nielsen & Tingleff 2004, 3.2).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, choose, pick, places, put

SLOW = 0.25
"""Gauss-Newton steps of which each gains more than this fraction of what the last one gained give way to Newton steps."""
NEAR = 1e-2
"""They do so only once they gain less than this fraction of the cost: before, the exact Hessian is rarely positive."""
LOOSE = 1e-4
"""And only where no more than this fraction of the cost may be left: Newton steps are for the last digits."""
FLAT = 1.5
"""Nor, unless they have been slow for long, where a step gains more than so many times what it promises,"""
GROWTH = 2.0
"""or more than so many times what the last one gained: they are under way along a valley."""
MINIMUM = 1e-13
"""Relative decrease still promised at which a place is the minimum that a derivative belongs to."""
LIGHT = 1e-6
"""Most damping of a step by which the end is told: more would hide what is left to gain where the cost is flat."""
STEEPEST = 1e-6
"""Most damping that is tried to make the exact Hessian positive."""
LEAST = 1e-3
"""Steps that gain less than this fraction of their promise are not taken."""
STRONGEST = 1e16
"""Damping beyond which no step whatever lowers the cost."""
WEAKEST = 1e-16
"""Damping below which it is none."""
_UNDER_WAY = -1
"""The status of what has not ended."""


@dataclass(frozen=True)
class Options:
    """When to stop, where the damping starts, and whom to tell."""

    max_iterations: int
    function_tolerance: float
    """End when no more than this fraction of the cost is left to gain."""
    step_tolerance: float = 0.0
    """End when a step is shorter than this fraction of what it moves, and promises next to nothing."""
    gradient_tolerance: float = 0.0
    """End when the cost is no steeper, as `System.steepest` measures it."""
    initial_damping: float = 1e-4
    progress: Callable[[int, Tensor], bool | None] | None = None
    """Called with the number of steps and the costs after each; False ends the descent."""
    interruptible: bool = False
    """Whether an interrupt (Ctrl-C) ends the descent with the best so far."""


class Descent(NamedTuple):
    """Where a descent ended.

    `status` is OK at a minimum, `NOT_CONVERGED` where the limit of steps came first or no step lowers the cost though more is
    promised, `NOT_FINITE` where the cost or its derivatives are not, at the start or at the best place so far, `TOO_FEW` where
    there are too few data, and `INTERRUPTED` where it was stopped from outside; `x` is the best place so far all the same.
    """

    end: Any
    """The system at the best place."""
    initial_cost: Tensor
    iterations: Tensor
    status: Tensor

    @property
    def x(self) -> Any:
        """The best place."""
        return self.end.x

    @property
    def cost(self) -> Tensor:
        """The cost there."""
        cost: Tensor = self.end.cost
        return cost


@dataclass(frozen=True)
class _State:
    """The elements still under way, and those that have ended since some were last left behind."""

    at: Places
    """Their places in the batch; none while that is all of it."""
    here: Any
    status: Tensor
    iterations: Tensor
    damping: Tensor
    growth: Tensor
    last: Tensor
    """What the last step gained by itself."""
    dull: Tensor
    """How many Gauss-Newton steps in a row were slow."""
    slow: Tensor
    """Where Newton steps are wanted,"""
    curved: Tensor
    """and where the exact Hessian is there for them."""
    weak: Tensor
    """The most damping that left the exact Hessian indefinite when that was last tried; less is not tried again."""

    @property
    def active(self) -> Tensor:
        return self.status == _UNDER_WAY


def descend(problem: Problem[Any], x0: Any, options: Options, *, enough: Tensor | None = None) -> Descent:
    """Minimise every problem of a batch; finished ones leave it when they are half of those under way.

    Args:
        problem: The problems.
        x0: Where they start.
        options: When to stop.
        enough: Where there are data enough; the others come back as they were.

    Returns:
        The minima, with a status for each.
    """
    here = problem.linearize(x0)
    cost = here.cost
    status = torch.full(cost.shape, _UNDER_WAY, dtype=torch.int8, device=cost.device)
    status = torch.where(cost.isfinite(), status, int(Status.NOT_FINITE))
    if enough is not None:
        status = torch.where(enough, status, int(Status.TOO_FEW))
    ones, none = torch.ones_like(cost), torch.zeros_like(status, dtype=torch.bool)
    count = torch.zeros_like(status, dtype=torch.int32)
    damping, growth, last = options.initial_damping * ones, 2 * ones, torch.inf * ones
    state = _State((), here, status, count, damping, growth, last, dull=count, slow=none, curved=none, weak=0 * ones)
    found = Descent(here, cost, count, status)
    try:
        for iteration in range(1, options.max_iterations + 1):
            # Where all have ended, nothing is linearised any more.
            if not bool(state.active.any()):
                break
            slope = state.here.steepest()
            falls = (slope > options.gradient_tolerance) & (slope < torch.inf)
            if not bool(falls.all()):
                state = _end(state, slope <= options.gradient_tolerance, Status.OK)
                state = _end(state, ~falls, Status.NOT_FINITE)
            active = state.active
            number = int(active.sum())
            if not number:
                break
            if active.ndim and 2 * number <= active.numel():
                found, rest = _stored(found, state), places(active)
                at = pick(rest, state.at) if state.at else rest
                problem, active = problem.pick(rest), active[rest]
                state = replace(pick(rest, replace(state, at=())), at=at)
            state = _stepped(problem, state, active, options)
            if options.progress is not None:
                costs = put(state.at, found.cost, state.here.cost)
                if options.progress(iteration, costs) is False:
                    state = _end(state, state.active, Status.INTERRUPTED)
                    break
    except KeyboardInterrupt:
        if not options.interruptible:
            raise
        state = _end(state, state.active, Status.INTERRUPTED)
    found = _stored(found, state)
    return found._replace(status=torch.where(found.status == _UNDER_WAY, int(Status.NOT_CONVERGED), found.status))


def _stepped(problem: Problem[Any], state: _State, active: Tensor, options: Options) -> _State:
    """One step of every element under way; a rejected one keeps the linearisation."""
    state, step, exact = _next_step(problem, state)
    here, promise = state.here, step.promise
    cost = here.cost
    least = max(options.function_tolerance, (10 * problem.epsilon) ** 2) * cost + problem.rounding(here)
    left, sure = _left(state, step, exact, least, active)
    # Gauss-Newton steps may promise too little; more than all of the cost cannot be left.
    done = (left <= torch.where(sure, least, 1e-2 * least)) | (cost <= least)
    # Promises of a smaller part of the cost come from near the minimum, where slopes tell what a step gains, not costs.
    settled = problem.epsilon**0.5 * cost
    near = active & (promise <= settled)
    if options.step_tolerance > 0:
        still = near & (state.damping <= LIGHT) & ~(step.bent | step.partial | done)
        if bool(still.any()):
            done = done | (still & problem.is_short(here, step.delta, options.step_tolerance))
    there = problem.advance(here, step)
    gain = cost - there.cost
    if bool(near.any()):
        slopes = -(here.along(step.delta) + there.along(step.delta)) / 2
        gain = torch.where(near & (gain >= -settled), slopes, gain)
    accepted = active & (gain > LEAST * promise)
    # Steps that fall as a geometric series have this much still before them.
    # No more than twice its promise comes from the step itself, the rest from what settled after it, which ends at once.
    own = torch.minimum(gain, 2 * promise)
    rate = (own / state.last).clamp_max(1)
    series = torch.where(rate < 1, gain * rate / (1 - rate), torch.inf)
    plain = accepted & ~exact
    done = active & (done | (plain & (torch.maximum(torch.maximum(gain, left), series) <= least)))
    dull, slow, curved = state.dull, state.slow, state.curved
    if problem.patience is not None and options.function_tolerance <= LOOSE:
        grows = (gain > GROWTH * state.last) & (gain > 100 * least)
        crawls, slow = plain & (rate > SLOW) & (gain <= NEAR * cost) & ~grows, exact
        dull = torch.where(plain, torch.where(crawls, dull + 1, 0), dull)
        if bool(crawls.any()):
            far = gain * rate ** (problem.patience + 1) > least * (1 - rate)
            # Along a step that gains this much more than it promises the cost is hardly curved, and the Hessian not positive.
            ends = (gain <= 100 * least) & (gain <= FLAT * promise)
            slow = slow | (crawls & far & ((dull > problem.patience) | ends))
        slow, curved = slow & ~done, curved & ~accepted
    trust = (gain / promise.clamp_min(torch.finfo(cost.dtype).tiny)).clamp(0, 1)
    shrink = (1 - (2 * trust - 1) ** 3).clamp_min(1 / 3)
    state = replace(
        state,
        here=choose(accepted, there, here),
        iterations=state.iterations + active,
        damping=torch.where(accepted, state.damping * shrink, state.damping * state.growth).clamp_min(WEAKEST),
        growth=torch.where(accepted, 2.0, 2 * state.growth),
        last=torch.where(accepted, own, state.last),
        dull=dull,
        slow=slow,
        curved=curved,
    )
    if bool(done.any()):
        state = _end(state, done, Status.OK)
    if bool((stuck := active & (state.damping > STRONGEST)).any()):
        # At a minimum, or where the cost is not smooth.
        light = _light(state, stuck)
        state = _end(state, stuck & (light <= least), Status.OK)
        state = _end(state, stuck, Status.NOT_CONVERGED)
    return state


def _next_step(problem: Problem[Any], state: _State) -> tuple[_State, Step, Tensor]:
    """A Newton step where Gauss-Newton steps are slow, and where these are; it may raise the damping.

    Where the Hessian is so far from positive that the damping would be the greater part of it, a Gauss-Newton step.
    """
    slow = state.slow
    if problem.patience is None or not bool(slow.any()):
        return state, state.here.step(state.damping), slow
    wanted = slow & ~state.curved
    if bool(wanted.any()):
        state = replace(state, here=problem.curve(state.here, wanted), curved=state.curved | wanted)
    damping = torch.where(slow, torch.maximum(state.damping, state.weak), state.damping)
    step = state.here.step(damping, slow)
    while bool((again := slow & ~step.solved & (10 * damping <= STEEPEST)).any()):
        damping = torch.where(again, 10 * damping, damping)
        some = places(again)
        step = put(some, step, pick(some, state.here).step(pick(some, damping), pick(some, slow)))
    exact = slow & step.solved
    bent = slow & ~exact
    state = replace(state, weak=torch.where(bent, damping, torch.where(exact, 0.0, state.weak)))
    if bool(bent.any()):
        damping = torch.where(bent, state.damping, damping)
        some = places(bent)
        step = put(some, step, pick(some, state.here).step(pick(some, damping)))
    return replace(state, damping=damping), step, exact


def _left(state: _State, step: Step, exact: Tensor, least: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """What is left to gain, and where that is by the exact Hessian.

    What a heavily damped step promises says nothing, nor what one along which the cost bends down does, or one that is partial.
    """
    hidden = active & (step.promise <= least) & ((state.damping > LIGHT) | step.bent | step.partial)
    if not bool(hidden.any()):
        return step.promise, exact
    return torch.where(hidden, _light(state, hidden), step.promise), exact & ~hidden


def _light(state: _State, where: Tensor) -> Tensor:
    """What a Gauss-Newton step with hardly any damping promises, in some elements; inf where that is partial."""
    some = places(where)
    promise = torch.full_like(state.damping, torch.inf)
    step: Step = pick(some, state.here).step(torch.full_like(pick(some, promise), LIGHT))
    return put(some, promise, torch.where(step.partial, torch.inf, step.promise))


def _end(state: _State, where: Tensor, status: Status) -> _State:
    """Give elements under way a status."""
    return replace(state, status=torch.where(where & state.active, int(status), state.status))


def _stored(found: Descent, state: _State) -> Descent:
    """What is known of all elements, with what those under way have reached."""
    return Descent(
        put(state.at, found.end, state.here),
        found.initial_cost,
        put(state.at, found.iterations, state.iterations),
        put(state.at, found.status, state.status),
    )
