"""Five rays in two calibrated cameras: E with d2' E d1 = 0 and 2 E E' E = tr(E E') E (Nister 2004).

E is x X + y Y + z Z + w W in an orthonormal basis of the null space of the five linear equations; ten cubic equations in
(x, y, z, w) remain, whose elimination leaves three that are linear in (x, y) and polynomial in z, and their determinant, of
degree ten. The basis is taken such that z : w is about the direction of the baseline in the image plane: over it the solutions
are spread, while over an arbitrary coordinate they crowd where the rotation, the baseline or the field of view is small. Every
solution is polished on the manifold of essential matrices. All arithmetic has the batch in the last dimension.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.nullspace import nullspace_columns
from torchsfm.linalg.real_roots import real_root_list
from torchsfm.linalg.rows import add_rows, combine_rows, take_columns
from torchsfm.optim import attach_implicit, wants_derivative

_CHUNK = 2048
"""Problems at a time: their matrices fit the cache."""
_INDEPENDENT = 1e-13
_NEAR = 1e-8
"""Distance from the manifold before a Newton step after which there is nothing left to gain."""
_MORE = 4
"""Newton steps for the others, among near-planar points and small baselines."""
_CONVERGED = 1e-7
"""Distance from the manifold before the last step, of what is a solution."""

# Cubic monomials in Nister's order, as sorted triples of 0 (x), 1 (y), 2 (z), 3 (w); quadratic ones as pairs, squares first.
_CUBICS = [(0, 0, 0), (1, 1, 1), (0, 0, 1), (0, 1, 1), (0, 0, 2), (0, 0, 3), (1, 1, 2), (1, 1, 3), (0, 1, 2), (0, 1, 3)]
_CUBICS += [(0, 2, 2), (0, 2, 3), (0, 3, 3), (1, 2, 2), (1, 2, 3), (1, 3, 3), (2, 2, 2), (2, 2, 3), (2, 3, 3), (3, 3, 3)]
_SQUARES = [(0, 0), (1, 1), (2, 2), (3, 3), (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
# The ways to write a monomial as a square, by its number, times a variable.
_WAYS = [[(_SQUARES.index(q), v) for q, v in product(_SQUARES, range(4)) if tuple(sorted((*q, v))) == m] for m in _CUBICS]
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]


def equations(
    E: Float[Tensor, "*#batch 3 3"], d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Float[Tensor, "*batch 15"]:
    """Fifteen equations of rank 9: d2' E d1 = 0 for each ray, 2 E E' E - tr(E E') E = 0, and |E|^2 = 2."""
    epipolar = (d2 * (d1 @ E.mT)).sum(-1)
    S = E @ E.mT
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)
    cubic = (2 * S @ E - trace[..., None, None] * E).flatten(-2)
    gauge = trace[..., None] - 2
    shape = epipolar.shape[:-1]
    return torch.cat((epipolar, cubic.expand(*shape, 9), gauge.expand(*shape, 1)), -1)


def essential_5pt(
    d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Solutions[Float[Tensor, "*batch 10 3 3"]]:
    """The essential matrices with d2' E d1 = 0 for five rays, at most ten, with |E|^2 = 2 (Frobenius).

    Args:
        d1: Five rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.

    Returns:
        Ten slots. None is valid where the linear equations are dependent (coinciding rays) or a ray is zero or not finite.
        Without baseline E is not determined: whatever is valid there has the right epipolar lines and no meaning. Computed in
        float64 whatever the dtype. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    batch = check_tensors(d1=(d1, "5 3"), d2=(d2, "5 3"))
    with torch.no_grad():
        # (coordinate, ray, problem)
        rows1, rows2 = (d.detach().double().expand(*batch, 5, 3).reshape(-1, 5, 3).permute(2, 1, 0) for d in (d1, d2))
        E, valid = _solve(rows1, rows2)
        E, valid = E.to(d1.dtype).reshape(*batch, 10, 3, 3), valid.reshape(*batch, 10)
    if wants_derivative(d1, d2):
        E = attach_implicit(equations, E, d1[..., None, :, :], d2[..., None, :, :], dims=2, valid=valid)
    return Solutions(E, valid)


class _Candidates(NamedTuple):
    """Solutions one after the other, in the last dimension."""

    item: Tensor
    slot: Tensor
    E: Tensor
    """(9, candidates), with |E| = 1."""
    error: Tensor
    """Distance from the essential manifold before the last Newton step."""
    rest: Tensor
    """Numbers of those that need more steps, with what these need:"""
    u: Tensor
    basis: Tensor


def _solve(d1: Float[Tensor, "3 5 batch"], d2: Float[Tensor, "3 5 batch"]) -> tuple[Tensor, Tensor]:
    """E as (batch, 10, 9) and valid as (batch, 10)."""
    batch = d1.shape[-1]
    starts = range(0, max(batch, 1), _CHUNK)
    chunks = [_candidates(d1[..., i : i + _CHUNK], d2[..., i : i + _CHUNK]) for i in starts]
    before = 0
    for i, chunk in enumerate(chunks):
        chunks[i] = chunk._replace(item=chunk.item + starts[i], rest=chunk.rest + before)
        before += len(chunk.item)
    item, slot, E, error, rest, u, basis = (torch.cat(parts, -1) for parts in zip(*chunks, strict=True))
    # The few that are not near yet, of all chunks together.
    last = error.index_select(0, rest)
    for _ in range(_MORE):
        u, last = _polish(u, basis)
    E = E.index_copy(1, rest, _combine(u, basis))
    error = error.index_copy(0, rest, last)
    keep = ((error < _CONVERGED) & torch.isfinite(E).all(0) & (slot < 10)).nonzero()[:, 0]
    place = item.index_select(0, keep), slot.index_select(0, keep)
    # An empty slot holds diag(1, 1, 0).
    out = torch.zeros(batch, 10, 9, dtype=E.dtype, device=E.device)
    out[..., ::4] = torch.tensor([1.0, 1.0, 0.0], dtype=E.dtype, device=E.device)
    out[place] = take_columns(E, keep).mT * 2**0.5
    valid = torch.zeros(batch, 10, dtype=torch.bool, device=E.device)
    valid[place] = True
    return out, valid


def _candidates(d1: Tensor, d2: Tensor) -> _Candidates:
    d1, fine1 = _unit(d1)
    d2, fine2 = _unit(d2)
    basis, pivot = _basis(d1, d2)
    x, y, w = _three_rows(_eliminate(_constraints(basis.view(4, 3, 3, -1))))
    n = _convolve(y[:, _NEXT], w[:, _AFTER]) - _convolve(y[:, _AFTER], w[:, _NEXT])
    # Without five independent equations there is no polynomial and no root.
    fine = fine1 & fine2 & (pivot > _INDEPENDENT)
    roots = real_root_list(torch.where(fine, add_rows(_convolve(x, n).unbind(1)), torch.nan), steps=2)
    # From here on each root has a column of its own.
    item = roots.item
    x, y, w, basis = (take_columns(rows, item) for rows in (x, y, w, basis))
    u, error = _polish(_back_substitute(x, y, w, roots.s, roots.t), basis)
    rest = (error > _NEAR).nonzero()[:, 0]
    return _Candidates(item, roots.slot(), _combine(u, basis), error, rest, take_columns(u, rest), take_columns(basis, rest))


def _unit(d: Tensor) -> tuple[Tensor, Tensor]:
    d = d.contiguous()
    largest = d.abs().amax((0, 1))
    fine = torch.isfinite(largest) & (largest > 0)
    d = torch.where(fine, d / torch.where(fine, largest, 1), 1)
    square = combine_rows(d, d)
    return d * torch.where(square > 0, square, 1).rsqrt_(), fine & (square > 0).all(0)


def _basis(d1: Tensor, d2: Tensor) -> tuple[Tensor, Tensor]:
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


def _constraints(E: Float[Tensor, "4 3 3 batch"]) -> Float[Tensor, "20 10 batch"]:
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
        for number, (square, variable) in enumerate(ways):
            for k in range(3):
                if number + k:
                    trace.addcmul_(traces[square][k], entries[variable][k])
                else:
                    torch.mul(traces[square][k], entries[variable][k], out=trace)
            if number:
                determinant += determinants[variable][square]
            else:
                determinant.copy_(determinants[variable][square])
    return out


def _eliminate(A: Float[Tensor, "20 10 batch"]) -> Float[Tensor, "10 6 batch"]:
    """Rows 5 to 10 of the reduced row echelon form, without pivoting: an orthonormal basis makes that accurate enough."""
    for k in range(9):
        A[k + 1 :, k + 1 :].addcmul_(A[k + 1 :, k, None], A[k, k + 1 :] / A[k, k], value=-1)
    for k in range(9, 4, -1):
        A[10:, 4:k].addcmul_(A[10:, k, None], A[k, 4:k] / A[k, k], value=-1)
    return A[10:, 4:] / torch.stack([A[k, k] for k in range(4, 10)])


def _three_rows(C: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Polynomials in z (power, row, batch) that multiply x, y and 1: rows x^2 z - z x^2, y^2 z - z y^2, xyz - z xy."""
    a, b = C[:, 0::2], C[:, 1::2]
    x = torch.stack((a[2], a[1] - b[2], a[0] - b[1], -b[0]))
    y = torch.stack((a[5], a[4] - b[5], a[3] - b[4], -b[3]))
    return x, y, torch.stack((a[9], a[8] - b[9], a[7] - b[8], a[6] - b[7], -b[6]))


def _convolve(p: Tensor, q: Tensor) -> Tensor:
    out = torch.zeros(p.shape[0] + q.shape[0] - 1, *q.shape[1:], dtype=q.dtype, device=q.device)
    for i in range(p.shape[0]):
        out[i : i + q.shape[0]].addcmul_(p[i], q)
    return out


def _back_substitute(x: Tensor, y: Tensor, w: Tensor, s: Tensor, c: Tensor) -> Tensor:
    """The unit (x, y, z, w) for every root z = s / c: a null vector of the three rows, from the best-conditioned pair."""
    cc, ss = c * c, s * s
    powers = (cc * c, cc * s, ss * c, ss * s)
    X, Y, W = (combine_rows(p[:4], powers) for p in (x, y, w))
    W = (W * c).addcmul_(w[4], ss * ss)
    n = torch.stack([_cross((X[i], Y[i], W[i]), (X[j], Y[j], W[j])) for i, j in ((1, 2), (2, 0), (0, 1))])
    best = add_rows((n * n).unbind(1)).max(0).indices
    n0, n1, n2 = n.gather(0, best.expand(1, 3, -1))[0]
    return _normalised(torch.stack((n0, n1, s * n2, c * n2)))


def _normalised(u: Tensor) -> Tensor:
    return u * combine_rows(u, u).rsqrt()


def _combine(u: Float[Tensor, "4 roots"], basis: Float[Tensor, "4 9 roots"]) -> Float[Tensor, "9 roots"]:
    return combine_rows(basis, u)


def _cross(a: Sequence[Tensor] | Tensor, b: Sequence[Tensor] | Tensor) -> Tensor:
    a0, a1, a2 = a
    b0, b1, b2 = b
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))


def _polish(u: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """One Newton step on the essential manifold within the null space, and how far the start was from the manifold.

    Around E = U diag(1, 1, 0) V' the manifold's normal space is spanned by u3 v3', u1 v1' - u2 v2' and u1 v2' + u2 v1', for any
    u1, u2 and v1 = E' u1, v2 = E' u2. Three linear equations in (x, y, z, w) remain: the solution is their 4D cross product.
    """
    e = _combine(u, basis)
    cofactors = torch.stack((_cross(e[3:6], e[6:]), _cross(e[6:], e[:3]), _cross(e[:3], e[3:6])))
    squares = cofactors * cofactors
    i, j = add_rows(squares.unbind(1)).max(0).indices, add_rows(squares).max(0).indices
    v3 = _normalised(cofactors.gather(0, i.expand(1, 3, -1))[0])
    u3 = _normalised(cofactors.gather(1, j.expand(3, 1, -1))[:, 0])
    # A frame around u3 without branches (Duff et al. 2017).
    sign = torch.copysign(torch.ones_like(u3[2]), u3[2])
    a = -1 / (sign + u3[2])
    b = u3[0] * u3[1] * a
    u1 = (1 + sign * u3[0] * u3[0] * a, sign * b, -sign * u3[0])
    u2 = (b, sign + u3[1] * u3[1] * a, -u3[1])
    rows = e.view(3, 3, -1)
    v1 = combine_rows(rows, u1)
    v1 = _normalised(v1 - v3 * combine_rows(v1, v3))
    v2 = _cross(v3, v1)
    v2 = v2 * torch.copysign(torch.ones_like(sign), combine_rows(combine_rows(rows, u2), v2))
    # The normals' products with the basis, by rows of the basis matrices: B v, then u' B v.
    columns = basis.view(4, 3, 3, -1).permute(2, 1, 0, 3)
    Bv1, Bv2, Bv3 = (combine_rows(columns, v) for v in (v1, v2, v3))
    p = combine_rows(Bv3, u3)
    q = combine_rows(Bv1, u1) - combine_rows(Bv2, u2)
    r = combine_rows(Bv2, u1) + combine_rows(Bv1, u2)
    error = torch.stack([combine_rows(f, u).abs() for f in (p, q, r)]).amax(0)
    p0, p1, p2, p3 = p
    q0, q1, q2, q3 = q
    r0, r1, r2, r3 = r
    m01, m02, m03 = p0 * q1 - p1 * q0, p0 * q2 - p2 * q0, p0 * q3 - p3 * q0
    m12, m13, m23 = p1 * q2 - p2 * q1, p1 * q3 - p3 * q1, p2 * q3 - p3 * q2
    x, y, z = m12 * r3 - m13 * r2 + m23 * r1, m03 * r2 - m02 * r3 - m23 * r0, m01 * r3 - m03 * r1 + m13 * r0
    return _normalised(torch.stack((x, y, z, m02 * r1 - m01 * r2 - m12 * r0))), error
