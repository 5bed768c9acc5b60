"""Circles on a plane through a lens: the centres of their outlines, and cameras from these."""

import math

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import calibrate_planes
from torchsfm.autocalibration.circle_outlines import centre_weights, circle_points, outline_centres
from torchsfm.geometry import Camera, Pose, Radial, intrinsics, rotation_from_rotvec
from torchsfm.images import fit_ellipse

F64 = torch.float64
COLUMNS, ROWS = 6, 5
LENSES = [(0.0, 0.0), (-0.25, 0.08)]


def camera(lens: tuple[float, float]) -> Camera:
    K = intrinsics(torch.tensor(500.0, dtype=F64), torch.tensor([322.0, 236.0], dtype=F64))
    return Camera(K, Radial(*torch.tensor(lens, dtype=F64)))


def boards(v: int, generator: torch.Generator) -> Pose:
    R = rotation_from_rotvec(torch.rand(v, 3, generator=generator, dtype=F64) * 1.2 - 0.6)
    middle = torch.tensor([(COLUMNS - 1) / 2, (ROWS - 1) / 2, 0.0], dtype=F64)
    place = torch.rand(v, 3, generator=generator, dtype=F64) - 0.5 + torch.tensor([0.0, 0.0, 7.5], dtype=F64)
    return Pose(R, place - R @ middle)


def places() -> Tensor:
    number = torch.arange(COLUMNS * ROWS)
    return torch.stack((number % COLUMNS, number // COLUMNS), -1).double()


def seen(poses: Pose, lens: Camera, X: Tensor) -> Tensor:
    """Image points (v, n, 2) of points on the plane."""
    space = torch.nn.functional.pad(X, (0, 1)).expand(*poses.shape, -1, 3)
    return lens.project(poses.transform(space))


def ellipses(poses: Pose, lens: Camera, radius: float, number: int = 200) -> Tensor:
    """Centres (v, n, 2) of ellipses that are fitted to the outlines, by their orthogonal distances."""
    at = torch.arange(number, dtype=F64) * (2 * math.pi / number)
    around = places()[:, None] + radius * torch.stack((at.cos(), at.sin()), -1)
    points = seen(poses, lens, around.flatten(0, 1)).unflatten(1, (-1, number))
    # As many to each length of the outline as edge points are.
    step = (points.roll(-1, 2) - points.roll(1, 2)).norm(dim=-1)
    return fit_ellipse(points, weights=step).model.centre


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("radius", [0.2, 0.42])
def test_centres_are_those_of_fitted_ellipses(lens: tuple[float, float], radius: float, generator: torch.Generator) -> None:
    poses, own = boards(4, generator), camera(lens)
    p = seen(poses, own, circle_points(places(), radius)).movedim(-1, 0)
    weights = centre_weights(p)
    found = outline_centres(weights, p).movedim(0, -1)
    centres = ellipses(poses, own, radius)
    moved = (centres - seen(poses, own, places())).norm(dim=-1)
    assert float(moved.max()) > 10 * float((found - centres).norm(dim=-1).max())
    assert float((found - centres).norm(dim=-1).max()) < 0.01
    # Where all points move alike, so does the centre.
    total = weights.reshape(2, 2, -1, COLUMNS * ROWS, weights.shape[-1] // (COLUMNS * ROWS)).sum(-1)
    torch.testing.assert_close(total, torch.eye(2, dtype=F64)[:, :, None, None].expand_as(total), rtol=0, atol=1e-6)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("radius", [0.2, 0.3, 0.42])
def test_large_circles_calibrate_without_bias(lens: tuple[float, float], radius: float, generator: torch.Generator) -> None:
    poses, own = boards(8, generator), camera(lens)
    x = ellipses(poses, own, radius)
    result = calibrate_planes(x, places(), image_size=(640.0, 480.0), radius=radius)
    assert result.status == Status.OK
    assert float((result.camera.K - own.K).abs().max()) < 0.1
    assert float(result.rms) < 2e-3
    # As points they are not where the middles of the circles are.
    wrong = calibrate_planes(x, places(), image_size=(640.0, 480.0))
    assert float(wrong.rms) > 10 * float(result.rms)


def test_deviations_are_true_and_derivatives_those_of_the_optimum(generator: torch.Generator) -> None:
    poses, own = boards(5, generator), camera((-0.2, 0.05))
    exact = ellipses(poses, own, 0.4)
    x = exact + 0.05 * torch.randn(60, *exact.shape, generator=generator, dtype=F64)
    many = calibrate_planes(x, places(), image_size=(640.0, 480.0), radius=0.4)
    score = (many.camera.K[:, 0, 0] - 500.0) / many.deviation[:, 0]
    # Chi-square of 60 freedoms.
    assert 0.55 < float(score.square().mean()) < 1.6
    x = x[0].requires_grad_()
    found = calibrate_planes(x, places(), image_size=(640.0, 480.0), radius=0.4, max_iterations=200)
    (slope,) = torch.autograd.grad(found.camera.K[0, 0], x)
    step = torch.randn(x.shape, generator=generator, dtype=F64)
    moved = [
        calibrate_planes(x.detach() + h * step, places(), image_size=(640.0, 480.0), radius=0.4, max_iterations=200)
        for h in (1e-3, -1e-3)
    ]
    difference = (moved[0].camera.K[0, 0] - moved[1].camera.K[0, 0]) / 2e-3
    torch.testing.assert_close((slope * step).sum(), difference, rtol=1e-2, atol=1e-4)


def test_wrong_radius(unchecked: None) -> None:
    with pytest.raises(ValueError, match="radius"):
        calibrate_planes(torch.zeros(2, 9, 2), torch.zeros(9, 2), radius=0.0)
