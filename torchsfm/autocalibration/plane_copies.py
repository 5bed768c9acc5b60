"""Photographs that were given twice, under other names or saved again: their noise is the same and says nothing new."""

from typing import TypeVar

import torch
from torch import Tensor

from torchsfm._types import tensor_map

T = TypeVar("T")

_SAME = 0.25
"""Part of the variance of a difference of two views' noise below which it is one noise."""
_LEAST = 4
"""Points that both views show."""


def first_of_copies(x: Tensor, seen: Tensor, noise: Tensor) -> Tensor:
    """For each view the first one (b, v) of which it may be a copy, itself where there is none.

    Args:
        x: Points (b, v, n, 2).
        seen: Which there are (b, v, n).
        noise: Variance of each coordinate (b,).
    """
    first = torch.arange(x.shape[1], device=x.device).repeat(len(x), 1)
    for i in range(1, x.shape[1]):
        both = seen[:, :i] & seen[:, i, None]
        count = both.sum(-1)
        square = ((x[:, :i] - x[:, i, None]).square().sum(-1) * both).sum(-1) / (2 * count).clamp_min(1)
        copy = (square <= _SAME * 2 * noise[:, None]) & (count >= _LEAST)
        earliest = torch.where(copy, first[:, :i], i).amin(-1)
        first[:, i] = earliest
    return first


def of_first(first: Tensor, values: T) -> T:
    """What belongs to views (*batch, v, ...), of the first of their copies."""

    def gathered(value: Tensor) -> Tensor:
        place = first.reshape(*first.shape, *[1] * (value.ndim - first.ndim)).expand(value.shape)
        return value.gather(first.ndim - 1, place)

    return tensor_map(gathered, values)
