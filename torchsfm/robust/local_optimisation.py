"""From a model through a noisy sample to the optimum near it."""

import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.robust.estimator import Estimator
from torchsfm.robust.scores import Score
from torchsfm.robust.scoring import around_model, squared_residual

M = TypeVar("M")

LOCAL_STEPS = (9.0, 3.0, 1.0)
"""Squared thresholds of the steps of local optimisation, in units of the squared threshold."""
_LEAST = 1e-6
"""Smallest variance of the noise in units of the squared threshold."""
SCALE_STEPS, FIXED_STEPS = 3, 5
"""Rounds of the final refinement that estimate the scale of the noise, and rounds that hold it."""
LOCAL_DATA, SCALE_DATA = 256, 512
"""Local optimisation, and the estimation of the scale, look at so many data at most."""


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
        ratio = squared_residual(estimator, model, *data) * (1 / (factor * limit))[..., None]
        model = estimator.refine(model, *data, weights=score.weigh(ratio, estimator.codimension) * counts[:, None])
    return model


def scale_of_noise(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    inside: Bool[Tensor, "g n"],
    weight: Float[Tensor, "g n"] | None,
) -> tuple[M, Float[Tensor, "g"]]:
    """Reweighted least squares out to the distance where an outlier is as likely as an inlier, and that distance.

    The weights fall as 1 - (distance / reach)^2. The reach follows from the scale of the noise, estimated with the
    probabilities of being an inlier among Gaussian inliers and evenly spread outliers (expectation maximisation), and from the
    density of the outliers, counted between two and six thresholds from the model. So the answer depends little on how well
    the threshold was chosen. One Gauss-Newton step for each round of weights.

    Args:
        estimator: The problem.
        model: One model of each problem, `(g, 1, ...)`.
        data: The data, each `(g, 1, n, d)`.
        limit: Squared threshold.
        inside: Which slots hold data.
        weight: What the data count.

    Returns:
        The model, and the square of its reach in units of the squared threshold, rounded to a coarse grid: so the model that
        `optimise_within` makes is the optimum of one fixed loss, also when the data move a little, and has a derivative.
    """
    k = estimator.codimension
    # The standard Gaussian at 0 in k dimensions, for a unit of volume in which the ball of radius one threshold is 1.
    peak = (2 * math.pi) ** (-k / 2) * math.pi ** (k / 2) / math.gamma(k / 2 + 1)
    present = inside[:, None]
    variance = number = None
    for step in range(SCALE_STEPS + 1):
        ratio = squared_residual(estimator, model, *data) * (1 / limit)[:, None, None]
        density = around_model(ratio, present, k)[..., None]
        if variance is None or number is None:
            core = ((ratio < 1) & present).to(ratio.dtype)
            number = core.sum(-1, keepdim=True).clamp(min=1)
            # A Gaussian cut off at the threshold looks narrower than it is.
            variance = (1.6 / k * (core * ratio.clamp(max=1)).sum(-1, keepdim=True) / number).clamp(_LEAST, 1)
        inlying = number * peak * variance ** (-k / 2)
        reach = 1.6 * k * variance * (inlying / density).clamp(min=3).log()
        if step == SCALE_STEPS:
            break
        model = estimator.refine(model, *data, weights=_falling(ratio, reach, inside, weight))
        odds = density / inlying * torch.exp((0.5 * ratio / variance).clamp(max=60))
        likely = torch.where(present & (ratio < 9), 1 / (1 + odds), 0)
        number = likely.sum(-1, keepdim=True).clamp(min=1)
        variance = ((likely * ratio.clamp(max=9)).sum(-1, keepdim=True) / (k * number)).clamp(_LEAST, 1)
    return model, torch.exp2((4 * reach[:, 0, 0].log2()).round() / 4)


def optimise_within(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    inside: Bool[Tensor, "g n"],
    weight: Float[Tensor, "g n"] | None,
) -> M:
    """The optimum of the sum of u - u^2 / 2, u the squared distance over the squared reach, near a model `(g, 1, ...)`."""
    for _ in range(FIXED_STEPS):
        squared = squared_residual(estimator, model, *data)
        model = estimator.refine(model, *data, weights=_falling(squared, reach[:, None, None], inside, weight))
    return model


def _falling(squared: Tensor, reach: Tensor, inside: Tensor, weight: Tensor | None) -> Tensor:
    falling = (1 - squared * (1 / reach)).clamp(min=0) * (inside if weight is None else weight)[:, None]
    return falling.nan_to_num(nan=0.0)


def damped_solve(A: Float[Tensor, "*batch k k"], b: Float[Tensor, "*batch k r"]) -> Float[Tensor, "*batch k r"]:
    """Solve normal equations `A x = b`, damped as little as makes them definite; zero where even that fails.

    The unknowns are scaled to a unit diagonal first, so that they may be of different units.
    """
    scale = A.diagonal(dim1=-2, dim2=-1).clamp(min=1e-280).rsqrt()
    eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    factor, info = torch.linalg.cholesky_ex(A * scale[..., :, None] * scale[..., None, :] + 1e-10 * eye)
    factor = torch.where((info == 0)[..., None, None], factor, eye)
    x = torch.cholesky_solve(b * scale[..., None], factor) * scale[..., None]
    return torch.where((info == 0)[..., None, None] & torch.isfinite(x), x, 0)
