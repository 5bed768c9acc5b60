"""What size numbers may have: floating point goes to 1e308, and squares and products of them not nearly as far."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LARGEST = 1e60
"""Numbers from here on count as not finite: the fifth power is the last that exists."""


def usable(x: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
    """Which numbers are finite and of a size that products of several can be computed with.

    Args:
        x: Any numbers.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.usable(torch.tensor([1.0, torch.inf, torch.nan]))
        tensor([ True, False, False])
    """
    return x.detach().abs() < LARGEST


def all_below(x: Float[Tensor, "*shape"], limit: float, dims: int) -> Bool[Tensor, "*batch"]:
    """Whether all numbers of the last dimensions are, in size: by the largest, in a fifth of the time of `all` over few."""
    if 0 in x.shape[x.ndim - dims :]:
        return torch.ones(x.shape[: x.ndim - dims], dtype=torch.bool, device=x.device)
    return x.detach().abs().amax(tuple(range(-dims, 0))) < limit


def unit_scale(A: Float[Tensor, "*batch m n"]) -> Float[Tensor, "*batch 1 1"]:
    """A power of two by which the largest number of a finite matrix, unless it is 0, comes to between 1/2 and 1.

    Args:
        A: Any matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.unit_scale(torch.tensor([[3.0, -12.0]]))  # 12 / 16 is 3 / 4
        tensor([[0.0625]])
    """
    if 0 in A.shape[-2:]:
        return A.new_ones(*A.shape[:-2], 1, 1)
    largest = A.detach().abs().amax((-2, -1), keepdim=True).clamp_min(torch.finfo(A.dtype).tiny)
    return torch.frexp(largest).mantissa / largest
