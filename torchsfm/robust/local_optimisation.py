"""From a model through a noisy sample to the optimum near it."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.portions import portion
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import join, put, select, tensors_of, zip_map
from torchsfm.robust.scoring import Scoring

M = TypeVar("M")
T = TypeVar("T")

LOCAL_STEPS, RIVAL_STEPS = (9.0, 1.0), (9.0, 4.0, 1.0, 1.0)
"""Squared thresholds of the steps of local optimisation, in units of the squared threshold; and where many minima compete."""
LOCAL_DATA = 256
"""How many data local optimisation looks at."""
NUMBERS = 1 << 15
"""Numbers in one row of all data of several problems, on a CPU."""
_MOST_STEPS = 64
"""Steps of the final refinement, of which there are two at least, for what still moves."""
_STILL, _SMALL = 1e-7, 1e-10
"""What has no more than so much of the first step, or of the model, before it is still."""
_ROUNDING, _DRAWN = 1e-6, 9.0
"""The share by which a step may raise the loss, as it leaves its manifold a little; how many times its length a step is drawn
out at most."""
_FLAT, _LEAST = 0.1, 1e-6
"""The least curvature of a datum in units of its weight, and of all data in units of one."""


def optimise_locally(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g k"],
    counts: Tensor,
    scoring: Scoring,
    steps: tuple[float, ...] = LOCAL_STEPS,
) -> M:
    """Gauss-Newton on the scoring's own weights with a shrinking threshold (Chum, Matas & Kittler 2003).

    Args:
        estimator: The problem.
        model: `k` models of each problem, `(g, k, ...)`.
        data: The data, each `(g, 1, n, d)`.
        limit: Squared thresholds.
        counts: What the data count, `(g, n)`: a boolean or a weight.
        scoring: How models are compared.
        steps: Squared thresholds of the steps, in units of the squared threshold.
    """
    for factor in steps:
        model = _local_step(estimator, model, data, factor * limit, counts, scoring)
    return model


def _local_step(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Tensor, counts: Tensor, scoring: Scoring
) -> M:
    scale = limit.reciprocal()[..., None]

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        weights = scoring.weigh(squared * scale, estimator.codimension) * counts[:, None]
        return weights, weights

    return estimator.step(model, *data, weigh=weigh)


def optimise_fully(
    estimator: Estimator[M],
    start: M,
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
) -> tuple[M, Bool[Tensor, "g"]]:
    """Steps from one model of each problem, the first already taken, to a minimum of the loss of `step_within`.

    Only a minimum has a derivative. A step that raises the loss is taken back and the next one damped (Levenberg 1944): in the
    limit it is a short one of reweighted least squares, which cannot raise it. Steps that shrink slowly are drawn out (Anderson
    1965, of depth 1).

    Args:
        estimator: The problem.
        start: Where the first step started, `(g, ...)`.
        model: Where it led.
        data: The data, each `(g, n, d)`.
        reach: Squared distance beyond which a datum does not matter.
        counts: What the data count, `(g, n)`: a boolean or a weight.

    Returns:
        The minima, and where they were reached.
    """
    settled = torch.zeros_like(reach, dtype=torch.bool)
    found, row = model, torch.arange(len(reach), device=reach.device)
    problem: tuple[Any, ...] = (estimator, tuple(data), reach, counts)
    # What started in lower precision was beside the manifold, where the loss may be less than anywhere on it.
    entries = _entries(model)
    step, start, last = entries - _entries(start), model, model
    length = _length(step)
    still = torch.maximum(_STILL * length, _SMALL * _length(entries))
    least, damping = torch.full_like(reach, torch.inf), torch.zeros_like(reach)
    for count in range(2, _MOST_STEPS + 1):
        own, values, edge, counted = problem
        moved, loss = in_portions(step_within, own, model, values, edge, counted, damping)
        # A loss that is no number is none.
        good = loss <= least * (1 + _ROUNDING)
        damping = torch.where(good, damping / 4, (4 * damping).clamp(min=1))
        start, least = select(good, model, start), torch.where(good, loss, least)
        before, step = step, _entries(moved) - _entries(model)
        shrunk, length = length, _length(step)
        # As a geometric series, steps that shrink have length^2 / (shrunk - length) before them.
        done = good & (length * length <= still * torch.maximum(length, shrunk - length))
        drawn = _drawn_out(moved, last, step, before) if count > 2 else moved
        last, model = moved, select(good, drawn, start)
        if not (bool(done.any()) or count == _MOST_STEPS):
            continue
        found = put(found, row, select(done, moved, start))
        settled = settled.index_copy(0, row, done)
        rest = (~done).nonzero()[:, 0]
        if not len(rest):
            break
        row, problem, start, last, model, step, length, still, least, damping = tensor_map(
            lambda t: t[rest],  # noqa: B023
            (row, problem, start, last, model, step, length, still, least, damping),
        )
    return found, settled


def _drawn_out(moved: M, last: M, step: Float[Tensor, "g e"], before: Float[Tensor, "g e"]) -> M:
    """Where two steps, and the models they led to, say that steps lead."""
    change = step - before
    share = ((step * change).sum(-1) / (change * change).sum(-1)).nan_to_num(nan=0.0).clamp(-_DRAWN, 0.5)
    return zip_map(lambda t, old: torch.addcmul(t, share.view(-1, *(1,) * (t.ndim - 1)), t - old, value=-1), moved, last)


def _entries(model: Any) -> Float[Tensor, "g e"]:
    """The entries of models `(g, ...)` side by side."""
    parts = [t.flatten(1) if t.ndim > 1 else t[:, None] for t in tensors_of(model)]
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def _length(entries: Float[Tensor, "g e"]) -> Float[Tensor, "g"]:
    length: Tensor = torch.linalg.vector_norm(entries, dim=-1)
    return length


def in_portions(function: Callable[..., T], estimator: Any, model: Any, data: Sequence[Tensor], *known: Tensor) -> T:
    """A function of problems `(g)` with so much data each, some of them at a time: what stays in a CPU's cache."""
    problems = (estimator, model, tuple(data), *known)
    g, n = data[0].shape[:2]
    size = max(1, portion(NUMBERS, data[0].device) // max(n, 1))
    if g <= size:
        return function(*problems)
    return join([function(*tensor_map(lambda t: t[i : i + size], problems)) for i in range(0, g, size)])  # noqa: B023


def step_within(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
    damping: Float[Tensor, "g"] | None = None,
) -> tuple[M, Float[Tensor, "g"]]:
    """A step towards a minimum of the sum of u - u^2 / 2, u the squared distance over the squared reach; that sum before it.

    Args:
        estimator: The problem.
        model: One model of each problem, `(g, ...)`.
        data: The data, each `(g, n, d)`.
        reach: Squared distance beyond which a datum does not matter.
        counts: What the data count, `(g, n)`: a boolean or a weight.
        damping: How much of least squares to add to the curvature of the loss; none if not given.
    """
    loss = reach

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal loss
        u = (squared / reach[:, None]).clamp(max=1)
        loss = (torch.addcmul(u, u, u, value=-0.5) * counts).sum(-1)
        weights, curvature = falling(u, counts, estimator.codimension)
        return weights, curvature if damping is None else torch.addcmul(curvature, damping[:, None], weights)

    return estimator.step(model, *data, weigh=weigh), loss


def falling(u: Tensor, counts: Tensor, codimension: int) -> tuple[Tensor, Tensor]:
    """Weight and curvature of the loss u - u^2 / 2, for u up to 1, its maximum.

    Curvatures that are negative, or next to nothing, could make the Hessian indefinite or vanish. What they are raised by is
    taken from all in proportion, so that steps are as long as they should be on average, and bounded by a multiple of those of
    reweighted least squares.
    """
    counts = (u < 1) * counts
    weights = (1 - u) * counts
    curvature = torch.addcmul(weights, u, counts, value=-2 / codimension)
    raised = torch.maximum(curvature, _FLAT * weights)
    share = curvature.sum(-1, keepdim=True) / raised.sum(-1, keepdim=True).clamp(min=_LEAST)
    return weights, raised * share.clamp(min=0.3)
