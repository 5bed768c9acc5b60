"""Hypotheses: models through samples of the data, and the few of them that more and more of the data support."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.portions import portion
from torchsfm.linalg.real_roots import number_among_equals
from torchsfm.linalg.rows import take_columns
from torchsfm.robust.estimator import Estimator, NeverZero, is_kind
from torchsfm.robust.models import cast, take_slots, tensors_of
from torchsfm.robust.problems import Problems
from torchsfm.robust.samplers import Sampler
from torchsfm.robust.scoring import Scoring

M = TypeVar("M")

_SURE = 3.0
"""Of how many standard deviations a part of the data must show that a model is worse than the best so far."""
NUMBERS = 1 << 17
"""How many distances to compute at a time, on a CPU."""
PREFIXES = (64, 256)
"""Numbers of data on which hypotheses are judged before all data are looked at; on the second where these are many more."""
KEPT = (16, 8)
"""The fewest hypotheses that are kept after each."""
_MANY = 1 << 15
"""From how many distances on the second of these pays."""
SHARE = 64
"""Of how many hypotheses one is kept after the first."""


def solve_samples(
    problems: Problems,
    part: Int[Tensor, "g"],
    drawn: Int[Tensor, "g"],
    number: Int[Tensor, "g"],
    seed: int,
    sampler: Sampler,
    least: int = 1,
) -> tuple[Any, Bool[Tensor, "g columns"]]:
    """The models through samples of some of the problems, in as many columns as the fullest row needs, and which hold any.

    Args:
        problems: All problems.
        part: Which of them to draw for.
        drawn: How many samples each had before.
        number: How many to draw for each.
        seed: Seed of the whole call.
        sampler: Draws.
        least: The fewest columns.
    """
    numbers, m = number.tolist(), problems.estimator.sample_size
    most = max(numbers)
    index = sampler.draw(problems, part, drawn, most, seed)
    # Position in the sample, then problem and sample: as solvers want it, who have the batch last.
    flat = (index + (part * problems.width).view(-1, 1, 1)).transpose(0, 1).flatten(1)
    if min(numbers) < most:
        flat = take_columns(flat, (torch.arange(most, device=part.device) < number[:, None]).flatten().nonzero()[:, 0])
    row, flat = torch.arange(len(part), device=part.device).repeat_interleave(number), flat.flatten()
    sample = [d.permute(2, 0, 1).flatten(1).index_select(1, flat).view(-1, m, len(row)).permute(2, 1, 0) for d in problems.data]
    estimator = tensor_map(lambda t: t[part[row]], problems.estimator)
    solutions = estimator.minimal(*sample)
    good = (solutions.valid & ~estimator.degenerate(*sample)[:, None]).flatten().nonzero()[:, 0]
    row = row.index_select(0, good // solutions.valid.shape[1])
    rank = number_among_equals(row)
    columns = max(int(rank.max()) + 1 if len(rank) else 0, least)
    place = torch.add(rank, row, alpha=columns)
    shape = (len(part), columns)
    there = torch.zeros(len(part) * columns, dtype=torch.bool, device=part.device).index_fill_(0, place, True)

    def filled(t: Tensor) -> Tensor:
        t = t.flatten(0, 1).index_select(0, good)
        return t.new_zeros(len(there), *t.shape[1:]).index_copy_(0, place, t).view(*shape, *t.shape[1:])

    return tensor_map(filled, solutions.model), there.view(shape)


def sift(
    coarse: Problems,
    models: Any,
    there: Bool[Tensor, "g columns"],
    scoring: Scoring,
    plan: Sequence[tuple[int, Int[Tensor, "g"]]],
    kept: int,
    least: Float[Tensor, "g"] | None = None,
) -> tuple[Any, Float[Tensor, "g kept"]]:
    """The best models and their losses, best first, found by way of ever larger parts of the data.

    Args:
        coarse: The problems.
        models: Their hypotheses.
        there: Which of these are any.
        scoring: How to compare.
        plan: On how many data to compare, and how many to keep for each problem, stage by stage.
        kept: How many to keep in the end.
        least: The least loss so far: of what a part of the data shows to be worse only so many as are kept are looked at again.
            Losses are then sums over the data of 1 at most.
    """
    wide, models, loss = coarse.spread(), cast(models, coarse.limit.dtype), coarse.limit
    for number, keep in plan:
        data = [d[:, :, :number] for d in wide.data]
        all_alike = coarse.weight is None and number <= int(coarse.count.min())
        counts = None if all_alike else coarse.counts[:, :number]
        loss = losses(wide.estimator, models, data, coarse.limit, counts, scoring)
        loss = torch.where(there, loss, torch.inf)
        chosen = smallest(loss, int(keep.max()))
        loss, there = loss.gather(1, chosen), there.gather(1, chosen)
        if number < coarse.width:
            # How many a problem keeps does not depend on the others.
            there &= torch.arange(chosen.shape[1], device=keep.device) < keep[:, None]
            if least is not None:
                there[:, kept:] &= loss[:, kept:] <= _most_of_part(least, coarse, number)[:, None]
            columns = max(kept, int(there.sum(-1).max()))
            chosen, loss, there = chosen[:, :columns], loss[:, :columns], there[:, :columns]
        models = take_slots(models, chosen)
    return tensor_map(lambda t: t[:, :kept], models), loss[:, :kept]


def _most_of_part(least: Float[Tensor, "g"], problems: Problems, number: int) -> Float[Tensor, "g"]:
    """The loss over the first data, each at most 1, beyond which a model is hardly one of less than the least over all."""
    counts = problems.counts.to(least.dtype)
    part = counts[:, :number]
    share = (least / counts.sum(-1)).clamp(max=1)
    variance = share * (1 - share)
    return share * part.sum(-1) + _SURE * (variance * (part * part).sum(-1)).sqrt()


def stages(problems: Problems, slots: Int[Tensor, "g"]) -> list[tuple[int, Int[Tensor, "g"]]]:
    """On how many data so many models of each problem are scored, stage by stage, and how many of them are kept each time."""
    plan, (first, second) = [], KEPT
    keep, last = (slots // SHARE).clamp(min=first), torch.full_like(slots, second)
    if PREFIXES[0] < problems.width:
        plan.append((PREFIXES[0], keep))
        many = (problems.count > 2 * PREFIXES[1]) & (keep * problems.count >= _MANY)
        if bool(many.any()):
            plan.append((PREFIXES[1], torch.where(many, last, keep)))
    return [*plan, (problems.width, last)]


def squared_residual(estimator: Estimator[M], model: M, *data: Float[Tensor, "*#batch n _"]) -> Float[Tensor, "*batch n"]:
    """The squared distance of data to models of as many batch dimensions: infinite or no number where a model is none."""
    return estimator.squared_residual(_no_numbers_for_none(estimator, model, data[0].ndim - 2), *data)


def _no_numbers_for_none(estimator: Estimator[M], model: M, dims: int) -> M:
    """NaN in the place of what is no model: not finite, or zero where the estimator says that this is none."""
    with torch.no_grad():
        own = [(t, tuple(range(dims, t.ndim))) for t in tensors_of(model)]
        parts = [torch.linalg.vector_norm(t, dim=dim) if dim else t.abs() for t, dim in own]
        size = parts[0] if len(parts) == 1 else torch.stack(parts).sum(0)
        # 1, but 0 / 0 or inf / inf; or 0, but inf - inf.
        one = size / size if is_kind(estimator, NeverZero) else size - size + 1
    return tensor_map(lambda t: t * one.reshape(one.shape + (1,) * (t.ndim - dims)), model)


def losses(
    estimator: Estimator[M],
    models: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    counts: Tensor | None,
    scoring: Scoring,
) -> Float[Tensor, "g s"]:
    """The cost of `s` models of each problem, computed in portions that stay in the cache.

    Args:
        estimator: The problem, with a dimension of size 1 for the models.
        models: `(g, s, ...)`.
        data: `(g, 1, n, d)` each.
        limit: Squared threshold.
        counts: What the data count, `(g, n)`: a boolean or a weight; all alike if not given.
        scoring: How models are compared.
    """
    (first, *_) = tensors_of(models)
    g, s = first.shape[:2]
    each = s * data[0].shape[-2]
    step = max(1, portion(NUMBERS, first.device) // max(each, 1))
    rows = []
    for i in range(0, g, step):
        some = slice(i, i + step)
        whole = (estimator, models, tuple(data), limit, counts)
        own, of, at, edge, part = whole if step >= g else tensor_map(lambda t: t[some], whole)  # noqa: B023
        rows.append(scoring.cost(squared_residual(own, of, *at), edge, part, own.codimension))
    if not rows:
        return limit.new_zeros(g, s)
    return rows[0] if len(rows) == 1 else torch.cat(rows)


def smallest(loss: Float[Tensor, "g s"], number: int) -> Int[Tensor, "g number"]:
    """The models with the smallest losses, best first.

    Of models that are equal but for rounding the first: else the number of columns, which is that of the fullest row, decides,
    and nonsense, of which nothing agrees with anything, feels its neighbours.
    """
    columns = loss.shape[-1]
    return (loss * _later(columns, loss.dtype, loss.device)).topk(min(number, columns), dim=-1, largest=False).indices


@lru_cache(maxsize=64)
def _later(columns: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "columns"]:
    with torch.inference_mode(False):
        return torch.arange(columns, device=device, dtype=dtype).mul_(torch.finfo(dtype).eps).add_(1)
