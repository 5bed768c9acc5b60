"""Six points in three uncalibrated images: the one or three projective reconstructions (Quan 1995; HZ 20.2.4).

Four of the points are the projective basis of space and of every image. Then each camera is [diag(a) | d 1] with four
unknowns, and the fifth point (1, 1, 1, 1) and the sixth X exchange roles with the cameras (Carlsson & Weinshall 1998): the
images y5 and y6 of one view satisfy y6' G y5 = 0 with one matrix G = -[p]x diag(X), p = X_4 - X_1..3, for all views. G has a
zero diagonal and entries that sum to zero; three views leave s G0 + t G1, and det G = 0 is a cubic. All arithmetic has the
batch in the last dimension.
"""

from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.portions import portions
from torchsfm.linalg.rows import combine_rows
from torchsfm.motion.three_views.dual_sixth_point import null_3x3, sixth_point
from torchsfm.optim import attach_implicit, for_slots, wants_derivative
from torchsfm.tensors import trifocal_from_cameras
from torchsfm.tensors.transfer import axis_lines

_CHUNK = 2048
"""Problems at a time: their matrices fit the cache."""
_INDEPENDENT = 1e-12
"""Smallest pivot of the normalised equations that is not taken for zero."""
_FLAT = 1e-9
"""Smallest area of a triangle of basis points, in a square of side 2."""
_PAIRS = list(combinations(range(6), 2))
_TRIPLES = list(combinations(range(6), 3))
_BASES = list(combinations(range(6), 4))
_ORDERS = [[*basis, *(set(range(6)) - set(basis))] for basis in _BASES]
_SIDES = [[_PAIRS.index(pair) for pair in ((i, j), (j, k), (i, k))] for i, j, k in _TRIPLES]
_FACES = [_TRIPLES.index(face) for basis in _BASES for face in combinations(basis, 3)]


def equations(P: Float[Tensor, "*#batch 3 3 4"], x: Float[Tensor, "*#batch 3 6 2"]) -> Float[Tensor, "*batch 42"]:
    """The incidence of the images of each point and the frame: P1 = [I | 0], P2 = [A | e] with A'e = 0, |A| = |e| = |P3| = 1.

    The incidence of each point is written with the vertical and horizontal lines through its second and third image. Of the
    24 + 18 equations 18 + 18 are independent, as many as there are unknowns.
    """
    P1, P2, P3 = P.unbind(-3)
    T = trifocal_from_cameras(P1, P2, P3)
    x1, x2, x3 = x.unbind(-3)
    h1 = torch.nn.functional.pad(x1, (0, 1), value=1.0)
    points = torch.einsum("...ijk,...ni,...naj,...nbk->...nab", T, h1, axis_lines(x2), axis_lines(x3)).flatten(-3)
    A, e = P2[..., :3], P2[..., 3]
    first = (P1 - torch.eye(3, 4, dtype=P.dtype, device=P.device)).flatten(-2)
    norms = torch.stack(((A * A).sum((-2, -1)), (e * e).sum(-1), (P3 * P3).sum((-2, -1))), -1) - 1
    frame = torch.cat((first, (e[..., None, :] @ A)[..., 0, :], norms), -1)
    return torch.cat((points, frame.expand(*points.shape[:-1], 18)), -1)


def trifocal_6pt(x: Float[Tensor, "*batch 3 6 2"]) -> Solutions[Float[Tensor, "*batch 3 3 3 4"]]:
    """The one or three triplets of projective cameras that see six points where they are.

    Which four points serve as the basis is chosen by their images, those that are farthest from collinear. Computed in float64
    whatever the dtype.

    Args:
        x: Six points in three images, in any unit.

    Returns:
        Three slots of three cameras (*batch, slot, view, 3, 4), P1 = [I | 0], P2 = [A | e] with A'e = 0, |A| = |e| = 1, |P3| =
        1, signs as of `canonical_cameras`. None is valid where the points do not determine them (coinciding points, or so few
        in general position that any four of them have three on a line in an image; six points in a plane) or a coordinate is
        not finite. Where the four basis points are in a plane, which the images do not tell, the true cameras are not among
        the solutions. Differentiable.

    Raises:
        ValueError: Wrong shape or dtype.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(6, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> found = torchsfm.motion.trifocal_6pt(torchsfm.project_points(P, X))
        >>> off = (found.model[found.valid] - torchsfm.tensors.canonical_cameras(P)).abs().amax((-3, -2, -1))
        >>> found.model.shape, bool(off.min() < 1e-6)  # the true one is there
        (torch.Size([3, 3, 3, 4]), True)
    """
    batch = check_tensors(x=(x, "3 6 2"))
    with torch.no_grad():
        rows = x.detach().double().reshape(-1, 3, 6, 2).permute(2, 1, 3, 0)
        chunks = [_solve(rows[..., some]) for some in portions(max(rows.shape[-1], 1), _CHUNK, x.device)]
        P, good = (torch.cat(parts, -1) for parts in zip(*chunks, strict=True))
        P = P.permute(4, 1, 0, 2, 3).reshape(*batch, 3, 2, 3, 4)
        valid = good.mT.reshape(*batch, 3)
        eye = torch.eye(3, 4, dtype=P.dtype, device=P.device).expand(*batch, 3, 1, 3, 4)
        P = torch.cat((eye, P), -3).to(x.dtype)
    if wants_derivative(x):
        P = attach_implicit(equations, P, for_slots(x, batch, 3), dims=3, valid=valid)
    return Solutions(P, valid)


def _solve(x: Float[Tensor, "6 3 2 batch"]) -> tuple[Tensor, Tensor]:
    """The second and third camera as (2, slot, 3, 4, batch), and valid as (slot, batch)."""
    h, centre, scale, fine = _normalised(x)
    h, area = _reordered(h)
    x1, x2, x3, x4, x5, x6 = h.unbind(0)
    lines = torch.stack((_join(x2, x3), _join(x3, x1), _join(x1, x2)))
    # Coordinates in the basis of the image: (coordinate, view, batch).
    m4, m5, m6 = (lines[:, :, 0] * p[:, 0] + lines[:, :, 1] * p[:, 1] + lines[:, :, 2] for p in (x4, x5, x6))
    m4 = torch.where(fine & (area > _FLAT), m4, 1)
    y5, y6 = _unit(m5 / m4), _unit(m6 / m4)
    X, real, pivot = sixth_point(y5, y6)
    # a y-coordinate of each camera and d: (slot, view, batch) each.
    y5, y6 = y5[:, None], y6[:, None]
    system = [(y5[i] * X[i][:, None], (X[3] - X[i])[:, None], -y6[i]) for i in range(3)]
    s, d, _ = null_3x3(system)
    a = torch.stack([s * y5[i] - d for i in range(3)])
    # The camera's columns are x_i times these: (column, slot, view, batch).
    weights = torch.cat((a * m4[:, None], (d * (m4[0] + m4[1] + m4[2]))[None]))
    A, e = _second_and_third(weights, a, d, h, lines, m4)
    P = _canonical(*_denormalised(A, e, centre, scale))
    good = fine.all(0) & (area > _FLAT) & (pivot > _INDEPENDENT)
    valid = real & good & torch.isfinite(P).flatten(2, 3).all(2).all(0)
    # An empty slot holds [I | (1, 0, 0)'] twice.
    empty = torch.eye(3, 4, dtype=P.dtype, device=P.device)[..., None].clone()
    empty[0, 3] = 1
    return torch.where(valid[:, None, None], P, empty), valid


def _normalised(x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points with |u|, |v| <= 1 in each view; centre, scale, and which are finite and not a point: (view, batch)."""
    low, high = x.amin(0), x.amax(0)
    centre, size = 0.5 * (low + high), 0.5 * (high - low).amax(1)
    fine = torch.isfinite(size) & (size > 0)
    scale = 1 / torch.where(fine, size, 1)
    return torch.where(fine[:, None], (x - centre) * scale[:, None], 0), torch.where(fine[:, None], centre, 0), scale, fine


def _reordered(h: Tensor) -> tuple[Tensor, Tensor]:
    """The points with the best basis first, and the smallest of the areas of its triangles."""
    sides, faces, orders = (torch.tensor(t, device=h.device) for t in (_SIDES, _FACES, _ORDERS))
    first, second = torch.tensor(_PAIRS, device=h.device).unbind(1)
    p, q = h[first], h[second]
    c = p[:, :, 0] * q[:, :, 1] - p[:, :, 1] * q[:, :, 0]
    areas = (c[sides[:, 0]] + c[sides[:, 1]] - c[sides[:, 2]]).abs().amin(1)
    area, best = areas[faces].view(15, 4, -1).amin(1).max(0)
    order = orders[best].mT
    return h.gather(0, order[:, None, None].expand(h.shape)), area


def _join(p: Tensor, q: Tensor) -> Tensor:
    """The line through points (view, 2, batch)."""
    (a, b), (c, d) = p.unbind(1), q.unbind(1)
    return torch.stack((b - d, c - a, a * d - b * c), 1)


def _unit(y: Tensor) -> Tensor:
    return y * (1 / y.abs().amax(0).clamp_min(1e-300))


def _second_and_third(
    weights: Tensor, a: Tensor, d: Tensor, h: Tensor, lines: Tensor, m4: Tensor
) -> tuple[list[list[Tensor]], list[Tensor]]:
    """The cameras [A | e] of views 2 and 3 in a frame where the first is [I | 0]: entries (slot, 2, batch), normalised images.

    The first camera has the columns w_i x_i. Its inverse on the plane of the first three basis points has the rows l_i / w_i,
    its centre is (1 / a, -1 / d).
    """
    one = torch.ones_like(h[:, 1:, 0])
    x = [[h[k, 1:, 0], h[k, 1:, 1], one[k]] for k in range(4)]
    ratio = [weights[i, :, 1:] / weights[i, :, :1] for i in range(3)]
    A = []
    for row in range(3):
        side = [ratio[i] * x[i][row] for i in range(3)]
        A.append([combine_rows(side, [lines[i, 0, column] for i in range(3)]) for column in range(3)])
    centre = [1 / a[i, :, :1] for i in range(3)]
    last = -1 / d[:, :1]
    e = []
    for row in range(3):
        terms = [weights[i, :, 1:] * x[i][row] for i in range(3)]
        e.append(combine_rows([*terms, weights[3, :, 1:] * x[3][row]], [*centre, last]))
    return A, e


def _denormalised(
    A: list[list[Tensor]], e: list[Tensor], centre: Tensor, scale: Tensor
) -> tuple[list[list[Tensor]], list[Tensor]]:
    """T^-1 A T1 and T^-1 e, with the similarities T of the images."""
    rows = [[*A[k], e[k]] for k in range(3)]
    s, c = 1 / scale[1:], centre[1:]
    rows[0] = [s * v + c[:, 0] * w for v, w in zip(rows[0], rows[2], strict=True)]
    rows[1] = [s * v + c[:, 1] * w for v, w in zip(rows[1], rows[2], strict=True)]
    t, b = scale[0], centre[0]
    left = [[t * v[0], t * v[1], v[2] - t * (b[0] * v[0] + b[1] * v[1])] for v in rows]
    return left, [v[3] for v in rows]


def _canonical(A: list[list[Tensor]], e: list[Tensor]) -> Tensor:
    """The frame of `canonical_cameras`, as (view, slot, 3, 4, batch)."""
    # Moderate numbers first, so that squares neither vanish nor overflow.
    e = [v / torch.stack(e).abs().amax(0).amax(1, keepdim=True) for v in e]
    second = [v[:, :1] for v in e]
    square = combine_rows(second, second)
    w = [combine_rows(second, [A[row][column][:, :1] for row in range(3)]) / square for column in range(3)]
    A = [[A[row][column] - e[row] * w[column] for column in range(3)] for row in range(3)]
    flat = [v for row in A for v in row]
    size = combine_rows([v[:, :1] for v in flat], [v[:, :1] for v in flat]).sqrt()
    stretch = size / square.sqrt()
    e = [v * stretch for v in e]
    both = [*flat, *e]
    norm = torch.cat((size, combine_rows([v[:, 1:] for v in both], [v[:, 1:] for v in both]).sqrt()), 1)
    left = torch.stack(flat)
    norm = torch.copysign(norm, _of_largest(left))
    right = torch.stack(e) / norm
    left = left / norm
    right = right * torch.copysign(torch.ones_like(norm[:, :1]), _of_largest(right[:, :, :1]))
    P = torch.cat((left.view(3, 3, *left.shape[1:]), right[:, None]), 1)
    return P.permute(3, 2, 0, 1, 4)


def _of_largest(v: Tensor) -> Tensor:
    """The entry of largest absolute value along the first dimension."""
    return v.gather(0, v.abs().argmax(0, keepdim=True))[0]
