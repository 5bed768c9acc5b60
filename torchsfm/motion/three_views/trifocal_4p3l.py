"""Four points and three lines in three uncalibrated images: one to three projective reconstructions.

Oskarsson, Zisserman & Astrom ("Minimal projective reconstruction for combinations of points and lines in three views", 2004)
count the solutions. Here the points are the projective basis of space and of every image. Then a camera is [diag(a) | d 1],
four numbers c = (a, d), and the plane of sight of an image line l is c * k with k = (l, l_1 + l_2 + l_3), * entry by entry.
Space may still be stretched along its axes, so that c = 1 for the first camera; u and v are those of the others. The planes of
a line have it in common where k_1, u * k_2 and v * k_3 are dependent: three equations for each line, linear in the twelve
products u_i v_j of different i and j. Nine equations leave three dimensions of them. That the products belong to vectors are
six quadrics, which meet in three points of this plane.
"""

from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import adjugate_3x3, cross, determinant_3x3, nullspace_rows, solve, solve_cubic, svd
from torchsfm.optim import attach_implicit, for_slots, wants_derivative
from torchsfm.tensors import trifocal_from_cameras
from torchsfm.tensors.canonical import canonical_frame
from torchsfm.tensors.transfer import axis_lines

_ROWS, _COLUMNS = zip(*((i, j) for i in range(4) for j in range(4) if i != j), strict=True)
"""The products u_i v_j."""
_PLACE = {pair: k for k, pair in enumerate(zip(_ROWS, _COLUMNS, strict=True))}
_SQUARES = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
_TIMES = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
"""Where the products with each coordinate are among these."""
_PENCIL = ((0.80, 0.36, -0.48), (0.36, 0.48, 0.80))
"""Two coordinates of the plane in which no solution lies at infinity but by chance."""
_FLAT = 1e-9
"""Least weight of a basis point that makes the fourth, in units of the largest, that is not taken for zero."""
_INDEPENDENT = 1e-11
"""Least pivot of the equations, for unit vectors, that is not taken for zero."""
_STEPS = 2
"""Gauss-Newton steps that mend what rounding leaves."""
_MET = 1e-9
"""What may be left of them."""


def equations(
    P: Float[Tensor, "*#batch 3 3 4"], x: Float[Tensor, "*#batch 3 4 2"], l: Float[Tensor, "*#batch 3 3 3"]  # noqa: E741
) -> Float[Tensor, "*batch 43"]:  # fmt: skip
    """The incidences of points and lines, 16 and 9, and the frame: P1 = [I | 0], P2 = [A | e], A'e = 0, |A| = |e| = |P3| = 1.

    Those of a line say that the line transferred from the other images is the first image's.
    """
    P1, P2, P3 = P.unbind(-3)
    T = trifocal_from_cameras(P1, P2, P3)
    h1 = torch.nn.functional.pad(x[..., 0, :, :], (0, 1), value=1.0)
    points = torch.einsum(
        "...ijk,...ni,...naj,...nbk->...nab", T, h1, axis_lines(x[..., 1, :, :]), axis_lines(x[..., 2, :, :])
    ).flatten(-3)
    unit = l / l[..., :2].norm(dim=-1, keepdim=True)
    transferred = torch.einsum("...ijk,...nj,...nk->...ni", T, unit[..., 1, :, :], unit[..., 2, :, :])
    lines = cross(unit[..., 0, :, :], transferred).flatten(-2)
    A, e = P2[..., :3], P2[..., 3]
    first = (P1 - torch.eye(3, 4, dtype=P.dtype, device=P.device)).flatten(-2)
    norms = torch.stack(((A * A).sum((-2, -1)), (e * e).sum(-1), (P3 * P3).sum((-2, -1))), -1) - 1
    frame = torch.cat((first, (e[..., None, :] @ A)[..., 0, :], norms), -1)
    return torch.cat((points, lines, frame.expand(*points.shape[:-1], 18)), -1)


def trifocal_4p3l(
    x: Float[Tensor, "*#batch 3 4 2"], l: Float[Tensor, "*#batch 3 3 3"]  # noqa: E741
) -> Solutions[Float[Tensor, "*batch 3 3 3 4"]]:  # fmt: skip
    """The triplets of projective cameras that see four points and three lines where they are, one to three.

    Computed in float64 whatever the dtype.

    Args:
        x: Four points in three images, in any unit.
        l: Three lines in these, homogeneous, of any scale.

    Returns:
        Three slots of three cameras (*batch, slot, view, 3, 4), P1 = [I | 0], P2 = [A | e] with A'e = 0, |A| = |e| = 1, |P3| =
        1, signs as of `canonical_cameras`. None is valid where points and lines do not determine them (three points on a line
        in an image, lines that coincide, a line through two of the points) or a number is not finite. Where the points are
        in a plane, which the images do not tell, the true cameras are not among the solutions. Differentiable.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(10, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> l = torchsfm.geometry.line_from_points(x[:, 4:7], x[:, 7:])
        >>> found = torchsfm.motion.trifocal_4p3l(x[:, :4], l)
        >>> off = (found.model[found.valid] - torchsfm.tensors.canonical_cameras(P)).abs().amax((-3, -2, -1))
        >>> found.model.shape, bool(off.min() < 1e-6)  # the true one is there
        (torch.Size([3, 3, 3, 4]), True)
    """
    batch = check_tensors(x=(x, "3 4 2"), l=(l, "3 3 3"))
    x, l = x.expand(*batch, 3, 4, 2), l.expand(*batch, 3, 3, 3)  # noqa: E741
    with torch.no_grad():
        P, valid = _solve(x.detach().double().reshape(-1, 3, 4, 2), l.detach().double().reshape(-1, 3, 3, 3))
        P, valid = P.reshape(*batch, 3, 3, 3, 4).to(x.dtype), valid.reshape(*batch, 3)
        valid = valid & P.isfinite().flatten(-3).all(-1)
        # An empty slot holds [I | (1, 0, 0)'] twice.
        empty = torch.eye(3, 4, dtype=P.dtype, device=P.device).repeat(3, 1, 1)
        empty[1:, 0, 3] = 1
        P = torch.where(valid[..., None, None, None], P, empty)
    if wants_derivative(x, l):
        P = attach_implicit(equations, P, *(for_slots(t, batch, 3) for t in (x, l)), dims=3, valid=valid)
    return Solutions(P, valid)


def _solve(x: Tensor, l: Tensor) -> tuple[Tensor, Tensor]:  # noqa: E741
    """Three cameras (n, slot, 3, 3, 4) and which are solutions."""
    fine = x.isfinite().flatten(1).all(-1) & l.isfinite().flatten(1).all(-1) & (l[..., :2] != 0).any(-1).flatten(1).all(-1)
    x = torch.where(
        fine[:, None, None, None], x, torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]], dtype=x.dtype, device=x.device)
    )
    l = torch.where(fine[:, None, None, None], l, 1.0)  # noqa: E741
    H, sound = _bases(x)
    k = _unit(l @ H)
    k = _unit(torch.cat((k, k.sum(-1, keepdim=True)), -1))
    Z, pivot = _products(k)
    u, v, real = _factors(Z)
    for _ in range(_STEPS):
        u, v = _polished(k[:, None], u, v)
    # In an order that does not hang on a basis.
    order = torch.where(real, u[..., 0] * u[..., 1] + v[..., 1] * v[..., 2], torch.inf).argsort(-1)
    real = real.gather(-1, order)
    u, v = (c.gather(1, order[..., None].expand_as(c)) for c in (u, v))
    planes = [k[:, None, 0].expand(-1, 3, -1, -1), *(_unit(c[:, :, None] * k[:, None, i]) for i, c in ((1, u), (2, v)))]
    N = _across(planes[0])
    left = cross(_times(N, planes[1]), _times(N, planes[2])).flatten(2).abs().amax(-1)
    # In the frame of the first camera, which is H [I | 1].
    turned = []
    for i, c in ((1, u), (2, v)):
        M = H[:, None, i] * c[:, :, None, :3]
        e = (H[:, None, i] * c[:, :, 3:, None]).sum(-1) - M.sum(-1)
        A, _ = solve(H[:, None, 0].mT.expand_as(M), M.mT)
        turned.append(torch.cat((A.mT, e[..., None]), -1))
    P = canonical_frame(torch.stack(turned, 2))
    valid = real & (left < _MET) & (fine & sound & (pivot > _INDEPENDENT))[:, None]
    return P, valid & P.isfinite().flatten(2).all(-1)


def _bases(x: Tensor) -> tuple[Tensor, Tensor]:
    """The matrices (n, view, 3, 3) that take the basis of the plane to the four points, and whether all images have one."""
    centre = x.mean(-2, keepdim=True)
    size = (x - centre).abs().amax((-2, -1))[..., None, None]
    size = torch.where(size > 0, size, 1)
    h = torch.nn.functional.pad((x - centre) / size, (0, 1), value=1.0)
    corners = h[..., :3, :].mT
    weights = (adjugate_3x3(corners) @ h[..., 3, :, None])[..., 0]
    least = weights.abs().amin(-1)
    sound = (determinant_3x3(corners).abs() > _FLAT) & (least > _FLAT)
    B = corners * torch.where(sound[..., None], weights, 1.0)[..., None, :]
    top = size * B[..., :2, :] + centre.mT * B[..., 2:, :]
    B = torch.cat((top, B[..., 2:, :]), -2)
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    return torch.where(sound[..., None, None], B, eye), sound.all(-1)


def _products(k: Tensor) -> tuple[Tensor, Tensor]:
    """A basis (n, 12, 3) of the products that the lines leave, and the least pivot of their equations."""
    k1, k2, k3 = k.unbind(1)
    across = _across(k1)
    i, j = list(_ROWS), list(_COLUMNS)
    rows = cross(across[..., i].mT, across[..., j].mT) * (k2[..., i] * k3[..., j])[..., None]
    basis, pivot = nullspace_rows(rows.permute(1, 3, 2, 0).flatten(0, 1).contiguous())
    return basis.permute(2, 1, 0), pivot


def _across(k: Tensor) -> Tensor:
    """Three orthonormal rows (..., 3, 4) across unit vectors."""
    sign = torch.where(k[..., :1] < 0, -1.0, 1.0)
    w = torch.cat((k[..., :1] + sign, k[..., 1:]), -1)
    eye = torch.eye(4, dtype=k.dtype, device=k.device)
    reflection = eye - w[..., :, None] * (2 * w / (w * w).sum(-1, keepdim=True))[..., None, :]
    return reflection[..., 1:, :]


def _times(N: Tensor, v: Tensor) -> Tensor:
    return (N @ v[..., None])[..., 0]


def _polished(k: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """A Gauss-Newton step on the equations of the lines over unit vectors."""
    N = _across(k[..., 0, :, :])
    second, third = (N * k[..., i, :, None, :] for i in (1, 2))
    a, b = _times(second, u[..., None, :]), _times(third, v[..., None, :])
    r = cross(a, b).flatten(-2)
    J = torch.cat((cross(second.mT, b[..., None, :]).mT, cross(a[..., None, :], third.mT).mT), -1).flatten(-3, -2)
    # Lengths stay as they are.
    both = torch.cat((u, v), -1)
    gauge = both[..., :, None] * both[..., None, :]
    gauge = gauge * (torch.arange(8, device=u.device) // 4 == torch.arange(8, device=u.device)[:, None] // 4)
    step, _ = solve(J.mT @ J + gauge, J.mT @ r[..., None])
    moved = both - step[..., 0]
    return _unit(moved[..., :4]), _unit(moved[..., 4:])


def _factors(Z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The unit vectors u and v (n, slot, 4) whose products are combinations of a basis, and which are real."""
    quadrics = []
    for a, b in combinations(range(4), 2):
        c, d = (i for i in range(4) if i not in (a, b))
        form = Z[:, _PLACE[a, c], :, None] * Z[:, _PLACE[b, d], None] - Z[:, _PLACE[a, d], :, None] * Z[:, _PLACE[b, c], None]
        quadrics.append(torch.stack([form[:, i, j] + (form[:, j, i] if i != j else 0) for i, j in _SQUARES], -1))
    # Squares of the common points s span what is left of the quadrics: of the matrices s_i S, S = V D_i W with V = (s ...).
    _, _, right, _ = svd(torch.stack(quadrics, 1))
    left = right[:, 3:].mT
    by_coordinate = torch.stack([left[:, at] for at in _TIMES], 1)
    S, T = (torch.tensor(c, dtype=Z.dtype, device=Z.device) for c in _PENCIL)
    S, T = ((c[:, None, None] * by_coordinate).sum(1) for c in (S, T))
    adjugate_S, adjugate_T = adjugate_3x3(S), adjugate_3x3(T)
    ratio, real = solve_cubic(
        torch.stack(
            (determinant_3x3(S), -(adjugate_S * T.mT).sum((-2, -1)), (adjugate_T * S.mT).sum((-2, -1)), -determinant_3x3(T)), -1
        )
    )
    kernels = adjugate_3x3(S[:, None] - ratio[..., None, None] * T[:, None])
    s = _unit((T[:, None] @ _largest_column(kernels)[..., None])[..., 0])
    X = torch.zeros(*s.shape[:-1], 4, 4, dtype=s.dtype, device=s.device)
    X[..., list(_ROWS), list(_COLUMNS)] = (Z[:, None] @ s[..., None])[..., 0]
    X = X + torch.diag_embed(_diagonal(X))
    v = _unit(_largest_column(X.mT))
    return _unit((X @ v[..., None])[..., 0]), v, real


def _diagonal(X: Tensor) -> Tensor:
    """Of matrices of rank one by the other entries: x_kk x_ij = x_kj x_ik, by least squares."""
    found = []
    for k in range(4):
        i, j = zip(*((i, j) for i in range(4) for j in range(4) if len({i, j, k}) == 3), strict=True)
        over = X[..., list(i), list(j)]
        square = over.square().sum(-1)
        both = (X[..., k, list(j)] * X[..., list(i), k] * over).sum(-1)
        found.append(both / torch.where(square > 0, square, 1))
    return torch.stack(found, -1)


def _largest_column(M: Tensor) -> Tensor:
    at = M.square().sum(-2).argmax(-1)[..., None, None].expand(*M.shape[:-1], 1)
    return M.gather(-1, at)[..., 0]


def _unit(v: Tensor) -> Tensor:
    length = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    return v / torch.where(length > 0, length, 1)
