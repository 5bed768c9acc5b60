"""Robust estimation of any model, for many problems at once.

Sample, score, optimise locally, stop: LO-RANSAC (Chum, Matas & Kittler 2003) with the MSAC score. The batch is
(problem, hypothesis); every problem has its own number of data and its own end. What becomes of a problem is a function of its
data and the seed alone: the sizes of all arrays that touch a problem follow from its own number of data.
"""

from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors, tensor_map
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import cast, zip_map
from torchsfm.robust.problems import pack
from torchsfm.robust.scoring import around_model, beyond_chance, squared_residual
from torchsfm.robust.search import Options, no_model, search

M = TypeVar("M")


@dataclass(frozen=True)
class RobustResult(Generic[M]):
    """A robustly estimated model for each problem of a batch.

    Attributes:
        model: The model; finite numbers without meaning where the status says that none was found.
        inliers: Which data are nearer to the model than the threshold.
        score: Sum over the data of max(0, 1 - squared distance / squared threshold): a soft number of inliers.
        iterations: Number of samples drawn.
        status: `OK`; `TOO_FEW` data for a sample; `NOT_FINITE`: too few of the data are finite; `DEGENERATE`: no sample
            determined a model; `NO_CONSENSUS`: no model was supported by more data than its own sample or chance explain
            (model and inliers are then those of the best one).
    """

    model: M
    inliers: Bool[Tensor, "*batch n"]
    score: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def ransac(
    estimator: Estimator[M],
    *data: Float[Tensor, "*#batch n _"],
    threshold: float | Float[Tensor, "*#batch"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    scores: Float[Tensor, "*#batch n"] | None = None,
    generator: torch.Generator | None = None,
    confidence: float = 0.9999,
    min_iterations: int = 64,
    max_iterations: int = 10_000,
    scoring_dtype: torch.dtype | None = None,
) -> RobustResult[M]:
    """Estimate a model for each problem of a batch from data of which many may be wrong.

    Minimal samples are solved in float64, hypotheses are scored and locally optimised in `scoring_dtype`, and the best model of
    each problem is refined in float64 on all its inliers with a robust loss. A problem ends when, with the given confidence,
    one of its samples was free of outliers, by the exact probability of such a sample.

    Rows with NaN or infinite numbers are left out. The result for a problem is the same whatever else is in the batch.

    Args:
        estimator: The problem: what to solve, measure and refine.
        *data: The data, `(*batch, n, d)` each, equally many; batch dimensions broadcast.
        threshold: Largest distance of an inlier, in the unit of the estimator's residual; one number or one per problem.
        mask: Which data exist; all of them if not given. Problems of different size share a batch this way.
        scores: How much each datum can be trusted, the larger the more, in any unit. Half of the samples then favour the best.
        generator: Source of randomness; PyTorch's global one if not given.
        confidence: Wanted probability of having drawn a sample without outliers.
        min_iterations: Fewest samples to draw for a problem.
        max_iterations: Most samples to draw for a problem, rounded up to a whole round.
        scoring_dtype: Type for scoring hypotheses; that of the data if not given. float32 is enough for data of moderate size
            around 0.

    Returns:
        Model, inliers, score, iterations and status of each problem.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    if not data:
        raise ValueError("data: wanted at least one tensor of shape (*batch, n, d), got none")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence: wanted a number between 0 and 1, got {confidence}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations: wanted a positive number, got {max_iterations}")
    known = {f"data[{i}]": (d, f"n {d.shape[-1]}" if d.ndim > 1 else "n d") for i, d in enumerate(data)}
    limit = threshold if isinstance(threshold, Tensor) else data[0].new_tensor(threshold)
    batch = check_tensors(**known, threshold=(limit, ""), mask=(mask, "n: bool"), scores=(scores, "n"))
    dtype, device, n = data[0].dtype, data[0].device, data[0].shape[-2]
    seed = int(torch.randint(1 << 62, (), generator=generator, device=None if generator is None else generator.device))
    with torch.no_grad():
        p = batch.numel()
        flat = [d.double().expand(*batch, n, d.shape[-1]).reshape(p, n, d.shape[-1]) for d in data]
        fields = tensor_map(lambda t: t.expand(batch + t.shape[len(batch) :]).reshape(p, *t.shape[len(batch) :]), estimator)
        fields = cast(fields, torch.float64)
        bound = limit.double().expand(batch).reshape(p)
        square = bound * bound
        exists = torch.ones(p, n, dtype=torch.bool, device=device)
        exists = exists if mask is None else mask.expand(*batch, n).reshape(p, n)
        usable = exists
        for d in flat:
            usable = usable & torch.isfinite(d).all(-1)
        trust = None if scores is None else scores.expand(*batch, n).reshape(p, n)
        enough = (usable.sum(-1) >= estimator.sample_size) & torch.isfinite(square) & (bound > 0)
        status = torch.full((p,), int(Status.NOT_FINITE), dtype=torch.int8, device=device)
        status[exists.sum(-1) < estimator.sample_size] = int(Status.TOO_FEW)
        model = no_model(fields, flat, p)
        inliers = torch.zeros(p, n, dtype=torch.bool, device=device)
        score = torch.zeros(p, dtype=torch.float64, device=device)
        iterations = torch.zeros(p, dtype=torch.long, device=device)
        options = Options(seed, confidence, min_iterations, max_iterations, scoring_dtype or dtype)
        for problems in pack(fields, flat, usable, enough, square, trust):
            best = search(problems, options)
            member = problems.member
            squared = squared_residual(problems.estimator, best.model, *problems.data)
            near = (squared < problems.limit[:, None]) & problems.inside
            ratio = squared / problems.limit[:, None]
            soft = torch.where(near, 1 - ratio, 0).sum(-1)
            expected = around_model(ratio, problems.inside, estimator.codimension)
            agreed = (near.sum(-1) > estimator.sample_size) & beyond_chance(
                soft, problems.count, expected, estimator.sample_size
            )
            fate = torch.where(agreed, int(Status.OK), int(Status.NO_CONSENSUS))
            status[member] = torch.where(best.solved, fate, int(Status.DEGENERATE)).to(torch.int8)
            model = zip_map(lambda old, new: old.index_copy(0, member, new), model, best.model)  # noqa: B023
            inliers[member] = problems.scatter(near, n)
            score[member] = soft
            iterations[member] = best.iterations
        return RobustResult(
            tensor_map(lambda t: t.to(dtype).reshape(batch + t.shape[1:]), model),
            inliers.reshape(*batch, n),
            score.to(dtype).reshape(batch),
            iterations.reshape(batch),
            status.reshape(batch),
        )
