"""Cameras, points and lines seen by several views, and how tensors are compared."""

import torch
from torch import Tensor

from torchsfm.geometry import rotation_from_rotvec

F64 = torch.float64
K = torch.tensor([[800.0, 1, 320], [0, 820, 240], [0, 0, 1]], dtype=F64)


def up_to_scale(A: Tensor, B: Tensor, order: int) -> Tensor:
    """Distance of tensors of `order` indices as points of projective space."""
    A, B = A.flatten(-order), B.flatten(-order)
    A, B = A / A.norm(dim=-1, keepdim=True), B / B.norm(dim=-1, keepdim=True)
    return torch.minimum((A - B).norm(dim=-1), (A + B).norm(dim=-1))


def cameras(*shape: int, v: int, generator: torch.Generator, calibration: Tensor = K, turn: float = 0.3) -> Tensor:
    """Cameras around the origin at distance 6, looking at it but for random turns."""
    w = turn * torch.randn(*shape, v, 3, generator=generator, dtype=F64)
    t = torch.randn(*shape, v, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0, 6], dtype=F64)
    return calibration @ torch.cat((rotation_from_rotvec(w), t[..., None]), -1)


def points(*shape: int, n: int, generator: torch.Generator) -> Tensor:
    return 3 * torch.rand(*shape, n, 3, generator=generator, dtype=F64) - 1.5


def images(P: Tensor, X: Tensor) -> Tensor:
    """(*shape, v, n, 2)."""
    y = X[..., None, :, :] @ P[..., :3].mT + P[..., None, :, 3]
    return y[..., :2] / y[..., 2:]


def line_images(P: Tensor, X: Tensor, Y: Tensor) -> Tensor:
    """Lines through the images of pairs of points, with unit normal."""
    a, b = (torch.nn.functional.pad(images(P, Z), (0, 1), value=1.0) for Z in (X, Y))
    line = torch.linalg.cross(a, b, dim=-1)
    return line / line[..., :2].norm(dim=-1, keepdim=True)


def line_through(x: Tensor, generator: torch.Generator) -> Tensor:
    """A line in a random direction through each point."""
    angle = 6.3 * torch.rand(x.shape[:-1], generator=generator, dtype=F64)
    normal = torch.stack((angle.cos(), angle.sin()), -1)
    return torch.cat((normal, -(normal * x).sum(-1, keepdim=True)), -1)
