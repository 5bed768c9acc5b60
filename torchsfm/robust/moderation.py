"""Data of moderate size around 0, so that squares fit float32 and a threshold stays a threshold."""

import math

import torch
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.robust.sampling import compact, spread_order

_MANY = 128
"""Of how many points to take the median."""
_FAR = 1e5
"""How many times as far as the median a point may be: fourth powers of that fit float32, and none is farther in earnest."""

_ABSURD = 1e8
"""How many times farther than others a half of all points must be to be no measure."""


def present(mask: Tensor | None, *data: Tensor) -> Tensor | None:
    """Which data exist and are finite; None for all."""
    usable = mask
    for d in data:
        # A sum is finite only if all numbers are.
        if not math.isfinite(float(d.detach().sum())):
            row = torch.isfinite(d).all(-1)
            usable = row if usable is None else usable & row
    return usable


def moderate(X: Tensor, usable: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Points of moderate size around 0, and their `middle_and_size`, which are held when the points move."""
    centre, size = middle_and_size(X.detach(), usable)
    return moved_and_scaled(X, centre, size), centre, size


def moved_and_scaled(X: Tensor, centre: Tensor, size: Tensor) -> Tensor:
    """(X - centre) / size, computed with one coordinate in a row; NaN, as what does not exist, where that is absurdly far."""
    rows = (X.mT.contiguous() - centre[..., None]) / size[..., None, None]
    near = rows.detach().abs() <= _FAR
    if not bool(near.all()):
        rows = torch.where(near.all(-2, keepdim=True), rows, torch.nan)
    return rows.mT


def middle_and_size(X: Tensor, usable: Tensor | None) -> tuple[Tensor, Tensor]:
    """Medians of the usable points and of their distances from it: wrong points, wherever they are, cost the others nothing.

    Points at the median itself have no distance: where most coincide the others are the measure. Of many points, some that are
    spread over all will do. Which ones depends on the usable points alone.
    """
    n = X.shape[-2]
    if n <= 2 * _MANY:
        return _medians(X, usable)
    if usable is None:
        return _medians(X[..., spread_order(n, n, X.device)[:_MANY], :], None)
    usable = usable.expand(*broadcast_shapes(X.shape[:-2], usable.shape[:-1]), n)
    count = usable.sum(-1)
    many = count > 2 * _MANY
    if not bool(many.any()):
        return _medians(X, usable)
    part = compact(usable.reshape(-1, n), count.flatten(), n)[:, :_MANY].reshape(*usable.shape[:-1], _MANY, 1)
    middle, radius = _medians(X.expand(*usable.shape, -1).gather(-2, part.expand(*part.shape[:-1], X.shape[-1])), None)
    if bool(many.all()):
        return middle, radius
    centre, size = _medians(X, usable)
    return torch.where(many[..., None], middle, centre), torch.where(many, radius, size)


def _medians(X: Tensor, usable: Tensor | None) -> tuple[Tensor, Tensor]:
    rows = X.mT.contiguous()
    if not rows.shape[-1]:
        centre = rows.new_zeros(rows.shape[:-1] if usable is None else (*usable.shape[:-1], rows.shape[-2]))
        return centre, torch.ones_like(centre[..., 0])
    if usable is not None:
        rows = torch.where(usable[..., None, :], rows, torch.nan)
    centre = rows.nanmedian(dim=-1).values
    if usable is not None:
        centre = torch.where(usable.any(-1)[..., None], centre, 0)
    distance = (rows - centre[..., None]).abs_().amax(-2)
    distance = torch.where(distance > 0, distance, torch.nan)
    size = distance.nanmedian(dim=-1).values
    # More than half may be absurdly far: the others are the measure, or nothing would be left of their digits.
    absurd = size > _ABSURD * distance.nan_to_num(nan=torch.inf).amin(-1)
    if bool(absurd.any()):
        low = torch.where(distance <= size[..., None], distance, torch.nan).nanmedian(dim=-1).values
        rest = torch.where(distance <= _ABSURD * low[..., None], distance, torch.nan).nanmedian(dim=-1).values
        size = torch.where(absurd, rest, size)
    return centre, torch.where((size > 0) & (size < torch.inf), size, 1)
