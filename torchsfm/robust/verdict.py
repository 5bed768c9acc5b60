"""The judgement on the best models: which data agree with them, whether these are more than chance, and what they lack."""

from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.robust.degeneracy import Degeneracy, diagnose
from torchsfm.robust.evidence import count_distinct, repeats_suspected
from torchsfm.robust.improvement import Best
from torchsfm.robust.models import take
from torchsfm.robust.problems import Flat, Problems
from torchsfm.robust.stopping import around_fewer, around_model, beyond_chance

M = TypeVar("M")


@dataclass(frozen=True)
class Verdict(Generic[M]):
    """What becomes of each of some problems, for the data in the caller's order.

    Attributes:
        model: The model.
        inliers: Which data are nearer than the threshold.
        support: The soft number of inliers.
        bound: The threshold.
        iterations: Number of samples drawn.
        status: What became of it.
        degeneracy: What the inliers lack.
        selected: Which data are within the reach of the loss of which the model is the optimum; none where it is no optimum.
        reach: The square of that reach; 1 for a model that is none.
    """

    model: M
    inliers: Bool[Tensor, "p n"]
    support: Float[Tensor, "p"]
    bound: Float[Tensor, "p"]
    iterations: Int[Tensor, "p"]
    status: Int[Tensor, "p"]
    degeneracy: Int[Tensor, "p"]
    selected: Bool[Tensor, "p n"]
    reach: Float[Tensor, "p"]

    @classmethod
    def untried(cls, flat: Flat) -> "Verdict[Any]":
        """On problems with too few data to draw a sample."""
        none = torch.zeros(flat.shape, dtype=torch.bool, device=flat.bound.device)
        zero, status = torch.zeros_like(flat.bound), flat.refused()
        code = torch.full_like(status, int(Degeneracy.TOO_FEW))
        return cls(flat.no_models(), none, zero, flat.bound, zero.long(), status, code, none, zero + 1)


def judge(problems: Problems, best: Best, squared: Float[Tensor, "p width"], n: int) -> Verdict[Any]:
    """Judge the best models by all data, and say which of these they are the optimum of.

    Args:
        problems: The problems.
        best: The best model of each.
        squared: The squared distances of their data.
        n: How many data the caller has.
    """
    size, limit, reach = problems.estimator.sample_size, best.limit, best.reach
    threshold = limit.sqrt()
    ratio = torch.where(problems.inside, squared / limit[:, None], torch.inf).nan_to_num_(nan=torch.inf)
    near = ratio < 1
    soft = (1 - ratio).clamp_(min=0)
    number, expected = near.sum(-1), around_model(ratio, problems.inside, problems.estimator.codimension)
    if problems.weight is None:
        total, around = problems.count, expected
    else:
        soft, total = soft * problems.weight, problems.weight.sum(-1)
        around = around_model(ratio, problems.weight, problems.estimator.codimension)
    support = soft.sum(-1)
    agreed = (number > size) & beyond_chance(support, total, around, size) & best.solved
    # Data that repeat others are no evidence.
    index = (agreed & repeats_suspected(problems, near, number, threshold)).nonzero()[:, 0]
    if len(index):
        some, known = take((problems, best), index, len(near)), (near, number, support, total, around)
        enough, few = _distinct(*some, *(t[index] for t in known))
        agreed, number = agreed.index_copy(0, index, enough), number.index_copy(0, index, few)
    optimal = agreed & (reach > 0)
    reach = torch.where(optimal, reach, 1)
    status = torch.full_like(agreed, int(Status.DEGENERATE), dtype=torch.int8)
    status.masked_fill_(best.solved, int(Status.NO_CONSENSUS)).masked_fill_(agreed, int(Status.OK))
    selected = (ratio < (reach / limit)[:, None]) & optimal[:, None]
    inliers, selected = problems.scatter(torch.stack((near, selected)), n).unbind(0)
    return Verdict(
        best.model,
        inliers,
        support,
        threshold,
        best.iterations,
        status,
        diagnose(replace(problems, limit=limit), best.model, best.solved, best.doubtful, near, number, expected),
        selected,
        reach,
    )


def _distinct(
    some: Problems,
    best: Best,
    near: Bool[Tensor, "g width"],
    number: Int[Tensor, "g"],
    support: Float[Tensor, "g"],
    total: Tensor,
    around: Float[Tensor, "g"],
) -> tuple[Bool[Tensor, "g"], Int[Tensor, "g"]]:
    """Whether models have more support than chance if data that repeat others count once, and by how many inliers at most."""
    size, codimension = some.estimator.sample_size, some.estimator.codimension
    inliers, data = count_distinct(some, best.model, near, best.limit)
    own, of_all = ((few / every.to(support.dtype)) for few, every in ((inliers, number), (data, some.count)))
    likely = beyond_chance(support * own, total * of_all, around_fewer(around, of_all, codimension), size)
    return (inliers > size) & likely, torch.minimum(number, inliers)
