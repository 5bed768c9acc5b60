"""What follows from a refined model being an optimum: its derivative and its covariance; and what its inliers may lack."""

import sys
from functools import partial
from typing import Any

import pytest
import torch
from chance import assert_share, assert_unit_variance
from robust_doors import DOORS, F64, Door, Scene, extremes, pixels
from torch import Tensor

from torchsfm._types import Status, tensor_map
from torchsfm.geometry import random_rotation, rotation_from_rotvec
from torchsfm.robust import Degeneracy, optimum
from torchsfm.robust.optimum import step_covariance

ransac_file = sys.modules["torchsfm.robust.ransac"]
"""The name `torchsfm.robust.ransac` is that of the function."""

every_door = pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
every_door_but_triangulation = pytest.mark.parametrize(
    "door", [door for name, door in DOORS.items() if name != "point"], ids=[name for name in DOORS if name != "point"]
)
"""Triangulation has a covariance of its own."""


# ---- derivatives ----


def estimate(door: Door, data: int, inputs: list[Tensor], **options: Any) -> Any:
    """The door as a function of its data, of what else it knows, and of weights."""
    return door(Scene(tuple(inputs[:data]), tuple(inputs[data:-1])), weights=inputs[-1], **options)


@every_door
def test_the_derivative_is_that_of_the_whole_estimation(door: Door, generator: torch.Generator) -> None:
    """Against central differences of the door itself, sampling and all, in random directions of each input."""
    scene = door.make(3, 80, generator, noise=0.4, wrong=0.2)
    inputs = [*scene.data, *scene.known, 0.5 + torch.rand(3, 80, generator=generator, dtype=F64)]
    free, data = [d.clone().requires_grad_() for d in inputs], len(scene.data)
    result, plain = estimate(door, data, free), estimate(door, data, inputs)
    assert torch.equal(result.model.detach(), plain.model)
    assert not plain.model.requires_grad
    mix = torch.randn(result.model.shape, generator=generator, dtype=F64)
    gradients = torch.autograd.grad((mix * result.model).sum(), free)

    def value_and_data_used(at: list[Tensor]) -> tuple[Tensor, Tensor]:
        first = at[0].clone().requires_grad_()
        value = (mix * estimate(door, data, [first, *at[1:]]).model).flatten(1).sum(-1)
        return value.detach(), (torch.autograd.grad(value.sum(), first)[0] != 0).any(-1)

    (value, used), compared = value_and_data_used(inputs), []
    for d, g in zip(inputs[:data], gradients, strict=False):
        # The reach of the final loss may end a little before the threshold.
        assert ((g == 0).all(-1) & plain.inliers).sum() <= 2, d.shape
    for i, (x, g) in enumerate(zip(inputs, gradients, strict=True)):
        assert torch.isfinite(g).all()
        step = 2e-4 * torch.randn(x.shape, generator=generator, dtype=F64)
        if i >= door.images:
            # Weights move the model so little that the change would be lost in how exactly the search ends.
            step = (10 if i == len(inputs) - 1 else 0.1) * step * x.abs()
        if door is DOORS["upright"] and data <= i < data + 2:
            step = 0.1 * (step - (step * x).sum(-1, keepdim=True) * x)
        slope = (g * step).flatten(1).sum(-1)
        (low, before), (high, after) = (value_and_data_used([*inputs[:i], x + s * step, *inputs[i + 1 :]]) for s in (-1, 1))
        difference = (high - low) / 2
        # Where a datum comes within the reach of the loss, the derivative jumps; where the reach changes, the model does.
        smooth = (before == used).all(-1) & (after == used).all(-1)
        smooth &= (high + low - 2 * value).abs() < 0.2 * difference.abs().max()
        compared.append(smooth)
        assert ((slope - difference).abs() < 2e-3 * difference.abs().max() + 1e-12)[smooth].all(), (i, slope, difference)
    assert_share(torch.stack(compared), at_least=0.8)


@every_door
def test_problems_without_model_have_finite_derivatives_and_covariance(door: Door, generator: torch.Generator) -> None:
    n = 60
    scene, mask, sizes = extremes(door, generator)
    inputs = [*(d[:, :n] for d in scene.data), *(k.clone() for k in scene.known), torch.ones(len(sizes), n, dtype=F64)]
    for known in inputs[len(scene.data) : -1]:
        known[list(sizes).index("huge")] = torch.nan
    inputs[-1][list(sizes).index("right"), :3] = torch.tensor([torch.nan, -1.0, torch.inf], dtype=F64)
    for x in inputs:
        x.requires_grad_()
    result = estimate(door, len(scene.data), inputs, mask=mask[:, :n], max_iterations=100, covariance=True)
    assert torch.isfinite(result.model).all()
    assert torch.isfinite(result.covariance).all()
    gradients = torch.autograd.grad(result.model.sum(), inputs)
    for g in gradients:
        assert torch.isfinite(g).all(), g.shape
    for i, name in enumerate(sizes):
        good = bool(result.status[i] == Status.OK)
        assert bool((result.covariance[i] != 0).any()) == good, name
        for g in (*gradients[: len(scene.data)], gradients[-1]):
            assert bool((g[i] != 0).any()) == good, (name, g.shape)
    assert (gradients[-1][list(sizes).index("right"), :3] == 0).all()
    known = bool(scene.known)
    assert (result.status[list(sizes).index("huge")] == Status.OK) != known
    assert result.status[list(sizes).index("right")] == Status.OK


# ---- covariance ----


def spread(door: Door, trials: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Errors of many trials, and the covariances predicted, for noise small enough for first order."""
    noise = 0.05
    exact = door.scene(1, 150, generator)
    truth = door(exact).model
    found = door(exact.expand(trials).noisy(noise, 0.0, door.images, generator), 6 * noise, covariance=True)
    assert (found.status == Status.OK).all()
    # Points know nothing of the noise.
    unit = noise**2 if door is DOORS["point"] else 1.0
    return door.difference(found.model, truth), unit * found.covariance


def check_spread(door: Door, error: Tensor, covariance: Tensor) -> None:
    assert covariance.shape == (len(error), error.shape[-1], error.shape[-1])
    torch.testing.assert_close(covariance, covariance.mT, rtol=1e-6, atol=1e-9 * float(covariance.abs().amax()))
    values = torch.linalg.eigvalsh(covariance)
    assert (values[:, : error.shape[-1] - door.rank].abs() <= 1e-9 * values[:, -1:]).all()
    # What few data tell, their scatter tells badly: each covariance may be too small, their mean is not.
    values, vectors = torch.linalg.eigh(covariance.mean(0))
    # Of directions that vary enough to be seen next to the curvature of the manifold.
    scores = ((error @ vectors) / values.clamp(min=1e-300).sqrt())[:, -min(door.rank, 4) :]
    assert_unit_variance(scores)
    assert_unit_variance(scores, dim=0)


@every_door
def test_the_covariance_is_that_of_many_trials(door: Door, generator: torch.Generator) -> None:
    check_spread(door, *spread(door, 200, generator))


@pytest.mark.slow
@every_door
def test_the_covariance_is_that_of_a_thousand_trials(door: Door, generator: torch.Generator) -> None:
    check_spread(door, *spread(door, 1000, generator))


@every_door_but_triangulation
def test_the_covariance_is_that_of_gradients_datum_by_datum(
    door: Door, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(ransac_file, "step_covariance", lambda *given: asked.append(given) or step_covariance(*given))
    scene = door.make(2, 30, generator, noise=0.4, wrong=0.2)
    n = scene.data[0].shape[1]
    door(scene, covariance=True, weights=0.5 + torch.rand(2, n, generator=generator, dtype=F64))
    estimator, model, data, weights, selected, reach = asked[0]

    def loss(i: int, j: slice, step: Tensor) -> Tensor:
        own, start = tensor_map(lambda t: t[i], (estimator, model))
        u = own.squared_residual(own.retract(start, step), *(d[i, j][selected[i, j]] for d in data)) / reach[i]
        return (weights[i, j][selected[i, j]] * (u - 0.5 * u * u)).sum()

    wanted = []
    for i in range(2):
        size, k = int(selected[i].sum()), estimator.dimension
        zero = torch.zeros(k, dtype=F64)
        gradients = torch.stack([torch.func.grad(partial(loss, i, slice(j, j + 1)))(zero) for j in range(n)])
        inverse = torch.linalg.inv(torch.func.jacrev(torch.func.grad(partial(loss, i, slice(None))))(zero))
        wanted.append(inverse @ gradients.mT @ gradients @ inverse.mT * (size / (size - k)))
    expected = torch.stack(wanted)
    entry = {"rtol": 0.0, "atol": 1e-7 * float(expected.abs().max())}
    torch.testing.assert_close(step_covariance(*asked[0]), expected, **entry)
    # The same where rows of derivatives are found one by one, as for many data.
    monkeypatch.setattr(optimum, "NUMBERS", 1)
    torch.testing.assert_close(step_covariance(*asked[0]), expected, **entry)


def test_covariance_is_computed_on_request_only(generator: torch.Generator) -> None:
    door = DOORS["homography"]
    scene = door.make(2, 30, generator)
    assert door(scene).covariance is None
    assert (door(scene.at(slice(None), slice(3)), covariance=True).covariance == 0).all()


# ---- degeneracy ----


@every_door
def test_good_scenes_are_not_degenerate(door: Door, generator: torch.Generator) -> None:
    if door is DOORS["point"]:
        pytest.skip("triangulation reports no degeneracy but in its status")
    scene = door.make(24, 150, generator)
    assert (door(scene).degeneracy == Degeneracy.NONE).all()
    few = door(scene.at(slice(None), slice(door.sample_size - 1))).degeneracy
    assert (few == Degeneracy.TOO_FEW).all()


@pytest.mark.parametrize("name", ["fundamental", "essential"])
def test_planar_scenes_are_reported(name: str, generator: torch.Generator) -> None:
    planes = DOORS["homography"].make(16, 200, generator, noise=0.4, wrong=0.2)
    assert_share(DOORS[name](planes).degeneracy == Degeneracy.PLANAR, 0.9)
    assert (DOORS["homography"](planes).degeneracy == Degeneracy.NONE).all()


@pytest.mark.parametrize("name", ["fundamental", "essential"])
def test_rotations_are_reported(name: str, generator: torch.Generator) -> None:
    X = torch.rand(16, 200, 3, generator=generator, dtype=F64) * 4 - 2 + torch.tensor([0.0, 0, 6])
    R = rotation_from_rotvec((torch.rand(16, 3, generator=generator, dtype=F64) - 0.5) * 0.5)
    scene = Scene((pixels(X), pixels(X @ R.mT))).noisy(0.4, 0.2, 2, generator)
    code = Degeneracy.PLANAR if name == "fundamental" else Degeneracy.ROTATION
    assert_share(DOORS[name](scene).degeneracy == code, 0.9)


def test_collinear_points_are_reported(generator: torch.Generator) -> None:
    s = torch.rand(6, 100, 1, generator=generator, dtype=F64) * 800 + 100
    a = torch.cat((s, 0.3 * s + 20), -1)
    exact = Scene((a, 0.9 * a + 10))
    result = DOORS["homography"](exact.noisy(0.3, 0.0, 2, generator))
    assert (result.degeneracy == Degeneracy.COLLINEAR).all()
    result = DOORS["homography"](exact)
    assert (result.status != Status.OK).all()
    assert (result.degeneracy == Degeneracy.COLLINEAR).all()


@pytest.mark.parametrize("name", ["camera", "focal", "projective"])
def test_lines_and_planes_of_known_points_are_reported(name: str, generator: torch.Generator) -> None:
    door = DOORS[name]
    X = torch.rand(6, 100, 3, generator=generator, dtype=F64) * 4 - 2
    along = torch.linspace(0, 1, 100, dtype=F64)[:, None]
    line = X[:, :1] + along * (X[:, 1:2] - X[:, :1])
    plane = torch.cat((X[..., :2], 0 * X[..., 2:]), -1)
    R = random_rotation(6, generator=generator, dtype=F64)
    for points, code in ((line, Degeneracy.COLLINEAR), (plane, Degeneracy.PLANAR)):
        known = door.scene(6, 1, generator).known
        images = pixels(points @ R.mT + torch.tensor([0.0, 0, 6], dtype=F64))
        found = door(Scene((images, points), known).noisy(0.3, 0.1, 1, generator))
        if name == "camera":
            assert (found.degeneracy == code).all()
        assert ((found.degeneracy == code) | (found.status != Status.OK)).all()
