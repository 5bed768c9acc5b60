"""What is no model agrees with nothing, no step leaps, and a wrong point is one wrong point wherever it is."""

import math

import pytest
import torch
from chance import seeded
from robust_doors import DOORS, F64, Door, Scene, rays
from scenes import make_scene

from torchsfm import motion, resection
from torchsfm._types import Status, tensor_map
from torchsfm.geometry import transform_points
from torchsfm.linalg import damped_solve, determinant_3x3
from torchsfm.motion import (
    FundamentalEstimator,
    HomographyEstimator,
    RelativePoseEstimator,
    estimate_essential,
    estimate_fundamental,
    estimate_homography,
    estimate_upright,
)
from torchsfm.resection import estimate_camera
from torchsfm.robust import InlierCount, LeastMedian, Magsac, Msac, NeverZero, constant_weights
from torchsfm.robust.hypotheses import losses, squared_residual
from torchsfm.robust.local_optimisation import optimise_fully, step_within
from torchsfm.triangulation import ESTIMATORS as OF_POINTS

OF_RAYS = ("essential", "upright")
"""For these a point far away is a direction like others."""
every_image = pytest.mark.parametrize("door", [DOORS[name] for name in DOORS if name not in OF_RAYS])
ESTIMATORS = [*motion.ESTIMATORS, *resection.ESTIMATORS, *OF_POINTS]
every_estimator = pytest.mark.parametrize("kind", ESTIMATORS, ids=lambda kind: kind.model_name)


@every_estimator
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_what_is_no_model_has_no_score(kind: type, dtype: torch.dtype, generator: torch.Generator) -> None:
    scene = make_scene(kind, (1,), 30, generator)
    data = [d.to(dtype)[:, None] for d in scene.data]
    estimator = tensor_map(lambda t: t.to(dtype)[:, None], scene.estimator)
    good = scene.model.to(dtype)
    bad = [torch.nan, torch.inf, -torch.inf, 1e37 if dtype == torch.float32 else 1e300]
    if isinstance(scene.estimator, NeverZero):
        bad.append(0.0)
    models = torch.stack([good, *(good * 0 + x if x else torch.zeros_like(good) for x in bad)], 1)
    partly = good.clone()
    partly.view(-1)[-1] = torch.nan
    models = torch.cat((models, partly[:, None]), 1)
    limit = torch.full((1,), 1e-4, dtype=dtype)
    squared = squared_residual(estimator, models, *data)
    assert (squared[0, 0] < limit).all()
    assert not (squared[0, 1:] < limit).any()
    # Huge ones may be models that are far away.
    none = [i for i, x in enumerate([*bad, torch.nan], 1) if x == 0 or not math.isfinite(x)]
    assert not torch.isfinite(squared[0, none]).any()
    for score in (Msac(), Magsac(), InlierCount(), LeastMedian()):
        loss = losses(estimator, models, data, limit, None, score)
        nothing = score.cost(torch.full_like(squared[:, :1], torch.inf), limit, None, kind.codimension)  # type: ignore[attr-defined]
        assert (loss[0, 1:] >= nothing[0]).all()
        assert loss[0, 0] < nothing[0, 0]


@every_estimator
def test_steps_are_bounded_where_all_curvatures_vanish(kind: type, generator: torch.Generator) -> None:
    """All data at distances where the loss is no longer convex: the step stays near, and refinement does not raise the loss."""
    scene = make_scene(kind, (20,), 40, generator, 1e-3)
    data, start, estimator = scene.data, scene.model, scene.estimator
    squared = squared_residual(estimator, start, *data)
    # The nearest datum just past the inflection.
    reach = 3 * squared.amin(-1) * (3 if kind.codimension == 1 else 1.5)  # type: ignore[attr-defined]
    reach = torch.where(torch.isfinite(reach), reach, 1.0).clamp(min=1e-12)
    counts = squared > reach[:, None] * kind.codimension / (2 + kind.codimension)  # type: ignore[attr-defined]

    def loss(model: torch.Tensor) -> torch.Tensor:
        u = (squared_residual(estimator, model, *data) / reach[:, None]).clamp(max=1)
        return ((u - u * u / 2) * counts).sum(-1)

    one, _ = step_within(estimator, start, data, reach, counts)
    assert torch.isfinite(one).all()
    assert ((one - start).flatten(1).norm(dim=-1) < 10 * (1 + start.flatten(1).norm(dim=-1))).all()
    final, settled = optimise_fully(estimator, start, one, data, reach, counts)
    assert torch.isfinite(final).all()
    assert (loss(final)[settled] <= loss(one)[settled] * (1 + 1e-4) + 1e-9).all()


@pytest.mark.parametrize("kind", [FundamentalEstimator, RelativePoseEstimator])
def test_what_has_settled_is_a_minimum(kind: type, generator: torch.Generator) -> None:
    """The next step leads nowhere, also where the Hessian was indefinite on the way, as with so many data beyond the reach."""
    scene = make_scene(kind, (200,), 40, generator, 1e-3)
    data, estimator = scene.data, scene.estimator
    start = estimator.retract(scene.model, 1e-2 * torch.randn(200, kind.dimension, generator=generator, dtype=F64))  # type: ignore[attr-defined]
    reach = squared_residual(estimator, start, *data).median(-1).values
    counts = torch.ones(200, 40, dtype=torch.bool)
    one, _ = step_within(estimator, start, data, reach, counts)
    final, settled = optimise_fully(estimator, start, one, data, reach, counts)
    again, _ = step_within(estimator, final, data, reach, counts)
    left, first = ((b - a).flatten(1).norm(dim=-1) for a, b in ((final, again), (start, one)))
    assert settled.sum() > 100
    assert (left < 1e-4 * first)[settled].all()


def test_steps_of_any_length_end_next_to_a_determinant_of_zero(generator: torch.Generator) -> None:
    """Beside the manifold the loss may be less than anywhere on it: every step from there would be taken back."""
    scene = make_scene(FundamentalEstimator, (20,), 40, generator, 1e-3)
    off = 0.1 * torch.randn(20, 7, generator=generator, dtype=F64)
    start = scene.estimator.retract(scene.model, off)
    moved = scene.estimator.step(start, *scene.data, weigh=constant_weights(torch.ones(20, 40, dtype=F64)))
    assert ((moved - start).flatten(1).norm(dim=-1) > 1e-2).all()
    off = determinant_3x3(moved[..., :3]).abs()
    assert off.max() < 1e-3
    assert off.median() < 1e-5


def test_systems_without_equations_have_no_solution(generator: torch.Generator) -> None:
    b = torch.randn(5, 4, 2, generator=generator, dtype=F64)
    J = torch.randn(5, 6, 4, generator=generator, dtype=F64)
    A = J.mT @ J
    assert (damped_solve(torch.zeros(5, 4, 4, dtype=F64), b) == 0).all()
    known = torch.tensor([True, False, True, True])
    part = torch.where(known[:, None] & known, A, 0)
    x = damped_solve(part, b)
    assert (x[:, ~known] == 0).all()
    torch.testing.assert_close(A[:, known][..., known] @ x[:, known], b[:, known], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(A @ damped_solve(A, b), b, rtol=1e-6, atol=1e-6)


def test_unrelated_points_have_no_fundamental_matrix() -> None:
    """Among these are pairs of which refinement once made the zero matrix, which everything agrees with."""
    seeds = [*range(40), 1085, 1156, 1426]
    pairs = [torch.rand(2, 100, 2, generator=torch.Generator().manual_seed(s), dtype=F64) * 1000 for s in seeds]
    for a, b in pairs:
        found = estimate_fundamental(a, b, threshold=3.0, max_iterations=256, generator=torch.Generator().manual_seed(0))
        assert found.status == Status.NO_CONSENSUS
        torch.testing.assert_close(found.model.norm(), torch.tensor(1.0, dtype=F64))


# ---- wrong points far away ----


@every_image
@pytest.mark.parametrize("far", [1e8, 1e12, 1e25, -1e300])
def test_a_wrong_point_costs_nothing_however_far(door: Door, far: float, generator: torch.Generator) -> None:
    scene, mask = door.make(8, 60, generator), torch.ones(8, 60, dtype=torch.bool)
    mask[:, 17] = False
    without = door(scene, mask=mask)
    for i in range(len(scene.data)):
        if door is DOORS["point"] and i:
            continue
        data = [d.clone() for d in scene.data]
        data[i][:, 17] = far
        found = door(Scene(tuple(data), scene.known))
        assert (found.status == Status.OK).all()
        assert torch.equal(found.inliers, without.inliers)
        # Samples differ, and with them, now and then, which of two nearly equal minima is found.
        assert (
            (door.difference(found.model, without.model).norm(dim=-1)) < 1e-6 * found.model.flatten(1).norm(dim=-1)
        ).sum() >= 7


@every_image
def test_many_wrong_points_far_away(door: Door, generator: torch.Generator) -> None:
    scene = door.make(8, 100, generator, wrong=0.1)
    data = [d.clone() for d in scene.data]
    data[door.images - 1][:, ::4] = 10 ** (300 * torch.rand(8, 25, 1, generator=generator, dtype=F64) + 4)
    found = door(Scene(tuple(data), scene.known))
    assert (found.status == Status.OK).all()
    assert not found.inliers[:, ::4].any()
    assert (found.inliers.sum(-1) > 50).all()


# ---- thresholds in the unit of something else ----


def test_pixels_are_not_radians(generator: torch.Generator) -> None:
    scene = DOORS["upright"].make(2, 60, generator)
    d1, d2 = (rays(x) for x in scene.data)
    for wrong in (2.0, 0.11, torch.tensor([1e-3, 0.5], dtype=F64)):
        with pytest.raises(ValueError, match=r"threshold: wanted radians.*focal"):
            estimate_essential(d1, d2, threshold=wrong)
        with pytest.raises(ValueError, match=r"threshold: wanted radians.*focal"):
            estimate_upright(d1, d2, *scene.known, threshold=wrong)
    for right in (0.1, torch.tensor([1e-3, 0.1], dtype=F64)):
        assert estimate_essential(d1, d2, threshold=right, max_iterations=64).status.shape == (2,)


def test_pixels_are_not_rays(generator: torch.Generator) -> None:
    scene = DOORS["upright"].make(2, 60, generator)
    d1, d2 = (rays(x) for x in scene.data)
    K = torch.tensor([[900.0, 0, 500], [0, 900, 375], [0, 0, 1]], dtype=F64)
    d1, d2 = d1 / d1[..., 2:], d2 / d2[..., 2:]
    for pixels in (d2 @ K.mT, d2 * d2.new_tensor([900.0, 900, 1])):
        with pytest.raises(ValueError, match=r"d2: wanted rays.*pixels"):
            estimate_essential(d1, pixels, threshold=1e-3)
        with pytest.raises(ValueError, match=r"d1: wanted rays.*pixels"):
            estimate_upright(pixels, d2, *scene.known, threshold=1e-3)
    # Half of the points of one problem lie far to the side.
    d1[0, :31, :2] *= 1e4
    for a, b in ((d1, d2), (3 * d1, d2 / 5)):
        assert estimate_essential(a, b, threshold=1e-3, max_iterations=64).status.shape == (2,)


@pytest.mark.parametrize("scoring", [Msac(), LeastMedian()])
def test_thresholds_as_wide_as_the_data_find_nothing(scoring: object, generator: torch.Generator) -> None:
    """In pixels, for points in focal lengths: any model would do."""
    options = {"threshold": 2.0, "scoring": scoring, "max_iterations": 64, "generator": generator}
    a, b = torch.rand(2, 8, 60, 2, generator=generator, dtype=F64)
    X = torch.randn(8, 60, 3, generator=generator, dtype=F64)
    eye = torch.eye(3, dtype=F64)
    for found in (
        estimate_fundamental(a, b, **options), estimate_homography(a, b, **options), estimate_camera(a, X, eye, **options)
    ):  # fmt: skip
        assert (found.status != Status.OK).all()


# ---- directions of any length ----


@pytest.mark.parametrize("length", [1e-300, 1e-160, 1e300])
def test_verticals_of_any_length_give_finite_solutions_and_derivatives(length: float, generator: torch.Generator) -> None:
    d, X, d1, d2 = (torch.randn(100, k, 3, generator=generator, dtype=F64) for k in (2, 2, 3, 3))
    verticals = torch.randn(2, 100, 3, generator=generator, dtype=F64)
    unit, scaled = verticals.clone().requires_grad_(), (length * verticals).requires_grad_()
    for solve in (
        lambda g: resection.camera_up2p(d, X, g, verticals[1]),
        lambda g: motion.relative_upright_3pt(d1, d2, g, verticals[1]),
    ):
        found, plain = solve(scaled[0]), solve(unit[0])
        assert found.valid.any()
        assert torch.isfinite(found.model).all()
        same = (found.valid == plain.valid).all(-1)
        assert same.double().mean() > 0.95
        torch.testing.assert_close(found.model[same], plain.model[same], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_weights_near_the_largest_number_leave_a_finite_score(dtype: torch.dtype, generator: torch.Generator) -> None:
    x = 100 * torch.rand(30, 2, generator=generator, dtype=dtype)
    weights = torch.full((30,), torch.finfo(dtype).max, dtype=dtype)
    found = estimate_homography(x, x + 1, threshold=1.0, weights=weights, max_iterations=64, generator=generator)
    assert found.status == Status.OK
    assert torch.isfinite(found.support)


def test_more_than_half_absurdly_far_cost_the_others_nothing(generator: torch.Generator) -> None:
    plane = torch.tensor([[0.9, 0.1, 30.0], [-0.05, 1.1, 20.0], [1e-4, -2e-4, 1.0]], dtype=torch.float64)
    x1 = 1000 * torch.rand(20, 60, 2, generator=generator, dtype=torch.float64)
    x2 = transform_points(plane, x1) + 0.3 * torch.randn(x1.shape, generator=generator, dtype=torch.float64)
    # Of three fifths either coordinate, so that the median of each is still right.
    slot = torch.arange(60)
    x2[:, slot % 5 == 0, 0] = x2[:, (slot % 5 == 1) | (slot % 10 == 2), 1] = 1e12
    x2[:, slot % 10 == 7, 0] = 1e12
    found = estimate_homography(x1, x2, threshold=2.0, generator=seeded(1))
    distance = HomographyEstimator().squared_residual(found.model, x1, x2).sqrt()
    assert bool((found.status == Status.OK).all())
    assert bool((distance[found.inliers] <= 2.0).all())
    assert bool((found.inliers.sum(-1) >= 20).all())
