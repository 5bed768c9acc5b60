"""Scenes for resection: simulated ones, and readers of the real ones."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

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
def read_vgg(data: Path) -> Callable[[str, str], tuple[Tensor, Tensor, Tensor, Tensor]]:
    """x (v, n, 2), visible (v, n), P (v, 3, 4), X (n, 3) of one of the Oxford sequences."""

    def read(folder: str, stem: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        root = data / "vgg" / folder
        # The sequences of three views have no stem, and keep their cameras with the images.
        stem = stem and f"{stem}."
        P = torch.tensor(np.stack([np.loadtxt(p) for p in sorted(root.glob(f"[23]D/{stem}*.P"))]))
        corners = [np.loadtxt(p) for p in sorted((root / "2D").glob(f"{stem}*.corners"))]
        table = [line.split() for line in (root / "2D" / f"{stem}nview-corners").read_text().splitlines()]
        index = torch.tensor([[-1 if entry == "*" else int(entry) for entry in row] for row in table]).T
        x = torch.stack([torch.tensor(c)[i.clamp_min(0)] for c, i in zip(corners, index, strict=True)])
        return x, index >= 0, P, torch.tensor(np.loadtxt(root / "3D" / f"{stem}p3d"))

    return read
