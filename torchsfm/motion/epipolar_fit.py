"""Sampson's distance to an epipolar geometry and its Gauss-Newton equations, for points in a plane and for rays on a sphere.

With the residual e = h2' F h1 and its gradient g over the tangents of both points, the distance is e / |g| (Sampson 1982; Luong &
Faugeras 1996). The derivative of e / |g| with respect to F is, up to terms of second order in the distance, that of e alone at the
points corrected to first order, divided by |g|: h2 (x) h1 / |g|. So the normal matrix is the sum of (h2 h2') (x) (h1 h1') / |g|^2,
made of 6 x 6 sums.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import cross_matrix
from torchsfm.linalg import adjugate_3x3

_I = [0, 1, 2, 0, 0, 1]
_J = [0, 1, 2, 1, 2, 2]
_PAIR = [[0, 3, 4], [3, 1, 5], [4, 5, 2]]


def plane_rows(x: Float[Tensor, "*batch n 2"]) -> Float[Tensor, "*batch 3 n"]:
    """Homogeneous points as columns."""
    x = x.mT
    return torch.cat((x, torch.ones_like(x[..., :1, :])), -2)


def sphere_rows(d: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3 n"]:
    """Rays of unit length as columns; a ray of length 0 stays 0."""
    d = d.mT
    norm = (d * d).sum(-2, keepdim=True)
    return d * torch.where(norm > 0, norm, 1).rsqrt()


def squares(h: Float[Tensor, "*batch 3 n"]) -> Float[Tensor, "*batch 6 n"]:
    """The distinct products of two coordinates, in the order of `_I`, `_J`."""
    return torch.cat((h * h, h[..., :1, :] * h[..., 1:, :], h[..., 1:2, :] * h[..., 2:, :]), -2)


def one_datum_set_for_many(model: Tensor, data: Tensor) -> bool:
    """Whether the last batch dimension counts several models of the same data: then matrix products do the work."""
    return model.ndim == data.ndim and model.ndim > 2 and data.shape[-3] == 1 and model.shape[-3] > 1


def squared_distance(
    F: Float[Tensor, "*#batch 3 3"], h1: Float[Tensor, "*#batch 3 n"], h2: Float[Tensor, "*#batch 3 n"], sphere: bool
) -> Float[Tensor, "*batch n"]:
    """The squared distance; infinite where F does not constrain the points (both at its epipoles)."""
    if one_datum_set_for_many(F, h1):
        e, size = _by_products(F, h1[..., 0, :, :], h2[..., 0, :, :], sphere)
    else:
        e, _, _, size = _by_points(F, h1, h2, sphere)
    squared = e * e / size
    return torch.where(size > 0, squared, torch.inf)


def _by_products(F: Tensor, h1: Tensor, h2: Tensor, sphere: bool) -> tuple[Tensor, Tensor]:
    e = F.flatten(-2) @ (h2[..., :, None, :] * h1[..., None, :, :]).flatten(-3, -2)
    top, left = (F, F) if sphere else (F[..., :2, :], F[..., :, :2])
    factor = torch.tensor([1.0, 1, 1, 2, 2, 2], dtype=F.dtype, device=F.device)
    first = (top[..., _I] * top[..., _J]).sum(-2) * factor
    second = (left[..., _I, :] * left[..., _J, :]).sum(-1) * factor
    size = torch.cat((first, second), -1) @ torch.cat((squares(h1), squares(h2)), -2)
    if sphere:
        size = size - 2 * e * e
    return e, size


def _by_points(F: Tensor, h1: Tensor, h2: Tensor, sphere: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The residual, its gradients over the tangents of the first and the second point, and their squared length."""
    l2 = F @ h1
    l1 = F.mT @ h2
    e = (h2 * l2).sum(-2)
    if sphere:
        l1, l2 = l1 - e[..., None, :] * h1, l2 - e[..., None, :] * h2
    else:
        l1, l2 = l1[..., :2, :], l2[..., :2, :]
    return e, l1, l2, (l1 * l1).sum(-2) + (l2 * l2).sum(-2)


def normal_equations(
    F: Float[Tensor, "*#batch 3 3"],
    h1: Float[Tensor, "*#batch 3 n"],
    h2: Float[Tensor, "*#batch 3 n"],
    weights: Float[Tensor, "*#batch n"],
    sphere: bool,
) -> tuple[Float[Tensor, "*batch 9 9"], Float[Tensor, "*batch 9"]]:
    """J' W J and J' W r of the distance with respect to the nine entries of F, in float64."""
    e, l1, l2, size = _by_points(F, h1, h2, sphere)
    good = (size > 0) & (weights > 0)
    inverse = torch.where(good, 1 / torch.where(good, size, 1), 0)
    shift = (e * inverse)[..., None, :]
    if sphere:
        p1, p2 = h1 - shift * l1, h2 - shift * l2
    else:
        p1 = torch.cat((h1[..., :2, :] - shift * l1, h1[..., 2:, :].expand_as(l1[..., :1, :])), -2)
        p2 = torch.cat((h2[..., :2, :] - shift * l2, h2[..., 2:, :].expand_as(l2[..., :1, :])), -2)
    scale = weights * inverse
    moments = ((squares(p2) * scale[..., None, :]) @ squares(p1).mT).double()
    A = moments[..., _PAIR, :][..., _PAIR]
    # (i, k, j, l) -> ((i, j), (k, l)).
    A = A.transpose(-3, -2).flatten(-2).flatten(-3, -2)
    b = ((p2 * (scale * e)[..., None, :]) @ p1.mT).double()
    return A, b.flatten(-2)


def left_epipole(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The left null vector of a rank-2 matrix, not normalised: the largest column of its cofactor matrix."""
    cofactors = adjugate_3x3(F).mT
    best = (cofactors * cofactors).sum(-2).argmax(-1)
    return cofactors.gather(-1, best[..., None, None].expand(*best.shape, 3, 1))[..., 0]


def oriented(
    F: Float[Tensor, "*#batch 3 3"], h1: Float[Tensor, "*#batch 3 m"], h2: Float[Tensor, "*#batch 3 m"]
) -> Bool[Tensor, "*batch"]:
    """Whether all points can be in front of both cameras: e2 x h2 ~ F h1 with one sign (Chum, Werner & Matas 2004)."""
    side = ((cross_matrix(left_epipole(F)) @ h2) * (F @ h1)).sum(-2)
    return (side >= 0).all(-1) | (side <= 0).all(-1)


def frame(e: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """An orthonormal basis as columns, the last of them along `e` (Duff et al. 2017)."""
    e = e / e.norm(dim=-1, keepdim=True)
    x, y, z = e.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(e.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    second = torch.stack((b, sign + y * y * a, -y), -1)
    return torch.stack((first, second, e), -1)


def damped_solve(A: Float[Tensor, "*batch k k"], b: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch k"]:
    """Solve a positive semidefinite system with the least damping that makes it definite; no step where that fails."""
    size = A.diagonal(dim1=-2, dim2=-1).mean(-1)
    eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    A = A + (1e-10 * size + 1e-300)[..., None, None] * eye
    factor, info = torch.linalg.cholesky_ex(A)
    good = (info == 0) & torch.isfinite(size)
    factor = torch.where(good[..., None, None], factor, eye)
    step = torch.cholesky_solve(b[..., None], factor)[..., 0]
    return torch.where(good[..., None] & torch.isfinite(step), step, 0)
