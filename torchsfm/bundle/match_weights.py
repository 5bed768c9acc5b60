"""Weights for tracks of two views, for which one check alone speaks."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.bundle.track_weights import squared_distances
from torchsfm.geometry import BundleProblem

_ROUNDS = 30
"""Of expectation and maximisation: what is left to gain then no weight shows."""
_KNOWN, _MOSTLY = 10.0, 0.9
"""As so many matches the share of all pairs of images counts in that of each; the share of right matches to begin with."""


def match_weights(
    problem: BundleProblem, *, extent: float = 3.0, dof: float = 4.0, least_noise: float = 0.0
) -> Float[Tensor, "m"]:
    """How likely each track of two views is right, by all of its pair of images: weights for `bundle_adjust`.

    One distance alone tells whether a match of two views is right. Where things look alike, as the windows of a facade, many
    wrong ones lie along epipolar lines, and cameras give way to them. Cameras that longer tracks have placed do not; the
    distances of matches are a mixture then. Those of right ones have Student's distribution, of one scale in all images; those
    of wrong ones are as likely at any distance; and how many are right differs from pair to pair (MLESAC: Torr & Zisserman
    2000, with Student's distribution in place of the normal one, by expectation and maximisation). A match that is a little off
    is trusted where nearly all of its pair fit, and not where many do not.

    To be multiplied by `track_weights`. So that wrong matches have no say in where the cameras are, adjust first with little
    weight on tracks of two views; then with these weights, two or three times.

    Args:
        problem: Near its minimum.
        extent: Distances up to which wrong matches were taken for right ones, pixels.
        dof: Degrees of freedom of the distribution of right ones: the fewer, the more of them are far off.
        least_noise: Image points are never better than this, pixels.

    Returns:
        The probability that the track is right, for both of its observations, and 1 for tracks of more views; 0 for
        observations that are not finite or whose point is behind the camera.

    Raises:
        ValueError: An option or an index of the problem does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(2, 100, 200, generator=g).truth
        >>> problem.x[:] += 0.2 * torch.randn(200, 2, generator=g)  # pixels
        >>> problem.x[problem.point < 30] += 2 * torch.randn(60, 2, generator=g)  # matches that are none
        >>> weights = torchsfm.bundle.match_weights(problem)
        >>> bool(weights[problem.point < 30].mean() < 0.3), bool(weights[problem.point >= 30].mean() > 0.7)
        (True, True)
    """
    check_options(extent=(extent, "float > 0"), dof=(dof, "float > 0"))
    square, good, floor = squared_distances(problem, least_noise)
    point, view, v = problem.point[good].long(), problem.view[good].long(), len(problem.poses.R)
    length = torch.bincount(point, minlength=len(problem.X))
    match = (length == 2).nonzero()[:, 0]
    trust = torch.ones_like(length, dtype=torch.float64)
    if len(match):
        none = torch.zeros_like(length)
        first, last = (none.scatter_reduce(0, point, view, which, include_self=False) for which in ("amin", "amax"))
        pair = torch.unique((first * v + last)[match], return_inverse=True)[1]
        total = trust.new_zeros(len(length)).index_add(0, point, square[good])[match]
        trust[match] = _share_right(total, pair, extent, dof, floor)
    return (trust[problem.point.long()] * good).to(problem.x.dtype)


def _share_right(
    square: Float[Tensor, "n"], pair: Int[Tensor, "n"], extent: float, dof: float, least: float
) -> Float[Tensor, "n"]:
    """The posterior probabilities that matches are right, given squared distances and pairs of images."""
    count = torch.bincount(pair).to(square.dtype)
    density = 2 * math.exp(math.lgamma((dof + 1) / 2) - math.lgamma(dof / 2)) / math.sqrt(dof * math.pi)
    share, variance = torch.full_like(count, _MOSTLY), (2 * square.median()).clamp(min=least**2)
    right = torch.ones_like(square)
    for _ in range(_ROUNDS):
        near = 1 + square / (variance * dof)
        as_right = share[pair] * density * near ** (-(dof + 1) / 2) / variance.sqrt()
        right = as_right / (as_right + (1 - share[pair]) / extent)
        share = (torch.zeros_like(count).index_add(0, pair, right) + _KNOWN * right.mean()) / (count + _KNOWN)
        variance = ((dof + 1) / dof * (right / near * square).sum() / right.sum()).clamp(min=least**2)
    return right
