"""Two thousand adjustments of the same small bundle with nothing held: they scatter as the covariance says, and no more."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchsfm.bundle import bundle_adjust, bundle_covariance
from torchsfm.formats import read_bal
from torchsfm.geometry import BundleProblem, Camera, Pose, intrinsics, rotation_from_rotvec, rotvec_from_rotation
from torchsfm.optim import levenberg_marquardt

F64 = torch.float64
VIEWS, POINTS, SIGMA, TRIALS = 4, 15, 0.3, 2000


@pytest.fixture
def scene(generator: torch.Generator) -> tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor]:
    """Four views of fifteen points, known intrinsics, without noise."""
    angle = torch.linspace(-0.5, 0.5, VIEWS, dtype=F64)
    R = rotation_from_rotvec(torch.stack((0.2 * torch.cos(5 * angle), angle, 0.1 * angle), -1))
    poses = Pose(R, torch.tensor([0.0, 0.0, 4.0], dtype=F64) + 0.2 * torch.randn(VIEWS, 3, generator=generator, dtype=F64))
    camera = Camera(intrinsics(torch.tensor([700.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64)))
    X = torch.rand(POINTS, 3, generator=generator, dtype=F64) * 2 - 1
    view, point = torch.cartesian_prod(torch.arange(VIEWS), torch.arange(POINTS)).T
    x = camera[torch.zeros_like(view)].project(poses[view].transform(X[point, None]))[:, 0]
    return poses, camera, X, x, view, point


def gauge_directions(poses: Pose) -> Tensor:
    """How steps (w, v) of all poses go when the world turns, moves and grows: (6 views, 7)."""
    turn = torch.cat((poses.R, -torch.linalg.cross(poses.R, poses.t[:, :, None].expand(-1, 3, 3), dim=1)), 1)
    shift = torch.cat((torch.zeros_like(poses.R), poses.R), 1)
    grow = torch.cat((torch.zeros_like(poses.t), poses.t), 1)[:, :, None]
    return torch.cat((turn, shift, grow), 2).flatten(0, 1)


def trials(scene: tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor], generator: torch.Generator) -> Tensor:
    """Steps (w, v) from the true poses to the adjusted ones, (trials, 6 views): all bundles in one batch of dense problems."""
    poses, camera, X, x, _, _ = scene
    K = camera.K[0]

    def move(theta: Tensor, delta: Tensor) -> Tensor:
        return theta + delta

    def residual(theta: Tensor, x: Tensor) -> Tensor:
        w, v = theta[..., : 6 * VIEWS].unflatten(-1, (VIEWS, 6)).split(3, -1)
        R = rotation_from_rotvec(w)
        t = (R @ poses.t[..., None])[..., 0] + v
        moved = theta[..., 6 * VIEWS :].unflatten(-1, (POINTS, 3))[..., None, :, :] @ (R @ poses.R).mT + t[..., None, :]
        pixels = moved @ K.T
        return (pixels[..., :2] / pixels[..., 2:]).flatten(-3, -2) - x

    noisy = x + SIGMA * torch.randn((TRIALS, *x.shape), generator=generator, dtype=F64)
    start = torch.cat((torch.zeros(6 * VIEWS, dtype=F64), X.flatten())).expand(TRIALS, -1)
    found = levenberg_marquardt(residual, start, noisy, retract=move, function_tolerance=1e-9, max_iterations=20)
    assert found.cost.isfinite().all()
    return found.x[:, : 6 * VIEWS]


@pytest.mark.slow
def test_free_network(scene: tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor], generator: torch.Generator) -> None:
    poses, camera, X, x, view, point = scene
    known = bundle_covariance(BundleProblem.of(poses, camera, X, x, view, point), free=(), sigma=SIGMA)
    assert known.nullity == 7
    error = trials(scene, generator)
    # Both in one gauge: steps without a part along the seven directions.
    N = gauge_directions(poses)
    across = torch.eye(6 * VIEWS, dtype=F64) - N @ torch.linalg.pinv(N)
    covariance = SIGMA**2 * across @ known.everything.joint @ across.T
    error = error @ across.T
    wanted, found = covariance.diagonal().sqrt(), error.square().mean(0).sqrt()
    ratio = found / wanted
    # One standard deviation of 2,000 trials is known to 1.6 percent.
    assert 0.95 < (ratio.square().mean()).sqrt() < 1.05
    assert ratio.min() > 0.93
    assert ratio.max() < 1.07
    # Within 1.1 of the Cramer-Rao bound in all directions together, and without bias.
    inverse = torch.linalg.pinv(covariance, rtol=1e-9, hermitian=True)
    squared = ((error @ inverse) * error).sum(1)
    assert abs(float(squared.mean()) / (6 * VIEWS - 7) - 1) < 0.05
    assert (error.mean(0) / wanted).abs().max() < 5 * TRIALS**-0.5


@pytest.mark.slow
def test_the_adjustment_is_that_of_the_trials(
    scene: tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor], generator: torch.Generator
) -> None:
    """`bundle_adjust` finds what the batch of dense problems finds."""
    poses, camera, X, x, view, point = scene
    state = generator.get_state()
    error = trials(scene, generator)
    generator.set_state(state)
    noisy = x + SIGMA * torch.randn((TRIALS, *x.shape), generator=generator, dtype=F64)
    N = gauge_directions(poses)
    across = torch.eye(6 * VIEWS, dtype=F64) - N @ torch.linalg.pinv(N)
    for k in range(5):
        found = bundle_adjust(BundleProblem.of(poses, camera, X, noisy[k], view, point), free=(), tolerance=1e-12).poses
        w = rotvec_from_rotation(found.R @ poses.R.mT)
        v = found.t - (found.R @ poses.R.mT @ poses.t[:, :, None])[:, :, 0]
        step = torch.cat((w, v), 1).flatten()
        # The gauge of a step is removed to first order.
        torch.testing.assert_close(across @ step, across @ error[k], rtol=0, atol=2e-4)


@pytest.mark.reference
def test_covariance_of_poses_is_pycolmaps(
    scene: tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor], generator: torch.Generator
) -> None:
    """Two poses and the intrinsics held; COLMAP turns and shifts on the left, `t <- t + v`."""
    pycolmap = pytest.importorskip("pycolmap")
    poses, camera, X, x, view, point = scene
    x = x + SIGMA * torch.randn(x.shape, generator=generator, dtype=F64)
    fixed = torch.tensor([True, True, False, False])
    found = bundle_adjust(BundleProblem.of(poses, camera, X, x, view, point), free=(), fixed_poses=fixed, tolerance=1e-12)
    ours = bundle_covariance(
        BundleProblem.of(found.poses, camera, found.X, x, view, point), free=(), fixed_poses=fixed, sigma=1.0
    )

    model = pycolmap.Reconstruction()
    K = camera.K[0]
    intrinsic = [float(K[0, 0]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5]
    for i in range(VIEWS):
        eye = pycolmap.Camera(camera_id=i + 1, model="SIMPLE_PINHOLE", width=640, height=480, params=intrinsic)
        model.add_camera_with_trivial_rig(eye)
        seen = [pycolmap.Point2D(p) for p in (x[view == i] + 0.5).numpy()]
        image = pycolmap.Image(name=str(i), points2D=pycolmap.Point2DList(seen))
        image.image_id, image.camera_id = i + 1, i + 1
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(found.poses.R[i].numpy()), found.poses.t[i].numpy())
        model.add_image_with_trivial_frame(image, pose)
    for j in range(POINTS):
        track = pycolmap.Track()
        for i in range(VIEWS):
            track.add_element(i + 1, j)
        model.add_point3D(found.X[j].numpy(), track)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(VIEWS):
        config.add_image(i + 1)
    for i in (0, 1):
        config.set_constant_rig_from_world_pose(model.image(i + 1).frame_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    theirs = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    for i in (2, 3):
        t = found.poses.t[i]
        cross = torch.linalg.cross(torch.eye(3, dtype=F64), t.expand(3, 3), dim=1).T
        change = torch.eye(6, dtype=F64)
        change[3:, :3] = cross
        # Ceres' steps of quaternions are half angles.
        angle = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0, 1.0, 1.0], dtype=F64))
        wanted = angle @ torch.from_numpy(theirs.get_cam_cov_from_world(i + 1)) @ angle
        mine = change @ ours.poses[i] @ change.T
        torch.testing.assert_close(mine, wanted, rtol=1e-3, atol=1e-4 * float(wanted.abs().max()))


@pytest.mark.slow
def test_derivative_on_ladybug(data: Path, generator: torch.Generator) -> None:
    """Nothing held: ratios of distances between camera centres, and focal lengths, along a direction of all observations."""
    problem = read_bal(data / "bal" / "problem-49-7776-pre.txt.gz")
    free = {"free": ("focal", "k1", "k2"), "max_iterations": 500}
    start = bundle_adjust(
        BundleProblem.of(problem.poses, problem.cameras, problem.X, problem.x, problem.view, problem.point),
        tolerance=1e-12,
        **free,
    )

    def quantity(x: Tensor, tolerance: float = 1e-13) -> Tensor:
        found = bundle_adjust(
            BundleProblem.of(start.poses, start.cameras, start.X, x, problem.view, problem.point), tolerance=tolerance, **free
        )
        length = found.poses.centre.diff(dim=0).norm(dim=1)
        ramp = torch.linspace(-1, 1, 49, dtype=F64)
        return 100 * (length[1:] / length[:-1]) @ ramp[:47] + found.cameras.K[:, 0, 0] @ ramp

    leaf = problem.x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(quantity(leaf), leaf)
    assert gradient.isfinite().all()
    away = torch.randn(problem.x.shape, generator=generator, dtype=F64)
    step = 3e-3
    numeric = (quantity(problem.x + step * away) - quantity(problem.x - step * away)) / (2 * step)
    torch.testing.assert_close((gradient * away).sum(), numeric, rtol=1e-4, atol=0)
