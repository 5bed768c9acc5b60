"""How large the noise is: the scale of Gaussian inliers among even outliers, and the reach of the loss that fits it."""

import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.hypotheses import squared_residual
from torchsfm.robust.local_optimisation import LOCAL_DATA, falling, step_within
from torchsfm.robust.models import select, zip_map

M = TypeVar("M")
T = TypeVar("T")

_GLANCE, _SCALE_DATA = 128, 512
"""How many data the first guess at the scale looks at, and each round but the last."""
_LEAST, _MOST = 1e-6, 16.0
"""Smallest and largest variance of the noise in units of the squared threshold."""
_VARIANCES, _SHARE_STEPS = tuple(4.0**i for i in range(-4, 3)), 2
"""Variances of which the estimation of the scale starts with the likeliest, and rounds that find the share of inliers."""
_WINDOW = 16.0
"""How far from the model its noise is looked for, in thresholds."""
_WIDE_STEPS = (16.0, 8.0, 4.0)
"""Reaches, in thresholds, of the steps that look for a model of more noise than the threshold says."""
_CROWD = 0.1
"""How many data beyond the threshold, for one within, make that worth while."""
_MARGIN = 3.0
"""How much larger the logarithm of the likelihood of what they find must be: rounding must not decide on nonsense."""
_SCALE_STEPS = 3
"""Rounds of reweighted least squares that estimate the scale."""


def scale_of_noise(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    counts: Tensor,
) -> tuple[M, Float[Tensor, "g"]]:
    """Reweighted least squares out to the distance where an outlier is as likely as an inlier, and that distance.

    The weights fall as 1 - (distance / reach)^2. The reach follows from the scale of the noise, that of Gaussian inliers among
    evenly spread outliers within many thresholds: the likeliest of a few at first, then by expectation maximisation, one step
    for each round of weights. So the answer depends little on how well the threshold was chosen. Where many data are beyond
    the threshold but not far from it, a model through the best of them may be wrong: then that from all of them is tried too.

    Args:
        estimator: The problem.
        model: One model of each problem, `(g, ...)`.
        data: The data, each `(g, n, d)`.
        limit: Squared threshold.
        counts: What the data count, `(g, n)`: a boolean or a weight.

    Returns:
        The model, and the square of its reach in units of the squared threshold, rounded to a coarse grid: so the model that
        `optimise_fully` makes is the optimum of one fixed loss, also when the data move a little, and has a derivative.
    """
    _, noise, crowd = _first_noise(estimator, model, [d[:, :_GLANCE] for d in data], limit, counts[:, :_GLANCE])
    rows = crowd.nonzero()[:, 0]
    if len(rows):

        def take(tree: T) -> T:
            return tensor_map(lambda t: t[rows], tree)

        found, own = _widened(take(estimator), take(model), take(data), limit[rows], counts[rows])
        model, noise = zip_map(lambda t, new: t.index_copy(0, rows, new), (model, noise), (found, own))
    some, counted = [d[:, :_SCALE_DATA] for d in data], counts[:, :_SCALE_DATA]
    for _ in range(_SCALE_STEPS - 1):
        model, noise, _ = _scale_step(estimator, model, some, limit, counted, noise)
    model, _, reach = _scale_step(estimator, model, data, limit, counts, noise)
    return model, reach


def _widened(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Float[Tensor, "g"], counts: Tensor
) -> tuple[M, tuple[Tensor, Tensor]]:
    """The likelier of a model and what becomes of it with far larger thresholds, and the noise."""
    data, counts, wide = [d[:, :LOCAL_DATA] for d in data], counts[:, :LOCAL_DATA], model
    for factor in _WIDE_STEPS:
        wide, _ = step_within(estimator, wide, data, factor**2 * limit, counts)
    (old, noise, _), (new, wider, _) = (_first_noise(estimator, one, data, limit, counts) for one in (model, wide))
    return select(new > old + _MARGIN, (wide, wider), (model, noise))


def _first_noise(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Tensor, counts: Tensor
) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor]:
    """The likeliest scale of Gaussian noise among evenly spread outliers within the window.

    Returns:
        The logarithm of the likelihood `(g)` against that of outliers alone; the variance, and the odds of an outlier where the
        model is, `(g, 1)`; and whether there are many data beyond the threshold, `(g)`.
    """
    k = estimator.codimension
    ratio, there, total = _within_window(squared_residual(estimator, model, *data), limit, counts)
    core = ((ratio < 1) * there).sum(-1)
    crowd = total[:, 0] - core > _CROWD * core
    table = [(v, -0.5 / v, _peak(k) * _WINDOW**k * v ** (-k / 2)) for v in _VARIANCES]
    variance, slope, peak = torch.tensor(table, dtype=ratio.dtype, device=ratio.device)[:, :, None].unbind(1)
    # The density of an inlier in units of that of an outlier.
    density = torch.exp(ratio[:, None] * slope) * peak
    gain, there, some = density - 1, there[:, None], total[:, None].clamp(min=1)
    own, share = there * density, torch.full_like(gain[..., :1], 0.5)
    for _ in range(_SHARE_STEPS):
        share = ((share * own / (1 + share * gain)).sum(-1, keepdim=True) / some).clamp(max=0.999)
    evidence, index = (there * torch.log1p(share * gain)).sum(-1).max(-1, keepdim=True)
    variance = variance[:, 0][index]
    number = (share[..., 0].gather(-1, index) * total).clamp(min=1)
    return evidence[:, 0], (variance, _odds(total, number, variance, k)), crowd


def _scale_step(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Tensor,
    counts: Tensor,
    noise: tuple[Tensor, Tensor],
) -> tuple[M, tuple[Tensor, Tensor], Tensor]:
    """A step by the noise that the distances before it show, that noise, and its squared reach `(g)` in squared thresholds."""
    k, (variance, odds), found = estimator.codimension, noise, limit

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal variance, odds, found
        ratio, there, total = _within_window(squared, limit, counts)
        likely = there / (1 + odds * torch.exp((0.5 * ratio / variance).clamp(max=60)))
        number = likely.sum(-1, keepdim=True).clamp(min=1)
        variance = ((likely * ratio).sum(-1, keepdim=True) / (k * number)).clamp(_LEAST, _MOST)
        odds = _odds(total, number, variance, k)
        # Where they are even, on a coarse grid.
        reach = (-1.6 * k * variance * odds.clamp(max=1 / 3).log()).clamp(max=_WINDOW**2)
        reach = torch.exp2((4 * reach.log2()).round() / 4)
        found = reach[:, 0]
        return falling((ratio / reach).clamp(max=1), counts, k)

    model = estimator.step(model, *data, weigh=weigh)
    return model, (variance, odds), found


def _within_window(squared: Tensor, limit: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distances in units of the squared threshold, at most those of the window, what is within counts, and its sum."""
    ratio = squared / limit[:, None]
    near = ratio < _WINDOW**2
    there = (near * counts).to(ratio.dtype)
    return torch.where(near, ratio, _WINDOW**2), there, there.sum(-1, keepdim=True)


def _odds(total: Tensor, number: Tensor, variance: Tensor, k: int) -> Tensor:
    """The odds of an outlier where a model is, from the number of inliers."""
    # Never less than half an outlier between two and six thresholds.
    outlying = (total - number).clamp(min=0) / _WINDOW**k + 0.5 / (6**k - 2**k)
    odds: Tensor = outlying / (number * _peak(k) * variance ** (-k / 2))
    return odds


def _peak(k: int) -> float:
    """The standard Gaussian at 0 in k dimensions, for a unit of volume in which the ball of radius 1 is 1."""
    return float((2 * math.pi) ** (-k / 2) * math.pi ** (k / 2) / math.gamma(k / 2 + 1))
