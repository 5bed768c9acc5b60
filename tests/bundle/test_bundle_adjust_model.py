"""Whole models in one argument: of any kind that has the members; film of few points; real problems."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import BundleTerms, Rig, bundle_adjust, bundle_adjust_model
from torchsfm.bundle.blocks import Bundle, cheapest_elimination
from torchsfm.formats import read_libmv
from torchsfm.geometry import BundleProblem, Camera, Pose, intrinsics, project_points
from torchsfm.optim import Block, RigidMotion, Subset, Term
from torchsfm.reconstruction import Reconstruction
from torchsfm.simulation import orbit_poses, random_bundle_problem, random_points

F64 = torch.float64


@pytest.fixture(scope="module")
def problem() -> BundleProblem:
    return random_bundle_problem(6, 80, 260, layout="path", generator=seeded(3)).problem


def test_what_is_held_is_explained_once() -> None:
    names = set(BundleTerms.__annotations__)
    assert names == {f.name for f in fields(Bundle)} - {"start"}
    for name in names:
        assert f"        {name}: " in (BundleTerms.__doc__ or ""), name


def test_a_problem_is_adjusted_as_its_parts(problem: BundleProblem) -> None:
    options = {"free": ("focal", "k1", "k2"), "tolerance": 1e-9}
    whole = bundle_adjust_model(problem, **options)
    p = problem
    parts = bundle_adjust(BundleProblem.of(p.poses, p.cameras, p.X, p.x, p.view, p.point), **options)
    assert whole.result.cost == parts.cost
    assert isinstance(whole.model, BundleProblem)
    assert torch.equal(whole.model.X, parts.X)
    torch.testing.assert_close(whole.model.residuals(), whole.result.residuals, rtol=1e-9, atol=1e-9)
    assert torch.equal(problem.X, p.X)


def test_a_reconstruction_keeps_the_rest(problem: BundleProblem) -> None:
    """A camera that two images share, an image that was not placed, names and colours."""
    views = 7
    index = torch.tensor([0, 0, 1, 2, 3, 4, 4])
    poses = Pose(
        torch.cat((problem.poses.R, torch.eye(3, dtype=F64)[None])),
        torch.cat((problem.poses.t, torch.zeros(1, 3, dtype=F64))),
    )
    model = Reconstruction(
        names=tuple("abcdefg"), image_size=torch.full((views, 2), 2000), cameras=problem.cameras, camera_index=index,
        poses=poses, registered=torch.arange(views) < 6, X=problem.X, color=torch.rand(80, 3, dtype=F64),
        x=problem.x, view=problem.view, point=problem.point,
    )  # fmt: skip
    adjusted = bundle_adjust_model(model, free=("focal",))
    new = adjusted.model
    assert isinstance(new, Reconstruction)
    assert new.names == model.names
    assert new.color is model.color
    assert torch.equal(new.poses.R[6], model.poses.R[6])
    assert new.residuals().square().mean() < 0.1 * model.residuals().square().mean()
    torch.testing.assert_close(new.residuals(), adjusted.result.residuals, rtol=1e-9, atol=1e-9)


def test_any_dataclass_with_the_members(problem: BundleProblem) -> None:
    @dataclass(frozen=True)
    class Mine:
        poses: Pose
        cameras: Camera
        camera_index: Tensor
        X: Tensor
        x: Tensor
        view: Tensor
        point: Tensor
        note: str

    mine = Mine(*vars(problem).values(), note="here")
    adjusted = bundle_adjust_model(mine, free=("focal", "k1", "k2"))
    assert adjusted.model.note == "here"
    assert adjusted.result.cost < 0.01 * adjusted.result.initial_cost


def test_a_rig_starts_from_the_views(problem: BundleProblem) -> None:
    """Pairs of views as frames of a stereo rig; views come back where the rig has them."""
    pairs = torch.tensor([0, 0, 1, 1, 2, 2])
    sensor = torch.tensor([0, 1] * 3)
    between = problem.poses[1] @ problem.poses[0].inverse()
    places = Pose(torch.stack((torch.eye(3, dtype=F64), between.R)), torch.stack((torch.zeros(3, dtype=F64), between.t)))
    adjusted = bundle_adjust_model(problem, free=(), rig=Rig(places, sensor, pairs), fixed_sensors=sensor[:2] == 0)
    result, poses = adjusted.result, adjusted.model.poses
    assert result.poses.shape == (3,)
    assert result.rig is not None
    relative = [poses[2 * k + 1] @ poses[2 * k].inverse() for k in range(3)]
    for pose in relative:
        torch.testing.assert_close(pose.R, result.rig.cam_from_rig.R[1], rtol=0, atol=1e-9)
        torch.testing.assert_close(pose.t, result.rig.cam_from_rig.t[1], rtol=0, atol=1e-9)
    torch.testing.assert_close(adjusted.model.residuals(), result.residuals, rtol=1e-9, atol=1e-9)


def test_poses_are_eliminated_where_they_are_many() -> None:
    """And the answer is the same, with points held, too."""
    # Views of four points or fewer would leave poses that run away.
    made = random_bundle_problem(30, 40, 600, generator=seeded())
    p = made.problem
    blocks = {
        "pose": Block(torch.zeros(30, 12), RigidMotion()),
        "camera": Block(torch.zeros(30, 7), Subset(7, (0,))),
        "point": Block(torch.zeros(20, 3)),
    }
    assert cheapest_elimination(blocks, []) == ("pose",)
    one = torch.zeros(1, dtype=torch.long)
    bound = Term(lambda a, b: a - b, ("pose", "pose"), (one, one + 1))
    assert cheapest_elimination(blocks, [bound]) == ("point",)
    blocks["point"] = Block(torch.zeros(60, 3))
    assert cheapest_elimination(blocks, []) == ("point",)
    few = p.point < 20
    fixed = torch.arange(40) < 3
    args = (p.poses, p.cameras, p.X, p.x[few], p.view[few], p.point[few])
    one = bundle_adjust(BundleProblem.of(*args), fixed_points=fixed, tolerance=1e-10, max_iterations=200)
    # Points that nobody sees change what is eliminated, and nothing else.
    more = torch.cat((p.X, torch.zeros(60, 3, dtype=F64)))
    two = bundle_adjust(
        BundleProblem.of(*args[:2], more, *args[3:]), fixed_points=torch.arange(100) < 3, tolerance=1e-10, max_iterations=200
    )
    assert one.status == two.status == Status.OK
    np.testing.assert_allclose(one.cost, two.cost, rtol=1e-8)
    torch.testing.assert_close(one.residuals, two.residuals, rtol=1e-3, atol=1e-3)


def test_derivatives_where_poses_are_eliminated(generator: torch.Generator) -> None:
    """Twelve views of eight points: how the shape moves with observations, against central differences."""
    poses = orbit_poses(12, radius=5.0)
    X = random_points(8, kind="cube", generator=generator)
    view, point = torch.cartesian_prod(torch.arange(12), torch.arange(8)).unbind(1)
    K = intrinsics(torch.tensor([800.0], dtype=F64), torch.zeros(1, 2, dtype=F64))
    x = project_points((K @ poses.matrix())[view], X[point, None])[:, 0]
    x = x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64)

    def function(x: Tensor, X: Tensor) -> Tensor:
        result = bundle_adjust(
            BundleProblem.of(poses, Camera(K), X, x, view, point),
            free=(),
            fixed_points=torch.arange(8) < 3,
            tolerance=1e-15,
            max_iterations=200,
        )
        return result.X[3:].sum() + result.poses.t.square().sum() + result.residuals[:9].square().sum()

    inputs = x, X
    leaves = tuple(v.clone().requires_grad_() for v in inputs)
    gradients = torch.autograd.grad(function(*leaves), leaves)
    for k, gradient in enumerate(gradients):
        step = (1e-3, 1e-5)[k] * torch.randn(inputs[k].shape, generator=generator, dtype=F64)
        if k:
            step[3:] = 0
        plus, minus = (function(*(v + s * step if n == k else v for n, v in enumerate(inputs))) for s in (1, -1))
        torch.testing.assert_close((gradient * step).sum(), (plus - minus) / 2, rtol=1e-4, atol=1e-9)


def test_film_with_shared_intrinsics(data: Path) -> None:
    """333 frames of one camera, 26 points in long tracks."""
    problem = read_libmv(data / "bal/libmv_problem_01.bin")
    adjusted = bundle_adjust_model(problem, free=("focal", "k1", "k2"), max_iterations=100)
    result = adjusted.result
    assert result.status == Status.OK
    assert float((2 * result.initial_cost / 5421) ** 0.5) == pytest.approx(1.304, abs=5e-4)
    assert result.cost < 4531
    everything = bundle_adjust_model(
        problem, free=("focal", "principal_point", "k1", "k2", "p1", "p2", "k3"), max_iterations=30
    )
    assert everything.result.cost < result.cost
    assert adjusted.model.cameras.K.shape == (1, 3, 3)
