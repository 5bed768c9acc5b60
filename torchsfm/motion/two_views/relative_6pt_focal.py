"""Six points in two images by cameras of one unknown focal length: E and f (Stewenius, Nister, Kahl & Schaffalitzky 2005).

With w = 1 / f^2 and Q = diag(1, 1, w), the six linear equations leave F = x F0 + y F1 + z F2, and det F = 0 together with
2 F Q F'Q F = tr(F Q F'Q) F are ten equations M(w) v = 0 in the ten cubic monomials v of (x, y, z): a quadratic eigenvalue
problem (Kukelova, Bujnak & Pajdla 2008). The coefficient of w^2 is F33 times quadratics in (x, y, z), so in a basis of which
one matrix alone has F33 != 0 it acts on six monomials; det F = 0 takes one unknown more: 15 are left, as many as solutions. The
eigenvalues are looked for around a negative w, which no camera has. Every solution is polished by Newton's method in
(x, y, z) and 1 / f together.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import eigvals
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.motion.two_views.epipolar_fit import matrices
from torchsfm.motion.two_views.essential_newton import Roots, newton_step, with_focal
from torchsfm.motion.two_views.sample_rows import rows_of
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 1024
"""Problems at a time."""
_INDEPENDENT = 1e-12
"""Smallest pivot of the six normalised linear equations."""
_SHIFT = -0.3
"""The 1 / f^2 around which eigenvalues are looked for, in units of the largest image coordinate."""
_REAL = 6e-2
"""Largest share of the imaginary part in what may be a real eigenvalue; Newton's method decides."""
_RANGE = (1e-3, 1e3)
"""Focal lengths that are meant, in units of the largest image coordinate."""
_NEAR = 1e-7
"""Length of a step, in F of norm 1 and in log f, after which there is nothing left to gain."""
_MORE = 8
"""Newton steps for the others."""
_CONVERGED = 1e-7
"""Distance from the essential matrices before the last step, of what is a solution."""
_ISOLATED = 4e-11
"""Slope of the conditions in the direction in which they change least, by log f and F of norm 1, below which the solution is
one of a family: rounding leaves up to 2e-11 there, and less than that is left of three in 360,000 single solutions."""
_SAME = 1e-6
"""Solutions nearer than this, in F of norm 1 and in log f, are one."""
_SLOTS = 15
_SQUARES = list(combinations_with_replacement(range(3), 2))
_CUBICS: list[tuple[int, ...]] = list(combinations_with_replacement(range(3), 3))
_LAST = [k for k, m in enumerate(_CUBICS) if 2 in m]
"""Monomials with a factor z, six."""
_TIMES = [[_CUBICS.index(tuple(sorted((i, i, j)))) for j in range(3)] for i in range(3)]
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]


@dataclass(frozen=True)
class FocalMotion:
    """An essential matrix and the focal length of both cameras, in the unit of the image points.

    `d2' E d1 = 0` for rays d = (x, f), |E|^2 = 2 (Frobenius). F = diag(1, 1, f) E diag(1, 1, f) up to scale.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(6, generator=g), torchsfm.random_poses(2, generator=g).matrix()
        >>> x1, x2 = 800 * torchsfm.project_points(P, X)
        >>> found = torchsfm.motion.relative_6pt_focal(x1, x2)
        >>> f, E = found.model.f[found.valid], found.model.E[found.valid]
        >>> best = (f - 800).abs().argmin()
        >>> f[best], bool((torch.linalg.svdvals(E[best])[:2].diff() < 1e-6).all())
        (tensor(800.0000, dtype=torch.float64), True)
    """

    E: Float[Tensor, "*batch 3 3"]
    f: Float[Tensor, "*batch"]


def equations(
    y: Float[Tensor, "*#batch 10"], x1: Float[Tensor, "*#batch 6 2"], x2: Float[Tensor, "*#batch 6 2"]
) -> Float[Tensor, "*batch 16"]:
    """Sixteen equations of rank 10 of (E, f): d2' E d1 = 0 for d = (x / f, 1), 2 E E'E = tr(E E') E, and |E|^2 = 2."""
    E, f = matrices(y[..., :9], 3), y[..., 9, None, None]
    d1, d2 = (torch.cat((x / f, torch.ones_like(x[..., :1] / f)), -1) for x in (x1, x2))
    epipolar = (d2 * (d1 @ E.mT)).sum(-1)
    S = E @ E.mT
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)
    cubic = (2 * S @ E - trace[..., None, None] * E).flatten(-2)
    gauge = trace[..., None] - 2
    return torch.cat([p.expand(*epipolar.shape[:-1], p.shape[-1]) for p in (epipolar, cubic, gauge)], -1)


def relative_6pt_focal(x1: Float[Tensor, "*#batch 6 2"], x2: Float[Tensor, "*#batch 6 2"]) -> Solutions[FocalMotion]:
    """The essential matrices and focal lengths, at most 15, of two cameras of the same unknown focal length.

    Pixels are square, principal points at (0, 0): subtract them before.

    Args:
        x1: Six points in the first image.
        x2: The corresponding points in the second image, in the same unit.

    Returns:
        Fifteen slots. None is valid where the points leave more than three F (coinciding points, a plane, a pure rotation) or a
        coordinate is not finite. Focal lengths are looked for between 1/1000 and 1000 times the largest coordinate. Critical
        motions leave a family of focal lengths and are not valid to rounding: parallel optical axes (pure translation, turning
        about the optical axis), and optical axes that meet at the same distance from both centres (Sturm 2001; Kahl & Triggs
        1999). Near them noise decides, and by how much `focals_from_fundamental` tells.
        Computed in float64 whatever the dtype. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(6, generator=g), torchsfm.random_poses(2, generator=g).matrix()
        >>> x1, x2 = 800 * torchsfm.project_points(P, X)
        >>> found = torchsfm.motion.relative_6pt_focal(x1, x2)
        >>> found.valid.shape, bool((found.model.f[found.valid] - 800).abs().min() < 1e-3)  # the true one is there
        (torch.Size([15]), True)
    """
    batch = check_tensors(x1=(x1, "6 2"), x2=(x2, "6 2"))
    with torch.no_grad():
        rows = rows_of(batch, x1, x2)
        size = rows[0].shape[-1]
        starts = range(0, max(size, 1), _CHUNK)
        parts = [_solve(*(r[..., i : i + _CHUNK] for r in rows)) for i in starts]
        y, valid = (torch.cat(p) for p in zip(*parts, strict=True))
        y, valid = y.to(x1.dtype).reshape(*batch, _SLOTS, 10), valid.reshape(*batch, _SLOTS)
    if wants_derivative(x1, x2):
        y = attach_implicit(equations, y, for_slots(x1, batch), for_slots(x2, batch), valid=valid)
    return Solutions(FocalMotion(matrices(y[..., :9], 3), y[..., 9]), valid)


def _solve(x1: Float[Tensor, "6 2 batch"], x2: Float[Tensor, "6 2 batch"]) -> tuple[Tensor, Tensor]:
    """(E, f) as (batch, 15, 10) and valid as (batch, 15)."""
    batch = x1.shape[-1]
    largest = torch.maximum(x1.abs().amax((0, 1)), x2.abs().amax((0, 1)))
    fine = torch.isfinite(largest) & (largest > 0)
    unit = torch.where(fine, largest, 1)
    h1, h2 = (torch.cat((torch.where(fine, x / unit, 0.5), torch.ones_like(x[:, :1])), 1) for x in (x1, x2))
    basis, pivot = nullspace_rows((h2[:, :, None] * h1[:, None]).flatten(1, 2))
    fine = fine & (pivot > _INDEPENDENT) & torch.isfinite(basis).all(0).all(0)
    basis = torch.where(fine, basis, torch.eye(9, dtype=basis.dtype, device=basis.device)[6:, :, None])
    basis = _one_corner(basis)
    full = _constraints(basis.view(3, 3, 3, -1))
    M, cubics = _without_determinant(full)
    item, w = _eigenvalues(M, full[2], cubics, fine)
    if len(item):
        own = take_columns(basis, item)
        u, g, *_ = newton_step(_start(M, cubics, item, w), w.sqrt(), own)
        state = newton_step(u, g, own)
        # The few that are not near yet.
        rest = (~(state.step < _NEAR)).nonzero()[:, 0]
        few, later = take_columns(own, rest), Roots(*(v.index_select(-1, rest) for v in state))
        for _ in range(_MORE):
            later = newton_step(later.u, later.g, few)
        u, g, error, _, slope = (v.index_copy(-1, rest, new) for v, new in zip(state, later, strict=True))
        E = combine_rows(with_focal(own, g), u)
        f = 1 / g
        keep = (error < _CONVERGED) & (slope > _ISOLATED) & torch.isfinite(E).all(0) & (f > _RANGE[0]) & (f < _RANGE[1])
        keep = keep & _first_of_its_kind(u, f, item, keep)
        chosen = keep.nonzero()[:, 0]
        item, E, f = item[chosen], E[:, chosen], f[chosen]
        # Numbered anew within each problem.
        slot = torch.arange(len(item), device=item.device) - torch.searchsorted(item, item)
        place = item, slot
        y = torch.cat((E * (2 / combine_rows(E, E)).sqrt(), (f * unit[item])[None]))
    # An empty slot holds diag(1, 1, 0) and 1.
    out = torch.zeros(batch, _SLOTS, 10, dtype=x1.dtype, device=x1.device)
    out[..., [0, 4, 9]] = 1
    valid = torch.zeros(batch, _SLOTS, dtype=torch.bool, device=x1.device)
    if len(item):
        out[place] = y.mT
        valid[place] = True
    return out, valid


def _one_corner(basis: Float[Tensor, "3 9 batch"]) -> Float[Tensor, "3 9 batch"]:
    """The same space, reflected such that only the last matrix has a corner F33 != 0."""
    corner = basis[:, 8].clone()
    length = combine_rows(corner, corner).sqrt()
    corner[2] = corner[2] + torch.copysign(length, corner[2])
    square = combine_rows(corner, corner)
    factor = 2 * combine_rows(basis, corner[:, None]) / torch.where(square > 0, square, 1)
    return torch.where(length > 0, basis - corner[:, None] * factor, basis)


def _constraints(F: Float[Tensor, "3 3 3 batch"]) -> Float[Tensor, "3 10 10 batch"]:
    """M0, M1, M2 of M(w): rows 2 F Q F'Q F - tr(F Q F'Q) F over 2 and det F, columns the cubic monomials."""
    batch = F.shape[-1]
    out = torch.zeros(3, 10, 10, batch, dtype=F.dtype, device=F.device)
    eye = torch.eye(3, dtype=F.dtype, device=F.device)[:, :, None]
    for i, j in _SQUARES:
        a, b = F[i], F[j]
        # F Q F' = plain + w corner.
        plain = a[:, 0, None] * b[None, :, 0] + a[:, 1, None] * b[None, :, 1]
        corner = a[:, 2, None] * b[None, :, 2]
        minors = a[1, _NEXT] * b[2, _AFTER] - a[1, _AFTER] * b[2, _NEXT]
        if i != j:
            plain, corner = plain + plain.transpose(0, 1), corner + corner.transpose(0, 1)
            minors = minors + b[1, _NEXT] * a[2, _AFTER] - b[1, _AFTER] * a[2, _NEXT]
        # Times Q from the right, minus half the trace.
        zero = torch.zeros_like(plain[:, :2])
        S0, S1, S2 = (
            torch.cat((plain[:, :2], zero[:, :1]), 1),
            torch.cat((corner[:, :2], plain[:, 2:]), 1),
            torch.cat((zero, corner[:, 2:]), 1),
        )
        for power, S in enumerate((S0, S1, S2)):
            S = S - 0.5 * (S[0, 0] + S[1, 1] + S[2, 2]) * eye
            for k in range(3):
                column = _CUBICS.index(tuple(sorted((i, j, k))))
                out[power, :9, column] += combine_rows(S.transpose(0, 1)[:, :, None], F[k][:, None]).flatten(0, 1)
        for k in range(3):
            out[0, 9, _CUBICS.index(tuple(sorted((i, j, k))))] += combine_rows(minors, F[k][0])
    return out


def _without_determinant(M: Float[Tensor, "3 10 10 batch"]) -> tuple[Tensor, Tensor]:
    """The nine other equations for the v with det F = 0: (3, 9, 9, batch), and v by nine coordinates, (10, 9, batch)."""
    row = M[0, 9].clone()
    length = combine_rows(row, row).sqrt()
    row[0] = row[0] + torch.copysign(length, row[0])
    square = combine_rows(row, row)
    # A reflection that leaves of the last equation its first coordinate alone.
    factor = torch.where(square > 0, 2 / torch.where(square > 0, square, 1), 0) * row
    rest = M[:, :9]
    image = combine_rows(rest.permute(2, 0, 1, 3), row)
    basis = torch.eye(10, dtype=M.dtype, device=M.device)[:, 1:, None] - row[:, None] * factor[1:]
    return rest[:, :, 1:] - image[:, :, None] * factor[1:], basis


def _eigenvalues(M: Float[Tensor, "3 9 9 batch"], M2: Tensor, basis: Tensor, fine: Tensor) -> tuple[Tensor, Tensor]:
    """The positive real w, one after the other, and the problem each belongs to."""
    near = M[0] + _SHIFT * M[1] + _SHIFT**2 * M[2]
    slope = M[1] + 2 * _SHIFT * M[2]
    right = torch.cat((slope, M2[:9, _LAST]), 1)
    A, info = torch.linalg.solve_ex(near.permute(2, 0, 1), right.permute(2, 0, 1))
    # v = -o (A1 v + A2 u) and u = o v_last for w = shift + o: eigenvalues 1 / o.
    C = torch.zeros(len(A), 15, 15, dtype=A.dtype, device=A.device)
    C[:, :9] = -A
    C[:, 9:, :9] = basis[_LAST].permute(2, 0, 1)
    fine = fine & (info == 0) & torch.isfinite(A).all(-1).all(-1)
    C = torch.where(fine[:, None, None], C, torch.eye(15, dtype=A.dtype, device=A.device))
    values, ok = eigvals(C)
    size = values.abs()
    real = (values.imag.abs() <= _REAL * size) & (size > 0) & (fine & ok)[:, None]
    offset = 1 / torch.where(real, values, 1)
    # Rounding may make two neighbours a complex pair: one is looked for on either side.
    w = _SHIFT + offset.real + offset.imag
    real = real & (w > _RANGE[1] ** -2) & (w < _RANGE[0] ** -2)
    item, column = real.nonzero().unbind(1)
    return item, w[item, column]


def _start(M: Tensor, basis: Tensor, item: Tensor, w: Float[Tensor, " roots"]) -> Float[Tensor, "3 roots"]:
    """(x, y, z) of length 1 from the null vector of M(w), by eight of its nine rows, each with a share of the ninth."""
    share = torch.tensor([0.7, -0.4, 0.9, 0.5, -0.8, 0.6, -0.5, 0.3], dtype=M.dtype, device=M.device)[:, None, None]
    eight = M[:, :8] + share * M[:, 8:]
    own = take_columns(eight, item)
    vector, _ = nullspace_rows(torch.addcmul(own[0], torch.addcmul(own[1], own[2], w), w))
    m = combine_rows(take_columns(basis, item).unbind(1), vector[0])
    rows = torch.stack([m[index] for index in _TIMES])
    square, best = combine_rows(rows.unbind(1), rows.unbind(1)).max(0)
    return rows.gather(0, best.expand(1, 3, -1))[0] * square.clamp_min(1e-280).rsqrt()


def _first_of_its_kind(u: Tensor, f: Tensor, item: Tensor, keep: Tensor) -> Tensor:
    """Which roots are not the same as an earlier one of their problem: Newton's method may lead two starts to one solution."""
    first = torch.ones_like(keep)
    log = f.clamp_min(1e-30).log()
    for back in range(1, min(_SLOTS + 1, len(item))):
        same = (item[back:] == item[:-back]) & keep[:-back] & ((log[back:] - log[:-back]).abs() < _SAME)
        closeness = (combine_rows(u[:, back:], u[:, :-back])).abs()
        first[back:] &= ~(same & (closeness > 1 - _SAME**2))
    return first
