"""Simulated observations of lines: exact without errors, with the statistics asked for otherwise."""

import math

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm import Status, triangulate_lines
from torchsfm.geometry import point_line_distance, project_lines, project_points
from torchsfm.geometry.cameras import Camera
from torchsfm.geometry.distortion import SimpleRadial
from torchsfm.geometry.poses import Pose
from torchsfm.simulation import random_intrinsics, random_points, random_poses, simulate_segments

SIZE = (1000, 750)


def problem(*batch: int, views: int = 4, n: int = 60) -> tuple[Tensor, Pose, Camera]:
    g = seeded(1)
    X = random_points(*batch, 2 * n, generator=g).reshape(*batch, n, 2, 3)
    return X, random_poses(*batch, views, generator=g), Camera(random_intrinsics(*batch, views, image_size=SIZE, generator=g))


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_exact_segments_in_any_batch(batch: tuple[int, ...]) -> None:
    X, poses, cameras = problem(*batch)
    seen = simulate_segments(X, poses, cameras, image_size=SIZE, generator=seeded())
    assert seen.l.shape == seen.l_true.shape == (*batch, 4, 60, 2, 2)
    assert seen.visible.shape == seen.outlier.shape == (*batch, 4, 60)
    expected = project_points((cameras.K @ poses.matrix())[..., None, :, :], X[..., None, :, :, :])
    assert torch.allclose(seen.l_true, expected)
    assert torch.allclose(seen.l[seen.visible], expected[seen.visible])
    assert (seen.l[~seen.visible] == 0).all()
    assert not seen.outlier.any()
    assert torch.allclose(seen.ends, X[..., None, :, :, :].expand_as(seen.ends))


def test_one_camera_and_one_set_of_lines_serve_all() -> None:
    X, _, cameras = problem()
    poses = random_poses(3, 4, generator=seeded(2))
    seen = simulate_segments(X, poses, cameras[0], generator=seeded())
    assert seen.l.shape == (3, 4, 60, 2, 2)
    assert seen.L.shape == (3, 60, 6)
    assert torch.equal(seen.l_true[1], simulate_segments(X, poses[1], cameras[0], generator=seeded()).l_true)


def test_parts_lie_on_the_lines_with_ends_of_their_own() -> None:
    X, poses, cameras = problem(n=500)
    seen = simulate_segments(X, poses, cameras, cut=0.6, generator=seeded())
    lines = project_lines(cameras.K @ poses.matrix(), seen.L)
    assert point_line_distance(seen.l, lines[..., None, :]).abs().max() < 1e-8
    length = (seen.ends[..., 1, :] - seen.ends[..., 0, :]).norm(dim=-1) / (X[:, 1] - X[:, 0]).norm(dim=-1)
    assert (length >= 0.4 - 1e-9).all()
    assert (length <= 1 + 1e-9).all()
    # What is lost is drawn evenly: 0.3 in the mean, with a standard deviation of 0.6 / sqrt(12) of each.
    assert abs(float(length.mean()) - 0.7) < 5 * 0.6 / math.sqrt(12 * length.numel())
    assert (seen.ends[0] - seen.ends[1]).norm(dim=-1).amin(-1).median() > 1e-3


def test_triangulated_lines_are_the_true_ones() -> None:
    X, poses, cameras = problem()
    P = cameras.K @ poses.matrix()
    exact = simulate_segments(X, poses, cameras, cut=0.5, generator=seeded())
    assert torch.allclose(triangulate_lines(exact.l, P).model, exact.L, atol=1e-6)
    noisy = simulate_segments(X, poses, cameras, cut=0.5, noise=0.5, dropout=0.1, generator=seeded())
    found = triangulate_lines(noisy.l, P, visible=noisy.visible)
    assert (found.status == Status.OK).float().mean() > 0.9


def test_noise_outliers_and_dropout_have_their_shares() -> None:
    X, poses, cameras = problem(n=2000)
    seen = simulate_segments(X, poses, cameras, noise=0.7, outliers=0.2, dropout=0.3, generator=seeded())
    count = seen.visible.numel()
    assert abs(float(seen.visible.double().mean()) - 0.7) < 5 * math.sqrt(0.21 / count)
    # Of the wrong ones as many are left as show another line: 0.7 of 0.2.
    visible = int(seen.visible.sum())
    share = 0.2 * 0.7
    assert abs(float(seen.outlier.sum()) / visible - share) < 5 * math.sqrt(share * (1 - share) / visible)
    right = seen.visible & ~seen.outlier
    error = (seen.l - seen.l_true)[right]
    assert abs(float(error.square().mean()) / 0.49 - 1) < 5 * math.sqrt(2 / error.numel())


def test_outliers_are_the_segments_of_other_lines_of_the_view() -> None:
    X, poses, cameras = problem(views=2, n=30)
    seen = simulate_segments(X, poses, cameras, outliers=1.0, generator=seeded())
    assert seen.outlier.all()
    away = (seen.l[:, :, None] - seen.l_true[:, None]).flatten(-2).norm(dim=-1)
    assert (away.amin(-1) < 1e-9).all()
    assert (away.diagonal(dim1=1, dim2=2) > 1e-6).all()
    # There is no other line.
    assert not simulate_segments(X[:1], poses, cameras, outliers=1.0, generator=seeded()).outlier.any()


def test_segments_partly_out_of_the_image_or_behind_are_not_seen() -> None:
    X = torch.tensor([[[0.0, 0, 3], [0.1, 0, 3]], [[0, 0, 3], [9, 0, 3]], [[0, 0, 3], [0, 0, -3]]], dtype=torch.float64)
    poses = Pose(torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    K = torch.tensor([[800.0, 0, 500], [0, 800, 375], [0, 0, 1]], dtype=torch.float64)
    seen = simulate_segments(X, poses, Camera(K), image_size=SIZE, generator=seeded())
    assert seen.visible.tolist() == [[True, False, False]]


def test_a_lens_moves_the_ends() -> None:
    X, poses, cameras = problem()
    lens = Camera(cameras.K, SimpleRadial(torch.full((4,), -0.1, dtype=torch.float64)))
    seen = simulate_segments(X, poses, lens, generator=seeded())
    expected = lens[:, None].project(poses[:, None].transform(X))
    assert torch.allclose(seen.l_true, expected)


def test_no_lines() -> None:
    _, poses, cameras = problem()
    seen = simulate_segments(torch.zeros(0, 2, 3, dtype=torch.float64), poses, cameras, outliers=0.5, generator=seeded())
    assert seen.l.shape == (4, 0, 2, 2)


@pytest.mark.parametrize(
    ("given", "name"),
    [({"cut": 1.0}, "cut"), ({"outliers": 1.5}, "outliers"), ({"noise": -1.0}, "noise"), ({"dropout": 2.0}, "dropout")],
)
def test_wrong_options_are_named(given: dict[str, float], name: str) -> None:
    X, poses, cameras = problem()
    with pytest.raises(ValueError, match=name):
        simulate_segments(X, poses, cameras, **given)  # type: ignore[arg-type]
