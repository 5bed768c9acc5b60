"""The judgement on the best models: which data agree with them, whether these are more than chance, and what they lack."""

from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.robust.degeneracy import Degeneracy, diagnose
from torchsfm.robust.improvement import Best
from torchsfm.robust.problems import Flat, Problems
from torchsfm.robust.stopping import around_model, beyond_chance

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
    ratio = torch.where(problems.inside, squared / limit[:, None], torch.inf).nan_to_num_(nan=torch.inf)
    near = ratio < 1
    soft = (1 - ratio).clamp_(min=0)
    number, expected = near.sum(-1), around_model(ratio, problems.inside, problems.estimator.codimension)
    if problems.weight is None:
        support = soft.sum(-1)
        likely = beyond_chance(support, problems.count, expected, size)
    else:
        weight = problems.weight
        support = (soft * weight).sum(-1)
        weighed = around_model(ratio, weight, problems.estimator.codimension)
        likely = beyond_chance(support, weight.sum(-1), weighed, size)
    agreed = (number > size) & likely
    fate = torch.where(agreed, int(Status.OK), int(Status.NO_CONSENSUS))
    optimal = agreed & best.solved & (reach > 0)
    reach = torch.where(optimal, reach, 1)
    judged = replace(problems, limit=limit)
    return Verdict(
        best.model,
        problems.scatter(near, n),
        support,
        limit.sqrt(),
        best.iterations,
        torch.where(best.solved, fate, int(Status.DEGENERATE)).to(torch.int8),
        diagnose(judged, best.model, best.solved, best.doubtful, near, expected),
        problems.scatter((ratio < (reach / limit)[:, None]) & optimal[:, None], n),
        reach,
    )
