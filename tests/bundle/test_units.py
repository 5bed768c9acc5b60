"""The unit of the world is free: in any, steps lead to the same minimum, with the same error."""

import dataclasses

import pytest
import torch
from structure_scenes import first_two, moved, views_on_an_arc, with_points

from torchsfm._types import Status
from torchsfm.bundle import BundleConics, BundleLines, bundle_adjust, bundle_covariance
from torchsfm.bundle.structure import Structure
from torchsfm.geometry import BundleProblem, Ellipse, Ellipsoid, Pose, pluecker_from_points, rotation_from_rotvec
from torchsfm.images import fit_ellipse
from torchsfm.optim import Cauchy, Loss

F64 = torch.float64
UNITS = (1e-12, 1e-6, 1e8, 1e12)


def in_unit(problem: BundleProblem, unit: float) -> BundleProblem:
    return dataclasses.replace(problem, poses=Pose(problem.poses.R, problem.poses.t * unit), X=problem.X * unit)


@pytest.fixture
def problem(generator: torch.Generator) -> BundleProblem:
    """Image points half a pixel off, and a start near the minimum."""
    poses, camera = views_on_an_arc(generator, "none", 6)
    exact = with_points(poses, camera, 2 * torch.rand(80, 3, generator=generator, dtype=F64) - 1)
    noise = 0.5 * torch.randn(exact.x.shape, generator=generator, dtype=F64)
    return moved(dataclasses.replace(exact, x=exact.x + noise), generator, 0.02)


@pytest.mark.parametrize("loss", [None, Cauchy(1.0)])
@pytest.mark.parametrize("unit", UNITS)
def test_points_and_cameras(unit: float, loss: Loss | None, problem: BundleProblem) -> None:
    found = bundle_adjust(problem, free=("focal",), loss=loss, tolerance=1e-12)
    again = bundle_adjust(in_unit(problem, unit), free=("focal",), loss=loss, tolerance=1e-12)
    assert found.status == again.status == Status.OK
    assert again.cost == pytest.approx(found.cost, rel=1e-9)
    torch.testing.assert_close(again.cameras.K, found.cameras.K, rtol=1e-4, atol=0)


@pytest.mark.parametrize("unit", [*UNITS, 1e14])
def test_points_alone(unit: float, problem: BundleProblem) -> None:
    held = {"fixed_poses": torch.ones(6, dtype=torch.bool), "free": ()}
    found, again = (bundle_adjust(p, tolerance=1e-12, **held) for p in (problem, in_unit(problem, unit)))
    assert found.status == again.status == Status.OK
    assert again.cost == pytest.approx(found.cost, rel=1e-9)
    torch.testing.assert_close(again.X / unit, found.X, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("unit", UNITS)
def test_covariances(unit: float, problem: BundleProblem) -> None:
    held = {"fixed_poses": first_two(problem), "free": ("focal",), "sigma": 1.0}
    here, there = bundle_covariance(problem, **held), bundle_covariance(in_unit(problem, unit), **held)
    steps = torch.tensor([1.0, 1.0, 1.0, unit, unit, unit], dtype=F64)
    deviation = here.poses.diagonal(dim1=1, dim2=2).sqrt() * steps
    torch.testing.assert_close(there.poses.diagonal(dim1=1, dim2=2).sqrt(), deviation, rtol=1e-6, atol=0)
    torch.testing.assert_close(there.cameras, here.cameras, rtol=1e-6, atol=0)
    torch.testing.assert_close(there.X / unit**2, here.X, rtol=1e-6, atol=0)


def lines(generator: torch.Generator) -> tuple[BundleProblem, list[Structure]]:
    """Views, and segments in them half a pixel off, at the start and in another unit."""
    poses, camera = views_on_an_arc(generator, "none", 5)
    ends = 2 * torch.rand(12, 2, 3, generator=generator, dtype=F64) - 1
    seen, line = torch.cartesian_prod(torch.arange(5), torch.arange(12)).unbind(1)
    image = camera.project(poses[seen].transform(ends[line]))
    image = image + 0.5 * torch.randn(image.shape, generator=generator, dtype=F64)
    ends = ends + 0.02 * torch.randn(ends.shape, generator=generator, dtype=F64)
    problem = moved(with_points(poses, camera, ends.flatten(0, 1)), generator, 0.02)
    return problem, [BundleLines(pluecker_from_points(*(unit * ends).unbind(1)), image, seen, line) for unit in (1.0, *UNITS)]


def conics(generator: torch.Generator) -> tuple[BundleProblem, list[Structure]]:
    """Views, and ellipses fitted to edges half a pixel off, at the start and in another unit."""

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    poses, camera = views_on_an_arc(generator, "none", 4, 0.05)
    tilt = torch.cat((rand(6, 2) - 0.5, 6 * rand(6, 1)), -1)
    axes = torch.nn.functional.pad((0.2 + 0.3 * rand(6, 2, 1)) * rotation_from_rotvec(tilt).mT[:, :2], (0, 0, 0, 1))
    model = Ellipsoid(1.6 * rand(6, 3) - 0.8, axes)
    seen, conic = torch.cartesian_prod(torch.arange(4), torch.arange(6)).unbind(1)
    t = torch.arange(40, dtype=F64) * (torch.pi / 20)
    edges = model.centre[:, None] + torch.stack((t.cos(), t.sin(), 0 * t), -1) @ axes
    edges = camera.project(poses[seen].transform(edges[conic]))
    fit = fit_ellipse(edges + 0.5 * torch.randn(edges.shape, generator=generator, dtype=F64))
    problem = moved(with_points(poses, camera, 2 * rand(20, 3) - 1), generator, 0.01)
    ellipse: Ellipse = fit.model
    start = model.centre + 0.01 * torch.randn(6, 3, generator=generator, dtype=F64)
    shapes = [Ellipsoid(unit * start, 1.05 * unit * axes) for unit in (1.0, *UNITS)]
    return problem, [BundleConics(shape, ellipse, seen, conic, fit.covariance) for shape in shapes]


@pytest.mark.parametrize("make", [lines, conics])
def test_lines_and_conics(make, generator: torch.Generator) -> None:
    problem, structures = make(generator)
    held = {"free": (), "fixed_poses": first_two(problem), "tolerance": 1e-12}
    found = bundle_adjust(problem, structure=structures[:1], **held)
    assert found.status == Status.OK
    covariance = bundle_covariance(problem, structure=structures[:1], free=(), fixed_poses=first_two(problem), sigma=1.0)
    for unit, structure in zip(UNITS, structures[1:], strict=True):
        there = in_unit(problem, unit)
        again = bundle_adjust(there, structure=[structure], **held)
        assert again.status == Status.OK
        assert again.cost == pytest.approx(found.cost, rel=1e-9)
        other = bundle_covariance(there, structure=[structure], free=(), fixed_poses=first_two(problem), sigma=1.0)
        deviation = covariance.poses[2:, 3:, 3:].diagonal(dim1=1, dim2=2).sqrt() * unit
        torch.testing.assert_close(other.poses[2:, 3:, 3:].diagonal(dim1=1, dim2=2).sqrt(), deviation, rtol=1e-6, atol=0)
        if make is conics:
            steps = torch.tensor([unit, unit, unit, 1.0, 1.0, unit, unit, unit], dtype=F64)
            deviation = covariance.structure[0].diagonal(dim1=1, dim2=2).sqrt() * steps
            torch.testing.assert_close(other.structure[0].diagonal(dim1=1, dim2=2).sqrt(), deviation, rtol=1e-6, atol=0)
