"""Scenes for resection: simulated ones, and readers of the real ones."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsfm.formats import VggScene, read_vgg
from torchsfm.geometry import random_rotation

Scene = tuple[Tensor, Tensor, Tensor]


@pytest.fixture
def make_scene(generator: torch.Generator) -> Callable[..., Scene]:
    """Points in the field of view of cameras: points in the camera's frame Y (*b, n, 3), in the world X, and [R | t]."""

    def make(*batch: int, n: int = 3, width: float = 1.0) -> Scene:
        def uniform(*shape: int) -> Tensor:
            return torch.rand(*batch, *shape, generator=generator, dtype=torch.float64)

        direction = torch.cat((width * (2 * uniform(n, 2) - 1), torch.ones(*batch, n, 1, dtype=torch.float64)), -1)
        Y = direction * (1 + 9 * uniform(n, 1))
        R = random_rotation(*batch, generator=generator, dtype=torch.float64)
        t = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
        return Y, (Y - t[..., None, :]) @ R, torch.cat((R, t[..., None]), -1)

    return make


@pytest.fixture
def pose6dscene(data: Path) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x (95, 2) in pixels, X (95, 3), and K and [R | t] of a real image."""
    folder = data / "absolute_pose" / "pose6dscene"
    points = torch.tensor(np.loadtxt(folder / "pose6dscene_points.txt", skiprows=1))
    K = torch.tensor(np.loadtxt(folder / "pose6dscene.K"))
    truth = torch.tensor(np.loadtxt(folder / "pose6dscene_gt.txt"))
    return points[:, :2], points[:, 2:5], K, truth


@pytest.fixture
def oxford(data: Path) -> Callable[[str], VggScene]:
    """One of the Oxford sequences by the name of its folder."""
    return lambda folder: read_vgg(data / "vgg" / folder)
