"""Exact random scenes, easy, hard and degenerate, of which every case cuts its samples."""

import math

import torch
from torch import Tensor

from torchsfm.geometry import random_rotation, rotation_from_rotvec

F64 = torch.float64
K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
HARD = (
    "near planar",
    "narrow view",
    "forward",
    "small baseline",
    "90 degree rotation",
    "far points",
)
"""Hard families of several views."""


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, dtype=F64, generator=generator)


def normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, dtype=F64, generator=generator)


def directions(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.nn.functional.normalize(normal(generator, *shape, 3), dim=-1)


def points(family: str, batch: int, n: int, generator: torch.Generator) -> Tensor:
    """Points `(batch, n, 3)` before a camera that looks along z from the origin, about 6 away."""
    X = 4 * uniform(generator, batch, n, 3) - 2
    X[..., 2] += 6
    if family == "near planar":
        # A plane across the view, and 1 % of the distance off it.
        X[..., 2] = 6 + 0.3 * X[..., 0] + 0.06 * uniform(generator, batch, n)
    elif family == "coplanar":
        X[..., 2] = 6 + 0.3 * X[..., 0] - 0.2 * X[..., 1]
    elif family == "narrow view":
        # Four degrees, from 60 away.
        X[..., 2] += 54
    elif family == "far points":
        X = X * 1000 ** uniform(generator, batch, n, 1)
    elif family == "all at infinity":
        X = X * 1e12
    elif family == "repeated points":
        X[:, 1:] = X[:, :1]
    elif family == "collinear":
        X = X[:, :1] + (X[:, -1:] - X[:, :1]) * torch.linspace(0, 1, n, dtype=F64)[:, None]
    return X


def views(family: str, batch: int, n: int, generator: torch.Generator, count: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """Points `(batch, n, 3)` in the frame of the first camera, and `(batch, count, 3, 3)` R and `(batch, count, 3)` t of all.

    The first is at the origin. The scene is about 4 wide and 6 away, neighbouring cameras about 1 from each other.
    """
    X = points(family, batch, n, generator)
    t = directions(generator, batch, count) * (1 + 0.5 * uniform(generator, batch, count, 1))
    w = 0.3 * normal(generator, batch, count, 3)
    if family == "narrow view":
        # Cameras 5 from each other that look at the scene's middle.
        t, w = 5 * t, 0.02 * w
        w = w - torch.stack((-t[..., 1], t[..., 0], torch.zeros_like(t[..., 0])), -1) / 60
    elif family == "forward":
        t = torch.tensor([0.0, 0, -0.5], dtype=F64) * torch.arange(count, dtype=F64)[:, None] + 0.01 * t
        w = 0.1 * w
    elif family == "small baseline":
        t, w = 0.06 * t, 0.2 * w
    elif family == "pure rotation":
        t = 0 * t
    elif family == "zero baseline":
        t, w = 0 * t, 0 * w
    R = rotation_from_rotvec(w)
    if family == "90 degree rotation":
        # Around the middle of the scene, and only around the optical axis in half of the samples.
        axis = directions(generator, batch, count)
        axis[: batch // 2] = torch.tensor([0.0, 0, 1], dtype=F64)
        R = rotation_from_rotvec(math.pi / 2 * axis)
        middle = torch.tensor([0.0, 0, 6], dtype=F64)
        t = t + middle - R @ middle
    R, t = R.clone(), t.clone()
    R[:, 0], t[:, 0] = torch.eye(3, dtype=F64), 0
    return X, R, t


def plane_views(family: str, batch: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same for two views of points on a plane `normal' X = 6`, with the normal `(batch, 3)` as well."""
    X, R, t = views(family, batch, n, generator)
    a = normal(generator, batch, 3) * 0.2
    a[:, 2] = 1
    if family == "far points":
        # A ground plane, up to the horizon.
        a = torch.tensor([0.0, 4, 0], dtype=F64).expand(batch, 3)
        X = torch.stack((X[..., 0], X[..., 2] * 1000 ** -uniform(generator, batch, n), X[..., 2]), -1)
    elif family == "near collinear":
        # Three points less than 0.2 % of their distance from a line.
        X = X / X[..., 2:]
        X[:, 2] = X[:, 0] + uniform(generator, batch, 1) * (X[:, 1] - X[:, 0]) + 1e-3 * normal(generator, batch, 3)
        X[..., 2] = 1
    elif family == "collinear":
        X = X / X[..., 2:]
        X = X[:, :1] + (X[:, -1:] - X[:, :1]) * torch.linspace(0, 1, n, dtype=F64)[:, None]
    distance = {"narrow view": 60.0, "all at infinity": 6e12}.get(family, 6.0)
    return X * (distance / (X * a[:, None]).sum(-1, keepdim=True)), R, t, a / distance


def camera(family: str, batch: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Points in a camera's frame and in the world's, `(batch, n, 3)` each, and `[R | t]` `(batch, 3, 4)`."""
    Y = points(family, batch, n, generator)
    R = random_rotation(batch, generator=generator, dtype=F64)
    t = normal(generator, batch, 3)
    if family == "sliver triangle":
        # The third point less than 0.2 % from the line of the others, or that close to one of them.
        Y[:, 2] = Y[:, 0] + uniform(generator, batch, 1) * (Y[:, 1] - Y[:, 0]) + 3e-3 * normal(generator, batch, 3)
        Y[batch // 2 :, 2] = Y[batch // 2 :, 0] + 3e-3 * normal(generator, batch - batch // 2, 3)
    elif family == "centre near the plane":
        Y[..., 1] = 0.2 * Y[..., 0] + 0.01 * normal(generator, batch, n)
    elif family == "90 degree rotation":
        axes = torch.eye(3, dtype=F64)[torch.randint(3, (batch,), generator=generator)]
        R = rotation_from_rotvec(math.pi / 2 * axes)
    elif family == "small baseline":
        t = 1e-3 * t
    elif family == "zero baseline":
        t = 0 * t
        R = torch.eye(3, dtype=F64).expand(batch, 3, 3)
    elif family == "pure rotation":
        t = 0 * t
    return Y, (Y - t[:, None]) @ R, torch.cat((R, t[..., None]), -1)


def pixels(X: Tensor) -> Tensor:
    """Of points in a camera's frame, through `K`."""
    x = X @ K.mT
    return x[..., :2] / x[..., 2:]
