"""The reprojection residual of one observation and its derivatives, as a term for the sparse optimiser.

Cameras are rows of numbers; see `intrinsics`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import BrownConrady, DistortionModel, NoDistortion, Radial, SimpleRadial
from torchsfm.geometry.decentring import brown_jacobian


@dataclass(frozen=True)
class Projection:
    """Projection of points `(m, 3)` by poses `(m, 12)` and cameras `(m, 5 + p)`, minus the image points `(m, 2)`.

    A point may have more numbers behind its coordinates; see `RayPoint`.
    """

    model: type[DistortionModel]
    free: tuple[int, ...]
    """Columns of the camera row that are optimised."""
    skew: bool = True
    """Whether any camera has skew; False saves time."""
    switched: bool = False
    """Whether switches follow the camera's numbers; see `Switched`."""

    def residual(self, pose: Tensor, camera: Tensor, point: Tensor, x: Tensor) -> Tensor:
        """Predicted minus measured image points, pixels; finite for all finite points, also behind the camera."""
        return self.residual_of(transform(pose, point), camera, x)

    def residual_of(self, moved: Tensor, camera: Tensor, x: Tensor) -> Tensor:
        """The residual of points in camera coordinates, (3, m)."""
        k = self._lens(camera)
        if issubclass(self.model, RADIAL):
            uv, _, s = _flatten(moved)
            if len(k):
                uv = uv * _radial(s, k)
        else:
            uv = torch.stack(self.model.project_rows(*moved.unbind(0), *k.unbind(0)))
        return self._pixels(uv, camera.mT, x.mT, _focal(camera.mT)).mT

    def linearize(self, pose: Tensor, camera: Tensor, point: Tensor, x: Tensor, out: list[Tensor | None]) -> Tensor:
        """Residuals; `out` gets their derivatives by pose step, free camera numbers and point: the chain rule, written out."""
        moved = transform(pose, point)
        by_pose, by_intrinsics, by_point = (None if o is None else o.permute(1, 2, 0) for o in out)
        # Pixels by camera coordinates, which is pixels by translation: (2, 3, m).
        by_camera = (
            torch.empty((2, 3, moved.shape[1]), dtype=moved.dtype, device=moved.device) if by_pose is None else by_pose[:, 3:]
        )
        residual = self.linearize_at(moved, camera, x, by_camera, by_intrinsics)
        if by_pose is not None:
            turn_derivative(moved, by_camera, by_pose)
        if by_point is not None:
            turn_back(pose, by_camera, by_point)
        return residual

    def linearize_at(self, moved: Tensor, camera: Tensor, x: Tensor, by_camera: Tensor, by_intrinsics: Tensor | None) -> Tensor:
        """Residuals of points in camera coordinates (3, m), and their derivatives by those and by free camera numbers."""
        rows, k = camera.mT, self._lens(camera)
        if issubclass(self.model, RADIAL):
            uv, by_parameter = _differentiate_radial(moved, k, by_camera)
        elif issubclass(self.model, BrownConrady):
            uv, by_parameter = _differentiate_brown(moved, k, by_camera)
        else:
            uv, by_parameter = _differentiate(self.model, moved, k, by_camera)
        focal = _focal(rows)
        residual = self._pixels(uv, rows, x.mT, focal)
        shear = rows[4] * by_camera[1] if self.skew else None
        by_camera *= focal[:, None]
        if shear is not None:
            by_camera[0] += shear
        if by_intrinsics is not None:
            self._by_intrinsics(uv, rows, focal, by_parameter, by_intrinsics)
            if self.switched:
                by_intrinsics *= rows[5 + self.model.num_parameters :]
        return residual.mT

    def _lens(self, camera: Tensor) -> Tensor:
        return camera.mT[5 : 5 + self.model.num_parameters]

    def _pixels(self, uv: Tensor, rows: Tensor, x: Tensor, focal: Tensor) -> Tensor:
        pixels = torch.addcmul(rows[2:4] - x, focal, uv)
        if self.skew:
            pixels = torch.stack((torch.addcmul(pixels[0], rows[4], uv[1]), pixels[1]))
        return pixels

    def _by_intrinsics(self, uv: Tensor, rows: Tensor, focal: Tensor, by_parameter: Sequence[Tensor], out: Tensor) -> None:
        for place, column in enumerate(self.free):
            here = out[:, place]
            if column == 0:
                here[0] = uv[0]
                torch.mul(rows[1], uv[1], out=here[1])
            elif column == 1:
                here[0] = 0
                torch.mul(rows[0], uv[1], out=here[1])
            elif column in (2, 3):
                here[column - 2] = 1
                here[3 - column] = 0
            elif column == 4:
                here[0] = uv[1]
                here[1] = 0
            else:
                by = by_parameter[column - 5]
                torch.mul(focal, by, out=here)
                if self.skew:
                    here[0].addcmul_(rows[4], by[1])


RADIAL = (NoDistortion, SimpleRadial, Radial)
NEAREST = 1e20
"""Largest reciprocal of a depth: it keeps every derivative finite for points in the focal plane."""


def _focal(rows: Tensor) -> Tensor:
    return torch.stack((rows[0], rows[0] * rows[1]))


def transform(pose: Tensor, point: Tensor) -> Tensor:
    """Points (m, 3), or rows that begin with one, after motions (m, 12), as (3, m)."""
    p = pose.mT
    X, Y, Z = point.mT[:3]
    return torch.addcmul(torch.addcmul(torch.addcmul(p[9:], p[0:9:3], X), p[1:9:3], Y), p[2:9:3], Z)


def turn_derivative(moved: Float[Tensor, "3 m"], by_place: Float[Tensor, "2 3 m"], out: Float[Tensor, "2 6 m"]) -> None:
    """Fill the first three rows: a small turn w moves a point by w x X, so the derivative is X x gradient."""
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        torch.mul(by_place[:, k], moved[j], out=out[:, i]).addcmul_(by_place[:, j], moved[k], value=-1)


def turn_back(pose: Float[Tensor, "m 12"], by_place: Float[Tensor, "2 3 m"], out: Float[Tensor, "2 3 m"]) -> None:
    """The derivative by a point before the motion."""
    R = pose.mT[:9].reshape(3, 3, -1)
    torch.mul(by_place[:, :1], R[0], out=out)
    out.addcmul_(by_place[:, 1:2], R[1]).addcmul_(by_place[:, 2:], R[2])


def _flatten(moved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`(X, Y) / Z`, 1 / Z, and the squared radius."""
    depth = moved[2].reciprocal().clamp(-NEAREST, NEAREST)
    uv = moved[:2] * depth
    return uv, depth, torch.addcmul(uv[0] * uv[0], uv[1], uv[1])


def _radial(s: Tensor, k: Tensor) -> Tensor:
    """`1 + k1 s + k2 s^2`."""
    inner = k[0] if len(k) == 1 else torch.addcmul(k[0], k[1], s)
    return 1 + inner * s


def _differentiate_radial(moved: Tensor, k: Tensor, by_ray: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Distorted coordinates (2, m) and their derivatives by each parameter (2, m); `by_ray` (2, 3, m) gets those by the ray.

    `h (x, y)` grows by h in every direction, and by `2 h' s` more outwards, where depth acts.
    """
    uv, depth, s = _flatten(moved)
    if not len(k):
        by_ray[:, :2] = 0
        by_ray[0, 0] = by_ray[1, 1] = depth
        torch.mul(uv, -depth, out=by_ray[:, 2])
        return uv, []
    h = _radial(s, k)
    slope = (k[0] if len(k) == 1 else torch.addcmul(k[0], k[1], s, value=2)) * depth * 2
    along = h * depth
    bent = uv * slope
    torch.addcmul(along, uv[0], bent[0], out=by_ray[0, 0])
    torch.addcmul(along, uv[1], bent[1], out=by_ray[1, 1])
    torch.mul(uv[0], bent[1], out=by_ray[0, 1])
    by_ray[1, 0] = by_ray[0, 1]
    torch.mul(uv, torch.addcmul(along, s, slope).neg_(), out=by_ray[:, 2])
    first = uv * s
    return uv * h, [first] if len(k) == 1 else [first, first * s]


def _differentiate_brown(moved: Tensor, k: Tensor, by_ray: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The same with decentring; the Jacobian by the flat coordinates is symmetric."""
    uv, depth, s = _flatten(moved)
    (x, y), (k1, k2, p1, p2, k3) = uv, k
    L, jxx, jxy, jyy, _ = brown_jacobian(x, y, s, (k1, k2, k3), p1, p2)
    torch.mul(jxx, depth, out=by_ray[0, 0])
    torch.mul(jyy, depth, out=by_ray[1, 1])
    torch.mul(jxy, depth, out=by_ray[0, 1])
    by_ray[1, 0] = by_ray[0, 1]
    torch.mul(by_ray[:, 0], -x, out=by_ray[:, 2]).addcmul_(by_ray[:, 1], y, value=-1)
    first = uv * s
    second = first * s
    both = 2 * x * y
    along = torch.stack((both, torch.addcmul(s, y, y, value=2)))
    across = torch.stack((torch.addcmul(s, x, x, value=2), both))
    distorted = torch.stack((torch.addcmul(x * L, p2, s), torch.addcmul(y * L, p1, s)))
    return distorted, [first, second, along, across, second * s]


def _differentiate(model: type[DistortionModel], moved: Tensor, k: Tensor, by_ray: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The same for any model, by two reverse sweeps."""
    leaves = [row.detach().requires_grad_() for row in (*moved, *k)]
    with torch.enable_grad():
        both = model.project_rows(*leaves)
        ones = torch.ones_like(leaves[0])
        du, dv = (torch.autograd.grad(c, leaves, ones, retain_graph=True, materialize_grads=True) for c in both)
    for row, slope in zip((*by_ray[0], *by_ray[1]), (*du[:3], *dv[:3]), strict=True):
        row.copy_(slope)
    return torch.stack(both).detach(), [torch.stack(pair) for pair in zip(du[3:], dv[3:], strict=True)]
