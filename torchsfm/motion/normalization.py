"""Bringing two images to a common moderate scale, so that a threshold stays a threshold."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class CommonScale(NamedTuple):
    """Points centred in each image, both divided by the same number.

    Attributes:
        x1: Points of the first image, between -1 and 1.
        x2: Points of the second image.
        T1: The similarity from the caller's first image to `x1`.
        T2: The similarity from the caller's second image to `x2`.
        scale: The common factor, by which distances are multiplied too.
    """

    x1: Float[Tensor, "*batch n 2"]
    x2: Float[Tensor, "*batch n 2"]
    T1: Float[Tensor, "*batch 3 3"]
    T2: Float[Tensor, "*batch 3 3"]
    scale: Float[Tensor, "*batch"]


def common_scale(
    x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"], mask: Bool[Tensor, "*#batch n"] | None
) -> CommonScale:
    """Centre the bounding boxes of both images' points, and divide by the larger half side.

    Bounding boxes, because they do not depend on the order of the points or on how many absent ones surround them, bit for bit.
    """
    (y1, y2), (T1, T2), scale = common_scale_of_views((x1, x2), mask)
    return CommonScale(y1, y2, T1, T2, scale)


def common_scale_of_views(
    x: Sequence[Float[Tensor, "*#batch n 2"]], mask: Bool[Tensor, "*#batch n"] | None
) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """The same for any number of images: the points, the similarities, the common factor."""
    # One coordinate in a row: extremes and differences are then taken along the memory.
    rows = [view.mT.contiguous() for view in x]
    # The similarity is held when the points move.
    fixed = [row.detach() for row in rows]
    low, high = _extremes(fixed, mask)
    centre = (low + high) / 2
    size = (high - low).amax((-2, -1)) / 2
    scale = torch.where((size > 0) & (size < torch.inf), 1 / size, 1)
    s = scale[..., None, None]
    similarities = s.new_zeros(*centre.shape[:-1], 3, 3)
    similarities.diagonal(dim1=-2, dim2=-1)[..., :2] = s
    similarities[..., :2, 2] = -s * centre
    similarities[..., 2, 2] = 1
    points = [((row - c[..., None]) * s).mT for row, c in zip(rows, centre.unbind(-2), strict=True)]
    return points, list(similarities.unbind(-3)), scale


def _extremes(rows: Sequence[Tensor], mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Of each coordinate of each view `(*batch, view, 2)`, the least and the largest where all views are finite, or 0."""
    if mask is None and rows[0].shape[-1]:
        low, high = _in_one([row.amin(-1) for row in rows]), _in_one([row.amax(-1) for row in rows])
        if math.isfinite(float((high - low).sum())):
            return low, high
    usable = torch.isfinite(rows[0]).all(-2)
    for row in rows[1:]:
        usable = usable & torch.isfinite(row).all(-2)
    if mask is not None:
        usable = usable & mask
    usable = usable[..., None, :]
    some = usable.any(-1)
    if not rows[0].shape[-1]:
        none = _in_one([torch.zeros_like(some * row.sum(-1)) for row in rows])
        return none, none
    low = _in_one([torch.where(some, torch.where(usable, row, torch.inf).amin(-1), 0) for row in rows])
    return low, _in_one([torch.where(some, torch.where(usable, row, -torch.inf).amax(-1), 0) for row in rows])


def _in_one(views: list[Tensor]) -> Tensor:
    if any(view.shape != views[0].shape for view in views):
        views = list(torch.broadcast_tensors(*views))  # type: ignore[no-untyped-call]
    return torch.stack(views, -2)


def largest_positive(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix or its negative, so that its entry of largest modulus is positive: one sign for one homogeneous matrix."""
    entries = M.flatten(-2)
    first = entries.detach().abs().argmax(-1, keepdim=True)
    return torch.where((entries.gather(-1, first) < 0)[..., None], -M, M)
