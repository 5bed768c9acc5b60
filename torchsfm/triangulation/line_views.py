"""Lines in their views, one problem a line: the data in double precision, a frame for each, the start and the residuals."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import line_from_points, to_homogeneous
from torchsfm.geometry.line_manifold import line_tangents
from torchsfm.linalg import adjugate_3x3, cross, determinant_3x3, eigh, usable

SAME = 1e-7
"""Angle between planes, and distance of centres over their own size, below which they are one but for rounding."""

_CENTRE = 1e-11
"""Distance of centres, over that from the origin, that is rounding."""
_POINT = 1e-9
"""Length of an image line, over those of the line and of its projection, that is rounding."""
_NOISE = 1.5
"""Distances, in units of noise, that say nothing."""


class LineViews(NamedTuple):
    """Segments and cameras of lines, harmless numbers of weight 0 where there is none."""

    ends: Float[Tensor, "n v 2 2"]
    """Two image points of each segment."""
    P: Float[Tensor, "n v 3 4"]
    w: Float[Tensor, "n v"]
    """Weights of the squared distances of both ends."""
    broken: Bool[Tensor, " n"]
    """Whether a wanted observation is not finite."""
    centre: Float[Tensor, "n v 3"]
    """Centres, directions of those at infinity; as plain numbers."""
    near: Bool[Tensor, "n v"]
    """Which centres are finite."""
    handed: Float[Tensor, "n v"]
    """The sign that depths in front have; 0 where the centre is at infinity."""

    @property
    def used(self) -> Tensor:
        """Which views count."""
        return self.w > 0

    def moved(self, origin: Tensor, unit: Tensor) -> "LineViews":
        """The cameras for points `(X - origin) / unit`, of arbitrary scale 1."""
        M, p = self.P[..., :3], self.P[..., 3:]
        P = torch.cat((M * unit[:, None, None, None], M @ origin[:, None, :, None] + p), -1)
        P = P / P.detach().abs().amax((-2, -1), keepdim=True).clamp_min(1e-300)
        centre = torch.where(self.near[..., None], (self.centre - origin[:, None]) / unit[:, None, None], self.centre)
        return self._replace(P=P, centre=centre)

    def rows(self) -> Tensor:
        """What gives residuals and normals of image lines of Pluecker vectors, see `image_rows`."""
        return image_rows(line_forms(self.P), to_homogeneous(self.ends))


def observe(l: Tensor, P: Tensor, visible: Tensor | None, weights: Tensor | None) -> LineViews:  # noqa: E741
    """Lay out l (n, v, 3) or (n, v, 2, 2), P (n, v, 3, 4), visible and weights (n, v)."""
    P, l = P.double(), l.double()  # noqa: E741
    good = usable(P).flatten(-2).all(-1)
    P = torch.where(good[..., None, None], P, torch.eye(3, 4, dtype=P.dtype, device=P.device))
    size = P.detach().abs().amax((-2, -1), keepdim=True)
    P = P / torch.where(size > 0, size, 1.0)
    if l.shape[-1] == 3:
        sound = usable(l).all(-1)
        l = torch.where(sound[..., None], l, l.new_tensor([1.0, 0.0, 0.0]))  # noqa: E741
        ends = _points_of(l, P)
    else:
        sound = usable(l).flatten(-2).all(-1)
        ends = l
    apart = (ends[..., 0, :] != ends[..., 1, :]).any(-1)
    sound = good & sound
    wanted = torch.ones_like(sound) if visible is None else visible
    w = torch.ones_like(ends[..., 0, 0])
    if weights is not None:
        w = weights.double()
        wanted = wanted & (w.detach() != 0)
        sound = sound & usable(w) & (w.detach() >= 0)
    use = wanted & sound
    harmless = ends.new_tensor([[0.0, 0.0], [1.0, 0.0]])
    ends = torch.where((use & apart)[..., None, None], ends, harmless)
    # A segment of one point is a point on the line, and no line.
    w = torch.where(use & apart, w, torch.zeros_like(w))
    return LineViews(ends, P, w, (wanted & ~sound).any(-1), *_centres(P.detach()))


def _centres(P: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centres (n, v, 3), directions of centres at infinity; which are finite; and the sign of depths."""
    M, p = P[..., :3], P[..., 3]
    det = determinant_3x3(M)
    size = torch.linalg.vector_norm(M, dim=-1).prod(-1)
    finite = det.abs() > 1e-13 * size
    centre = -(adjugate_3x3(M) @ p[..., None])[..., 0]
    length = torch.linalg.vector_norm(centre, dim=-1).clamp_min(1e-300)
    return centre / torch.where(finite, det, length)[..., None], finite, torch.where(finite, torch.sign(det), 0.0)


def _points_of(l: Tensor, P: Tensor) -> Tensor:  # noqa: E741
    """Two points on image lines, a focal length to each side of the foot of the principal point."""
    third = P[..., 2, :3].detach()
    square = third.square().sum(-1, keepdim=True)
    affine = square <= 1e-24
    third = third / torch.where(affine, 1.0, square)
    middle = torch.where(affine, 0.0, (P[..., :2, :3].detach() @ third[..., None])[..., 0])
    across = P[..., :2, :3].detach() - middle[..., None] * P[..., 2:, :3].detach()
    focal = (across.square().sum((-2, -1)) / torch.where(affine[..., 0], 2.0, 2 * square[..., 0])).sqrt()
    size = l[..., :2].square().sum(-1, keepdim=True)
    infinite = size.detach() <= 1e-24 * l.detach()[..., 2:].square()
    size = torch.where(infinite, 1.0, size)
    foot = middle - ((l[..., :2] * middle).sum(-1, keepdim=True) + l[..., 2:]) / size * l[..., :2]
    along = torch.stack((l[..., 1], -l[..., 0]), -1) * size.rsqrt() * focal[..., None]
    along = torch.where(infinite, 0.0, along)
    return torch.stack((foot - along, foot + along), -2)


def frame_of_centres(views: LineViews) -> tuple[Tensor, Tensor]:
    """The mean (n, 3) of the centres and their root-mean-square distance (n) from it, 1 where they are one point."""
    counted = (views.near & views.used)[..., None]
    number = counted.sum(1).clamp_min(1)
    mean = torch.where(counted, views.centre, 0.0).sum(1) / number
    spread = torch.where(counted, (views.centre - mean[:, None]).square(), 0.0).sum((1, 2)).div(number[:, 0]).sqrt()
    reach = torch.where(counted, views.centre.square(), 0.0).sum((1, 2)).div(number[:, 0]).sqrt()
    return mean, torch.where(spread > _CENTRE * reach, spread, 1.0)


def one_centre(views: LineViews) -> Tensor:
    """Whether the views that see a line have one centre (n)."""
    counted = (views.near & views.used)[..., None]
    low = torch.where(counted, views.centre, torch.inf).amin(1)
    high = torch.where(counted, views.centre, -torch.inf).amax(1)
    reach = torch.maximum(low.abs(), high.abs()).amax(-1)
    return ~(((high - low).amax(-1) > _CENTRE * reach) | (views.used & ~views.near).any(1))


def linear_lines(views: LineViews, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Lines (n, 6) through the two points that are least off the viewing planes, and the planes' singular values (n, 4).

    The planes are scaled to unit normals; both points are right singular vectors, so that the line is one, always.
    """
    l = line_from_points(views.ends[..., 0, :], views.ends[..., 1, :])[..., None]  # noqa: E741
    planes = l[..., 0, :] * views.P[..., 0, :] + l[..., 1, :] * views.P[..., 1, :] + l[..., 2, :] * views.P[..., 2, :]
    planes = planes / torch.linalg.vector_norm(planes[..., :3], dim=-1, keepdim=True).clamp_min(1e-300)
    rows = planes * weight.sqrt()[..., None]
    values, vectors, _ = eigh(rows.mT @ rows)
    (a, wa), (b, wb) = ((v[..., :3], v[..., 3:]) for v in vectors[..., :2].unbind(-1))
    return torch.cat((wa * b - wb * a, cross(a, b)), -1), values.clamp_min(0).sqrt()


def one_plane(views: LineViews) -> Tensor:
    """Whether all rays to the ends of segments lie in planes of one direction, but for noise of a unit (n).

    Then the planes of sight are one, or parallel, as far as can be told, and meet anywhere.
    """
    cofactors, h = adjugate_3x3(views.P[..., :3]).mT, to_homogeneous(views.ends)
    rays = _unit(h @ cofactors)
    weighted = rays * torch.where(views.near, views.w, 0.0)[..., None, None]
    _, vectors, _ = eigh(weighted.flatten(1, 2).mT @ rays.flatten(1, 2))
    line = (cofactors.flatten(1, 2) @ vectors[..., :1]).view(*h.shape[:2], 1, 3)
    away = (h * line).sum(-1).square() / line[..., :2].square().sum(-1).clamp_min(1e-300)
    square = torch.where(views.near, views.w * away.mean(-1), 0.0).sum(-1)
    number = (views.used & views.near).sum(-1)
    return (square <= _NOISE**2 * number.to(square.dtype)) & (views.used <= views.near).all(-1)


class SeenParts(NamedTuple):
    """Where on lines the ends of their segments are seen."""

    foot: Float[Tensor, "n 3"]
    """The point of each line that is nearest to the origin."""
    d: Float[Tensor, "n 3"]
    """Its direction, of unit length."""
    along: Float[Tensor, "n v 2"]
    """Of both ends, from the foot."""
    finite: Bool[Tensor, "n v 2"]
    """Which are seen at all."""
    depth: Float[Tensor, "n v"]
    """The third coordinate of the image of the middle."""

    def points(self) -> Tensor:
        """The ends (n, v, 2, 3)."""
        return self.foot[:, None, None] + self.along[..., None] * self.d[:, None, None]


def seen_parts(views: LineViews, line: Tensor) -> SeenParts:
    """Where lines meet the planes through the rays to the ends of segments and across their images."""
    size = torch.linalg.vector_norm(line[:, :3], dim=-1, keepdim=True).clamp_min(1e-300)
    d = line[:, :3] / size
    foot = cross(d, line[:, 3:] / size)
    pair = torch.stack((torch.nn.functional.pad(d, (0, 1)), torch.nn.functional.pad(foot, (0, 1), value=1.0)), -1)
    image = (views.P.flatten(1, 2) @ pair).view(*views.P.shape[:-1], 2)
    (c1, c2, c3), (b1, b2, b3) = (v.unbind(-1) for v in image.unbind(-1))
    l1, l2 = b2 * c3 - b3 * c2, b3 * c1 - b1 * c3
    # Of the planes h x (l1, l2, 0).
    third = views.ends[..., 0] * l2[..., None] - views.ends[..., 1] * l1[..., None]
    slope = (l1 * c2 - l2 * c1)[..., None] + third * c3[..., None]
    value = (l1 * b2 - l2 * b1)[..., None] + third * b3[..., None]
    bound = (l1.square() + l2.square())[..., None] + third.square()
    steep = slope.square() > 1e-18 * bound * (c1.square() + c2.square() + c3.square())[..., None]
    along = torch.where(steep, -value / torch.where(steep, slope, 1.0), 0.0)
    return SeenParts(foot, d, along, steep, b3 + along.mean(-1) * c3)


def frame_of_line(views: LineViews, seen: SeenParts) -> tuple[Tensor, Tensor]:
    """An origin (n, 3) as far from the part of the line that is seen as the centres are, and that distance (n) as the unit.

    There the direction and the moment of the line are of one length, which is where its manifold is best.
    """
    counted = seen.finite & views.used[..., None]
    number = counted.sum((1, 2)).clamp_min(1)
    middle = seen.foot + (torch.where(counted, seen.along, 0.0).sum((1, 2)) / number)[:, None] * seen.d
    near = views.near & views.used
    away = torch.where(near[..., None], views.centre - middle[:, None], 0.0)
    count = near.sum(1).clamp_min(1)
    unit = (away.square().sum((1, 2)) / count).sqrt()
    unit = torch.where((unit > 0) & (unit < 1e100), unit, 1.0)
    mean = away.sum(1)
    across = mean - (mean * seen.d).sum(-1, keepdim=True) * seen.d
    thin = across.square().sum(-1, keepdim=True) <= 1e-6 * mean.square().sum(-1, keepdim=True)
    axis = torch.nn.functional.one_hot(seen.d.abs().argmin(-1), 3).to(seen.d.dtype)
    across = _unit(torch.where(thin, cross(seen.d, axis), across))
    return middle + unit[:, None] * across, unit


def line_forms(P: Tensor) -> Tensor:
    """The matrices (*batch, 3, 6) that take Pluecker vectors to image lines, of size 1 whatever the rows of the cameras are."""
    M, p = P[..., :3], P[..., 3]
    direct = torch.stack([cross(p, column) for column in M.unbind(-1)], -1)
    forms = torch.cat((direct, adjugate_3x3(M).mT), -1)
    return forms / forms.detach().abs().amax((-2, -1), keepdim=True).clamp_min(1e-300)


def through_centre(l: Tensor, line: Tensor, projections: Tensor) -> Tensor:  # noqa: E741
    """Whether lines pass through the centres of views, but for rounding: what is seen of them is then a point (*batch, v).

    Args:
        l: Their images (*batch, v, 3).
        line: The lines (*batch, 6).
        projections: The matrices (*#batch, v, 3, 6) between them.
    """
    size = projections.square().sum((-2, -1)) * line.square().sum(-1, keepdim=True)
    return l.square().sum(-1) <= _POINT**2 * size


def image_rows(forms: Tensor, ends: Tensor) -> Tensor:
    """What gives of a Pluecker vector e1'l, e2'l, l1, l2 for its image l and homogeneous ends e (*batch, v, 4, 6)."""
    return torch.cat((ends @ forms, forms[..., :2, :]), -2)


def residuals(line: Tensor, rows: Tensor) -> Tensor:
    """Signed distances (n, v, 2) of the ends of segments from images of lines, in pixels."""
    l = _images(rows, line[..., None])[..., 0]  # noqa: E741
    scale = l[..., 2:].square().sum(-1, keepdim=True).clamp_min(1e-200).rsqrt()
    return l[..., :2] * scale


def linearize(line: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The residuals and their derivatives (n, v, 2, 4) along the tangents of `Line3D`."""
    return slopes_along(line, line_tangents(line), rows)


def slopes_along(line: Tensor, tangents: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The residuals (*batch, v, 2) and their derivatives (*batch, v, 2, k) along tangents (*batch, 6, k) of lines."""
    l = _images(rows, torch.cat((line[..., None], tangents), -1))  # noqa: E741
    first, second = l[..., 2:3, :], l[..., 3:, :]
    l1, l2 = first[..., :1], second[..., :1]
    scale = (l1 * l1 + l2 * l2).clamp_min(1e-200).rsqrt()
    r = l[..., :2, :1] * scale
    stretch = (l1 * first[..., 1:] + l2 * second[..., 1:]) * (scale * scale)
    return r[..., 0], l[..., :2, 1:] * scale - r * stretch


def _images(rows: Tensor, vectors: Tensor) -> Tensor:
    """Rows (*batch, v, 4, 6) times columns (*batch, 6, k): one product for all views."""
    product = rows.flatten(-3, -2) @ vectors
    return product.reshape(*product.shape[:-2], *rows.shape[-3:-1], product.shape[-1])


def in_world(line: Tensor, origin: Tensor, unit: Tensor) -> Tensor:
    """Lines (n, 6) of the frame as lines of the world, of unit direction."""
    d = line[..., :3]
    L = torch.cat((d, unit[..., None] * line[..., 3:] + cross(origin, d)), -1)
    size = d.square().sum(-1, keepdim=True)
    return L * torch.where(size > 0, torch.where(size > 0, size, 1.0).rsqrt(), 0.0)


def in_frame(L: Tensor, origin: Tensor, unit: Tensor) -> Tensor:
    """Lines of the world in the frame."""
    d = L[..., :3]
    return torch.cat((d, (L[..., 3:] - cross(origin, d)) / unit[..., None]), -1)


def _unit(v: Tensor) -> Tensor:
    unit: Tensor = v / torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-300)
    return unit
