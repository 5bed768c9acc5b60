"""How large the noise is: the scale of Gaussian inliers among even outliers, and the reach of the loss that fits it."""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.robust.estimator import Estimator
from torchsfm.robust.local_optimisation import LOCAL_DATA, falling, step_within
from torchsfm.robust.models import put, select, take

M = TypeVar("M")

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


class Noise(NamedTuple):
    """The noise of the inliers of each problem.

    Attributes:
        variance: Of a Gaussian, in units of the squared threshold.
        favour: The logarithm of the odds of an inlier where the model is.
    """

    variance: Float[Tensor, "g 1"]
    favour: Float[Tensor, "g 1"]


def scale_of_noise(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    counts: Tensor,
) -> tuple[M, Noise]:
    """The scale of Gaussian inliers among evenly spread outliers within many thresholds, and a model that fits it better.

    The likeliest of a few scales at first, then by expectation maximisation: so the answer depends little on how well the
    threshold was chosen. Where many data are beyond the threshold but not far from it, a model through the best of them may be
    wrong: then that from all of them is tried too.

    Args:
        estimator: The problem.
        model: One model of each problem, `(g, ...)`.
        data: The data, each `(g, n, d)`.
        limit: Squared threshold.
        counts: What the data count, `(g, n)`: a boolean or a weight.
    """
    found, noise, evidence, crowd = _first_step(estimator, model, data, limit, counts)
    rows = crowd.nonzero()[:, 0]
    if len(rows):
        own, wide, values, edge, counted = take((estimator, model, tuple(data), limit, counts), rows, len(crowd))
        for factor in _WIDE_STEPS:
            wide, _ = step_within(own, wide, [d[:, :LOCAL_DATA] for d in values], factor**2 * edge, counted[:, :LOCAL_DATA])
        wide, wider, likely, _ = _first_step(own, wide, values, edge, counted)
        old, least = take(((found, noise), evidence), rows, len(crowd))
        found, noise = put((found, noise), rows, select(likely > least + _MARGIN, (wide, wider), old))
    return found, noise


def step_by_noise(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Float[Tensor, "g"],
    counts: Tensor,
    variance: Float[Tensor, "g 1"],
    favour: Float[Tensor, "g 1"],
) -> tuple[M, Float[Tensor, "g"]]:
    """A step of reweighted least squares out to the distance where an outlier is as likely as an inlier, and that distance.

    The weights fall as 1 - (distance / reach)^2. The reach follows from the noise by one more round of expectation
    maximisation, over all data.

    Args:
        estimator: The problem.
        model: One model of each problem, `(g, ...)`.
        data: The data, each `(g, n, d)`.
        limit: Squared threshold.
        counts: What the data count, `(g, n)`: a boolean or a weight.
        variance: The noise as `scale_of_noise` found it.
        favour: The same.

    Returns:
        The model, and the square of its reach in units of the squared threshold, rounded to a coarse grid: so the model that
        `optimise_fully` makes is the optimum of one fixed loss, also when the data move a little, and has a derivative.
    """
    k, found = estimator.codimension, limit

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal found
        ratio, there, total = _within_window(squared, limit, counts)
        reach = _reach(_maximised(Noise(variance, favour), ratio, there, total, k), k)
        found = reach[:, 0]
        return falling((ratio / reach).clamp(max=1), counts, k)

    return estimator.step(model, *data, weigh=weigh), found


def _first_step(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Tensor, counts: Tensor
) -> tuple[M, Noise, Tensor, Tensor]:
    """A step by the noise of the likeliest scale.

    Returns:
        The model after it; the noise; the logarithm of its likelihood before, `(g)`, against that of outliers alone; and
        whether there are many data beyond the threshold, `(g)`.
    """
    k, noise, evidence, crowd = estimator.codimension, Noise(limit, limit), limit, limit

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal noise, evidence, crowd
        ratio, there, total = _within_window(squared, limit, counts)
        core = ((ratio < 1) * there).sum(-1)
        crowd = total[:, 0] > (1 + _CROWD) * core
        glance = there[:, :LOCAL_DATA]
        evidence, likeliest = _likeliest(ratio[:, :LOCAL_DATA], glance, glance.sum(-1, keepdim=True), k)
        noise = _maximised(likeliest, ratio, there, total, k)
        return falling((ratio / _reach(noise, k)).clamp(max=1), counts, k)

    model = estimator.step(model, *data, weigh=weigh)
    return model, noise, evidence, crowd


def _likeliest(ratio: Tensor, there: Tensor, total: Tensor, k: int) -> tuple[Tensor, Noise]:
    """The likeliest of a few scales, and the logarithm of its likelihood."""
    variance, slope, peak = _scales(k, ratio.dtype, ratio.device)
    # The density of an inlier in units of that of an outlier.
    density = torch.exp(ratio[:, None] * slope) * peak
    gain, there, some = density - 1, there[:, None], total[:, None].clamp(min=1)
    own, share = there * density, torch.full_like(gain[..., :1], 0.5)
    for _ in range(_SHARE_STEPS):
        share = ((share * own / (1 + share * gain)).sum(-1, keepdim=True) / some).clamp(max=0.999)
    evidence, index = (there * torch.log1p(share * gain)).sum(-1).max(-1, keepdim=True)
    number = (share[..., 0].gather(-1, index) * total).clamp(min=1)
    return evidence[:, 0], _noise_of(variance[:, 0][index], number, total, k)


@cache
def _scales(k: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """The variances to try, the slope of the logarithm of their density, and its peak in units of that of an outlier."""
    table = [(v, -0.5 / v, _peak(k) * _WINDOW**k * v ** (-k / 2)) for v in _VARIANCES]
    with torch.inference_mode(False):
        return torch.tensor(table, dtype=dtype, device=device).unsqueeze(-1).unbind(1)


def _maximised(noise: Noise, ratio: Tensor, there: Tensor, total: Tensor, k: int) -> Noise:
    """The noise after a round of expectation maximisation."""
    likely = there * torch.addcdiv(noise.favour, ratio, noise.variance, value=-0.5).sigmoid()
    number = likely.sum(-1, keepdim=True).clamp(min=1)
    variance = ((likely * ratio).sum(-1, keepdim=True) / (k * number)).clamp(_LEAST, _MOST)
    return _noise_of(variance, number, total, k)


def _noise_of(variance: Tensor, number: Tensor, total: Tensor, k: int) -> Noise:
    """The noise by its variance, the number of inliers, and that of all data within the window."""
    # Never less than half an outlier between two and six thresholds.
    outlying = (total - number).clamp(min=0) / _WINDOW**k + 0.5 / (6**k - 2**k)
    return Noise(variance, (number * _peak(k) * variance ** (-k / 2) / outlying).log())


def _reach(noise: Noise, k: int) -> Float[Tensor, "g 1"]:
    """The squared distance where inlier and outlier are as likely, in squared thresholds, on a coarse grid."""
    reach = (1.6 * k * noise.variance * noise.favour.clamp(min=math.log(3))).clamp(max=_WINDOW**2)
    return torch.exp2((4 * reach.log2()).round() / 4)


def _within_window(squared: Tensor, limit: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distances in units of the squared threshold, at most those of the window, what is within counts, and its sum."""
    ratio = squared / limit[:, None]
    near = ratio < _WINDOW**2
    there = (near * counts).to(ratio.dtype)
    return torch.where(near, ratio, _WINDOW**2), there, there.sum(-1, keepdim=True)


def _peak(k: int) -> float:
    """The standard Gaussian at 0 in k dimensions, for a unit of volume in which the ball of radius 1 is 1."""
    return float((2 * math.pi) ** (-k / 2) * math.pi ** (k / 2) / math.gamma(k / 2 + 1))
