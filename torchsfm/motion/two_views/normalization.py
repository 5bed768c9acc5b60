"""Bringing two images to a common moderate scale, so that a threshold stays a threshold."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.robust.moderation import middle_and_size, moved_and_scaled, present


class CommonScale(NamedTuple):
    """Points centred in each image, both divided by the same number.

    Attributes:
        x1: Points of the first image, most of them not far from the unit square; NaN where they are absurdly far.
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
    """Centre both images' points, and divide by the larger of their sizes: medians, which wrong points do not move far.

    What is then absurdly far is NaN: it agrees with nothing, and would cost the others their precision.
    """
    (y1, y2), (T1, T2), scale = common_scale_of_views((x1, x2), mask)
    return CommonScale(y1, y2, T1, T2, scale)


def common_scale_of_views(
    x: Sequence[Float[Tensor, "*#batch n 2"]], mask: Bool[Tensor, "*#batch n"] | None
) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """The same for any number of images: the points, the similarities, the common factor."""
    batch = broadcast_shapes(*(view.shape[:-2] for view in x), () if mask is None else mask.shape[:-1])
    n = x[0].shape[-2]
    views = torch.stack([view.expand(*batch, n, 2) for view in x])
    # The similarity is held when the points move.
    fixed = views.detach()
    centre, sizes = middle_and_size(fixed, present(mask, *fixed))
    size = sizes.amax(0)
    scale = size.reciprocal()
    similarities = torch.nn.functional.pad(-centre[..., None], (2, 0, 0, 1))
    similarities.diagonal(dim1=-2, dim2=-1).add_(1)
    similarities[..., :2, :].mul_(scale[..., None, None])
    points = list(moved_and_scaled(views, centre, size))
    return points, list(similarities), scale


def largest_positive(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix or its negative, so that its entry of largest modulus is positive: one sign for one homogeneous matrix."""
    entries = M.flatten(-2)
    first = entries.detach().abs().argmax(-1, keepdim=True)
    return torch.where((entries.gather(-1, first) < 0)[..., None], -M, M)
