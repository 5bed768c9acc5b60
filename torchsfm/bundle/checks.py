"""Checks that the doors of bundle adjustment share."""

from torch import Tensor


def check_index(**indices: tuple[Tensor, int]) -> None:
    """See that index tensors, each given with its limit, point at something.

    Raises:
        ValueError: A number is negative or not below its limit.
    """
    for name, (index, limit) in indices.items():
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < limit:
            raise ValueError(f"{name}: wanted numbers from 0 to {limit - 1}, got {int(index.min())} to {int(index.max())}")
