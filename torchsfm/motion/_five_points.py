"""The polynomial of the five-point problem (Nister 2004), and the way back from its roots.

E is x X + y Y + z Z + w W in an orthonormal basis of the null space of the five linear equations; ten cubic equations in
(x, y, z, w) remain, whose elimination leaves three that are linear in (x, y) and polynomial in z, and their determinant, of
degree ten. The basis is taken such that z : w is about the direction of the baseline in the image plane: over it the solutions
are spread, while over an arbitrary coordinate they crowd where the rotation, the baseline or the field of view is small. All
arithmetic has the batch in the last dimension.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.nullspace import nullspace_columns
from torchsfm.linalg.real_roots import real_root_list
from torchsfm.linalg.rows import add_rows, combine_rows, take_columns

# Cubic monomials in Nister's order, as sorted triples of 0 (x), 1 (y), 2 (z), 3 (w); quadratic ones as pairs, squares first.
_CUBICS = [(0, 0, 0), (1, 1, 1), (0, 0, 1), (0, 1, 1), (0, 0, 2), (0, 0, 3), (1, 1, 2), (1, 1, 3), (0, 1, 2), (0, 1, 3)]
_CUBICS += [(0, 2, 2), (0, 2, 3), (0, 3, 3), (1, 2, 2), (1, 2, 3), (1, 3, 3), (2, 2, 2), (2, 2, 3), (2, 3, 3), (3, 3, 3)]
_SQUARES = [(0, 0), (1, 1), (2, 2), (3, 3), (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
# The ways to write a monomial as a square, by its number, times a variable.
_WAYS = [[(_SQUARES.index(q), v) for q, v in product(_SQUARES, range(4)) if tuple(sorted((*q, v))) == m] for m in _CUBICS]
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]
# A quaternion's product with any other: orthonormal.
_TURN = [[0.5, -0.1, 0.7, -0.5], [0.1, 0.5, 0.5, 0.7], [-0.7, -0.5, 0.5, 0.1], [0.5, -0.7, -0.1, 0.5]]
_INDEPENDENT = 1e-13


class FivePointRoots(NamedTuple):
    """The roots z : w = s : t of the polynomials of some problems, each with a column of its own."""

    item: Tensor
    s: Tensor
    t: Tensor
    x: Tensor
    y: Tensor
    w: Tensor
    basis: Tensor
    d1: Tensor
    """The rays at length 1, (3, 5, problems)."""
    d2: Tensor


def five_point_roots(
    d1: Float[Tensor, "3 5 batch"], d2: Float[Tensor, "3 5 batch"], *, steps: int, other_coordinates: bool = False
) -> FivePointRoots:
    """All real roots, in any order, after some steps of Newton's method."""
    d1, fine1 = _unit(d1)
    d2, fine2 = _unit(d2)
    basis, pivot = nullspace_basis(d1, d2)
    if other_coordinates:
        basis = turned(basis)
    x, y, w, p = polynomial(basis)
    # Without five independent equations there is no polynomial and no root.
    fine = fine1 & fine2 & (pivot > _INDEPENDENT)
    item, s, t = real_root_list(torch.where(fine, p, torch.nan), steps=steps, in_order=False)
    x, y, w, basis = (take_columns(rows, item) for rows in (x, y, w, basis))
    return FivePointRoots(item, s, t, x, y, w, basis, d1, d2)


def _unit(d: Tensor) -> tuple[Tensor, Tensor]:
    """Rays of length 1, and where all are finite and have a direction; what they are elsewhere concerns no other problem."""
    d = d.contiguous()
    largest = d.abs().amax((0, 1))
    # Squares neither overflow nor vanish.
    d = d * (1 / largest)
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


def polynomial(basis: Float[Tensor, "4 9 batch"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Three rows of polynomials that multiply x, y and 1, `(power, row, batch)`, and their determinant `(power, batch)`."""
    x, y, w = three_rows(eliminate(constraints(basis.view(4, 3, 3, -1))))
    n = convolve(y[:, _NEXT], w[:, _AFTER]) - convolve(y[:, _AFTER], w[:, _NEXT])
    return x, y, w, add_rows(convolve(x, n).unbind(1))


def constraints(E: Float[Tensor, "4 3 3 batch"]) -> Float[Tensor, "20 10 batch"]:
    """Coefficients of the monomials in (E E' - tr(E E') / 2) E = 0 and det E = 0."""
    batch = E.shape[-1]
    # Coefficients of the squares: the symmetric E E' by columns, and the cofactors of the first column of E.
    S = E.new_empty(10, 3, 3, batch)
    columns = [matrix[:, :, None].unbind(1) for matrix in E.unbind(0)]
    lines = [matrix.unbind(0) for matrix in E.transpose(1, 2).unbind(0)]
    for (i, j), square in zip(_SQUARES, S.unbind(0), strict=True):
        torch.mul(columns[i][0], lines[j][0], out=square)
        for k in (1, 2):
            square.addcmul_(columns[i][k], lines[j][k])
        if i != j:
            square += square.transpose(0, 1).clone()
    diagonal = S.view(10, 9, batch)[:, ::4]
    diagonal -= (S[:, 0, 0] + S[:, 1, 1]).add_(S[:, 2, 2]).mul_(0.5)[:, None]
    C = E.new_empty(3, 10, batch)
    first, second = E[:, None, :, 1], E[None, :, :, 2]
    for k, cofactors in enumerate(C.unbind(0)):
        minors = first[:, :, _NEXT[k]] * second[:, :, _AFTER[k]]
        minors.addcmul_(first[:, :, _AFTER[k]], second[:, :, _NEXT[k]], value=-1)
        cofactors[:4] = minors.diagonal().mT
        for number, (i, j) in enumerate(_SQUARES[4:], 4):
            torch.add(minors[i, j], minors[j, i], out=cofactors[number])
    out = E.new_empty(20, 10, batch)
    traces = [square.unbind(1) for square in S[:, :, :, None].unbind(0)]
    entries = [matrix.unbind(0) for matrix in E.unbind(0)]
    determinants = [combine_rows(C, matrix[:, 0]).unbind(0) for matrix in E.unbind(0)]
    for row, ways in zip(out.unbind(0), _WAYS, strict=True):
        trace, determinant = row[:9].view(3, 3, batch), row[9]
        for way, (which, variable) in enumerate(ways):
            for k in range(3):
                if way + k:
                    trace.addcmul_(traces[which][k], entries[variable][k])
                else:
                    torch.mul(traces[which][k], entries[variable][k], out=trace)
            if way:
                determinant += determinants[variable][which]
            else:
                determinant.copy_(determinants[variable][which])
    return out


def eliminate(A: Float[Tensor, "20 10 batch"]) -> Float[Tensor, "10 6 batch"]:
    """Rows 5 to 10 of the reduced row echelon form, without pivoting: an orthonormal basis makes that accurate enough."""
    for k in range(9):
        A[k + 1 :, k + 1 :].addcmul_(A[k + 1 :, k, None], A[k, k + 1 :] / A[k, k], value=-1)
    for k in range(9, 4, -1):
        A[10:, 4:k].addcmul_(A[10:, k, None], A[k, 4:k] / A[k, k], value=-1)
    return A[10:, 4:] / torch.stack([A[k, k] for k in range(4, 10)])


def three_rows(C: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Polynomials in z (power, row, batch) that multiply x, y and 1: rows x^2 z - z x^2, y^2 z - z y^2, xyz - z xy."""
    a, b = C[:, 0::2], C[:, 1::2]
    x = torch.stack((a[2], a[1] - b[2], a[0] - b[1], -b[0]))
    y = torch.stack((a[5], a[4] - b[5], a[3] - b[4], -b[3]))
    return x, y, torch.stack((a[9], a[8] - b[9], a[7] - b[8], a[6] - b[7], -b[6]))


def convolve(p: Tensor, q: Tensor) -> Tensor:
    out = torch.zeros(p.shape[0] + q.shape[0] - 1, *q.shape[1:], dtype=q.dtype, device=q.device)
    for i in range(p.shape[0]):
        out[i : i + q.shape[0]].addcmul_(p[i], q)
    return out


def back_substitute(x: Tensor, y: Tensor, w: Tensor, s: Tensor, c: Tensor) -> Tensor:
    """The unit (x, y, z, w) for every root z = s / c: a null vector of the three rows, from the best-conditioned pair."""
    cc, ss = c * c, s * s
    powers = (cc * c, cc * s, ss * c, ss * s)
    X, Y, W = (combine_rows(p[:4], powers) for p in (x, y, w))
    W = (W * c).addcmul_(w[4], ss * ss)
    rows = list(zip(X, Y, W, strict=True))
    n = [cross(rows[i], rows[j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    n0, n1, n2 = longest([combine_rows(v, v) for v in n], n)
    return normalised(torch.stack((n0, n1, s * n2, c * n2)))


def longest(squares: Sequence[Tensor], vectors: Sequence[Tensor]) -> Tensor:
    """Of three vectors the one with the largest square."""
    first, second, third = squares
    longer = torch.where(second > first, vectors[1], vectors[0])
    return torch.where(third > torch.maximum(first, second), vectors[2], longer)


def normalised(u: Tensor) -> Tensor:
    return u * combine_rows(u, u).rsqrt()


def cross(a: Sequence[Tensor] | Tensor, b: Sequence[Tensor] | Tensor) -> Tensor:
    a0, a1, a2 = a
    b0, b1, b2 = b
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))
