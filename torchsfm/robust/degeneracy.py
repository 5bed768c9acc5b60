"""Why the data, although they agree on a model, may not determine it; asked of estimators that can tell.

A glance at a part of the data comes first, to look no further where it already shows that nothing is degenerate.
"""

from enum import IntEnum
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.estimator import Diagnosed
from torchsfm.robust.problems import Problems

GLANCE = 128
"""How many data to look at: any part of packed data is spread over all."""


class Degeneracy(IntEnum):
    """What the inliers of a model lack; results hold it as an int8 tensor over the batch.

    Which of these are found, and what they mean for the model, is said where the model is estimated.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(50, 2, generator=g, dtype=torch.float64)
        >>> x2 = x1 + 0.1 + 1e-4 * torch.randn(50, 2, generator=g, dtype=torch.float64)  # a plane: any epipole fits
        >>> found = torchsfm.estimate_fundamental(x1, x2, threshold=1e-3, generator=g)
        >>> torchsfm.Degeneracy(int(found.degeneracy)).name
        'PLANAR'
    """

    NONE = 0
    """Nothing was found."""
    TOO_FEW = 1
    """No more distinct inliers than a sample: they agree with any model through them."""
    COLLINEAR = 2
    """All points on a line, but for so few as chance explains."""
    PLANAR = 3
    """All points in a plane, or a camera that only turned, but for so few as chance explains."""
    ROTATION = 4
    """The camera only turned: there is no parallax."""
    UNDETERMINED = 5
    """No sample determined a model, for a reason that is none of the others."""


def glance(
    problems: Problems,
    model: Any,
    limit: Float[Tensor, "p"],
    inliers: Bool[Tensor, "p _"],
    chance: Float[Tensor, "p"],
) -> Bool[Tensor, "p"]:
    """Where the inliers may be degenerate, judging by a part of the data.

    Args:
        problems: The problems, of an estimator that is `Diagnosed`.
        model: The model of each.
        limit: Squared thresholds.
        inliers: Which of the first data or more agree with the model.
        chance: How many data agree by chance.
    """
    estimator: Any = problems.estimator
    data = [d[:, :GLANCE] for d in problems.data]
    found: Bool[Tensor, "p"] = estimator.may_be_degenerate(
        model, *data, inliers=inliers[:, :GLANCE], threshold=limit.sqrt(), chance=chance
    )
    return found


def diagnose(
    problems: Problems,
    model: Any,
    solved: Bool[Tensor, "p"],
    doubtful: Bool[Tensor, "p"] | None,
    near: Bool[Tensor, "p width"],
    number: Int[Tensor, "p"],
    chance: Float[Tensor, "p"],
) -> Int[Tensor, "p"]:
    """What the inliers lack, or all data where no sample determined a model: a `Degeneracy` each, as int8.

    Args:
        problems: The problems, with the thresholds by which the data were judged.
        model: The best model of each.
        solved: Whether any sample had a solution.
        doubtful: What a glance has left open; None if there was none yet.
        near: Which data agree with the model.
        number: How many these are, or no more than a sample where no more are distinct.
        chance: How many data agree by chance.
    """
    code = torch.full_like(solved, int(Degeneracy.UNDETERMINED), dtype=torch.int8).masked_fill_(solved, int(Degeneracy.NONE))
    if isinstance(problems.estimator, Diagnosed):
        if doubtful is None:
            doubtful = glance(problems, model, problems.limit, near, chance)
        index = (doubtful | ~solved).nonzero()[:, 0]
        if len(index):
            some, known, looked_at = problems.take(index), solved[index], near[index]
            estimator: Any = some.estimator
            found = estimator.degeneracy(
                tensor_map(lambda t: t[index], model), *some.data,
                inliers=torch.where(known[:, None], looked_at, some.inside), threshold=some.limit.sqrt(), chance=chance[index],
            )  # fmt: skip
            found = torch.where(known | (found != Degeneracy.NONE), found, int(Degeneracy.UNDETERMINED))
            code = code.index_copy(0, index, found.to(torch.int8))
    size = problems.estimator.sample_size
    few = (solved & (number <= size)) | (problems.count <= size)
    return code.masked_fill(few, int(Degeneracy.TOO_FEW))
