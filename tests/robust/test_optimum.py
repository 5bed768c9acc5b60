"""What follows from a refined model being an optimum: its derivative and its covariance; and what its inliers may lack."""

from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import random_rotation, rotation_from_rotvec, rotvec_from_rotation
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.resection import estimate_camera
from torchsfm.robust import Degeneracy

FOCAL, CENTRE = 800.0, 500.0
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=torch.float64)
MODELS = ["fundamental", "essential", "homography", "camera"]


def pixels(X: Tensor) -> Tensor:
    return X[..., :2] / X[..., 2:] * FOCAL + CENTRE


def rays(x: Tensor) -> Tensor:
    return torch.cat(((x - CENTRE) / FOCAL, torch.ones_like(x[..., :1])), -1)


def clean_scene(model: str, p: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Exact data in pixels: two images, or an image and points."""
    kind: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(p, n, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6])
    if model == "camera":
        R = random_rotation(p, **kind)
        return pixels(X), (X - torch.tensor([0.0, 0, 6])) @ R
    R = rotation_from_rotvec((torch.rand(p, 3, **kind) - 0.5) * 0.5)
    t = torch.nn.functional.normalize(torch.randn(p, 3, **kind), dim=-1)
    if model == "homography":
        normal = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64) / 6
        X = X / (X @ normal)[..., None]
    return pixels(X), pixels(X @ R.mT + t[:, None])


def door(model: str, a: Tensor, b: Tensor, threshold: float = 2.0, **options: Any) -> Any:
    options = {"generator": torch.Generator().manual_seed(3), **options}
    if model == "fundamental":
        return estimate_fundamental(a, b, threshold=threshold, **options)
    if model == "homography":
        return estimate_homography(a, b, threshold=threshold, **options)
    if model == "camera":
        return estimate_camera(a, b, K, threshold=threshold, **options)
    return estimate_essential(rays(a), rays(b), threshold=threshold / FOCAL, **options)


def spoiled(x: Tensor, share: float, noise: float, generator: torch.Generator) -> Tensor:
    wrong = torch.rand(x.shape[:-1], generator=generator) < share
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    return torch.where(wrong[..., None], torch.rand(x.shape, generator=generator, dtype=torch.float64) * 1000, x)


# ---- derivatives ----


@pytest.mark.parametrize("model", MODELS)
def test_the_derivative_is_that_of_the_whole_estimation(model: str, generator: torch.Generator) -> None:
    """Against central differences of the door itself, sampling and all, in random directions of all data."""
    a, b = clean_scene(model, 3, 80, generator)
    a = spoiled(a, 0.2, 0.5, generator)
    tangents = [torch.randn(d.shape, generator=generator, dtype=torch.float64) * s for d, s in ((a, 1.0), (b, 0.01))]
    tangents[1] *= 1 if model == "camera" else 100
    free = [d.clone().requires_grad_() for d in (a, b)]
    result = door(model, *free)
    plain = door(model, a, b)
    assert torch.equal(result.model.detach(), plain.model)
    assert not plain.model.requires_grad
    weights = torch.randn(result.model.shape, generator=generator, dtype=torch.float64)
    gradients = torch.autograd.grad((weights * result.model).sum(), free)
    for g, inliers in zip(gradients, (plain.inliers, plain.inliers), strict=True):
        assert torch.isfinite(g).all()
        assert (g.abs().sum(-1) > 0)[inliers].double().mean() > 0.99
    slope = sum((g * d).flatten(1).sum(-1) for g, d in zip(gradients, tangents, strict=True))
    step = 1e-4
    ends = [door(model, a + s * tangents[0], b + s * tangents[1]).model for s in (-step, step)]
    difference = ((ends[1] - ends[0]) * weights).flatten(1).sum(-1) / (2 * step)
    torch.testing.assert_close(slope, difference, rtol=2e-3, atol=1e-7)


@pytest.mark.parametrize("model", MODELS)
def test_models_without_consensus_have_finite_derivatives(model: str, generator: torch.Generator) -> None:
    a, b = clean_scene(model, 4, 40, generator)
    a = spoiled(a, 0.1, 0.5, generator)
    a[0] = torch.rand(40, 2, generator=generator, dtype=torch.float64) * 1000
    a[1, 3] = torch.nan
    a[2, :] = a[2, :1].clone()
    a.requires_grad_()
    result = door(model, a, b)
    (gradient,) = torch.autograd.grad(result.model.sum(), [a])
    assert torch.isfinite(gradient).all()
    assert result.status[3] == Status.OK
    assert (gradient[3] != 0).any()
    assert (gradient[2] == 0).all()
    assert (gradient[1, 3] == 0).all()


# ---- covariance ----


@pytest.mark.parametrize("model", MODELS)
def test_the_covariance_is_that_of_many_trials(model: str, generator: torch.Generator) -> None:
    a, b = clean_scene(model, 1, 200, generator)
    trials = 150
    truth = door(model, a, b).model
    noisy = [spoiled(a.expand(trials, -1, -1), 0.0, 0.3, generator), b.expand(trials, -1, -1)]
    if model != "camera":
        noisy[1] = spoiled(noisy[1], 0.0, 0.3, generator)
    result = door(model, *noisy, threshold=1.5, covariance=True)
    if model == "camera":
        turn = rotvec_from_rotation(result.model[..., :3] @ truth[..., :3].mT)
        move = result.model[..., 3] - (result.model[..., :3] @ truth[..., :3].mT @ truth[..., 3:])[..., 0]
        error = torch.cat((turn, move), -1)
    else:
        flat, true = result.model.flatten(-2), truth.flatten(-2)
        error = flat * (flat * true).sum(-1, keepdim=True).sign() - true
    covariance = result.covariance
    assert covariance.shape == (trials, error.shape[-1], error.shape[-1])
    torch.testing.assert_close(covariance, covariance.mT, rtol=1e-6, atol=1e-18)
    rank = {"fundamental": 7, "essential": 5, "homography": 8, "camera": 6}[model]
    values, vectors = torch.linalg.eigh(covariance)
    assert (values[:, : error.shape[-1] - rank].abs() <= 1e-9 * values[:, -1:]).all()
    # In every direction of the manifold the squared error is as large as predicted: the mean of chi-squared / rank is 1.
    whitened = (error[:, None] @ vectors[..., -rank:])[:, 0] / values[:, -rank:].sqrt()
    assert 0.8 < (whitened**2).mean() < 1.25
    assert 0.65 < (whitened[:, -1] ** 2).mean() < 1.4


def test_covariance_is_computed_on_request_only(generator: torch.Generator) -> None:
    a, b = clean_scene("homography", 2, 30, generator)
    assert door("homography", a, b).covariance is None
    assert (door("homography", a[:, :3], b[:, :3], covariance=True).covariance == 0).all()


# ---- degeneracy ----


@pytest.mark.parametrize("model", MODELS)
def test_good_scenes_are_not_degenerate(model: str, generator: torch.Generator) -> None:
    a, b = clean_scene(model, 24, 150, generator)
    a = spoiled(a, 0.3, 0.5, generator)
    result = door(model, a, b)
    assert (result.degeneracy == Degeneracy.NONE).all()
    few = door(model, a[:, :3], b[:, :3]).degeneracy
    assert (few == Degeneracy.TOO_FEW).all()


def planes(generator: torch.Generator, p: int = 16) -> tuple[Tensor, Tensor]:
    a, b = clean_scene("homography", p, 200, generator)
    return spoiled(a, 0.2, 0.4, generator), spoiled(b, 0.0, 0.4, generator)


@pytest.mark.parametrize("model", ["fundamental", "essential"])
def test_planar_scenes_are_reported(model: str, generator: torch.Generator) -> None:
    result = door(model, *planes(generator))
    assert (result.degeneracy == Degeneracy.PLANAR).double().mean() > 0.9
    assert (door("homography", *planes(generator)).degeneracy == Degeneracy.NONE).all()


@pytest.mark.parametrize("model", ["fundamental", "essential"])
def test_rotations_are_reported(model: str, generator: torch.Generator) -> None:
    kind: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(16, 200, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6])
    R = rotation_from_rotvec((torch.rand(16, 3, **kind) - 0.5) * 0.5)
    a, b = spoiled(pixels(X), 0.2, 0.4, generator), spoiled(pixels(X @ R.mT), 0.0, 0.4, generator)
    code = Degeneracy.PLANAR if model == "fundamental" else Degeneracy.ROTATION
    assert (door(model, a, b).degeneracy == code).double().mean() > 0.9


def test_collinear_points_are_reported(generator: torch.Generator) -> None:
    kind: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    s = torch.rand(6, 100, 1, **kind) * 800 + 100
    a = torch.cat((s, 0.3 * s + 20), -1)
    b = 0.9 * a + 10
    result = door("homography", spoiled(a, 0.0, 0.3, generator), spoiled(b, 0.0, 0.3, generator))
    assert (result.degeneracy == Degeneracy.COLLINEAR).all()
    exact = door("homography", a, b)
    assert (exact.status != Status.OK).all()
    assert (exact.degeneracy == Degeneracy.COLLINEAR).all()
    _, X = clean_scene("camera", 6, 100, generator)
    line = X[:, :1] + torch.linspace(0, 1, 100, dtype=torch.float64)[:, None] * (X[:, 1:2] - X[:, :1])
    for points, code in ((line, Degeneracy.COLLINEAR), (torch.cat((X[..., :2], 0 * X[..., 2:]), -1), Degeneracy.PLANAR)):
        t = torch.tensor([0.0, 0, 6], dtype=torch.float64)
        R = random_rotation(6, **kind)
        images = spoiled(pixels(points @ R.mT + t), 0.1, 0.3, generator)
        assert (door("camera", images, points).degeneracy == code).all()
