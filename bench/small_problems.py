"""Ten thousand small least-squares problems at once: problems per second, against loops over SciPy and PoseLib.

`python -m bench.small_problems` prints the table; `pytest bench/small_problems.py` times the batches with pytest-benchmark.
Everything starts at the same numbers and ends at a relative decrease of 1e-8; one thread, CPU seconds. SciPy (`least_squares`,
method "lm", numerical Jacobians, the same residual as a function of tensors) and PoseLib's refiners solve a hundred of the same
problems, one a call. "automatic" differentiates the residual, "written" has `linearize`.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsfm.geometry import rotation_from_rotvec
from torchsfm.optim import LeastSquaresResult, Product, RigidMotion, Rotation, UnitSphere, levenberg_marquardt

FOCAL = 800.0
NOISE = 0.5 / FOCAL


@dataclass(frozen=True)
class Family:
    """Problems of one kind, in units of the focal length."""

    name: str
    residual: Callable[..., Tensor]
    start: Tensor
    data: tuple[Tensor, ...]
    manifold: Any
    linearize: Callable[..., tuple[Tensor, Tensor]] | None
    refine: Callable[[int], Any] | None
    """PoseLib's refiner on one of them."""

    def solve(self, written: bool) -> LeastSquaresResult[Tensor]:
        """All of them."""
        retract, size = (
            (None, self.start.shape[-1]) if self.manifold is None else (self.manifold.retract, self.manifold.tangent)
        )
        return levenberg_marquardt(
            self.residual, self.start, *self.data, retract=retract, size=size,
            linearize=self.linearize if written else None, function_tolerance=1e-8,
        )  # fmt: skip


def _normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def project(pose: Tensor, X: Tensor) -> Tensor:
    moved = X @ pose[..., :9].unflatten(-1, (3, 3)).mT + pose[..., None, 9:]
    return moved[..., :2] / moved[..., 2:]


def linearize_pose(pose: Tensor, x: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """The chain rule, one long row per entry."""
    p, (X1, X2, X3) = pose[:, :, None], X.unbind(-1)
    a, b, c = (p[:, 3 * i] * X1 + p[:, 3 * i + 1] * X2 + p[:, 3 * i + 2] * X3 + p[:, 9 + i] for i in range(3))
    depth = 1 / c
    u, v, zero = a * depth, b * depth, torch.zeros_like(a)
    rows = (-u * v, 1 + u * u, -v, depth, zero, -u * depth, -(1 + v * v), u * v, u, zero, depth, -v * depth)
    return torch.stack((u, v), -1) - x, torch.stack(rows, -1).unflatten(-1, (2, 6))


def poses(count: int, generator: torch.Generator) -> Family:
    """Poses from 50 known points."""
    R = rotation_from_rotvec(0.3 * _normal(generator, count, 3))
    t = 0.3 * _normal(generator, count, 3) + torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)
    pose, X = torch.cat((R.flatten(1), t), 1), _normal(generator, count, 50, 3)
    x = project(pose, X) + NOISE * _normal(generator, count, 50, 2)
    start = RigidMotion().retract(pose, 0.05 * _normal(generator, count, 6))
    camera = {"model": "SIMPLE_PINHOLE", "width": 1000, "height": 1000, "params": [FOCAL, 0.0, 0.0]}

    def refine(i: int) -> Any:
        import poselib

        guess = poselib.CameraPose()
        guess.R, guess.t = start[i, :9].view(3, 3).numpy(), start[i, 9:].numpy()
        return poselib.refine_absolute_pose((FOCAL * x[i]).numpy(), X[i].numpy(), guess, camera, {})

    return Family("pose, 50 points", lambda p, x, X: project(p, X) - x, start, (x, X), RigidMotion(), linearize_pose, refine)


def linearize_point(X: Tensor, x: Tensor, P: Tensor) -> tuple[Tensor, Tensor]:
    a, b, c = (P[..., i, :3] @ X[..., None] + P[..., i, 3:] for i in range(3))
    depth = 1 / c
    u, v = a * depth, b * depth
    by = torch.stack((P[..., 0, :3] - u * P[..., 2, :3], P[..., 1, :3] - v * P[..., 2, :3]), -2) * depth[..., None]
    return torch.cat((u, v), -1) - x, by


def points(count: int, generator: torch.Generator) -> Family:
    """Points from 8 views."""
    R = rotation_from_rotvec(0.3 * _normal(generator, count, 8, 3))
    t = _normal(generator, count, 8, 3) + torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)
    P, X = torch.cat((R, t[..., None]), -1), _normal(generator, count, 3)

    def residual(X: Tensor, x: Tensor, P: Tensor) -> Tensor:
        moved = (P[..., :3] @ X[..., None, :, None])[..., 0] + P[..., 3]
        return moved[..., :2] / moved[..., 2:] - x

    x = residual(X, torch.zeros(1, dtype=torch.float64), P) + NOISE * _normal(generator, count, 8, 2)
    return Family("point, 8 views", residual, X + 0.1 * _normal(generator, count, 3), (x, P), None, linearize_point, None)


def pairs(count: int, generator: torch.Generator) -> Family:
    """Relative poses, a rotation and a direction, from 100 pairs of points by their Sampson distances."""
    R = rotation_from_rotvec(0.2 * _normal(generator, count, 3))
    t = torch.nn.functional.normalize(_normal(generator, count, 3) * torch.tensor([1.0, 0.5, 0.3]), dim=-1)
    X = _normal(generator, count, 100, 3) + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    moved = X @ R.mT + t[:, None]
    x1, x2 = (y[..., :2] / y[..., 2:] + NOISE * _normal(generator, count, 100, 2) for y in (X, moved))
    manifold = Product((Rotation(), UnitSphere(3)))
    start = manifold.retract(torch.cat((R.flatten(1), t), 1), 0.03 * _normal(generator, count, 5))

    def residual(pose: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        E = torch.linalg.cross(pose[..., 9:, None].expand(*pose.shape[:-1], 3, 3), pose[..., :9].unflatten(-1, (3, 3)), dim=-2)
        l2 = x1 @ E[..., :, :2].mT + E[..., None, :, 2]
        l1 = x2 @ E[..., :2, :] + E[..., None, 2, :]
        product = (x2 * l2[..., :2]).sum(-1) + l2[..., 2]
        return (product / (l1[..., :2].square().sum(-1) + l2[..., :2].square().sum(-1)).sqrt())[..., None]

    camera = {"model": "SIMPLE_PINHOLE", "width": 1000, "height": 1000, "params": [FOCAL, 0.0, 0.0]}

    def refine(i: int) -> Any:
        import poselib

        guess = poselib.CameraPose()
        guess.R, guess.t = start[i, :9].view(3, 3).numpy(), start[i, 9:].numpy()
        return poselib.refine_relative_pose((FOCAL * x1[i]).numpy(), (FOCAL * x2[i]).numpy(), guess, camera, camera, {})

    return Family("pair, 100 matches", residual, start, (x1, x2), manifold, None, refine)


FAMILIES = (poses, points, pairs)


def scipy_solve(family: Family, i: int) -> float:
    """The cost that SciPy finds; the residual is the same function, of one problem."""
    from scipy.optimize import least_squares

    x, data = family.start[i], [d[i] for d in family.data]
    size = family.start.shape[-1] if family.manifold is None else family.manifold.tangent

    def residual(step: Any) -> Any:
        delta = torch.from_numpy(step)
        moved = x + delta if family.manifold is None else family.manifold.retract(x, delta)
        return family.residual(moved, *data).flatten().numpy()

    return float(least_squares(residual, np.zeros(size), method="lm", ftol=1e-8).cost)


def rate(function: Callable[[], Any], count: int, repeats: int = 3) -> tuple[float, Any]:
    """Problems per CPU second, best of some runs, and what the last one gave."""
    best, result = float("inf"), None
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        best = min(best, time.process_time() - start)
    return count / best, result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--loop", type=int, default=100, help="how many of them peers solve")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'problem':20s} {'program':22s} {'per second':>11s} {'mean cost of ' + str(arguments.loop):>18s}")
    for make in FAMILIES:
        compare(make(arguments.count, torch.Generator().manual_seed(0)), arguments.count, arguments.loop)


def compare(family: Family, count: int, loop: int) -> None:
    """The rows of one family."""
    for written in (False, True) if family.linearize else (False,):
        speed, found = rate(partial(family.solve, written), count)
        label = f"torchsfm, {'written' if written else 'automatic'}"
        print(f"{family.name:20s} {label:22s} {speed:11.0f} {float(found.cost[:loop].mean()):18.9g}", flush=True)
    speed, costs = rate(lambda: [scipy_solve(family, i) for i in range(loop)], loop, 1)
    print(f"{family.name:20s} {'SciPy':22s} {speed:11.0f} {float(np.mean(costs)):18.9g}", flush=True)
    refine = family.refine
    if refine is not None:
        speed, _ = rate(lambda: [refine(i) for i in range(loop)], loop)
        print(f"{family.name:20s} {'PoseLib':22s} {speed:11.0f}", flush=True)


@pytest.mark.parametrize("make", FAMILIES, ids=lambda f: f.__name__)
def test_small_problems(benchmark: Any, make: Callable[[int, torch.Generator], Family]) -> None:
    family = make(2000, torch.Generator().manual_seed(0))
    found = benchmark.pedantic(lambda: family.solve(family.linearize is not None), rounds=3, warmup_rounds=1)
    automatic = family.solve(False)
    assert (found.status == 0).all()
    torch.testing.assert_close(found.cost, automatic.cost, rtol=1e-6, atol=0)


if __name__ == "__main__":
    main()
