"""Back substitution, Newton step and pose of essential matrices number by number, as a compiler wants them.

The same formulas stand in `_five_points.py`, `_essential_manifold.py` and `relative_5pt.py` for whole matrices, which takes
fewer operations: those are for eager mode.
"""

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

Numbers = Sequence[Tensor]


def _dot(a: Numbers, b: Numbers) -> Tensor:
    return reduce(torch.add, (x * y for x, y in zip(a, b, strict=True)))


def _cross(a: Numbers, b: Numbers) -> list[Tensor]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _unit(v: Numbers) -> list[Tensor]:
    scale = _dot(v, v).rsqrt()
    return [x * scale for x in v]


def _longest(vectors: Sequence[Numbers]) -> list[Tensor]:
    a, b, c = vectors
    first, second, third = (_dot(v, v) for v in vectors)
    both = torch.maximum(first, second)
    return [torch.where(third > both, z, torch.where(second > first, y, x)) for x, y, z in zip(a, b, c, strict=True)]


def _columns(rows: Sequence[Numbers]) -> list[list[Tensor]]:
    return [list(column) for column in zip(*rows, strict=True)]


def _cofactors(rows: Sequence[Numbers]) -> list[list[Tensor]]:
    return [_cross(rows[1], rows[2]), _cross(rows[2], rows[0]), _cross(rows[0], rows[1])]


def _combined(u: Numbers, basis: Sequence[Numbers]) -> list[list[Tensor]]:
    E = [_dot(u, column) for column in zip(*basis, strict=True)]
    return [E[:3], E[3:6], E[6:]]


def back_substitute(rows: Tensor, s: Tensor, c: Tensor) -> list[Tensor]:
    """The unit (x, y, z, w) for a root."""
    cc, ss = c * c, s * s
    powers = [cc * c, cc * s, ss * c, ss * s]
    matrix = []
    for x in rows.unbind(1):
        k = x.unbind(0)
        matrix.append([_dot(k[:4], powers), _dot(k[4:8], powers), _dot(k[8:12], powers) * c + k[12] * (ss * ss)])
    n = _longest(_cofactors(matrix))
    return _unit([n[0], n[1], s * n[2], c * n[2]])


def polish(u: Numbers, basis: Sequence[Numbers]) -> tuple[list[Tensor], Tensor]:
    """One Newton step on the essential manifold, and the distance from it before."""
    E = _combined(u, basis)
    C = _cofactors(E)
    x, y, z = _unit(_longest(_columns(C)))
    one = torch.copysign(torch.ones_like(z), z)
    b = -1 / (one + z)
    a = x * b
    u1, u2 = (1 + one * a * x, one * a * y, -one * x), (a * y, one + y * y * b, -y)
    columns = _columns(E)
    v1, v2 = [_dot(k, u1) for k in columns], [_dot(k, u2) for k in columns]
    first = [p * q - r * t for p, r in zip(u1, u2, strict=True) for q, t in zip(v1, v2, strict=True)]
    second = [p * t + r * q for p, r in zip(u1, u2, strict=True) for q, t in zip(v1, v2, strict=True)]
    forms, error = [], None
    for normal, share in (([k for row in C for k in row], 2 / 3), (first, 0.5), (second, 0.5)):
        form = [_dot(normal, k) for k in basis]
        value = _dot(form, u) * share
        forms.append([f - value * k for f, k in zip(form, u, strict=True)])
        error = value.abs() if error is None else torch.maximum(error, value.abs())
    p, q, r = forms
    m = {(i, j): p[i] * q[j] - p[j] * q[i] for i in range(4) for j in range(i + 1, 4)}
    new = [
        m[1, 2] * r[3] - m[1, 3] * r[2] + m[2, 3] * r[1],
        m[0, 3] * r[2] - m[0, 2] * r[3] - m[2, 3] * r[0],
        m[0, 1] * r[3] - m[0, 3] * r[1] + m[1, 3] * r[0],
        m[0, 2] * r[1] - m[0, 1] * r[2] - m[1, 2] * r[0],
    ]
    assert error is not None
    return _unit(new), error * 2**0.5


def from_roots(rows: Tensor, s: Tensor, t: Tensor, basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The coordinates, E, and the error before the step."""
    lines = [line.unbind(0) for line in basis.unbind(0)]
    u, error = polish(back_substitute(rows, s, t), lines)
    return torch.stack(u), torch.stack([k for row in _combined(u, lines) for k in row]), error


def starts(
    rows: Tensor, s: Tensor, t: Tensor, basis: Tensor, rays: Tensor, slack: Tensor, limit: float
) -> tuple[Tensor, Tensor]:
    """The coordinates, and whether E is poor or may have five rays in front."""
    u = back_substitute(rows, s, t)
    E = _combined(u, [line.unbind(0) for line in basis.unbind(0)])
    C = [k for row in _cofactors(E) for k in row]
    return torch.stack(u), in_front(E, rays, slack)[1] | ~((4 * _dot(C, C) - 1).abs() < limit)


def polished(u: Tensor, basis: Tensor, rays: Tensor, slack: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coordinates, pose, whether it is in front, and the error before."""
    lines = [line.unbind(0) for line in basis.unbind(0)]
    new, error = polish(u.unbind(0), lines)
    return torch.stack(new), *in_front(_combined(new, lines), rays, slack), error


def in_front(rows: Sequence[Numbers], rays: Tensor, slack: Tensor) -> tuple[Tensor, Tensor]:
    """The pose of E, and whether it has five rays in front."""
    C = _cofactors(rows)
    t = _unit(_longest(_columns(C)))
    T = _columns([_cross(t, column) for column in _columns(rows)])
    C = [[2 * x for x in row] for row in C]
    other = [_dot(column, t) for column in _columns(C)]
    points = []
    for ray in rays.unbind(1):
        d = ray.unbind(0)
        points.append((_dot(other, d[:3]), _dot(t, d[3:]), _dot([_dot(row, d[:3]) for row in T], d[3:])))
    sign = torch.copysign(torch.full_like(slack, 2**0.5), reduce(torch.add, (across for _, _, across in points)))
    depths = []
    for along1, along2, across in points:
        cosine = along1 * along2 + across * sign
        depths += [cosine * along2 - along1, along2 - cosine * along1]
    ahead, behind = reduce(torch.minimum, depths) > -slack, reduce(torch.maximum, depths) < slack
    way = torch.where(ahead, 1.0, -1.0).to(slack.dtype)
    pose = [
        k
        for row, turn, x in zip(C, T, t, strict=True)
        for k in (*(c + sign * s for c, s in zip(row, turn, strict=True)), x * way)
    ]
    return torch.stack(pose), ahead | behind
