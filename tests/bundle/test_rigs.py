"""Rigs: several cameras on one body, with their places known or not."""

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import BundleResult, Rig, bundle_adjust, bundle_covariance
from torchsfm.bundle.projection import Projection
from torchsfm.bundle.rig import RigProjection
from torchsfm.geometry import BundleProblem, Camera, Pose, Radial, intrinsics, rotation_angle, rotation_from_rotvec
from torchsfm.geometry.intrinsic_parameters import row_from_camera
from torchsfm.optim import RigidMotion, Subset
from torchsfm.optim.terms import Block, Term, Workspace, lift_of, linearize

F64 = torch.float64
Scene = tuple[Pose, Rig, Camera, Tensor, Tensor, Tensor, Tensor]


def make_scene(generator: torch.Generator, *, frames: int = 5, points: int = 80, noise: float = 0.3) -> Scene:
    """Three cameras on a body that moves along an arc; the second frame lacks the third view."""
    angle = torch.linspace(-0.6, 0.6, frames, dtype=F64)
    zero = torch.zeros_like(angle)
    body = Pose(
        rotation_from_rotvec(torch.stack((0.1 * torch.cos(3 * angle), angle, zero), -1)),
        torch.tensor([0.0, 0.0, 4.0], dtype=F64) + 0.2 * torch.randn(frames, 3, generator=generator, dtype=F64),
    )
    places = Pose(
        rotation_from_rotvec(torch.tensor([[0.0, 0, 0], [0, 0.15, 0.02], [0.1, -0.12, 0]], dtype=F64)),
        torch.tensor([[0.0, 0, 0], [-0.4, 0, 0.05], [0.3, 0.2, 0]], dtype=F64),
    )
    frame, sensor = torch.cartesian_prod(torch.arange(frames), torch.arange(3)).unbind(1)
    keep = ~((frame == 1) & (sensor == 2))
    rig = Rig(places, sensor[keep], frame[keep])
    K = intrinsics(torch.tensor([800.0, 760.0, 840.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64).expand(3, 2))
    cameras = Camera(K, Radial(torch.full((3,), -0.1, dtype=F64), torch.full((3,), 0.02, dtype=F64)))
    X = torch.rand(points, 3, generator=generator, dtype=F64) * 2 - 1
    visible = torch.rand(len(rig.frame), points, generator=generator) < 0.7
    view, point = visible.nonzero().unbind(1)
    x = cameras[rig.sensor[view]].project(rig.view_poses(body)[view].transform(X[point, None]))[:, 0]
    return body, rig, cameras, X, x + noise * torch.randn(x.shape, generator=generator, dtype=F64), view, point


def disturb(pose: Pose, generator: torch.Generator, size: float = 0.01) -> Pose:
    return pose.retract(size * torch.randn(*pose.shape, 6, generator=generator, dtype=F64))


def run(scene: Scene, generator: torch.Generator, **options: object) -> BundleResult:
    body, rig, cameras, X, x, view, point = scene
    places = disturb(rig.cam_from_rig, generator)
    fixed = options.get("fixed_sensors")
    if isinstance(fixed, Tensor):
        places = Pose(
            torch.where(fixed[:, None, None], rig.cam_from_rig.R, places.R),
            torch.where(fixed[:, None], rig.cam_from_rig.t, places.t),
        )
    options = {"free": (), "tolerance": 1e-12} | options
    start = Rig(places, rig.sensor, rig.frame)
    noisy = X + 0.02 * torch.randn(X.shape, generator=generator, dtype=F64)
    problem = BundleProblem(start.view_poses(disturb(body, generator)), cameras, rig.sensor, noisy, x, view, point)
    return bundle_adjust(problem, rig=start, **options)  # type: ignore[arg-type]


def test_jacobians(generator: torch.Generator) -> None:
    body, rig, cameras, X, x, view, point = make_scene(generator, frames=2, points=10)
    rows = row_from_camera(cameras)
    columns = (0, 5, 6)
    through = RigProjection(Projection(Radial, columns))

    def twelve(pose: Pose) -> Tensor:
        return torch.cat((pose.R.flatten(1), pose.t), 1)

    blocks = {
        "pose": Block(twelve(body), RigidMotion()),
        "sensor": Block(twelve(rig.cam_from_rig), RigidMotion()),
        "camera": Block(rows, Subset(rows.shape[1], columns)),
        "point": Block(X),
    }
    values = {name: b.x.mT.contiguous().mT for name, b in blocks.items()}
    lifts = {name: lift_of(b, values[name]) for name, b in blocks.items()}
    index = (rig.frame[view], rig.sensor[view], rig.sensor[view], point)
    by_hand = Term(through.residual, tuple(blocks), index, (x,), linearize=through.linearize)
    automatic = Term(through.residual, tuple(blocks), index, (x,))

    def jacobians(term: Term, wanted: tuple[bool, ...]) -> list[Tensor | None]:
        sizes = (6, 6, 3, 3)
        out = [x.new_empty((2, s, len(x))).permute(2, 0, 1) if w else None for s, w in zip(sizes, wanted, strict=True)]
        linearize(term, values, lifts, out, Workspace(x))
        return out

    every = jacobians(automatic, (True,) * 4)
    for wanted in ((True,) * 4, (True, False, False, True), (False, True, True, False), (False, False, False, True)):
        for a, b, w in zip(every, jacobians(by_hand, wanted), wanted, strict=True):
            if w:
                torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-8)


def test_view_and_frame_poses(generator: torch.Generator) -> None:
    body, rig, *_ = make_scene(generator)
    back = rig.frame_poses(rig.view_poses(body))
    torch.testing.assert_close(back.R, body.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(back.t, body.t, rtol=0, atol=1e-12)


def test_exact_data_are_recovered(generator: torch.Generator) -> None:
    """One sensor and one frame held, everything else found, the size by the distance of two control points."""
    scene = make_scene(generator, noise=0.0)
    body, rig, _, X, *_ = scene
    result = run(scene, generator, fixed_sensors=torch.tensor([True, True, True]), tolerance=1e-14)
    assert result.status == Status.OK
    assert result.cost < 1e-12
    # The rig gives the size; place and orientation are free.
    torch.testing.assert_close(torch.pdist(result.X), torch.pdist(X), rtol=1e-7, atol=1e-7)
    assert result.rig is not None
    assert torch.equal(result.rig.cam_from_rig.R, rig.cam_from_rig.R)
    relative = result.poses[1] @ result.poses[0].inverse()
    true = body[1] @ body[0].inverse()
    assert rotation_angle(relative.R.mT @ true.R) < 1e-7


def test_places_on_the_rig_are_found(generator: torch.Generator) -> None:
    """With the first sensor as the rig's frame the others come out, up to the size of the world."""
    scene = make_scene(generator, noise=0.0)
    result = run(scene, generator, fixed_sensors=torch.tensor([True, False, False]), tolerance=1e-14)
    assert result.cost < 1e-12
    assert result.rig is not None
    true = scene[1].cam_from_rig
    torch.testing.assert_close(result.rig.cam_from_rig.R, true.R, rtol=0, atol=1e-7)
    scale = true.t[1].norm() / result.rig.cam_from_rig.t[1].norm()
    torch.testing.assert_close(scale * result.rig.cam_from_rig.t, true.t, rtol=0, atol=1e-7)


def test_one_sensor_is_no_rig(generator: torch.Generator) -> None:
    """With one sensor at the rig's origin, a rig is an ordinary bundle."""
    body, rig, cameras, X, x, view, point = make_scene(generator)
    first = rig.sensor[view] == 0
    args = x[first], rig.frame[view[first]], point[first]
    start, X0 = disturb(body, generator), X + 0.01
    plain = bundle_adjust(BundleProblem.of(start, cameras[:1], X0, *args), free=("focal", "k1"), tolerance=1e-12)
    one = Rig(Pose.identity(1, dtype=F64), torch.zeros(5, dtype=torch.int64), torch.arange(5))
    through = bundle_adjust(
        BundleProblem.of(start, cameras[:1], X0, *args),
        free=("focal", "k1"),
        tolerance=1e-12,
        rig=one,
        fixed_sensors=torch.tensor([True]),
    )
    assert through.cost == pytest.approx(plain.cost, rel=1e-8)
    torch.testing.assert_close(through.residuals, plain.residuals, rtol=1e-4, atol=1e-4)


def test_statistics_and_gain(generator: torch.Generator) -> None:
    """The residual has the size of its degrees of freedom, and the rig's constraint makes poses more certain."""
    scene = make_scene(generator, points=300)
    body, rig, cameras, X, x, view, point = scene
    result = run(scene, generator, fixed_sensors=torch.tensor([True, False, False]))
    freedom = 2 * len(x) - 6 * 5 - 6 * 2 - 3 * 300 + 7
    assert abs(result.cost / (0.045 * freedom) - 1) < 4 * (2 / freedom) ** 0.5
    options = {"free": (), "sigma": 0.3}
    problem = BundleProblem(rig.view_poses(body), cameras, rig.sensor, X, x, view, point)
    hold = torch.arange(5) == 0
    bound = bundle_covariance(
        problem,
        rig=rig,
        fixed_sensors=torch.tensor([True] * 3),
        fixed_poses=hold,
        **options,
    )
    assert bound.nullity == 0
    assert bound.sensors is not None
    loose = bundle_covariance(problem, fixed_poses=hold[rig.frame], **options)
    first = torch.tensor([int((rig.frame == k).nonzero()[0]) for k in range(5)])
    assert (bound.poses[1:].diagonal(dim1=1, dim2=2) < 1.001 * loose.poses[first][1:].diagonal(dim1=1, dim2=2)).all()


def test_derivatives(generator: torch.Generator) -> None:
    """By observations and by the place of a held sensor, against central differences."""
    body, rig, cameras, X, x, view, point = make_scene(generator, frames=3, points=20)

    def function(x: Tensor, t: Tensor) -> Tensor:
        at = Rig(Pose(rig.cam_from_rig.R, t), rig.sensor, rig.frame)
        hold = torch.tensor([True, True, False])
        problem = BundleProblem(at.view_poses(body), cameras, rig.sensor, X, x, view, point)
        result = bundle_adjust(problem, free=(), rig=at, fixed_sensors=hold, tolerance=1e-15)
        assert result.rig is not None
        return (
            (result.X[0] - result.X[1:5]).norm(dim=1).sum()
            + result.rig.cam_from_rig.t[2].sum()
            + result.residuals[:9].square().sum()
        )

    inputs = x, rig.cam_from_rig.t
    leaves = tuple(v.clone().requires_grad_() for v in inputs)
    gradients = torch.autograd.grad(function(*leaves), leaves)
    for k, gradient in enumerate(gradients):
        step = (1e-4, 1e-5)[k] * torch.randn(inputs[k].shape, generator=generator, dtype=F64)
        if k:
            step[2] = 0
        plus, minus = (function(*(v + s * step if n == k else v for n, v in enumerate(inputs))) for s in (1, -1))
        torch.testing.assert_close((gradient * step).sum(), (plus - minus) / 2, rtol=1e-4, atol=1e-9)


@pytest.mark.usefixtures("unchecked")
def test_wrong_rigs(generator: torch.Generator) -> None:
    body, rig, cameras, X, x, view, point = make_scene(generator)
    problem = BundleProblem(rig.view_poses(body), cameras, rig.sensor, X, x, view, point)
    with pytest.raises(ValueError, match=r"rig\.frame: wanted numbers from 0 to 13"):
        bundle_adjust(problem, rig=Rig(rig.cam_from_rig, rig.sensor, rig.frame + 20))
    with pytest.raises(ValueError, match="sensor: wanted v = 14"):
        bundle_adjust(problem, rig=Rig(rig.cam_from_rig, rig.sensor[:13], rig.frame[:13]))
    with pytest.raises(ValueError, match=r"rig\.sensor: wanted numbers from 0 to 2"):
        bundle_adjust(problem, rig=Rig(rig.cam_from_rig, rig.sensor + 1, rig.frame))
    with pytest.raises(ValueError, match="without a rig"):
        bundle_adjust(BundleProblem.of(body, cameras[:1], X, x, view * 0, point), fixed_sensors=torch.tensor([True]))
    with pytest.raises(ValueError, match="frame: wanted v = 3"):
        Rig(rig.cam_from_rig, rig.sensor[:3], rig.frame)
