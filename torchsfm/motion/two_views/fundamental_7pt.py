"""Seven points in two uncalibrated images: F with x2' F x1 = 0 and det F = 0 (Hartley & Zisserman 2004, 11.1.2).

The seven linear equations leave s G + t H, and the determinant is a cubic form in (s, t). All arithmetic has the batch in the
last dimension.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import determinant_3x3
from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.nullspace import nullspace_columns
from torchsfm.linalg.polynomial import cubic_rows
from torchsfm.linalg.rows import combine_rows
from torchsfm.linalg.vectors import fms
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

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

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(7, generator=g), torchsfm.random_poses(2, generator=g).matrix()
        >>> x1, x2 = torchsfm.project_points(P, X)
        >>> F = torchsfm.motion.fundamental_7pt(x1, x2)
        >>> residual = torchsfm.geometry.sampson_distance(F.model[F.valid], x1, x2)
        >>> F.model.shape, bool(residual.max() < 1e-6)
        (torch.Size([3, 3, 3]), True)
    """
    batch = check_tensors(x1=(x1, "7 2"), x2=(x2, "7 2"))
    with torch.no_grad():
        rows, good = solve(batch_last(x1, batch), batch_last(x2, batch))
        F = rows.permute(2, 1, 0).reshape(*batch, 3, 3, 3).to(x1.dtype)
        valid = good.mT.reshape(*batch, 3)
    if wants_derivative(x1, x2):
        F = attach_implicit(equations, F, for_slots(x1, batch), for_slots(x2, batch), dims=2, valid=valid)
    return Solutions(F, valid)


def batch_last(x: Float[Tensor, "*#batch 7 2"], batch: tuple[int, ...]) -> Float[Tensor, "2 7 n"]:
    """Points as (coordinate, point, problem), in float64."""
    x = x.detach().expand(*batch, 7, 2)
    return x.permute(-1, -2, *range(len(batch))).reshape(2, 7, -1).double()


@kernel(chunk=8192)
def solve(x1: Float[Tensor, "2 7 batch"], x2: Float[Tensor, "2 7 batch"]) -> tuple[Tensor, Tensor]:
    """F as (9, 3, batch) and valid as (3, batch)."""
    # The points with the first one at the origin and the largest coordinate 1, in both images.
    x = torch.stack((x1, x2))
    c1, c2 = centre = x[:, :, 0]
    moved = x[:, :, 1:] - centre[:, :, None]
    s1, s2 = extent = moved.abs().amax((1, 2))
    (u, v), (a, b) = moved * extent.reciprocal()[:, None, None]
    # The first point says that F33 = 0: six equations in eight entries are left.
    N, pivot = nullspace_columns(torch.stack((a * u, a * v, a, b * u, b * v, b, u, v)))
    # Each row for G and for H.
    swapped = N.flip(1)
    n, crossed = N.unbind(0), swapped.unbind(0)
    C = _cofactors(n)
    # det(G + t H): the coefficients of 1 and t^3, and of t and t^2.
    outer, inner = combine_rows(C[6:], n[6:]), combine_rows(C, crossed)
    cubic = torch.cat((outer[:1], inner, outer[1:]))
    size = cubic.abs()
    # The larger of the outer coefficients leads: where that is the first one, G and H change places.
    turn = size[0] > size[3]
    roots, real = cubic_rows(*torch.where(turn, cubic.flip(0), cubic).unbind(0))
    G, H = torch.split(torch.where(turn, swapped, N), 1, 1)
    F = N.new_zeros(9, *roots.shape)
    torch.addcmul(G, H, roots, out=F[:8])
    # Back to the coordinates that came: T2' F T1 with T = [I, -c] / size, up to scale; by columns, then by rows.
    rows = F.view(3, 3, *roots.shape)
    first, second, third = rows.unbind(1)
    third.mul_(s1)
    rows[2].mul_(s2)
    third.addcmul_(c1[0], first, value=-1).addcmul_(c1[1], second, value=-1)
    first, second, third = rows
    third.addcmul_(c2[0], first, value=-1).addcmul_(c2[1], second, value=-1)
    entries = F.unbind(0)
    square = combine_rows(entries, entries)
    # False for NaN; an empty slot holds diag(1, 1, 0).
    valid = real & (torch.minimum(pivot, size.amax(0)) > _INDEPENDENT) & (square > 0) & (square < torch.inf)
    empty = ~valid
    F.mul_(square.rsqrt().masked_fill(empty, 0.0)).nan_to_num_(0.0, 0.0, 0.0)
    F[0:5:4].add_(empty, alpha=0.5**0.5)
    return F, valid


def _cofactors(f: Sequence[Tensor]) -> list[Tensor]:
    """Of a matrix whose last entry is 0, without the last one."""
    f0, f1, f2, f3, f4, f5, f6, f7 = f
    first, second = (-(f5 * f7), f5 * f6, fms(f4, f6, f3 * f7)), (f2 * f7, -(f2 * f6), fms(f0, f7, f1 * f6))
    return [*first, *second, fms(f2, f4, f1 * f5), fms(f0, f5, f2 * f3)]
