"""View graphs with known rotations: rings and random ones, edges with noise and wrong ones."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.geometry import random_rotation, rotation_from_rotvec


@dataclass(frozen=True)
class TrueGraph:
    """Relative rotations R of edges, the rotations they come from, and which are wrong."""

    rotations: Tensor
    edges: Tensor
    R: Tensor
    wrong: Tensor

    @property
    def views(self) -> int:
        return len(self.rotations)

    @property
    def answer(self) -> Tensor:
        """With the first camera as world."""
        return self.rotations @ self.rotations[0].mT


def ring(views: int, reach: int, noise: float, outliers: float, generator: torch.Generator) -> TrueGraph:
    """Every camera with the `reach` next ones, around a circle; wrong edges at random."""
    start = torch.arange(views)
    edges = torch.cat([torch.stack((start, (start + k + 1) % views), 1) for k in range(reach)])
    rotations = random_rotation(views, generator=generator, dtype=torch.float64)
    return with_edges(rotations, edges, noise, outliers, generator)


def with_edges(rotations: Tensor, edges: Tensor, noise: float, outliers: float, generator: torch.Generator) -> TrueGraph:
    i, j = edges.unbind(-1)
    turn = noise * torch.randn(len(edges), 3, generator=generator, dtype=torch.float64)
    R = rotation_from_rotvec(turn) @ rotations[j] @ rotations[i].mT
    wrong = torch.rand(len(edges), generator=generator) < outliers
    R = torch.where(wrong[:, None, None], random_rotation(len(edges), generator=generator, dtype=torch.float64), R)
    return TrueGraph(rotations, edges, R, wrong)
