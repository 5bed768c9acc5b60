"""Robust estimation of any model, for many problems at once.

Sample, score, optimise locally, stop: LO-RANSAC (Chum, Matas & Kittler 2003). The batch is
(problem, hypothesis); every problem has its own number of data and its own end. What becomes of a problem is a function of its
data and the seed alone: the sizes of all arrays that touch a problem follow from its own number of data.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.optim import wants_derivative
from torchsfm.robust.degeneracy import Degeneracy
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.glance import suspected
from torchsfm.robust.models import cast, tensors_of, zip_map
from torchsfm.robust.optimum import attach_derivative, has_manifold, step_covariance
from torchsfm.robust.problems import Problems, pack
from torchsfm.robust.scores import LeastMedian, Msac, Score
from torchsfm.robust.scoring import around_model, beyond_chance
from torchsfm.robust.search import Best, Options, no_model, search

M = TypeVar("M")


@dataclass(frozen=True)
class RobustResult(Generic[M]):
    """A robustly estimated model for each problem of a batch.

    Attributes:
        model: The model; finite numbers without meaning where the status says that none was found.
        inliers: Which data are nearer to the model than the threshold.
        score: Sum over the data of (their weights times) max(0, 1 - squared distance / squared threshold): a soft number of
            inliers.
        threshold: The largest distance of an inlier, given or estimated.
        iterations: Number of samples drawn.
        status: `OK`; `TOO_FEW` data for a sample; `NOT_FINITE`: too few of the data are finite; `DEGENERATE`: no sample
            determined a model; `NO_CONSENSUS`: no model was supported by more data than its own sample or chance explain, or
            the threshold is so wide that any would be (model and inliers are then those of the best one).
        degeneracy: Whether the inliers, although they agree, leave the model open: a `Degeneracy` each. Which of them are
            looked for is said where the model is estimated.
        covariance: If asked for, that of the model by the scatter of the data around it: of its entries, row by row, unless
            said otherwise where the model is estimated. Zero where the model is no optimum or not determined.
    """

    model: M
    inliers: Bool[Tensor, "*batch n"]
    score: Float[Tensor, "*batch"]
    threshold: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]
    degeneracy: Int[Tensor, "*batch"]
    covariance: Float[Tensor, "*batch k k"] | None = None


def ransac(
    estimator: Estimator[M],
    *data: Float[Tensor, "*#batch n _"],
    threshold: float | Float[Tensor, "*#batch"] | None,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    scores: Float[Tensor, "*#batch n"] | None = None,
    weights: Float[Tensor, "*#batch n"] | None = None,
    score: Score | None = None,
    generator: torch.Generator | None = None,
    confidence: float = 0.9999,
    min_iterations: int = 64,
    max_iterations: int = 10_000,
    scoring_dtype: torch.dtype | None = None,
    covariance: bool = False,
) -> RobustResult[M]:
    """Estimate a model for each problem of a batch from data of which many may be wrong.

    Minimal samples are solved in float64, hypotheses are scored and locally optimised in `scoring_dtype`, and the best model of
    each problem is refined in float64 on all its inliers with a robust loss. A problem ends when, with the given confidence,
    one of its samples was free of outliers, by the exact probability of such a sample.

    Rows with NaN or infinite numbers are left out. The result for a problem is the same, up to rounding,
    whatever else is in the batch.

    Args:
        estimator: The problem: what to solve, measure and refine.
        *data: The data, `(*batch, n, d)` each, equally many; batch dimensions broadcast.
        threshold: Largest distance of an inlier, in the unit of the estimator's residual; one number or one per problem. None
            where it is not known: the score must then be one that does without (`LeastMedian`, which is then the default).
        mask: Which data exist; all of them if not given. Problems of different size share a batch this way.
        scores: How much each datum can be trusted, the larger the more, in any unit. Half of the samples then favour the best
            (PROSAC, Chum & Matas 2005), and the search ends as soon as the samples of the best data suffice.
        weights: For how many data each datum counts: in sampling (without `scores`), in comparing models, in refinement. 0 is
            absent. In any unit: what is consensus depends on their ratios alone.
        score: How models are compared: `Msac()` (the default), `Magsac()`, `InlierCount()`, `LeastMedian()`.
        generator: Source of randomness; PyTorch's global one if not given.
        confidence: Wanted probability of having drawn a sample without outliers.
        min_iterations: Fewest samples to draw for a problem.
        max_iterations: Most samples to draw for a problem, rounded up to a whole round.
        scoring_dtype: Type for scoring hypotheses; that of the data if not given. float32 is enough for data of moderate size
            around 0.
        covariance: Compute the covariance of the step, in the sense of the estimator's `retract`, that leads from the refined
            model to the true one.

    Returns:
        Model, inliers, score, threshold, iterations, status and degeneracy of each problem. Where the estimator has `retract`,
        the model carries its derivatives with respect to the inliers, their weights, and fields of the estimator: those of the
        optimum of the final refinement, whose data and scale are held. They are zero where the model is not such an optimum.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    if not data:
        raise ValueError("data: wanted at least one tensor of shape (*batch, n, d), got none")
    check_options(
        estimator=(estimator, Estimator),
        confidence=(confidence, "0 < float < 1"),
        min_iterations=(min_iterations, "int >= 0"),
        max_iterations=(max_iterations, "int >= 1"),
        score=(score, Score | None),
        covariance=(covariance, bool),
        scoring_dtype=(scoring_dtype, torch.dtype | None),
    )
    if covariance and not has_manifold(estimator):
        raise ValueError(f"covariance: {type(estimator).__name__} does not say how its models move (`retract`)")
    limit = threshold if isinstance(threshold, Tensor) else None
    if limit is None:
        check_options(threshold=(threshold, "?float > 0"))
    score = score or (LeastMedian() if threshold is None else Msac())
    if threshold is None and score.needs_threshold:
        raise ValueError(f"threshold: {type(score).__name__} wants one, got None")
    known = {f"data[{i}]": (d, f"n d{i}") for i, d in enumerate(data)}
    batch = check_tensors(
        **known, threshold=(limit, "?"), mask=(mask, "?n: bool"), scores=(scores, "?n"), weights=(weights, "?n")
    )
    if limit is None:
        limit = data[0].new_tensor(1.0 if threshold is None else threshold)
    dtype, n = data[0].dtype, data[0].shape[-2]
    seed = int(torch.randint(1 << 62, (), generator=generator, device=None if generator is None else generator.device))
    p = batch.numel()
    _keep_freed_memory()
    graph = [_in_one_batch(d.double(), batch, 2) for d in data]
    counts = None if weights is None else _in_one_batch(weights.double(), batch, 1)
    own = cast(tensor_map(lambda t: _in_one_batch(t, batch, t.ndim - len(batch)), estimator), torch.float64)
    followed = covariance or (has_manifold(estimator) and wants_derivative(*graph, *tensors_of((counts, own))))
    with torch.no_grad():
        flat, fields = [d.detach() for d in graph], tensor_map(Tensor.detach, own)
        bound = _in_one_batch(limit.detach().double(), batch, 0)
        square = bound * bound
        enough = (bound > 0) & (square < torch.inf)
        given = None if counts is None else counts.detach()
        exists = None if mask is None else _in_one_batch(mask, batch, 1)
        usable = _usable(flat, exists, given)
        if usable is not None:
            enough &= usable.sum(-1) >= estimator.sample_size
        elif n < estimator.sample_size:
            enough = torch.zeros_like(enough)
        if given is not None and usable is not None:
            given, unit = _evidence(given, usable)
        trust = None if scores is None else _in_one_batch(scores, batch, 1)
        options = Options(seed, confidence, min_iterations, max_iterations, scoring_dtype or dtype, score)
        found = []
        for problems in pack(fields, flat, usable, enough, square, trust, given):
            found.append((problems.member, _outcome(problems, *search(problems, options), n, followed)))
        if len(found) == 1 and len(found[0][0]) == p:
            result = found[0][1]
        else:
            result = _nothing(fields, flat, bound, exists, followed)
            for member, part in found:
                result = zip_map(lambda old, new: old.index_copy(0, member, new), result, part)  # noqa: B023
    model, spread = result.model, None
    # Weights near the largest number there is leave it there.
    support = result.support if given is None else (result.support * unit).clamp(max=torch.finfo(unit.dtype).max)
    if result.selected is not None:
        counts = bound.new_ones(p, n) if counts is None else counts
        if covariance:
            spread = step_covariance(fields, model, flat, counts.detach(), result.selected, result.reach)
            spread = spread.to(dtype).reshape(*batch, *spread.shape[1:])
        model = attach_derivative(own, model, graph, counts, result.selected, result.reach)
    return RobustResult(
        tensor_map(lambda t: t.to(dtype).reshape(batch + t.shape[1:]), model),
        result.inliers.reshape(*batch, n),
        support.to(dtype).reshape(batch),
        result.bound.to(dtype).reshape(batch),
        result.iterations.reshape(batch),
        result.status.reshape(batch),
        result.degeneracy.reshape(batch),
        spread,
    )


@cache
def _keep_freed_memory() -> None:
    """Let the C library keep what is freed: otherwise it gives it back, and every step faults its memory in anew.

    glibc raises its limits to the largest block ever freed (mallopt, M_MMAP_THRESHOLD); nothing is written to this one.
    """
    torch.empty(31 << 20, dtype=torch.uint8)


def _in_one_batch(t: Tensor, batch: torch.Size, own: int) -> Tensor:
    """With all batch dimensions in one; the last `own` dimensions are its own."""
    trailing = t.shape[t.ndim - own :]
    if t.shape != batch + trailing:
        t = t.expand(batch + trailing)
    return t if len(batch) == 1 else t.reshape(batch.numel(), *trailing)


def _usable(data: Sequence[Tensor], exists: Tensor | None, counts: Tensor | None) -> Bool[Tensor, "p n"] | None:
    """Which data exist, are finite and count; None for all."""
    # A sum is finite only if all numbers are.
    finite = [math.isfinite(float(d.sum())) for d in data]
    usable = exists
    for d, good in zip(data, finite, strict=True):
        if not good:
            row = torch.isfinite(d).all(-1)
            usable = row if usable is None else usable & row
    if counts is not None:
        row = torch.isfinite(counts) & (counts > 0)
        usable = row if usable is None else usable & row
    return usable


def _evidence(weights: Tensor, usable: Tensor) -> tuple[Float[Tensor, "p n"], Float[Tensor, "p"]]:
    """Weights in a unit in which their sum is the number of equal data that tell as much (Kish 1965), and that unit.

    What is consensus and what is chance cannot depend on the unit in which the caller weighs.
    """
    weights = torch.where(usable, weights, 0)
    top = weights.amax(-1).clamp(min=1e-300) if weights.shape[-1] else weights.new_ones(len(weights))
    share = weights / top[:, None]
    unit = (share * share).sum(-1) / share.sum(-1).clamp(min=1e-300)
    unit = torch.where(unit > 0, unit, 1)
    return share / unit[:, None], unit * top


@dataclass(frozen=True)
class _Outcome(Generic[M]):
    """What becomes of each of some problems, for the data in the caller's order.

    Attributes:
        model: The model.
        inliers: Which data are nearer than the threshold.
        support: The soft number of inliers.
        bound: The threshold.
        iterations: Number of samples drawn.
        status: What became of it.
        degeneracy: What the inliers lack.
        selected: Which data are within the reach of the loss of which the model is the optimum; None if nobody asks.
        reach: The square of that reach; 1 for a model that is none.
    """

    model: M
    inliers: Bool[Tensor, "p n"]
    support: Float[Tensor, "p"]
    bound: Float[Tensor, "p"]
    iterations: Int[Tensor, "p"]
    status: Int[Tensor, "p"]
    degeneracy: Int[Tensor, "p"]
    selected: Bool[Tensor, "p n"] | None
    reach: Float[Tensor, "p"]


def _nothing(
    estimator: Estimator[M], data: Sequence[Tensor], bound: Tensor, exists: Tensor | None, followed: bool
) -> _Outcome[M]:
    """What becomes of problems that are not even tried."""
    p, n = data[0].shape[:2]
    none = torch.zeros(p, n, dtype=torch.bool, device=bound.device)
    few = (torch.full_like(bound, n) if exists is None else exists.sum(-1)) < estimator.sample_size
    status = torch.where(few, int(Status.TOO_FEW), int(Status.NOT_FINITE)).to(torch.int8)
    zero = bound.new_zeros(p)
    code = torch.full_like(status, int(Degeneracy.TOO_FEW))
    return _Outcome(
        no_model(estimator, data, p), none, zero, bound, zero.long(), status, code, none if followed else None, zero + 1
    )


def _outcome(problems: Problems, best: Best, squared: Float[Tensor, "p width"], n: int, followed: bool) -> _Outcome[Any]:
    """Judge the best models by all data, and say which of these they are the optimum of if that is to be followed."""
    estimator, size, limit, reach = problems.estimator, problems.estimator.sample_size, best.limit, best.reach
    ratio = torch.where(problems.inside, squared / limit[:, None], torch.inf).nan_to_num_(nan=torch.inf)
    near = ratio < 1
    soft = (1 - ratio).clamp_(min=0)
    number, expected = near.sum(-1), around_model(ratio, problems.inside, estimator.codimension)
    if problems.weight is None:
        soft = soft.sum(-1)
        likely = beyond_chance(soft, problems.count, expected, size)
    else:
        soft, weight = (soft * problems.weight).sum(-1), problems.weight
        likely = beyond_chance(soft, weight.sum(-1), around_model(ratio, weight, estimator.codimension), size)
    agreed = (number > size) & likely
    fate = torch.where(agreed, int(Status.OK), int(Status.NO_CONSENSUS))
    optimal = agreed & best.solved & (reach > 0)
    reach = torch.where(optimal, reach, 1)
    selected = problems.scatter((ratio < (reach / limit)[:, None]) & optimal[:, None], n) if followed else None
    return _Outcome(
        best.model,
        problems.scatter(near, n),
        soft,
        limit.sqrt(),
        best.iterations,
        torch.where(best.solved, fate, int(Status.DEGENERATE)).to(torch.int8),
        _degeneracy(replace(problems, limit=limit), best, near, expected),
        selected,
        reach,
    )


def _degeneracy(problems: Problems, best: Best, near: Bool[Tensor, "p n"], chance: Float[Tensor, "p"]) -> Int[Tensor, "p"]:
    """What the inliers lack, or all data where no sample determined a model."""
    estimator, solved = problems.estimator, best.solved
    code = torch.where(solved, int(Degeneracy.NONE), int(Degeneracy.UNDETERMINED)).to(torch.int8)
    if hasattr(estimator, "degeneracy"):
        doubtful = best.doubtful
        if hasattr(estimator, "suspect") and not hasattr(estimator, "rivals"):
            doubtful = suspected(problems, best.model, problems.limit, near, chance)
        doubtful = doubtful | ~solved
        index = doubtful.nonzero()[:, 0]
        if len(index):
            some, known, looked_at = problems.take(index), solved[index], near[index]
            own = {
                "inliers": torch.where(known[:, None], looked_at, some.inside),
                "threshold": some.limit.sqrt(),
                "chance": chance[index],
            }
            model = tensor_map(lambda t: t[index], best.model)
            found = some.estimator.degeneracy(model, *some.data, **own)  # type: ignore[attr-defined]
            found = torch.where(known | (found != Degeneracy.NONE), found, int(Degeneracy.UNDETERMINED))
            code = code.index_copy(0, index, found.to(torch.int8))
    few = (solved & (near.sum(-1) <= estimator.sample_size)) | (problems.count <= estimator.sample_size)
    return torch.where(few, int(Degeneracy.TOO_FEW), code).to(torch.int8)
