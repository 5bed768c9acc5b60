"""Seven points in two uncalibrated images: F with x2' F x1 = 0 and det F = 0 (Hartley & Zisserman 2004, 11.1.2).

The seven linear equations leave a G0 + b G1, and the determinant is a cubic form in (a, b). All arithmetic has the batch in the
last dimension.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import determinant_3x3
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.linalg.polynomial import cubic_rows
from torchsfm.linalg.rows import combine_rows
from torchsfm.optim import attach_implicit, wants_derivative

_CHUNK = 2048
"""Problems at a time: their matrices fit the cache."""
_INDEPENDENT = 1e-12
"""Smallest pivot of the normalised equations, and largest coefficient of the cubic, that are not taken for zero."""


def equations(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
) -> Float[Tensor, "*batch 9"]:
    """The nine equations of the nine entries of F: x2' F x1 = 0 for each point, det F = 0 and |F| = 1."""
    line = x1 @ F[..., :2].mT + F[..., None, :, 2]
    epipolar = (x2 * line[..., :2]).sum(-1) + line[..., 2]
    gauge = (F * F).sum((-2, -1)) - 1
    rest = torch.stack((determinant_3x3(F), gauge), -1)
    return torch.cat((epipolar, rest.expand(*epipolar.shape[:-1], 2)), -1)


def fundamental_7pt(
    x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
) -> Solutions[Float[Tensor, "*batch 3 3 3"]]:
    """The one or three F with x2' F x1 = 0 for seven points and det F = 0, with |F| = 1 (Frobenius).

    Args:
        x1: Seven points in the first image, in any unit.
        x2: The corresponding points in the second image.

    Returns:
        Three slots. None is valid where the points do not determine F (coinciding points, six or more points in a plane, a pure
        rotation) or a coordinate is not finite. Computed in float64 whatever the dtype. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    batch = check_tensors(x1=(x1, "7 2"), x2=(x2, "7 2"))
    with torch.no_grad():
        rows1, rows2 = (x.detach().double().expand(*batch, 7, 2).reshape(-1, 7, 2).permute(1, 2, 0) for x in (x1, x2))
        starts = range(0, max(rows1.shape[-1], 1), _CHUNK)
        chunks = [_solve(rows1[..., i : i + _CHUNK], rows2[..., i : i + _CHUNK]) for i in starts]
        rows, good = (torch.cat(parts, -1) for parts in zip(*chunks, strict=True))
        F = rows.permute(2, 1, 0).reshape(*batch, 3, 3, 3).to(x1.dtype)
        valid = good.mT.reshape(*batch, 3)
    if wants_derivative(x1, x2):
        F = attach_implicit(equations, F, x1[..., None, :, :], x2[..., None, :, :], dims=2, valid=valid)
    return Solutions(F, valid)


def _solve(x1: Float[Tensor, "7 2 batch"], x2: Float[Tensor, "7 2 batch"]) -> tuple[Tensor, Tensor]:
    """F as (9, 3, batch) and valid as (3, batch)."""
    h1, c1, s1, fine1 = _normalised(x1)
    h2, c2, s2, fine2 = _normalised(x2)
    basis, pivot = nullspace_rows((h2[:, :, None] * h1[:, None]).flatten(1, 2))
    G = basis.view(2, 3, 3, -1)
    r0, r1, r2 = G.unbind(1)
    cofactors = torch.stack((_cross(r1, r2), _cross(r2, r0), _cross(r0, r1)), 1)
    # det(a G0 + b G1): the coefficients of b^3, a b^2, a^2 b, a^3.
    d0, d3 = combine_rows(cofactors[1, 0], G[1, 0]), combine_rows(cofactors[0, 0], G[0, 0])
    d1, d2 = combine_rows(cofactors[1].flatten(0, 1), basis[0]), combine_rows(cofactors[0].flatten(0, 1), basis[1])
    some = torch.stack((d0, d1, d2, d3)).abs().amax(0)
    # The larger of the outer coefficients leads.
    turn = d0.abs() > d3.abs()
    roots, real = cubic_rows(
        torch.where(turn, d3, d0), torch.where(turn, d2, d1), torch.where(turn, d1, d2), torch.where(turn, d0, d3)
    )
    one = torch.ones_like(roots)
    F = torch.where(turn, one, roots) * basis[0, :, None] + torch.where(turn, roots, one) * basis[1, :, None]
    # Back to the coordinates that came: T2' F T1 with the similarities T = [s I, -s c].
    F = F.view(3, 3, 3, -1)
    last = F[:, 2] - s1 * (c1[0] * F[:, 0] + c1[1] * F[:, 1])
    F = torch.stack((s1 * F[:, 0], s1 * F[:, 1], last), 1)
    last = F[2] - s2 * (c2[0] * F[0] + c2[1] * F[1])
    F = torch.cat((s2 * F[0], s2 * F[1], last))
    F = F * combine_rows(F, F).rsqrt()
    valid = real & (fine1 & fine2 & (torch.minimum(pivot, some) > _INDEPENDENT)) & torch.isfinite(F).all(0)
    # An empty slot holds diag(1, 1, 0).
    empty = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0], dtype=F.dtype, device=F.device)[:, None, None] / 2**0.5
    return torch.where(valid, F, empty), valid


def _normalised(x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Homogeneous points (7, 3, batch) with |u|, |v| <= 1; centre, scale, and which elements are finite and not a point."""
    low, high = x.amin(0), x.amax(0)
    centre, size = 0.5 * (low + high), 0.5 * (high - low).amax(0)
    fine = torch.isfinite(size) & (size > 0)
    scale = 1 / torch.where(fine, size, 1)
    h = torch.ones(7, 3, x.shape[-1], dtype=x.dtype, device=x.device)
    h[:, :2] = torch.where(fine, (x - centre) * scale, 0)
    return h, centre, scale, fine


def _cross(a: Float[Tensor, "k 3 batch"], b: Float[Tensor, "k 3 batch"]) -> Float[Tensor, "k 3 batch"]:
    a0, a1, a2 = a.unbind(1)
    b0, b1, b2 = b.unbind(1)
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), 1)
