"""The search itself, for problems of like size: sample, solve, score, optimise, until each problem has had enough."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.glance import suspected
from torchsfm.robust.hypotheses import OPTIMISED, hypotheses, sift
from torchsfm.robust.local_optimisation import (
    FIRST_STEPS,
    LOCAL_DATA,
    SCALE_DATA,
    optimise_fully,
    optimise_locally,
    optimise_within,
    scale_of_noise,
)
from torchsfm.robust.models import cast, join, put, select, take_slots
from torchsfm.robust.problems import Problems
from torchsfm.robust.scores import Msac, Score, limits
from torchsfm.robust.scoring import around_model, losses, smallest, squared_residual

M = TypeVar("M")

ROUNDS = (16, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)
"""How many samples a round may draw for a problem."""
STARTS = (2, 4, 8, 16, 32, 64)
"""From how many samples of the inliers the best model may be sought once more."""
EXPLORED_DATA = 512
"""How many data that looks at."""
_PER_START, _AMBIGUOUS = 128, 0.5
"""One such start for so many samples of the search; none where chance puts fewer wrong data than this among the inliers."""
_SUPPORT = 0.6
"""How much of its support within the threshold a model may lose by refinement."""
_BY_CHANCE = 0.05
"""Share of wrong data taken to agree with a wrong model, as PROSAC's end assumes."""
_SAMPLES, _NUMBERS = 1 << 13, 1 << 15
"""Samples to solve at a time, and numbers in one row of all data of several models, on a CPU: what fits its cache."""


@dataclass(frozen=True)
class Options:
    """When to stop, how to compare models, and in which precision."""

    seed: int
    confidence: float
    min_iterations: int
    max_iterations: int
    dtype: torch.dtype
    score: Score


@dataclass(frozen=True)
class Best:
    """The best model found for each problem.

    Attributes:
        model: The model; zeros where no sample had a solution, None before the first round.
        loss: Its cost over all data; infinite where there is none.
        limit: Its squared threshold.
        needed: How many samples would do, judging by its inliers.
        minimal_loss: The least cost of a model straight from a sample.
        solved: Whether any sample had a solution.
        iterations: Number of samples drawn.
        reach: The squared distance at which weights vanish in the loss of which the model is the optimum; 0 if it is none.
        doubtful: Whether a glance left open that the inliers are degenerate; True where nobody looked.
    """

    model: Any
    loss: Float[Tensor, "p"]
    limit: Float[Tensor, "p"]
    needed: Float[Tensor, "p"]
    minimal_loss: Float[Tensor, "p"]
    solved: Bool[Tensor, "p"]
    iterations: Int[Tensor, "p"]
    reach: Float[Tensor, "p"]
    doubtful: Bool[Tensor, "p"]


def search(problems: Problems, options: Options) -> tuple[Best, Float[Tensor, "p width"]]:
    """Find the best model of each problem, in float64, refined, and the squared distances of its data."""
    p, device = len(problems.count), problems.count.device
    infinite = torch.full((p,), torch.inf, dtype=options.dtype, device=device)
    none = torch.zeros(p, dtype=torch.long, device=device)
    limit = problems.limit.to(options.dtype)
    best = Best(None, infinite, limit, infinite.double(), infinite, none > 0, none, torch.zeros_like(infinite), none == 0)
    coarse = problems.cast(options.dtype)
    active = torch.arange(p, device=device)
    while len(active):
        size = _round_size(best.iterations[active], best.needed[active], options)
        for number in sorted(set(size.tolist()) - {0}):
            best = _round(problems, coarse, best, active[size == number], number, options)
        active = active[size > 0]
    best = _explored(problems, coarse, best, options)
    return _polished(problems, coarse, _rivalled(problems, coarse, best, options), options)


def _round_size(drawn: Int[Tensor, "g"], needed: Float[Tensor, "g"], options: Options) -> Int[Tensor, "g"]:
    """How many samples to draw next: so many that there are four times as many, or the rest; 0 for a problem that is done."""
    rest = torch.maximum(needed, torch.full_like(needed, options.min_iterations)).clamp(max=options.max_iterations) - drawn
    wanted = torch.minimum(rest, (3 * drawn).clamp(min=options.min_iterations).to(rest.dtype))
    sizes = torch.tensor(ROUNDS, device=drawn.device)
    size = sizes[torch.searchsorted(sizes, wanted.ceil().long()).clamp(max=len(ROUNDS) - 1)]
    return torch.where(rest > 0, size, 0)


def no_model(estimator: Estimator[M], data: Sequence[Tensor], number: int) -> M:
    """Zeros in the form of a model for each of a number of problems."""
    none = tensor_map(lambda t: t[:0], estimator)
    samples = [d.new_zeros(0, estimator.sample_size, d.shape[-1]) for d in data]
    return tensor_map(lambda t: t.new_zeros(number, *t.shape[2:]), none.minimal(*samples).model)


def samples_needed(problems: Problems, near: Bool[Tensor, "g width"], options: Options) -> Float[Tensor, "g"]:
    """How many samples it takes to have drawn, with the given confidence, one of inliers alone."""
    size, missed = problems.estimator.sample_size, math.log(1 - options.confidence)
    steps = torch.arange(size, device=near.device)
    if problems.weight is not None and problems.ranking is None:
        share = (problems.weight * near).double().sum(-1) / problems.weight.double().sum(-1)
        share = share**size
    else:
        support = near.sum(-1, keepdim=True)
        share = ((support - steps).clamp(min=0).double() / (problems.count[:, None] - steps).double()).prod(-1)
    if not options.score.needs_threshold:
        # The threshold follows from the model: a wrong one would vouch for itself. The median takes half of the data for good.
        share = share.clamp(max=0.5**size)
    needed = missed / torch.log1p(-share)
    if problems.ranking is None or problems.growth is None:
        return needed
    # PROSAC's own end (Chum & Matas 2005, 2.2): inliers enough among the n best, and no chance, for the samples drawn of them.
    number = torch.arange(size, near.shape[-1] + 1, device=near.device)
    ranked = near.gather(-1, problems.ranking).cumsum(-1)[:, size - 1 :]
    share = ((ranked[..., None] - steps).clamp(min=0).double() / (number[:, None] - steps).double()).prod(-1)
    own = missed / torch.log1p(-share)
    spare = (number - size).double()
    chance = size + _BY_CHANCE * spare + 3.1 * (_BY_CHANCE * (1 - _BY_CHANCE) * spare).sqrt()
    good = (ranked > chance) & (problems.growth >= own) & (number <= problems.count[:, None])
    return torch.minimum(needed, torch.where(good, 2 * own, torch.inf).amin(-1))


def _split(index: Int[Tensor, "g"], each: int, budget: int) -> Sequence[Tensor]:
    """Cut a list of problems so that what they need at a time stays within a budget; other devices than CPUs take more."""
    size = max(1, (budget if index.device.type == "cpu" else 256 * budget) // each)
    return [index[i : i + size] for i in range(0, len(index), size)]


def _round(fine: Problems, coarse: Problems, best: Best, index: Int[Tensor, "g"], number: int, options: Options) -> Best:
    """Draw samples for some problems, and update the best models with what comes of them."""
    parts = []
    for part in _split(index, number, _SAMPLES):
        models, valid = hypotheses(fine, part, best.iterations[part], number, options.seed)
        parts.append(sift(coarse.take(part), models, valid, options.score, options.dtype))
    models = join([part[0] for part in parts])
    loss, solved = (torch.cat([part[i] for part in parts]) if len(parts) > 1 else parts[0][i] for i in (1, 2))
    if best.model is None:
        best = replace(best, model=tensor_map(lambda t: t.new_zeros(len(best.loss), *t.shape[2:]), models))
    best = replace(
        best,
        solved=best.solved.index_put((index,), best.solved[index] | solved),
        iterations=best.iterations.index_add(0, index, torch.full_like(index, number)),
    )
    improved = (loss[:, 0] < best.minimal_loss[index]).nonzero()[:, 0]
    for part in _split(improved, OPTIMISED * min(coarse.width, LOCAL_DATA), _NUMBERS):
        top = tensor_map(lambda t: t[part], models)  # noqa: B023
        best = _optimised(coarse.take(index[part]), best, index[part], top, loss[part], options)
    return best


def _optimised(
    coarse: Problems, best: Best, index: Int[Tensor, "g"], top: Any, loss: Tensor, options: Options, looked_at: int = LOCAL_DATA
) -> Best:
    """Update the best models of some problems with what local optimisation makes of the best hypotheses of a round.

    Args:
        coarse: The problems.
        best: The best models of all problems.
        index: Which problems these are.
        top: Hypotheses, the best first.
        loss: The costs of the hypotheses.
        options: How to compare.
        looked_at: How many data to optimise on.
    """
    wide, size, k = coarse.spread(), coarse.estimator.sample_size, coarse.estimator.codimension
    counts = coarse.inside if coarse.weight is None else coarse.weight
    prefix = [d[:, :, :looked_at] for d in wide.data]
    limit = limits(options.score, loss, coarse.limit, coarse.count, size, k)
    better = optimise_locally(wide.estimator, top, prefix, limit, counts[:, :looked_at], options.score)
    candidates = join([better, tensor_map(lambda t: t[:, :1], top)], 1)
    squared = squared_residual(wide.estimator, candidates, *wide.data)
    candidate_loss = options.score.cost(squared, coarse.limit, counts, k)
    new_loss, winner = candidate_loss.min(-1, keepdim=True)
    new_limit = limits(options.score, new_loss, coarse.limit, coarse.count, size, k)[:, 0]
    squared = squared.gather(1, winner[..., None].expand(-1, -1, squared.shape[-1]))[:, 0]
    needed = samples_needed(coarse, (squared < new_limit[:, None]) & coarse.inside, options)
    old = _take(best, index)
    gain = new_loss[:, 0] < old.loss
    new = replace(
        old,
        model=select(gain, tensor_map(lambda t: t[:, 0], take_slots(candidates, winner)), old.model),
        loss=torch.where(gain, new_loss[:, 0], old.loss),
        limit=torch.where(gain, new_limit, old.limit),
        needed=torch.where(gain, needed, old.needed),
        minimal_loss=torch.minimum(loss[:, 0], old.minimal_loss),
    )
    return put(best, index, new)


def _explored(fine: Problems, coarse: Problems, best: Best, options: Options) -> Best:
    """Optimise locally from many samples of the inliers alone, where wrong data may pass for inliers.

    Each of these is in or out: the cost has many minima, and a model straight from a sample leads to one of them. The effort
    is a part of that of the search.
    """
    near, number = [], []
    for part in _split(torch.arange(len(fine.count), device=fine.count.device), fine.width, _NUMBERS):
        some, old = coarse.take(part), _take(best, part)
        ratio = squared_residual(some.estimator, old.model, *some.data) / old.limit[:, None]
        near.append((ratio < 1) & some.inside)
        chance = around_model(ratio, some.inside, fine.estimator.codimension)
        worthwhile = (chance >= _AMBIGUOUS) & (near[-1].sum(-1) > 2 * fine.estimator.sample_size)
        number.append(torch.where(worthwhile & old.solved, old.iterations // _PER_START, 0))
    sizes = torch.tensor((0, *STARTS), device=fine.count.device)
    starts, inlying = sizes[torch.searchsorted(sizes, torch.cat(number), right=True) - 1], torch.cat(near)
    for size in sorted(set(starts.tolist()) - {0}):
        drawn = max(4 * size, 64)
        for part in _split((starts == size).nonzero()[:, 0], drawn, _SAMPLES):
            ranking = inlying[part].to(torch.int8).argsort(dim=-1, descending=True, stable=True)
            among = ranking, inlying[part].sum(-1, keepdim=True).expand(-1, drawn)
            models, valid = hypotheses(fine, part, best.iterations[part], drawn, options.seed, among)
            some = coarse.take(part)
            models, loss, _ = sift(some, models, valid, options.score, options.dtype, [(min(LOCAL_DATA, coarse.width), size)])
            for row in _split(torch.arange(len(part), device=part.device), size * EXPLORED_DATA, _NUMBERS):
                top = tensor_map(lambda t: t[row], models)  # noqa: B023
                best = _optimised(some.take(row), best, part[row], top, loss[row], options, EXPLORED_DATA)
    return best


def _rivalled(fine: Problems, coarse: Problems, best: Best, options: Options) -> Best:
    """Look for better models in places that samples do not lead to, where the estimator knows such."""
    if not hasattr(fine.estimator, "rivals"):
        return best
    index = torch.arange(len(fine.count), device=fine.count.device)
    if hasattr(fine.estimator, "suspect"):
        best = replace(best, doubtful=suspected(fine, cast(best.model, torch.float64), best.limit.double()))
        index = best.doubtful.nonzero()[:, 0]
    for part in _split(index, fine.width, _NUMBERS):
        some = fine.take(part)
        model = cast(tensor_map(lambda t: t[part], best.model), torch.float64)  # noqa: B023
        found = some.estimator.rivals(  # type: ignore[attr-defined]
            model, *some.data, inside=some.inside, threshold=best.limit[part].double().sqrt(), seed=options.seed
        )
        row = (found.valid.any(-1) & best.solved[part]).nonzero()[:, 0]
        if not len(row):
            continue
        chosen, rivals = coarse.take(part[row]), tensor_map(lambda t: t[row].to(options.dtype), found.model)  # noqa: B023
        counts = chosen.inside if chosen.weight is None else chosen.weight
        wide = chosen.spread()
        loss = losses(wide.estimator, rivals, wide.data, chosen.limit, counts, options.score)
        loss = torch.where(found.valid[row], loss, torch.inf)
        order = smallest(loss, OPTIMISED)
        best = _optimised(chosen, best, part[row], take_slots(rivals, order), loss.gather(1, order), options)
    return best


def _polished(fine: Problems, coarse: Problems, best: Best, options: Options) -> tuple[Best, Float[Tensor, "p width"]]:
    """Refine the best models on all data, to the end in float64, and keep what does not lose support; and their distances."""
    parts, distances, score, k = [], [], Msac(), fine.estimator.codimension
    for part in _split(torch.arange(len(fine.count), device=fine.count.device), fine.width, _NUMBERS):
        some, rough, old = fine.take(part), coarse.take(part).spread(), _take(best, part)
        counts = rough.inside if rough.weight is None else rough.weight
        start = tensor_map(lambda t: t[:, None], old.model)
        model, reach = scale_of_noise(
            rough.estimator, start, [d[:, :, :SCALE_DATA] for d in rough.data], old.limit, counts[:, :SCALE_DATA]
        )
        model = optimise_within(rough.estimator, model, rough.data, reach * old.limit, counts, FIRST_STEPS)
        old, reach = cast(old, torch.float64), reach.double() * old.limit
        wide, counts = some.spread(), some.inside if some.weight is None else some.weight
        model, settled = optimise_fully(wide.estimator, cast(model, torch.float64), wide.data, reach, counts)
        squared = squared_residual(wide.estimator, model, *wide.data)
        # A threshold smaller than the noise would blame the better model.
        judged = torch.maximum(old.limit, reach)
        loss = score.cost(squared, judged, counts, k)[:, 0]
        before = squared_residual(rough.estimator, start, *rough.data)
        before_loss = score.cost(before, judged, counts, k)[:, 0].double()
        # One datum more or less proves nothing: it may sit at the edge of what is in front of the cameras.
        won = (loss <= 1.02 * before_loss + 1) & (loss < torch.inf)
        # Noise that leaves the threshold so much less support is none: the model is not quite that of the data.
        within, within_before = (((d < old.limit[:, None, None]) * counts[:, None]).sum(-1)[:, 0] for d in (squared, before))
        won &= within >= _SUPPORT * within_before
        distances.append(torch.where(won[:, None], squared[:, 0], before[:, 0]))
        parts.append(
            replace(
                old,
                model=select(won, tensor_map(lambda t: t[:, 0], model), old.model),
                loss=torch.where(won, loss, before_loss),
                reach=torch.where(won & settled, reach, 0),
            )
        )
    return join(parts), torch.cat(distances)


def _take(best: Best, index: Tensor) -> Best:
    return tensor_map(lambda t: t[index], best)
