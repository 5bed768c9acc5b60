"""Least squares of reprojection errors without a robust loss, thousands of small problems at once.

The same minimum as by `levenberg_marquardt`, with what makes it fast: coordinates in rows, residuals next to the Jacobian so
that one product gives cost, gradient and normal matrix, and no pass over the points that is not needed.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import Pose, rotation_from_rotvec
from torchsfm.geometry.projection import turn_slopes
from torchsfm.optim.dense import DenseSystem, dense_system, passable
from torchsfm.optim.descent import Descent, Options, descend
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, pick
from torchsfm.resection.reprojection import Inside, State, camera_frame

_FLAT = 1e-14
"""A problem ends when no more than this fraction of its cost is left to gain."""
_EXACT = 5e-27
"""Or no more than this, for unit weights in focal lengths."""


def minimise_squares(
    pose: Pose, theta: Tensor, x: Tensor, X: Tensor, w: Tensor, inside: Inside, max_iterations: int
) -> Descent:
    """Levenberg-Marquardt for poses (b), displacements theta (b, k) and points (b, n), all float64, weights >= 0."""
    root = None if bool((w == 1).all()) else w.sqrt()[:, None, None]
    f = inside.camera.K[:, 0, 0]
    M = x.new_empty(len(x), 7 + theta.shape[-1], 2, x.shape[-2])
    problem = _Squares(x.movedim(-1, 0).contiguous(), X.mT.contiguous(), root, inside, _EXACT * w.sum(-1) * f * f, M)
    return descend(problem, (pose, theta), Options(max_iterations, _FLAT), enough=2 * (w > 0).sum(-1) >= M.shape[1] - 1)


@dataclass(frozen=True)
class _Squares(Problem[DenseSystem]):
    """Points in rows, roots of weights if any, and memory for the Jacobian with the residual (b, k + 1, 2, n)."""

    x: Float[Tensor, "2 b n"]
    X: Float[Tensor, "b 3 n"]
    root: Float[Tensor, "b 1 1 n"] | None
    inside: Inside
    least: Float[Tensor, "b"]
    memory: Tensor

    def pick(self, at: Places) -> "_Squares":
        """Some of the problems."""
        X, root, inside, least = pick(at, (self.X, self.root, self.inside, self.least))
        return _Squares(self.x.index_select(1, at[0]), X, root, inside, least, self.memory[: len(X)])

    def linearize(self, x: State) -> DenseSystem:
        """The products with each other of the Jacobian's columns and, last, the residual."""
        pose, theta = x
        ray, out = camera_frame(pose, self.X), self.memory.permute(2, 1, 0, 3)
        pixels = self.inside.projection.linearize(ray, self.inside.row(theta), out[:, 3:6], out[:, 6:-1])
        turn_slopes(ray, out[:, 3:6], out)
        torch.sub(pixels, self.x, out=out[:, -1])
        rows = self.memory if self.root is None else self.memory.mul_(self.root)
        rows = rows.flatten(2)
        moments = rows @ rows.mT
        return dense_system(x, moments[:, -1, -1] / 2, moments[:, :-1, -1], moments[:, :-1, :-1])

    def advance(self, here: DenseSystem, step: Step) -> DenseSystem:
        """The system where a step leads."""
        pose, theta = here.x
        turn = rotation_from_rotvec(step.delta[:, :3])
        moved = Pose(turn @ pose.R, (turn @ pose.t[..., None])[..., 0] + step.delta[:, 3:6])
        return passable(self.linearize((moved, theta + step.delta[:, 6:])))

    def rounding(self, here: DenseSystem) -> Tensor:
        """What rounding makes of image points."""
        return self.least
