"""Sampson's distance to an epipolar geometry and its Gauss-Newton equations, for points in a plane and for rays on a sphere.

With the residual e = h2' F h1 and its gradient g over the tangents of both points, the distance is e / |g| (Sampson 1982;
Luong & Faugeras 1996). Its derivative with respect to F is, up to second order in the distance, that of e alone at the points
corrected to first order, divided by |g|: h2 (x) h1 / |g|. So the normal matrix is the sum of (h2 h2') (x) (h1 h1') / |g|^2,
made of 6 x 6 sums. Everything is written in rows: one tensor for each coordinate of all points.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

# Products of two coordinates in the order xx, yy, zz, xy, xz, yz.
_PAIR = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
# Where entry ((i, j), (k, l)) of a sum of Kronecker products (a a') (x) (b b') is among the 6 x 6 products of a and of b.
_KRONECKER = [6 * _PAIR[i][k] + _PAIR[j][m] for i in range(3) for j in range(3) for k in range(3) for m in range(3)]
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


def squared_distance(
    F: Float[Tensor, "*#batch 3 3"], h1: Sequence[Tensor], h2: Sequence[Tensor], sphere: bool
) -> Float[Tensor, "*batch n"]:
    """The squared distance: of points, or of rays of unit length on the sphere."""
    e, _, _, size = _by_points(F, h1, h2, sphere)
    return e * e / size.clamp(min=_TINY)


def _by_points(
    F: Tensor, h1: Sequence[Tensor], h2: Sequence[Tensor], sphere: bool
) -> tuple[Tensor, list[Tensor], list[Tensor], Tensor]:
    """The residual, its gradients over the tangents of the first and the second point, and their squared length."""
    l2 = forms(F, h1)
    e = h2[0] * l2[0] + h2[1] * l2[1] + h2[2] * l2[2]
    if sphere:
        l1 = forms(F.mT, h2)
        l1 = [a - e * b for a, b in zip(l1, h1, strict=True)]
        l2 = [a - e * b for a, b in zip(l2, h2, strict=True)]
    else:
        l1, l2 = forms(F.mT[..., :2, :], h2), l2[:2]
    size = l1[0] * l1[0]
    for row in (*l1[1:], *l2):
        size = size + row * row
    return e, l1, l2, size


def normal_equations(
    F: Float[Tensor, "*#batch 3 3"],
    h1: Sequence[Tensor],
    h2: Sequence[Tensor],
    weights: Float[Tensor, "*#batch n"],
    sphere: bool,
) -> tuple[Float[Tensor, "*batch 9 9"], Float[Tensor, "*batch 9"]]:
    """J' W J and J' W r of the distance with respect to the nine entries of F, in float64."""
    e, l1, l2, size = _by_points(F, h1, h2, sphere)
    scale = weights / size.clamp(min=_TINY)
    shift = e / size.clamp(min=_TINY)
    p1 = [a - shift * b for a, b in zip(h1, l1, strict=False)] + list(h1[len(l1) :])
    p2 = [a - shift * b for a, b in zip(h2, l2, strict=False)] + list(h2[len(l2) :])
    x, y, z = p1
    right = _stack([x * x, y * y, z * z, x * y, x * z, y * z])
    x, y, z = p2
    sx, sy, sz, se = scale * x, scale * y, scale * z, scale * e
    left = _stack([sx * x, sy * y, sz * z, sx * y, sx * z, sy * z])
    moments = (left @ right.mT).double().flatten(-2)
    A = matrices(moments.index_select(-1, torch.tensor(_KRONECKER, device=F.device)), 9)
    b = _stack([x * se, y * se, z * se]) @ _stack(p1).mT
    return A, b.double().flatten(-2)


def _stack(rows: Sequence[Tensor]) -> Tensor:
    shape = max((row.shape for row in rows), key=len)
    for row in rows:
        shape = shape if row.shape == shape else torch.Size(max(a, b) for a, b in zip(shape, row.shape, strict=True))
    return torch.stack([row.expand(shape) for row in rows], -2)


def matrices(entries: Float[Tensor, "*batch nn"], n: int) -> Float[Tensor, "*batch n n"]:
    """Square matrices from their entries, row by row."""
    return entries.reshape(*entries.shape[:-1], n, n)


def cofactors(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of cofactors: the gradient of the determinant. Its rows are cross products of rows."""
    C: Tensor = torch.linalg.cross(F.roll(-1, -2), F.roll(-2, -2))
    return C
