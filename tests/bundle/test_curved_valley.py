"""Forward motion with hardly a turn: focal length against depth is a long curved valley of the cost."""

from dataclasses import replace

import pytest
import torch

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust
from torchsfm.geometry import BundleProblem, Camera, Pose, Radial, intrinsics, rotation_from_rotvec
from torchsfm.simulation import simulate_images

FOCAL = 700.0
VIEWS, POINTS = 24, 300


def corridor(generator: torch.Generator) -> BundleProblem:
    """Frames straight ahead through a cloud of points, each turned by a third of a degree: the truth, noise in x alone."""
    options = {"generator": generator, "dtype": torch.float64}
    draw = torch.rand(POINTS, 3, **options)
    X = (draw - torch.tensor([0.5, 0.5, 0.0])) * torch.tensor([16.0, 8.0, VIEWS + 10.0])
    centre = 0.02 * torch.randn(VIEWS, 3, **options)
    centre[:, 2] += torch.arange(VIEWS)
    R = rotation_from_rotvec(0.006 * torch.randn(VIEWS, 3, **options))
    poses = Pose(R, -(R @ centre[..., None])[..., 0])
    zero = torch.zeros(1, dtype=torch.float64)
    K = intrinsics(torch.tensor([FOCAL], dtype=torch.float64), torch.tensor([[599.5, 299.5]], dtype=torch.float64))
    camera = Camera(K, Radial(zero, zero))
    seen = simulate_images(X, poses, camera, image_size=(1200, 600), noise=0.5, depth_range=(3.0, 25.0), generator=generator)
    visible = seen.visible & (seen.visible.sum(0) >= 2)
    view, point = visible.nonzero(as_tuple=True)
    return BundleProblem(poses, camera, torch.zeros(VIEWS, dtype=torch.long), X, seen.x[view, point], view, point)


def zoomed(problem: BundleProblem, factor: float) -> BundleProblem:
    """The world stretched along the road, and the focal length with it: frames that do not turn show the same."""
    stretch = torch.tensor([1.0, 1.0, factor], dtype=torch.float64)
    centre = problem.poses.centre * stretch
    K = problem.cameras.K.clone()
    K[:, 0, 0], K[:, 1, 1] = factor * FOCAL, factor * FOCAL
    poses = Pose(problem.poses.R, -(problem.poses.R @ centre[..., None])[..., 0])
    return replace(problem, poses=poses, cameras=replace(problem.cameras, K=K), X=problem.X * stretch)


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_the_bottom_of_the_valley_is_reached(generator: torch.Generator, factor: float) -> None:
    for _ in range(4):
        truth = corridor(generator)
        start = zoomed(truth, factor)
        data = (truth.x, truth.view, truth.point)
        options = {"free": ("focal", "k1", "k2", "principal_point"), "tolerance": 1e-9}
        best = bundle_adjust(BundleProblem.of(truth.poses, truth.cameras, truth.X, *data), **options, max_iterations=200)
        found = bundle_adjust(BundleProblem.of(start.poses, start.cameras, start.X, *data), **options, max_iterations=25)
        assert found.status == best.status == Status.OK
        assert found.cost < best.cost * (1 + 1e-6)
        assert abs(float(found.cameras.K[0, 0, 0] / best.cameras.K[0, 0, 0]) - 1) < 1e-3
