"""A small reconstruction: four images, three of them registered, thirty points."""

import math
from dataclasses import replace

import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose, intrinsics
from torchsfm.reconstruction import Curves, Reconstruction
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


def with_curves(model: Reconstruction, *, finer: int = 1, shift: float = 0.0) -> Reconstruction:
    """The model with a circle, a part of a helix and a straight curve of two samples, as its registered images show them.

    The first two have so many times the samples, each further on by a part of the way to the next.
    """
    g = seeded(7)
    t = [
        (torch.arange(16 * finer) + shift) * (2 * math.pi / (16 * finer)),
        (torch.arange(12 * finer) + shift) * (3 / (12 * finer - 1)),
        torch.tensor([0.0, 1.0]),
    ]
    place, curve = torch.cat(t).double(), torch.arange(3).repeat_interleave(torch.tensor([len(part) for part in t]))
    bent, rise = torch.tensor([0.6, 0.5, 0.0]).double()[curve], torch.tensor([0.0, 0.3, 0.4]).double()[curve]

    def at(t: Tensor, of: Tensor) -> Tensor:
        return torch.stack((bent[of] * t.cos(), bent[of] * t.sin(), rise[of] * t), -1)

    def seen(t: Tensor, of: Tensor, view: Tensor) -> Tensor:
        camera = model.cameras[model.camera_index[view]]
        return camera.project(model.poses[view].transform(at(t, of)[:, None]))[:, 0]

    n = len(place)
    known = model.registered.nonzero()[:, 0]
    sample, view = torch.arange(n).repeat_interleave(len(known)), known.repeat(n)
    # The edge points are up to a pixel or two along their curves.
    on = place[sample] + 0.005 * torch.rand(len(sample), generator=g, dtype=torch.float64) / finer
    h = 1e-3
    before, x, after = (seen(on + step, sample, view) for step in (-h, 0, h))
    first, second = (after - before) / (2 * h), (after - 2 * x + before) / h**2
    normal = torch.stack((-first[:, 1], first[:, 0]), -1) / first.norm(dim=-1, keepdim=True)
    curvature = (normal * second).sum(-1) / first.square().sum(-1)
    color, one = torch.rand(n, 3, generator=g, dtype=torch.float64), torch.ones(n, dtype=torch.float64)
    curves = Curves(
        at(place, torch.arange(n)), curve, torch.tensor([True, False, True]), color, 0.01 * one, x, normal, curvature,
        4 + torch.rand(len(x), generator=g, dtype=torch.float64), view, sample,
    )  # fmt: skip
    return replace(model, curves=curves)
