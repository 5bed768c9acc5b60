"""The surfaces that textured scenes are made of: where a ray meets them, and how a texture lies on them."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Chart(NamedTuple):
    """Texture coordinates of points on a surface, and how they change when the point moves. Coordinates come first."""

    layer: Int[Tensor, "n"]
    """Which of the surface's texture sheets the point lies on."""
    uv: Float[Tensor, "2 n"]
    """Position on the sheet, from its corner, in the unit of the scene."""
    du: Float[Tensor, "3 n"]
    """Gradient of u with respect to the point, tangent to the surface."""
    dv: Float[Tensor, "3 n"]
    """Gradient of v with respect to the point, tangent to the surface."""
    normal: Float[Tensor, "3 n"]
    """Unit normal, to either side."""


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@dataclass(frozen=True)
class Rectangle:
    """A rectangle with one corner and two perpendicular edges; with `round` only the ellipse inside it."""

    corner: Float[Tensor, "3"]
    edge_u: Float[Tensor, "3"]
    edge_v: Float[Tensor, "3"]
    round: bool = False

    def sheets(self) -> tuple[tuple[float, float], ...]:
        """Width and height of each texture sheet, in the unit of the scene."""
        return ((float(self.edge_u.norm()), float(self.edge_v.norm())),)

    def _frame(self) -> Tensor:
        u, v = self.edge_u / self.edge_u.norm(), self.edge_v / self.edge_v.norm()
        return torch.stack((u, v, torch.linalg.cross(u, v)))

    def ball(self) -> tuple[Float[Tensor, "3"], float]:
        """Centre and radius of a ball around the surface."""
        half = (self.edge_u + self.edge_v) / 2
        reach = torch.maximum(self.edge_u.norm(), self.edge_v.norm()) / 2 if self.round else half.norm()
        return self.corner + half, 1.001 * float(reach)

    def intersect(self, origin: Float[Tensor, "3 #n"], d: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
        """The smallest s > 0 for which origin + s d lies on the surface, infinity where there is none."""
        frame = self._frame().to(d)
        o, e = frame @ (origin - self.corner.to(d)[:, None]), frame @ d
        s = -o[2] / e[2]
        u = (o[0] + s * e[0]) / self.edge_u.norm().to(d)
        v = (o[1] + s * e[1]) / self.edge_v.norm().to(d)
        box = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        inside = (u - 0.5).square() + (v - 0.5).square() <= 0.25 if self.round else box
        return torch.where(inside & (s > 0), s, math.inf)

    def chart(self, X: Float[Tensor, "3 n"]) -> Chart:
        """Texture coordinates at points on the surface."""
        frame = self._frame().to(X)
        uv = frame[:2] @ (X - self.corner.to(X)[:, None])
        du, dv, normal = (row[:, None].expand_as(X) for row in frame)
        return Chart(torch.zeros_like(uv[0], dtype=torch.long), uv, du, dv, normal)


_UPRIGHT = ((1, -1, 2, -1), (1, 1, 2, -1), (0, 1, 2, -1), (0, -1, 2, -1), (0, 1, 1, 1), (0, 1, 1, -1))
"""For each side of a box (-x, +x, -y, ...) the axes and signs of u and v: seen from outside u runs right, v down."""


@dataclass(frozen=True)
class Box:
    """A box with its centre, its axes as the rows of a rotation, and half its length along each."""

    centre: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    half: Float[Tensor, "3"]

    def sheets(self) -> tuple[tuple[float, float], ...]:
        """Width and height of each texture sheet: -x, +x, -y, +y, -z, +z."""
        a, b, c = (2 * float(h) for h in self.half)
        return ((b, c), (b, c), (a, c), (a, c), (a, b), (a, b))

    def ball(self) -> tuple[Float[Tensor, "3"], float]:
        """Centre and radius of a ball around the surface."""
        return self.centre, 1.001 * float(self.half.norm())

    def intersect(self, origin: Float[Tensor, "3 #n"], d: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
        """The smallest s > 0 for which origin + s d lies on the surface, infinity where there is none."""
        axes, half = self.axes.to(d), self.half.to(d)[:, None]
        o, e = axes @ (origin - self.centre.to(d)[:, None]), axes @ d
        e = torch.where(e.abs() < 1e-12, 1e-12, e)
        a, b = (-half - o) / e, (half - o) / e
        near, far = torch.minimum(a, b).amax(0), torch.maximum(a, b).amin(0)
        s = torch.where(near > 0, near, far)
        return torch.where((near <= far) & (s > 0), s, math.inf)

    def chart(self, X: Float[Tensor, "3 n"]) -> Chart:
        """Texture coordinates at points on the surface."""
        axes, half = self.axes.to(X), self.half.to(X)[:, None]
        p = axes @ (X - self.centre.to(X)[:, None])
        axis = (p.abs() / half).argmax(0)
        side = p.gather(0, axis[None])[0] > 0
        sheet = 2 * axis + side.long()
        u_axis, u_sign, v_axis, v_sign = torch.tensor(_UPRIGHT, device=X.device).T[:, sheet]
        rows = axes.T
        u = half[u_axis, 0] + u_sign * p.gather(0, u_axis[None])[0]
        v = half[v_axis, 0] + v_sign * p.gather(0, v_axis[None])[0]
        return Chart(sheet, torch.stack((u, v)), u_sign * rows[:, u_axis], v_sign * rows[:, v_axis], rows[:, axis])


@dataclass(frozen=True)
class Sphere:
    """A sphere, painted as the six faces of a cube blown up to it (nearly even, without poles)."""

    centre: Float[Tensor, "3"]
    radius: float

    def sheets(self) -> tuple[tuple[float, float], ...]:
        """Width and height of each texture sheet: -x, +x, -y, +y, -z, +z."""
        return ((self.radius * math.pi / 2,) * 2,) * 6

    def ball(self) -> tuple[Float[Tensor, "3"], float]:
        """Centre and radius of a ball around the surface."""
        return self.centre, 1.001 * self.radius

    def intersect(self, origin: Float[Tensor, "3 #n"], d: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
        """The smallest s > 0 for which origin + s d lies on the surface, infinity where there is none."""
        o = origin - self.centre.to(d)[:, None]
        return _first_root(_dot(d, d), _dot(o, d), _dot(o, o) - self.radius**2)[0]

    def chart(self, X: Float[Tensor, "3 n"]) -> Chart:
        """Texture coordinates at points on the surface."""
        p = (X - self.centre.to(X)[:, None]) / self.radius
        sheet, uv, du, dv = _cube_chart(p)
        return Chart(sheet, uv * self.radius, du, dv, p)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with its axes as the rows of a rotation and its radius along each: a sphere stretched, paint and all."""

    centre: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    radii: Float[Tensor, "3"]

    def sheets(self) -> tuple[tuple[float, float], ...]:
        """Width and height of each texture sheet, those of a sphere of the mean radius: -x, +x, -y, +y, -z, +z."""
        return ((self._size() * math.pi / 2,) * 2,) * 6

    def _size(self) -> float:
        return float(self.radii.mean())

    def ball(self) -> tuple[Float[Tensor, "3"], float]:
        """Centre and radius of a ball around the surface."""
        return self.centre, 1.001 * float(self.radii.max())

    def _to_sphere(self) -> Tensor:
        """The linear map that makes the ellipsoid a unit sphere."""
        return self.axes / self.radii[:, None]

    def intersect(self, origin: Float[Tensor, "3 #n"], d: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
        """The smallest s > 0 for which origin + s d lies on the surface, infinity where there is none."""
        stretch = self._to_sphere().to(d)
        o, e = stretch @ (origin - self.centre.to(d)[:, None]), stretch @ d
        return _first_root(_dot(e, e), _dot(o, e), _dot(o, o) - 1)[0]

    def chart(self, X: Float[Tensor, "3 n"]) -> Chart:
        """Texture coordinates at points on the surface."""
        stretch = self._to_sphere().to(X)
        p = stretch @ (X - self.centre.to(X)[:, None])
        sheet, uv, *gradients = _cube_chart(p)
        normal = torch.nn.functional.normalize(stretch.T @ p, dim=0)
        du, dv = (self._size() * (stretch.T @ g) for g in gradients)
        du, dv = (g - normal * _dot(g, normal) for g in (du, dv))
        return Chart(sheet, uv * self._size(), du, dv, normal)


def _cube_chart(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Face of the cube, coordinates on it, and their gradients, of points on the unit sphere."""
    axis = p.abs().argmax(0)
    first, second = torch.where(axis == 0, 1, 0), torch.where(axis == 2, 1, 2)
    main = p.gather(0, axis[None])[0]
    rows = torch.eye(3, dtype=p.dtype, device=p.device)

    def along(index: Tensor) -> tuple[Tensor, Tensor]:
        tangent = p.gather(0, index[None])[0] / main.abs()
        gradient = (rows[:, index] - tangent * torch.sign(main) * rows[:, axis]) / (main.abs() * (1 + tangent.square()))
        return torch.atan(tangent) + math.pi / 4, gradient

    (u, du), (v, dv) = along(first), along(second)
    return 2 * axis + (main > 0).long(), torch.stack((u, v)), du, dv


@dataclass(frozen=True)
class Cylinder:
    """The side of a cylinder, standing on `base` along the third row of `axes`; a round `Rectangle` makes its lid."""

    base: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    radius: float
    height: float

    def sheets(self) -> tuple[tuple[float, float], ...]:
        """Width (the circumference) and height of the texture sheet."""
        return ((2 * math.pi * self.radius, self.height),)

    def ball(self) -> tuple[Float[Tensor, "3"], float]:
        """Centre and radius of a ball around the surface."""
        return self.base + self.axes[2] * (self.height / 2), 1.001 * math.hypot(self.radius, self.height / 2)

    def intersect(self, origin: Float[Tensor, "3 #n"], d: Float[Tensor, "3 n"]) -> Float[Tensor, "n"]:
        """The smallest s > 0 for which origin + s d lies on the surface, infinity where there is none."""
        axes = self.axes.to(d)
        o, e = axes @ (origin - self.base.to(d)[:, None]), axes @ d
        a = e[0].square() + e[1].square()
        b, c = o[0] * e[0] + o[1] * e[1], o[0].square() + o[1].square() - self.radius**2
        best = torch.full_like(d[0], math.inf)
        for s in reversed(_first_root(a, b, c)):
            z = o[2] + s * e[2]
            best = torch.where((z >= 0) & (z <= self.height) & (s > 0), s, best)
        return best

    def chart(self, X: Float[Tensor, "3 n"]) -> Chart:
        """Texture coordinates at points on the surface."""
        axes = self.axes.to(X)
        p = axes @ (X - self.base.to(X)[:, None])
        uv = torch.stack(((torch.atan2(p[1], p[0]) + math.pi) * self.radius, p[2]))
        zero = torch.zeros_like(p[0])
        normal = torch.stack((p[0], p[1], zero)) / self.radius
        du = axes.T @ torch.stack((-normal[1], normal[0], zero))
        return Chart(zero.long(), uv, du, axes[2][:, None].expand_as(X), axes.T @ normal)


Surface = Rectangle | Box | Sphere | Ellipsoid | Cylinder


def _first_root(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Roots of a s^2 + 2 b s + c, positive ones first and ascending; infinity where there is none."""
    root = (b.square() - a * c).clamp_min(0).sqrt()
    hit = (b.square() >= a * c) & (a > 0)
    near, far = (-b - root) / a, (-b + root) / a
    near = torch.where(hit & (near > 0), near, math.inf)
    far = torch.where(hit & (far > 0), far, math.inf)
    return torch.minimum(near, far), torch.maximum(near, far)
