"""Three and four views with outliers, missing data and real images."""

from pathlib import Path

import pytest
import torch
from chance import assert_share, seeded
from multiview_scenes import F64, cameras, images, points
from oxford import lines_of, read
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Pose, project_points
from torchsfm.motion import TrifocalEstimator, estimate_trifocal, quadrifocal_6pt, trifocal_7pt
from torchsfm.robust import Degeneracy
from torchsfm.simulation import random_poses
from torchsfm.tensors import (
    quadrifocal_from_cameras,
    transfer_points_quadrifocal,
    transfer_points_trifocal,
    trifocal_from_cameras,
)
from torchsfm.triangulation import triangulate_points


def scene(batch: int, n: int, wrong: float, generator: torch.Generator, noise: float = 0.7) -> tuple[Tensor, Tensor, Tensor]:
    """Images with noise and outliers, which are outliers, cameras."""
    P = cameras(batch, v=3, generator=generator)
    x = images(P, points(batch, n=n, generator=generator))
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=F64)
    bad = torch.rand(batch, n, generator=generator) < wrong
    anywhere = x + 100 * torch.randn(x.shape, generator=generator, dtype=F64)
    view = torch.randint(3, (batch, n), generator=generator)
    hit = bad[:, None] & (view[:, None] == torch.arange(3)[:, None])
    return torch.where(hit[..., None], anywhere, x), bad, P


def transfer_error(P: Tensor, x: Tensor) -> Tensor:
    T = trifocal_from_cameras(*P.unbind(-3))
    return (transfer_points_trifocal(T, x[..., 0, :, :], x[..., 1, :, :]) - x[..., 2, :, :]).norm(dim=-1)


def test_distance_is_the_reprojection_error(generator: torch.Generator) -> None:
    P = cameras(5, v=3, generator=generator, calibration=torch.eye(3, dtype=F64))
    x = images(P, points(5, n=50, generator=generator))
    x = x + 1e-3 * torch.randn(x.shape, generator=generator, dtype=F64)
    best = triangulate_points(x, P)
    optimum = (images(P, best.model) - x).square().sum((-1, -3)).sqrt()
    # The same cameras in the frame of the first.
    H = torch.linalg.inv(torch.cat((P[:, 0], torch.tensor([[[0.0, 0, 0, 1]]], dtype=F64).expand(5, 1, 4)), 1))
    model = P[:, 1:] @ H[:, None]
    found = TrifocalEstimator().squared_residual(model, *x.unbind(1)).sqrt()
    assert (found >= optimum * (1 - 1e-6)).all()
    torch.testing.assert_close(found, optimum, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("wrong", [0.2, 0.5])
def test_outliers(wrong: float, generator: torch.Generator) -> None:
    x, bad, P = scene(6, 150, wrong, generator)
    mask = torch.rand(6, 150, generator=generator) < 0.9
    copy = x.clone()
    found = estimate_trifocal(x, threshold=3.0, mask=mask, generator=generator)
    assert torch.equal(x, copy)
    assert (found.status == Status.OK).all()
    assert found.model.shape == (6, 3, 3, 4)
    held = images(P, points(6, n=50, generator=generator))
    assert transfer_error(found.model, held).median() < 0.7
    good = ~bad & mask
    assert (found.inliers & good).sum() > 0.93 * good.sum()
    assert (found.inliers & bad).sum() < 0.03 * bad.sum() + 2
    assert not (found.inliers & ~mask).any()


def test_refined_estimate_is_better_than_the_algebraic_one(generator: torch.Generator) -> None:
    x, _, P = scene(20, 40, 0.0, generator, noise=1.0)
    held = images(P, points(20, n=50, generator=generator))
    robust = transfer_error(estimate_trifocal(x, threshold=4.0, generator=generator).model, held).median(-1).values
    algebraic = transfer_error(trifocal_7pt(x).P, held).median(-1).values
    assert robust.mean() < 1.05 * algebraic.mean()


def test_derivatives_covariance_and_degeneracy(generator: torch.Generator) -> None:
    x, _, _ = scene(1, 40, 0.1, generator, noise=0.3)
    found = estimate_trifocal(x.requires_grad_(), threshold=2.0, generator=seeded(1), covariance=True)
    assert found.degeneracy == Degeneracy.NONE
    assert found.covariance is not None
    assert found.covariance.shape == (1, 36, 36)
    # The gradient against the estimate from moved points.
    weight = torch.randn(1, 3, 3, 4, generator=generator, dtype=F64) / found.model.detach().abs().clamp(min=1e-3)
    (grad,) = torch.autograd.grad((found.model * weight).sum(), x)
    d = torch.randn(x.shape, generator=generator, dtype=F64) * found.inliers[:, None, :, None]
    h = 1e-3
    models = [estimate_trifocal(x.detach() + s * h * d, threshold=2.0, generator=seeded(1)).model for s in (1, -1)]
    slope = ((models[0] - models[1]) * weight).sum() / (2 * h)
    torch.testing.assert_close((grad * d).sum(), slope, rtol=0.02, atol=1e-6)
    P = cameras(4, v=3, generator=generator)
    X = points(4, n=60, generator=generator)
    X[..., 2] = 0.4 * X[..., 0]
    flat = images(P, X) + 0.3 * torch.randn(4, 3, 60, 2, generator=generator, dtype=F64)
    planar = estimate_trifocal(flat, threshold=2.0, generator=seeded(1), max_iterations=200)
    assert (planar.degeneracy[planar.status == Status.OK] == Degeneracy.PLANAR).all()
    assert (planar.status == Status.OK).any()


def test_a_plane_does_not_win_over_points_off_it(generator: torch.Generator) -> None:
    P = cameras(30, v=3, generator=generator)
    X = points(30, n=80, generator=generator)
    X[:, 16:, 2] = 0.4 * X[:, 16:, 0]
    x = images(P, X) + 0.3 * torch.randn(30, 3, 80, 2, generator=generator, dtype=F64)
    wrong = torch.rand(30, 80, generator=generator) < 0.2
    x[:, 2] = torch.where(wrong[..., None], 600 * torch.rand(30, 80, 2, generator=generator, dtype=F64), x[:, 2])
    found = estimate_trifocal(x, threshold=2.0, generator=generator)
    off = ~wrong[:, :16]
    assert (found.inliers[:, :16] & off).sum() > 0.9 * off.sum()
    assert_share(found.degeneracy == Degeneracy.NONE, 0.9)
    held = images(P, points(30, n=40, generator=generator))
    assert_share(transfer_error(found.model, held).median(-1).values < 3, 0.85)


@pytest.mark.parametrize("kind", ["general", "two lines", "centres"])
def test_points_that_leave_a_change_unseen_say_so(kind: str, generator: torch.Generator) -> None:
    draw = {"generator": generator, "dtype": torch.float64}
    X = 2 * torch.rand(10, 60, 3, **draw) - 1
    poses = random_poses(10, 3, generator=generator)
    if kind == "two lines":
        along = torch.linspace(-1, 1, 30, dtype=torch.float64)[:, None]
        X = torch.cat([0.6 * along * torch.randn(10, 1, 3, **draw) + 0.4 * torch.randn(10, 1, 3, **draw) for _ in range(2)], 1)
    if kind == "centres":
        # The second camera stands where the first does.
        t = poses.t.clone()
        t[:, 1] = (poses.R[:, 1] @ poses.R[:, 0].mT @ t[:, 0, :, None])[..., 0]
        poses = Pose(poses.R, t)
    x = project_points(poses.matrix(), X[:, None])
    for noise in (1e-3, 3e-3):
        found = estimate_trifocal(x + noise * torch.randn(x.shape, **draw), threshold=0.01, generator=generator)
        fine = (found.status == Status.OK) & (found.degeneracy == Degeneracy.NONE)
        assert_share(fine == (kind == "general"), 0.9)


def test_bad_problems_and_scale_of_the_threshold(generator: torch.Generator) -> None:
    x, _, _ = scene(5, 60, 0.3, generator)
    x[1] = torch.nan
    x[2] = x[2, :, :1]
    x[3] = torch.rand(3, 60, 2, generator=generator, dtype=F64) * 640
    mask = torch.ones(5, 60, dtype=torch.bool)
    mask[4, 5:] = False
    found = estimate_trifocal(x, threshold=3.0, mask=mask, generator=seeded(1), max_iterations=500)
    wanted = [Status.OK, Status.NOT_FINITE, Status.DEGENERATE, Status.NO_CONSENSUS, Status.TOO_FEW]
    assert found.status.tolist() == wanted
    assert torch.isfinite(found.model).all()
    large = estimate_trifocal(1000 * x, threshold=3000.0, mask=mask, generator=seeded(1), max_iterations=500)
    assert torch.equal(large.inliers, found.inliers)
    single = estimate_trifocal(x[:1].float(), threshold=3.0, generator=seeded(1))
    assert single.model.dtype == torch.float32


def test_wrong_arguments(unchecked: None) -> None:
    with pytest.raises(ValueError, match="x"):
        estimate_trifocal(torch.zeros(2, 9, 2), threshold=1.0)
    with pytest.raises(ValueError, match="mask"):
        estimate_trifocal(torch.zeros(3, 9, 2), threshold=1.0, mask=torch.ones(8, dtype=torch.bool))


# ---- the Oxford sequences: half of the points are held out, and found in the last view from the others ----------------------

TRIPLETS = [
    ("model_house", [0, 1, 2], 0.7),
    ("corridor", [0, 1, 2], 0.5),
    ("corridor", [0, 3, 6], 1.0),
    ("merton1", [0, 1, 2], 0.8),
    ("library", [0, 1, 2], 0.8),
]
QUADRUPLETS = [("model_house", [0, 1, 2, 3], 0.5), ("corridor", [0, 1, 2, 3], 0.4), ("corridor", [0, 2, 4, 6], 0.6)]


def halves(x: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    order = torch.randperm(x.shape[1], generator=generator)
    half = x.shape[1] // 2
    return x[:, order[:half]], x[:, order[half:]]


@pytest.mark.parametrize(("name", "views", "limit"), TRIPLETS)
def test_transfer_in_oxford_triplets(name: str, views: list[int], limit: float, data: Path, generator: torch.Generator) -> None:
    x, segments, P = read(data, name, views)
    x, held = halves(x, generator)
    fit = trifocal_7pt(x)
    assert fit.status == Status.OK
    assert transfer_error(fit.P, held).median() < limit
    robust = estimate_trifocal(x, threshold=2.0, generator=generator)
    assert robust.status == Status.OK
    assert_share(robust.inliers, 0.9)
    assert transfer_error(robust.model, held).median() < limit
    # Half the points do as well as Oxford's cameras, which come from all of them in all views, but for a fifth of a pixel.
    assert transfer_error(robust.model, held).median() < transfer_error(P, held).median() + 0.2
    both = trifocal_7pt(x, lines_of(segments), ends=segments[0])
    assert transfer_error(both.P, held).median() < limit + 0.2
    # Spoiled matches.
    wrong = torch.rand(x.shape[1], generator=generator) < 0.3
    spoiled = x.clone()
    spoiled[2, wrong] = spoiled[2, wrong] + 50 * torch.randn(int(wrong.sum()), 2, generator=generator, dtype=F64)
    again = estimate_trifocal(spoiled, threshold=2.0, generator=generator)
    assert transfer_error(again.model, held).median() < limit + 0.2


@pytest.mark.parametrize(("name", "limit"), [("merton1", 1.3), ("library", 1.6)])
def test_lines_alone_in_oxford_triplets(name: str, limit: float, data: Path) -> None:
    x, segments, _ = read(data, name, [0, 1, 2])
    fit = trifocal_7pt(x[:, :0], lines_of(segments), ends=segments[0])
    assert fit.status == Status.OK
    assert transfer_error(fit.P, x).median() < limit
    few = trifocal_7pt(x[:, :7], lines_of(segments), ends=segments[0])
    assert transfer_error(few.P, x).median() < limit


@pytest.mark.parametrize(("name", "views", "limit"), QUADRUPLETS)
def test_transfer_in_oxford_quadruplets(
    name: str, views: list[int], limit: float, data: Path, generator: torch.Generator
) -> None:
    x, _, P = read(data, name, views)
    # One half may be a bad one: many of them, judged together.
    x, held = (torch.stack(part) for part in zip(*(halves(x, generator) for _ in range(8)), strict=True))
    fit = quadrifocal_6pt(x)
    assert (fit.status == Status.OK).all()

    def error(Q: Tensor) -> Tensor:
        return (transfer_points_quadrifocal(Q, *held[:, :3].unbind(1)) - held[:, 3]).norm(dim=-1).median(-1).values.median()

    assert error(fit.Q) < limit
    assert error(fit.Q) < error(quadrifocal_from_cameras(*P)) + 0.1
