"""Four points or more in two affine images: F with only its last row and column (Hartley & Zisserman 2004, 14.2-14.3).

The joint points (x2, y2, x1, y1) of affine cameras lie in a hyperplane of 4-space. Through four points it is their 4D cross
product; to more it is fitted by total least squares, which is the maximum-likelihood estimate: the gold standard of 14.3.1.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.linalg import eigvalsh, null_vector, usable
from torchsfm.linalg.rows import combine_rows
from torchsfm.motion.two_views.sample_rows import in_chunks, rows_of
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 4096
"""Problems at a time: their numbers fit the cache."""
_FLAT = 1e-12
"""Relative size of a determinant, or squared of a singular value, that is zero."""


def equations(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]
) -> Float[Tensor, "*batch 9"]:
    """The nine equations of the entries of F: x2' F x1 = 0 for four points, four zeros, and |F|^2 = 1."""
    epipolar = (x1 * F[..., None, 2, :2]).sum(-1) + (x2 * F[..., None, :2, 2]).sum(-1) + F[..., 2, 2, None]
    zeros = F[..., :2, :2].flatten(-2)
    gauge = (F * F).sum((-2, -1))[..., None] - 1
    return torch.cat([p.expand(*epipolar.shape[:-1], p.shape[-1]) for p in (epipolar, zeros, gauge)], -1)


def fundamental_affine_4pt(
    x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"], *, weights: Float[Tensor, "*#batch n"] | None = None
) -> Solutions[Float[Tensor, "*batch 1 3 3"]]:
    """The affine fundamental matrix [0 0 a; 0 0 b; c d e], |F| = 1, of two images by affine cameras.

    It minimises the sum over points of the squared distance to the nearest exact pair, in both images together.

    Args:
        x1: At least four points in the first image, in any unit.
        x2: The corresponding points in the second image, in the same unit.
        weights: Weight of each squared distance, >= 0; 0 means absent. None: all 1.

    Returns:
        One slot. Not valid where the points do not determine F (coplanar points, coinciding points, fewer than four of weight,
        the same view twice), or where a coordinate or weight that counts is not finite. Computed in float64 whatever the dtype.
        Differentiable in all arguments.

    Raises:
        ValueError: Wrong shape, dtype or device, or n < 4.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(4, generator=g), torchsfm.random_poses(2, generator=g)
        >>> x1, x2 = (X @ poses.R.mT)[..., :2]  # two views from far away
        >>> F = torchsfm.motion.fundamental_affine_4pt(x1, x2)
        >>> F.valid, bool(torchsfm.geometry.sampson_distance(F.model, x1, x2).max() < 1e-6)
        (tensor([True]), True)
    """
    batch = check_tensors(x1=(x1, "n>=4 2"), x2=(x2, "n 2"), weights=(weights, "?n"))
    if x1.shape[-2] == 4 and weights is None:
        with torch.no_grad():
            rows, good = in_chunks(_solve, _CHUNK, *rows_of(batch, x1, x2))
            F, valid = rows.mT.to(x1.dtype).reshape(*batch, 1, 3, 3), good.reshape(*batch, 1)
        if wants_derivative(x1, x2):
            F = attach_implicit(equations, F, for_slots(x1, batch), for_slots(x2, batch), dims=2, valid=valid)
        return Solutions(F, valid)
    normal, offset, valid = _fit(x1, x2, weights)
    zero = torch.zeros_like(offset)
    a, b, c, d = normal.unbind(-1)
    F = torch.stack((zero, zero, a, zero, zero, b, c, d, offset), -1)
    F = F / (F * F).sum(-1, keepdim=True).sqrt()
    return Solutions(F.reshape(*F.shape[:-1], 1, 3, 3).to(x1.dtype), valid[..., None])


def _solve(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    """F as (9, batch) and valid as (batch)."""
    z = torch.cat((x2, x1), 1)
    centre, y = z[3], z[:3] - z[3]
    size = y.abs().amax((0, 1))
    fine = usable(z).all(0).all(0) & (size > 0)
    (p0, p1, p2, p3), (q0, q1, q2, q3), (r0, r1, r2, r3) = (row.unbind(0) for row in y / torch.where(fine, size, 1))
    m01, m02, m03 = p0 * q1 - p1 * q0, p0 * q2 - p2 * q0, p0 * q3 - p3 * q0
    m12, m13, m23 = p1 * q2 - p2 * q1, p1 * q3 - p3 * q1, p2 * q3 - p3 * q2
    a, b = m12 * r3 - m13 * r2 + m23 * r1, m03 * r2 - m02 * r3 - m23 * r0
    c, d = m01 * r3 - m03 * r1 + m13 * r0, m02 * r1 - m01 * r2 - m12 * r0
    n = torch.stack((a, b, c, d))
    square = combine_rows(n, n)
    valid = fine & (square > _FLAT**2)
    n = n * torch.where(valid, square, 1).rsqrt()
    e = -combine_rows(centre, n)
    zero = torch.zeros_like(e)
    F = torch.stack((zero, zero, n[0], zero, zero, n[1], n[2], n[3], e))
    largest = F.abs().amax(0)
    F = F / torch.where(valid & (largest > 0), largest, 1)
    F = F * combine_rows(F, F).rsqrt()
    valid = valid & torch.isfinite(F).all(0)
    return torch.where(valid, F, _empty(F)[:, None]), valid


def _empty(like: Tensor) -> Tensor:
    """What an empty slot holds."""
    return torch.tensor([0.0, 0, 1, 0, 0, 0, 1, 0, 0], dtype=like.dtype, device=like.device) / 2**0.5


def _fit(x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The normal and offset of the hyperplane nearest to the joint points, and which elements determine one."""
    w = torch.ones_like(x1[..., 0]) if weights is None else weights
    shape = broadcast_shapes(x1.shape[:-1], x2.shape[:-1], w.shape)
    w = w.double().expand(shape)
    z = torch.cat((x2.double().expand(*shape, 2), x1.double().expand(*shape, 2)), -1)
    absent = w == 0
    fine = (usable(z).all(-1) & usable(w) & (w >= 0) | absent).all(-1)
    keep = fine[..., None] & ~absent
    w, z = torch.where(keep, w, 0), torch.where(keep[..., None], z, 0)
    total = w.sum(-1, keepdim=True)
    share = w / torch.where(total > 0, total, 1)
    centre = (share[..., None] * z).sum(-2, keepdim=True)
    y = torch.where(keep[..., None], z - centre, 0)
    size = y.detach().abs().amax((-2, -1), keepdim=True)
    y = y / torch.where(size > 0, size, 1)
    A = torch.where(keep, torch.where(keep, share, 1).sqrt(), 0)[..., None] * y
    # The plane through the points is determined where only one direction is without extent.
    values, _ = eigvalsh((A.mT @ A).detach())
    valid = fine & (values[..., 1] > _FLAT * values[..., 3]) & (values[..., 3] > 0)
    blank = torch.eye(4, dtype=A.dtype, device=A.device)[:3]
    padded = torch.nn.functional.pad(blank, (0, 0, 0, A.shape[-2] - 3))
    normal, _ = null_vector(torch.where(valid[..., None, None], A, padded))
    offset = -(centre[..., 0, :] * normal).sum(-1)
    empty = torch.tensor([1.0, 0, 1, 0], dtype=A.dtype, device=A.device)
    return torch.where(valid[..., None], normal, empty), torch.where(valid, offset, 0), valid
