"""A glance at a part of the data, to look no further where it already shows that nothing is degenerate."""

from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.robust.problems import Problems
from torchsfm.robust.scoring import around_model, squared_residual

GLANCE = 128
"""How many data to look at: any part of packed data is spread over all."""


def suspected(
    problems: Problems,
    model: Any,
    limit: Float[Tensor, "p"],
    inliers: Bool[Tensor, "p _"] | None = None,
    chance: Float[Tensor, "p"] | None = None,
) -> Bool[Tensor, "p"]:
    """Where a glance leaves open that the inliers are degenerate, for an estimator that says what to `suspect`.

    Args:
        problems: The problems.
        model: The model of each.
        limit: Squared thresholds.
        inliers: Which of the first data or more agree with the model; found out if not given.
        chance: How many data agree by chance; estimated if not given.
    """
    data = [d[:, :GLANCE] for d in problems.data]
    if inliers is None or chance is None:
        inside = problems.inside[:, :GLANCE]
        ratio = squared_residual(problems.estimator, model, *data) / limit[:, None]
        inliers = (ratio < 1) & inside
        chance = around_model(ratio, inside, problems.estimator.codimension) * (problems.width / inside.shape[-1])
    found: Bool[Tensor, "p"] = problems.estimator.suspect(  # type: ignore[attr-defined]
        model, *data, inliers=inliers[:, :GLANCE], threshold=limit.sqrt(), chance=chance
    )
    return found
