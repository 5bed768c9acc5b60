"""Metric scenes seen by unknown cameras, and their projective reconstructions in arbitrary frames, scales and signs."""

from dataclasses import dataclass

import torch
from torch import Tensor

SIZE = (1000.0, 750.0)
MOTIONS = ("translation", "one axis", "planar", "orbital", "collinear")


@dataclass(frozen=True)
class ProjectiveScene:
    """Observations, the projective reconstruction, and the truth."""

    P: Tensor
    X: Tensor
    x: Tensor
    visible: Tensor
    K: Tensor
    R: Tensor
    centre: Tensor
    distortion: Tensor


def projective_scene(
    generator: torch.Generator,
    v: int,
    n: int = 40,
    *,
    motion: str = "general",
    noise: float = 0.0,
    focal: float | None = None,
    varying: bool = False,
    offset: float = 0.01,
    aspect: float = 1.0,
    skew: float = 0.0,
    variation: float = 0.2,
    around: float = 1.8,
    distortion: float = 0.0,
) -> ProjectiveScene:
    """Cameras around a cube of points that fills the image; focal lengths 0.6 to 4 times the width unless given.

    With noise or distortion the projective reconstruction is the one of least reprojection error. `variation` is the standard
    deviation of the logarithms of focal lengths that are `varying`, `around` the range of directions in radians, `distortion`
    the standard deviation of the first radial coefficient.
    """

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    width, height = SIZE
    f = 0.6 * float(torch.tensor(4 / 0.6).log().mul(uniform(1)[0]).exp()) if focal is None else focal
    each = f * (variation * normal(v)).exp() if varying else torch.full((v,), f, dtype=torch.float64)
    K = torch.zeros(v, 3, 3, dtype=torch.float64)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 1], K[:, 2, 2] = each * width, each * width * aspect, each * width * skew, 1
    K[:, :2, 2] = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64) + offset * width * normal(2)
    distance = 2.4 * f
    far = distance * (1 + 0.15 * normal(v)).clamp(0.75, 1.5)
    angle, height_angle, tilt = around * (uniform(v) - 0.5), 0.8 * (uniform(v) - 0.5), 0.5 * normal(v)
    target = 0.25 * normal(v, 3)
    if motion in ("one axis", "planar"):
        height_angle, tilt = 0 * height_angle, 0 * tilt
        target[:, 1] = 0
    if motion == "orbital":
        far, target, tilt = torch.full_like(far, distance), 0 * target, 0 * tilt
    centre = torch.stack((angle.sin() * height_angle.cos(), -height_angle.sin(), -angle.cos() * height_angle.cos()), -1)
    centre = far[:, None] * centre
    if motion == "collinear":
        s = torch.linspace(-0.7, 0.7, v, dtype=torch.float64) + 0.05 * normal(v)
        centre = distance * torch.stack((s, 0.2 * s, -torch.ones_like(s)), -1)
    z = torch.nn.functional.normalize(target - centre, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).to(z).expand(v, 3), z), dim=-1)
    y = torch.linalg.cross(z, x)
    c, s = tilt.cos()[:, None], tilt.sin()[:, None]
    R = torch.stack((c * x + s * y, c * y - s * x, z), -2)
    if motion == "one axis":
        centre = centre + 0.15 * distance * normal(v, 3)
    if motion == "translation":
        R = R[:1].expand(v, 3, 3).clone()
        centre = centre[:1] + 0.3 * distance * normal(v, 3) * torch.tensor([0.5, 0.5, 1.0])
    P = K @ torch.cat((R, -R @ centre[..., None]), -1)
    X = torch.cat((2 * uniform(n, 3) - 1, torch.ones(n, 1, dtype=torch.float64)), -1)
    h = X @ P.mT
    image = h[..., :2] / h[..., 2:]
    limit = torch.tensor([width, height], dtype=torch.float64)
    visible = (h[..., 2] > 0) & ((image > -0.2 * limit) & (image < 1.2 * limit)).all(-1)
    k = torch.zeros((), dtype=torch.float64)
    if distortion:
        k = distortion * normal(1)[0]
        offsets = (image - (limit - 1) / 2) / width
        image = (limit - 1) / 2 + width * offsets * (1 + k * offsets.square().sum(-1, keepdim=True))
    image = image + noise * normal(v, n, 2)
    frame = torch.eye(4, dtype=torch.float64) + 0.3 * normal(4, 4)
    P, X = P @ frame, torch.linalg.solve(frame, X.mT).mT
    if noise or distortion:
        P, X = adjust(P, X, image, visible)
    P = P * (normal(v).exp() * normal(v).sign())[:, None, None]
    X = X * (normal(n).exp() * normal(n).sign())[:, None]
    return ProjectiveScene(P, X, image, visible, K, R, centre, k)


def stack(scenes: list[ProjectiveScene]) -> ProjectiveScene:
    """A batch."""
    return ProjectiveScene(*(torch.stack([getattr(s, name) for s in scenes]) for name in ProjectiveScene.__dataclass_fields__))


def adjust(P: Tensor, X: Tensor, x: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Newton steps of least length on the reprojection error, from cameras and points that are nearly right."""
    v, n = visible.shape
    view, point = visible.nonzero(as_tuple=True)
    row = torch.arange(len(view))
    P, X = P / P.flatten(1).norm(dim=1)[:, None, None], X / X.norm(dim=1, keepdim=True)
    for _ in range(3):
        h = (P[view] @ X[point][..., None])[..., 0]
        D = torch.zeros(len(view), 2, 3, dtype=P.dtype)
        D[:, 0, 0] = D[:, 1, 1] = 1 / h[:, 2]
        D[:, :, 2] = -h[:, :2] / h[:, 2:] ** 2
        J = torch.zeros(len(view), 2, v * 12 + n * 4, dtype=P.dtype)
        J[row[:, None], :, view[:, None] * 12 + torch.arange(12)] = (
            (D[..., None] * X[point][:, None, None]).flatten(2).transpose(1, 2)
        )
        J[row[:, None], :, v * 12 + point[:, None] * 4 + torch.arange(4)] = (D @ P[view]).transpose(1, 2)
        A, r = J.flatten(0, 1), (x[view, point] - h[:, :2] / h[:, 2:]).flatten()
        # Columns of very different size would spoil the rank.
        scale = A.norm(dim=0).clamp_min(1e-12)
        values, U = torch.linalg.eigh((A / scale).mT @ (A / scale))
        inverse = torch.where(values > 1e-12 * values[-1], 1 / values, 0.0)
        step = (U @ (inverse * (U.mT @ ((A / scale).mT @ r)))) / scale
        P = P + step[: 12 * v].reshape(v, 3, 4)
        X = X + step[12 * v :].reshape(n, 4)
    return P, X
