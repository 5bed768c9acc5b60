"""The laws that every estimator of every room obeys."""

import importlib
import math
import pkgutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from chance import assert_share, seeded
from scenes import Scene, make_scene

import torchsfm
from torchsfm._types import Solutions, Status, tensor_map
from torchsfm.robust import Estimator, constant_weights, ransac

ESTIMATORS: list[type] = []
for room in pkgutil.iter_modules(torchsfm.__path__):
    if not room.ispkg:
        continue
    ESTIMATORS += getattr(importlib.import_module(f"torchsfm.{room.name}"), "ESTIMATORS", ())

pytestmark = pytest.mark.parametrize("kind", ESTIMATORS, ids=lambda kind: kind.model_name)


def sample_scene(kind: type, batch: tuple[int, ...], generator: torch.Generator) -> Scene:
    return make_scene(kind, batch, kind.sample_size, generator)  # type: ignore[attr-defined]


def nearest(scene: Scene, solutions: Solutions[torch.Tensor]) -> torch.Tensor:
    """The error of the best valid solution of each problem."""
    error = scene.error(solutions.model.double(), scene.model.unsqueeze(len(solutions.valid.shape) - 1))
    return torch.where(solutions.valid, error, torch.inf).amin(-1)


def cast(scene: Scene, dtype: torch.dtype) -> tuple[Any, tuple[torch.Tensor, ...]]:
    return tensor_map(lambda t: t.to(dtype), (scene.estimator, scene.data))


def row(scene: Scene, index: Any) -> tuple[Any, list[torch.Tensor]]:
    return tensor_map(lambda t: t[index], scene.estimator), [d[index] for d in scene.data]


def same(a: Solutions[torch.Tensor], b: Solutions[torch.Tensor], index: Any = ...) -> bool:
    return torch.equal(a.valid[index], b.valid) and torch.equal(a.model[index], b.model)


def test_estimators_keep_the_protocol(kind: type, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (), generator)
    assert isinstance(scene.estimator, Estimator)
    assert scene.estimator.codimension in (1, 2, 3)
    assert len(scene.data) == len(kind.data_names)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("dtype", "tolerance", "recall"), [(torch.float64, 1e-6, 0.999), (torch.float32, 1e-2, 0.98)])
def test_recall(kind: type, dtype: torch.dtype, tolerance: float, recall: float, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (1000,), generator)
    estimator, data = cast(scene, dtype)
    assert_share(nearest(scene, estimator.minimal(*data)) < tolerance, at_least=recall)


def test_solutions_meet_their_sample(kind: type, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (500,), generator)
    solutions = scene.estimator.minimal(*scene.data)
    assert torch.isfinite(solutions.model).all()
    wide = tensor_map(lambda t: t[:, None], scene.estimator)
    residual = wide.squared_residual(solutions.model, *(d[:, None] for d in scene.data)).sqrt()
    assert residual.shape == (500, kind.max_solutions, kind.sample_size)  # type: ignore[attr-defined]
    worst = residual.amax(-1)[solutions.valid]
    assert worst.numel() >= 499
    assert_share(worst < 1e-7, 0.995)


def test_batches_are_loops(kind: type, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (2, 3), generator)
    together = scene.estimator.minimal(*scene.data)
    wrong = scene.estimator.degenerate(*scene.data)
    assert wrong.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            estimator, data = row(scene, (i, j))
            alone = estimator.minimal(*data)
            assert torch.equal(alone.valid, together.valid[i, j])
            torch.testing.assert_close(alone.model, together.model[i, j], rtol=1e-9, atol=1e-9)
            assert torch.equal(estimator.degenerate(*data), wrong[i, j])
    for shape in ((1,), (0,), (2, 0)):
        scene = sample_scene(kind, shape, generator)
        assert scene.estimator.minimal(*scene.data).valid.shape == (*shape, kind.max_solutions)  # type: ignore[attr-defined]


def test_residual_and_refinement_broadcast_models_against_data(kind: type, generator: torch.Generator) -> None:
    scene = make_scene(kind, (4,), 20, generator, 1e-3)
    models = torch.stack([scene.model + 1e-3 * k for k in range(3)], 1)
    wide = tensor_map(lambda t: t[:, None], scene.estimator)
    data = [d[:, None] for d in scene.data]
    weights = torch.rand(4, 3, 20, generator=generator, dtype=torch.float64)
    residual = wide.squared_residual(models, *data).sqrt()
    refined = wide.step(models, *data, weigh=constant_weights(weights))
    assert residual.shape == (4, 3, 20)
    for i in range(4):
        estimator, own = row(scene, i)
        for k in range(3):
            torch.testing.assert_close(
                estimator.squared_residual(models[i, k], *own).sqrt(), residual[i, k], rtol=1e-6, atol=1e-9
            )
            alone = estimator.step(models[i, k], *own, weigh=constant_weights(weights[i, k]))
            torch.testing.assert_close(alone, refined[i, k], rtol=1e-6, atol=1e-8)


def test_steps_with_weights_of_their_own(kind: type, generator: torch.Generator) -> None:
    """The distances that weights are asked for are the residuals'; weights belong in the gradient, curvature in the Hessian."""
    scene = make_scene(kind, (4,), 40, generator, 1e-4)
    models = torch.stack([scene.model, scene.model + 1e-5], 1)
    wide, data = tensor_map(lambda t: t[:, None], scene.estimator), [d[:, None] for d in scene.data]
    weights = torch.rand(4, 2, 40, generator=generator, dtype=torch.float64)
    seen = []

    def step(factor: float) -> torch.Tensor:
        def weigh(squared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            seen.append(squared)
            return weights, factor * weights

        moved: torch.Tensor = wide.step(models, *data, weigh=weigh)
        return moved - models

    full, half = step(1), step(2)
    torch.testing.assert_close(seen[0], wide.squared_residual(models, *data), rtol=1e-6, atol=1e-15)
    torch.testing.assert_close(full, wide.step(models, *data, weigh=constant_weights(weights)) - models, rtol=1e-9, atol=1e-12)
    # What is left is of second order, or mends a model that is not quite on its manifold.
    size = full[:, 0].flatten(1).norm(dim=-1)
    assert ((half - 0.5 * full)[:, 0].flatten(1).norm(dim=-1) < 0.02 * size).all()


def test_squared_residual_is_the_square(kind: type, generator: torch.Generator) -> None:
    scene = make_scene(kind, (3,), 15, generator, 1e-2)
    residual = scene.estimator.squared_residual(scene.model, *scene.data).sqrt()
    torch.testing.assert_close(scene.estimator.squared_residual(scene.model, *scene.data), residual**2)
    assert residual.median() > 1e-4


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
def test_a_bad_sample_touches_no_other(kind: type, poison: float, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (64,), generator)
    good = scene.estimator.minimal(*scene.data)
    for d in range(len(scene.data)):
        data = [t.clone() for t in scene.data]
        data[d][5, 0, 0] = poison
        found = scene.estimator.minimal(*data)
        assert not found.valid[5].any()
        assert torch.isfinite(found.model).all()
        others = torch.arange(64) != 5
        assert torch.equal(found.valid[others], good.valid[others])
        assert torch.equal(found.model[others], good.model[others])


def test_repeated_data_give_no_nan(kind: type, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (8,), generator)
    data = [d.clone() for d in scene.data]
    for d in data:
        d[0] = d[0, :1]
        d[1, 1] = d[1, 0]
        d[2] = 0
    solutions = scene.estimator.minimal(*data)
    rejected = scene.estimator.degenerate(*data)
    assert torch.isfinite(solutions.model).all()
    assert not (solutions.valid[:3].any(-1) & ~rejected[:3]).any()
    assert (nearest(scene, solutions)[3:] < 1e-5).all()


def test_the_order_of_a_sample_does_not_matter(kind: type, generator: torch.Generator) -> None:
    scene = sample_scene(kind, (200,), generator)
    order = torch.randperm(kind.sample_size, generator=generator)  # type: ignore[attr-defined]
    solutions = scene.estimator.minimal(*scene.data)
    turned = scene.estimator.minimal(*(d[:, order] for d in scene.data))
    assert (nearest(scene, turned) < 1e-6).all()
    assert_share(solutions.valid.sum(-1) == turned.valid.sum(-1), 0.99)


def test_retraction_follows_the_manifold(kind: type, generator: torch.Generator) -> None:
    """No step is no move; every step is a model that data can have: exact data of it are found to fit after refinement."""
    if not hasattr(kind, "retract"):
        pytest.skip("models of this estimator do not say how they move")
    scene = make_scene(kind, (6,), 40, generator, 1e-4)
    size = kind.dimension  # type: ignore[attr-defined]
    zero = torch.zeros(6, size, dtype=torch.float64)
    torch.testing.assert_close(scene.estimator.retract(scene.model, zero), scene.model, rtol=0, atol=1e-12)
    steps = torch.eye(size, dtype=torch.float64)[:, None].expand(size, 6, size)
    moved = scene.estimator.retract(scene.model, 1e-4 * steps) - scene.model
    flat = moved.reshape(size, 6, -1).transpose(0, 1) / 1e-4
    # As many directions as the dimension says, all of them of about unit speed.
    values = torch.linalg.svdvals(flat)
    assert (values[:, -1] > 0.1).all()
    assert (values[:, 0] < 30).all()
    # And they are all there are: what refinement changes is a step, but for what the model leaves open (frame, scale).
    weights = torch.ones(6, 40, dtype=torch.float64)
    refined = scene.estimator.step(scene.model, *scene.data, weigh=constant_weights(weights))
    change = (refined - scene.model).reshape(6, -1, 1)
    step = torch.linalg.lstsq(flat.mT, change).solution[..., 0]
    length = change.norm(dim=1)[:, 0]
    left = scene.error(scene.estimator.retract(scene.model, step), refined)
    assert (left < 0.01 * length + length**2 + 1e-12).all()


def test_refinement_finds_the_optimum(kind: type, generator: torch.Generator) -> None:
    """From near the truth, with noise: the cost falls, then stands still, and exact data give the exact model."""
    for noise in (0.0, 1e-3):
        scene = make_scene(kind, (20,), 60, generator, noise)
        weights = torch.rand(20, 60, generator=generator, dtype=torch.float64)
        cost = lambda model, s=scene, w=weights: (w * s.estimator.squared_residual(model, *s.data)).sum(-1)  # noqa: E731
        model = scene.model
        for _ in range(6):
            model = scene.estimator.step(model, *scene.data, weigh=constant_weights(weights))
        best = cost(model)
        assert torch.isfinite(model).all()
        again = cost(scene.estimator.step(model, *scene.data, weigh=constant_weights(weights)))
        rests = (best <= cost(scene.model) + 1e-12) & ((again - best).abs() <= 1e-7 * best + 1e-16)
        if noise == 0:
            assert rests.all()
            assert (scene.error(model, scene.model) < 1e-7).all()
        # Next to a point on an epipole steps without damping may circle; the search keeps the best of them.
        assert_share(rests, 0.99)
        # A minimum of the true cost, not only of its linear model: no neighbour on the manifold costs less.
        for _ in range(5):
            other = weights * (1 + 0.1 * torch.rand(20, 60, generator=generator, dtype=torch.float64))
            neighbour = scene.estimator.step(model, *scene.data, weigh=constant_weights(other))
            assert (cost(neighbour) >= best * (1 - 1e-6) - 1e-16)[rests].all()


def test_gradients_of_minimal_solutions(kind: type, generator: torch.Generator) -> None:
    def solutions(scene: Scene) -> tuple[Callable[..., torch.Tensor], list[torch.Tensor], float]:
        """The solution nearest to the truth by the data, these, and the largest derivative."""
        found = scene.estimator.minimal(*scene.data)
        error = torch.where(found.valid, scene.error(found.model, scene.model[:, None]), torch.inf)
        slot = error.argmin(-1)

        def solve(*data: torch.Tensor) -> torch.Tensor:
            more = data[0].shape[: data[0].ndim - scene.data[0].ndim]
            wide = tensor_map(lambda t: t.expand(more + t.shape), scene.estimator)
            return wide.minimal(*data).model[(slice(None),) * len(more) + (torch.arange(3), slot)]

        inputs = [d.clone().requires_grad_() for d in scene.data]
        slopes = torch.autograd.grad(solve(*inputs).square().sum(), inputs, allow_unused=True)
        steepest = max(float(g.abs().max()) for g in slopes if g is not None)
        return solve, inputs, steepest if bool(error.amin(-1).isfinite().all()) else math.inf

    # Differences tell little close to degenerate samples, where derivatives are huge and change fast.
    tried = [solutions(sample_scene(kind, (3,), generator)) for _ in range(4)]
    solve, inputs, steepest = min(tried, key=lambda one: one[2])
    assert steepest < math.inf
    derivatives = torch.autograd.functional.jacobian(solve, tuple(inputs))
    # `gradcheck` would prepare for derivatives at each of its differences, and take them one by one.
    with torch.no_grad():
        for k, (x, derivative) in enumerate(zip(inputs, derivatives, strict=True)):
            n = x.numel()
            step = 1e-8 * torch.eye(n, dtype=x.dtype).view(n, *x.shape)
            before, after = ([y.expand(n, *y.shape) for y in part] for part in (inputs[:k], inputs[k + 1 :]))
            ahead, behind = (solve(*before, x + d, *after) for d in (step, -step))
            difference = ((ahead - behind) / 2e-8).movedim(0, -1)
            torch.testing.assert_close(derivative.flatten(ahead.ndim - 1), difference, rtol=1e-3, atol=1e-3)


# ---- estimation in the presence of outliers --------------------------------------------------------------------------------


def spoiled(kind: type, batch: tuple[int, ...], n: int, generator: torch.Generator) -> tuple[Scene, Any, torch.Tensor]:
    scene = make_scene(kind, batch, n, generator, 1e-3)
    wrong = torch.rand(*batch, n, generator=generator) < 0.4
    return scene, scene.spoil(scene.data, wrong, generator), wrong


def test_ransac_recovers_with_40_percent_outliers(kind: type, generator: torch.Generator) -> None:
    scene, data, wrong = spoiled(kind, (16,), 200, generator)
    copies = [d.clone() for d in data]
    result = ransac(scene.estimator, *data, threshold=3 * scene.noise, generator=generator)
    assert all(torch.equal(a, b) for a, b in zip(copies, data, strict=True))
    assert (result.status == Status.OK).all()
    assert (scene.error(result.model, scene.model) < 0.1).all()
    # About as near to the truth as the optimum of those that are right: medians of 16 errors scatter by a quarter.
    best = scene.model
    for _ in range(4):
        best = scene.estimator.step(best, *data, weigh=constant_weights((~wrong).double()))
    assert scene.error(result.model, scene.model).median() < 3 * scene.error(best, scene.model).median()
    assert (result.inliers & ~wrong).sum() > 0.95 * (~wrong).sum()
    assert (result.inliers & wrong).sum() < 0.05 * wrong.sum()
    residual = scene.estimator.squared_residual(result.model, *data).sqrt()
    assert torch.equal(result.inliers, residual < 3 * scene.noise)


def test_ransac_is_deterministic_alone_and_in_a_batch(kind: type, generator: torch.Generator) -> None:
    scene, data, _ = spoiled(kind, (2, 2), 90, generator)
    mask = torch.rand(2, 2, 90, generator=generator) < 0.9
    together = ransac(scene.estimator, *data, threshold=3 * scene.noise, mask=mask, generator=seeded(3))
    again = ransac(scene.estimator, *data, threshold=3 * scene.noise, mask=mask, generator=seeded(3))
    assert torch.equal(together.model, again.model)
    for i, j in ((0, 0), (0, 1), (1, 1)):
        estimator, own = row(scene, (i, j))[0], [d[i, j] for d in data]
        alone = ransac(estimator, *own, threshold=3 * scene.noise, mask=mask[i, j], generator=seeded(3))
        assert torch.equal(alone.inliers, together.inliers[i, j])
        assert torch.equal(alone.iterations, together.iterations[i, j])
        torch.testing.assert_close(alone.model, together.model[i, j], rtol=1e-9, atol=1e-9)


def test_ransac_follows_the_dtype(kind: type, generator: torch.Generator) -> None:
    scene, data, _ = spoiled(kind, (4,), 100, generator)
    estimator, data = tensor_map(lambda t: t.float(), (scene.estimator, data))
    result = ransac(estimator, *data, threshold=3 * scene.noise, generator=generator)
    assert result.model.dtype == result.support.dtype == torch.float32
    assert (scene.error(result.model.double(), scene.model) < 0.1).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_default_dtype_changes_nothing(kind: type, dtype: torch.dtype, generator: torch.Generator) -> None:
    scene, data, _ = spoiled(kind, (3,), 100, generator)
    estimator, data = tensor_map(lambda t: t.to(dtype), (scene.estimator, data))

    def found() -> Any:
        return ransac(estimator, *data, threshold=3 * scene.noise, scoring_dtype=torch.float32, generator=seeded(3))

    usual, by_default = found(), torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        other = found()
    finally:
        torch.set_default_dtype(by_default)
    assert other.model.dtype == usual.model.dtype == dtype
    assert torch.equal(other.model, usual.model)
    assert torch.equal(other.support, usual.support)


def test_ragged_extremes_in_one_batch(kind: type, generator: torch.Generator) -> None:
    scene, data, _ = spoiled(kind, (8,), 400, generator)
    data = [d.clone() for d in data]
    mask = torch.zeros(8, 400, dtype=torch.bool)
    for problem, count in enumerate((0, 1, kind.sample_size, 50, 400, 400, 400, 400)):  # type: ignore[attr-defined]
        mask[problem, :count] = True
    everywhere = torch.ones(8, 400, dtype=torch.bool)
    random = scene.spoil(tuple(data), everywhere, generator)
    for d, wrong in zip(data, random, strict=True):
        d[5] = wrong[5]
        d[6] = d[6, :1]
        d[7, ::2] = torch.nan
    result = ransac(
        scene.estimator, *data, threshold=3 * scene.noise, mask=mask, max_iterations=3000,
        generator=seeded(),
    )  # fmt: skip
    status = result.status.tolist()
    assert status[:2] == [Status.TOO_FEW, Status.TOO_FEW]
    assert status[3:5] == [Status.OK, Status.OK]
    assert status[5] == Status.NO_CONSENSUS
    assert status[6] == Status.DEGENERATE
    assert status[7] == Status.OK
    assert torch.isfinite(result.model).all()
    assert torch.isfinite(result.support).all()
    assert not (result.inliers & ~mask).any()
    assert not result.inliers[7, ::2].any()
    for problem in (3, 4, 7):
        estimator = tensor_map(lambda t: t[problem], scene.estimator)  # noqa: B023
        alone = ransac(
            estimator, *(d[problem] for d in data), threshold=3 * scene.noise, mask=mask[problem], max_iterations=3000,
            generator=seeded(),
        )  # fmt: skip
        assert torch.equal(alone.inliers, result.inliers[problem])
    data[0][:] = torch.nan
    assert (ransac(scene.estimator, *data, threshold=1.0).status == Status.NOT_FINITE).all()
