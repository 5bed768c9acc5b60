"""Bad input: problems that fall apart, are observed twice, not at all, from behind, exactly, or by numbers that are none."""

import numpy as np
import pytest
import torch
from chance import seeded

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust, bundle_adjust_model, bundle_covariance
from torchsfm.geometry import BundleProblem, Camera, Pose, Radial
from torchsfm.optim import Cauchy
from torchsfm.simulation import random_bundle_problem

F64 = torch.float64
FREE = ("focal", "k1", "k2")


@pytest.fixture
def problem(generator: torch.Generator) -> BundleProblem:
    return random_bundle_problem(8, 120, 500, generator=generator, disturbance=0.3).problem


def change(problem: BundleProblem, **members: object) -> BundleProblem:
    return BundleProblem(**(vars(problem) | members))  # type: ignore[arg-type]


def join(a: BundleProblem, b: BundleProblem) -> BundleProblem:
    """Two problems that share nothing, as one."""
    views, points = a.poses.shape[0], len(a.X)
    return BundleProblem(
        Pose(torch.cat((a.poses.R, b.poses.R)), torch.cat((a.poses.t, b.poses.t))),
        Camera(
            torch.cat((a.cameras.K, b.cameras.K)),
            Radial.from_parameters(torch.cat((a.cameras.distortion.parameters(), b.cameras.distortion.parameters()))),
        ),
        torch.cat((a.camera_index, b.camera_index + views)),
        torch.cat((a.X, b.X)),
        torch.cat((a.x, b.x)),
        torch.cat((a.view, b.view + views)),
        torch.cat((a.point, b.point + points)),
    )


def test_two_problems_in_one(problem: BundleProblem) -> None:
    """Each part finds what it finds alone, in a gauge of its own."""
    other = random_bundle_problem(6, 90, 350, layout="path", generator=seeded(5)).problem
    both = join(problem, other)
    options = {"free": FREE, "tolerance": 1e-10, "max_iterations": 100}
    together = bundle_adjust_model(both, **options)
    one, two = bundle_adjust_model(problem, **options), bundle_adjust_model(other, **options)
    assert together.result.status == Status.OK
    np.testing.assert_allclose(together.result.cost, one.result.cost + two.result.cost, rtol=1e-6)
    torch.testing.assert_close(together.result.residuals[:500], one.result.residuals, rtol=1e-2, atol=1e-2)
    m = together.model
    covariance = bundle_covariance(
        BundleProblem.of(m.poses, m.cameras, m.X, m.x, m.view, m.point, camera_index=m.camera_index), free=FREE
    )
    assert covariance.nullity == 14
    assert covariance.X[covariance.determined_points].isfinite().all()


def test_no_observations(problem: BundleProblem) -> None:
    keep = (problem.view != 3) & (problem.point % 10 != 7)
    bare = change(problem, x=problem.x[keep], view=problem.view[keep], point=problem.point[keep])
    adjusted = bundle_adjust_model(bare, free=FREE)
    assert adjusted.result.status == Status.OK
    new = adjusted.model
    assert torch.equal(new.poses.R[3], problem.poses.R[3])
    assert torch.equal(new.poses.t[3], problem.poses.t[3])
    assert torch.equal(new.cameras.K[3], problem.cameras.K[3])
    assert torch.equal(new.X[7::10], problem.X[7::10])
    nothing = change(problem, x=problem.x[:0], view=problem.view[:0], point=problem.point[:0])
    empty = bundle_adjust_model(nothing, free=FREE)
    assert empty.result.status == Status.TOO_FEW
    assert (empty.result.cost, empty.result.iterations) == (0.0, 0)
    assert torch.equal(empty.model.X, problem.X)


def test_observed_twice(problem: BundleProblem) -> None:
    """The same observation twice is one of weight two; two different ones of a point in a view both count."""
    again = torch.arange(0, 500, 3)
    double = change(
        problem,
        x=torch.cat((problem.x, problem.x[again])),
        view=torch.cat((problem.view, problem.view[again])),
        point=torch.cat((problem.point, problem.point[again])),
    )
    weights = torch.ones(500, dtype=F64)
    weights[again] = 2
    options = {"free": FREE, "tolerance": 1e-12}
    one = bundle_adjust_model(double, **options)
    two = bundle_adjust_model(problem, weights=weights, **options)
    np.testing.assert_allclose(one.result.cost, two.result.cost, rtol=1e-8)
    torch.testing.assert_close(one.result.residuals[:500], two.result.residuals, rtol=1e-4, atol=1e-4)
    moved = change(double, x=torch.cat((problem.x, problem.x[again] + 1)))
    result = bundle_adjust_model(moved, **options).result
    assert result.status == Status.OK
    assert result.cost > one.result.cost + 0.2 * len(again)


def test_points_behind_their_cameras(problem: BundleProblem) -> None:
    """They are mirrored through a camera; whatever becomes of them, the others come out."""
    X = problem.X.clone()
    centre = problem.poses.centre
    behind = torch.arange(0, 120, 15)
    for k in behind.tolist():
        seen = problem.view[problem.point == k]
        X[k] = centre[seen].mean(0) - 0.3 * (X[k] - centre[seen].mean(0))
    bad = change(problem, X=X)
    assert (bad.depths() < 0).sum() > 10
    for loss in (None, Cauchy(2.0)):
        result = bundle_adjust_model(bad, free=FREE, loss=loss, max_iterations=100).result
        assert result.cost < result.initial_cost
        for value in (result.X, result.poses.R, result.poses.t, result.residuals):
            assert value.isfinite().all()
    others = ~torch.isin(problem.point, behind)
    assert result.residuals[others].median() < 1.0


def test_exact_start(generator: torch.Generator) -> None:
    """Nothing is left to do, and nothing is done."""
    truth = random_bundle_problem(6, 60, 250, generator=generator).truth
    result = bundle_adjust_model(truth, free=FREE).result
    assert result.status == Status.OK
    assert result.cost < 1e-18
    torch.testing.assert_close(result.X, truth.X, rtol=0, atol=1e-9)
    torch.testing.assert_close(result.poses.R, truth.poses.R, rtol=0, atol=1e-9)


def test_numbers_that_are_none(problem: BundleProblem) -> None:
    """NaN and inf in every place they can be: their observations are left out, and the rest is as without them."""
    x, X, t = problem.x.clone(), problem.X.clone(), problem.poses.t.clone()
    K = problem.cameras.K.clone()
    x[0, 0], x[17] = torch.nan, torch.inf
    X[5], X[6, 2] = torch.nan, -torch.inf
    t[2] = torch.nan
    K[4, 0, 0] = torch.nan
    poses, cameras = Pose(problem.poses.R, t), Camera(K, problem.cameras.distortion)
    bad = change(problem, x=x, X=X, poses=poses, cameras=cameras)
    out = (problem.view == 2) | (problem.view == 4) | (problem.point == 5) | (problem.point == 6)
    out[0] = out[17] = True
    result = bundle_adjust_model(bad, free=FREE, tolerance=1e-10).result
    assert result.status == Status.OK
    assert torch.equal(result.used, ~out)
    assert (result.residuals[out] == torch.inf).all()
    clean = change(problem, x=problem.x[~out], view=problem.view[~out], point=problem.point[~out])
    expected = bundle_adjust_model(clean, free=FREE, tolerance=1e-10).result
    np.testing.assert_allclose(result.cost, expected.cost, rtol=1e-8)
    kept = torch.ones(120, dtype=torch.bool)
    kept[5] = kept[6] = False
    torch.testing.assert_close(result.X[kept], expected.X[kept], rtol=1e-5, atol=1e-5)
    nothing = change(problem, x=x * torch.nan)
    assert bundle_adjust_model(nothing, free=FREE).result.status == Status.NOT_FINITE


def test_weights_of_zero_and_nan(problem: BundleProblem) -> None:
    weights = torch.ones(500, dtype=F64)
    weights[::7] = 0
    weights[3] = torch.nan
    result = bundle_adjust_model(problem, free=FREE, weights=weights, tolerance=1e-10).result
    assert torch.equal(result.used, weights > 0)
    some = weights > 0
    clean = change(problem, x=problem.x[some], view=problem.view[some], point=problem.point[some])
    np.testing.assert_allclose(result.cost, bundle_adjust_model(clean, free=FREE, tolerance=1e-10).result.cost, rtol=1e-8)


def test_points_seen_once_stay_on_their_rays(problem: BundleProblem) -> None:
    """Nothing tells their depth; they are finite, and the others are as without them."""
    first = torch.zeros(500, dtype=torch.bool)
    for k in range(10):
        first[int((problem.point == k).nonzero()[0])] = True
    keep = (problem.point >= 10) | first
    some = change(problem, x=problem.x[keep], view=problem.view[keep], point=problem.point[keep])
    result = bundle_adjust_model(some, free=(), tolerance=1e-10, max_iterations=100).result
    assert result.X.isfinite().all()
    without = problem.point >= 10
    rest = change(problem, x=problem.x[without], view=problem.view[without], point=problem.point[without])
    expected = bundle_adjust_model(rest, free=(), tolerance=1e-10, max_iterations=100).result
    np.testing.assert_allclose(result.cost, expected.cost, rtol=1e-6)
    assert result.residuals[result.used][some.point[result.used] < 10].max() < 1e-3


FAR = (1e10, -1e16, 1e40, -1e120, 1e200, 1e308, torch.inf, -torch.inf, torch.nan)


def poisoned(problem: BundleProblem, kind: str, place: int, value: float) -> tuple[BundleProblem, torch.Tensor]:
    """One number of a point, a pose, a camera or an observation replaced, and which observations that touches."""
    X, t, K, x = problem.X.clone(), problem.poses.t.clone(), problem.cameras.K.clone(), problem.x.clone()
    if kind == "point":
        X[place % 120, place % 3] = value
        touched = problem.point == place % 120
    elif kind == "pose":
        t[place % 8, place % 3] = value
        touched = problem.view == place % 8
    elif kind == "camera":
        K[place % 8, 0, (0, 2)[place % 2]] = value
        touched = problem.camera_index[problem.view] == place % 8
    else:
        x[place % 500, place % 2] = value
        touched = torch.arange(500) == place % 500
    new = change(problem, X=X, x=x, poses=Pose(problem.poses.R, t), cameras=Camera(K, problem.cameras.distortion))
    return new, touched


@pytest.mark.parametrize("kind", ["point", "pose", "camera", "observation"])
def test_far_numbers_without_weight_change_nothing(problem: BundleProblem, kind: str, generator: torch.Generator) -> None:
    """Whatever stands where nothing counts, the others end where they end without it, bit for bit."""
    for value in FAR:
        place = int(torch.randint(100_000, (), generator=generator))
        bad, touched = poisoned(problem, kind, place, value)
        weights = (~touched).double()
        found = bundle_adjust_model(bad, free=FREE, weights=weights).result
        wanted = bundle_adjust_model(problem, free=FREE, weights=weights).result
        assert found.status == wanted.status == Status.OK
        assert found.iterations == wanted.iterations > 2
        assert found.cost == wanted.cost
        assert torch.equal(found.residuals, wanted.residuals)
        rest = torch.ones(120, dtype=torch.bool)
        if kind == "point":
            rest[place % 120] = False
        assert torch.equal(found.X[rest], wanted.X[rest])


@pytest.mark.parametrize("loss", [None, Cauchy(2.0)])
@pytest.mark.parametrize("kind", ["point", "pose", "camera", "observation"])
def test_far_numbers_that_count_never_end_it_early(
    problem: BundleProblem, kind: str, loss: Cauchy | None, generator: torch.Generator
) -> None:
    """Nothing is called right that is not finite, or from which the same adjustment still gets down by more than a little."""
    for value in FAR:
        place = int(torch.randint(100_000, (), generator=generator))
        bad, _ = poisoned(problem, kind, place, value)
        first = bundle_adjust_model(bad, free=FREE, loss=loss, max_iterations=60)
        result = first.result
        if result.status != Status.OK:
            continue
        assert np.isfinite(result.cost)
        assert result.residuals[result.used].isfinite().all()
        again = bundle_adjust_model(first.model, free=FREE, loss=loss, max_iterations=60).result
        assert result.cost - again.cost <= 1e-5 * result.cost


@pytest.mark.usefixtures("unchecked")
def test_wrong_indices_and_names(problem: BundleProblem) -> None:
    args = [problem.poses, problem.cameras, problem.X, problem.x, problem.view, problem.point]
    for place, name, limit in ((4, "view", 7), (5, "point", 119)):
        for wrong in (args[place] + 1, args[place] - 1):  # type: ignore[operator]
            bad = [*args[:place], wrong, *args[place + 1 :]]
            with pytest.raises(ValueError, match=f"{name}: wanted numbers from 0 to {limit}"):
                bundle_adjust(BundleProblem.of(*bad), free=())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="camera_index: wanted numbers from 0 to 7"):
        bundle_adjust(BundleProblem.of(*args, camera_index=torch.arange(8) + 1))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="free: wanted names"):
        bundle_adjust(BundleProblem.of(*args), free=("zoom",))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fixed_poses: wanted shape"):
        bundle_adjust(BundleProblem.of(*args), fixed_poses=torch.zeros(3, dtype=torch.bool))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="weights"):
        bundle_adjust(BundleProblem.of(*args), weights=torch.ones(3, dtype=F64))  # type: ignore[arg-type]
