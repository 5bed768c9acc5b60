"""Scenes for the autocalibration bench: unknown cameras around a cube of points, in general and in critical motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.bundle import bundle_adjust_projective
from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.motion import factorize_points
from torchsfm.simulation import look_at, simulate_images

SIZE = (1000, 750)
CRITICAL = ("translation", "one axis", "planar", "orbital", "collinear")


@dataclass(frozen=True)
class UnknownCameras:
    """Observations and the truth behind them, and the projective reconstruction made of the observations alone."""

    x: Tensor
    visible: Tensor
    K: Tensor
    poses: Pose
    P: Tensor
    X: Tensor
    solved: bool


def unknown_cameras(
    generator: torch.Generator,
    views: int,
    *,
    motion: str = "general",
    noise: float = 1.0,
    points: int = 60,
    offset: float = 0.01,
) -> UnknownCameras:
    """A scene whose one focal length is drawn between 0.6 and 4 times the image width, evenly in logarithm.

    The principal point is drawn around the middle of the image, with standard deviation `offset` of the width in x and y.
    Projective cameras come from factorisation and projective bundle adjustment.
    """

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    width, height = SIZE
    f = 0.6 * (4 / 0.6) ** uniform(1)[0]
    c = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64) + offset * width * normal(2)
    K = intrinsics(f * width, c)
    distance = 3.2 * f
    far = (distance * (1 + 0.15 * normal(views))).clamp(0.75 * distance, 1.5 * distance)
    around, above = 1.8 * (uniform(views) - 0.5), 0.8 * (uniform(views) - 0.5)
    target, roll = 0.25 * normal(views, 3), 0.5 * normal(views)
    if motion in ("one axis", "planar"):
        above, roll, target = 0 * above, 0 * roll, target * torch.tensor([1.0, 1.0, 0.0])
    if motion == "orbital":
        far, target, roll = distance.expand(views), 0 * target, 0 * roll
    direction = torch.stack((around.sin() * above.cos(), -around.cos() * above.cos(), above.sin()), -1)
    centre = far[:, None] * direction
    if motion == "collinear":
        s = torch.linspace(-0.7, 0.7, views, dtype=torch.float64) + 0.05 * normal(views)
        centre = distance * torch.stack((s, -torch.ones_like(s), 0.2 * s), -1)
    R = look_at(centre, target).R
    turn = torch.zeros(views, 3, 3, dtype=torch.float64)
    turn[:, 0, 0] = turn[:, 1, 1] = roll.cos()
    turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = -roll.sin(), roll.sin(), 1
    R = turn @ R
    if motion == "translation":
        R = R[:1].expand(views, 3, 3).clone()
        # Sideways as far as the cube stays in view, more along the axis.
        step = torch.stack((torch.tensor(0.4), torch.tensor(0.4), 0.15 * distance)).double()
        centre = centre[:1] + (step * normal(views, 3)) @ R[0]
    if motion == "one axis":
        centre = centre + 0.1 * distance * normal(views, 3)
    poses = Pose(R, -(R @ centre[..., None])[..., 0])
    X = 2 * uniform(points, 3) - 1
    seen = simulate_images(X, poses, Camera(K), image_size=SIZE, noise=noise, generator=generator)
    enough = seen.visible.sum(0) >= 3
    x, visible = seen.x[:, enough], seen.visible[:, enough]
    factors = factorize_points(x, visible=visible)
    used = visible & factors.used_view[:, None] & factors.used_point
    view, point = used.nonzero().unbind(-1)
    adjusted = bundle_adjust_projective(factors.P, factors.X, x[used], view, point, max_iterations=30)
    rms = float(adjusted.residuals.square().mean().sqrt())
    solved = bool(factors.used_view.all()) and rms < 1.6 * noise + 1e-6
    return UnknownCameras(x, used, K.expand(views, 3, 3), poses, adjusted.P, adjusted.X, solved)
