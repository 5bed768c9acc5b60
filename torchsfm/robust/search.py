"""The search itself, for problems of like size: sample, solve, score, optimise, until each problem has had enough."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.local_optimisation import LOCAL_DATA, optimise_locally, polish
from torchsfm.robust.models import cast, join, select, take_slots, zip_map
from torchsfm.robust.problems import Problems
from torchsfm.robust.sampling import draw_samples, guided_pools
from torchsfm.robust.scoring import gather_valid, smallest, squared_residual, stages, truncated_loss

FIRST_ROUND = 64
LARGEST_ROUND = 2048
SCORED = 8
"""Hypotheses of a round that are scored on all data."""
OPTIMISED = 3
"""Hypotheses of a round that are optimised locally."""
POLISH_STEPS = 6
_CHUNK = 1 << 18
"""Numbers in the largest intermediate array on a CPU: what fits its cache."""


@dataclass(frozen=True)
class Options:
    """When to stop, and in which precision to score."""

    seed: int
    confidence: float
    min_iterations: int
    max_iterations: int
    dtype: torch.dtype


@dataclass(frozen=True)
class Best:
    """The best model found for each problem.

    Attributes:
        model: The model.
        loss: Its truncated loss over all data; infinite where there is none.
        support: Its number of inliers.
        minimal_loss: The least loss of a model straight from a sample.
        solved: Whether any sample had a solution.
        iterations: Number of samples drawn.
    """

    model: Any
    loss: Float[Tensor, "p"]
    support: Int[Tensor, "p"]
    minimal_loss: Float[Tensor, "p"]
    solved: Bool[Tensor, "p"]
    iterations: Int[Tensor, "p"]


def search(problems: Problems, options: Options) -> Best:
    """Find the best model of each problem, in float64, refined."""
    p, device = len(problems.count), problems.count.device
    infinite = torch.full((p,), torch.inf, dtype=options.dtype, device=device)
    none = torch.zeros(p, dtype=torch.long, device=device)
    best = Best(cast(no_model(problems.estimator, problems.data, p), options.dtype), infinite, none, infinite, none > 0, none)
    coarse = problems.cast(options.dtype)
    active = torch.arange(p, device=device)
    drawn, size = 0, FIRST_ROUND
    while len(active):
        group = _chunk(device, size * problems.estimator.max_solutions * min(problems.width, 64))
        parts = []
        for part in torch.split(active, group):
            parts.append(_round(problems.take(part), coarse.take(part), _take(best, part), options, drawn, size))
        found = join(parts)
        best = _put(best, active, found)
        drawn += size
        if drawn >= options.max_iterations:
            break
        needed = samples_needed(found.support, problems.count[active], problems.estimator.sample_size, options.confidence)
        active = active[(drawn < needed) | (drawn < options.min_iterations)]
        size = min(drawn, LARGEST_ROUND)
    return _polished(problems, best)


def no_model(estimator: Any, data: Sequence[Tensor], number: int) -> Any:
    """Zeros in the form of a model for each of a number of problems."""
    none = tensor_map(lambda t: t[:0], estimator)
    samples = [d.new_zeros(0, estimator.sample_size, d.shape[-1]) for d in data]
    return tensor_map(lambda t: t.new_zeros(number, *t.shape[2:]), none.minimal(*samples).model)


def samples_needed(support: Int[Tensor, "p"], count: Int[Tensor, "p"], size: int, confidence: float) -> Float[Tensor, "p"]:
    """How many samples it takes to have drawn, with the given confidence, one of `support` among `count` data alone."""
    steps = torch.arange(size, device=count.device)
    inlying = (support[:, None] - steps).clamp(min=0).double() / (count[:, None] - steps).double()
    return math.log(1 - confidence) / torch.log1p(-inlying.prod(-1))


def _chunk(device: torch.device, elements: int) -> int:
    """How many problems to treat at a time when each needs so many numbers; devices other than CPUs want more at a time."""
    return max(1, (_CHUNK if device.type == "cpu" else 256 * _CHUNK) // elements)


def _round(fine: Problems, coarse: Problems, best: Best, options: Options, drawn: int, size: int) -> Best:
    """Draw samples for each problem, and update the best models with what comes of them."""
    models, valid = _hypotheses(fine, options, drawn, size)
    models, loss = _cascade(coarse, cast(models, options.dtype), valid)
    improved = (loss[:, 0] < best.minimal_loss).nonzero()[:, 0]
    solved = best.solved | valid.any(-1)
    best = Best(best.model, best.loss, best.support, best.minimal_loss, solved, best.iterations + size)
    if not len(improved):
        return best
    some = coarse.take(improved)
    wide = some.spread()
    top = tensor_map(lambda t: t[improved, :OPTIMISED], models)
    prefix = [d[:, :, :LOCAL_DATA] for d in wide.data]
    better = optimise_locally(wide.estimator, top, prefix, some.limit, some.inside[:, :LOCAL_DATA])
    candidates = join([better, tensor_map(lambda t: t[:, :1], top)], 1)
    squared = squared_residual(wide.estimator, candidates, *wide.data)
    candidate_loss = truncated_loss(squared, some.limit, some.inside)
    support = ((squared < some.limit[:, None, None]) & some.inside[:, None]).sum(-1)
    winner = candidate_loss.argmin(-1, keepdim=True)
    old = _take(best, improved)
    new_loss = candidate_loss.gather(1, winner)[:, 0]
    gain = new_loss < old.loss
    new = Best(
        select(gain, tensor_map(lambda t: t[:, 0], take_slots(candidates, winner)), old.model),
        torch.where(gain, new_loss, old.loss),
        torch.where(gain, support.gather(1, winner)[:, 0], old.support),
        loss[improved, 0],
        old.solved,
        old.iterations,
    )
    return _put(best, improved, new)


def _hypotheses(fine: Problems, options: Options, drawn: int, size: int) -> tuple[Any, Bool[Tensor, "g slots"]]:
    """The models through random samples, all solution slots of all samples in a row."""
    m = fine.estimator.sample_size
    pool = None if fine.ranking is None else guided_pools(fine.count, drawn, size, m)
    index = draw_samples(options.seed, fine.count, drawn, size, m, pool).flatten(1)
    if fine.ranking is not None:
        index = fine.ranking.gather(1, index)
    sample = []
    for d in fine.data:
        picked = d.mT.gather(2, index[:, None].expand(-1, d.shape[-1], -1))
        sample.append(picked.reshape(*picked.shape[:2], m, size).permute(0, 3, 2, 1))
    estimator = fine.spread().estimator
    solutions = estimator.minimal(*sample)
    valid = solutions.valid & ~estimator.degenerate(*sample)[..., None]
    return tensor_map(lambda t: t.flatten(1, 2), solutions.model), valid.flatten(1)


def _cascade(coarse: Problems, models: Any, valid: Bool[Tensor, "g slots"]) -> tuple[Any, Float[Tensor, "g kept"]]:
    """The best models and their losses over all data, best first, found by way of ever larger parts of the data."""
    wide = coarse.spread()
    for level, (number, keep) in enumerate(stages(coarse.width, valid.shape[-1], SCORED)):
        data = [d[:, :, :number] for d in wide.data]
        inside = coarse.inside if number == coarse.width else None
        slots = valid.shape[-1]
        if level == 0 and coarse.estimator.max_solutions > 1:
            column, filled = gather_valid(valid)
            squared = squared_residual(wide.estimator, take_slots(models, column), *data)
            part = truncated_loss(squared, coarse.limit, inside)
            loss = part.new_full((len(part), slots + 1), torch.inf)
            loss = loss.scatter_(1, torch.where(filled, column, slots), part)[:, :slots]
        else:
            squared = squared_residual(wide.estimator, models, *data)
            loss = truncated_loss(squared, coarse.limit, inside)
        loss = torch.where(valid, loss, torch.inf)
        chosen = smallest(loss, keep)
        models, loss, valid = take_slots(models, chosen), loss.gather(1, chosen), valid.gather(1, chosen)
    return models, loss


def _polished(problems: Problems, best: Best) -> Best:
    """Refine the best models in float64 on all data, and keep what does not lose support."""
    group = _chunk(problems.count.device, 16 * problems.width)
    parts = []
    for part in torch.split(torch.arange(len(problems.count), device=problems.count.device), group):
        some, old = problems.take(part), cast(_take(best, part), torch.float64)
        wide = some.spread()
        start = tensor_map(lambda t: t[:, None], old.model)
        model = polish(wide.estimator, start, wide.data, some.limit, some.inside, POLISH_STEPS)
        both = join([model, start], 1)
        squared = squared_residual(wide.estimator, both, *wide.data)
        loss = truncated_loss(squared, some.limit, some.inside)
        support = ((squared < some.limit[:, None, None]) & some.inside[:, None]).sum(-1)
        winner = (loss[:, :1] > 1.02 * loss[:, 1:]).long()
        model = tensor_map(lambda t: t[:, 0], take_slots(both, winner))
        parts.append(
            Best(
                model,
                loss.gather(1, winner)[:, 0],
                support.gather(1, winner)[:, 0],
                old.minimal_loss,
                old.solved,
                old.iterations,
            )
        )
    return join(parts)


def _take(best: Best, index: Tensor) -> Best:
    return tensor_map(lambda t: t[index], best)


def _put(best: Best, index: Tensor, new: Best) -> Best:
    return zip_map(lambda old, part: old.index_copy(0, index, part), best, new)
