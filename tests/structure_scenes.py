"""What bundles with lines, ellipses or curves have in common, whatever their structure is."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import pytest
import torch
from torch import Tensor

from torchsfm.bundle import BundleResult, Rig, bundle_adjust
from torchsfm.bundle.blocks import Bundle
from torchsfm.bundle.structure import Structure
from torchsfm.geometry import (
    BrownConrady,
    BundleProblem,
    Camera,
    Distortion,
    KannalaBrandt,
    NoDistortion,
    Pose,
    Radial,
    intrinsics,
    rotation_from_rotvec,
)
from torchsfm.optim import Block, Term
from torchsfm.optim.terms import Workspace, lift_of, linearize

F64 = torch.float64
LENSES: dict[str, Callable[[], Distortion]] = {
    "none": NoDistortion,
    "radial": lambda: Radial(*torch.tensor([-0.25, 0.08], dtype=F64)),
    "brown": lambda: BrownConrady(*torch.tensor([-0.2, 0.05, 0.01, 0.004, -0.003], dtype=F64)),
    "fisheye": lambda: KannalaBrandt(*torch.tensor([-0.05, 0.01, 0.0, 0.0], dtype=F64)),
}
S = TypeVar("S", bound=Structure)


def views_on_an_arc(generator: torch.Generator, lens: str, views: int, size: float = 0.1) -> tuple[Pose, Camera]:
    """Poses that look at the origin from about 4 away, each turned and displaced a little, and the one camera of all."""
    angle = torch.linspace(-0.5, 0.5, views, dtype=F64)
    turn = torch.stack((0.15 * torch.cos(4 * angle), angle, 0.1 * torch.sin(5 * angle)), -1)
    poses = Pose(rotation_from_rotvec(turn), torch.tensor([[0.1, -0.1, 4.0]], dtype=F64).repeat(views, 1))
    K = intrinsics(torch.tensor(700.0, dtype=F64), torch.tensor([320.0, 240.0], dtype=F64), 1.02)
    return poses.retract(size * torch.randn(views, 6, generator=generator, dtype=F64)), Camera(K, LENSES[lens]())


def with_points(poses: Pose, camera: Camera, X: Tensor) -> BundleProblem:
    """Points that every view sees."""
    views, kind = len(poses.t), type(camera.distortion)
    view, point = torch.cartesian_prod(torch.arange(views), torch.arange(len(X))).unbind(1)
    x = camera.project(poses[view].transform(X[point, None]))[:, 0]
    cameras = Camera(camera.K[None], kind.from_parameters(camera.distortion.parameters()[None]))
    return BundleProblem(poses, cameras, torch.zeros(views, dtype=torch.long), X, x, view, point)


def without_points(problem: BundleProblem) -> BundleProblem:
    return dataclasses.replace(problem, X=problem.X[:0], x=problem.x[:0], view=problem.view[:0], point=problem.point[:0])


def moved(problem: BundleProblem, generator: torch.Generator, size: float) -> BundleProblem:
    """All but the first two poses, and the points, by so much."""
    step = size * torch.randn(len(problem.poses.t), 6, generator=generator, dtype=F64)
    step[:2] = 0
    X = problem.X + size * torch.randn(problem.X.shape, generator=generator, dtype=F64)
    return dataclasses.replace(problem, poses=problem.poses.retract(step), X=X)


def first_two(problem: BundleProblem) -> Tensor:
    return torch.arange(len(problem.poses.t)) < 2


def adjusted(result: BundleResult, kind: type[S]) -> S:
    """The only structure of a result."""
    (structure,) = result.structure
    assert isinstance(structure, kind)
    return structure


def whitened(step: Tensor, C: Tensor) -> Tensor:
    """Errors in units of their covariance."""
    return torch.linalg.solve_triangular(torch.linalg.cholesky(C), step[..., None], upper=False)[..., 0]


def with_a_rig_of_one(problem: BundleProblem, structure: Structure) -> tuple[BundleResult, BundleResult]:
    """Adjusted plainly, and with a rig whose one sensor is held; to the same cost."""
    views = len(problem.poses.t)
    rig = Rig(Pose.identity(1, dtype=F64), torch.zeros(views, dtype=torch.long), torch.arange(views))
    options = {"fixed_poses": first_two(problem), "structure": [structure], "tolerance": 1e-13}
    plain = bundle_adjust(problem, **options)
    rigged = bundle_adjust(problem, rig=rig, fixed_sensors=torch.tensor([True]), **options)
    assert rigged.cost == pytest.approx(plain.cost, rel=1e-9)
    return plain, rigged


def with_the_first_camera_where_it_was(problem: BundleProblem, structure: Structure) -> tuple[BundleResult, BundleResult]:
    """Adjusted freely, and in the frame of the first camera; the same model in another world."""
    free = bundle_adjust(problem, structure=[structure], tolerance=1e-12)
    first = bundle_adjust(problem, structure=[structure], tolerance=1e-12, gauge="first")
    assert torch.equal(first.poses.R[0], problem.poses.R[0])
    assert not torch.allclose(first.poses.t[1:], free.poses.t[1:], rtol=0, atol=1e-6)
    there = dataclasses.replace(problem, poses=first.poses, cameras=first.cameras, X=first.X)
    held = {"free": (), "fixed_poses": torch.ones(len(problem.poses.t), dtype=torch.bool)}
    again = bundle_adjust(there, structure=first.structure, max_iterations=0, **held)
    assert again.initial_cost == pytest.approx(free.cost, rel=1e-9)
    return free, first


def with_all_free(
    problem: BundleProblem, structure: Structure, rigged: bool, generator: torch.Generator
) -> tuple[dict[str, Block], list[Term]]:
    """The blocks and terms where every variable is free, with skew and numbers held in some cameras."""
    names = ("focal", "aspect", "skew", "principal_point", *problem.cameras.distortion.parameter_names)
    views = len(problem.poses.t)
    sensors = Pose.identity(2, dtype=F64).retract(0.1 * torch.randn(2, 6, generator=generator, dtype=F64))
    rig = Rig(sensors, torch.arange(views) % 2, torch.arange(views)) if rigged else None
    held = {"skew": torch.tensor([not rigged])}
    blocks, terms = Bundle(problem, free=names, fixed_intrinsics=held, rig=rig, structure=(structure,)).problem()
    return blocks, list(terms)


def assert_written_derivatives(blocks: dict[str, Block], term: Term, rows: int, like: Tensor) -> list[Tensor]:
    """What a term writes down is what automatic derivatives give, by every variable."""
    x = {name: block.x for name, block in blocks.items()}
    lifts = {name: lift_of(block, x[name]) for name, block in blocks.items()}
    found: list[Tensor] = []
    wanted: list[Tensor] = []
    for one, slopes in ((term, found), (dataclasses.replace(term, linearize=None), wanted)):
        sizes = [blocks[name].tangent for name in one.blocks]
        slopes += [like.new_empty(rows, size, len(one.index[0])).permute(2, 0, 1) for size in sizes]
        slopes.append(linearize(one, x, lifts, slopes[:], Workspace(like))[0])
    for mine, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9 * float(other.abs().max()))
    return found
