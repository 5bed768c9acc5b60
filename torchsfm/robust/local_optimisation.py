"""From a model through a noisy sample to the optimum near it."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.robust.estimator import Estimator
from torchsfm.robust.scores import Score
from torchsfm.robust.scoring import around_model, squared_residual

M = TypeVar("M")

Weigh = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From squared distances `(*batch, n)` to the weights of the data and to the curvature of their losses.

For a loss rho(r^2) the weight is rho' and the curvature the mean over the directions of r of rho' + 2 rho'' r r', at least 0:
the gradient takes the one, the Hessian the other.
"""

LOCAL_STEPS = (9.0, 3.0, 1.0)
"""Squared thresholds of the steps of local optimisation, in units of the squared threshold."""
_LEAST = 1e-6
"""Smallest variance of the noise in units of the squared threshold."""
SCALE_STEPS = 3
"""Rounds of the final refinement that estimate the scale of the noise."""
FIRST_STEPS, LAST_STEPS = 1, 3
"""Rounds that hold it, in the precision of scoring and in float64; twice as many without the curvature of the loss."""
LOCAL_DATA, SCALE_DATA = 256, 512
"""Local optimisation, and the estimation of the scale, look at so many data at most."""


def reweighted_step(estimator: Estimator[M], model: M, data: Sequence[Tensor], weigh: Weigh) -> M:
    """A step towards the optimum of a robust loss."""
    if hasattr(estimator, "reweighted_step"):
        moved: M = estimator.reweighted_step(model, *data, weigh=weigh)
        return moved
    return estimator.refine(model, *data, weights=weigh(squared_residual(estimator, model, *data))[0])


def optimise_locally(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g k"],
    counts: Tensor,
    score: Score,
) -> M:
    """Gauss-Newton on the score's own weights with a shrinking threshold (Chum, Matas & Kittler 2003).

    Args:
        estimator: The problem.
        model: `k` models of each problem, `(g, k, ...)`.
        data: The data, each `(g, 1, n, d)`.
        limit: Squared thresholds.
        counts: What the data count, `(g, n)`: a boolean or a weight.
        score: How models are compared.
    """
    for factor in LOCAL_STEPS:
        scale = (1 / (factor * limit))[..., None]

        def weigh(squared: Tensor, scale: Tensor = scale) -> tuple[Tensor, Tensor]:
            weights = score.weigh(squared * scale, estimator.codimension) * counts[:, None]
            return weights, weights

        model = reweighted_step(estimator, model, data, weigh)
    return model


def scale_of_noise(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    counts: Tensor,
) -> tuple[M, Float[Tensor, "g"]]:
    """Reweighted least squares out to the distance where an outlier is as likely as an inlier, and that distance.

    The weights fall as 1 - (distance / reach)^2. The reach follows from the scale of the noise, estimated with the
    probabilities of being an inlier among Gaussian inliers and evenly spread outliers (expectation maximisation), and from the
    density of the outliers, counted between two and six thresholds from the model. So the answer depends little on how well
    the threshold was chosen. One step for each round of weights.

    Args:
        estimator: The problem.
        model: One model of each problem, `(g, 1, ...)`.
        data: The data, each `(g, 1, n, d)`.
        limit: Squared threshold.
        counts: What the data count, `(g, n)`: a boolean or a weight.

    Returns:
        The model, and the square of its reach in units of the squared threshold, rounded to a coarse grid: so the model that
        `optimise_within` makes is the optimum of one fixed loss, also when the data move a little, and has a derivative.
    """
    k = estimator.codimension
    # The standard Gaussian at 0 in k dimensions, for a unit of volume in which the ball of radius one threshold is 1.
    peak = (2 * math.pi) ** (-k / 2) * math.pi ** (k / 2) / math.gamma(k / 2 + 1)
    present = counts[:, None]
    variance = number = reach = torch.empty(0)

    def weigh(squared: Tensor, first: bool = False, last: bool = False) -> tuple[Tensor, Tensor]:
        nonlocal variance, number, reach
        ratio = squared * (1 / limit)[:, None, None]
        density = around_model(ratio, present, k)[..., None]
        if first:
            core = ((ratio < 1) * present).to(ratio.dtype)
            number = core.sum(-1, keepdim=True).clamp(min=1)
            # A Gaussian cut off at the threshold looks narrower than it is.
            variance = (1.6 / k * (core * ratio.clamp(max=1)).sum(-1, keepdim=True) / number).clamp(_LEAST, 1)
        inlying = number * peak * variance ** (-k / 2)
        reach = 1.6 * k * variance * (inlying / density).clamp(min=3).log()
        if last:
            return ratio, ratio
        # What the next step takes for the noise.
        odds = density / inlying * torch.exp((0.5 * ratio / variance).clamp(max=60))
        likely = torch.where(ratio < 9, 1 / (1 + odds), 0) * present
        number = likely.sum(-1, keepdim=True).clamp(min=1)
        variance = ((likely * ratio.clamp(max=9)).sum(-1, keepdim=True) / (k * number)).clamp(_LEAST, 1)
        return _falling(ratio * (1 / reach), counts, k)

    for step in range(SCALE_STEPS):
        model = reweighted_step(estimator, model, data, partial(weigh, first=step == 0))
    weigh(squared_residual(estimator, model, *data), last=True)
    return model, torch.exp2((4 * reach[:, 0, 0].log2()).round() / 4)


def optimise_within(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
    steps: int,
) -> M:
    """The optimum of the sum of u - u^2 / 2, u the squared distance over the squared reach, near a model `(g, 1, ...)`."""
    scale = (1 / reach)[:, None, None]

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        return _falling(squared * scale, counts, estimator.codimension)

    for _ in range(steps if hasattr(estimator, "reweighted_step") else 2 * steps):
        model = reweighted_step(estimator, model, data, weigh)
    return model


def _falling(u: Tensor, counts: Tensor, codimension: int) -> tuple[Tensor, Tensor]:
    """Weight and curvature of the loss u - u^2 / 2, up to its maximum.

    Negative curvatures could make the Hessian indefinite. They are taken from all positive ones in proportion instead, so that
    steps are as long as they should be on average.
    """
    u, counts = u.clamp(max=1), counts[:, None]
    slope = 1 - u
    curvature = slope - (2 / codimension) * u * (slope > 0)
    total, curvature = (curvature * counts).sum(-1, keepdim=True), curvature.clamp_(min=0) * counts
    share = total / curvature.sum(-1, keepdim=True).clamp(min=_LEAST)
    return slope * counts, curvature * share.clamp(min=0.3)


def damped_solve(A: Float[Tensor, "*batch k k"], b: Float[Tensor, "*batch k r"]) -> Float[Tensor, "*batch k r"]:
    """Solve normal equations `A x = b`, damped as little as makes them definite; zero where even that fails.

    The damping is relative to the diagonal, so that the unknowns may be of different units.
    """
    A = A.clone()
    # As much as 1e-10 on the diagonal of the matrix scaled to a unit one; the scaling itself changes nothing.
    A.diagonal(dim1=-2, dim2=-1).mul_(1 + 1e-10).add_(1e-290)
    factor, info = torch.linalg.cholesky_ex(A)
    x = torch.cholesky_solve(b, factor).nan_to_num_(0, 0, 0)
    return x.mul_((info == 0)[..., None, None])
