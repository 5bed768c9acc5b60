"""What makes the best model of a search better: optimised hypotheses, samples of its inliers, alternatives, refinement.

Each function takes the best models so far and gives back better ones; the loop that calls them is in `ransac`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.portions import portion
from torchsfm.robust.degeneracy import glance
from torchsfm.robust.estimator import WithAlternatives
from torchsfm.robust.hypotheses import losses, sift, smallest, solve_samples, squared_residual, stages
from torchsfm.robust.local_optimisation import (
    LOCAL_DATA,
    LOCAL_STEPS,
    NUMBERS,
    RIVAL_STEPS,
    in_portions,
    optimise_fully,
    optimise_locally,
    step_within,
)
from torchsfm.robust.models import cast, join, put, select, take, take_slots, zip_map
from torchsfm.robust.noise import scale_of_noise, step_by_noise
from torchsfm.robust.problems import Problems
from torchsfm.robust.samplers import Among, Sampler, draws
from torchsfm.robust.scoring import Msac, Scoring, limits
from torchsfm.robust.stopping import around_model

OPTIMISED, RIVALS = 2, 8
"""Hypotheses of a round that are optimised locally; and where wrong data pass for inliers."""
STARTS = (2, 4, 8, 16, 32, 64)
"""From how many samples of the inliers the best model may be sought once more."""
EXPLORED_DATA = 512
"""How many data that looks at."""
_PER_START, _AMBIGUOUS, _CROWDED = 128, 0.5, 0.01
"""One such start for so many samples of the search; none where chance puts fewer wrong data than this among the inliers; what
share of wrong data among them lets minima compete."""
_SUPPORT, _CHANCE = 0.6, 1.5
"""How much of what is within the threshold a model may lose by refinement, and how many standard deviations of its support: the
one before was chosen for it."""
_SLOTS = 5 << 13
"""Slots for solutions of samples at a time, on a CPU."""
_TOGETHER = 8
"""Portions of problems that are refined together: few of each take many steps."""


@dataclass(frozen=True)
class Options:
    """When to stop, how to sample and to compare, and in which precision."""

    seed: int
    confidence: float
    min_iterations: int
    max_iterations: int
    dtype: torch.dtype
    scoring: Scoring
    sampler: Sampler


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
        near: Which data were within the threshold of the best model of the search.
        chance: How many of them chance explains.
        doubtful: Where a glance left open that the inliers are degenerate; None where nobody looked.
    """

    model: Any
    loss: Float[Tensor, "p"]
    limit: Float[Tensor, "p"]
    needed: Float[Tensor, "p"]
    minimal_loss: Float[Tensor, "p"]
    solved: Bool[Tensor, "p"]
    iterations: Int[Tensor, "p"]
    reach: Float[Tensor, "p"]
    near: Bool[Tensor, "p width"]
    chance: Float[Tensor, "p"]
    doubtful: Bool[Tensor, "p"] | None = None

    @classmethod
    def none(cls, coarse: Problems) -> "Best":
        """Before the first sample."""
        infinite, zero = torch.full_like(coarse.limit, torch.inf), torch.zeros_like(coarse.limit)
        drawn, near = torch.zeros_like(coarse.count), torch.zeros_like(coarse.inside)
        return cls(
            None, infinite, coarse.limit, infinite.double(), infinite, drawn > 0, drawn, zero, near, zero
        )  # fmt: skip

    def take(self, index: Tensor) -> "Best":
        """Those of some problems."""
        return take(self, index, len(self.loss))


def propose(
    source: Problems,
    coarse: Problems,
    best: Best,
    part: Int[Tensor, "g"],
    number: Int[Tensor, "g"],
    options: Options,
) -> tuple[Best, Any, Float[Tensor, "g kept"]]:
    """Draw so many samples for each of some of the problems, and keep the hypotheses that the data support best.

    Args:
        source: All problems, as they are sampled.
        coarse: The same in the type of scoring.
        best: Their best models.
        part: For which of them to draw.
        number: How many samples.
        options: How to draw and to compare.

    Returns:
        The best models, with what is known of the samples; the hypotheses, `(g, kept, ...)`; and their losses.
    """
    least, parts, slots = None, [], number * coarse.estimator.max_solutions
    if options.scoring.needs_threshold and best.model is not None:
        # Where rivals are optimised they need not be better.
        least = torch.where(_is_crowded(coarse, best), torch.inf, best.minimal_loss)
    rows = _alike(slots, portion(_SLOTS, part.device))
    for row in rows:
        own, count, size = take((part, number, slots), row, len(part))
        models, there = solve_samples(source, own, best.iterations[own], count, options.seed, options.sampler, RIVALS)
        some, known = coarse.take(own), None if least is None else least[own]
        parts.append((*sift(some, models, there, options.scoring, stages(some, size), RIVALS, known), there.any(-1)))
    models, loss, solved = parts[0]
    if len(rows) > 1:
        back = torch.cat(rows).argsort()
        models, loss, solved = tensor_map(lambda t: t[back], join(parts))
    if best.model is None:
        best = replace(best, model=tensor_map(lambda t: t.new_zeros(len(best.loss), *t.shape[2:]), models))
    old = take((best.solved, best.iterations), part, len(best.loss))
    solved, iterations = put((best.solved, best.iterations), part, (old[0] | solved, old[1] + number))
    return replace(best, solved=solved, iterations=iterations), models, loss


def optimise(coarse: Problems, best: Best, part: Int[Tensor, "g"], models: Any, loss: Tensor, options: Options) -> Best:
    """Optimise the proposed hypotheses locally where one of them is better than all before, or wrong data pass for inliers.

    There models through samples of right data are so far from their minima that their costs do not tell which is the lowest:
    the best of each round are optimised, whether better than those before or not. Models that are curves for each datum, as
    fundamental matrices, gain nothing by it on real images.
    """
    least = take(best.minimal_loss, part, len(best.loss))
    improved, first = (loss[:, 0] < least).nonzero()[:, 0], tensor_map(lambda t: t[:, :OPTIMISED], (models, loss))
    for row in _portions(improved, OPTIMISED * min(coarse.width, LOCAL_DATA), NUMBERS):
        index, (top, cost) = take((part, first), row, len(part))
        best = _optimised(coarse.take(index), best, index, top, cost, options)
    if coarse.estimator.codimension == 1:
        return best
    crowded = _is_crowded(coarse, best)[part].nonzero()[:, 0]
    for row in _portions(crowded, RIVALS * min(coarse.width, LOCAL_DATA), NUMBERS):
        index, top, cost = take((part, models, loss), row, len(part))
        best = _optimised(coarse.take(index), best, index, top, cost, options, steps=RIVAL_STEPS)
    return best


def _is_crowded(problems: Problems, best: Best) -> Bool[Tensor, "p"]:
    """Where wrong data pass for inliers of models that are points for each datum."""
    wrong, own = best.chance, best.near.sum(-1)
    return (wrong >= _AMBIGUOUS) & (wrong >= _CROWDED * own) & (problems.estimator.codimension > 1)


def _optimised(
    coarse: Problems,
    best: Best,
    index: Int[Tensor, "g"],
    top: Any,
    loss: Tensor,
    options: Options,
    looked_at: int = LOCAL_DATA,
    steps: tuple[float, ...] = LOCAL_STEPS,
) -> Best:
    """Update the best models of some problems with what local optimisation makes of hypotheses.

    Args:
        coarse: The problems.
        best: The best models of all problems.
        index: Which problems these are.
        top: Hypotheses, the best first.
        loss: The costs of the hypotheses.
        options: How to compare.
        looked_at: How many data to optimise on.
        steps: The squared thresholds of the steps.
    """
    wide, size, k = coarse.spread(), coarse.estimator.sample_size, coarse.estimator.codimension
    scoring, counts = options.scoring, coarse.counts
    prefix = [d[:, :, :looked_at] for d in wide.data]
    limit = limits(scoring, loss, coarse.limit, coarse.count, size, k)
    better = optimise_locally(wide.estimator, top, prefix, limit, counts[:, :looked_at], scoring, steps)
    candidates = join([better, tensor_map(lambda t: t[:, :1], top)], 1)
    squared = squared_residual(wide.estimator, candidates, *wide.data)
    candidate_loss = scoring.cost(squared, coarse.limit, counts, k)
    new_loss, winner = candidate_loss.min(-1, keepdim=True)
    new_limit = limits(scoring, new_loss, coarse.limit, coarse.count, size, k)[:, 0]
    ratio = squared.gather(1, winner[..., None].expand(-1, -1, squared.shape[-1]))[:, 0] / new_limit[:, None]
    near = (ratio < 1) & coarse.inside
    needed = options.sampler.needed(coarse, near, options.confidence)
    if not scoring.needs_threshold:
        # The threshold follows from the model: a wrong one would vouch for itself. The median takes half of the data for good.
        needed = torch.maximum(needed, draws(torch.full_like(needed, 0.5**size), options.confidence))
    old = best.take(index)
    gain = new_loss[:, 0] < old.loss
    new = replace(
        old,
        model=select(gain, tensor_map(lambda t: t[:, 0], take_slots(candidates, winner)), old.model),
        loss=torch.where(gain, new_loss[:, 0], old.loss),
        limit=torch.where(gain, new_limit, old.limit),
        needed=torch.where(gain, needed, old.needed),
        minimal_loss=torch.minimum(loss[:, 0], old.minimal_loss),
        near=torch.where(gain[:, None], near, old.near),
        chance=torch.where(gain, around_model(ratio, coarse.inside, k), old.chance),
    )
    return put(best, index, new)


def search_inliers(source: Problems, coarse: Problems, best: Best, options: Options) -> Best:
    """Optimise locally from many samples of the inliers alone, where wrong data may pass for inliers.

    Each of these is in or out: the cost has many minima, and a model straight from a sample leads to one of them. The effort
    is a part of that of the search.
    """
    worthwhile = best.solved & (best.chance >= _AMBIGUOUS) & (best.near.sum(-1) > 2 * coarse.estimator.sample_size)
    if not bool(worthwhile.any()):
        return best
    number = torch.where(worthwhile, best.iterations // _PER_START, 0)
    sizes = torch.tensor((0, *STARTS), device=coarse.count.device)
    starts, sampler = sizes[torch.searchsorted(sizes, number, right=True) - 1], Among(best.near)
    for size in sorted(set(starts.tolist()) - {0}):
        drawn = max(4 * size, 64)
        for part in _portions((starts == size).nonzero()[:, 0], drawn * coarse.estimator.max_solutions, _SLOTS):
            count = torch.full_like(part, drawn)
            models, there = solve_samples(source, part, best.iterations[part], count, options.seed, sampler, size)
            some, plan = coarse.take(part), [(min(LOCAL_DATA, coarse.width), torch.full_like(part, size))]
            models, loss = sift(some, models, there, options.scoring, plan, size)
            for row in _portions(_all(some), size * EXPLORED_DATA, NUMBERS):
                index, top, cost = take((part, models, loss), row, len(part))
                best = _optimised(some.take(row), best, index, top, cost, options, EXPLORED_DATA)
    return best


def try_alternatives(fine: Problems, coarse: Problems, best: Best, options: Options) -> Best:
    """Look for better models in places that samples do not lead to, where the estimator knows such."""
    if not isinstance(fine.estimator, WithAlternatives):
        return best
    doubtful = glance(fine, cast(best.model, torch.float64), best.limit.double(), best.near, best.chance)
    best = replace(best, doubtful=doubtful)
    for part in _portions(doubtful.nonzero()[:, 0], fine.width, NUMBERS):
        some, old = fine.take(part), best.take(part)
        estimator: Any = some.estimator
        model, threshold = cast(old.model, torch.float64), old.limit.double().sqrt()
        found = estimator.alternative_models(model, *some.data, inside=some.inside, threshold=threshold, seed=options.seed)
        row = (found.valid.any(-1) & old.solved).nonzero()[:, 0]
        if not len(row):
            continue
        chosen, others = coarse.take(part[row]), cast(take(found.model, row, len(part)), options.dtype)
        wide = chosen.spread()
        loss = losses(wide.estimator, others, wide.data, chosen.limit, chosen.counts, options.scoring)
        loss = torch.where(found.valid[row], loss, torch.inf)
        order = smallest(loss, OPTIMISED)
        best = _optimised(chosen, best, part[row], take_slots(others, order), loss.gather(1, order), options)
    return best


def refine_finally(fine: Problems, coarse: Problems, best: Best) -> tuple[Best, Float[Tensor, "p width"]]:
    """Refine the best models on all data, to the end in float64, and keep what does not lose support; and their distances.

    The loss is that of the noise found in the data, whatever the scoring; where the data within the threshold contradict such
    noise, that of the threshold.
    """
    parts = []
    for part in _portions(_all(fine), fine.width, _TOGETHER * NUMBERS):
        some, rough, old = fine.take(part), coarse.take(part), best.take(part)
        noisy = in_portions(scale_of_noise, rough.estimator, old.model, rough.data, old.limit, rough.counts)
        old, (start, noise) = cast((old, noisy), torch.float64)
        model, reach = in_portions(step_by_noise, some.estimator, start, some.data, old.limit, some.counts, *noise)
        found, squared, won = _refined(some, old, start, model, reach * old.limit)
        lost = (~won & old.solved).nonzero()[:, 0]
        if len(lost):
            few, start = some.take(lost), old.take(lost)
            model, _ = step_within(few.estimator, start.model, few.data, start.limit, few.counts)
            again = _refined(few, start, start.model, model, start.limit)
            found, squared = put(found, lost, again[0]), squared.index_copy(0, lost, again[1])
        parts.append((found, squared))
    return join([one[0] for one in parts]), torch.cat([one[1] for one in parts])


def _refined(
    some: Problems, old: Best, start: Any, model: Any, reach: Float[Tensor, "g"]
) -> tuple[Best, Tensor, Bool[Tensor, "g"]]:
    """The optima of losses near some models where they are better than the old ones, the distances, and where that is."""
    model, settled = optimise_fully(some.estimator, start, model, some.data, reach, some.counts)
    # In double precision too: in single precision what is far may look near by a threshold below rounding.
    wide, models = some.spread(), zip_map(lambda *pair: torch.stack(pair, 1), model, old.model)
    both = squared_residual(wide.estimator, models, *wide.data)
    # A threshold smaller than the noise would blame the better model.
    judged = torch.maximum(old.limit, reach)
    score, k, counts = Msac(), some.estimator.codimension, some.counts
    loss, before_loss = score.cost(both, judged, counts, k).unbind(1)
    # One datum more or less proves nothing: it may sit at the edge of what is in front of the cameras.
    won = (loss <= 1.02 * before_loss + 1) & (loss < torch.inf)
    # Noise that leaves the threshold so much less support is none: the model is not quite that of the data.
    ratio = both / old.limit[:, None, None]
    within, within_before = ((ratio < 1) * counts[:, None]).sum(-1).unbind(1)
    support, support_before = ((1 - ratio).clamp(min=0) * counts[:, None]).nan_to_num(0).sum(-1).unbind(1)
    chance = some.estimator.sample_size + _CHANCE * support_before.sqrt()
    won &= (within >= _SUPPORT * within_before.to(loss.dtype)) & (support >= support_before - chance)
    found = replace(
        old,
        model=select(won, model, old.model),
        loss=torch.where(won, loss, before_loss),
        reach=torch.where(won & settled, reach, 0),
    )
    return found, torch.where(won[:, None], both[:, 0], both[:, 1]), won


def _portions(index: Int[Tensor, "g"], each: int, budget: int) -> Iterator[Int[Tensor, "_"]]:
    """A list of problems in portions that need no more than a budget at a time."""
    size = max(1, portion(budget, index.device) // each)
    return (index[i : i + size] for i in range(0, len(index), size))


def _alike(number: Int[Tensor, "g"], budget: int) -> list[Int[Tensor, "_"]]:
    """All problems, in lists of such as have like numbers, of no more than a budget together but for the last of each list."""
    order = number.argsort(stable=True)
    if len(order) == 1 or int(number.sum()) <= budget:
        return [torch.arange(len(order), device=order.device)]
    group = number[order].cumsum(0).sub_(1) // budget
    return [row.sort().values for row in torch.split(order, [size for size in group.bincount().tolist() if size])]


def _all(problems: Problems) -> Int[Tensor, "p"]:
    return torch.arange(len(problems.count), device=problems.count.device)
