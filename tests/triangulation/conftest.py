"""Scenes for triangulation: simulated ones, and readers of the real ones."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsfm.formats import VggScene, read_vgg

Scene = tuple[Tensor, Tensor, Tensor]


@pytest.fixture
def make_scene(generator: torch.Generator) -> Callable[..., Scene]:
    """Points in front of cameras that look at them from about the origin: x (*b, v, n, 2), P (*b, v, 3, 4), X (*b, n, 3)."""

    def make(
        *batch: int,
        v: int = 3,
        n: int = 20,
        noise: float = 0.0,
        depth: float = 10.0,
        origin: float = 0.0,
        focal: float = 1000.0,
    ) -> Scene:
        def normal(*shape: int) -> Tensor:
            return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

        centre, target = normal(v, 3), 0.5 * normal(v, 3)
        target[..., 2] += depth
        z = torch.nn.functional.normalize(target - centre, dim=-1)
        x_axis = torch.nn.functional.normalize(torch.linalg.cross(normal(v, 3), z), dim=-1)
        R = torch.stack((x_axis, torch.linalg.cross(z, x_axis), z), -2)
        K = torch.tensor([[focal, 0.0, 0.5 * focal], [0.0, 1.1 * focal, 0.4 * focal], [0.0, 0.0, 1.0]], dtype=torch.float64)
        centre = centre + origin
        P = K @ torch.cat((R, -R @ centre[..., None]), -1)
        X = normal(n, 3) * depth / 5
        X[..., 2] += depth
        X = X + origin
        x = project(P, X)
        return x + noise * normal(v, n, 2), P, X

    return make


def project(P: Tensor, X: Tensor) -> Tensor:
    """Images (*b, v, n, 2) of points (*b, n, 3), written out independently of the library."""
    h = X[..., None, :, :] @ P[..., :3].mT + P[..., None, :, 3]
    return h[..., :2] / h[..., 2:]


@pytest.fixture
def image_of() -> Callable[[Tensor, Tensor], Tensor]:
    return project


@pytest.fixture
def oxford(data: Path) -> Callable[[str], VggScene]:
    """One of the Oxford sequences by the name of its folder."""
    return lambda folder: read_vgg(data / "vgg" / folder)


@pytest.fixture
def dinosaur(data: Path) -> tuple[Tensor, Tensor, Tensor]:
    """x (v, n, 2), visible (v, n) and P (v, 3, 4) of the turntable sequence; coordinates are (row, column) in all."""
    from scipy.io import loadmat

    folder = data / "vgg" / "dinosaur"
    P = torch.tensor(np.stack([p.astype(np.float64) for p in loadmat(folder / "dino_Ps.mat")["P"][0]]))
    table = torch.tensor(np.loadtxt(folder / "viff.xy")).unflatten(1, (36, 2)).transpose(0, 1)
    return table.contiguous(), (table != -1).all(-1), P
