"""The reprojection residual of one observation and its derivatives, as a term for the sparse optimiser.

A camera is one row of numbers here, `(fx, fy / fx, cx, cy, skew, distortion...)`, so that "focal" is one number.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import Camera, DistortionModel, NoDistortion, Radial, SimpleRadial

COORDINATES: dict[str, tuple[int, ...]] = {"focal": (0,), "aspect": (1,), "principal_point": (2, 3), "skew": (4,)}
"""Columns of a camera row by the names users know."""


def camera_rows(camera: Camera) -> Float[Tensor, "g k"]:
    """Cameras as rows of numbers."""
    K = camera.K
    fx = K[:, 0, 0]
    head = torch.stack((fx, K[:, 1, 1] / fx, K[:, 0, 2], K[:, 1, 2], K[:, 0, 1]), -1)
    names = camera.distortion.parameter_names
    return torch.cat((head, *(getattr(camera.distortion, name)[:, None] for name in names)), -1)


def camera_from_rows(rows: Float[Tensor, "g k"], model: type[DistortionModel]) -> Camera:
    """Cameras from rows of numbers."""
    fx, aspect, cx, cy, skew = rows[:, :5].unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack((fx, skew, cx, zero, fx * aspect, cy, zero, zero, one), -1).reshape(-1, 3, 3)
    return Camera(K, model.from_parameters(rows[:, 5:]))  # type: ignore[arg-type]


def free_columns(names: Sequence[str], model: type[DistortionModel]) -> tuple[int, ...]:
    """The columns of a camera row that names stand for, in order."""
    columns = dict(COORDINATES)
    columns.update({name: (5 + i,) for i, name in enumerate(model.parameter_names)})
    for name in names:
        if name not in columns:
            raise ValueError(f"free: wanted names among {sorted(columns)}, got {name!r}")
    return tuple(sorted({c for name in names for c in columns[name]}))


@dataclass(frozen=True)
class Projection:
    """Projection of points `(m, 3)` by poses `(m, 12)` and cameras `(m, 5 + p)`, minus the image points `(m, 2)`."""

    model: type[DistortionModel]
    free: tuple[int, ...]
    """Columns of the camera row that are optimised."""

    def residual(self, pose: Tensor, camera: Tensor, point: Tensor, x: Tensor) -> Tensor:
        """Predicted minus measured image points, pixels; finite for all finite points, also behind the camera."""
        X, Y, Z = _transform(pose, point)
        u, v = self.model.project_rows(X, Y, Z, *camera[:, 5:].unbind(-1))
        fx, aspect, cx, cy, skew = camera[:, :5].unbind(-1)
        ex = torch.addcmul(torch.addcmul(cx - x[:, 0], fx, u), skew, v)
        ey = torch.addcmul(cy - x[:, 1], fx * aspect, v)
        return torch.stack((ex, ey)).mT

    def linearize(
        self, pose: Tensor, camera: Tensor, point: Tensor, x: Tensor, wanted: tuple[bool, ...]
    ) -> tuple[Tensor, list[Tensor | None]]:
        """Residuals, and Jacobians by pose step, free camera numbers and point; by the chain rule, written out."""
        X, Y, Z = _transform(pose, point)
        distortion = camera[:, 5:].unbind(-1)
        u, v, by_ray, by_parameter = _distort(self.model, X, Y, Z, distortion)
        fx, aspect, cx, cy, skew = camera[:, :5].unbind(-1)
        fy = fx * aspect
        ex = torch.addcmul(torch.addcmul(cx - x[:, 0], fx, u), skew, v)
        ey = torch.addcmul(cy - x[:, 1], fy, v)
        # Pixels by camera coordinates: (2, 3, m).
        by_camera = torch.stack((torch.addcmul(fx * by_ray[0], skew, by_ray[1]), fy * by_ray[1]))
        jacobians: list[Tensor | None] = [None, None, None]
        if wanted[0]:
            gx, gy, gz = by_camera.unbind(1)
            turn = (
                torch.addcmul(Y * gz, Z, gy, value=-1),
                torch.addcmul(Z * gx, X, gz, value=-1),
                torch.addcmul(X * gy, Y, gx, value=-1),
            )
            jacobians[0] = torch.cat((torch.stack(turn, 1), by_camera), 1).permute(2, 0, 1)
        if wanted[1]:
            zero, one = torch.zeros_like(ex), torch.ones_like(ex)
            columns = [(u, aspect * v), (zero, fx * v), (one, zero), (zero, one), (v, zero)]
            columns += [(torch.addcmul(fx * du, skew, dv), fy * dv) for du, dv in by_parameter]
            chosen = [columns[c] for c in self.free]
            jacobians[1] = torch.stack([torch.stack(pair) for pair in chosen], 1).permute(2, 0, 1)
        if wanted[2]:
            R = pose.mT[:9].reshape(3, 3, -1)
            by_point = by_camera[:, 0, None] * R[0]
            by_point.addcmul_(by_camera[:, 1, None], R[1]).addcmul_(by_camera[:, 2, None], R[2])
            jacobians[2] = by_point.permute(2, 0, 1)
        return torch.stack((ex, ey)).mT, jacobians


def _transform(pose: Tensor, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    p = pose.mT
    X, Y, Z = point.unbind(-1)
    moved = torch.addcmul(p[9:], p[0:9:3], X).addcmul_(p[1:9:3], Y) if not pose.requires_grad else None
    if moved is None or point.requires_grad:
        moved = p[9:] + p[0:9:3] * X + p[1:9:3] * Y + p[2:9:3] * Z
    else:
        moved.addcmul_(p[2:9:3], Z)
    a, b, c = moved.unbind(0)
    return a, b, c


def _distort(
    model: type[DistortionModel], X: Tensor, Y: Tensor, Z: Tensor, parameters: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
    """Distorted coordinates with derivatives by the ray (2, 3, m) and by each parameter."""
    if issubclass(model, NoDistortion | SimpleRadial | Radial):
        return _radial(X, Y, Z, parameters)
    leaves = [r.detach().requires_grad_() for r in (X, Y, Z, *parameters)]
    with torch.enable_grad():
        both = model.project_rows(*leaves)
        ones = torch.ones_like(X)
        du, dv = (torch.autograd.grad(c, leaves, ones, retain_graph=True, materialize_grads=True) for c in both)
    by_ray = torch.stack((torch.stack(du[:3]), torch.stack(dv[:3])))
    return both[0].detach(), both[1].detach(), by_ray, list(zip(du[3:], dv[3:], strict=True))


def _radial(
    X: Tensor, Y: Tensor, Z: Tensor, parameters: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
    """`(x, y) (1 + k1 s + k2 s^2)` with s = x^2 + y^2, x = X / Z, y = Y / Z."""
    eps = torch.finfo(Z.dtype).eps
    floor = torch.maximum(X.abs(), Y.abs()) * eps + eps * eps
    depth = 1 / torch.copysign(torch.maximum(Z.abs(), floor), Z)
    x, y = X * depth, Y * depth
    zero = torch.zeros_like(x)
    if not parameters:
        by_ray = torch.stack((torch.stack((depth, zero, -x * depth)), torch.stack((zero, depth, -y * depth))))
        return x, y, by_ray, []
    s = torch.addcmul(x * x, y, y)
    k1 = parameters[0]
    if len(parameters) == 1:
        h = torch.addcmul(torch.ones_like(s), k1, s)
        slope = 2 * k1
    else:
        k2 = parameters[1]
        h = torch.addcmul(torch.ones_like(s), torch.addcmul(k1, k2, s), s)
        slope = 2 * torch.addcmul(k1, k2, s, value=2)
    # h (x, y) grows by h in every direction and by s slope more outwards; outwards is what depth changes.
    out = torch.addcmul(h, s, slope) * depth
    xs, ys = x * slope, y * slope
    xx = torch.addcmul(h, x, xs) * depth
    yy = torch.addcmul(h, y, ys) * depth
    xy = x * ys * depth
    by_ray = torch.stack((torch.stack((xx, xy, -x * out)), torch.stack((xy, yy, -y * out))))
    by_parameter = [(x * s, y * s)]
    if len(parameters) == 2:
        by_parameter.append((x * s * s, y * s * s))
    return x * h, y * h, by_ray, by_parameter
