"""From a model through a noisy sample to the optimum near it."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.fused import fused
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
        model = _local_step(estimator, model, data, factor * limit, counts, score)
    return model


@fused("g 1", "g k", "g 1 n", "g k", "g n")
def _local_step(estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Tensor, counts: Tensor, score: Score) -> M:
    scale = (1 / limit)[..., None]

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        weights = score.weigh(squared * scale, estimator.codimension) * counts[:, None]
        return weights, weights

    return reweighted_step(estimator, model, data, weigh)


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
    model, noise = _scale_step(estimator, model, data, limit, counts, None)
    for _ in range(SCALE_STEPS - 1):
        model, noise = _scale_step(estimator, model, data, limit, counts, noise)
    return model, _reach_at(estimator, model, data, limit, counts, noise)


@fused("g 1", "g 1", "g 1 n", "g", "g n", "g")
def _scale_step(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Tensor,
    counts: Tensor,
    noise: tuple[Tensor, Tensor] | None,
) -> tuple[M, tuple[Tensor, Tensor]]:
    """A step, and the noise by the distances before it: its variance and the number of inliers, `(g, 1, 1)`."""
    k, present, found = estimator.codimension, counts[:, None], noise

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal found
        ratio = squared * (1 / limit)[:, None, None]
        if noise is None:
            core = ((ratio < 1) * present).to(ratio.dtype)
            number = core.sum(-1, keepdim=True).clamp(min=1)
            # A Gaussian cut off at the threshold looks narrower than it is.
            variance = (1.6 / k * (core * ratio.clamp(max=1)).sum(-1, keepdim=True) / number).clamp(_LEAST, 1)
        else:
            variance, number = noise
        odds, reach = _odds_and_reach(ratio, present, variance, number, k)
        odds = odds * torch.exp((0.5 * ratio / variance).clamp(max=60))
        likely = torch.where(ratio < 9, 1 / (1 + odds), 0) * present
        number = likely.sum(-1, keepdim=True).clamp(min=1)
        found = ((likely * ratio.clamp(max=9)).sum(-1, keepdim=True) / (k * number)).clamp(_LEAST, 1), number
        return _falling(ratio * (1 / reach), counts, k)

    model = reweighted_step(estimator, model, data, weigh)
    assert found is not None
    return model, found


@fused("g 1", "g 1", "g 1 n", "g", "g n", "g")
def _reach_at(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Tensor,
    counts: Tensor,
    noise: tuple[Tensor, Tensor],
) -> Tensor:
    """The squared reach `(g)` in units of the squared threshold, rounded."""
    ratio = squared_residual(estimator, model, *data) * (1 / limit)[:, None, None]
    _, reach = _odds_and_reach(ratio, counts[:, None], *noise, estimator.codimension)
    return torch.exp2((4 * reach[:, 0, 0].log2()).round() / 4)


def _odds_and_reach(ratio: Tensor, present: Tensor, variance: Tensor, number: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The odds of an outlier where a model is, and the squared distance at which they are even, for ratios `(g, 1, n)`."""
    # The standard Gaussian at 0 in k dimensions, for a unit of volume in which the ball of radius one threshold is 1.
    peak = (2 * math.pi) ** (-k / 2) * math.pi ** (k / 2) / math.gamma(k / 2 + 1)
    odds = around_model(ratio, present, k)[..., None] / (number * peak * variance ** (-k / 2))
    return odds, 1.6 * k * variance * (1 / odds).clamp(min=3).log()


def optimise_within(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
    steps: int,
) -> M:
    """The optimum of the sum of u - u^2 / 2, u the squared distance over the squared reach, near a model `(g, 1, ...)`."""
    for _ in range(steps if hasattr(estimator, "reweighted_step") else 2 * steps):
        model = _step_within(estimator, model, data, reach, counts)
    return model


@fused("g 1", "g 1", "g 1 n", "g", "g n")
def _step_within(estimator: Estimator[M], model: M, data: Sequence[Tensor], reach: Tensor, counts: Tensor) -> M:
    scale = (1 / reach)[:, None, None]

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        return _falling(squared * scale, counts, estimator.codimension)

    return reweighted_step(estimator, model, data, weigh)


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
