"""Minors of stacked cameras: the pieces of which all multilinear tensors are made (Laplace expansion of 4x4 determinants)."""

import torch
from jaxtyping import Float
from torch import Tensor

_FIRST, _SECOND = [0, 0, 0, 1, 1, 2], [1, 2, 3, 2, 3, 3]
LAPLACE_SIGNS = (1.0, -1.0, 1.0, 1.0, -1.0, 1.0)
"""det(r1, r2, r3, r4) is the sum of signs times wedge(r1, r2) times the flipped wedge(r3, r4)."""


def wedge(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 6"]:
    """The 2x2 minors of pairs of rows, columns in the order 01 02 03 12 13 23."""
    return a[..., _FIRST] * b[..., _SECOND] - a[..., _SECOND] * b[..., _FIRST]


def split_last(x: Float[Tensor, "*batch m"], *sizes: int) -> Tensor:
    """The last dimension as several, the last of them counting fastest."""
    return x.reshape(*x.shape[:-1], *sizes)


def cyclic_pairs(P: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 3 6"]:
    """For each row of a camera the minors of the two rows that follow it cyclically."""
    return wedge(P[..., [1, 2, 0], :], P[..., [2, 0, 1], :])


def dual_matrix(minors: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The antisymmetric L with det(a, b, c, d) = c' L d, from wedge(a, b)."""
    w01, w02, w03, w12, w13, w23 = minors.unbind(-1)
    zero = torch.zeros_like(w01)
    rows = (zero, w23, -w13, w12, -w23, zero, w03, -w02, w13, -w03, zero, w01, -w12, w02, -w01, zero)
    return split_last(torch.stack(rows, -1), 4, 4)
