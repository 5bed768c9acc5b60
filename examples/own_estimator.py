"""An estimator of one's own: RANSAC over lines in the plane, and over similarities of space, in about thirty lines each.

What the engine wants to know of a model is how to solve a minimal sample, which samples are not worth it, how far data are from
a model, and how to take a robust step. It then samples, scores, optimises and stops, for all problems of a batch at once.

    python examples/own_estimator.py
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchsfm import Solutions, ransac
from torchsfm.geometry import random_rotation, similarity_from_points
from torchsfm.robust import Weigh


@dataclass(frozen=True)
class LineEstimator:
    """Lines l = (a, b, c) with l'x = 0 and a^2 + b^2 = 1; a datum is a point."""

    sample_size: ClassVar[int] = 2
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 1

    def minimal(self, x: Tensor) -> Solutions[Tensor]:
        """The line through two points."""
        ends = torch.nn.functional.pad(x, (0, 1), value=1.0)
        line = torch.linalg.cross(ends[..., 0, :], ends[..., 1, :])
        return Solutions((line / line[..., :2].norm(dim=-1, keepdim=True))[..., None, :], ~self.degenerate(x)[..., None])

    def degenerate(self, x: Tensor) -> Tensor:
        """Whether the points coincide."""
        return (x[..., 0, :] == x[..., 1, :]).all(-1)

    def squared_residual(self, line: Tensor, x: Tensor) -> Tensor:
        """The squared distance of points from a line."""
        return ((x * line[..., None, :2]).sum(-1) + line[..., 2:]).square()

    def step(self, line: Tensor, x: Tensor, *, weigh: Weigh) -> Tensor:
        """The line of weighted least squares."""
        weights, _ = weigh(self.squared_residual(line, x))
        share = (weights / weights.sum(-1, keepdim=True).clamp(min=1e-12))[..., None]
        centre = (share * x).sum(-2)
        gap = x - centre[..., None, :]
        normal = torch.linalg.eigh((share * gap).mT @ gap)[1][..., 0]
        return torch.cat((normal, -(normal * centre).sum(-1, keepdim=True)), -1)


@dataclass(frozen=True)
class SimilarityEstimator:
    """Similarities Y = s R X + t as matrices [s R | t]; a datum is a pair of points in space."""

    sample_size: ClassVar[int] = 3
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 3

    def minimal(self, X: Tensor, Y: Tensor) -> Solutions[Tensor]:
        """The similarity nearest to three pairs."""
        found = similarity_from_points(X, Y)
        return Solutions(found.matrix()[..., None, :3, :], ~self.degenerate(X, Y)[..., None])

    def degenerate(self, X: Tensor, Y: Tensor) -> Tensor:
        """Whether the points are on a line."""
        sides = X[..., 1:, :] - X[..., :1, :]
        return torch.linalg.cross(sides[..., 0, :], sides[..., 1, :]).norm(dim=-1) < 1e-9

    def squared_residual(self, model: Tensor, X: Tensor, Y: Tensor) -> Tensor:
        """The squared distance in the space of Y."""
        return (X @ model[..., :3].mT + model[..., None, :, 3] - Y).square().sum(-1)

    def step(self, model: Tensor, X: Tensor, Y: Tensor, *, weigh: Weigh) -> Tensor:
        """The similarity of weighted least squares."""
        weights, _ = weigh(self.squared_residual(model, X, Y))
        return similarity_from_points(X, Y, weights=weights).matrix()[..., :3, :]


# %% Lines: 64 problems, half of the points wrong
generator = torch.Generator().manual_seed(0)


def random(*shape: int) -> Tensor:
    """Numbers between 0 and 1."""
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


angle, offset = 2 * torch.pi * random(64, 1), 20 * random(64, 1)
normal, along = torch.cat((angle.cos(), angle.sin()), -1), torch.cat((-angle.sin(), angle.cos()), -1)
on = (offset * normal)[:, None] + 100 * (random(64, 200, 1) - 0.5) * along[:, None]
noise = 0.1 * torch.randn(64, 200, 2, generator=generator, dtype=torch.float64)
wrong = random(64, 200, 1) < 0.5
x = torch.where(wrong, 100 * (random(64, 200, 2) - 0.5), on + noise)
found = ransac(LineEstimator(), x, threshold=0.4, generator=generator)
off = (found.model[:, None, :2] * on).sum(-1) + found.model[:, None, 2]
print(f"lines: true points are {off.abs().median():.3f} off (noise 0.1), at most {int(found.iterations.max())} samples")

# %% Similarities: 64 problems, 70 % of the pairs wrong
scale, R, t = 0.5 + random(64, 1, 1), random_rotation(64, generator=generator, dtype=torch.float64), random(64, 1, 3)
X = random(64, 300, 3)
exact = scale * X @ R.mT + t
noise = 0.002 * torch.randn(64, 300, 3, generator=generator, dtype=torch.float64)
Y = torch.where(random(64, 300, 1) < 0.7, 3 * random(64, 300, 3) - 1, exact + noise)
similar = ransac(SimilarityEstimator(), X, Y, threshold=0.01, generator=generator)
error = (X @ similar.model[..., :3].mT + similar.model[:, None, :, 3] - exact).norm(dim=-1)
print(f"similarities: {error.median():.5f} off (noise 0.002), at most {int(similar.iterations.max())} samples")

# %% What is missing is said at once


class Unfinished:
    """Half an estimator."""

    sample_size = 2

    def minimal(self, x: Tensor) -> Solutions[Tensor]:
        """The line through two points."""
        return LineEstimator().minimal(x)


try:
    ransac(Unfinished(), x, threshold=0.4)  # type: ignore[arg-type]
except ValueError as error_message:
    print(error_message)
