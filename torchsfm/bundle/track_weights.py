"""Weights for observations whose whole track fits worse than noise lets it."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_index, check_options
from torchsfm.geometry import BundleProblem
from torchsfm.optim import Loss

_EXACT = 1e-12
"""Standard deviation of image points, as a part of the largest coordinate, below which all is rounding."""
_LEAST = 1e-100
"""It is never less, not even where all points are the origin."""


def track_weights(
    problem: BundleProblem, *, loss: Loss | None = None, dof: float = 4.0, least_noise: float = 0.0
) -> Float[Tensor, "m"]:
    """How much the observations of each point count, by how well its track as a whole fits: weights for `bundle_adjust`.

    Outlines, highlights and places where one thing passes behind another are matched from image to image, but are no points:
    they move over the scene as the camera does. Each observation is only a little off, so that no robust loss of single
    distances tells, and they are off in the same way everywhere in the images, so that cameras follow them. What tells is the
    track: its distances share a scale of their own. With Student's distribution of all distances of a track at once (Lange,
    Little & Taylor 1989), a track of m observations, which have d = 2 m - 3 degrees of freedom left, with the sum S of squared
    distances weighs (dof + d) / (dof + S / s^2), at most 1. The noise s is that of the track in the middle, counted by
    observations.

    The weights belong to the residuals of the problem as it is. Adjusting with them and finding them anew, two or three times,
    comes to their fixed point.

    Args:
        problem: Near its minimum.
        loss: The robust loss of squared distances that goes with the weights, so that a single wrong observation takes less of
            the weight of the others of its track; squares if not given.
        dof: Degrees of freedom: the fewer, the faster weights fall.
        least_noise: Image points are never better than this, pixels.

    Returns:
        Weights between 0 and 1; 0 for observations that are not finite or whose point is behind the camera.

    Raises:
        ValueError: An option or an index of the problem does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 190, noise=0.5, generator=g).truth
        >>> problem.x[problem.point == 7] += 9 * torch.tensor([1, -1])  # a track that is none
        >>> weights = torchsfm.bundle.track_weights(problem)
        >>> bool(weights[problem.point == 7].max() < 0.2), bool(weights.median() > 0.9)
        (True, True)
    """
    check_options(loss=(loss, Callable | None), dof=(dof, "float > 0"))
    square, good, floor = squared_distances(problem, least_noise)
    point = problem.point
    rho = square if loss is None else loss(square)
    zero = rho.new_zeros(len(problem.X))
    length, total = zero.index_add(0, point, good.to(rho.dtype)), zero.index_add(0, point, rho)
    weights = student_weights(total, (2 * length - 3).clamp(min=1), length, dof, floor)
    return (weights[point] * good).to(problem.x.dtype)


def student_weights(
    total: Float[Tensor, "n"], left: Float[Tensor, "n"], count: Float[Tensor, "n"], dof: float, least: float
) -> Float[Tensor, "n"]:
    """Weights of groups of distances that share a scale each, by Student's distribution of all distances of a group at once.

    Args:
        total: Sums of squares.
        left: Degrees of freedom that are left of them, 1 at least.
        count: What the groups count in the choice of the middle one, whose noise is that of all.
        dof: Degrees of freedom of the distribution.
        least: The noise is never less.
    """
    rate = total / left
    order = rate.argsort()
    # The middle one by its observations: the noise of most of what cameras are made of.
    counted = count[order].cumsum(0)
    if not len(counted) or not bool(counted[-1] > 0):
        return torch.ones_like(total)
    middle = order[torch.searchsorted(counted, counted[-1:] / 2).clamp(max=len(order) - 1)]
    weights: Tensor = ((dof + left) / (dof + total / rate[middle].clamp(min=least**2))).clamp(max=1)
    return weights


def squared_distances(problem: BundleProblem, least_noise: float) -> tuple[Float[Tensor, "m"], Bool[Tensor, "m"], float]:
    """Of each observation, 0 where it does not count; where it does; and the least that the noise can be, pixels."""
    check_options(problem=(problem, BundleProblem), least_noise=(least_noise, "float >= 0"))
    check_index(view=(problem.view, len(problem.poses.R)), point=(problem.point, len(problem.X)))
    square = problem.residuals().detach().double().square()
    good = square.isfinite() & (problem.depths().detach() > 0)
    largest = float(problem.x.detach().abs()[good].max()) if bool(good.any()) else 0.0
    return torch.where(good, square, 0.0), good, max(least_noise, _EXACT * largest, _LEAST)
