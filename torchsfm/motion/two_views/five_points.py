"""The polynomial of the five-point problem (Nister 2004), and the way back from its roots.

E is x X + y Y + z Z + w W in an orthonormal basis of the null space of the five linear equations; ten cubic equations in
(x, y, z, w) remain, whose elimination leaves three that are linear in (x, y) and polynomial in z, and their determinant, of
degree ten. The basis is taken such that z : w is about the direction of the baseline in the image plane: over it the solutions
are spread, while over an arbitrary coordinate they crowd where the rotation, the baseline or the field of view is small. All
arithmetic has the batch in the last dimension.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.constants import Constant
from torchsfm.linalg.nullspace import nullspace_columns
from torchsfm.linalg.real_roots import real_root_list
from torchsfm.linalg.rows import add_rows, combine_rows

# Cubic monomials in Nister's order, as sorted triples of 0 (x), 1 (y), 2 (z), 3 (w), the last ones by powers of z; quadratic
# ones as pairs, squares first.
_CUBICS: list[tuple[int, ...]] = [(0, 0, 0), (1, 1, 1), (0, 0, 1), (0, 1, 1), (0, 0, 2), (0, 0, 3), (1, 1, 2), (1, 1, 3)]
_CUBICS += [(0, 1, 2), (0, 1, 3)]
_CUBICS += [(0, 3, 3), (0, 2, 3), (0, 2, 2), (1, 3, 3), (1, 2, 3), (1, 2, 2), (3, 3, 3), (2, 3, 3), (2, 2, 3), (2, 2, 2)]
_SQUARES = [(0, 0), (1, 1), (2, 2), (3, 3), (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
# Number of the monomial that a quadratic one times a variable is, by variable.
_TIMES = [Constant(torch.tensor([_CUBICS.index((*sorted((*q, v)),)) for q in _SQUARES])) for v in range(4)]
# Where the quadratic monomials are in a square of pairs.
_PLACES = Constant(torch.tensor([4 * i + j for i, j in _SQUARES]))
# A quaternion's product with any other: orthonormal.
_TURN = [[0.5, -0.1, 0.7, -0.5], [0.1, 0.5, 0.5, 0.7], [-0.7, -0.5, 0.5, 0.1], [0.5, -0.7, -0.1, 0.5]]
_INDEPENDENT = 1e-13


class FivePointRoots(NamedTuple):
    """The roots z : w = s : t of the polynomials of some problems, one after the other, and what belongs to each problem."""

    item: Tensor
    """The problem of each root."""
    s: Tensor
    t: Tensor
    rows: Tensor
    """See `polynomial`, (13, 3, problems)."""
    basis: Tensor
    """(4, 9, problems)"""
    d1: Tensor
    """The rays at length 1, (3, 5, problems)."""
    d2: Tensor


def five_point_roots(
    d1: Float[Tensor, "3 5 batch"], d2: Float[Tensor, "3 5 batch"], *, other_coordinates: bool = False
) -> FivePointRoots:
    """All real roots, in any order."""
    d1, fine1 = _unit(d1)
    d2, fine2 = _unit(d2)
    basis, pivot = nullspace_basis(d1, d2)
    if other_coordinates:
        basis = turned(basis)
    rows, p = polynomial(basis)
    # Without five independent equations there is no polynomial and no root.
    fine = fine1 & fine2 & (pivot > _INDEPENDENT)
    item, s, t, _ = real_root_list(torch.where(fine, p, torch.nan), in_order=False)
    return FivePointRoots(item, s, t, rows, basis, d1, d2)


def _unit(d: Tensor) -> tuple[Tensor, Tensor]:
    """Rays of length 1, and where all are finite and have a direction; what they are elsewhere concerns no other problem."""
    d = d.contiguous()
    largest = d.abs().amax((0, 1))
    # Squares neither overflow nor vanish.
    d = d * largest.reciprocal()
    square = combine_rows(d, d)
    return d.mul_(square.rsqrt()), (largest < torch.inf) & (square > 0).all(0)


def nullspace_basis(d1: Tensor, d2: Tensor) -> tuple[Tensor, Tensor]:
    """An orthonormal basis (4, 9, batch) of the matrices with d2' E d1 = 0, in which the last two follow the skew part."""
    P = d2[:, None] * d1[None]
    half = 0.5**0.5
    (p00, p01, p02), (p10, p11, p12), (p20, p21, p22) = (row.unbind(0) for row in P.unbind(0))
    # Orthonormal coordinates: what is eliminated first, then trace, and the skew part by z, x, y.
    first = (p22, (p02 + p20) * half, (p12 + p21) * half, (p00 - p11) * half, (p01 + p10) * half)
    last = ((p00 + p11) * half, (p10 - p01) * half, (p21 - p12) * half, (p02 - p20) * half)
    N, pivot = nullspace_columns(torch.stack((*first, *last)))
    e33, s13, s23, minus, s12, plus, a3, a1, a2 = N.unbind(0)
    entries = (plus + minus, s12 - a3, s13 + a2, s12 + a3, plus - minus, s23 - a1, s13 - a2, s23 + a1)
    basis = torch.stack((*entries, e33), 1)
    basis[:, :8] *= half
    return basis, pivot


def turned(basis: Float[Tensor, "4 9 batch"]) -> Float[Tensor, "4 9 batch"]:
    """Another orthonormal basis, the same turn of every one, near no coordinate plane."""
    return torch.stack([combine_rows(basis, [basis.new_tensor(entry) for entry in row]) for row in _TURN])


def polynomial(basis: Float[Tensor, "4 9 batch"]) -> tuple[Tensor, Tensor]:
    """Three rows of polynomials in z that multiply x, y and 1, and their determinant.

    The rows are x^2 z - z x^2, y^2 z - z y^2 and xyz - z xy.

    Returns:
        Coefficients of all four, four and five powers as `(13, 3, batch)`, and of the determinant as `(11, batch)`.
    """
    batch = basis.shape[-1]
    A = eliminate(constraints(basis.view(4, 3, 3, -1)))
    a, b = A[:, 0::2], A[:, 1::2]
    # The first two rows again behind the third.
    rows = basis.new_zeros(13, 5, batch)
    for begin, first, last in ((0, 0, 3), (4, 3, 6), (8, 6, 10)):
        size = last - first
        rows[begin : begin + size, :3] = a[first:last]
        rows[begin + 1 : begin + 1 + size, :3] -= b[first:last]
    rows[:, 3:] = rows[:, :2]
    x, y, w = rows[:4, :3], rows[4:8], rows[8:]
    n = basis.new_zeros(8, 3, batch)
    for i, (left, right) in enumerate(zip(y[:, 1:4].unbind(0), y[:, 2:].unbind(0), strict=True)):
        n[i : i + 5].addcmul_(left, w[:, 2:]).addcmul_(right, w[:, 1:4], value=-1)
    p = basis.new_zeros(11, 3, batch)
    for i, row in enumerate(x.unbind(0)):
        p[i : i + 8].addcmul_(row, n)
    return rows[:, :3], add_rows(p.unbind(1))


def constraints(E: Float[Tensor, "4 3 3 batch"]) -> Float[Tensor, "20 10 batch"]:
    """Coefficients of the monomials in (E E' - tr(E E') / 2) E = 0 and det E = 0."""
    batch = E.shape[-1]
    # Coefficients of the squares: the symmetric E E', and the cofactors of the first column of E.
    S = E.new_empty(10, 3, 3, batch)
    columns, lines = E[:, :, None].unbind(3), E[:, None].unbind(3)
    _sum_of_products(columns, lines, S[:4])
    for i, part in enumerate((S[4:7], S[7:9], S[9:])):
        _sum_of_products([c[i] for c in columns], [r[i + 1 :] for r in lines], part)
    S[4:] = S[4:] + S[4:].transpose(1, 2)
    diagonal = S.view(10, 9, batch)[:, ::4]
    diagonal -= add_rows(diagonal.unbind(1)).mul_(0.5)[:, None]
    round_ = E.new_empty(4, 5, 2, batch)
    round_[:, :3] = E[:, :, 1:]
    round_[:, 3:] = round_[:, :2]
    left, right = round_[:, None, :, 0], round_[None, :, :, 1]
    C = (left[:, :, 1:4] * right[:, :, 2:]).addcmul_(left[:, :, 2:], right[:, :, 1:4], value=-1)
    C += C.transpose(0, 1).clone()
    C = C.flatten(0, 1).index_select(0, _PLACES.on(C.device))
    C[:4] *= 0.5
    # Times E, one variable after the other.
    out = E.new_zeros(20, 10, batch)
    part = E.new_empty(10, 10, batch)
    trace, determinant = part[:, :9].view(10, 3, 3, batch), part[:, 9]
    squares, cofactors = S[:, :, :, None].unbind(2), C.unbind(1)
    for times, matrix in zip(_TIMES, E.unbind(0), strict=True):
        _sum_of_products(squares, matrix.unbind(0), trace)
        _sum_of_products(cofactors, matrix[:, 0].unbind(0), determinant)
        out.index_add_(0, times.on(E.device), part)
    return out


def _sum_of_products(left: Sequence[Tensor], right: Sequence[Tensor], out: Tensor) -> None:
    torch.mul(left[0], right[0], out=out).addcmul_(left[1], right[1]).addcmul_(left[2], right[2])


def eliminate(A: Float[Tensor, "20 10 batch"]) -> Float[Tensor, "10 6 batch"]:
    """Rows 5 to 10 of the reduced row echelon form, without pivoting: an orthonormal basis makes that accurate enough."""
    for k in range(9):
        A[k + 1 :, k + 1 :].addcmul_(A[k + 1 :, k, None], A[k, k + 1 :] / A[k, k], value=-1)
    for k in range(9, 4, -1):
        A[10:, 4:k].addcmul_(A[10:, k, None], A[k, 4:k] / A[k, k], value=-1)
    return A[10:, 4:] / A[4:10, 4:].diagonal().mT


def back_substitute(rows: Float[Tensor, "13 3 roots"], s: Tensor, c: Tensor) -> Float[Tensor, "4 roots"]:
    """The unit (x, y, z, w) for every root z = s / c: a null vector of the three rows, from the best-conditioned pair."""
    cc, ss = c * c, s * s
    powers = (cc * c, cc * s, ss * c, ss * s)
    lines = rows.unbind(0)
    X, Y, W = (combine_rows(lines[i : i + 4], powers) for i in (0, 4, 8))
    M = torch.stack((X, Y, (W * c).addcmul_(lines[12], ss * ss)), 1)
    C = products_of_minors(gone_round(M))
    n = longest(add_rows((C * C).unbind(1)).unbind(0), C.unbind(0))
    u = n.new_empty(4, n.shape[-1])
    u[:2] = n[:2]
    torch.mul(s, n[2], out=u[2])
    torch.mul(c, n[2], out=u[3])
    return normalised(u)


def gone_round(E: Float[Tensor, "3 3 *batch"]) -> Float[Tensor, "5 5 *batch"]:
    """The matrices with their first two rows and columns once more behind the last."""
    out = E.new_empty(5, 5, *E.shape[2:])
    out[:3, :3] = E
    out[3:, :3] = E[:2]
    out[:, 3:] = out[:, :2]
    return out


def products_of_minors(round_: Float[Tensor, "5 5 *batch"]) -> Float[Tensor, "3 3 *batch"]:
    """The matrices of cofactors, whose rows are cross products of rows, in two products, of matrices that go round."""
    return (round_[1:4, 1:4] * round_[2:, 2:]).addcmul_(round_[1:4, 2:], round_[2:, 1:4], value=-1)


def longest(squares: Sequence[Tensor], vectors: Sequence[Tensor]) -> Tensor:
    """Of three vectors the one with the largest square."""
    first, second, third = squares
    longer = torch.where(second > first, vectors[1], vectors[0])
    return torch.where(third > torch.maximum(first, second), vectors[2], longer)


def normalised(u: Tensor) -> Tensor:
    """Vectors along the first dimension, of unit length."""
    return u * combine_rows(u, u).rsqrt()
