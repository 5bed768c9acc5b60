"""From a model through a noisy sample to the optimum near it."""

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.fused import fused
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import put, select, tensors_of, zip_map
from torchsfm.robust.scoring import Scoring

M = TypeVar("M")

LOCAL_STEPS = (9.0, 3.0, 1.0)
"""Squared thresholds of the steps of local optimisation, in units of the squared threshold."""
LOCAL_DATA = 256
"""How many data local optimisation looks at."""
_LAST_STEPS, _MOST_STEPS = 3, 64
"""Steps of the final refinement at least, and at most for what still moves."""
_STILL, _SMALL = 1e-5, 1e-10
"""What moves by less than so much of the first step, or of the model, is still."""
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
) -> M:
    """Gauss-Newton on the scoring's own weights with a shrinking threshold (Chum, Matas & Kittler 2003).

    Args:
        estimator: The problem.
        model: `k` models of each problem, `(g, k, ...)`.
        data: The data, each `(g, 1, n, d)`.
        limit: Squared thresholds.
        counts: What the data count, `(g, n)`: a boolean or a weight.
        scoring: How models are compared.
    """
    for factor in LOCAL_STEPS:
        model = _local_step(estimator, model, data, factor * limit, counts, scoring)
    return model


@fused("g 1", "g k", "g 1 n", "g k", "g n")
def _local_step(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Tensor, counts: Tensor, scoring: Scoring
) -> M:
    scale = (1 / limit)[..., None]

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        weights = scoring.weigh(squared * scale, estimator.codimension) * counts[:, None]
        return weights, weights

    return estimator.step(model, *data, weigh=weigh)


def optimise_within(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
    steps: int,
) -> M:
    """Steps from models `(g, 1, ...)` to a minimum of the sum of u - u^2 / 2, u the squared distance over the squared reach."""
    for _ in range(steps):
        model, _ = _step_within(estimator, model, data, reach, counts, torch.zeros_like(reach))
    return model


def optimise_fully(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
) -> tuple[M, Bool[Tensor, "g"]]:
    """That minimum itself, and where it was reached: only a minimum has a derivative.

    A step that raises the loss is taken back and the next one damped (Levenberg 1944): in the limit it is a short one of
    reweighted least squares, which cannot raise it. Steps that shrink slowly are drawn out (Anderson 1965, of depth 1).
    """
    settled = torch.zeros_like(reach, dtype=torch.bool)
    # What comes in lower precision is beside the manifold, where the loss may be less than anywhere on it.
    coarse, model = model, optimise_within(estimator, model, data, reach, counts, 1)
    found, row = model, torch.arange(len(reach), device=reach.device)
    problem: tuple[Any, ...] = (estimator, tuple(data), reach, counts)
    start, last, step = model, model, zip_map(torch.sub, model, coarse)
    first, least, damping = _size(step), torch.full_like(reach, torch.inf), torch.zeros_like(reach)
    for count in range(2, _MOST_STEPS + 1):
        own, values, edge, counted = problem
        moved, loss = _step_within(own, model, values, edge, counted, damping)
        # A loss that is no number is none.
        good = loss <= least * (1 + _ROUNDING)
        damping = torch.where(good, torch.where(loss < least, damping / 4, damping), (4 * damping).clamp(min=1))
        start, least = select(good, model, start), torch.where(good, loss, least)
        before, step = step, zip_map(torch.sub, moved, model)
        size = _size(step)
        done = good & ((size <= _STILL * first) | (size <= _SMALL * _size(moved)))
        drawn = _drawn_out(moved, last, step, before) if count > 2 else moved
        last, model = moved, select(good, drawn, start)
        if count < _LAST_STEPS or not (bool(done.any()) or count == _MOST_STEPS):
            continue
        found = put(found, row, select(done, moved, start))
        settled = settled.index_copy(0, row, done)
        rest = (~done).nonzero()[:, 0]
        if not len(rest):
            break
        row, problem, start, last, model, step, first, least, damping = tensor_map(
            lambda t: t[rest],  # noqa: B023
            (row, problem, start, last, model, step, first, least, damping),
        )
    return found, settled


def _drawn_out(moved: M, last: M, step: M, before: M) -> M:
    """Where two steps, and the models they led to, say that steps lead."""
    change = zip_map(torch.sub, step, before)
    share = (_dot(step, change) / _dot(change, change)).nan_to_num(nan=0.0).clamp(-_DRAWN, 0.5)
    return zip_map(lambda t, old: t - share.reshape(-1, *(1,) * (t.ndim - 1)) * (t - old), moved, last)


def _dot(model: M, other: M) -> Float[Tensor, "g"]:
    """The sum of products of the entries of models `(g, 1, ...)`."""
    return torch.stack([t.flatten(1).sum(-1) for t in tensors_of(zip_map(torch.mul, model, other))]).sum(0)


def _size(model: M) -> Float[Tensor, "g"]:
    """The length of the entries of models."""
    return _dot(model, model).sqrt()


@fused("g 1", "g 1", "g 1 n", "g", "g n", "g")
def _step_within(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], reach: Tensor, counts: Tensor, damping: Tensor
) -> tuple[M, Tensor]:
    """A step, and the loss `(g)` before it."""
    scale, loss = (1 / reach)[:, None, None], reach

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal loss
        u = (squared * scale).clamp(max=1)
        loss = ((u - 0.5 * u * u) * counts[:, None]).sum(-1)[:, 0]
        weights, curvature = falling(u, counts, estimator.codimension)
        return weights, curvature + damping[:, None, None] * weights

    return estimator.step(model, *data, weigh=weigh), loss


def falling(u: Tensor, counts: Tensor, codimension: int) -> tuple[Tensor, Tensor]:
    """Weight and curvature of the loss u - u^2 / 2, up to its maximum.

    Curvatures that are negative, or next to nothing, could make the Hessian indefinite or vanish. What they are raised by is
    taken from all in proportion, so that steps are as long as they should be on average, and bounded by a multiple of those of
    reweighted least squares.
    """
    u, counts = u.clamp(max=1), counts[:, None]
    slope = 1 - u
    curvature = slope - (2 / codimension) * u * (slope > 0)
    total, curvature = (curvature * counts).sum(-1, keepdim=True), torch.maximum(curvature, _FLAT * slope) * counts
    share = total / curvature.sum(-1, keepdim=True).clamp(min=_LEAST)
    return slope * counts, curvature * share.clamp(min=0.3)
