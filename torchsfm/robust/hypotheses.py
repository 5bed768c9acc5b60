"""Hypotheses: models through random samples, and the few of them that more and more of the data support."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.models import cast, take_slots
from torchsfm.robust.problems import Problems
from torchsfm.robust.sampling import draw_samples, draw_weighted, prosac_pools
from torchsfm.robust.scores import Score, counted
from torchsfm.robust.scoring import gather_valid, losses, smallest, stages

OPTIMISED = 2
"""Hypotheses of a round that are optimised locally."""


def hypotheses(
    fine: Problems,
    part: Int[Tensor, "g"],
    drawn: Int[Tensor, "g"],
    size: int,
    seed: int,
    among: tuple[Int[Tensor, "g width"], Int[Tensor, "g size"]] | None = None,
) -> tuple[Any, Bool[Tensor, "g size slots"]]:
    """The models through random samples of some of the problems.

    Args:
        fine: All problems.
        part: Which of them to draw for.
        drawn: How many samples each had before.
        size: How many to draw.
        seed: The seed.
        among: An order of the data, and from how many of the first to draw each sample; as the problems want it if not given.
    """
    m, count, newest = fine.estimator.sample_size, fine.count[part], None
    if among is None and fine.ranking is not None and fine.growth is not None:
        pool, newest = prosac_pools(count, fine.growth[part], drawn, size, m)
        among = fine.ranking[part], pool
    if among is not None:
        index = draw_samples(seed, count, drawn, size, m, among[1], newest)
        index = among[0].gather(1, index.flatten(1)).view_as(index)
    elif fine.weight is not None:
        index = draw_weighted(seed, fine.weight[part], count, drawn, size, m)
    else:
        index = draw_samples(seed, count, drawn, size, m)
    # Coordinate, position in the sample, problem, sample: as solvers want it, who have the batch last.
    flat = (index + part[:, None, None] * fine.width).transpose(0, 1).flatten()
    sample = []
    for d in fine.data:
        picked = d.permute(2, 0, 1).flatten(1).index_select(1, flat)
        sample.append(picked.view(-1, m, len(part), size).permute(2, 3, 1, 0))
    estimator = tensor_map(lambda t: t[part, None], fine.estimator)
    solutions = estimator.minimal(*sample)
    return solutions.model, solutions.valid & ~estimator.degenerate(*sample)[..., None]


def sift(
    coarse: Problems,
    models: Any,
    valid: Bool[Tensor, "g size slots"],
    score: Score,
    dtype: torch.dtype,
    plan: Sequence[tuple[int, int]] | None = None,
) -> tuple[Any, Float[Tensor, "g kept"], Bool[Tensor, "g"]]:
    """The best models and their losses, best first, found by way of ever larger parts of the data.

    Args:
        coarse: The problems.
        models: Their hypotheses.
        valid: Which of these are any.
        score: How to compare.
        dtype: In which precision.
        plan: On how many data to compare, and how many to keep, stage by stage; all data at last, and the few to be optimised,
            if not given.
    """
    wide, slots = coarse.spread(), valid.shape[-1]
    kept = OPTIMISED if plan is None else plan[-1][1]
    plan = plan or stages(coarse.width, valid.shape[1] * slots)
    index, there = gather_valid(valid.flatten(1), kept)
    row = torch.arange(len(index), device=index.device)[:, None]
    models = cast(tensor_map(lambda t: t[row, index // slots, index % slots], models), dtype)
    loss = there
    for number, keep in plan:
        data = [d[:, :, :number] for d in wide.data]
        counts = counted(coarse.inside, coarse.weight, number)
        loss = losses(wide.estimator, models, data, coarse.limit, counts, score)
        loss = torch.where(there, loss, torch.inf)
        chosen = smallest(loss, keep)
        loss = loss.gather(1, chosen)
        models, there = take_slots(models, chosen), there.gather(1, chosen)
    return tensor_map(lambda t: t[:, :kept], models), loss[:, :kept], there[:, 0]
