import pytest
import torch
from torch import Tensor

from torchsfm.bundle import bundle_adjust, bundle_covariance
from torchsfm.geometry import BundleProblem, Camera, Pose, Radial, intrinsics, rotation_from_rotvec

F64 = torch.float64
Scene = tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor]


@pytest.fixture
def scene(generator: torch.Generator) -> Scene:
    """Five views of forty points, exact."""
    angle = torch.linspace(-0.6, 0.6, 5, dtype=F64)
    R = rotation_from_rotvec(torch.stack((0.1 * torch.cos(3 * angle), angle, torch.zeros_like(angle)), -1))
    poses = Pose(R, torch.tensor([0.0, 0.0, 4.0], dtype=F64) + 0.2 * torch.randn(5, 3, generator=generator, dtype=F64))
    K = intrinsics(torch.tensor([700.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64))
    camera = Camera(K, Radial(torch.tensor([-0.1], dtype=F64), torch.tensor([0.02], dtype=F64)))
    X = torch.rand(40, 3, generator=generator, dtype=F64) * 2 - 1
    visible = torch.rand(5, 40, generator=generator) < 0.8
    visible[1:4] |= torch.arange(40) != 13
    view, point = visible.nonzero().unbind(1)
    x = camera[torch.zeros_like(view)].project(poses[view].transform(X[point, None]))[:, 0]
    return poses, camera, X, x, view, point


def test_spread_of_many_trials(scene: Scene, generator: torch.Generator) -> None:
    """Adjusting noisy observations again and again scatters points, poses and the focal length by the covariance."""
    poses, camera, X, x, view, point = scene
    fixed = torch.tensor([True, True, False, False, False])
    options = {"free": ("focal", "k1", "k2"), "fixed_poses": fixed}
    known = bundle_covariance(BundleProblem.of(poses, camera, X, x, view, point), sigma=0.2, **options)
    assert known.nullity == 0
    once = torch.bincount(point, minlength=40) < 2
    assert torch.equal(known.determined_points, ~once)
    assert once.sum() <= 1
    points, focals, shifts, sigmas = [], [], [], []
    for _ in range(40):
        noisy = x + 0.2 * torch.randn(x.shape, generator=generator, dtype=F64)
        result = bundle_adjust(BundleProblem.of(poses, camera, X, noisy, view, point), **options)
        points.append((result.X - X)[~once])
        focals.append((result.cameras.K[0, 0, 0] - 700).square() / known.cameras[0, 0, 0])
        turn = result.poses.R[2:] @ poses.R[2:].mT
        shifts.append(result.poses.t[2:] - (turn @ poses.t[2:, :, None])[:, :, 0])
        sigmas.append(
            bundle_covariance(BundleProblem.of(result.poses, result.cameras, result.X, noisy, view, point), **options).sigma
        )
    for errors, covariance in ((torch.stack(points), known.X[~once]), (torch.stack(shifts), known.poses[2:, 3:, 3:])):
        chi2 = (errors[..., None, :] @ torch.linalg.solve(covariance, errors[..., None])).mean() / 3
        assert 0.85 < chi2 < 1.15
    # Forty squares of one normal number.
    assert 0.5 < torch.stack(focals).mean() < 1.7
    assert abs(sum(sigmas) / 40 - 0.2) < 0.01


def test_cameras_alone(scene: Scene) -> None:
    """Without the covariances of points, those of cameras are the same."""
    problem = BundleProblem.of(*scene)
    options = {"free": ("focal", "k1"), "sigma": 0.3}
    whole, alone = (bundle_covariance(problem, points=points, **options) for points in (True, False))
    torch.testing.assert_close(alone.poses, whole.poses, rtol=1e-6, atol=1e-9 * float(whole.poses.abs().max()))
    torch.testing.assert_close(alone.cameras, whole.cameras, rtol=1e-6, atol=0.0)
    assert alone.nullity == whole.nullity == 7
    assert alone.X.diagonal(dim1=-2, dim2=-1).isinf().all()
    assert not alone.determined_points.any()


def test_gauge(scene: Scene) -> None:
    poses, camera, X, x, view, point = scene
    free = bundle_covariance(BundleProblem.of(poses, camera, X, x, view, point), sigma=1.0, free=())
    assert free.nullity == 7
    assert free.X[free.determined_points].isfinite().all()
    held = bundle_covariance(
        BundleProblem.of(poses, camera, X, x, view, point), sigma=1.0, free=(), fixed_poses=torch.arange(5) == 0
    )
    assert held.nullity == 1
    assert (held.poses[0] == 0).all()
    # Fixing one camera's place and turn moves the uncertainty to the others.
    assert held.poses[1:].diagonal(dim1=1, dim2=2).sum() > free.poses.diagonal(dim1=1, dim2=2).sum()


def test_derivative_of_a_bundle(scene: Scene, generator: torch.Generator) -> None:
    """How the shape found depends on observations and known intrinsics, against central differences; the gauge is free."""
    poses, camera, X, x, view, point = scene
    x = x + 0.3 * torch.randn(x.shape, generator=generator, dtype=F64)

    def shape(x: Tensor, K: Tensor, k1: Tensor) -> Tensor:
        cameras = Camera(K, Radial(k1, camera.distortion.k2))
        result = bundle_adjust(BundleProblem.of(poses, cameras, X, x, view, point), free=(), tolerance=1e-15)
        ratios = (result.X[0] - result.X[1:5]).norm(dim=1) / (result.poses.centre[0] - result.poses.centre[1]).norm()
        return ratios.sum() + result.residuals[:20].square().sum()

    inputs = x, camera.K, camera.distortion.k1
    leaves = tuple(v.clone().requires_grad_() for v in inputs)
    gradients = torch.autograd.grad(shape(*leaves), leaves)
    for k, gradient in enumerate(gradients):
        step = 1e-4 * torch.randn(inputs[k].shape, generator=generator, dtype=F64)
        if k == 1:
            step = step * 30 * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=F64)
        plus, minus = (shape(*(v + s * step if n == k else v for n, v in enumerate(inputs))) for s in (1, -1))
        torch.testing.assert_close((gradient * step).sum(), (plus - minus) / 2, rtol=1e-4, atol=1e-9)


def test_priors_of_intrinsics_count(scene: Scene) -> None:
    poses, camera, X, x, view, point = scene
    data = (poses, camera, X, x, view, point)
    free = bundle_covariance(BundleProblem.of(*data), sigma=1.0, free=("focal",))
    fixed = bundle_covariance(BundleProblem.of(*data), sigma=1.0, free=())
    for width in (1e-9, 1e9):
        known = bundle_covariance(BundleProblem.of(*data), sigma=1.0, free=("focal",), intrinsics_sigma={"focal": width})
        expected = free if width > 1 else fixed
        torch.testing.assert_close(known.poses, expected.poses, rtol=1e-4, atol=1e-12)
    # A prior as wide as what the images say halves the variance.
    sigma = float(free.cameras[0, 0, 0].sqrt() / camera.K[..., 0, 0].flatten()[0])
    both = bundle_covariance(BundleProblem.of(*data), sigma=1.0, free=("focal",), intrinsics_sigma={"focal": sigma})
    torch.testing.assert_close(both.cameras[0, 0, 0], free.cameras[0, 0, 0] / 2, rtol=1e-6, atol=0)
