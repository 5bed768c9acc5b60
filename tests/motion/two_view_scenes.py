"""Exact scenes for two calibrated views: an easy family and hard ones that are not degenerate."""

import math

import torch
from torch import Tensor

from torchsfm.geometry.rotations import cross_matrix, rotation_from_rotvec

F64 = torch.float64
K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
FAMILIES = (
    "random",
    "near planar",
    "narrow view",
    "forward",
    "sideways",
    "small baseline",
    "tiny baseline",
    "far points",
    "roll 90",
    "convergent 90",
)


def two_views(family: str, count: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Points in the coordinates of both cameras, (count, n, 3) each, and E with |E|^2 = 2."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, dtype=F64, generator=generator)

    def turn(largest: float) -> Tensor:
        axis = torch.nn.functional.normalize(torch.randn(count, 3, dtype=F64, generator=generator), dim=-1)
        return rotation_from_rotvec(axis * largest * uniform(count, 1))

    t = torch.nn.functional.normalize(torch.randn(count, 3, dtype=F64, generator=generator), dim=-1)
    R, X = turn(0.5), 4 * uniform(count, n, 3) - 2
    X[..., 2] += 6
    if family == "near planar":
        X[..., 2] = 6 + 0.3 * X[..., 0] + 0.01 * uniform(count, n)
    elif family == "narrow view":
        X[..., 2] += 60
        R, t = turn(0.02), 3 * t
    elif family == "forward":
        t = torch.tensor([0.0, 0, 1], dtype=F64) + 0.01 * torch.randn(count, 3, dtype=F64, generator=generator)
        R = turn(0.05)
    elif family == "sideways":
        R, t = torch.eye(3, dtype=F64).expand(count, 3, 3), torch.tensor([1.0, 0, 0], dtype=F64).expand(count, 3)
    elif family == "small baseline":
        R, t = turn(0.1), 0.1 * t
    elif family == "tiny baseline":
        R, t = turn(0.1), 0.06 * t
    elif family == "far points":
        X = X * 100 ** uniform(count, n, 1)
    elif family == "roll 90":
        R = rotation_from_rotvec(torch.tensor([0.0, 0, math.pi / 2], dtype=F64)) @ turn(0.3)
    elif family == "convergent 90":
        R = rotation_from_rotvec(torch.tensor([0.0, math.pi / 2, 0], dtype=F64)).expand(count, 3, 3)
        centre = torch.tensor([-6.0, 0, 6], dtype=F64) + 0.3 * torch.randn(count, 3, dtype=F64, generator=generator)
        t = -(R @ centre[..., None])[..., 0]
    E = cross_matrix(t) @ R
    return X, X @ R.mT + t[:, None], E * (2**0.5 / E.norm(dim=(-2, -1), keepdim=True))


def pixels(X: Tensor) -> Tensor:
    x = X @ K.mT
    return x[..., :2] / x[..., 2:]


def fundamental(E: Tensor) -> Tensor:
    """F of pixels with |F| = 1."""
    F = torch.linalg.inv(K).mT @ E @ torch.linalg.inv(K)
    return F / F.norm(dim=(-2, -1), keepdim=True)


def distance(found: Tensor, valid: Tensor, truth: Tensor) -> Tensor:
    """From the truth to the nearest valid slot, as unit matrices of either sign; 9 where none is valid."""
    found, truth = (A.double() / A.double().norm(dim=(-2, -1), keepdim=True) for A in (found, truth))
    truth = truth[..., None, :, :]
    gap = torch.minimum((found - truth).norm(dim=(-2, -1)), (found + truth).norm(dim=(-2, -1)))
    return torch.where(valid, gap, 9).amin(-1)
