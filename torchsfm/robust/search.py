"""The search itself, for problems of like size: sample, solve, score, optimise, until each problem has had enough."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.local_optimisation import LOCAL_DATA, optimise_locally, polish
from torchsfm.robust.models import cast, join, select, take_slots, zip_map
from torchsfm.robust.problems import Problems
from torchsfm.robust.sampling import draw_samples, guided_pools
from torchsfm.robust.scoring import gather_valid, losses, smallest, squared_residual, stages, truncated_loss

ROUNDS = (16, 32, 64, 128, 256, 512, 1024, 2048)
"""How many samples a round may draw for a problem."""
SCORED = 8
"""Hypotheses of a round that are scored on all data."""
OPTIMISED = 3
"""Hypotheses of a round that are optimised locally."""
_SAMPLES, _NUMBERS = 1 << 12, 1 << 15
"""Samples to solve at a time, and numbers in one row of all data of several models, on a CPU: what fits its cache."""


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
        reach: The squared distance at which weights vanish in the loss of which the model is the optimum; 0 if it is none.
    """

    model: Any
    loss: Float[Tensor, "p"]
    support: Int[Tensor, "p"]
    minimal_loss: Float[Tensor, "p"]
    solved: Bool[Tensor, "p"]
    iterations: Int[Tensor, "p"]
    reach: Float[Tensor, "p"]


def search(problems: Problems, options: Options) -> Best:
    """Find the best model of each problem, in float64, refined."""
    p, device = len(problems.count), problems.count.device
    infinite = torch.full((p,), torch.inf, dtype=options.dtype, device=device)
    none = torch.zeros(p, dtype=torch.long, device=device)
    model = cast(no_model(problems.estimator, problems.data, p), options.dtype)
    best = Best(model, infinite, none, infinite, none > 0, none, torch.zeros_like(infinite))
    coarse = problems.cast(options.dtype)
    active = torch.arange(p, device=device)
    while len(active):
        size = _round_size(best.iterations[active], samples_needed(best, problems, active, options.confidence), options)
        for number in sorted(set(size.tolist()) - {0}):
            best = _round(problems, coarse, best, active[size == number], number, options)
        active = active[size > 0]
    return _polished(problems, best)


def _round_size(drawn: Int[Tensor, "g"], needed: Float[Tensor, "g"], options: Options) -> Int[Tensor, "g"]:
    """How many samples to draw next: as many as drawn so far, or the rest if that is fewer; 0 for a problem that is done."""
    rest = torch.maximum(needed, torch.full_like(needed, options.min_iterations)).clamp(max=options.max_iterations) - drawn
    wanted = torch.minimum(rest, drawn.clamp(min=options.min_iterations).to(rest.dtype))
    sizes = torch.tensor(ROUNDS, device=drawn.device)
    size = sizes[torch.searchsorted(sizes, wanted.ceil().long()).clamp(max=len(ROUNDS) - 1)]
    return torch.where(rest > 0, size, 0)


def no_model(estimator: Any, data: Sequence[Tensor], number: int) -> Any:
    """Zeros in the form of a model for each of a number of problems."""
    none = tensor_map(lambda t: t[:0], estimator)
    samples = [d.new_zeros(0, estimator.sample_size, d.shape[-1]) for d in data]
    return tensor_map(lambda t: t.new_zeros(number, *t.shape[2:]), none.minimal(*samples).model)


def samples_needed(best: Best, problems: Problems, index: Int[Tensor, "g"], confidence: float) -> Float[Tensor, "g"]:
    """How many samples it takes to have drawn, with the given confidence, one of inliers alone."""
    steps = torch.arange(problems.estimator.sample_size, device=index.device)
    inlying = (best.support[index, None] - steps).clamp(min=0).double() / (problems.count[index, None] - steps).double()
    return math.log(1 - confidence) / torch.log1p(-inlying.prod(-1))


def _split(index: Int[Tensor, "g"], each: int, budget: int) -> Sequence[Tensor]:
    """Cut a list of problems so that what they need at a time stays within a budget; other devices than CPUs take more."""
    size = max(1, (budget if index.device.type == "cpu" else 256 * budget) // each)
    return [index[i : i + size] for i in range(0, len(index), size)]


def _round(fine: Problems, coarse: Problems, best: Best, index: Int[Tensor, "g"], number: int, options: Options) -> Best:
    """Draw samples for some problems, and update the best models with what comes of them."""
    parts = []
    for part in _split(index, number, _SAMPLES):
        models, valid = _hypotheses(fine.take(part), best.iterations[part], number, options.seed)
        parts.append((*_cascade(coarse.take(part), cast(models, options.dtype), valid), valid.any(-1)))
    models = join([part[0] for part in parts])
    loss, solved = (torch.cat([part[i] for part in parts]) for i in (1, 2))
    best = replace(
        best,
        solved=best.solved.index_put((index,), best.solved[index] | solved),
        iterations=best.iterations.index_add(0, index, torch.full_like(index, number)),
    )
    improved = (loss[:, 0] < best.minimal_loss[index]).nonzero()[:, 0]
    for part in _split(improved, OPTIMISED * min(coarse.width, LOCAL_DATA), _NUMBERS):
        top = tensor_map(lambda t: t[part, :OPTIMISED], models)  # noqa: B023
        best = _optimised(coarse.take(index[part]), best, index[part], top, loss[part, 0])
    return best


def _optimised(coarse: Problems, best: Best, index: Int[Tensor, "g"], top: Any, loss: Float[Tensor, "g"]) -> Best:
    """Update the best models of some problems with what local optimisation makes of the best hypotheses of a round."""
    wide = coarse.spread()
    prefix = [d[:, :, :LOCAL_DATA] for d in wide.data]
    better = optimise_locally(wide.estimator, top, prefix, coarse.limit, coarse.inside[:, :LOCAL_DATA])
    candidates = join([better, tensor_map(lambda t: t[:, :1], top)], 1)
    squared = squared_residual(wide.estimator, candidates, *wide.data)
    candidate_loss = truncated_loss(squared, coarse.limit, coarse.inside)
    support = ((squared < coarse.limit[:, None, None]) & coarse.inside[:, None]).sum(-1)
    winner = candidate_loss.argmin(-1, keepdim=True)
    new_loss = candidate_loss.gather(1, winner)[:, 0]
    old = _take(best, index)
    gain = new_loss < old.loss
    new = replace(
        old,
        model=select(gain, tensor_map(lambda t: t[:, 0], take_slots(candidates, winner)), old.model),
        loss=torch.where(gain, new_loss, old.loss),
        support=torch.where(gain, support.gather(1, winner)[:, 0], old.support),
        minimal_loss=loss,
    )
    return _put(best, index, new)


def _hypotheses(fine: Problems, drawn: Int[Tensor, "g"], size: int, seed: int) -> tuple[Any, Bool[Tensor, "g slots"]]:
    """The models through random samples, all solution slots of all samples in a row."""
    m = fine.estimator.sample_size
    pool = None if fine.ranking is None else guided_pools(fine.count, drawn, size, m)
    index = draw_samples(seed, fine.count, drawn, size, m, pool).flatten(1)
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
            part = losses(wide.estimator, take_slots(models, column), data, coarse.limit, inside)
            loss = part.new_full((len(part), slots + 1), torch.inf)
            loss = loss.scatter_(1, torch.where(filled, column, slots), part)[:, :slots]
        else:
            loss = losses(wide.estimator, models, data, coarse.limit, inside)
        loss = torch.where(valid, loss, torch.inf)
        chosen = smallest(loss, keep)
        models, loss, valid = take_slots(models, chosen), loss.gather(1, chosen), valid.gather(1, chosen)
    return models, loss


def _polished(problems: Problems, best: Best) -> Best:
    """Refine the best models in float64 on all data, and keep what does not lose support."""
    parts = []
    for part in _split(torch.arange(len(problems.count), device=problems.count.device), problems.width, _NUMBERS):
        some, old = problems.take(part), cast(_take(best, part), torch.float64)
        wide = some.spread()
        start = tensor_map(lambda t: t[:, None], old.model)
        model, reach = polish(wide.estimator, start, wide.data, some.limit, some.inside)
        both = join([model, start], 1)
        squared = squared_residual(wide.estimator, both, *wide.data)
        loss = truncated_loss(squared, some.limit, some.inside)
        support = ((squared < some.limit[:, None, None]) & some.inside[:, None]).sum(-1)
        # One datum more or less proves nothing: it may sit at the edge of what is in front of the cameras.
        winner = (loss[:, :1] > 1.02 * loss[:, 1:] + 1).long()
        parts.append(
            replace(
                old,
                model=tensor_map(lambda t: t[:, 0], take_slots(both, winner)),
                loss=loss.gather(1, winner)[:, 0],
                support=support.gather(1, winner)[:, 0],
                reach=torch.where(winner[:, 0] == 0, reach * some.limit, 0),
            )
        )
    return join(parts)


def _take(best: Best, index: Tensor) -> Best:
    return tensor_map(lambda t: t[index], best)


def _put(best: Best, index: Tensor, new: Best) -> Best:
    return zip_map(lambda old, part: old.index_copy(0, index, part), best, new)
