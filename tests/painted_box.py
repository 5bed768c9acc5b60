"""Photographs of a box with a disc on its top: its edges and the circle are all the curves there are."""

import math

import torch
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics

F64 = torch.float64
SIZE, FOCAL, RADIUS = 180, 315.0, 0.55
HALF = torch.tensor([1.0, 0.8, 0.6], dtype=F64)
"""Half the sides of the box."""
GREY = torch.tensor([[0.75, 0.4], [0.6, 0.3], [0.5, 0.9]], dtype=F64)
"""Of the faces at the far ends of the axes, then at the near ends."""


def orbit(views: int) -> Pose:
    """Around the box, from above, in two rows."""
    turn = torch.arange(views, dtype=F64) * (2 * math.pi / views)
    height = torch.where(torch.arange(views) % 2 == 0, 3.0, 4.6).double()
    centre = torch.stack((5.5 * turn.cos(), 5.5 * turn.sin(), height), -1)
    z = torch.nn.functional.normalize(-centre, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand_as(z)), dim=-1)
    R = torch.stack((x, torch.linalg.cross(z, x), z), -2)
    return Pose(R, -(R @ centre[..., None])[..., 0])


def camera(views: int) -> Camera:
    middle = torch.full((views, 2), (SIZE - 1) / 2, dtype=F64)
    return Camera(intrinsics(torch.full((views,), FOCAL, dtype=F64), middle))


def photograph(poses: Pose, lens: Camera | None = None, fine: int = 3) -> Tensor:
    """Images (v, 1, SIZE, SIZE), each pixel the mean of `fine` x `fine` rays, through a lens without distortion by default."""
    at = (torch.arange(SIZE * fine, dtype=F64) + 0.5) / fine - 0.5
    y, x = torch.meshgrid(at, at, indexing="ij")
    rays, _ = (lens or camera(1)[0]).unproject(torch.stack((x, y), -1).flatten(0, 1))
    d = rays.view(*x.shape, 3)
    images = []
    for R, centre in zip(poses.R, poses.centre, strict=True):
        ray = d @ R
        ends = torch.stack(((-HALF - centre) / ray, (HALF - centre) / ray))
        enter, axis = ends.amin(0).max(-1)
        hit = (enter > 0) & (enter < ends.amax(0).amin(-1))
        point = centre + enter[..., None] * ray
        front = point.gather(-1, axis[..., None])[..., 0] > 0
        shade = torch.where(front, GREY[axis, 0], GREY[axis, 1])
        disc = (axis == 2) & front & (point[..., :2].norm(dim=-1) < RADIUS)
        shade = torch.where(disc, 0.15, shade)
        images.append(torch.where(hit, shade, 0.05).unfold(0, fine, fine).unfold(1, fine, fine).mean((-1, -2)))
    return torch.stack(images)[:, None].float()


def true_curves(step: float = 0.005) -> dict[str, Tensor]:
    """Points of the curves that are seen: the upper edges, the upright ones and the circle; and of the lower edges."""
    x, y, z = HALF.tolist()
    corners = [(x, y), (-x, y), (-x, -y), (x, -y)]

    def segment(a: tuple[float, ...], b: tuple[float, ...]) -> Tensor:
        first, last = torch.tensor(a, dtype=F64), torch.tensor(b, dtype=F64)
        t = torch.arange(0, 1, step / float((last - first).norm()), dtype=F64)[:, None]
        return first + t * (last - first)

    turn = torch.arange(0, 2 * math.pi, step / RADIUS, dtype=F64)
    circle = torch.stack((RADIUS * turn.cos(), RADIUS * turn.sin(), torch.full_like(turn, z)), -1)
    ends = list(zip(corners, corners[1:] + corners[:1], strict=True))
    return {
        "upper": torch.cat([segment((*a, z), (*b, z)) for a, b in ends]),
        "upright": torch.cat([segment((*a, -z), (*a, z)) for a in corners]),
        "lower": torch.cat([segment((*a, -z), (*b, -z)) for a, b in ends]),
        "circle": circle,
    }
