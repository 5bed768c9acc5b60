"""How far image points are from the images of lines, whatever the lens makes of them, and what changes that.

The image of a line is that of the plane through the line and the camera's centre, a curve where lenses distort. Rays in the
plane are projected through the whole camera; the foot of a point is where the curve is square to what separates both. There
the distance changes only with what moves the curve across itself: where n is the normal of the plane, q the ray of the foot, J
the derivative of its image p by the ray, and c the curve's normal in the image, by `c'J n (q'dn) / n'n - c'dp`.

Coordinates come first, the ends of segments next, their numbers last.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.bundle.projection import Projection

_TINY = 1e-300
_STEPS = 4
"""Places on a curve tried as the foot: from rays of a camera of before to the foot to rounding, for points as near as noise."""

Frame = tuple[Float[Tensor, "3 3 k"], Float[Tensor, "3 k"], Float[Tensor, "3 k"], Float[Tensor, "3 k"]]
"""Rotation and translation of a motion; direction and moment of lines behind it, about its origin."""


@dataclass(frozen=True)
class NearestOnCurve:
    """The feet of image points on the images of planes through the centre."""

    normal: Float[Tensor, "3 1 k"]
    """Of the planes."""
    ray: Float[Tensor, "3 e k"]
    by_ray: Float[Tensor, "2 3 e k"]
    """The derivatives of the feet by their rays."""
    across: Float[Tensor, "2 e k"]
    """Unit normals of the curves in the image."""
    distance: Float[Tensor, "e k"]
    """Signed distances of the points, positive to one side all along."""

    def by_normal(self) -> Float[Tensor, "3 e k"]:
        """The derivatives of the distances by the normals of the planes."""
        slope = (self.across * (self.by_ray * self.normal).sum(1)).sum(0)
        return slope / self.normal.square().sum(0).clamp_min(_TINY) * self.ray


def nearest_on_curve(
    projection: Projection,
    camera: Float[Tensor, "c k"],
    normal: Float[Tensor, "3 k"],
    x: Float[Tensor, "2 e k"],
    rays: Float[Tensor, "3 e k"],
    by_free: Float[Tensor, "2 q e k"] | None = None,
) -> NearestOnCurve:
    """Newton's method along the curves, without derivatives, from the rays of the planes that are nearest to those given.

    `by_free` gets the derivatives of the feet's images by the free numbers of the cameras.
    """
    unit, ray = _in_plane(normal, rays)
    camera, by_ray = camera[:, None], ray.new_empty(2, *ray.shape)
    for left in reversed(range(_STEPS)):
        place = projection.slopes(ray, camera, by_ray, None if left else by_free)
        along = torch.linalg.cross(unit.expand_as(ray), ray, dim=0)
        tangent, away = (by_ray * along).sum(1), x - place
        square = tangent.square().sum(0).clamp_min(_TINY)
        if left:
            ray = ray + ((away * tangent).sum(0) / square) * along
    across = torch.stack((-tangent[1], tangent[0])) / square.sqrt()
    return NearestOnCurve(normal[:, None], ray, by_ray, across, (across * away).sum(0))


def expand_distances(
    projection: Projection,
    camera: Float[Tensor, "c k"],
    normal: Float[Tensor, "3 k"],
    x: Float[Tensor, "2 e k"],
    rays: Float[Tensor, "3 e k"],
) -> tuple[Float[Tensor, "e k"], Float[Tensor, "p e k"], Float[Tensor, "p p e k"]]:
    """The distances of `nearest_on_curve`, and their first and second derivatives by (normal, free numbers of the camera).

    A distance is the stationary value of `c'(x - p)` over the direction of the unit vector c and the place s of p along the
    curve, so that its second derivatives are `L_yy - L_yu L_uu^-1 L_uy` of that Lagrangian with u = (angle of c, s). What it
    takes of lenses are those of c'p with c held, by the ray and the camera's numbers.
    """
    found = nearest_on_curve(projection, camera, normal, x, rays)
    q, n, r = found.ray, found.across, found.distance
    size = normal.square().sum(0).clamp_min(_TINY).sqrt()
    unit = (normal / size)[:, None]
    along = torch.linalg.cross(unit.expand_as(q), q, dim=0)
    first, second, sideways = _lens_slopes(projection, camera, q, n)
    # A step d of the normal moves the ray by -unit (d'q) / size, to first order.
    lean = q / size
    on_unit, on_along = (second[:, :3] * unit).sum(1), (second[:, :3] * along).sum(1)
    tilt = (first[:3] * unit).sum(0)
    by = torch.cat((tilt * lean, -first[3:]))
    speed, bend = (sideways[:3] * along).sum(0), (on_along[:3] * along).sum(0)
    by_angle = torch.cat(((sideways[:3] * unit).sum(0) * lean, -sideways[3:]))
    by_place = torch.cat(((on_along[:3] * unit).sum(0) * lean + tilt * (along / size), -on_along[3:]))
    twice = torch.empty_like(second)
    mixed = tilt * lean[:, None] * (unit / size)
    twice[:3, :3] = -(on_unit[:3] * unit).sum(0) * lean[:, None] * lean - mixed - mixed.transpose(0, 1)
    twice[:3, 3:] = lean[:, None] * on_unit[3:]
    twice[3:, :3] = twice[:3, 3:].transpose(0, 1)
    twice[3:, 3:] = -second[3:, 3:]
    scale = 1 / (r * bend - speed.square())
    through = by_angle[:, None] * (speed * by_place - bend * by_angle) + by_place[:, None] * (speed * by_angle - r * by_place)
    return r, by, twice - scale * through


def curve_distances(
    projection: Projection,
    camera: Float[Tensor, "c k"],
    normal: Float[Tensor, "3 k"],
    x: Float[Tensor, "2 e k"],
    rays: Float[Tensor, "3 e k"],
) -> Float[Tensor, "e k"]:
    """The distances of `nearest_on_curve`, with their derivatives, first and second, where these are followed."""
    with torch.no_grad():
        nearest = nearest_on_curve(projection, camera, normal, x, rays)
    if not (torch.is_grad_enabled() and any(t.requires_grad for t in (camera, normal, x))):
        return nearest.distance
    unit, ray = _in_plane(normal, nearest.ray)
    # Moved once more the foot is right to first order, and what it does to the distance to second.
    for last in (False, True):
        along = torch.linalg.cross(unit.expand_as(ray), ray, dim=0)
        place, tangent = _followed(projection, camera[:, None], ray, along)
        square = tangent.square().sum(0).clamp_min(_TINY)
        away = x - place
        if not last:
            ray = ray + ((away * tangent).sum(0) / square) * along
    distance: Tensor = (tangent[0] * away[1] - tangent[1] * away[0]) / square.sqrt()
    return distance


def into_frames(line: Float[Tensor, "10 k"], motions: Sequence[tuple[Tensor, Tensor]]) -> list[Frame]:
    """Lines `(d, m, origin, unit)` behind each motion on the way to the camera: the last moment is normal to the plane."""
    d, m, origin, unit = line[:3], line[3:6], line[6:9], line[9:]
    found: list[Frame] = []
    for R, t in motions:
        place, turned = _turn(R, origin) + t, _turn(R, d)
        d, m = turned, unit * _turn(R, m) + torch.linalg.cross(place, turned, dim=0)
        origin, unit = torch.zeros_like(origin), torch.ones_like(unit)
        found.append((R, t, d, m))
    return found


def pull_back(
    by_moment: Float[Tensor, "3 e k"], frames: Sequence[Frame], out: Sequence[Float[Tensor, "e 6 k"] | None]
) -> tuple[Float[Tensor, "3 e k"], Float[Tensor, "3 e k"]]:
    """From the derivatives by the moments in the camera to those by direction and moment in the world.

    `out` gets those by the steps of the motions: a turn w moves d and m by w x d and w x m, a shift v moves m by v x d.
    """
    by_direction = torch.zeros_like(by_moment)
    for (R, t, d, m), o in zip(reversed(frames), reversed(out), strict=True):
        d, m = d[:, None].expand_as(by_moment), m[:, None].expand_as(by_moment)
        if o is not None:
            turn = torch.linalg.cross(m, by_moment, dim=0) + torch.linalg.cross(d, by_direction, dim=0)
            o[:, :3] = turn.transpose(0, 1)
            o[:, 3:] = torch.linalg.cross(d, by_moment, dim=0).transpose(0, 1)
        shifted = by_direction + torch.linalg.cross(by_moment, t[:, None].expand_as(by_moment), dim=0)
        by_direction, by_moment = _turn(R.transpose(0, 1), shifted), _turn(R.transpose(0, 1), by_moment)
    return by_direction, by_moment


def _in_plane(normal: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Unit normals, and the rays nearest to others."""
    unit = (normal / normal.square().sum(0).clamp_min(_TINY).sqrt())[:, None]
    return unit, rays - (rays * unit).sum(0) * unit


def _turn(R: Float[Tensor, "3 3 k"], v: Float[Tensor, "3 *e k"]) -> Float[Tensor, "3 *e k"]:
    """Rotate vectors."""
    R = R if v.ndim == 2 else R[:, :, None]
    return (R * v).sum(1)


def _followed(
    projection: Projection, camera: Tensor, ray: Float[Tensor, "3 *n"], along: Float[Tensor, "3 *n"]
) -> tuple[Float[Tensor, "2 *n"], Float[Tensor, "2 *n"]]:
    """Image points of rays, and how they move where the rays move along a direction, with derivatives of both."""
    ray = ray if ray.requires_grad else ray.detach().requires_grad_()
    place = projection.inside.pixels(ray, camera)
    ones = torch.ones_like(place[0])
    slopes = [torch.autograd.grad(row, ray, ones, create_graph=True, retain_graph=True)[0] for row in place]
    return place, torch.stack([(slope * along).sum(0) for slope in slopes])


def _lens_slopes(
    projection: Projection, camera: Float[Tensor, "c k"], ray: Float[Tensor, "3 e k"], c: Float[Tensor, "2 e k"]
) -> tuple[Float[Tensor, "p e k"], Float[Tensor, "p p e k"], Float[Tensor, "p e k"]]:
    """First and second derivatives of `c'p` by (ray, free numbers of the camera), and the first of p along the curve."""
    free = projection.free
    with torch.enable_grad():
        moves = camera[list(free)][:, None].expand(-1, *ray.shape[1:])
        leaf = torch.cat((ray, moves)).detach().requires_grad_()
        rows = list(camera[:, None].expand(-1, *ray.shape[1:]).unbind(0))
        for place, column in enumerate(free, 3):
            rows[column] = leaf[place]
        pixels = projection.inside.pixels(leaf[:3], torch.stack(rows))
        (first,) = torch.autograd.grad((c * pixels).sum(), leaf, create_graph=True)
        (sideways,) = torch.autograd.grad((c[1] * pixels[0] - c[0] * pixels[1]).sum(), leaf, retain_graph=True)
        second = [torch.autograd.grad(row.sum(), leaf, retain_graph=True, materialize_grads=True)[0] for row in first]
    return first.detach(), torch.stack(second), sideways
