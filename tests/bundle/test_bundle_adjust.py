from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import BundleResult, bundle_adjust, bundle_adjust_model, bundle_covariance
from torchsfm.bundle.projection import Projection
from torchsfm.formats import read_bal
from torchsfm.geometry import (
    DISTORTION_MODELS,
    BundleProblem,
    Camera,
    NoDistortion,
    Pose,
    Radial,
    intrinsics,
    rotation_angle,
    rotation_from_rotvec,
    similarity_from_points,
)
from torchsfm.geometry.intrinsic_parameters import SKEW, camera_from_row, row_from_camera
from torchsfm.optim import Cauchy, RigidMotion, Subset
from torchsfm.optim.terms import Block, Term, Workspace, lift_of, linearize

F64 = torch.float64
DISTORTION = {
    "pinhole": [],
    "simple_radial": [-0.1],
    "radial": [-0.1, 0.02],
    "opencv": [-0.1, 0.02, 1e-3, -2e-3, 1e-3],
    "fisheye": [0.02, -0.01, 0.002, 0.001],
}


def make_camera(model: str, groups: int = 1, f: float = 800.0) -> Camera:
    K = intrinsics(torch.full((groups,), f, dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64).expand(groups, 2))
    parameters = torch.tensor(DISTORTION[model], dtype=F64).expand(groups, -1)
    return Camera(K, DISTORTION_MODELS[model].from_parameters(parameters))


def make_scene(
    generator: torch.Generator,
    *,
    views: int = 8,
    points: int = 100,
    seen: float = 0.6,
    noise: float = 0.5,
    model: str = "radial",
    groups: int = 1,
) -> tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Cameras on an arc around a cube of points: truth and observations."""
    angle = torch.linspace(-0.7, 0.7, views, dtype=F64)
    zero = torch.zeros_like(angle)
    R = rotation_from_rotvec(torch.stack((0.1 * torch.cos(3 * angle), angle, zero), -1))
    t = torch.tensor([0.0, 0.0, 4.0], dtype=F64) + 0.2 * torch.randn(views, 3, generator=generator, dtype=F64)
    poses, cameras = Pose(R, t), make_camera(model, groups)
    X = torch.rand(points, 3, generator=generator, dtype=F64) * 2 - 1
    visible = torch.rand(views, points, generator=generator) < seen
    # Every point in three views at least.
    for k in range(3):
        visible[(torch.arange(points) + k * (views // 3)) % views, torch.arange(points)] = True
    view, point = visible.nonzero().unbind(1)
    group = torch.arange(views) % groups
    x = cameras[group[view]].project(poses[view].transform(X[point, None]))[:, 0]
    return poses, cameras, X, x + noise * torch.randn(x.shape, generator=generator, dtype=F64), view, point, group


def perturb(poses: Pose, X: Tensor, generator: torch.Generator, size: float = 0.01) -> tuple[Pose, Tensor]:
    delta = size * torch.randn((*poses.shape, 6), generator=generator, dtype=X.dtype)
    return poses.retract(delta), X + 2 * size * torch.randn(X.shape, generator=generator, dtype=X.dtype)


@pytest.mark.parametrize("model", list(DISTORTION))
def test_jacobians(model: str, generator: torch.Generator) -> None:
    """The written-out derivatives are those of the residual along the retractions."""
    poses, cameras, X, x, view, point, group = make_scene(generator, views=3, points=12, model=model)
    rows = row_from_camera(cameras)
    rows[:, SKEW] = 0.7
    columns = tuple(range(rows.shape[1]))
    projection = Projection(type(cameras.distortion), columns)
    blocks = {
        "pose": Block(torch.cat((poses.R.flatten(1), poses.t), 1), RigidMotion()),
        "camera": Block(rows, Subset(len(columns), columns)),
        "point": Block(X),
    }
    values = {name: b.x.mT.contiguous().mT for name, b in blocks.items()}
    term = Term(projection.residual, ("pose", "camera", "point"), (view, group[view], point), (x,))
    lifts = {name: lift_of(b, values[name]) for name, b in blocks.items()}
    written = Term(term.residual, term.blocks, term.index, term.data, linearize=projection.linearize)
    sizes = (6, len(columns), 3)

    def jacobians(term: Term, *wanted: bool) -> tuple[Tensor, list[Tensor | None]]:
        m = len(x)
        out = [x.new_empty((2, s, m)).permute(2, 0, 1) if w else None for s, w in zip(sizes, wanted, strict=True)]
        residual, scale = linearize(term, values, lifts, out, Workspace(x))
        assert scale is None
        return residual, out

    r, automatic = jacobians(term, True, True, True)
    for wanted in ((True, True, True), (False, True, True), (True, False, False), (False, False, True)):
        r2, by_hand = jacobians(written, *wanted)
        torch.testing.assert_close(r2, r, rtol=1e-12, atol=1e-9)
        for a, b, w in zip(automatic, by_hand, wanted, strict=True):
            if w:
                torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("model", list(DISTORTION))
def test_exact_data_are_recovered(model: str, generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator, noise=0.0, model=model)
    fixed = torch.tensor([True, True] + [False] * 6)
    start, X0 = perturb(poses, X, generator)
    R = torch.where(fixed[:, None, None], poses.R, start.R)
    start = Pose(R, torch.where(fixed[:, None], poses.t, start.t))
    rows = row_from_camera(cameras)
    rows[:, 0] *= 1.05
    rows[:, 5:] = 0
    guess = camera_from_row(rows, type(cameras.distortion))
    free = ("focal", *cameras.distortion.parameter_names)
    result = bundle_adjust(BundleProblem.of(start, guess, X0, x, view, point), free=free, fixed_poses=fixed, tolerance=1e-14)
    assert result.status == Status.OK
    assert result.cost < 1e-12
    torch.testing.assert_close(result.X, X, rtol=0, atol=1e-8)
    torch.testing.assert_close(result.poses.t, poses.t, rtol=0, atol=1e-8)
    torch.testing.assert_close(row_from_camera(result.cameras), row_from_camera(cameras), rtol=1e-7, atol=1e-8)


def test_noise_and_free_gauge(generator: torch.Generator) -> None:
    """With a free gauge the residual has its statistical size, and the shape is right up to a similarity."""
    poses, cameras, X, x, view, point, _ = make_scene(generator, points=400)
    start, X0 = perturb(poses, X, generator)
    result = bundle_adjust(BundleProblem.of(start, cameras, X0, x, view, point), free=("focal", "k1", "k2"))
    assert result.status == Status.OK
    dof = 2 * len(x) - (6 * 8 + 3 + 3 * 400 - 7)
    assert abs(result.cost / (0.125 * dof) - 1) < 4 * (2 / dof) ** 0.5
    aligned = similarity_from_points(result.X, X).transform(result.X)
    assert (aligned - X).square().mean().sqrt() < 0.003
    assert abs(result.cameras.K[0, 0, 0] - 800) < 8
    np.testing.assert_allclose(result.residuals.square().sum() / 2, result.cost, rtol=1e-9)


def test_efficiency(generator: torch.Generator) -> None:
    """Over many noises the error of poses and points is the Cramer-Rao bound's (its chi-square has the right mean)."""
    poses, cameras, X, x, view, point, _ = make_scene(generator, views=4, points=12, seen=1.0, noise=0.0)
    fixed_points = torch.arange(12) < 4
    values = []
    pose12 = torch.cat((poses.R.flatten(1), poses.t), 1)

    def predict(delta: Tensor) -> Tensor:
        moved = RigidMotion().retract(pose12, delta[:24].view(4, 6))
        Y = torch.cat((X[:4], X[4:] + delta[24:].view(8, 3)))
        cam = cameras[torch.zeros(len(view), dtype=torch.long)]
        pose = Pose(moved[:, :9].unflatten(1, (3, 3)), moved[:, 9:])
        return cam.project(pose[view].transform(Y[point, None]))[:, 0].flatten()

    jacobian = torch.func.jacrev(predict)(torch.zeros(48, dtype=F64))
    information = jacobian.T @ jacobian / 0.3**2
    for _ in range(40):
        noisy = x + 0.3 * torch.randn(x.shape, generator=generator, dtype=F64)
        result = bundle_adjust(
            BundleProblem.of(poses, cameras, X, noisy, view, point), free=(), fixed_points=fixed_points, tolerance=1e-10
        )
        turn = result.poses.R @ poses.R.mT
        w = torch.stack((turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]), -1) / 2
        v = result.poses.t - (turn @ poses.t[:, :, None])[:, :, 0]
        error = torch.cat((torch.cat((w, v), 1).flatten(), (result.X - X)[4:].flatten()))
        values.append(error @ information @ error / 48)
    mean = torch.stack(values).mean()
    assert abs(mean - 1) < 4 * (2 / 48 / 40) ** 0.5


def test_shared_and_separate_intrinsics(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, group = make_scene(generator, groups=2, noise=0.0, model="simple_radial")
    rows = row_from_camera(cameras)
    rows[:, 0] *= torch.tensor([0.97, 1.04], dtype=F64)
    guess = camera_from_row(rows, type(cameras.distortion))
    start, X0 = perturb(poses, X, generator, 0.003)
    result = bundle_adjust(
        BundleProblem.of(start, guess, X0, x, view, point, camera_index=group),
        free=("focal", "k1", "principal_point"),
        tolerance=1e-13,
    )
    torch.testing.assert_close(row_from_camera(result.cameras), row_from_camera(cameras), rtol=1e-5, atol=1e-3)
    each = Camera(guess.K[group], type(cameras.distortion)(guess.distortion.k1[group]))
    apart = bundle_adjust(BundleProblem.of(start, each, X0, x, view, point), free=("focal", "k1"), tolerance=1e-13)
    torch.testing.assert_close(apart.cameras.K[:, 0, 0], torch.full((8,), 800.0, dtype=F64), rtol=1e-5, atol=0)
    held = bundle_adjust(
        BundleProblem.of(start, guess, X0, x, view, point, camera_index=group),
        free=("focal",),
        fixed_cameras=torch.tensor([True, False]),
    )
    assert torch.equal(held.cameras.K[0], guess.K[0])
    assert held.cameras.K[1, 0, 0] != guess.K[1, 0, 0]
    assert torch.equal(held.cameras.distortion.k1, guess.distortion.k1)


def test_intrinsics_free_in_some_cameras(generator: torch.Generator) -> None:
    """Any subset of numbers in any subset of cameras; the rest keep every bit."""
    poses, cameras, X, x, view, point, group = make_scene(generator, groups=2)
    start, X0 = perturb(poses, X, generator, 0.003)
    first = torch.tensor([True, False])
    problem = BundleProblem.of(start, cameras, X0, x, view, point, camera_index=group)
    one = bundle_adjust(problem, free=("focal",), fixed_cameras=first, tolerance=1e-12)
    two = bundle_adjust(problem, free=("focal",), fixed_intrinsics={"focal": first}, tolerance=1e-12)
    np.testing.assert_allclose(two.cost, one.cost, rtol=1e-10)
    torch.testing.assert_close(two.X, one.X, rtol=0, atol=1e-8)
    assert torch.equal(two.cameras.K[0], cameras.K[0])
    free = ("focal", "principal_point", "k1", "k2")
    fixed = {"focal": first, "principal_point": torch.tensor([True, True]), "k2": ~first}
    mixed = bundle_adjust(problem, free=free, fixed_intrinsics=fixed, tolerance=1e-12)
    before, after = row_from_camera(cameras), row_from_camera(mixed.cameras)
    held = torch.tensor([[1, 1, 1, 1, 1, 0, 0], [0, 1, 1, 1, 1, 0, 1]], dtype=torch.bool)
    assert torch.equal(torch.isclose(after, before, rtol=1e-15, atol=0), held)
    assert torch.equal(mixed.cameras.K[0], cameras.K[0])
    everything = bundle_adjust(problem, free=free, tolerance=1e-12)
    nothing = bundle_adjust(problem, free=(), tolerance=1e-12)
    assert everything.cost < mixed.cost < nothing.cost
    found = (mixed.poses, mixed.cameras, mixed.X, x, view, point)
    known = bundle_covariance(BundleProblem.of(*found, camera_index=group), free=free, fixed_intrinsics=fixed)
    assert known.nullity == 7
    columns = torch.tensor([[1, 1, 1, 0, 0], [0, 1, 1, 0, 1]], dtype=torch.bool)
    assert torch.equal(known.cameras.diagonal(dim1=1, dim2=2) == 0, columns)
    with pytest.raises(ValueError, match="fixed_intrinsics"):
        bundle_adjust(problem, free=free, fixed_intrinsics={"focal": torch.ones(3, dtype=torch.bool)})
    with pytest.raises(ValueError, match="zoom"):
        bundle_adjust(problem, free=free, fixed_intrinsics={"zoom": first})


def test_masks_are_kept_bit_for_bit(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    start, X0 = perturb(poses, X, generator)
    fixed_poses = torch.rand(8, generator=generator) < 0.4
    fixed_points = torch.rand(100, generator=generator) < 0.4
    keep = (view != 5) & (point != 7)
    result = bundle_adjust(
        BundleProblem.of(start, cameras, X0, x[keep], view[keep], point[keep]),
        free=(),
        fixed_poses=fixed_poses,
        fixed_points=fixed_points,
    )
    fixed_poses[5] = True
    fixed_points[7] = True
    assert torch.equal(result.poses.R[fixed_poses], start.R[fixed_poses])
    assert torch.equal(result.poses.t[fixed_poses], start.t[fixed_poses])
    assert torch.equal(result.X[fixed_points], X0[fixed_points])
    assert torch.equal(result.cameras.K, cameras.K)
    assert (result.X[~fixed_points] != X0[~fixed_points]).all()
    assert (result.poses.t[~fixed_poses] != start.t[~fixed_poses]).all()
    assert result.cost < 0.8 * result.initial_cost


def test_dropping_fixed_terms_changes_nothing(generator: torch.Generator) -> None:
    """A local adjustment over the observations that matter is the one over all."""
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    start, X0 = perturb(poses, X, generator)
    fixed_poses, fixed_points = torch.arange(8) > 2, torch.arange(100) > 30
    options = {"free": (), "fixed_poses": fixed_poses, "fixed_points": fixed_points, "tolerance": 1e-12}
    everything = bundle_adjust(BundleProblem.of(start, cameras, X0, x, view, point), **options)
    matter = ~(fixed_poses[view] & fixed_points[point])
    some = bundle_adjust(BundleProblem.of(start, cameras, X0, x[matter], view[matter], point[matter]), **options)
    torch.testing.assert_close(some.X, everything.X)
    assert everything.cost > some.cost


def test_bad_observations_and_points(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    start, X0 = perturb(poses, X, generator)
    keep = point != 3
    clean = bundle_adjust(BundleProblem.of(start, cameras, X0, x[keep][2:], view[keep][2:], point[keep][2:]))
    x, X0 = x.clone(), X0.clone()
    bad = keep.nonzero()[:2, 0]
    x[bad] = torch.tensor([[torch.nan, 1.0], [torch.inf, 2.0]], dtype=F64)
    X0[3] = torch.nan
    result = bundle_adjust(BundleProblem.of(start, cameras, X0, x, view, point))
    assert result.status == Status.OK
    unused = ~keep
    unused[bad] = True
    assert torch.equal(result.used, ~unused)
    assert (result.residuals[unused] == torch.inf).all()
    assert result.residuals[~unused].isfinite().all()
    others = torch.arange(100) != 3
    torch.testing.assert_close(result.X[others], clean.X[others], rtol=1e-6, atol=1e-8)
    assert result.poses.R.isfinite().all()


def test_points_behind_and_in_the_focal_plane(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    X0 = X.clone()
    X0[0] = poses[0].centre - 2 * poses[0].R[2]
    X0[1] = poses[1].centre + poses[1].R[0]
    result = bundle_adjust(BundleProblem.of(poses, cameras, X0, x, view, point), loss=Cauchy(1.0))
    assert result.cost < result.initial_cost
    for value in (result.X, result.poses.R, result.poses.t, result.cameras.K, result.residuals):
        assert value.isfinite().all()


def test_outliers_and_losses(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator, points=150)
    outlier = torch.rand(len(x), generator=generator) < 0.1
    spoiled = torch.where(outlier[:, None], x + 60 * torch.randn(x.shape, generator=generator, dtype=F64), x)
    start, X0 = perturb(poses, X, generator, 0.003)
    robust = bundle_adjust(BundleProblem.of(start, cameras, X0, spoiled, view, point), free=("focal",), loss=Cauchy(1.0))
    squares = bundle_adjust(BundleProblem.of(start, cameras, X0, spoiled, view, point), free=("focal",))
    inliers = bundle_adjust(BundleProblem.of(start, cameras, X0, x, view, point), free=("focal",), weights=(~outlier).double())

    def error(result: BundleResult) -> Tensor:
        return (similarity_from_points(result.X, X).transform(result.X) - X).square().mean().sqrt()

    assert error(robust) < 1.5 * error(inliers)
    assert error(squares) > 4 * error(robust)


def test_priors_on_intrinsics(generator: torch.Generator) -> None:
    """A tight prior holds the focal length, a loose one lets it go, between them information adds up."""
    poses, cameras, X, x, view, point, _ = make_scene(generator, model="pinhole")
    guess = Camera(intrinsics(torch.tensor([840.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64)), NoDistortion())
    problem = BundleProblem.of(poses, guess, X, x, view, point)
    focal = [
        bundle_adjust(problem, free=("focal",), intrinsics_sigma={"focal": s}, tolerance=1e-10).cameras.K[0, 0, 0]
        for s in (1e-7, 1e-3, 10.0)
    ]
    free = bundle_adjust(problem, free=("focal",), tolerance=1e-10).cameras.K[0, 0, 0]
    assert abs(focal[0] - 840) < 0.1
    assert abs(focal[2] - free) < 0.01
    assert free + 1 < focal[1] < 839
    centred = bundle_adjust(problem, free=("focal",), intrinsics_sigma={"focal": 1e-7}, intrinsics_mean=cameras)
    assert abs(centred.cameras.K[0, 0, 0] - 800) < 0.1


def test_float32_and_repeatability(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    start, X0 = perturb(poses, X, generator)
    double = bundle_adjust(BundleProblem.of(start, cameras, X0, x, view, point), free=("focal", "k1"))
    again = bundle_adjust(BundleProblem.of(start, cameras, X0, x, view, point), free=("focal", "k1"))
    assert torch.equal(double.X, again.X)
    camera = Camera(cameras.K.float(), Radial(cameras.distortion.k1.float(), cameras.distortion.k2.float()))
    single = bundle_adjust(
        BundleProblem.of(Pose(start.R.float(), start.t.float()), camera, X0.float(), x.float(), view, point),
        free=("focal", "k1"),
    )
    assert single.X.dtype == single.poses.R.dtype == single.cameras.K.dtype == torch.float32
    np.testing.assert_allclose(single.cost, double.cost, rtol=1e-4)
    gap = single.poses.R.mT @ single.poses.R - torch.eye(3)
    assert gap.abs().max() < 1e-5


def test_iteration_limit_and_nothing_free(generator: torch.Generator) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    start, X0 = perturb(poses, X, generator)
    seen = []
    result = bundle_adjust(
        BundleProblem.of(start, cameras, X0, x, view, point), max_iterations=1, progress=lambda k, c: seen.append((k, c))
    )
    assert result.status == Status.NOT_CONVERGED
    assert seen == [(1, result.cost)]
    assert result.cost < result.initial_cost
    every = torch.ones(8, dtype=torch.bool), torch.ones(100, dtype=torch.bool)
    still = bundle_adjust(
        BundleProblem.of(start, cameras, X0, x, view, point), free=(), fixed_poses=every[0], fixed_points=every[1]
    )
    assert still.status == Status.TOO_FEW
    assert still.cost == pytest.approx(result.initial_cost)
    empty = bundle_adjust(BundleProblem.of(start, cameras, X0, x[:0], view[:0], point[:0]))
    assert empty.status == Status.TOO_FEW
    assert empty.residuals.shape == (0,)


def test_wrong_arguments(generator: torch.Generator, unchecked: None) -> None:
    poses, cameras, X, x, view, point, _ = make_scene(generator)
    with pytest.raises(ValueError, match="free"):
        bundle_adjust(BundleProblem.of(poses, cameras, X, x, view, point), free=("k3",))
    with pytest.raises(ValueError, match="view: wanted numbers from 0 to 7"):
        bundle_adjust(BundleProblem.of(poses, cameras, X, x, view + 1, point))
    with pytest.raises(ValueError, match="point"):
        bundle_adjust(BundleProblem.of(poses, cameras, X, x, view, point[:-1]))
    with pytest.raises(ValueError, match="camera_index"):
        bundle_adjust(BundleProblem.of(poses, make_camera("radial", 2), X, x, view, point))
    with pytest.raises(ValueError, match="fixed_points"):
        bundle_adjust(BundleProblem.of(poses, cameras, X, x, view, point), fixed_points=torch.ones(3, dtype=torch.bool))


@pytest.mark.parametrize(
    ("name", "start", "end"),
    [
        ("dubrovnik-3-7-pre.txt", 2764.22, 1e3),
        ("problem-21-11315-pre.txt.gz", 4.413239e6, 3.0379e4),
        ("problem-49-7776-pre.txt.gz", 8.509125e5, 1.3345e4),
    ],
)
def test_bal(data: Path, name: str, start: float, end: float) -> None:
    result = bundle_adjust_model(read_bal(data / "bal" / name), free=("focal", "k1", "k2"), max_iterations=100).result
    np.testing.assert_allclose(result.initial_cost, start, rtol=1e-5)
    assert result.cost <= end
    angles = rotation_angle(result.poses.R @ result.poses.R.mT)
    assert angles.max() < 1e-7
