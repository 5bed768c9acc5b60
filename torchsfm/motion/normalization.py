"""Bringing two images to a common moderate scale, so that a threshold stays a threshold."""

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
    # The similarity is held when the points move.
    fixed = [view.detach() for view in x]
    usable = torch.isfinite(fixed[0]).all(-1)
    for view in fixed[1:]:
        usable = usable & torch.isfinite(view).all(-1)
    if mask is not None:
        usable = usable & mask
    usable = usable[..., None]
    some = usable.any(-2)
    centres, halves = [], []
    for view in fixed:
        if view.shape[-2] == 0:
            low = high = torch.where(some, torch.zeros_like(view.sum(-2)), 0)
        else:
            low = torch.where(some, torch.where(usable, view, torch.inf).amin(-2), 0)
            high = torch.where(some, torch.where(usable, view, -torch.inf).amax(-2), 0)
        centres.append((low + high) / 2)
        halves.append(((high - low) / 2).amax(-1))
    size = halves[0]
    for half in halves[1:]:
        size = torch.maximum(size, half)
    scale = torch.where(torch.isfinite(size) & (size > 0), 1 / size, 1)
    s = scale[..., None, None]
    similarities = []
    for centre in centres:
        T = torch.zeros(*scale.shape, 3, 3, dtype=scale.dtype, device=scale.device)
        T[..., 0, 0] = T[..., 1, 1] = scale
        T[..., :2, 2] = -scale[..., None] * centre
        T[..., 2, 2] = 1
        similarities.append(T)
    return [(view - centre[..., None, :]) * s for view, centre in zip(x, centres, strict=True)], similarities, scale


def largest_positive(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix or its negative, so that its entry of largest modulus is positive: one sign for one homogeneous matrix."""
    entries = M.flatten(-2)
    first = entries.detach().abs().argmax(-1, keepdim=True)
    return torch.where((entries.gather(-1, first) < 0)[..., None], -M, M)
