"""Six rays or more in two calibrated cameras: E without a polynomial to solve (Philip 1998).

The linear equations leave E = x A + y B + z C, with A, B, C the three least singular vectors. The ten cubic equations of an
essential matrix (det E = 0 and 2 E E'E = tr(E E') E) are linear in the ten cubic monomials of (x, y, z), and for points not in
a plane they determine these: (x, y, z) is read off their null vector. Six rays determine E with one equation to spare, so from
there the algebraic error is minimised over the manifold of essential matrices, E = [t]x R.
"""

from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_tensors
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import damped_solve, svd, triangular_factor
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.motion.two_views.epipolar_fit import cofactors
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 1024
"""Problems at a time: their matrices fit the cache."""
_INDEPENDENT = 1e-13
"""Smallest pivot of six normalised linear equations."""
_RANK = 1e-12
"""Size of the second singular value of the cubic system, below which the points lie in a plane."""
_CLEAR = 0.5
"""Largest ratio of its last two singular values: above, nothing tells two solutions apart."""
_STEPS = {True: 3, False: 12}
"""Steps along the manifold for six rays, that fit exactly or are mere hypotheses, and for more."""

# Quadratic and cubic monomials in three variables, as sorted tuples.
_SQUARES = list(combinations_with_replacement(range(3), 2))
_CUBICS: list[tuple[int, ...]] = list(combinations_with_replacement(range(3), 3))
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]
# Where x^3, x^2 y, x^2 z, ... stand: the rows of (x, y, z) times a square.
_TIMES = [[_CUBICS.index(tuple(sorted((i, i, j)))) for j in range(3)] for i in range(3)]


def equations(
    E: Float[Tensor, "*#batch 3 3"],
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    weights: Float[Tensor, "*#batch n"] | None = None,
) -> Float[Tensor, "*batch 16"]:
    """Sixteen equations of rank 9: E is essential, and the algebraic error of unit rays stands still over [w]x E and E [w]x.

    Essential is 2 E E'E = tr(E E') E, and |E|^2 = 2 fixes the scale. With six exact rays the error is 0.
    """
    f1, f2 = (d / (d * d).sum(-1, keepdim=True).sqrt() for d in (d1, d2))
    error = ((f1 @ E.mT) * f2).sum(-1, keepdim=True)
    G = (f2 * (error if weights is None else error * weights[..., None])).mT @ f1
    # The gradient along [w]x E is the skew part of G E', and along E [w]x that of E' G.
    left, right = G @ E.mT, E.mT @ G
    skew = torch.stack([(M - M.mT)[..., i, j] for M in (left, right) for i, j in ((2, 1), (0, 2), (1, 0))], -1)
    S = E @ E.mT
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)
    cubic = (2 * S @ E - trace[..., None, None] * E).flatten(-2)
    gauge = trace[..., None] - 2
    return torch.cat([p.expand(*skew.shape[:-1], p.shape[-1]) for p in (skew, cubic, gauge)], -1)


def essential_6pt(
    d1: Float[Tensor, "*#batch n 3"], d2: Float[Tensor, "*#batch n 3"], *, weights: Float[Tensor, "*#batch n"] | None = None
) -> Solutions[Float[Tensor, "*batch 1 3 3"]]:
    """The essential matrix of at least six rays of points not in a plane, with |E|^2 = 2 (Frobenius).

    It makes the weighted sum of squares of d2' E d1 (unit rays) stand still among essential matrices, near the linear answer.

    Args:
        d1: At least six rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.
        weights: Weight of each squared error, >= 0; 0 means absent, and what stands there is not looked at. None: all 1.

    Returns:
        One slot. Not valid where the rays leave more than one answer: points in a plane (see `motions_from_homography`), no
        baseline, coinciding rays, fewer than six of weight, other critical surfaces; or noise so large that the cubic system
        has no clear null vector; or a ray or weight that counts is not finite. Computed in float64 whatever the dtype.
        Differentiable in all arguments.

    Raises:
        ValueError: Wrong shape, dtype or device, or n < 6.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(6, generator=g), torchsfm.random_poses(generator=g)
        >>> E = torchsfm.motion.essential_6pt(X, pose.transform(X))  # the first camera is the world's origin
        >>> truth = torchsfm.tensors.essential_from_pose(pose.R, pose.t / pose.t.norm())
        >>> E.valid, round(float((E.model[0] * truth).sum().abs() / 2), 6)  # 1: the same up to sign
        (tensor([True]), 1.0)
    """
    check_tensors(d1=(d1, "n>=6 3"), d2=(d2, "n 3"), weights=(weights, "?n"))
    shape = broadcast_shapes(d1.shape[:-1], d2.shape[:-1], d1.shape[:-1] if weights is None else weights.shape)
    batch = shape[:-1]
    with torch.no_grad():
        rays = [d.detach().double().expand(*shape, 3).reshape(-1, shape[-1], 3) for d in (d1, d2)]
        w = rays[0].new_ones(shape) if weights is None else weights.detach().double().expand(shape)
        w = w.reshape(-1, shape[-1])
        starts = range(0, max(len(w), 1), _CHUNK)
        parts = [_solve(*(v[i : i + _CHUNK] for v in (*rays, w))) for i in starts]
        E, valid = (torch.cat(p) for p in zip(*parts, strict=True))
        E, valid = E.to(d1.dtype).reshape(*batch, 1, 3, 3), valid.reshape(*batch, 1)
    given = [v for v in (d1, d2, weights) if v is not None]
    if wants_derivative(*given):
        inputs = [for_slots(d1, batch), for_slots(d2, batch)]
        if weights is not None:
            # Absent rays may hold anything: ones take their place.
            there = (weights > 0)[..., None, :, None]
            inputs = [*(torch.where(there, d, 1) for d in inputs), for_slots(weights, batch, 1)]
        E = attach_implicit(equations, E, *inputs, dims=2, valid=valid)
    return Solutions(E, valid)


def _solve(d1: Tensor, d2: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """E as (batch, 3, 3) and valid as (batch), from rays (batch, n, 3) and weights (batch, n)."""
    good = torch.isfinite(w) & (w >= 0)
    absent = w == 0
    units = []
    for d in (d1, d2):
        largest = d.abs().amax(-1, keepdim=True)
        fine = torch.isfinite(largest) & (largest > 0)
        d = torch.where(fine, d / torch.where(fine, largest, 1), 1)
        units.append(d / (d * d).sum(-1, keepdim=True).sqrt())
        good = good & fine[..., 0]
    fine = (good | absent).all(-1) & ((~absent).sum(-1) >= 6)
    w = torch.where(good & ~absent, w, 0)
    largest = w.amax(-1, keepdim=True)
    root = (w / torch.where(largest > 0, largest, 1)).sqrt()[..., None]
    d1, d2 = units[0], units[1] * root
    A = (d2[..., :, None] * d1[..., None, :]).flatten(-2)
    if A.shape[-2] == 6:
        basis, pivot = nullspace_rows(A.permute(1, 2, 0))
        fine = fine & (pivot > _INDEPENDENT)
    else:
        _, s, Vh, _ = svd(triangular_factor(A)[0] if A.shape[-2] > 9 else A)
        fine = fine & (s[..., 5] > _INDEPENDENT * s[..., 0])
        basis = Vh[..., 6:, :].permute(1, 2, 0)
    fine = fine & torch.isfinite(basis).all(0).all(0)
    eye = torch.eye(9, dtype=A.dtype, device=A.device)[6:, :, None]
    basis = torch.where(fine, basis, eye)
    u, clear = _null_vector(_constraints(basis.view(3, 3, 3, -1)).permute(2, 0, 1))
    E = combine_rows(basis, u).mT.reshape(-1, 3, 3)
    R, t = _descend(E, d1, d2)
    if A.shape[-2] > 7:
        # With noise the third singular vector by itself may be the better start.
        other = _descend(basis[2].mT.reshape(-1, 3, 3), d1, d2)
        better = _cost(*other, d1, d2) < _cost(R, t, d1, d2)
        R, t = torch.where(better[:, None, None], other[0], R), torch.where(better[:, None], other[1], t)
    E = cross_matrix(t) @ R
    valid = fine & clear & torch.isfinite(E).all(-1).all(-1)
    # An empty slot holds diag(1, 1, 0).
    empty = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=E.dtype, device=E.device))
    return torch.where(valid[:, None, None], E, empty), valid


def _constraints(E: Float[Tensor, "3 3 3 batch"]) -> Float[Tensor, "10 10 batch"]:
    """Rows: the entries of (E E' - tr(E E') / 2) E and det E; columns: cubic monomials in the coefficients of the three."""
    columns: list[list[Tensor]] = [[] for _ in _CUBICS]
    for i, j in _SQUARES:
        S = combine_rows(E[i].transpose(0, 1)[:, :, None], E[j].transpose(0, 1)[:, None])
        minors = E[i][1, _NEXT] * E[j][2, _AFTER] - E[i][1, _AFTER] * E[j][2, _NEXT]
        if i != j:
            S = S + S.transpose(0, 1)
            minors = minors + E[j][1, _NEXT] * E[i][2, _AFTER] - E[j][1, _AFTER] * E[i][2, _NEXT]
        half = 0.5 * (S[0, 0] + S[1, 1] + S[2, 2])
        S = S - half * torch.eye(3, dtype=S.dtype, device=S.device)[:, :, None]
        for k in range(3):
            trace = combine_rows(S.transpose(0, 1)[:, :, None], E[k][:, None]).flatten(0, 1)
            det = combine_rows(minors, E[k][0])
            columns[_CUBICS.index(tuple(sorted((i, j, k))))].append(torch.cat((trace, det[None])))
    return torch.stack([add_rows(c) if len(c) > 1 else c[0] for c in columns], 1)


def _null_vector(M: Float[Tensor, "batch 10 10"]) -> tuple[Tensor, Tensor]:
    """(x, y, z) of length 1 from the least singular vector of the cubic system, and whether there is a clear one."""
    u = torch.tensor([1.0, 0.4, -0.6, 0.8, -0.3, 0.9, -0.7, 0.5, 1.1, -0.8], dtype=M.dtype, device=M.device)
    u = v = u[:, None].expand(len(M), 10, 1)
    u, v, least, fine = _inverse_iteration(M, u, v)
    # With the least singular value lifted to 1 the next is the least.
    _, _, after, _ = _inverse_iteration(M + u @ v.mT, v.flip(-2), u.flip(-2))
    clear = fine & (after > _RANK) & (least < _CLEAR * after)
    m = v[..., 0].mT
    rows = torch.stack([m[index] for index in _TIMES])
    square, best = combine_rows(rows.unbind(1), rows.unbind(1)).max(0)
    u = rows.gather(0, best.expand(1, 3, -1))[0] * square.clamp_min(1e-280).rsqrt()
    clear = clear & torch.isfinite(u).all(0)
    return torch.where(clear, u, 1 / 3**0.5), clear


def _inverse_iteration(M: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Left and right vector of the least singular value, the value, and which elements are finite."""
    eye = torch.eye(10, dtype=M.dtype, device=M.device)
    # A pivot that is exactly zero would divide by zero.
    LU, pivots, _ = torch.linalg.lu_factor_ex(M + 1e-18 * eye)
    tiny = LU.diagonal(dim1=-2, dim2=-1) == 0
    LU = LU + 1e-18 * torch.diag_embed(tiny.to(M.dtype))
    ok = torch.isfinite(LU).all(-1).all(-1)
    LU = torch.where(ok[:, None, None], LU, eye)
    for _ in range(2):
        u = torch.linalg.lu_solve(LU, pivots, v, adjoint=True)
        u = u / u.abs().amax(-2, keepdim=True).clamp_min(1e-280)
        v = torch.linalg.lu_solve(LU, pivots, u)
        v = v / v.abs().amax(-2, keepdim=True).clamp_min(1e-280)
    u, v = (x / x.norm(dim=-2, keepdim=True) for x in (u, v))
    value = (M @ v).norm(dim=-2)[:, 0]
    ok = ok & torch.isfinite(u).all(-2)[:, 0] & torch.isfinite(v).all(-2)[:, 0]
    return torch.where(ok[:, None, None], u, eye[:, :1]), torch.where(ok[:, None, None], v, eye[:, :1]), value, ok


def _descend(E: Tensor, d1: Tensor, d2: Tensor) -> tuple[Tensor, Tensor]:
    """R and t of the minimum near E."""
    R, t = _pose(E)
    for _ in range(_STEPS[d1.shape[-2] == 6]):
        R, t = _step(R, t, d1, d2)
    return R, t


def _cost(R: Tensor, t: Tensor, d1: Tensor, d2: Tensor) -> Tensor:
    error: Tensor = (torch.linalg.cross(d1 @ R.mT, d2) @ t[..., None])[..., 0]
    return (error * error).sum(-1)


def _pose(E: Float[Tensor, "batch 3 3"]) -> tuple[Tensor, Tensor]:
    """One of the four poses of a matrix near an essential one (Horn 1990), a rotation to second order."""
    E = E * (2**0.5 / E.flatten(-2).norm(dim=-1)[:, None, None])
    C = cofactors(E)
    best = (C * C).sum(-2).argmax(-1)
    t = C.gather(-1, best[:, None, None].expand(-1, 3, 1))[..., 0]
    t = t / t.norm(dim=-1, keepdim=True).clamp_min(1e-280)
    R = C - cross_matrix(t) @ E
    for _ in range(8):
        R = 1.5 * R - 0.5 * (R @ R.mT @ R)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    # False for NaN too.
    good = ((R @ R.mT - eye).abs().amax((-2, -1)) < 1e-12)[:, None]
    return torch.where(good[..., None], R, eye), torch.where(good, t, eye[2])


def _step(R: Tensor, t: Tensor, d1: Tensor, d2: Tensor) -> tuple[Tensor, Tensor]:
    """A Gauss-Newton step on d2' [t]x R d1 over rotations and directions."""
    y = d1 @ R.mT
    moment = torch.linalg.cross(y, d2)
    error = (moment @ t[..., None])[..., 0]
    turn = (y @ t[..., None]) * d2 - (d2 @ y.mT).diagonal(dim1=-2, dim2=-1)[..., None] * t[:, None]
    J = torch.cat((turn, moment), -1)
    A, b = J.mT @ J, J.mT @ error[..., None]
    # A move along t changes nothing but the length of E: keep it at zero.
    along = torch.cat((torch.zeros_like(t), t), -1)
    A = A + A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * along[..., :, None] * along[..., None, :]
    step = -damped_solve(A, b)[..., 0]
    t = t + step[..., 3:]
    t = t / t.norm(dim=-1, keepdim=True).clamp_min(1e-280)
    # Cayley's rotation, by an angle that agrees to third order.
    half = 0.5 * step[..., :3]
    W = cross_matrix(half)
    return R + (2 / (1 + (half * half).sum(-1)))[:, None, None] * ((W + W @ W) @ R), t
