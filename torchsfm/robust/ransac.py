"""Robust estimation of any model, for many problems at once.

Sample, score, optimise locally, stop: LO-RANSAC (Chum, Matas & Kittler 2003). The batch is
(problem, hypothesis); every problem has its own number of data and its own end. What becomes of a problem is a function of its
data and the seed alone: the sizes of all arrays that touch a problem follow from its own number of data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors, tensor_map
from torchsfm.robust.degeneracy import Degeneracy
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import cast, join
from torchsfm.robust.optimum import attach_derivative, has_manifold, step_covariance
from torchsfm.robust.problems import Problems, pack
from torchsfm.robust.scores import LeastMedian, Msac, Score
from torchsfm.robust.scoring import around_model, beyond_chance, squared_residual
from torchsfm.robust.search import Best, Options, no_model, search

M = TypeVar("M")

_GLANCE = 256
"""How many data to look at first for a degeneracy."""


@dataclass(frozen=True)
class RobustResult(Generic[M]):
    """A robustly estimated model for each problem of a batch.

    Attributes:
        model: The model; finite numbers without meaning where the status says that none was found.
        inliers: Which data are nearer to the model than the threshold.
        score: Sum over the data of max(0, 1 - squared distance / squared threshold): a soft number of inliers.
        threshold: The largest distance of an inlier, given or estimated.
        iterations: Number of samples drawn.
        status: `OK`; `TOO_FEW` data for a sample; `NOT_FINITE`: too few of the data are finite; `DEGENERATE`: no sample
            determined a model; `NO_CONSENSUS`: no model was supported by more data than its own sample or chance explain
            (model and inliers are then those of the best one).
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
            absent.
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
    if not 0 < confidence < 1:
        raise ValueError(f"confidence: wanted a number between 0 and 1, got {confidence}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations: wanted a positive number, got {max_iterations}")
    if covariance and not has_manifold(estimator):
        raise ValueError(f"covariance: {type(estimator).__name__} does not say how its models move (`retract`)")
    score = score or (LeastMedian() if threshold is None else Msac())
    if threshold is None and score.needs_threshold:
        raise ValueError(f"threshold: {type(score).__name__} wants one, got None")
    known = {f"data[{i}]": (d, f"n {d.shape[-1]}" if d.ndim > 1 else "n d") for i, d in enumerate(data)}
    limit = threshold if isinstance(threshold, Tensor) else data[0].new_tensor(1.0 if threshold is None else threshold)
    batch = check_tensors(**known, threshold=(limit, ""), mask=(mask, "n: bool"), scores=(scores, "n"), weights=(weights, "n"))
    dtype, device, n = data[0].dtype, data[0].device, data[0].shape[-2]
    seed = int(torch.randint(1 << 62, (), generator=generator, device=None if generator is None else generator.device))
    p = batch.numel()
    graph = [d.double().expand(*batch, n, d.shape[-1]).reshape(p, n, d.shape[-1]) for d in data]
    counts = None if weights is None else weights.double().expand(*batch, n).reshape(p, n)
    own = tensor_map(lambda t: t.expand(batch + t.shape[len(batch) :]).reshape(p, *t.shape[len(batch) :]), estimator)
    own = cast(own, torch.float64)
    with torch.no_grad():
        flat, fields = [d.detach() for d in graph], tensor_map(Tensor.detach, own)
        bound = limit.double().expand(batch).reshape(p).clone()
        square = bound * bound
        exists = torch.ones(p, n, dtype=torch.bool, device=device)
        exists = exists if mask is None else mask.expand(*batch, n).reshape(p, n)
        usable = exists
        for d in flat:
            usable = usable & torch.isfinite(d).all(-1)
        if counts is not None:
            usable = usable & torch.isfinite(counts) & (counts > 0)
        trust = None if scores is None else scores.expand(*batch, n).reshape(p, n)
        enough = (usable.sum(-1) >= estimator.sample_size) & torch.isfinite(square) & (bound > 0)
        status = torch.full((p,), int(Status.NOT_FINITE), dtype=torch.int8, device=device)
        status[exists.sum(-1) < estimator.sample_size] = int(Status.TOO_FEW)
        inliers = torch.zeros(p, n, dtype=torch.bool, device=device)
        support = torch.zeros(p, dtype=torch.float64, device=device)
        iterations = torch.zeros(p, dtype=torch.long, device=device)
        degeneracy = torch.full((p,), int(Degeneracy.TOO_FEW), dtype=torch.int8, device=device)
        selected, reach = torch.zeros_like(inliers), torch.ones_like(support)
        options = Options(seed, confidence, min_iterations, max_iterations, scoring_dtype or dtype, score)
        found: list[tuple[Tensor, M]] = []
        given = None if counts is None else counts.detach()
        for problems in pack(fields, flat, usable, enough, square, trust, given):
            best = search(problems, options)
            problems = replace(problems, limit=best.limit)
            member = problems.member
            bound[member] = best.limit.sqrt()
            squared = squared_residual(problems.estimator, best.model, *problems.data)
            near = (squared < problems.limit[:, None]) & problems.inside
            ratio = squared / problems.limit[:, None]
            soft = torch.where(near, 1 - ratio, 0)
            soft = (soft if problems.weight is None else soft * problems.weight).sum(-1)
            expected = around_model(ratio, problems.inside, estimator.codimension)
            agreed = (near.sum(-1) > estimator.sample_size) & beyond_chance(
                soft, problems.count, expected, estimator.sample_size
            )
            fate = torch.where(agreed, int(Status.OK), int(Status.NO_CONSENSUS))
            status[member] = torch.where(best.solved, fate, int(Status.DEGENERATE)).to(torch.int8)
            found.append((member, best.model))
            inliers[member] = problems.scatter(near, n)
            support[member] = soft
            iterations[member] = best.iterations
            degeneracy[member] = _degeneracy(problems, best, near, expected)
            optimal = agreed & best.solved & (best.reach > 0)
            within = (squared < best.reach[:, None]) & problems.inside & optimal[:, None]
            selected[member] = problems.scatter(within, n)
            reach[member] = torch.where(optimal, best.reach, 1)
    model = _together(found, fields, flat, p)
    counts = torch.ones_like(usable, dtype=torch.float64) if counts is None else counts
    spread = step_covariance(fields, model, flat, counts.detach(), selected, reach) if covariance else None
    model = attach_derivative(own, model, graph, counts, selected, reach)
    return RobustResult(
        tensor_map(lambda t: t.to(dtype).reshape(batch + t.shape[1:]), model),
        inliers.reshape(*batch, n),
        support.to(dtype).reshape(batch),
        bound.to(dtype).reshape(batch),
        iterations.reshape(batch),
        status.reshape(batch),
        degeneracy.reshape(batch),
        None if spread is None else spread.to(dtype).reshape(*batch, *spread.shape[1:]),
    )


def _together(found: Sequence[tuple[Tensor, M]], estimator: Estimator[M], data: Sequence[Tensor], p: int) -> M:
    """The models of all problems, zeros where there is none."""
    if not found:
        return no_model(estimator, data, p)
    member = torch.cat([index for index, _ in found])
    return tensor_map(lambda t: t.new_zeros(p, *t.shape[1:]).index_copy(0, member, t), join([model for _, model in found]))


def _degeneracy(problems: Problems, best: Best, near: Bool[Tensor, "p n"], chance: Float[Tensor, "p"]) -> Int[Tensor, "p"]:
    """What the inliers lack, or all data where no sample determined a model."""
    estimator, solved = problems.estimator, best.solved
    code = torch.where(solved, int(Degeneracy.NONE), int(Degeneracy.UNDETERMINED)).to(torch.int8)
    if hasattr(estimator, "degeneracy"):
        looked_at, found = torch.where(solved[:, None], near, problems.inside), code
        index = torch.arange(len(near), device=near.device)
        # What a part of the data, spread over all, already shows to be determined need not be looked at in full.
        for part in (slice(0, _GLANCE), slice(None)) if problems.width > 2 * _GLANCE else (slice(None),):
            some = problems.take(index)
            model = tensor_map(lambda t: t[index], best.model)  # noqa: B023
            data = [d[:, part] for d in some.data]
            own = {"inliers": looked_at[index, part], "threshold": some.limit.sqrt(), "chance": chance[index]}
            found = found.index_copy(0, index, some.estimator.degeneracy(model, *data, **own))  # type: ignore[attr-defined]
            index = index[found[index] != Degeneracy.NONE]
        code = torch.where(solved | (found != Degeneracy.NONE), found, code)
    few = (solved & (near.sum(-1) <= estimator.sample_size)) | (problems.count <= estimator.sample_size)
    return torch.where(few, int(Degeneracy.TOO_FEW), code).to(torch.int8)
