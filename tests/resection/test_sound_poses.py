"""What minimal solvers of the pose call a solution is one, whatever the sizes of rays and points."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchsfm import Solutions, Status, camera_dlt, camera_gp3p, camera_p3p, camera_up2p, resect_cameras
from torchsfm.geometry import random_rotation

N = 400
F64 = torch.float64


def p3p(d: Tensor, X: Tensor, R: Tensor) -> Solutions[Tensor]:
    return camera_p3p(d, X)


def gp3p(d: Tensor, X: Tensor, R: Tensor) -> Solutions[Tensor]:
    return camera_gp3p(torch.zeros_like(d), d, X)


def up2p(d: Tensor, X: Tensor, R: Tensor) -> Solutions[Tensor]:
    return camera_up2p(d[:, :2], X[:, :2], R[:, :, 1], R.new_tensor([0.0, 1, 0]).expand(len(R), 3))


every_solver = pytest.mark.parametrize("solve", [p3p, gp3p, up2p])
Solve = Callable[[Tensor, Tensor, Tensor], Solutions[Tensor]]


def scene(generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points, rays to them, and the pose."""
    X = torch.rand(N, 3, 3, generator=generator, dtype=F64) * 4 - 2
    R = random_rotation(N, generator=generator, dtype=F64)
    t = torch.tensor([0.0, 0, 7], dtype=F64).expand(N, 3)
    return X, X @ R.mT + t[:, None], R, t


def assert_sound(found: Solutions[Tensor], d: Tensor, X: Tensor) -> None:
    R, t = found.model[..., :3], found.model[..., 3]
    count = 2 if found.valid.shape[-1] == 2 else 3
    Y = X[:, None, :count] @ R.mT + t[..., None, :]
    aside = torch.linalg.cross(torch.nn.functional.normalize(d, dim=-1)[:, None, :count], Y).norm(dim=-1)
    size = X[:, None, :count].norm(dim=-1) + t.norm(dim=-1, keepdim=True)
    assert ((aside / size).amax(-1)[found.valid] < 1e-5).all()
    assert torch.isfinite(found.model).all()


@every_solver
def test_rays_whose_squares_are_no_numbers(solve: Solve, generator: torch.Generator) -> None:
    X, Y, R, _ = scene(generator)
    size = 10 ** (320 * torch.rand(N, 3, 1, generator=generator, dtype=F64) - 160)
    found = solve(Y * size, X, R)
    unit = Y / Y.norm(dim=-1, keepdim=True)
    assert_sound(found, unit, X)


@every_solver
def test_points_at_the_camera(solve: Solve, generator: torch.Generator) -> None:
    """From there a point is seen along any ray: rounding decides."""
    X, Y, R, t = scene(generator)
    X[:, 1] = -(R.mT @ t[..., None])[..., 0]
    found = solve(Y, X, R)
    assert_sound(found, Y, X)
    true = (found.model - torch.cat((R, t[..., None]), -1)[:, None]).abs().amax((-2, -1)) < 1e-6
    assert not (found.valid & true).any()


@every_solver
@pytest.mark.parametrize("far", [1e4, 1e8, 1e12])
def test_points_far_behind_the_others(solve: Solve, far: float, generator: torch.Generator) -> None:
    """Rounding of the far ones turns the triangle: either the near ones are where they are seen, or there is no solution."""
    X, Y, R, _ = scene(generator)
    X[:, 0] = far * torch.rand(N, 3, generator=generator, dtype=F64)
    found = solve(Y, X, R)
    assert_sound(found, Y, X)
    if far < 1e6:
        assert found.valid.any(-1).double().mean() > 0.3


def test_cameras_that_no_number_holds(generator: torch.Generator) -> None:
    """A point as far away as float32 goes leaves a camera beyond it, or none."""
    X, Y, _, _ = scene(generator)
    X, Y = X.reshape(-1, 20, 3), Y.reshape(-1, 20, 3)
    x = 800 * Y[..., :2] / Y[..., 2:] + 500
    x[:, 3] *= 1e30
    found = camera_dlt(x.float(), X.float())
    good = found.status == Status.OK
    assert torch.isfinite(found.model).all()
    assert (found.model[good] != 0).flatten(1).any(-1).all()
    several = resect_cameras(x.float()[:, None], X.float())
    good = several.status == Status.OK
    assert torch.isfinite(several.model[good]).all()
    assert (several.model[good] != 0).flatten(1).any(-1).all()
