"""Sampson's distance to an epipolar geometry and its Gauss-Newton equations, for points in a plane and for rays on a sphere.

With the residual e = h2' F h1 and its gradient g over the tangents of both points, the distance is e / |g| (Sampson 1982;
Luong & Faugeras 1996). Residual and gradient are linear in the products h2_i h1_j of a datum, so one matrix product gives them
for all models and data. The derivative of e^2 / (2 |g|^2) with respect to F is written out; J' W J is the sum of
(h2 (x) h1) (h2 (x) h1)' / |g|^2, which it is at the points corrected to first order, up to the noise.
"""

from collections.abc import Sequence
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

_TINY = 1e-30


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
    t0, t1, t2 = t[..., None].unbind(-2)
    a0, a1, a2 = A.unbind(-2)
    return torch.stack((t1 * a2 - t2 * a1, t2 * a0 - t0 * a2, t0 * a1 - t1 * a0), -2)


@cache
def _arrangement(kind: str, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The constant matrix from the numbers of a model to the coefficients of its rows over the products of a datum.

    Products are h2_i h1_j at 3 i + j; for rays followed by h1 and h2. Rows are the residual, then its gradients over the second
    and the first point: F h1 and F' h2, of which the plane has two coordinates. After them come the rows that tell the sides.
    """
    sphere = kind == "sphere"
    products, free = (15, 3) if sphere else (9, 2)
    entries = [(0, 3 * i + j, 3 * i + j) for i in range(3) for j in range(3)]
    for k in range(free):
        entries += [(1 + k, (9 if sphere else 6) + j, 3 * k + j) for j in range(3)]
        entries += [(1 + free + k, 12 + i if sphere else 3 * i + 2, 3 * i + k) for i in range(3)]
    rows = 1 + 2 * free
    # One more bilinear form; for rays also a linear one in each of h2 and h1.
    entries += [(rows, i, 9 + i) for i in range(9)]
    if sphere:
        entries += [(rows + 1, 12 + i, 18 + i) for i in range(3)] + [(rows + 2, 9 + i, 21 + i) for i in range(3)]
    table = torch.zeros(rows + (3 if sphere else 1), products, 24 if sphere else 18, dtype=dtype)
    for row, product, number in entries:
        table[row, product, number] = 1
    return table.flatten(0, 1).mT.to(device).contiguous()


def products(h1: Sequence[Tensor], h2: Sequence[Tensor], sphere: bool) -> Float[Tensor, "*batch q n"]:
    """The products h2_i h1_j of all data, for rays followed by their coordinates."""
    first, second = torch.stack(list(h1), -2), torch.stack(list(h2), -2)
    z = (second[..., :, None, :] * first[..., None, :, :]).flatten(-3, -2)
    return torch.cat((z, first, second), -2) if sphere else z


def apply_rows(B: Float[Tensor, "*#batch r q"], z: Float[Tensor, "*#batch q n"]) -> Float[Tensor, "*batch r n"]:
    """B z, as one product for several models of the same data."""
    if B.ndim == z.ndim and z.ndim > 2 and z.shape[-3] == 1 and B.shape[-3] > 1:
        merged: Tensor = B.flatten(-3, -2) @ z[..., 0, :, :]
        return merged.reshape(*B.shape[:-1], z.shape[-1])
    return B @ z


def epipolar_rows(
    F: Float[Tensor, "*#batch 3 3"], *others: Tensor, z: Float[Tensor, "*#batch q n"], sphere: bool
) -> Float[Tensor, "*batch r n"]:
    """The residual h2' F h1, its gradients, and the values of the other forms (3 x 3; for rays also over h2 and over h1)."""
    numbers = torch.cat([F.flatten(-2), others[0].flatten(-2), *others[1:]], -1)
    table = _arrangement("sphere" if sphere else "plane", F.dtype, F.device)
    return apply_rows((numbers @ table).reshape(*numbers.shape[:-1], table.shape[-1] // z.shape[-2], z.shape[-2]), z)


def squared_from_rows(rows: Float[Tensor, "*batch r n"], sphere: bool) -> tuple[Tensor, Tensor]:
    """The squared distance of points, or of rays of unit length on the sphere, and the squared length of the gradient."""
    e, gradient = rows[..., 0, :], rows[..., 1 : 7 if sphere else 5, :]
    square, size = e * e, (gradient * gradient).sum(-2)
    if sphere:
        # The gradients over the tangents of unit rays: those in space without their part along the rays.
        size = size - 2 * square
    size = size.clamp(min=_TINY)
    return square / size, size


def normal_equations(
    F: Float[Tensor, "*#batch 3 3"],
    h1: Sequence[Tensor],
    h2: Sequence[Tensor],
    weights: Float[Tensor, "*#batch n"],
    sphere: bool,
) -> tuple[Float[Tensor, "*batch 9 9"], Float[Tensor, "*batch 9"]]:
    """J' W J and J' W r of the distance with respect to the nine entries of F, in float64.

    The right side is exact; in the matrix the measured points stand for the corrected ones.
    """
    z = products(h1, h2, sphere)
    free = 3 if sphere else 2
    numbers = F.flatten(-2)
    table = _arrangement("sphere" if sphere else "plane", F.dtype, F.device)[:9, : (1 + 2 * free) * z.shape[-2]]
    rows = apply_rows((numbers @ table).reshape(*numbers.shape[:-1], table.shape[-1] // z.shape[-2], z.shape[-2]), z)
    squared, size = squared_from_rows(rows, sphere)
    scale = weights / size
    # The derivative of e^2 / (2 |g|^2): e de / |g|^2 - e^2 / |g|^4 d|g|^2 / 2.
    share = scale * squared
    slope = scale * rows[..., 0, :]
    if sphere:
        slope = slope + 2 * share * rows[..., 0, :]
    coefficients = torch.cat((slope[..., None, :], -share[..., None, :] * rows[..., 1:, :]), -2)
    b = sums_of_products(coefficients, z).flatten(-2) @ table.mT
    bilinear_part = z[..., :9, :]
    A = sums_of_products(scale[..., None, :] * bilinear_part, bilinear_part)
    return A.double(), b.double()


def sums_of_products(a: Tensor, z: Tensor) -> Tensor:
    """The sums over the data a z', as one product for several models of the same data."""
    if a.ndim == z.ndim and z.ndim > 2 and z.shape[-3] == 1 and a.shape[-3] > 1:
        merged: Tensor = a.flatten(-3, -2) @ z[..., 0, :, :].mT
        return merged.reshape(*a.shape[:-1], z.shape[-2])
    return a @ z.mT


def matrices(entries: Float[Tensor, "*batch nn"], n: int) -> Float[Tensor, "*batch n n"]:
    """Square matrices from their entries, row by row."""
    return entries.reshape(*entries.shape[:-1], n, n)


def cofactors(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of cofactors: the gradient of the determinant. Its rows are cross products of rows."""
    C: Tensor = torch.linalg.cross(F.roll(-1, -2), F.roll(-2, -2))
    return C
