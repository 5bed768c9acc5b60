"""The door for calibrated cameras: accuracy, units, worlds of any size, real data, PoseLib."""

from pathlib import Path

import numpy as np
import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import random_rotation, rotation_angle
from torchsfm.resection import CameraEstimator, estimate_camera
from torchsfm.robust import constant_weights

K = torch.tensor([[800.0, 0, 500], [0, 820, 400], [0, 0, 1]], dtype=torch.float64)


def project(X: Tensor, R: Tensor, t: Tensor) -> Tensor:
    Y = (X @ R.mT + t[..., None, :]) @ K.mT
    return Y[..., :2] / Y[..., 2:]


def images(p: int, n: int, inliers: float, generator: torch.Generator, noise: float = 1.0) -> tuple[Tensor, ...]:
    kind = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(p, n, 3, **kind) * 4 - 2
    R = random_rotation(p, **kind)
    t = torch.randn(p, 3, **kind) * 0.3 + torch.tensor([0.0, 0, 6])
    x = project(X, R, t) + noise * torch.randn(p, n, 2, **kind)
    wrong = torch.rand(p, n, generator=generator) > inliers
    return torch.where(wrong[..., None], torch.rand(p, n, 2, **kind) * 1000, x), X, wrong, R, t


def turn(model: Tensor, R: Tensor) -> Tensor:
    return torch.rad2deg(rotation_angle(model[..., :3] @ R.mT))


@pytest.mark.parametrize(("inliers", "n"), [(0.9, 100), (0.5, 300), (0.2, 1000)])
def test_poses_are_right(inliers: float, n: int, generator: torch.Generator) -> None:
    x, X, wrong, R, t = images(24, n, inliers, generator)
    result = estimate_camera(x, X, K, threshold=3.0, generator=seeded())
    assert (result.status == Status.OK).all()
    assert (turn(result.model, R) < 0.5).all()
    assert ((result.model[..., 3] - t).norm(dim=-1) < 0.1).all()
    torch.testing.assert_close(result.model[..., :3] @ result.model[..., :3].mT, torch.eye(3).double().expand(24, 3, 3))
    error = (project(X, result.model[..., :3], result.model[..., 3]) - x).norm(dim=-1)
    assert torch.equal(result.inliers, error < 3.0)
    assert (result.inliers & ~wrong).sum() > 0.95 * (~wrong).sum()


def test_refinement_reaches_the_bound(generator: torch.Generator) -> None:
    x, X, wrong, R, t = images(100, 150, 0.6, generator)
    model = torch.cat((R, t[..., None]), -1)
    estimator = CameraEstimator(K.expand(100, 3, 3))
    for _ in range(4):
        model = estimator.step(model, x, X, weigh=constant_weights((~wrong).double()))
    for threshold in (2.0, 5.0):
        found = estimate_camera(x, X, K, threshold=threshold, generator=seeded()).model
        ratio = turn(found, R) / turn(model, R)
        assert ratio.log().mean().exp() < 1.1


def test_the_world_may_be_anywhere_and_of_any_size(generator: torch.Generator) -> None:
    x, X, _, R, _ = images(8, 300, 0.6, generator)
    plain = estimate_camera(x, X, K, threshold=3.0, generator=seeded())
    for size, shift in ((1e4, 3e6), (1e-3, 2.0)):
        moved = estimate_camera(x, X * size + shift, K, threshold=3.0, generator=seeded())
        assert torch.equal(moved.inliers, plain.inliers)
        assert (turn(moved.model, R) < 0.5).all()


def test_far_points_do_not_spoil_the_others(generator: torch.Generator) -> None:
    x, X, wrong, R, _ = images(8, 300, 0.6, generator)
    X = torch.where(wrong[..., None] & (torch.arange(300) % 3 == 0)[:, None], X * 1e7, X)
    result = estimate_camera(x, X, K, threshold=3.0, generator=seeded())
    assert (turn(result.model, R) < 0.5).all()


def test_units_of_the_image_do_not_matter(generator: torch.Generator) -> None:
    x, X, *_ = images(8, 200, 0.6, generator)
    plain = estimate_camera(x, X, K, threshold=3.0, generator=seeded())
    S = torch.diag(torch.tensor([1000.0, 1000, 1], dtype=torch.float64))
    scaled = estimate_camera(x * 1000, X, S @ K, threshold=3000.0, generator=seeded())
    assert torch.equal(plain.inliers, scaled.inliers)
    torch.testing.assert_close(plain.model, scaled.model, rtol=1e-6, atol=1e-6)


def test_focal_lengths_as_a_batch(generator: torch.Generator) -> None:
    """The intrinsics broadcast against the images: the right focal length has the most inliers."""
    x, X, _, R, _ = images(3, 200, 0.7, generator)
    scale = torch.tensor([0.5, 0.7, 1.0, 1.4, 2.0], dtype=torch.float64)
    many = K.repeat(5, 1, 1)
    many[:, :2, :2] *= scale[:, None, None]
    result = estimate_camera(x[:, None], X[:, None], many, threshold=3.0, generator=seeded(), max_iterations=200)
    assert result.model.shape == (3, 5, 3, 4)
    assert (result.inliers.sum(-1).argmax(-1) == 2).all()
    assert (turn(result.model[:, 2], R) < 0.5).all()


def test_ragged_extremes_in_one_batch(generator: torch.Generator) -> None:
    x, X, *_ = images(9, 2000, 0.6, generator)
    count = torch.tensor([0, 1, 3, 4, 50, 2000, 500, 500, 500])
    mask = torch.arange(2000) < count[:, None]
    x[6] = torch.rand(2000, 2, generator=generator, dtype=torch.float64) * 1000
    x[7], X[7] = x[7, :1], X[7, :1]
    X[8, ::2] = torch.nan
    result = estimate_camera(x, X, K, threshold=3.0, mask=mask, generator=seeded(), max_iterations=2000)
    status = result.status.tolist()
    assert status[:2] == [Status.TOO_FEW] * 2
    assert status[4:6] == [Status.OK] * 2
    assert status[6:8] == [Status.NO_CONSENSUS, Status.DEGENERATE]
    assert status[8] == Status.OK
    assert torch.isfinite(result.model).all()
    for i in range(9):
        n = int(count[i])
        alone = estimate_camera(x[i, :n], X[i, :n], K, threshold=3.0, generator=seeded(), max_iterations=2000)
        assert alone.status == result.status[i]
        assert torch.equal(alone.inliers, result.inliers[i, :n])
        torch.testing.assert_close(alone.model, result.model[i], rtol=1e-9, atol=1e-9)


def test_points_of_a_plane(generator: torch.Generator) -> None:
    x, X, _, R, t = images(8, 200, 0.6, generator)
    X[..., 2] = 0.3 * X[..., 0]
    good = project(X, R, t) + torch.randn(8, 200, 2, generator=generator, dtype=torch.float64)
    right = torch.rand(8, 200, generator=generator) < 0.6
    result = estimate_camera(torch.where(right[..., None], good, x), X, K, threshold=3.0, generator=seeded())
    assert (turn(result.model, R) < 1).all()


def test_real_scene(data: Path) -> None:
    folder = data / "absolute_pose" / "pose6dscene"
    camera = torch.from_numpy(np.loadtxt(folder / "pose6dscene.K"))
    truth = torch.from_numpy(np.loadtxt(folder / "pose6dscene_gt.txt"))
    rows = torch.from_numpy(np.loadtxt(folder / "pose6dscene_points.txt", skiprows=1))
    x, X = rows[:, :2], rows[:, 2:]
    result = estimate_camera(x, X, camera, threshold=4.0, generator=seeded())
    assert result.status == Status.OK
    assert turn(result.model, truth[:, :3]) < 3
    assert (result.model[:, 3] - truth[:, 3]).norm() < 0.03 * truth[:, 3].norm()
    wrong = torch.rand(len(x), generator=seeded()) < 0.5
    spoiled = torch.where(wrong[:, None], torch.rand(len(x), 2, generator=seeded(1), dtype=torch.float64) * 480, x)
    again = estimate_camera(spoiled, X, camera, threshold=4.0, generator=seeded())
    assert turn(again.model, truth[:, :3]) < 5


@pytest.mark.reference
def test_no_worse_than_poselib(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    x, X, _, R, _ = images(64, 300, 0.5, generator)
    camera = {"model": "PINHOLE", "width": 1000, "height": 1000, "params": [800, 820, 500, 400]}
    options = {"max_reproj_error": 2.5, "success_prob": 0.9999, "min_iterations": 100, "dyn_num_trials_mult": 1.0}
    theirs = torch.stack(
        [
            torch.from_numpy(poselib.estimate_absolute_pose(a, b, camera, options, {})[0].R)
            for a, b in zip(x.numpy(), X.numpy(), strict=True)
        ]
    )
    ours, peers = turn(estimate_camera(x, X, K, threshold=2.5, generator=seeded()).model, R), turn(theirs, R)
    assert ours.median() < 1.05 * peers.median()
    assert ours.quantile(0.95) < 1.05 * peers.quantile(0.95)
