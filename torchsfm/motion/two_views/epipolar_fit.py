"""Linear and bilinear forms in points and rays, for epipolar geometry: h2' F h1 and what goes with it."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

_TINY = 1e-30
MIXTURE = (0.37, -0.61)
"""Shares of the third column: the left epipole would be lost where the right one is on 0.37 x - 0.61 y = 1, for all digits."""


def plane_rows(x: Float[Tensor, "*batch n 2"]) -> list[Tensor]:
    """The coordinates x, y, 1 of points."""
    return [x[..., 0], x[..., 1], torch.ones_like(x[..., 0])]


def sphere_rows(d: Float[Tensor, "*batch n 3"]) -> list[Tensor]:
    """The coordinates of rays of unit length."""
    x, y, z = d.unbind(-1)
    inverse = (x * x + y * y + z * z).clamp(min=_TINY).rsqrt()
    return [x * inverse, y * inverse, z * inverse]


def one_data_set_for_many(model: Tensor, row: Tensor) -> bool:
    """Whether the last batch dimension counts several models of the same data: then matrix products do the work."""
    return model.ndim == row.ndim + 1 and row.ndim > 1 and row.shape[-2] == 1 and model.shape[-3] > 1


def forms(A: Float[Tensor, "*#batch r 3"], h: Sequence[Tensor]) -> list[Tensor]:
    """The linear forms a'h of some points, one for each row a of A."""
    if one_data_set_for_many(A, h[0]):
        models, r = A.shape[-3], A.shape[-2]
        product = A.reshape(*A.shape[:-3], models * r, 3) @ torch.cat(list(h), -2)
        return list(product.reshape(*product.shape[:-2], models, r, product.shape[-1]).unbind(-2))
    columns = [[A[..., i, j, None] for j in range(3)] for i in range(A.shape[-2])]
    return [a * h[0] + b * h[1] + c * h[2] for a, b, c in columns]


def bilinear(A: Float[Tensor, "*#batch 3 3"], h1: Sequence[Tensor], h2: Sequence[Tensor]) -> Float[Tensor, "*batch n"]:
    """h2' A h1."""
    if one_data_set_for_many(A, h1[0]):
        return A.flatten(-2) @ torch.cat([b * a for b in h2 for a in h1], -2)
    x, y, z = forms(A, h1)
    return x * h2[0] + y * h2[1] + z * h2[2]


def cross_rows(t: Float[Tensor, "*#batch 3"], A: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """[t]x A."""
    product: Tensor = torch.linalg.cross(t[..., None], A, dim=-2)
    return product


def product(A: Float[Tensor, "*#batch r q"], B: Float[Tensor, "*#batch q c"]) -> Float[Tensor, "*batch r c"]:
    """A B, without the shapes that broadcasting needs where there is nothing to broadcast."""
    if A.shape[:-2] != B.shape[:-2] or A.ndim < 3:
        return A @ B
    if A.ndim == 3:
        return torch.bmm(A, B)
    return torch.bmm(A.flatten(0, -3), B.flatten(0, -3)).view(*A.shape[:-1], B.shape[-1])


def apply_rows(B: Float[Tensor, "*#batch r q"], z: Float[Tensor, "*#batch q n"]) -> Float[Tensor, "*batch r n"]:
    """B z, as one product for several models of the same data."""
    if B.ndim == z.ndim and z.ndim > 2 and z.shape[-3] == 1 and B.shape[-3] > 1:
        merged = product(B.flatten(-3, -2), z[..., 0, :, :])
        return merged.reshape(*B.shape[:-1], z.shape[-1])
    return product(B, z)


def sums_of_products(a: Tensor, z: Tensor) -> Tensor:
    """The sums over the data a z', as one product for several models of the same data."""
    if a.ndim == z.ndim and z.ndim > 2 and z.shape[-3] == 1 and a.shape[-3] > 1:
        merged = product(a.flatten(-3, -2), z[..., 0, :, :].mT)
        return merged.reshape(*a.shape[:-1], z.shape[-2])
    return product(a, z.mT)


def matrices(entries: Float[Tensor, "*batch nn"], n: int) -> Float[Tensor, "*batch n n"]:
    """Square matrices from their entries, row by row."""
    return entries.reshape(*entries.shape[:-1], n, n)


def cofactors(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of cofactors: the gradient of the determinant. Its rows are cross products of rows."""
    C: Tensor = torch.linalg.cross(F.roll(-1, -2), F.roll(-2, -2))
    return C


def with_left_epipole(F: Float[Tensor, "*#batch 3 3"], e: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 4"]:
    """F and its left null vector, of norm 1 and on the side of a given one.

    It is across all columns: across two mixtures of them, so that no choice between pairs of columns is needed.
    """
    first, second, third = F.unbind(-1)
    across = torch.linalg.cross(torch.add(first, third, alpha=MIXTURE[0]), torch.add(second, third, alpha=MIXTURE[1]))
    length = torch.linalg.vector_norm(across, dim=-1, keepdim=True).clamp(min=1e-100)
    turned = across / torch.copysign(length, (across * e).sum(-1, keepdim=True))
    return torch.stack((first, second, third, turned), -1)
