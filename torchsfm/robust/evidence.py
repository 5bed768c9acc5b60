"""How many of the data that agree on a model are evidence: what repeats another datum says nothing new.

Of data nearer to each other than twice the threshold, whatever goes through the middle between them has all for inliers: they
are evidence once. A detector that gives one corner several times, or a list of matches joined with itself, is no consensus.
A glance at some of the inliers comes first, and nearly always suffices.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg.farthest_points import farthest_points
from torchsfm.robust.estimator import Located, is_kind
from torchsfm.robust.problems import Problems
from torchsfm.robust.sampling import hash_integers

_GLANCE, _MANY, _MOST = 256, 25, 0.75
"""How many data a glance looks at; how many inliers that it tells apart, or which part of all, are evidence enough."""
_REACH = 2.0
"""How far from each other data are evidence twice, in thresholds."""
_EQUAL = 1e-12
"""Part of the largest number by which rows that are equal may differ, where an estimator does not say where its data are."""
_FAR = 1e15
"""Cells from the origin, at most."""


def repeats_suspected(
    problems: Problems, near: Bool[Tensor, "p width"], number: Int[Tensor, "p"], threshold: Float[Tensor, "p"]
) -> Bool[Tensor, "p"]:
    """Where some of the inliers leave open that most repeat others; what is not suspected is not so.

    Args:
        problems: The problems.
        near: Which data agree with the model.
        number: How many these are.
        threshold: The largest distance of an inlier.
    """
    reach = _REACH * threshold[:, None] if is_kind(problems.estimator, Located) else 0
    # Data that one coordinate tells apart are apart; beyond the inliers infinities follow.
    first = torch.where(near[:, :_GLANCE], problems.data[0][..., 0][:, :_GLANCE], torch.inf).sort().values
    gaps = (first[:, 1:] - first[:, :-1] > reach).sum(-1)
    return gaps < (_MOST * number).clamp(problems.estimator.sample_size + 1, _MANY)


def count_distinct(
    problems: Problems, model: object, near: Bool[Tensor, "p width"], limit: Float[Tensor, "p"]
) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """How many inliers, and data, there are if those that repeat others count once.

    Args:
        problems: The problems.
        model: The model of each.
        near: Which data agree with it, at least one.
        limit: Squared threshold.
    """
    estimator, inside = problems.estimator, problems.inside
    if isinstance(estimator, Located):
        place, reach = estimator.places(model, *problems.data), _REACH * limit.sqrt()
    else:
        place = torch.cat(problems.data, -1)
        reach = _EQUAL * torch.where(inside[..., None], place, 0).abs().amax((-1, -2))
    place = place / reach.clamp(min=1e-300)[:, None, None]
    place = torch.where(inside[..., None], place, 0).nan_to_num(0, _FAR, -_FAR).clamp(-_FAR, _FAR)
    inliers = 1 + (farthest_points(place, near, _MANY)[1] > 1).sum(-1)
    # Cells may part what is near, but are few for all.
    inliers = torch.where(inliers > _MANY, torch.maximum(inliers, _cells(place, near)), inliers)
    return inliers, inliers + _cells(place, inside & ~near)


def _cells(place: Float[Tensor, "p n k"], counted: Bool[Tensor, "p n"]) -> Int[Tensor, "p"]:
    """How many cells of a grid hold the data that count."""
    axis = torch.arange(1, place.shape[-1] + 1, device=place.device)
    key = hash_integers(hash_integers(place.floor().long()) + axis).sum(-1)
    last = torch.iinfo(torch.int64).max
    key = torch.where(counted, key, last).sort().values
    return (key[:, 1:] != key[:, :-1]).sum(-1) + (key[:, -1] != last)
