"""The reprojection error of lines in three views and its Gauss-Newton equations over the cameras, without a line in space.

A line is measured by the two ends of a segment in each image, which need not be ends of the same piece of it. With the cameras
[I | 0], P2 and P3 the segments of the second and third view make planes (n, w) = P'l, and what the first view sees of the line
in both is m = n2 w3 - n3 w2: a line is possible where m passes through both ends h of the first segment, f = h'm = 0. The ends
that meet this nearest to the measured ones are, to first order, away by J'S^-1 f, S = J J', with J the derivative of f by all
twelve coordinates; a few such steps find them. What is measured is the distance of the ends from the lines through these.
Everything is written in rows: one tensor for each coordinate of all lines.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.motion.two_views.epipolar_fit import forms

Rows = Sequence[Tensor]
_TINY = 1e-30
_BLIND = 1e-8
"""Squared slopes, in units of what they are differences of, that are rounding."""
_STEPS = 3
"""Steps towards ends that one line has; for what is near it they are many."""


class Transfer(NamedTuple):
    """What the other two views say of the line in the first.

    Attributes:
        lines: Those of the three views, the first transferred from the others; the other two with unit normals.
        planes: Planes of sight of the second and third view, the normal and the offset of each.
        f: The two forms.
        J: Their derivatives by the coordinates of the ends, view by view: (form, end, coordinate); None where they are 0.
        S: The entries 00, 01, 11 of J J'.
    """

    lines: list[Rows]
    planes: list[tuple[Rows, Tensor]]
    f: Rows
    J: list[list[list[Rows | None]]]
    S: Rows


def squared_line_distance(model: Float[Tensor, "*#batch 2 3 4"], x: Sequence[Rows], steps: int = _STEPS) -> Tensor:
    """The sum of the squared distances of all six ends from the images of one line, the best to first order.

    Args:
        model: The second and third camera.
        x: Four rows for each of three views, the coordinates of both ends.
        steps: Of Gauss-Newton towards ends that one line has.
    """
    moved = _nearest(model, x, steps)
    return _arrived(_squared(moved, x), _transfer(model, moved))


def line_equations(
    model: Float[Tensor, "*#batch 2 3 4"], x: Sequence[Rows]
) -> tuple[Tensor, Float[Tensor, "*batch 2 n"], Float[Tensor, "*batch 24 2 n"]]:
    """The squared distances; two numbers each with the same sum of squares, and their derivatives by the cameras."""
    moved = _nearest(model, x, _STEPS)
    there = _transfer(model, moved)
    f = _forms_at(there, x, moved)
    # Whitened by the Cholesky factor of S.
    first, mixed, second = _factor(there)
    r = torch.stack((f[0] * first, (f[1] - mixed * f[0]) * second), -2)
    (n2, w2), (n3, w3) = there.planes
    entries = []
    for k in range(2):
        h = [moved[0][2 * k], moved[0][2 * k + 1]]
        on2, on3 = (h[0] * n[0] + h[1] * n[1] + n[2] for n in (n2, n3))
        # The point on the first view's ray in the third view's plane, and in the second's.
        X2, X3 = [h[0] * w3, h[1] * w3, w3, -on3], [-h[0] * w2, -h[1] * w2, -w2, on2]
        entries.append([line * X for line, X in ((line, X) for line in there.lines[1] for X in X2)])
        entries[k] += [line * X for line, X in ((line, X) for line in there.lines[2] for X in X3)]
    F = [torch.stack(torch.broadcast_tensors(*e), -2) for e in entries]  # type: ignore[no-untyped-call]
    first, mixed, second = (s[..., None, :] for s in (first, mixed, second))
    J = torch.stack((F[0] * first, (F[1] - mixed * F[0]) * second), -2)
    return _arrived(_squared(moved, x), there), r, J


def _arrived(squared: Tensor, at: Transfer) -> Tensor:
    """Squared distances, with what is missing to a line, to first order, where the steps have not arrived at one."""
    first, mixed, second = _factor(at)
    r0, r1 = at.f[0] * first, (at.f[1] - mixed * at.f[0]) * second
    return (squared + r0 * r0 + r1 * r1).masked_fill(_blind(at), torch.inf)


def _transfer(model: Tensor, x: Sequence[Rows]) -> Transfer:
    lines: list[Rows] = []
    planes: list[tuple[Rows, Tensor]] = []
    for k in range(2):
        line = _line(x[k + 1])
        P = model[..., k, :, :]
        *n, w = forms(P.mT, line)
        lines.append(line)
        planes.append((n, w))
    (n2, w2), (n3, w3) = planes
    m = [a * w3 - b * w2 for a, b in zip(n2, n3, strict=True)]
    one = torch.ones_like(x[0][0])
    f, slopes = [], []
    for k in range(2):
        h = [x[0][2 * k], x[0][2 * k + 1], one]
        f.append(m[0] * h[0] + m[1] * h[1] + m[2])
        on2, on3 = (h[0] * n[0] + h[1] * n[1] + n[2] for n in (n2, n3))
        seen = [forms(model[..., i, :, :3], h) for i in range(2)]
        # Points that the segments of the other two views should pass through.
        through2 = [g * w3 - model[..., 0, i, 3, None] * on3 for i, g in enumerate(seen[0])]
        through3 = [model[..., 1, i, 3, None] * on2 - g * w2 for i, g in enumerate(seen[1])]
        slopes.append((through2, through3))
    J: list[list[list[Rows | None]]] = [[[m[:2], None], [None, m[:2]]]]
    for view in (1, 2):
        # Of g'(a x b) over the length of the segment by a and b: along it they do not move their line.
        a, b = x[view][:2], x[view][2:]
        u, v, _ = lines[view - 1]
        along_a, along_b = ((w[0] * v - w[1] * u) for w in (a, b))
        over = _over_length(x[view])
        J.append([])
        for g in (slopes[k][view - 1] for k in range(2)):
            turned = g[0] * v - g[1] * u
            by_a, by_b = (turned - along_b * g[2]) * over, (along_a * g[2] - turned) * over
            J[-1].append([[by_a * u, by_a * v], [by_b * u, by_b * v]])
    products = []
    for k, i in ((0, 0), (0, 1), (1, 1)):
        total = torch.zeros_like(f[0])
        for view in range(3):
            for one_slope, other in zip(J[view][k], J[view][i], strict=True):
                if one_slope is not None and other is not None:
                    total = total + one_slope[0] * other[0] + one_slope[1] * other[1]
        products.append(total)
    return Transfer([m, *lines], planes, f, J, products)


def _blind(at: Transfer) -> Tensor:
    """Where cameras would agree with any line: those that make one plane of all lines, and what is no segment."""
    (n2, w2), (n3, w3) = at.planes
    # Of the first view's slopes, so that the unit of image coordinates is that of S.
    second, third = (n[0] * n[0] + n[1] * n[1] for n in (n2, n3))
    return ~(at.S[0] + at.S[2] > _BLIND * (second * w3 * w3 + third * w2 * w2))


def _factor(at: Transfer) -> tuple[Tensor, Tensor, Tensor]:
    """What whitens the forms: their multiples, and how much of the first to take from the second."""
    m = at.lines[0]
    own = m[0] * m[0] + m[1] * m[1]
    square = at.S[0].clamp(min=_TINY)
    mixed = at.S[1] / square
    # The ends of the first view are independent of each other.
    rest = torch.maximum(at.S[2] - mixed * at.S[1], own).clamp(min=_TINY)
    return square.rsqrt(), mixed, rest.rsqrt()


def _nearest(model: Tensor, x: Sequence[Rows], steps: int) -> Sequence[Rows]:
    """The ends moved, as little as possible, to where a line is possible."""
    moved = x
    for _ in range(steps):
        at = _transfer(model, moved)
        moved = _moved(x, at, _forms_at(at, x, moved))
    return moved


def _forms_at(at: Transfer, x: Sequence[Rows], moved: Sequence[Rows]) -> list[Tensor]:
    """What the forms would be at the measured ends, if they were as linear as at the moved ones."""
    f = list(at.f)
    if moved is x:
        return f
    for k in range(2):
        for view in range(3):
            for end, slopes in enumerate(at.J[view][k]):
                if slopes is not None:
                    for c in range(2):
                        f[k] = f[k] + slopes[c] * (x[view][2 * end + c] - moved[view][2 * end + c])
    return f


def _moved(x: Sequence[Rows], at: Transfer, f: Rows) -> list[Rows]:
    first, mixed, second = _factor(at)
    b = (f[1] - mixed * f[0]) * second * second
    a = f[0] * first * first - mixed * b
    moved: list[Rows] = []
    for view in range(3):
        rows = []
        for end in range(2):
            for c in range(2):
                shift = None
                for k, multiplier in ((0, a), (1, b)):
                    slopes = at.J[view][k][end]
                    if slopes is not None:
                        shift = slopes[c] * multiplier if shift is None else shift + slopes[c] * multiplier
                assert shift is not None
                rows.append(x[view][2 * end + c] - shift)
        moved.append(rows)
    return moved


def _squared(moved: Sequence[Rows], x: Sequence[Rows]) -> Tensor:
    """The sum of the squared distances of ends from the lines through the moved ones."""
    total = None
    for there, ends in zip(moved, x, strict=True):
        line = _line(there)
        for k in range(2):
            away = line[0] * ends[2 * k] + line[1] * ends[2 * k + 1] + line[2]
            total = away * away if total is None else total + away * away
    assert total is not None
    return total


def _line(ends: Rows) -> Rows:
    """The line through two points, with a unit normal."""
    u, v, s, t = ends
    over = _over_length(ends)
    return [(v - t) * over, (s - u) * over, (u * t - s * v) * over]


def _over_length(ends: Rows) -> Tensor:
    u, v, s, t = ends
    square = (s - u) * (s - u) + (t - v) * (t - v)
    return square.clamp(min=_TINY).rsqrt()
