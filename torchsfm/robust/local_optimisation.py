"""From a model through a noisy sample to the optimum near it."""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.fused import fused
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import join, put, select, take_slots, tensors_of, zip_map
from torchsfm.robust.scores import Score
from torchsfm.robust.scoring import squared_residual

M = TypeVar("M")
T = TypeVar("T")

Weigh = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From squared distances `(*batch, n)` to the weights of the data and to the curvature of their losses.

For a loss rho(r^2) the weight is rho' and the curvature the mean over the directions of r of rho' + 2 rho'' r r', at least 0:
the gradient takes the one, the Hessian the other.
"""

LOCAL_STEPS = (9.0, 3.0, 1.0)
"""Squared thresholds of the steps of local optimisation, in units of the squared threshold."""
_LEAST, _MOST = 1e-6, 16.0
"""Smallest and largest variance of the noise in units of the squared threshold."""
_VARIANCES, _SHARE_STEPS = tuple(4.0**i for i in range(-4, 3)), 2
"""Variances of which the estimation of the scale starts with the likeliest, and rounds that find the share of inliers."""
WINDOW = 16.0
"""How far from the model its noise is looked for, in thresholds."""
WIDE_STEPS = (16.0, 8.0, 4.0)
"""Reaches, in thresholds, of the steps that look for a model of more noise than the threshold says."""
_CROWD = 0.1
"""How many data beyond the threshold, for one within, make that worth while."""
_MARGIN = 3.0
"""How much larger the logarithm of the likelihood of what they find must be: rounding must not decide on nonsense."""
SCALE_STEPS = 3
"""Rounds of the final refinement that estimate the scale of the noise."""
FIRST_STEPS, LAST_STEPS = 1, 3
"""Rounds that hold it, in the precision of scoring and in float64; twice as many without the curvature of the loss."""
_MOST_STEPS, _STILL, _SMALL = 64, 1e-5, 1e-10
"""At most so many of the last ones, for what still moves by more than so much of the first of them, and of the model."""
_FLAT, _ROUNDING, _DRAWN = 0.1, 1e-6, 9.0
"""The least curvature of a datum in units of its weight; the share by which a step may raise the loss, as it leaves its
manifold a little; how many times its length a step is drawn out at most."""
_GLANCE, LOCAL_DATA, SCALE_DATA = 128, 256, 512
"""The first guess of the scale, local optimisation, and the estimation of the scale look at so many data at most."""


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

    The weights fall as 1 - (distance / reach)^2. The reach follows from the scale of the noise, that of Gaussian inliers among
    evenly spread outliers within many thresholds: the likeliest of a few at first, then by expectation maximisation, one step
    for each round of weights. So the answer depends little on how well the threshold was chosen. Where many data are beyond
    the threshold but not far from it, a model through the best of them may be wrong: then that from all of them is tried too.

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
    _, noise, crowd = _first_noise(estimator, model, [d[:, :, :_GLANCE] for d in data], limit, counts[:, :_GLANCE])
    rows = crowd.nonzero()[:, 0]
    if len(rows):

        def take(tree: T) -> T:
            return tensor_map(lambda t: t[rows], tree)

        found, own = _widened(take(estimator), take(model), take(data), limit[rows], counts[rows])
        model, noise = zip_map(lambda t, new: t.index_copy(0, rows, new), (model, noise), (found, own))
    for _ in range(SCALE_STEPS):
        model, noise = _scale_step(estimator, model, data, limit, counts, noise)
    return model, _reach_at(estimator, model, data, limit, counts, noise)


def _widened(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Float[Tensor, "g"], counts: Tensor
) -> tuple[M, tuple[Tensor, Tensor]]:
    """The likelier of a model and what becomes of it with far larger thresholds, and the noise."""
    data, counts, wide = [d[:, :, :LOCAL_DATA] for d in data], counts[:, :LOCAL_DATA], model
    for factor in WIDE_STEPS:
        wide = optimise_within(estimator, wide, data, factor**2 * limit, counts, 1)
    both = join([model, wide], 1)
    evidence, noise, _ = _first_noise(estimator, both, data, limit, counts)
    winner = (evidence[:, 1:] > evidence[:, :1] + _MARGIN).long()
    variance, share = (t.gather(1, winner[..., None]) for t in noise)
    return take_slots(both, winner), (variance, share)


@fused("g 1", "g k", "g 1 n", "g", "g n")
def _first_noise(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], limit: Tensor, counts: Tensor
) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor]:
    """The likeliest scale of Gaussian noise among evenly spread outliers within the window.

    Returns:
        The logarithm of the likelihood `(g, k)` against that of outliers alone; the variance and the share of inliers among
        the data in the window, `(g, k, 1)`; and whether there are many data beyond the threshold of the first model, `(g)`.
    """
    k = estimator.codimension
    ratio, there, total = _within_window(squared_residual(estimator, model, *data), limit, counts)
    core = ((ratio < 1) * there).sum(-1)
    crowd = ((total[..., 0] - core) > _CROWD * core)[:, 0]
    variance = torch.tensor(_VARIANCES, dtype=ratio.dtype, device=ratio.device)[:, None]
    # The density of an inlier in units of that of an outlier.
    density = torch.exp(ratio[..., None, :] * (-0.5 / variance)) * (_peak(k) * WINDOW**k * variance ** (-k / 2))
    gain, there, some = density - 1, there[..., None, :], total[..., None].clamp(min=1)
    share = torch.full_like(gain[..., :1], 0.5)
    for _ in range(_SHARE_STEPS):
        share = ((there * share * density / (1 + share * gain)).sum(-1, keepdim=True) / some).clamp(max=0.999)
    evidence, index = (there * torch.log1p(share * gain)).sum(-1).max(-1, keepdim=True)
    return evidence[..., 0], (variance[:, 0][index], share[..., 0].gather(-1, index)), crowd


@fused("g 1", "g 1", "g 1 n", "g", "g n", "g")
def _scale_step(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    limit: Tensor,
    counts: Tensor,
    noise: tuple[Tensor, Tensor],
) -> tuple[M, tuple[Tensor, Tensor]]:
    """A step, and the noise by the distances before it: its variance and the share of inliers in the window, `(g, 1, 1)`."""
    k, found = estimator.codimension, noise

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal found
        ratio, there, total = _within_window(squared, limit, counts)
        odds, reach = _odds_and_reach(total, *noise, k)
        likely = there / (1 + odds * torch.exp((0.5 * ratio / noise[0]).clamp(max=60)))
        number = likely.sum(-1, keepdim=True).clamp(min=1)
        variance = ((likely * ratio).sum(-1, keepdim=True) / (k * number)).clamp(_LEAST, _MOST)
        found = variance, number / total.clamp(min=1)
        return _falling(ratio * (1 / reach), counts, k)

    model = reweighted_step(estimator, model, data, weigh)
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
    _, _, total = _within_window(squared_residual(estimator, model, *data), limit, counts)
    _, reach = _odds_and_reach(total, *noise, estimator.codimension)
    return torch.exp2((4 * reach[:, 0, 0].log2()).round() / 4)


def _within_window(squared: Tensor, limit: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distances in units of the squared threshold, at most those of the window, what is within counts, and its sum."""
    ratio = squared * (1 / limit)[:, None, None]
    near = ratio < WINDOW**2
    there = (near * counts[:, None]).to(ratio.dtype)
    return torch.where(near, ratio, WINDOW**2), there, there.sum(-1, keepdim=True)


def _odds_and_reach(total: Tensor, variance: Tensor, share: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The odds of an outlier where a model is, and the squared distance at which they are even."""
    number = (share * total).clamp(min=1)
    # Never less than half an outlier between two and six thresholds.
    outlying = (total - number).clamp(min=0) / WINDOW**k + 0.5 / (6**k - 2**k)
    odds = outlying / (number * _peak(k) * variance ** (-k / 2))
    return odds, (1.6 * k * variance * (1 / odds).clamp(min=3).log()).clamp(max=WINDOW**2)


def _peak(k: int) -> float:
    """The standard Gaussian at 0 in k dimensions, for a unit of volume in which the ball of radius 1 is 1."""
    return float((2 * math.pi) ** (-k / 2) * math.pi ** (k / 2) / math.gamma(k / 2 + 1))


def optimise_within(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
    steps: int,
) -> M:
    """Steps from models `(g, 1, ...)` to a minimum of the sum of u - u^2 / 2, u the squared distance over the squared reach."""
    for _ in range(steps if hasattr(estimator, "reweighted_step") else 2 * steps):
        model, _ = _step_within(estimator, model, data, reach, counts, torch.zeros_like(reach))
    return model


def optimise_fully(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Tensor],
    reach: Float[Tensor, "g"],
    counts: Tensor,
) -> tuple[M, Bool[Tensor, "g"]]:
    """That minimum itself, and where it was reached: only a minimum has a derivative.

    A step that raises the loss is taken back and the next one damped (Levenberg 1944): in the limit it is a short one of
    reweighted least squares, which cannot raise it. Steps that shrink slowly are drawn out (Anderson 1965, of depth 1).
    """
    settled = torch.zeros_like(reach, dtype=torch.bool)
    # What comes in lower precision is beside the manifold, where the loss may be less than anywhere on it.
    coarse, model = model, optimise_within(estimator, model, data, reach, counts, 1)
    found, row = model, torch.arange(len(reach), device=reach.device)
    problem: tuple[Any, ...] = (estimator, tuple(data), reach, counts)
    start, last, step = model, model, zip_map(torch.sub, model, coarse)
    first, least, damping = _size(step), torch.full_like(reach, torch.inf), torch.zeros_like(reach)
    for count in range(2, _MOST_STEPS + 1):
        own, values, edge, counted = problem
        moved, loss = _step_within(own, model, values, edge, counted, damping)
        # A loss that is no number is none.
        good = loss <= least * (1 + _ROUNDING)
        damping = torch.where(good, torch.where(loss < least, damping / 4, damping), (4 * damping).clamp(min=1))
        start, least = select(good, model, start), torch.where(good, loss, least)
        before, step = step, zip_map(torch.sub, moved, model)
        size = _size(step)
        done = good & ((size <= _STILL * first) | (size <= _SMALL * _size(moved)))
        drawn = _drawn_out(moved, last, step, before) if count > 2 else moved
        last, model = moved, select(good, drawn, start)
        if count < LAST_STEPS or not (bool(done.any()) or count == _MOST_STEPS):
            continue
        found = put(found, row, select(done, moved, start))
        settled = settled.index_copy(0, row, done)
        rest = (~done).nonzero()[:, 0]
        if not len(rest):
            break
        row, problem, start, last, model, step, first, least, damping = tensor_map(
            lambda t: t[rest],  # noqa: B023
            (row, problem, start, last, model, step, first, least, damping),
        )
    return found, settled


def _drawn_out(moved: M, last: M, step: M, before: M) -> M:
    """Where two steps, and the models they led to, say that steps lead."""
    change = zip_map(torch.sub, step, before)
    share = (_dot(step, change) / _dot(change, change)).nan_to_num(nan=0.0).clamp(-_DRAWN, 0.5)
    return zip_map(lambda t, old: t - share.reshape(-1, *(1,) * (t.ndim - 1)) * (t - old), moved, last)


def _dot(model: M, other: M) -> Float[Tensor, "g"]:
    """The sum of products of the entries of models `(g, 1, ...)`."""
    return torch.stack([t.flatten(1).sum(-1) for t in tensors_of(zip_map(torch.mul, model, other))]).sum(0)


def _size(model: M) -> Float[Tensor, "g"]:
    """The length of the entries of models."""
    return _dot(model, model).sqrt()


@fused("g 1", "g 1", "g 1 n", "g", "g n", "g")
def _step_within(
    estimator: Estimator[M], model: M, data: Sequence[Tensor], reach: Tensor, counts: Tensor, damping: Tensor
) -> tuple[M, Tensor]:
    """A step, and the loss `(g)` before it."""
    scale, loss = (1 / reach)[:, None, None], reach

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal loss
        u = (squared * scale).clamp(max=1)
        loss = ((u - 0.5 * u * u) * counts[:, None]).sum(-1)[:, 0]
        weights, curvature = _falling(u, counts, estimator.codimension)
        return weights, curvature + damping[:, None, None] * weights

    return reweighted_step(estimator, model, data, weigh), loss


def _falling(u: Tensor, counts: Tensor, codimension: int) -> tuple[Tensor, Tensor]:
    """Weight and curvature of the loss u - u^2 / 2, up to its maximum.

    Curvatures that are negative, or next to nothing, could make the Hessian indefinite or vanish. What they are raised by is
    taken from all in proportion, so that steps are as long as they should be on average, and bounded by a multiple of those of
    reweighted least squares.
    """
    u, counts = u.clamp(max=1), counts[:, None]
    slope = 1 - u
    curvature = slope - (2 / codimension) * u * (slope > 0)
    total, curvature = (curvature * counts).sum(-1, keepdim=True), torch.maximum(curvature, _FLAT * slope) * counts
    share = total / curvature.sum(-1, keepdim=True).clamp(min=_LEAST)
    return slope * counts, curvature * share.clamp(min=0.3)


def damped_solve(A: Float[Tensor, "*batch k k"], b: Float[Tensor, "*batch k r"]) -> Float[Tensor, "*batch k r"]:
    """Solve normal equations `A x = b`, damped as little as makes them definite; zero where even that fails.

    The damping is relative to the diagonal, so that the unknowns may be of different units. An unknown that nothing depends on
    is 0.
    """
    A = A.clone()
    diagonal = A.diagonal(dim1=-2, dim2=-1)
    known = diagonal > 1e-290
    # As much as 1e-10 on the diagonal of the matrix scaled to a unit one; the scaling itself changes nothing.
    diagonal.mul_(1 + 1e-10).add_(~known)
    factor, info = torch.linalg.cholesky_ex(A)
    x = torch.cholesky_solve(b, factor).nan_to_num_(0, 0, 0)
    return x.mul_(((info == 0)[..., None] & known)[..., None])
