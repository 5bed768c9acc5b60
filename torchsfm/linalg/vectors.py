"""Three-vectors of rows: small formulas for thousands of problems, in as few passes over memory as possible.

A vector is a tensor (3, ..., problem), stacked so that one operation serves all of its numbers.
"""

from collections.abc import Sequence

import torch
from torch import Tensor


def fma(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """`a b + c`."""
    return torch.addcmul(c, a, b)


def fms(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """`c - a b`."""
    return torch.addcmul(c, a, b, value=-1)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """`a'b`."""
    return (a * b).sum(0)


def cross(a: Tensor | Sequence[Tensor], b: Tensor | Sequence[Tensor]) -> Tensor:
    """`a x b`."""
    a0, a1, a2 = a
    b0, b1, b2 = b
    return torch.stack((fms(a2, b1, a1 * b2), fms(a0, b2, a2 * b0), fms(a1, b0, a0 * b1)))


def ahead(v: Tensor) -> tuple[Tensor, Tensor]:
    """`(v1, v2, v0)` and `(v2, v0, v1)`."""
    twice = torch.cat((v, v[:2]))
    return twice[1:4], twice[2:]


def matrix(rows: list[list[Tensor]]) -> Tensor:
    """Three vectors of numbers, (3, 3, ..., problem)."""
    return torch.stack([x for row in rows for x in row]).view(3, 3, *rows[0][0].shape)


def largest(keys: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The largest of three keys and the row of a matrix that belongs to it."""
    key, index = keys.max(0)
    return key, rows.gather(0, index.expand(1, *rows.shape[1:]))[0]


def across(u: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors orthogonal to a unit vector and to each other (Duff et al. 2017)."""
    x, y, z = u
    s = torch.copysign(torch.ones_like(z), z)
    a = -1 / (s + z)
    b = x * y * a
    return torch.stack((1 + s * x * x * a, s * b, -s * x)), torch.stack((b, s + y * y * a, -y))
