"""Priors on centres, poses and points; what holds the world; and its restoration."""

import pytest
import torch
from torch import Tensor

from torchsfm.bundle import CentrePrior, PointPrior, PosePrior, Prior, RelativePosePrior, Rig, bundle_adjust, bundle_covariance
from torchsfm.bundle.gauge import gauge_motions
from torchsfm.geometry import (
    BundleProblem,
    Camera,
    NoDistortion,
    Pose,
    intrinsics,
    random_rotation,
    rotation_angle,
    rotation_from_rotvec,
    similarity_from_points,
)
from torchsfm.optim import Cauchy, RigidMotion

F64 = torch.float64
Scene = tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor]


@pytest.fixture
def scene(generator: torch.Generator) -> Scene:
    """Six views of sixty points, 0.5 pixels of noise."""
    angle = torch.linspace(-0.6, 0.6, 6, dtype=F64)
    R = rotation_from_rotvec(torch.stack((0.1 * torch.cos(3 * angle), angle, torch.zeros_like(angle)), -1))
    poses = Pose(R, torch.tensor([0.0, 0.0, 4.0], dtype=F64) + 0.2 * torch.randn(6, 3, generator=generator, dtype=F64))
    K = intrinsics(torch.tensor([700.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64))
    X = torch.rand(60, 3, generator=generator, dtype=F64) * 2 - 1
    visible = torch.rand(6, 60, generator=generator) < 0.8
    visible[2:5] = True
    view, point = visible.nonzero().unbind(1)
    camera = Camera(K, NoDistortion())
    x = camera[torch.zeros_like(view)].project(poses[view].transform(X[point, None]))[:, 0]
    return poses, camera, X, x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64), view, point


def elsewhere(poses: Pose, X: Tensor, generator: torch.Generator) -> tuple[Pose, Tensor]:
    """The same model in a world turned, moved and scaled a little."""
    turn = rotation_from_rotvec(0.1 * torch.randn(3, generator=generator, dtype=F64))
    shift = 0.3 * torch.randn(3, generator=generator, dtype=F64)
    X2 = 1.2 * X @ turn.mT + shift
    centre = 1.2 * poses.centre @ turn.mT + shift
    R = poses.R @ turn.mT
    return Pose(R, -(R @ centre[:, :, None])[:, :, 0]), X2


def test_positions_hold_the_world(scene: Scene, generator: torch.Generator) -> None:
    """From another world to that of the positions, with everything in its place."""
    poses, camera, X, x, view, point = scene
    start, X0 = elsewhere(poses, X, generator)
    truth = poses.centre
    for prior in (
        CentrePrior(torch.arange(6), truth, 0.01),
        PointPrior(torch.arange(20), X[:20], 0.01),
        PosePrior(torch.arange(6), poses, 0.01),
    ):
        result = bundle_adjust(
            BundleProblem.of(start, camera, X0, x, view, point), free=(), priors=[prior], tolerance=1e-12, max_iterations=100
        )
        assert (result.poses.centre - truth).norm(dim=1).max() < 0.05
        assert (result.X - X).norm(dim=1).mean() < 0.02
        free = bundle_covariance(BundleProblem.of(poses, camera, X, x, view, point), free=())
        held = bundle_covariance(BundleProblem.of(poses, camera, X, x, view, point), free=(), priors=[prior], sigma=0.5)
        assert (free.nullity, held.nullity) == (7, 0)


def test_motions_from_pose_to_pose_bend_no_more_than_they_are_sure(scene: Scene, generator: torch.Generator) -> None:
    """Exact motions, and points that see noise: rotations come from the motions, the world stays free."""
    poses, camera, X, x, view, point = scene
    pairs = torch.tensor([[0, 1], [1, 2], [2, 3], [5, 3], [4, 3]])
    motions = poses[pairs[:, 1]] @ poses[pairs[:, 0]].inverse()
    problem = BundleProblem.of(poses, camera, X, x, view, point)
    free = bundle_adjust(problem, free=(), tolerance=1e-12, max_iterations=100).poses
    turned = torch.tensor([1e-6] * 3 + [torch.inf] * 3, dtype=F64)

    def off(found: Pose) -> tuple[float, float]:
        error = (found[pairs[:, 1]] @ found[pairs[:, 0]].inverse()) @ motions.inverse()
        return float(rotation_angle(error.R).max()), float(error.t.norm(dim=-1).max())

    for solver in ("dense", "sparse", "pcg"):
        prior = RelativePosePrior(pairs, motions, turned)
        found = bundle_adjust(problem, free=(), priors=[prior], tolerance=1e-12, max_iterations=100, linear_solver=solver)
        # Where images know to a thousandth, motions are believed; translations, of which nothing is said, follow the images.
        assert off(free)[0] > 1e-4 > 1e-6 > off(found.poses)[0]
        assert off(found.poses)[1] > 1e-4
        whole = bundle_adjust(problem, free=(), priors=[RelativePosePrior(pairs, motions, 1e-6)], linear_solver=solver)
        assert max(off(whole.poses)) < 1e-5
    # All but the place and the direction of the world are known, its size from the motions.
    assert bundle_covariance(problem, free=(), priors=[prior]).nullity == 7
    assert bundle_covariance(problem, free=(), priors=[RelativePosePrior(pairs, motions, 0.01)]).nullity == 6
    with pytest.raises(ValueError, match="two different poses"):
        RelativePosePrior(pairs[:, :1].expand(-1, 2), motions, 1.0)


def test_poses_bound_to_each_other_are_not_eliminated(scene: Scene, generator: torch.Generator) -> None:
    """A film of few points, of which poses are eliminated otherwise."""
    poses, camera, X, _, _, _ = scene
    many = poses[torch.arange(48) % 6]
    view, point = torch.arange(48).repeat_interleave(4), torch.arange(4).repeat(48)
    x = camera[torch.zeros_like(view)].project(many[view].transform(X[point, None]))[:, 0]
    pairs = torch.stack((torch.arange(47), torch.arange(1, 48)), -1)
    prior = RelativePosePrior(pairs, many[1:] @ many[:-1].inverse(), 0.1)
    noisy = many.retract(0.01 * torch.randn(48, 6, generator=generator, dtype=F64))
    found = bundle_adjust(
        BundleProblem.of(noisy, camera, X[:4], x, view, point),
        free=(),
        priors=[prior],
        fixed_points=torch.ones(4, dtype=torch.bool),
    )
    assert rotation_angle(found.poses.R @ many.R.mT).max() < 1e-5


def test_information_adds_up(scene: Scene, generator: torch.Generator) -> None:
    """Many noises of images and positions: the errors have the covariance that is predicted, prior included."""
    poses, camera, X, x, view, point = scene
    exact = camera[torch.zeros_like(view)].project(poses[view].transform(X[point, None]))[:, 0]
    sigma = torch.tensor([0.02, 0.02, 0.05], dtype=F64)
    weights = torch.full((len(x),), 1 / 0.5**2, dtype=F64)
    prior = CentrePrior(torch.arange(6), poses.centre, sigma)
    known = bundle_covariance(
        BundleProblem.of(poses, camera, X, exact, view, point), free=(), weights=weights, sigma=1.0, priors=[prior]
    )
    chi2 = []
    for _ in range(30):
        noisy = exact + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64)
        gps = poses.centre + sigma * torch.randn(6, 3, generator=generator, dtype=F64)
        prior = CentrePrior(torch.arange(6), gps, sigma)
        result = bundle_adjust(
            BundleProblem.of(poses, camera, X, noisy, view, point), free=(), weights=weights, priors=[prior], tolerance=1e-10
        )
        error = (result.X - X)[:, None]
        chi2.append((error @ torch.linalg.solve(known.X, error.mT)).mean() / 3)
    # All points of a trial share the error of the world's place.
    assert 0.7 < torch.stack(chi2).mean() < 1.4


def test_sigmas_and_covariances_say_the_same(scene: Scene, generator: torch.Generator) -> None:
    poses, camera, X, x, view, point = scene
    which = torch.tensor([0, 3, 5])
    sigma = torch.tensor([0.01, 0.02, 0.03], dtype=F64)
    centre = poses.centre[which] + 0.02
    covariance = torch.diag(sigma.square()).expand(3, 3, 3)
    problem = BundleProblem.of(poses, camera, X, x, view, point)
    one = bundle_adjust(problem, free=(), priors=[CentrePrior(which, centre, sigma)], tolerance=1e-12)
    two = bundle_adjust(problem, free=(), priors=[CentrePrior(which, centre, 1.0, covariance=covariance)], tolerance=1e-12)
    torch.testing.assert_close(one.X, two.X, rtol=0, atol=1e-9)
    assert one.cost == pytest.approx(two.cost, rel=1e-10)
    # A rotated covariance is that of rotated errors: the cost at the start is the Mahalanobis distance.
    turn = random_rotation(generator=generator, dtype=F64)
    skewed = turn @ torch.diag(sigma.square()) @ turn.mT
    error = poses.centre[which] - centre
    expected = (error[:, None] @ torch.linalg.solve(skewed, error[:, :, None])).sum() / 2
    plain = bundle_adjust(problem, free=(), max_iterations=0)
    three = bundle_adjust(
        problem,
        free=(),
        max_iterations=0,
        priors=[CentrePrior(which, centre, 1.0, covariance=skewed.expand(3, 3, 3))],
    )
    assert three.initial_cost - plain.initial_cost == pytest.approx(float(expected), rel=1e-9)


def test_a_pose_prior_measures_its_own_coordinates(scene: Scene, generator: torch.Generator) -> None:
    poses, camera, X, x, view, point = scene
    delta = 0.1 * torch.randn(6, 6, generator=generator, dtype=F64)
    off = poses.retract(delta)
    sigma = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=F64)
    problem = BundleProblem.of(off, camera, X, x, view, point)
    with_prior = bundle_adjust(problem, free=(), max_iterations=0, priors=[PosePrior(torch.arange(6), poses, sigma)])
    without = bundle_adjust(problem, free=(), max_iterations=0)
    expected = float((delta / sigma).square().sum() / 2)
    assert with_prior.initial_cost - without.initial_cost == pytest.approx(expected, rel=1e-8)


def test_a_robust_prior_survives_a_wrong_position(scene: Scene) -> None:
    poses, camera, X, x, view, point = scene
    centre = poses.centre.clone()
    centre[4] += 5.0
    problem = BundleProblem.of(poses, camera, X, x, view, point)
    plain = bundle_adjust(problem, free=(), priors=[CentrePrior(torch.arange(6), centre, 0.01)])
    robust = bundle_adjust(problem, free=(), priors=[CentrePrior(torch.arange(6), centre, 0.01, loss=Cauchy(2.0))])
    assert (robust.poses.centre - poses.centre).norm(dim=1).max() < 0.05
    assert (plain.poses.centre - poses.centre).norm(dim=1).max() > 0.3


def test_priors_place_what_images_do_not(scene: Scene) -> None:
    """A pose without observations goes where its prior says, a point too; NaN priors do not count."""
    poses, camera, X, x, view, point = scene
    keep = (view != 1) & (point != 2)
    goal = torch.tensor([[1.0, 2.0, 3.0]], dtype=F64)
    priors = [
        PosePrior(torch.tensor([1]), Pose(poses.R[1:2], goal), 0.1),
        PointPrior(torch.tensor([2]), goal, 0.1),
        PointPrior(torch.tensor([3]), goal * torch.nan, 0.1),
        CentrePrior(torch.tensor([4]), goal, 0.0),
    ]
    result = bundle_adjust(
        BundleProblem.of(poses, camera, X, x[keep], view[keep], point[keep]), free=(), priors=priors, tolerance=1e-12
    )
    torch.testing.assert_close(result.poses.t[1], goal[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(result.X[2], goal[0], rtol=0, atol=1e-6)
    assert result.X.isfinite().all()
    assert (result.X[3] - X[3]).norm() < 0.1


def test_derivatives_of_priors(scene: Scene, generator: torch.Generator) -> None:
    poses, camera, X, x, view, point = scene

    def function(centre: Tensor, control: Tensor) -> Tensor:
        priors: list[Prior] = [CentrePrior(torch.arange(6), centre, 0.02), PointPrior(torch.arange(4), control, 0.03)]
        result = bundle_adjust(
            BundleProblem.of(poses, camera, X, x, view, point), free=("focal",), priors=priors, tolerance=1e-15
        )
        return result.X.sum() + result.poses.t.square().sum() + result.cameras.K[0, 0, 0] / 100

    inputs = poses.centre, X[:4]
    leaves = tuple(v.clone().requires_grad_() for v in inputs)
    gradients = torch.autograd.grad(function(*leaves), leaves)
    for k, gradient in enumerate(gradients):
        step = 1e-4 * torch.randn(inputs[k].shape, generator=generator, dtype=F64)
        plus, minus = (function(*(v + s * step if n == k else v for n, v in enumerate(inputs))) for s in (1, -1))
        torch.testing.assert_close((gradient * step).sum(), (plus - minus) / 2, rtol=1e-4, atol=1e-9)


def test_first_gauge(scene: Scene, generator: torch.Generator) -> None:
    poses, camera, X, x, view, point = scene
    start = poses.retract(0.02 * torch.randn(6, 6, generator=generator, dtype=F64))
    X0 = X + 0.02 * torch.randn(X.shape, generator=generator, dtype=F64)
    seen = view != 0
    problem = BundleProblem.of(start, camera, X0, x[seen], view[seen], point[seen])
    free = bundle_adjust(problem, free=(), tolerance=1e-12)
    first = bundle_adjust(problem, free=(), tolerance=1e-12, gauge="first")
    assert first.cost == free.cost
    # View 0 sees nothing and stays; view 1 is the first that takes part.
    for k in (0, 1):
        assert torch.equal(first.poses.R[k], start.R[k])
        assert torch.equal(first.poses.t[k], start.t[k])
    away = (start.centre[1:] - start.centre[1]).norm(dim=1)
    far = 1 + int(away.argmax())
    assert (first.poses.centre[far] - first.poses.centre[1]).norm() == pytest.approx(float(away.max()), rel=1e-12)
    # The same shape, seen the same.
    projected = camera[torch.zeros_like(view)].project(first.poses[view].transform(first.X[point, None]))[:, 0]
    torch.testing.assert_close((projected - x).norm(dim=1)[seen], free.residuals, rtol=1e-9, atol=1e-9)
    s = similarity_from_points(free.X, first.X)
    torch.testing.assert_close(s.transform(free.X), first.X, rtol=0, atol=1e-9)


def test_first_gauge_of_a_rig(scene: Scene, generator: torch.Generator) -> None:
    """A rig's size scales with the world where nothing holds it."""
    poses, camera, X, x, view, point = scene
    places = Pose(random_rotation(2, generator=generator, dtype=F64), torch.randn(2, 3, generator=generator, dtype=F64))
    rig = Rig(places, torch.tensor([0, 1] * 3), torch.arange(6))
    body = Pose(places.R[rig.sensor], places.t[rig.sensor]).inverse() @ poses
    body = body.retract(0.01 * torch.randn(6, 6, generator=generator, dtype=F64))
    problem = BundleProblem.of(rig.view_poses(body), camera, X, x, view, point)
    body = rig.frame_poses(problem.poses)
    for fixed in (None, torch.tensor([True, True])):
        result = bundle_adjust(problem, free=(), rig=rig, fixed_sensors=fixed, gauge="first", tolerance=1e-12)
        assert torch.equal(result.poses.R[0], body.R[0])
        assert result.rig is not None
        placed = result.rig.view_poses(result.poses)
        projected = camera[torch.zeros_like(view)].project(placed[view].transform(result.X[point, None]))[:, 0]
        torch.testing.assert_close((projected - x).norm(dim=1), result.residuals, rtol=1e-8, atol=1e-8)
        assert rotation_angle(result.rig.cam_from_rig.R @ places.R.mT).max() < 0.2


def test_gauge_that_is_held_already(scene: Scene) -> None:
    poses, camera, X, x, view, point = scene
    problem = BundleProblem.of(poses, camera, X, x, view, point)
    for options in (
        {"fixed_poses": torch.arange(6) == 0},
        {"fixed_points": torch.arange(60) == 0},
        {"priors": [CentrePrior(torch.arange(6), poses.centre, 1.0)]},
    ):
        with pytest.raises(ValueError, match="gauge"):
            bundle_adjust(problem, gauge="first", **options)  # type: ignore[arg-type]


@pytest.mark.usefixtures("unchecked")
def test_wrong_priors(scene: Scene) -> None:
    poses, camera, X, x, view, point = scene
    problem = BundleProblem.of(poses, camera, X, x, view, point)
    with pytest.raises(ValueError, match="centre: wanted k = 2"):
        CentrePrior(torch.arange(2), poses.centre, 1.0)
    with pytest.raises(ValueError, match="covariance: wanted shape"):
        PointPrior(torch.arange(2), X[:2], 1.0, covariance=torch.eye(3, dtype=F64)[0])
    with pytest.raises(ValueError, match=r"priors\[1\]\.index: wanted numbers from 0 to 5"):
        bundle_adjust(
            problem,
            priors=[PointPrior(torch.tensor([7]), X[:1], 1.0), PosePrior(torch.tensor([6]), poses[:1], 1.0)],
        )


def test_motions_of_the_gauge_change_no_image(generator: torch.Generator) -> None:
    R, t = random_rotation(5, generator=generator, dtype=F64), torch.randn(5, 3, generator=generator, dtype=F64)
    poses, X = Pose(R, t), torch.randn(40, 3, generator=generator, dtype=F64)
    rows, middle, size = torch.cat((R.flatten(1), t), 1), poses.centre.mean(0), 1e-6
    motions = gauge_motions(rows, keep_size=False)
    assert gauge_motions(rows, keep_size=True).equal(motions[..., :6])

    def rays(R: Tensor, t: Tensor, X: Tensor) -> Tensor:
        return torch.nn.functional.normalize((R[:, None] @ X[..., None])[..., 0] + t[:, None], dim=-1)

    for k, way in enumerate(torch.eye(7, dtype=F64)):
        moved = RigidMotion().retract(rows, size * motions[..., k])
        off = X - middle
        world = X + size * (way[:3] + torch.linalg.cross(way[3:6].expand_as(off), off) + way[6] * off)
        apart = rays(moved[:, :9].reshape(-1, 3, 3), moved[:, 9:], world) - rays(R, t, X)
        assert apart.abs().max() < 1e-4 * size
