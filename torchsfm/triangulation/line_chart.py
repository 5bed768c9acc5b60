"""Lines near one that is known, by four numbers, and the distances of their segments from them.

About a line stands a frame: the origin on the line, amid what is seen of it; the third axis along it; the unit the distance of
the cameras. Lines (a, b, p, q) go through (a, b, 0) in the direction (p, q, 1). A camera is then four image points: of the axes
and of the origin. The image of a line goes through those of (a, b, 0) and of (p, q, 1), each a sum of three.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.linalg.vectors import across
from torchsfm.triangulation.line_views import LineViews, applied

Rows = tuple[Tensor, ...]
Parameters = tuple[Tensor, Tensor, Tensor, Tensor]
"""a, b, p and q, (n) each."""


class Chart(NamedTuple):
    """The frames."""

    origin: Float[Tensor, "3 n"]
    """In the world."""
    axes: Float[Tensor, "3 3 n"]
    """Three unit vectors, one after the other."""
    unit: Float[Tensor, "n"]
    """In the world's units."""

    def cameras(self, views: LineViews) -> Tensor:
        """The images (4, 3, v, n) of the axes and of the origin."""
        M, p = views.P[:, :3], views.P[:, 3]
        found = p.new_empty(4, *M.shape[1:-1], len(self.unit))
        for axis, image in zip((*self.axes.unbind(0), self.origin), found.unbind(0), strict=True):
            applied(M, axis, out=image)
        found[3].add_(p).div_(self.unit)
        return found

    def line(self, x: Parameters) -> tuple[Tensor, Tensor]:
        """A point of each line (3, n), in the world, and its direction (3, n), of any length."""
        u, v, d = self.axes.unbind(0)
        return self.origin + self.unit * (x[0] * u + x[1] * v), torch.addcmul(torch.addcmul(d, x[2], u), x[3], v)

    def some(self, at: Tensor) -> "Chart":
        """The frames of some lines."""
        return Chart(*(t.index_select(-1, at) for t in self))


def chart_about(origin: Tensor, d: Tensor, unit: Tensor) -> Chart:
    """The frames of lines through origins (3, n) in unit directions d (3, n)."""
    return Chart(origin, torch.stack((*across(d), d)), unit)


class Images(NamedTuple):
    """Lines in their views, and where on them the ends of their segments are seen.

    The place of an end is the point of the line whose image is its foot on the line's image. Of a line through X in the
    direction d it is X + t d, with homogeneous coordinates (scale, scale t) by which its image has a third coordinate of 1.
    """

    line: tuple[Tensor, Tensor, Tensor]
    """The image lines, of unit normal, (v, n) each; zero where there is no view."""
    r: Float[Tensor, "2 v n"]
    """Signed distances of both ends, in pixels."""
    scale: Float[Tensor, "2 v n"]
    moved: Float[Tensor, "2 v n"]
    """scale t"""
    along: Float[Tensor, "2 v n"]
    """The feet's places in the image, along its line."""
    inverse: Float[Tensor, "v n"]
    """One over the length of the normal that the images of X and d give."""


def images(a: Tensor | Rows, c: Tensor | Rows, ends: Tensor, used: Tensor) -> Images:
    """The images of lines through points X of which a (3, v, n) are the images, in directions d of which c (3, v, n) are.

    Args:
        a: Images of points.
        c: Images of directions.
        ends: The ends (2, 2, v, n) of segments.
        used: 1 for views that count, 0 for others (v, n).
    """
    (a1, a2, a3), (c1, c2, c3) = a, c
    l1, l2 = difference(a2, c3, a3, c2), difference(a3, c1, a1, c3)
    # Not so small that products of a few of these overflow.
    inverse = torch.addcmul(l1 * l1, l2, l2).clamp_min(1e-60).rsqrt() * used
    n1, n2, n3 = l1 * inverse, l2 * inverse, difference(a1, c2, a2, c1) * inverse
    x, y = ends.unbind(0)
    r = torch.addcmul(torch.addcmul(n3, x, n1), y, n2)
    along = difference(y, n1, x, n2)
    scale = torch.addcmul(difference(c1, n2, c2, n1), along, c3) * inverse
    moved = torch.addcmul(difference(a2, n1, a1, n2), along, a3, value=-1) * inverse
    return Images((n1, n2, n3), r, scale, moved, along, inverse)


def places(found: Images, c: Tensor) -> tuple[Tensor, Tensor]:
    """The t of all ends (2, v, n), 0 where the ray to an end does not meet the line, and where it does."""
    bound = torch.addcmul(torch.ones_like(found.along), found.along, found.along)
    bound = bound * (1e-18 * combine_rows(c, c) * found.inverse.square())
    meets = found.scale.square() > bound
    return torch.where(meets, found.moved / torch.where(meets, found.scale, 1.0), 0.0), meets


class Place(NamedTuple):
    """Where the segments of a line are."""

    middle: Float[Tensor, "n"]
    """Of all ends, from the point of the line that was given, along it."""
    unit: Float[Tensor, "n"]
    """The root-mean-square distance of the cameras from there, 1 where there is none."""
    depth: Float[Tensor, "v n"]
    """The third coordinate of the image of the middle of each segment."""


def place_of(views: LineViews, point: Tensor, d: Tensor, used: Tensor) -> Place:
    """Where the segments of lines through points (3, n) in unit directions d (3, n) are, by the views that are used (v, n)."""
    M, p = views.P[:, :3], views.P[:, 3]
    a, c = applied(M, point) + p, applied(M, d)
    t, meets = places(images(a, c, views.ends, used), c)
    counted = meets * used
    middle = add_rows(add_rows(t * counted)) / add_rows(add_rows(counted)).clamp_min(1)
    near = views.near * used
    away = views.centre - (point + middle * d)[:, None]
    unit = (combine_rows(combine_rows(away, away), near) / add_rows(near).clamp_min(1)).sqrt()
    unit = torch.where((unit > 0) & (unit < 1e100), unit, 1.0)
    return Place(middle, unit, torch.addcmul(a[2], add_rows(t), c[2], value=0.5))


def difference(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """`a b - c d`."""
    return torch.addcmul(a * b, c, d, value=-1)
