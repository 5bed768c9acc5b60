"""Where the fit of a line starts: the line through the two points that are least off all planes of sight.

Planes are four-vectors (n, w), and those through a line are combinations of two. The two largest axes of all planes are found
from two that are far apart, by the power method: a step takes what is off by the ratio of what noise adds to what the planes
are apart, squared, which is next to nothing. One step is for the line, the next for the line with the planes weighed by how
far away it is.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchsfm.linalg.rows import combine_rows
from torchsfm.linalg.vectors import cross
from torchsfm.triangulation.line_chart import Chart, chart_about, difference, place_of
from torchsfm.triangulation.line_views import LineViews, frame_of_centres

SAME = 1e-7
"""Angle between planes below which they are one but for rounding."""


class Start(NamedTuple):
    """Frames of the lines that the fit starts with."""

    chart: Chart
    lost: Tensor
    """Where rounding tells that there is no line (n)."""
    angle: Tensor
    """The angle at which the planes of sight meet (n), radians."""


def start(views: LineViews) -> Start:
    """The lines that the fit starts with."""
    used = views.used.to(views.w.dtype)
    mean, spread, one = frame_of_centres(views)
    planes, square = _planes(views, mean, spread, used)
    axes = _power(planes, views.w, *_apart(planes, views.w))[:2]
    d, foot = _line_of(*axes)
    # A plane misses a point by more where it is farther away: once more, with what is known now.
    place = place_of(views, mean + spread * foot, d, used)
    origin = foot + place.middle / spread * d
    third = views.P[2, :3]
    least = 1e-6 * combine_rows(third, third) * place.unit.square()
    weight = views.w * square / torch.maximum(place.depth.square(), least).clamp_min(1e-200)
    weight = weight / weight.amax(0).clamp_min(1e-300)
    z1, z2, largest, second = _power(planes, weight, *axes)
    d, foot = _line_of(z1, z2)
    chart = chart_about(mean + spread * (foot + d * combine_rows(origin - foot, d)), d, place.unit)
    # Planes of one centre may well meet in different lines, but only through it.
    return Start(chart, (second <= SAME * largest) | one, _angle(planes, chart))


def _angle(planes: Tensor, chart: Chart) -> Tensor:
    """The angle (n) at which planes meet around the third axes of charts: of two their own, of more a kind of mean.

    Turned about its line, a plane is the same after half a turn: so it is twice the angles of their normals that are averaged.
    """
    a, b = (combine_rows(planes[:3], axis[:, None]) for axis in chart.axes[:2].unbind(0))
    total = combine_rows(a, a) + combine_rows(b, b)
    mean = torch.hypot(combine_rows(a, a) - combine_rows(b, b), 2 * combine_rows(a, b))
    return 2 * torch.atan((total - mean).clamp_min(0).div((total + mean).clamp_min(1e-300)).sqrt())


def _planes(views: LineViews, mean: Tensor, spread: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """The planes of sight (4, v, n) for points `(X - mean) / spread`, of unit normal, zero where not used.

    The distance of a point from one, times the root of what comes second (v, n), over the third coordinate of its image, is
    the distance of its image from the segment.
    """
    (x1, x2), (y1, y2) = views.ends
    l1, l2, l3 = y1 - y2, x2 - x1, difference(x1, y2, x2, y1)
    plane = torch.addcmul(torch.addcmul(views.P[0] * l1, views.P[1], l2), views.P[2], l3)
    n = plane[:3]
    plane[3].add_(combine_rows(n, mean[:, None])).div_(spread)
    square = combine_rows(n, n)
    plane *= square.clamp_min(1e-300).rsqrt() * used
    return plane, square / torch.addcmul(l1 * l1, l2, l2).clamp_min(1e-300)


def _apart(planes: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """The plane (4, n) of the most weight, and what of another one is the farthest from it, both of unit length."""
    first = _largest(planes, w * combine_rows(planes, planes))
    first = first * combine_rows(first, first).clamp_min(1e-300).rsqrt()
    rest = torch.addcmul(planes, first[:, None], combine_rows(planes, first[:, None]), value=-1)
    second = _largest(rest, w * combine_rows(rest, rest))
    return first, second * combine_rows(second, second).clamp_min(1e-300).rsqrt()


def _largest(rows: Tensor, key: Tensor) -> Tensor:
    """Of vectors (4, v, n) that of the largest key (v, n); `argmax` and `gather` take several times as long."""
    found, top = rows[:, 0], key[0]
    for row, new in zip(rows.unbind(1)[1:], key.unbind(0)[1:], strict=True):
        found = torch.where(new > top, row, found)
        top = torch.maximum(top, new)
    return found


def _power(planes: Tensor, weight: Tensor, z1: Tensor, z2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Orthonormal axes (4, n) after a step, and the singular values (n) of the planes along the axes before, largest first."""
    c1, c2 = combine_rows(planes, z1[:, None]), combine_rows(planes, z2[:, None])
    w1, w2 = weight * c1, weight * c2
    each = planes.unbind(1)
    y1, y2 = combine_rows(each, w1), combine_rows(each, w2)
    A11, A12, A22 = combine_rows(w1, c1), combine_rows(w1, c2), combine_rows(w2, c2)
    y1 = y1 * combine_rows(y1, y1).clamp_min(1e-300).rsqrt()
    # Twice: what is left may be small beside what is taken away.
    for _ in range(2):
        y2 = torch.addcmul(y2, y1, combine_rows(y1, y2), value=-1)
    y2 = y2 * combine_rows(y2, y2).clamp_min(1e-300).rsqrt()
    half = torch.hypot(0.5 * (A11 - A22), A12)
    largest = 0.5 * (A11 + A22) + half
    most = largest.clamp_min(1e-300)
    second = difference(A11 / most, A22, A12 / most, A12).clamp_min(0)
    return y1, y2, largest.sqrt(), second.sqrt()


def _line_of(z1: Tensor, z2: Tensor) -> tuple[Tensor, Tensor]:
    """The unit direction (3, n) of the line in which two planes meet, and its point nearest to the origin (3, n)."""
    d = cross(z1[:3], z2[:3])
    moment = z1[3] * z2[:3] - z2[3] * z1[:3]
    square = combine_rows(d, d)
    sound = square > 1e-200
    if not bool(sound.all()):
        # Any line.
        d = torch.where(sound, d, d.new_tensor([[1.0], [0.0], [0.0]]))
        moment = torch.where(sound, moment, d.new_tensor([[0.0], [0.0], [1.0]]))
        square = torch.where(sound, square, 1.0)
    return d * square.rsqrt(), cross(d, moment) / square
