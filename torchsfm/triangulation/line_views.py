"""Lines in their views: the data in double precision, the lines last, so that each operation is one long pass."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import usable
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.linalg.vectors import cross

_CENTRE = 1e-11
"""Distance of centres, over that from the origin, that is rounding."""


class LineViews(NamedTuple):
    """Segments and cameras of lines, harmless numbers of weight 0 where there is none; two views at least.

    Cameras that all lines share have m = 1, else m = n.
    """

    ends: Float[Tensor, "2 2 v n"]
    """The coordinates x and y of both ends of each segment."""
    P: Float[Tensor, "3 4 v m"]
    """Cameras, the largest number in the left part 1."""
    w: Float[Tensor, "v n"]
    """Weights of the squared distances of both ends."""
    broken: Bool[Tensor, " n"]
    """Whether a wanted observation is not finite."""
    centre: Float[Tensor, "3 v m"]
    """Centres, directions of those at infinity; as plain numbers."""
    near: Bool[Tensor, "v m"]
    """Which centres are finite."""
    handed: Float[Tensor, "v m"]
    """The sign that depths in front have; 0 where the centre is at infinity."""

    @property
    def used(self) -> Tensor:
        """Which views count (v, n)."""
        return self.w > 0

    def detached(self) -> "LineViews":
        """The same numbers, which nothing is differentiated by."""
        return LineViews(*(t.detach() for t in self))

    def moved(self, origin: Tensor, unit: Tensor) -> Tensor:
        """The cameras (3, 4, v, n) for points `(X - origin) / unit`, the largest number of each 1."""
        M, p = self.P[:, :3], self.P[:, 3:]
        P = torch.cat((M * unit, applied(M, origin)[:, None] + p), 1)
        return P / P.detach().abs().amax((0, 1)).clamp_min(1e-300)

    def some(self, at: Tensor) -> "LineViews":
        """The views of some lines."""
        n = self.w.shape[-1]
        return LineViews(*(t if t.shape[-1] != n else t.index_select(-1, at) for t in self))

    def by_line(self) -> "ByLine":
        """The views of all lines, the lines first."""
        ends, P, w, _, centre, near, _ = (t.expand(*t.shape[:-1], self.w.shape[-1]) for t in self)
        return ByLine(ends.permute(3, 2, 1, 0), P.permute(3, 2, 0, 1), w.mT, centre.permute(2, 1, 0), near.mT)


class ByLine(NamedTuple):
    """Some of `LineViews`, the lines first."""

    ends: Float[Tensor, "n v 2 2"]
    """Two image points of each segment."""
    P: Float[Tensor, "n v 3 4"]
    w: Float[Tensor, "n v"]
    centre: Float[Tensor, "n v 3"]
    near: Bool[Tensor, "n v"]

    @property
    def used(self) -> Tensor:
        """Which views count."""
        return self.w > 0


def observe(l: Tensor, P: Tensor, visible: Tensor | None, weights: Tensor | None) -> LineViews:  # noqa: E741
    """Lay out l (3, v, n) or x and y of both ends (2, 2, v, n), P (3, 4, v, m), visible and weights (v, n)."""
    P, l = P.double(), l.double()  # noqa: E741
    good = _all(usable(P).flatten(0, 1))
    P = torch.where(good, P, torch.eye(3, 4, dtype=P.dtype, device=P.device)[:, :, None, None])
    size = P.detach().abs()
    size = torch.maximum(size[:, :3].amax((0, 1)), 1e-30 * size[:, 3].amax(0))
    P = P / torch.where(size > 0, size, 1.0)
    if l.ndim == 3:
        sound = _all(usable(l))
        ends = _points_of(torch.where(sound, l, l.new_tensor([1.0, 0.0, 0.0])[:, None, None]), P)
    else:
        sound = _all(usable(l).flatten(0, 1))
        ends = l
    sound = good & sound
    # A segment of one point is a point on the line, and no line.
    apart = (ends[0, 0] != ends[0, 1]) | (ends[1, 0] != ends[1, 1])
    w = torch.ones_like(ends[0, 0]) if weights is None else weights.double()
    wanted = torch.ones_like(sound) if visible is None else visible
    if weights is not None:
        wanted = wanted & (w.detach() != 0)
        sound = sound & usable(w) & (w.detach() >= 0)
    use = wanted & sound & apart
    if not bool(use.all()):
        harmless = ends.new_tensor([[0.0, 1.0], [0.0, 0.0]])[:, :, None, None]
        ends, w = torch.where(use, ends, harmless), torch.where(use, w, 0.0)
    return LineViews(ends, P, w, (wanted & ~sound).any(0), *_centres(P.detach()))


def _centres(P: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centres (3, v, m), directions of centres at infinity; which are finite; and the sign of depths."""
    (a, b, c), p = P[:, :3], P[:, 3]
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    det = combine_rows(a, bc)
    size = _length(a) * _length(b) * _length(c)
    finite = det.abs() > 1e-13 * size
    centre = -(bc * p[0] + ca * p[1] + ab * p[2])
    length = _length(centre).clamp_min(1e-300)
    return centre / torch.where(finite, det, length), finite, torch.where(finite, torch.sign(det), 0.0)


def _points_of(l: Tensor, P: Tensor) -> Tensor:  # noqa: E741
    """Two points on image lines, a focal length to each side of the foot of the principal point."""
    M = P[:, :3].detach()
    square = combine_rows(M[2], M[2])
    affine = square <= 1e-24
    third = M[2] / torch.where(affine, 1.0, square)
    middle = torch.where(affine, 0.0, torch.stack([combine_rows(row, third) for row in M[:2].unbind(0)]))
    outer = M[:2] - middle[:, None] * M[2]
    focal = (outer.square().flatten(0, 1).sum(0) / torch.where(affine, 2.0, 2 * square)).sqrt()
    size = combine_rows(l[:2], l[:2])
    infinite = size.detach() <= 1e-24 * l.detach()[2].square()
    size = torch.where(infinite, 1.0, size)
    foot = middle - (l[0] * middle[0] + l[1] * middle[1] + l[2]) / size * l[:2]
    along = torch.stack((l[1], -l[0])) * size.rsqrt() * focal
    along = torch.where(infinite, 0.0, along)
    return torch.stack((foot - along, foot + along), 1)


def frame_of_centres(views: LineViews) -> tuple[Tensor, Tensor, Tensor]:
    """The mean (3, n) of the centres, their root-mean-square distance (n) from it, 1 where they are one, and where that is."""
    counted = (views.near & views.used).to(views.w.dtype)
    number = add_rows(counted).clamp_min(1)
    mean = torch.stack([combine_rows(row, counted) / number for row in views.centre.unbind(0)])
    away = views.centre - mean[:, None]
    spread = (combine_rows(combine_rows(away, away), counted) / number).sqrt()
    reach = (combine_rows(combine_rows(views.centre, views.centre), counted) / number).sqrt()
    apart = spread > _CENTRE * reach
    one = ~apart
    if not bool(views.near.all()):
        one = one & ~(views.used & ~views.near).any(0)
    return mean, torch.where(apart, spread, 1.0), one


def applied(M: Tensor, v: Tensor, out: Tensor | None = None) -> Tensor:
    """Matrices (3, 3, v, m) of views times vectors (3, n) of lines: (3, v, n)."""
    return torch.mul(M[:, 0], v[0], out=out).addcmul_(M[:, 1], v[1]).addcmul_(M[:, 2], v[2])


def _all(mask: Tensor) -> Tensor:
    """Where all rows are True; `Tensor.all` takes several times as long."""
    first, *rest = mask.unbind(0)
    for row in rest:
        first = first & row
    return first


def _length(v: Tensor) -> Tensor:
    return combine_rows(v, v).sqrt()
