"""Orientation and place of a calibrated camera from three lines: one equation of degree eight.

In frames of the camera and the world where `l_1 = e_1` and `V_1 = e_3`, the rotations with `l_1'R V_1 = 0` are `Rx(alpha)
Rz(beta)`, and `l_i'R V_i = 0` is bilinear in (1, cos alpha, sin alpha) and (1, cos beta, sin beta). Two lines give the latter
as a cross product; that it is a point of the unit circle is of degree four in cos and sin of alpha, eight in the tangent of its
half.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.portions import portions
from torchsfm.linalg.real_roots import RootList, real_root_list
from torchsfm.linalg.rows import add_rows, take_columns
from torchsfm.resection.candidate_poses import Candidates, solve_poses
from torchsfm.resection.points_and_lines import Sample
from torchsfm.resection.vector_rows import cross_rows, dot_rows, frame_rows, outer_rows, turned

CONCURRENT = 1e-7
"""Volume that the unit normals of three planes of sight span, at which they meet in a line but for rounding."""
_VAGUE = 1e-6
"""Area that two rows span, below which they are one and the same."""
_CHUNK = 16384
"""Roots at a time: what follows of them stays in the cache."""
_PARALLEL = 1e-3
"""Sine of the angle between lines that are parallel."""


def camera_3l(
    l: Float[Tensor, "*#batch 3 3"],  # noqa: E741
    L: Float[Tensor, "*#batch 3 6"],
) -> Solutions[Float[Tensor, "*batch 8 3 4"]]:
    """The up to eight poses `[R | t]` that see three lines in planes of sight.

    Lines have no depths: what is seen of them tells which poses have it in front. Computed in float64 whatever comes in;
    derivatives by the implicit function theorem. No slot is valid where all lines are parallel, the planes of sight meet in a
    line (concurrent image lines, which leave a shift open), or anything is not finite.

    Args:
        l: Image lines as normals of their planes of sight in the camera frame, `K'l` of a line in pixels; of any scale.
        L: The lines in the world, Pluecker vectors (d, m); what is no line (d'm is not 0) has no solution.

    Returns:
        Eight slots of `cam_from_world` and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(6, generator=g), torchsfm.random_poses(generator=g)
        >>> L = torchsfm.geometry.pluecker_from_points(X[:3], X[3:])  # three lines
        >>> poses = torchsfm.resection.camera_3l(torchsfm.geometry.project_lines(pose.matrix(), L), L)
        >>> bool((poses.model[poses.valid] - pose.matrix()).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        True
    """
    batch = check_tensors(l=(l, "3 3"), L=(L, "3 6"))
    none = l.new_zeros(0, 3)
    return solve_poses(_candidates, 8, batch, none, none, l, L)


def _candidates(s: Sample) -> Iterator[Candidates]:
    l, V = _ordered(s)  # noqa: E741
    # Concurrent image lines: three planes of sight through one line, along which nothing is told.
    l1, l2, l3 = s.l.unbind(1)
    e1 = cross_rows(l2, l3)
    volume = dot_rows(l1, e1)
    edges = torch.stack((e1, cross_rows(l3, l1), cross_rows(l1, l2)), 1)
    edges = edges / torch.where(volume.abs() > CONCURRENT, volume, torch.nan)
    table, roots = _octic(l, V)
    number, vague = roots.slot(), [roots.double]
    for some in portions(max(len(number), 1), _CHUNK, number.device):
        item = roots.item[some]
        R, length = _rotations(take_columns(table, item), roots.s[some], roots.t[some])
        vague.append(item[length < _VAGUE])
        yield _placed(item, number[some], R, take_columns(edges, item), s.of(item))
    again = torch.unique(torch.cat(vague))
    across = cross_rows(*(take_columns(V[:, i], again) for i in (1, 2)))
    again = again[dot_rows(across, across) > _PARALLEL**2]
    if len(again):
        # Solutions that turn the first line alike are double roots, as in scenes that are their own mirror images.
        table, roots = _octic(*(take_columns(v[:, [1, 0, 2]], again) for v in (l, V)))
        R, _ = _rotations(take_columns(table, roots.item), roots.s, roots.t)
        item = again[roots.item]
        yield _placed(item, roots.slot(), R, take_columns(edges, item), s.of(item))._replace(anew=True)


def _placed(item: Tensor, slot: Tensor, R: Tensor, edges: Tensor, s: Sample) -> Candidates:
    """Cameras where the planes of sight pass through the lines; the edges, of these planes, are dual to their normals."""
    normals = turned(R.transpose(0, 1), s.l)
    t = turned(edges, dot_rows(normals, s.A).neg_()[:, None])[:, 0]
    return Candidates(item, slot, R, t, s, normals)


def _octic(l: Float[Tensor, "3 3 n"], V: Float[Tensor, "3 3 n"]) -> tuple[Float[Tensor, "29 n"], RootList]:  # noqa: E741
    """What rotations follow from, and s / t = tan(alpha / 2) of each."""
    (l1, l2, l3), (V1, V2, V3) = l.unbind(1), V.unbind(1)
    # The world's frame has the columns 2, 3, 1 of this one, so that V1 is the third axis.
    camera, (f1, f2, f3) = frame_rows(l1, l2), frame_rows(V1, V2)
    p = [dot_rows(c, l2) for c in camera[:2]], [dot_rows(c, l3) for c in camera]
    q = [dot_rows(f2, V2), dot_rows(f1, V2)], [dot_rows(f, V3) for f in (f2, f3, f1)]
    rows = _two_rows(p, q)
    table = torch.cat((torch.stack(rows), *camera, f2, f3, f1))
    return table, real_root_list(_on_circle(_circle_point(rows)))


def _rotations(table: Float[Tensor, "29 m"], s: Float[Tensor, " m"], t: Float[Tensor, " m"]) -> tuple[Tensor, Tensor]:
    """Rotations (3, 3, m), and how far the two lines are from leaving beta open."""
    size = 1 / (s.square() + t.square())
    cos, sin = (t - s) * (t + s) * size, 2 * s * t * size
    a0, a1, a2, zc, zs, u, uc, us, v, vc, vs = table[:11]
    second = a0 * sin, a1, a2 * cos
    third = [torch.addcmul(c * cos, d, sin) for c, d in ((zc, zs), (uc, us), (vc, vs))]
    third[1] += u
    third[2] += v
    length, cos_b, sin_b = cross_rows(torch.stack(second), torch.stack(third))
    length = torch.copysign((cos_b * cos_b).addcmul_(sin_b, sin_b).sqrt_(), length)
    cos_b, sin_b = cos_b / length, sin_b / length
    # Columns of Rx(alpha) Rz(beta) in the camera's frame.
    x, y, z, *world = table[11:].view(6, 3, -1)
    y, z = (cos * y).addcmul_(sin, z), (cos * z).addcmul_(sin, y, value=-1)
    x, y = (cos_b * x).addcmul_(sin_b, y), (cos_b * y).addcmul_(sin_b, x, value=-1)
    return outer_rows((x, y, z), world), length.abs_()


def _two_rows(p: tuple[list[Tensor], list[Tensor]], q: tuple[list[Tensor], list[Tensor]]) -> list[Tensor]:
    """What (1, cos beta, sin beta) is across: a row of the second line, (a0 sin, a1, a2 cos), and one of the third one.

    A row is (z q3, p1 q1 + y q2, y q1 - p1 q2) with y = p2 cos + p3 sin, z = p3 cos - p2 sin, of alpha; of the second line p3
    and q2 are zero. Of the third line there are the parts in cos and sin of the first number, and the constant and these parts
    of the others.
    """
    (p1, p2), (q1, q3) = p[0], q[0]
    a = [-p2 * q3, p1 * q1, p2 * q1]
    (p1, p2, p3), (q1, q2, q3) = p[1], q[1]
    return [*a, p3 * q3, -p2 * q3, p1 * q1, p2 * q2, p3 * q2, -p1 * q2, p2 * q1, p3 * q1]


def _circle_point(rows: list[Tensor]) -> Tensor:
    """The vector along (1, cos beta, sin beta): three forms of degree four in sin and cos of half alpha, as (3, 5, n)."""
    a0, a1, a2, zc, zs, u, uc, us, v, vc, vs = rows
    zero = torch.zeros_like(a0)
    forms = (
        # 1, cos, sin, cos^2, cos sin, sin^2
        (a1 * v, a1 * vc - a2 * u, a1 * vs, -a2 * uc, -a2 * us, zero),
        (zero, zero, -a0 * v, a2 * zc, a2 * zs - a0 * vc, -a0 * vs),
        (zero, -a1 * zc, a0 * u - a1 * zs, zero, a0 * uc, a0 * us),
    )
    rows = []
    for one, c, s, cc, cs, ss in forms:
        even = one + cc
        rows += [even + c, 2 * (s + cs), 2 * (one - cc) + 4 * ss, 2 * (s - cs), even - c]
    return torch.stack(rows).view(3, 5, -1)


def _on_circle(w: Float[Tensor, "3 5 n"]) -> Float[Tensor, "9 n"]:
    """The form of degree eight that is zero where w is along a point of the unit circle: w1^2 + w2^2 - w0^2."""
    sign = w.new_tensor([-1.0, 1.0, 1.0])[:, None]
    rows = []
    for power in range(9):
        low = max(0, power - 4)
        total = sum(2 * (w[:, i] * w[:, power - i]) for i in range(low, (power + 1) // 2))
        if power % 2 == 0:
            total = total + w[:, power // 2].square()
        rows.append(add_rows(sign * total))
    c = torch.stack(rows)
    return torch.where(c.isfinite().all(0), c, torch.nan)


def _ordered(s: Sample) -> tuple[Tensor, Tensor]:
    """Lines in the order in which that whose direction is least like another one's is first: two of them may be parallel."""
    (a, b), (c, d), (e, f) = [(s.V[:, i], s.V[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    across = [cross_rows(*pair) for pair in ((a, b), (c, d), (e, f))]
    sines = [dot_rows(v, v) for v in across]
    # The least sine of each with the others.
    m1, m2, m3 = sines[0].minimum(sines[1]), sines[0].minimum(sines[2]), sines[1].minimum(sines[2])
    first = torch.where(m3 > torch.maximum(m1, m2), 2, (m2 > m1).long())
    second = torch.where(first < 2, first + 1, 0)
    order = torch.stack((first, second, 3 - first - second))
    l, V = (v.gather(1, order.expand_as(v)) for v in (s.l, s.V))  # noqa: E741
    return l, V
