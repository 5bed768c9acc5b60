"""Hypotheses: models through samples of the data, and the few of them that more and more of the data support."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.portions import portion
from torchsfm.robust.estimator import Estimator, is_never_zero
from torchsfm.robust.models import cast, take_slots, tensors_of
from torchsfm.robust.problems import Problems
from torchsfm.robust.samplers import Sampler
from torchsfm.robust.scoring import Scoring

M = TypeVar("M")

NUMBERS = 1 << 17
"""How many distances to compute at a time, on a CPU."""
PREFIXES = (64, 512)
"""Numbers of data on which hypotheses are judged before all data are looked at, where these are four times as many."""
KEPT = (16, 8)
"""The fewest hypotheses that are kept after each."""
SHARE = 64
"""Of how many hypotheses one is kept after the first."""


def solve_samples(
    fine: Problems, part: Int[Tensor, "g"], drawn: Int[Tensor, "g"], number: int, seed: int, sampler: Sampler
) -> tuple[Any, Bool[Tensor, "g number slots"]]:
    """The models through samples of some of the problems, and which slots hold any.

    Args:
        fine: All problems.
        part: Which of them to draw for.
        drawn: How many samples each had before.
        number: How many to draw.
        seed: Seed of the whole call.
        sampler: Draws.
    """
    index = sampler.draw(fine, part, drawn, number, seed)
    m = fine.estimator.sample_size
    # Coordinate, position in the sample, problem, sample: as solvers want it, who have the batch last.
    flat = (index + (part * fine.width).view(-1, 1, 1)).transpose(0, 1).flatten()
    sample = []
    for d in fine.data:
        picked = d.permute(2, 0, 1).flatten(1).index_select(1, flat)
        sample.append(picked.view(-1, m, len(part), number).permute(2, 3, 1, 0))
    estimator = tensor_map(lambda t: t[part, None], fine.estimator)
    solutions = estimator.minimal(*sample)
    return solutions.model, solutions.valid & ~estimator.degenerate(*sample)[..., None]


def sift(
    coarse: Problems,
    models: Any,
    valid: Bool[Tensor, "g number slots"],
    scoring: Scoring,
    plan: Sequence[tuple[int, int]],
    kept: int,
) -> tuple[Any, Float[Tensor, "g kept"], Bool[Tensor, "g"]]:
    """The best models and their losses, best first, found by way of ever larger parts of the data; and whether there was any.

    Args:
        coarse: The problems.
        models: Their hypotheses.
        valid: Which of these are any.
        scoring: How to compare.
        plan: On how many data to compare, and how many to keep, stage by stage.
        kept: How many to keep in the end.
    """
    wide, slots = coarse.spread(), valid.shape[-1]
    index, there = gather_valid(valid.flatten(1), kept)
    row = torch.arange(len(index), device=index.device)[:, None]
    models = cast(tensor_map(lambda t: t[row, index // slots, index % slots], models), coarse.limit.dtype)
    loss = there
    for number, keep in plan:
        data = [d[:, :, :number] for d in wide.data]
        counts = coarse.counts[:, :number] if coarse.weight is not None or number == coarse.width else None
        loss = losses(wide.estimator, models, data, coarse.limit, counts, scoring)
        loss = torch.where(there, loss, torch.inf)
        chosen = smallest(loss, keep)
        loss = loss.gather(1, chosen)
        models, there = take_slots(models, chosen), there.gather(1, chosen)
    return tensor_map(lambda t: t[:, :kept], models), loss[:, :kept], there[:, 0]


def stages(width: int, slots: int) -> list[tuple[int, int]]:
    """On how many data `slots` models are scored, stage by stage, and how many of the models are kept each time."""
    plan = []
    for level, (prefix, fewest) in enumerate(zip(PREFIXES, KEPT, strict=True)):
        keep = max(fewest, slots // SHARE) if level == 0 else fewest
        if 4 * prefix <= width and keep < slots:
            plan.append((prefix, keep))
            slots = keep
    return [*plan, (width, KEPT[-1])]


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
        one = size / size if is_never_zero(estimator) else size - size + 1
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


def gather_valid(valid: Bool[Tensor, "g s"], least: int) -> tuple[Int[Tensor, "g _"], Bool[Tensor, "g _"]]:
    """Where the valid slots of each row are, in as few columns as the fullest row needs or `least`, and which are filled."""
    g, slots = valid.shape
    rank = valid.cumsum(-1)
    columns = max(int(rank[:, -1].max()) if valid.numel() else 0, least)
    index = torch.zeros(g, columns + 1, dtype=torch.long, device=valid.device)
    position = torch.where(valid, rank - 1, columns)
    index.scatter_(1, position, torch.arange(slots, device=valid.device).expand(g, slots))
    filled = torch.arange(columns, device=valid.device) < rank[:, -1:]
    return index[:, :columns], filled
