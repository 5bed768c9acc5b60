"""Simulated observations: exact without errors, with the statistics asked for otherwise."""

import math

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry.cameras import Camera, intrinsics, project_points
from torchsfm.geometry.distortion import SimpleRadial
from torchsfm.geometry.poses import Pose
from torchsfm.simulation import look_at, orbit_poses, random_intrinsics, random_points, random_poses, simulate_images

SIZE = (1000, 750)


def problem(*batch: int, views: int = 3, n: int = 200) -> tuple[Tensor, Pose, Camera]:
    g = seeded(1)
    X = random_points(*batch, n, generator=g)
    poses = random_poses(*batch, views, generator=g)
    return X, poses, Camera(random_intrinsics(*batch, views, image_size=SIZE, generator=g))


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_exact_projections_in_any_batch(batch: tuple[int, ...]) -> None:
    X, poses, cameras = problem(*batch)
    seen = simulate_images(X, poses, cameras, image_size=SIZE, generator=seeded())
    assert seen.x.shape == (*batch, 3, 200, 2)
    assert seen.visible.shape == seen.outlier.shape == seen.depth.shape == (*batch, 3, 200)
    expected = project_points(cameras.K @ poses.matrix(), X[..., None, :, :])
    assert torch.allclose(seen.x_true, expected)
    assert torch.allclose(seen.x[seen.visible], expected[seen.visible])
    assert (seen.x[~seen.visible] == 0).all()
    assert not seen.outlier.any()


def test_one_camera_and_one_cloud_serve_all() -> None:
    X, _, _ = problem()
    poses = random_poses(4, 3, generator=seeded(2))
    camera = Camera(intrinsics(torch.tensor(800.0, dtype=torch.float64), torch.tensor([500.0, 375.0], dtype=torch.float64)))
    seen = simulate_images(X, poses, camera, image_size=SIZE, generator=seeded())
    assert seen.x.shape == (4, 3, 200, 2)
    single = simulate_images(X, poses[1], camera, image_size=SIZE, generator=seeded())
    assert torch.equal(seen.x_true[1], single.x_true)
    assert torch.equal(seen.visible[1], single.visible)


def test_field_of_view_and_depth_limits() -> None:
    X, poses, cameras = problem(n=3000)
    X = 3 * X
    seen = simulate_images(X, poses, cameras, image_size=SIZE, depth_range=(2.0, 5.0), generator=seeded())
    x, z = seen.x_true, seen.depth
    inside = (x[..., 0] >= -0.5) & (x[..., 0] < 999.5) & (x[..., 1] >= -0.5) & (x[..., 1] < 749.5)
    assert torch.equal(seen.visible, inside & (z > 2) & (z <= 5))
    assert 0.1 < seen.visible.float().mean() < 0.9


def test_points_behind_are_not_seen() -> None:
    X = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]], dtype=torch.float64)
    camera = Camera(intrinsics(torch.tensor(1.0, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)))
    seen = simulate_images(X, Pose.identity(1, dtype=torch.float64), camera)
    assert seen.visible.tolist() == [[True, False]]


def test_points_beyond_the_fold_of_the_lens_are_not_seen() -> None:
    one = torch.ones((), dtype=torch.float64)
    camera = Camera(intrinsics(500 * one, torch.tensor([500.0, 375.0], dtype=torch.float64)), SimpleRadial(-0.3 * one))
    X = torch.tensor([[0.5, 0.0, 1.0], [1.5, 0.0, 1.0]], dtype=torch.float64)
    seen = simulate_images(X, Pose.identity(1, dtype=torch.float64), camera, image_size=SIZE)
    assert (seen.x_true[0, :, 0] < 999).all(), "both land in the image"
    assert seen.visible.tolist() == [[True, False]]


def test_noise_outliers_and_dropout_have_their_rates() -> None:
    X, poses, cameras = problem(20, n=1000)
    everything = simulate_images(X, poses, cameras, image_size=SIZE, generator=seeded()).visible
    seen = simulate_images(X, poses, cameras, image_size=SIZE, noise=0.7, outliers=0.3, dropout=0.2, generator=seeded())
    kept = seen.visible.sum() / everything.sum()
    assert float(kept) == pytest.approx(0.8, abs=0.01)
    assert not (seen.visible & ~everything).any()
    assert not (seen.outlier & ~seen.visible).any()
    assert float(seen.outlier.sum() / seen.visible.sum()) == pytest.approx(0.3, abs=0.01)
    error = (seen.x - seen.x_true)[seen.visible & ~seen.outlier]
    assert float(error.std()) == pytest.approx(0.7, rel=0.02)
    assert error.mean(0).abs().max() < 0.02
    wild = seen.x[seen.outlier]
    size = torch.tensor(SIZE, dtype=torch.float64)
    assert ((wild >= -0.5) & (wild <= size - 0.5)).all()
    assert torch.allclose(wild.mean(0), (size - 1) / 2, rtol=0.03)
    assert torch.allclose(wild.std(0), size / math.sqrt(12), rtol=0.03)


def test_outliers_without_an_image_size_stay_among_the_points() -> None:
    X, poses, cameras = problem(2)
    seen = simulate_images(X, poses, cameras, outliers=1.0, generator=seeded())
    assert seen.outlier.all()
    for i in range(2):
        for j in range(3):
            assert (seen.x[i, j] >= seen.x_true[i, j].amin(0)).all()
            assert (seen.x[i, j] <= seen.x_true[i, j].amax(0)).all()


def test_a_broken_problem_leaves_its_neighbours_alone() -> None:
    X, poses, cameras = problem(3)
    good = simulate_images(X, poses, cameras, image_size=SIZE, noise=1.0, outliers=0.2, generator=seeded())
    broken = X.clone()
    broken[1, 5] = float("nan")
    bad = simulate_images(broken, poses, cameras, image_size=SIZE, noise=1.0, outliers=0.2, generator=seeded())
    assert not bad.visible[1, :, 5].any()
    assert torch.isfinite(bad.x).all()
    assert torch.equal(bad.x[::2], good.x[::2])
    keep = torch.arange(200) != 5
    assert torch.equal(bad.x[1][:, keep], good.x[1][:, keep])


def test_derivatives_reach_the_points() -> None:
    X, poses, cameras = problem(n=4)
    X.requires_grad_()
    simulate_images(X, poses, cameras, noise=1.0, generator=seeded()).x.sum().backward()
    assert X.grad is not None
    assert torch.isfinite(X.grad).all()
    assert (X.grad != 0).any()


def test_the_same_generator_gives_the_same_answer() -> None:
    X, poses, cameras = problem()
    first, again, other = (
        simulate_images(X, poses, cameras, noise=1.0, outliers=0.2, generator=seeded(s)).x for s in (3, 3, 4)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_dtype_follows_the_input() -> None:
    X, poses, cameras = problem()
    seen = simulate_images(X.float(), Pose(poses.R.float(), poses.t.float()), Camera(cameras.K.float()), noise=1.0)
    assert seen.x.dtype == seen.depth.dtype == torch.float32


def test_wrong_arguments(unchecked: None) -> None:
    X, poses, cameras = problem()
    with pytest.raises(ValueError, match=r"X: wanted shape \(\*batch, n, 3\)"):
        simulate_images(X[:, :2], poses, cameras)
    with pytest.raises(ValueError, match="poses: wanted batch shape"):
        simulate_images(X, poses[0], cameras)
    with pytest.raises(ValueError, match="outliers: wanted 0 <= float <= 1, got 2"):
        simulate_images(X, poses, cameras, outliers=2.0)
    with pytest.raises(ValueError, match="noise: wanted float >= 0"):
        simulate_images(X, poses, cameras, noise=-1.0)
    with pytest.raises(ValueError, match="kind: wanted one of"):
        random_points(3, kind="torus")
    with pytest.raises(ValueError, match="views: wanted int >= 1"):
        orbit_poses(0)


@pytest.mark.parametrize("kind", ["ball", "cube", "plane", "line", "gauss"])
def test_random_points_fill_their_shape(kind: str) -> None:
    X = random_points(4, 20000, kind=kind, size=2.0, generator=seeded())
    assert X.shape == (4, 20000, 3)
    used = {"plane": 2, "line": 1}.get(kind, 3)
    assert (X[..., used:] == 0).all()
    deviation = {"ball": 2 / math.sqrt(5), "gauss": 2.0}.get(kind, 2 / math.sqrt(3))
    assert torch.allclose(X[..., :used].std(1), torch.full((4, used), deviation, dtype=X.dtype), rtol=0.03)
    assert X.mean(1).abs().max() < 0.05


def test_look_at_puts_the_target_ahead_and_up_above() -> None:
    g = seeded()
    centre, target = (torch.randn(50, 3, generator=g, dtype=torch.float64) for _ in range(2))
    pose = look_at(centre, target)
    assert torch.allclose(pose.centre, centre)
    assert torch.allclose(torch.linalg.det(pose.R), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(pose.R @ pose.R.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    ahead = pose.transform(target[:, None])[:, 0]
    assert torch.allclose(ahead[:, :2], torch.zeros(50, 2, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(ahead[:, 2], (target - centre).norm(dim=-1))
    above = pose.transform((target + torch.tensor([0, 0, 0.1], dtype=torch.float64))[:, None])[:, 0]
    assert above[:, 0].abs().max() < 1e-12
    assert (above[:, 1] < 0).all(), "up in the world is up in the image, where y points down"


@pytest.mark.parametrize("target", [(0.0, 0.0, 5.0), (0.0, 0.0, -5.0), (0.0, 0.0, 0.0)])
def test_look_at_survives_degenerate_directions(target: tuple[float, float, float]) -> None:
    pose = look_at(torch.zeros(3, dtype=torch.float64), torch.tensor(target, dtype=torch.float64))
    assert torch.allclose(pose.R @ pose.R.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(pose.R)) == pytest.approx(1)


def test_orbit_stays_on_its_cylinder() -> None:
    target = (1.0, 2.0, 3.0)
    poses = orbit_poses(9, radius=4.0, height=(0.5, 2.0), sweep=1.2, start=0.3, target=target)
    offset = poses.centre - torch.tensor(target, dtype=torch.float64)
    assert torch.allclose(offset[:, :2].norm(dim=-1), torch.full((9,), 4.0, dtype=torch.float64))
    angle = torch.atan2(offset[:, 1], offset[:, 0])
    assert torch.allclose(angle, 0.3 + torch.linspace(0, 1.2, 9, dtype=torch.float64))
    assert float(offset[:, 2].min()) == pytest.approx(0.5)
    assert float(offset[:, 2].max()) == pytest.approx(2.0)
    whole = orbit_poses(8, sweep=2 * math.pi)
    assert (whole.centre[0] - whole.centre[-1]).norm() > 1


def test_random_poses_face_the_origin_from_their_cap() -> None:
    poses = random_poses(5, 400, distance=(4.0, 6.0), spread=0.5, wobble=0.0, generator=seeded())
    assert poses.shape == (5, 400)
    distance = poses.centre.norm(dim=-1)
    assert 4 <= float(distance.min()) < 4.1
    assert 5.9 < float(distance.max()) <= 6
    assert torch.allclose(poses.t[..., :2], torch.zeros(5, 400, 2, dtype=torch.float64), atol=1e-12)
    angle = torch.acos(-poses.centre[..., 2] / distance)
    assert 0.49 < float(angle.max()) <= 0.5 + 1e-9
    roll = torch.atan2(poses.R[..., 1, 0], poses.R[..., 1, 1])
    assert float(roll.abs().mean()) < 0.35


def test_random_intrinsics_have_the_angle_of_view() -> None:
    K = random_intrinsics(2000, image_size=SIZE, view_angle=(0.8, 1.0), wobble=0.02, generator=seeded())
    angle = 2 * torch.atan(500 / K[:, 0, 0])
    assert 0.8 <= float(angle.min()) < 0.81
    assert 0.99 < float(angle.max()) <= 1.0
    assert torch.equal(K[:, 0, 0], K[:, 1, 1])
    assert torch.allclose(K[:, :2, 2].mean(0), torch.tensor([499.5, 374.5], dtype=torch.float64), atol=2)
    assert torch.allclose(K[:, :2, 2].std(0), torch.full((2,), 20.0, dtype=torch.float64), rtol=0.1)
    assert random_intrinsics().shape == (3, 3)
