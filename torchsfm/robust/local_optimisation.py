"""From a model through a noisy sample to the optimum near it."""

from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.robust.estimator import Estimator
from torchsfm.robust.scoring import squared_residual

M = TypeVar("M")

LOCAL_STEPS = (9.0, 4.0, 1.5, 1.0)
"""Squared thresholds of the steps of local optimisation, in units of the squared threshold."""
LOCAL_DATA = 512
"""Local optimisation looks at this many data at most."""


def optimise_locally(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    inside: Bool[Tensor, "g n"],
) -> M:
    """Gauss-Newton on the truncated squared distance with a shrinking threshold (Chum, Matas & Kittler 2003).

    Args:
        estimator: The problem.
        model: `k` models of each problem, `(g, k, ...)`.
        data: The data, each `(g, 1, n, d)`.
        limit: Squared threshold.
        inside: Which slots hold data.
    """
    for factor in LOCAL_STEPS:
        squared = squared_residual(estimator, model, *data)
        weights = ((squared < (factor * limit)[:, None, None]) & inside[:, None]).to(squared.dtype)
        model = estimator.refine(model, *data, weights=weights)
    return model


def polish(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    inside: Bool[Tensor, "g n"],
    steps: int,
) -> M:
    """Iteratively reweighted Gauss-Newton on a Cauchy loss at half the threshold, cut off at twice the threshold."""
    for _ in range(steps):
        squared = squared_residual(estimator, model, *data)
        ratio = squared / limit[:, None, None]
        weights = torch.where((ratio < 4) & inside[:, None], 1 / (1 + 4 * ratio), 0)
        model = estimator.refine(model, *data, weights=weights)
    return model


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
