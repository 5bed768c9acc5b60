"""Figures without a screen, and a small model with exact geometry."""

from collections.abc import Iterator

import pytest
import torch
from chance import seeded

from torchsfm.geometry import Camera, Radial
from torchsfm.geometry.cameras import intrinsics
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.simulation import orbit_poses, random_points, simulate_images


@pytest.fixture(autouse=True)
def backend() -> Iterator[None]:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    yield
    plt.close("all")


@pytest.fixture
def model() -> Reconstruction:
    """Five images of 200 points, the last but one not registered, with half a pixel of noise."""
    g = seeded()
    X = random_points(200, generator=g)
    poses = orbit_poses(5, radius=4.0, height=(0.5, 2.0))
    K = intrinsics(torch.tensor([500.0], dtype=torch.float64), torch.tensor([[320.0, 240.0]], dtype=torch.float64))
    cameras = Camera(K, Radial(torch.tensor([-0.1], dtype=torch.float64), torch.tensor([0.01], dtype=torch.float64)))
    seen = simulate_images(X, poses, cameras, image_size=(640, 480), noise=0.5, dropout=0.2, generator=g)
    visible = seen.visible.clone()
    visible[3] = False
    point, view = visible.T.nonzero(as_tuple=True)
    registered = torch.tensor([True, True, True, False, True])
    poses.R[3], poses.t[3] = torch.eye(3, dtype=torch.float64), 0.0
    return Reconstruction(
        names=tuple(f"view_{i}.png" for i in range(5)),
        image_size=torch.tensor([[640, 480]]).repeat(5, 1),
        cameras=cameras,
        camera_index=torch.zeros(5, dtype=torch.long),
        poses=poses,
        registered=registered,
        X=X,
        color=torch.rand(200, 3, generator=g, dtype=torch.float64),
        x=seen.x[view, point],
        view=view,
        point=point,
    )
