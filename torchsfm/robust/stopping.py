"""When enough samples are drawn, and whether what they found is more than chance."""

import math

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

_ROUND = 4096
"""The most samples that are drawn for a problem at a time."""
_LEAST = 0.5
"""How many data there are between two and six thresholds from a model where none is seen."""


def samples_wanted(drawn: Int[Tensor, "p"], needed: Float[Tensor, "p"], least: int, most: int) -> Int[Tensor, "p"]:
    """How many samples to draw next for each problem: none where it has had enough.

    So many that there are four times as many, or the rest.

    Args:
        drawn: How many samples each problem has had.
        needed: How many would do.
        least: Fewest samples of a problem.
        most: Most samples of a problem.
    """
    rest = needed.clamp(min=least, max=most).ceil().long() - drawn
    return torch.minimum(rest, (3 * drawn).clamp(min=max(least, 1), max=_ROUND)).clamp(min=0)


def around_model(
    ratio: Float[Tensor, "*batch n"], counts: Shaped[Tensor, "*#batch n"], codimension: int
) -> Float[Tensor, "*batch"]:
    """How many data the threshold would take in if they were as dense there as between two and six thresholds from the model.

    Args:
        ratio: Squared distances in units of the squared threshold.
        counts: What the data count: a boolean or a weight.
        codimension: The number of dimensions across the model.
    """
    between = ((ratio > 4) & (ratio < 36)).mul(counts).sum(-1)
    # Cast: a count plus a half would have the default dtype, whatever the data's.
    expected: Tensor = (between.to(ratio.dtype) + _LEAST) / (6**codimension - 2**codimension)
    return expected


def around_fewer(
    expected: Float[Tensor, "*batch"], share: Float[Tensor, "*batch"], codimension: int
) -> Float[Tensor, "*batch"]:
    """The same if of the data only a share counted."""
    return torch.lerp(torch.full_like(expected, _LEAST / (6**codimension - 2**codimension)), expected, share)


def beyond_chance(
    support: Float[Tensor, "p"], count: Shaped[Tensor, "p"], expected: Float[Tensor, "p"], size: int
) -> Bool[Tensor, "p"]:
    """Whether so much support is more than the best of all samples finds by chance (Moisan & Stival 2004, bounded by entropy).

    If a datum fits with probability p, a share q of n data does with probability exp(-n KL(q || p)) at most (Sanov's bound),
    and there are (n over size) samples to choose from.

    Args:
        support: Soft number of inliers.
        count: Number of data.
        expected: How many data would fit by chance.
        size: Number of data in a sample.
    """
    n = (count - size).to(support.dtype)
    q = ((support - size) / n.clamp(min=1)).clamp(1e-9, 1 - 1e-9)
    p = (expected / count).to(support.dtype).clamp(1e-4, 1 - 1e-9)
    # What is less than chance explains as little as what is as much.
    share = torch.maximum(q, p)
    rest = 1 - share
    entropy = torch.addcmul(share * (share / p).log(), rest, (rest / (1 - p)).log())
    samples = torch.lgamma(n + (size + 1.0)) - torch.lgamma(n + 1.0) - math.lgamma(size + 1)
    # Where nearly all data agree, there is no other explanation, however few they are.
    return (n * entropy > samples) | (q > 0.9)
