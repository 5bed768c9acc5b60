"""Seven points in two uncalibrated images: F with x2' F x1 = 0 and det F = 0 (Hartley & Zisserman 2004, 11.1.2).

The seven linear equations leave s G + t H, and the determinant is a cubic form in (s, t). All arithmetic has the batch in the
last dimension.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import determinant_3x3
from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.nullspace import nullspace_columns
from torchsfm.linalg.polynomial import cubic_rows
from torchsfm.linalg.rows import combine_rows
from torchsfm.linalg.vectors import fms
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_INDEPENDENT = {torch.float64: 1e-12, torch.float32: 1e-6}
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
        rows, good = solve(batch_last(x1.double(), batch), batch_last(x2.double(), batch))
        F = rows.permute(2, 1, 0).reshape(*batch, 3, 3, 3).to(x1.dtype)
        valid = good.mT.reshape(*batch, 3)
    if wants_derivative(x1, x2):
        F = attach_implicit(equations, F, for_slots(x1, batch), for_slots(x2, batch), dims=2, valid=valid)
    return Solutions(F, valid)


def batch_last(x: Float[Tensor, "*#batch 7 2"], batch: tuple[int, ...]) -> Float[Tensor, "2 7 n"]:
    """Points as (coordinate, point, problem)."""
    x = x.detach().expand(*batch, 7, 2)
    return x.permute(-1, -2, *range(len(batch))).reshape(2, 7, -1)


@kernel(chunk=8192)
def solve(x1: Float[Tensor, "2 7 batch"], x2: Float[Tensor, "2 7 batch"]) -> tuple[Tensor, Tensor]:
    """F as (9, 3, batch) and valid as (3, batch)."""
    some = pencil(x1, x2)
    F, unit = members(some.basis[:, :, None], some.roots, some.moves)
    valid = some.real & unit
    empty = ~valid
    # An empty slot holds diag(1, 1, 0).
    F.masked_fill_(empty, 0.0)[0:5:4].add_(empty, alpha=0.5**0.5)
    return F, valid


class Pencil(NamedTuple):
    """The F = s G + t H of determinant 0 through seven points each, with F33 = 0, of the points moved and scaled."""

    points: tuple[Float[Tensor, "2 6 batch"], Float[Tensor, "2 6 batch"]]
    """The points of both images, the first one in the origin and left out, the largest coordinate 1."""
    moves: Float[Tensor, "2 3 batch"]
    """How they came there: of both images the origin and the unit."""
    basis: Float[Tensor, "8 2 batch"]
    """G and H: the entries of rows and columns 1 and 2, then the rest of the third column, and of the third row."""
    roots: Float[Tensor, "2 3 batch"]
    """s and t of each."""
    real: Bool[Tensor, "3 batch"]
    """Which roots are any; none where the points leave more F than these."""


def pencil(x1: Float[Tensor, "2 7 batch"], x2: Float[Tensor, "2 7 batch"]) -> Pencil:
    """The two matrices that seven linear equations leave, and the roots of det(G + t H) = 0."""
    x = torch.stack((x1, x2))
    centre = x[:, :, 0]
    moved = x[:, :, 1:] - centre[:, :, None]
    extent = moved.abs().amax((1, 2))
    first, second = moved.mul_(extent.reciprocal()[:, None, None])
    # The first point says that F33 = 0: six equations in eight entries are left.
    A = x.new_empty(8, 6, x.shape[-1])
    torch.mul(second[:, None], first, out=A[:4].view(2, 2, *A.shape[1:]))
    A[4:6], A[6:] = second, first
    N, pivot = nullspace_columns(A)
    # Each row for G and for H.
    n, crossed = N.unbind(0), N.flip(1).unbind(0)
    C = _cofactors(n)
    # det(G + t H): the coefficients of 1 and t^3, and of t and t^2.
    outer, inner = combine_rows(C[6:], n[6:]), combine_rows(C, crossed)
    cubic = torch.cat((outer[:1], inner, outer[1:]))
    size = cubic.abs()
    # The larger of the outer coefficients leads: where that is the first one, the root is 1 / t.
    turn = size[0] > size[3]
    roots, real = cubic_rows(*torch.where(turn, cubic.flip(0), cubic).unbind(0))
    one = roots.new_ones(())
    pairs = torch.stack((torch.where(turn, roots, one), torch.where(turn, one, roots)))
    moves = torch.cat((centre, extent[:, None]), 1)
    determined = torch.minimum(pivot, size.amax(0)) > _INDEPENDENT[x.dtype]
    return Pencil((first, second), moves, N, pairs, real & determined)


def members(
    basis: Float[Tensor, "8 2 *#slots"], roots: Float[Tensor, "2 *#slots"], moves: Float[Tensor, "2 3 *#slots"]
) -> tuple[Float[Tensor, "9 *slots"], Bool[Tensor, "*slots"]]:
    """S G + t H between points as they came, of norm 1, and where it is finite."""
    F = (basis[:, 0] * roots[0]).addcmul_(basis[:, 1], roots[1])
    f0, f1, f3, f4, f2, f5, f6, f7 = F
    F = torch.stack((f0, f1, f2, f3, f4, f5, f6, f7, torch.zeros_like(f7)))
    # T2' F T1 with T = [I, -c] / size, up to scale; by columns, then by rows.
    rows = F.view(3, 3, *F.shape[1:])
    (u, v, s1), (a, b, s2) = moves
    first, second, third = rows.unbind(1)
    third.mul_(s1).addcmul_(u, first, value=-1).addcmul_(v, second, value=-1)
    first, second, third = rows
    third.mul_(s2).addcmul_(a, first, value=-1).addcmul_(b, second, value=-1)
    entries = F.unbind(0)
    square = combine_rows(entries, entries)
    # False for NaN.
    return F.mul_(square.rsqrt()), (square > 0) & (square < torch.inf)


def _cofactors(f: Sequence[Tensor]) -> list[Tensor]:
    """Of a matrix whose last entry is 0, without the last one; as the entries, those of the first rows and columns first."""
    f0, f1, f3, f4, f2, f5, f6, f7 = f
    first, second = (-(f5 * f7), f5 * f6, fms(f4, f6, f3 * f7)), (f2 * f7, -(f2 * f6), fms(f0, f7, f1 * f6))
    return [*first[:2], *second[:2], first[2], second[2], fms(f2, f4, f1 * f5), fms(f0, f5, f2 * f3)]
