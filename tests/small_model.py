"""A small reconstruction: four images, three of them registered, thirty points."""

from dataclasses import replace

import torch
from chance import seeded

from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose, intrinsics
from torchsfm.reconstruction import Reconstruction
from torchsfm.simulation import orbit_poses, random_points


def make(model: str = "radial") -> Reconstruction:
    g = seeded()
    v, n = 4, 30
    poses = orbit_poses(v, radius=5.0)
    X = random_points(n, generator=g)
    distortion = DISTORTION_MODELS[model]
    parameters = 0.01 * torch.rand(1, distortion.num_parameters, generator=g, dtype=torch.float64)
    f, c = torch.tensor([900.0], dtype=torch.float64), torch.tensor([[399.5, 299.5]], dtype=torch.float64)
    cameras = Camera(intrinsics(f, c), distortion.from_parameters(parameters))
    view, point = torch.arange(v - 1).repeat(n), torch.arange(n).repeat_interleave(v - 1)
    registered = torch.tensor([True, True, True, False])
    poses = Pose(torch.where(registered[:, None, None], poses.R, torch.eye(3).double()), poses.t * registered[:, None])
    empty = Reconstruction(
        names=("a.jpg", "b ä.jpg", "c.jpg", "d.jpg"),
        image_size=torch.tensor([[800, 600]] * v),
        cameras=cameras,
        camera_index=torch.zeros(v, dtype=torch.long),
        poses=poses,
        registered=registered,
        X=X,
        color=torch.rand(n, 3, generator=g, dtype=torch.float64),
        x=torch.zeros(len(view), 2, dtype=torch.float64),
        view=view,
        point=point,
    )
    noise = torch.randn(len(view), 2, generator=g, dtype=torch.float64)
    return replace(empty, x=empty.projections() + noise)
