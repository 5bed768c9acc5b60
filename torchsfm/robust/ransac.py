"""Robust estimation of any model, for many problems at once.

Sample, score, optimise locally, stop: LO-RANSAC (Chum, Matas & Kittler 2003). The batch is
(problem, hypothesis); every problem has its own number of data and its own end. What becomes of a problem is a function of its
data and the seed alone, but for rounding.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options, tensor_map
from torchsfm.optim import wants_derivative
from torchsfm.robust.estimator import Differentiable, Estimator, SolvedInSingle, is_kind
from torchsfm.robust.improvement import Best, Options, optimise, propose, refine_finally, search_inliers, try_alternatives
from torchsfm.robust.models import cast, tensors_of, zip_map
from torchsfm.robust.optimum import attach_derivative, step_covariance
from torchsfm.robust.problems import Flat, Problems, pack
from torchsfm.robust.samplers import Prosac, Sampler, Uniform
from torchsfm.robust.sampling import draw_seed
from torchsfm.robust.scoring import LeastMedian, Msac, Scoring
from torchsfm.robust.stopping import samples_wanted
from torchsfm.robust.verdict import Verdict, judge

M = TypeVar("M")


@dataclass(frozen=True)
class RobustResult(Generic[M]):
    """A robustly estimated model for each problem of a batch.

    Attributes:
        model: The model; finite numbers without meaning where the status says that none was found.
        inliers: Which data are nearer to the model than the threshold.
        support: Sum over the data of (their weights times) max(0, 1 - squared distance / squared threshold): a soft number of
            inliers.
        threshold: The largest distance of an inlier, given or estimated.
        iterations: Number of samples drawn.
        status: `OK`; `TOO_FEW` data for a sample; `NOT_FINITE`: too few of the data are finite; `DEGENERATE`: no sample
            determined a model; `NO_CONSENSUS`: no model was supported by more data than its own sample or chance explain, or
            the threshold is so wide that any would be (model and inliers are then those of the best one). Data that repeat
            others, to twice the threshold in all images, support nothing (see `Located`).
        degeneracy: Whether the inliers, although they agree, leave the model open: a `Degeneracy` each. Which of them are
            looked for is said where the model is estimated.
        covariance: If asked for, that of the model by the scatter of the data around it: of its entries, row by row, unless
            said otherwise where the model is estimated. Zero where the model is no optimum or not determined.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(2, 50, 2, generator=g, dtype=torch.float64)
        >>> x2 = x1 + 0.1 + 1e-4 * torch.randn(2, 50, 2, generator=g)
        >>> x2[1] = torch.rand(50, 2, generator=g, dtype=torch.float64)  # the second pair has nothing in common
        >>> options = {"threshold": 1e-3, "max_iterations": 200, "covariance": True}
        >>> found = torchsfm.estimate_homography(x1, x2, generator=g, **options)
        >>> [torchsfm.Status(k).name for k in found.status.tolist()], int(found.inliers[0].sum())
        (['OK', 'NO_CONSENSUS'], 50)
        >>> found.covariance.shape, bool(found.support[0] > found.support[1])
        (torch.Size([2, 9, 9]), True)
    """

    model: M
    inliers: Bool[Tensor, "*batch n"]
    support: Float[Tensor, "*batch"]
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
    quality: Float[Tensor, "*#batch n"] | None = None,
    weights: Float[Tensor, "*#batch n"] | None = None,
    scoring: Scoring | None = None,
    sampler: Sampler | None = None,
    generator: torch.Generator | None = None,
    confidence: float = 0.9999,
    min_iterations: int = 64,
    max_iterations: int = 10_000,
    scoring_dtype: torch.dtype | None = None,
    covariance: bool = False,
) -> RobustResult[M]:
    """Estimate a model for each problem of a batch from data of which many may be wrong.

    Minimal samples are solved in float64, or in `scoring_dtype` where that is as good (see `SolvedInSingle`), hypotheses
    are scored and locally optimised in `scoring_dtype`, and the best model of each problem is refined in float64 on all its
    inliers with a robust loss. A problem ends when, with the given confidence, one of its samples was free of outliers, by
    the exact probability of such a sample.

    Rows with NaN or infinite numbers are left out. The result for a problem is the same, up to rounding,
    whatever else is in the batch.

    Args:
        estimator: The problem: what to solve, measure and refine.
        *data: The data, `(*batch, n, d)` each, equally many; batch dimensions broadcast.
        threshold: Largest distance of an inlier, in the unit of the estimator's residual; one number or one per problem. None
            where it is not known: the scoring must then be one that does without (`LeastMedian`, which is then the default).
        mask: Which data exist; all of them if not given. Problems of different size share a batch this way.
        quality: How much each datum can be trusted, the larger the more, in any unit: the samples then favour the best.
        weights: For how many data each datum counts: in sampling, in comparing models, in refinement. 0 is absent. In any unit:
            what is consensus depends on their ratios alone.
        scoring: How models are compared: `Msac()` (the default), `Magsac()`, `InlierCount()`, `LeastMedian()`.
        sampler: How samples are drawn: `Uniform()` (the default), `Prosac()` (where `quality` is given), `Neighbours()`.
        generator: Source of randomness; PyTorch's global one if not given.
        confidence: Wanted probability of having drawn a sample without outliers.
        min_iterations: Fewest samples to draw for a problem.
        max_iterations: Most samples to draw for a problem.
        scoring_dtype: Type for scoring hypotheses; that of the data if not given. float32 is enough for data of moderate size
            around 0.
        covariance: Compute the covariance of the step, in the sense of the estimator's `retract`, that leads from the refined
            model to the true one.

    Returns:
        Model, inliers, support, threshold, iterations, status and degeneracy of each problem. If the estimator is
        `Differentiable`, the model carries its derivatives with respect to the inliers, their weights, and fields of the
        estimator: those of the optimum of the final refinement, whose data and scale are held. They are zero where the model is
        not such an optimum.

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or the estimator lacks what it must have.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(8, 100, 2, generator=g, dtype=torch.float64)  # eight problems
        >>> x2 = x1 + 0.1
        >>> x2[:, :40] = torch.rand(8, 40, 2, generator=g, dtype=torch.float64)  # in each 40 % are wrong
        >>> found = torchsfm.ransac(torchsfm.motion.HomographyEstimator(), x1, x2, threshold=1e-3, generator=g)
        >>> found.model.shape, bool(found.inliers[:, 40:].all()), bool((found.status == torchsfm.Status.OK).all())
        (torch.Size([8, 3, 3]), True, True)
    """
    flat = Flat.of(estimator, data, threshold, mask, unknown_threshold=1.0, quality=quality, weights=weights)
    check_options(
        confidence=(confidence, "0 < float < 1"),
        min_iterations=(min_iterations, "int >= 0"),
        max_iterations=(max_iterations, "int >= 1"),
        scoring=(scoring, Scoring | None),
        sampler=(sampler, Sampler | None),
        covariance=(covariance, bool),
        scoring_dtype=(scoring_dtype, torch.dtype | None),
    )
    moves = isinstance(estimator, Differentiable)
    if covariance and not moves:
        raise ValueError(f"covariance: {type(estimator).__name__} does not say how its models move (see `Differentiable`)")
    scoring = scoring or (LeastMedian() if threshold is None else Msac())
    if threshold is None and scoring.needs_threshold:
        raise ValueError(f"threshold: {type(scoring).__name__} wants one, got None")
    sampler = sampler or (Uniform() if quality is None else Prosac())
    if isinstance(sampler, Prosac) and quality is None:
        raise ValueError("sampler: Prosac() wants the quality of the data, got none")
    dtype = data[0].dtype
    options = Options(
        draw_seed(generator), confidence, min_iterations, max_iterations, scoring_dtype or dtype, scoring, sampler
    )  # fmt: skip
    _keep_freed_memory()
    flat = cast(flat, torch.float64)
    counts = flat.of_data.get("weights")
    with torch.no_grad():
        verdict, unit = _solve(tensor_map(Tensor.detach, flat), options)
    model, spread = verdict.model, None
    if covariance or (moves and wants_derivative(*flat.data, *tensors_of((counts, flat.estimator)))):
        counts = torch.ones_like(flat.data[0][..., 0]) if counts is None else counts
        if covariance:
            fixed = tensor_map(Tensor.detach, flat)
            spread = step_covariance(fixed.estimator, model, fixed.data, counts.detach(), verdict.selected, verdict.reach)
        model = attach_derivative(flat.estimator, model, flat.data, counts, verdict.selected, verdict.reach)
    result = RobustResult(
        model=model,
        inliers=verdict.inliers,
        # Weights near the largest number there is leave it there.
        support=(verdict.support * unit).clamp(max=torch.finfo(dtype).max),
        threshold=verdict.bound,
        iterations=verdict.iterations,
        status=verdict.status,
        degeneracy=verdict.degeneracy,
        covariance=spread,
    )
    return flat.unflatten(cast(result, dtype))


def _solve(flat: Flat, options: Options) -> tuple[Verdict[Any], Float[Tensor, "p"]]:
    """What becomes of all problems of a call, and the unit of its weights."""
    usable, weights, unit = flat.usable(), flat.of_data.get("weights"), torch.ones_like(flat.bound)
    if weights is not None:
        row = torch.isfinite(weights) & (weights > 0)
        usable = row if usable is None else usable & row
        weights, unit = _evidence(weights, usable)
    p, n = flat.shape
    size = flat.estimator.sample_size
    square = flat.bound * flat.bound
    enough = (flat.bound > 0) & (square < torch.inf) & (n >= size if usable is None else usable.sum(-1) >= size)
    verdicts = []
    for problems in pack(flat, usable, enough, flat.of_data.get("quality"), weights):
        verdicts.append((problems.member, judge(problems, *search(problems, options), n)))
    if len(verdicts) == 1 and len(verdicts[0][0]) == p:
        return verdicts[0][1], unit
    result = Verdict.untried(flat)
    for member, found in verdicts:
        result = zip_map(lambda old, new: old.index_copy(0, member, new), result, found)  # noqa: B023
    return result, unit


def search(problems: Problems, options: Options) -> tuple[Best, Float[Tensor, "p width"]]:
    """Find the best model of each problem, in float64, refined, and the squared distances of its data."""
    coarse = problems.cast(options.dtype)
    source = coarse if is_kind(problems.estimator, SolvedInSingle) else problems
    best = Best.none(coarse)
    while True:
        wanted = samples_wanted(best.iterations, best.needed, options.min_iterations, options.max_iterations)
        part = wanted.nonzero()[:, 0]
        if not len(part):
            break
        best, models, loss = propose(source, coarse, best, part, wanted[part], options)
        best = optimise(coarse, best, part, models, loss, options)
    best = search_inliers(source, coarse, best, options)
    best = try_alternatives(problems, coarse, best, options)
    return refine_finally(problems, coarse, best)


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


@cache
def _keep_freed_memory() -> None:
    """Let the C library keep what is freed: otherwise it gives it back, and every step faults its memory in anew.

    glibc raises its limits to the largest block ever freed (mallopt, M_MMAP_THRESHOLD); nothing is written to this one.
    """
    torch.empty(31 << 20, dtype=torch.uint8)
