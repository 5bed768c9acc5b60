"""Projective factorisation: exact data, laws, noise, missing data, wrong tracks, degenerate data, real tracks."""

from pathlib import Path

import numpy as np
import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust_projective
from torchsfm.geometry import from_homogeneous, to_homogeneous
from torchsfm.motion import Factorization, factorize_points


def scene(batch: int, views: int, n: int, *, noise: float = 0.0, missing: float = 0.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Images 1000 px wide of points in a cube, from cameras anywhere around it."""
    g = seeded(seed)
    kind = {"generator": g, "dtype": torch.float64}
    unit = torch.nn.functional.normalize
    X = torch.rand(batch, n, 3, **kind) * 2 - 1
    c = unit(torch.randn(batch, views, 3, **kind), dim=-1) * (4 + 4 * torch.rand(batch, views, 1, **kind))
    z = unit(0.3 * torch.randn(batch, views, 3, **kind) - c, dim=-1)
    a = unit(torch.linalg.cross(torch.randn(batch, views, 3, **kind), z), dim=-1)
    R = torch.stack((a, torch.linalg.cross(z, a), z), -2)
    Y = (X[:, None] - c[:, :, None]) @ R.mT
    x = 1000 * Y[..., :2] / Y[..., 2:] + 500
    return x + noise * torch.randn(x.shape, **kind), torch.rand(batch, views, n, generator=g) >= missing


def rms(found: Factorization) -> Tensor:
    seen = torch.isfinite(found.error)
    return (torch.where(seen, found.error, 0).square().sum((-2, -1)) / seen.sum((-2, -1))).sqrt()


def reprojected(found: Factorization) -> Tensor:
    return from_homogeneous(found.X[..., None, :, :] @ found.P.mT)[0]


@pytest.mark.parametrize(("views", "n", "share"), [(2, 8, 0.97), (2, 40, 0.999), (3, 8, 0.99), (5, 20, 0.999), (12, 60, 0.999)])
def test_exact_points_are_found_exactly(views: int, n: int, share: float) -> None:
    """Of eight points in two images one set in forty has a minimum of its own beside the true one."""
    x, _ = scene(20, views, n)
    found = factorize_points(x)
    right = found.error.amax((-2, -1)) < 1e-8
    assert_share(right, share)
    assert (found.status == Status.OK)[right].all()
    assert (found.proximity[right, -1] < 1e-11).all()
    assert (found.depths > 0)[right].all()
    h = to_homogeneous(x) * found.depths[..., None]
    torch.testing.assert_close(h[right], (found.X[:, None] @ found.P.mT)[right], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(torch.linalg.matrix_norm(found.P), torch.ones(20, views, dtype=torch.float64))


def test_forty_views_of_five_hundred_points() -> None:
    x, _ = scene(1, 40, 500)
    assert factorize_points(x).error.max() < 1e-8


def test_missing_data_are_left_out() -> None:
    x, visible = scene(10, 8, 60, missing=0.6, seed=3)
    x = torch.where(visible[..., None], x, torch.nan)
    found = factorize_points(x)
    assert (found.status == Status.OK).all()
    assert (torch.isfinite(found.error) == (visible & found.used_point[:, None])).all()
    assert rms(found).max() < 1e-8
    assert torch.equal(found.used_point, visible.sum(1) >= 2)
    assert (found.X[~found.used_point] == 0).all()


def test_a_homography_of_one_image_changes_nothing_but_its_camera() -> None:
    x, _ = scene(4, 5, 20, noise=0.5)
    g = seeded(1)
    H = torch.randn(4, 3, 3, generator=g, dtype=torch.float64) * torch.tensor([[1, 1, 500], [1, 1, 500], [5e-4, 5e-4, 1]])
    warped = x.clone()
    warped[:, 2] = from_homogeneous(to_homogeneous(x[:, 2]) @ H.mT)[0]
    first, second = factorize_points(x), factorize_points(warped)
    torch.testing.assert_close(first.proximity[:, -1], second.proximity[:, -1], rtol=1e-6, atol=0)
    again = from_homogeneous(to_homogeneous(reprojected(second)[:, 2]) @ torch.linalg.inv(H).mT)[0]
    torch.testing.assert_close(again, reprojected(first)[:, 2], rtol=0, atol=1e-3)
    others = [0, 1, 3, 4]
    torch.testing.assert_close(reprojected(second)[:, others], reprojected(first)[:, others], rtol=0, atol=1e-3)


@pytest.mark.parametrize("views", [3, 6])
def test_homographies_of_all_images_that_move_points_through_infinity(views: int) -> None:
    x, _ = scene(20, views, 30)
    g = seeded(1)
    H = torch.randn(20, views, 3, 3, generator=g, dtype=torch.float64)
    h = to_homogeneous((x - 500) / 300) @ H.mT
    # Some of the points lie beyond the image's new line at infinity.
    assert_share((h[..., 2] > 0).any(-1) & (h[..., 2] < 0).any(-1), 0.2)
    assert_share(factorize_points(from_homogeneous(h)[0]).proximity[:, -1] < 1e-9, 0.95)


def test_order_of_views_and_points_means_nothing() -> None:
    x, visible = scene(3, 6, 30, noise=1.0, missing=0.2)
    g = seeded(2)
    views, points = torch.randperm(6, generator=g), torch.randperm(30, generator=g)
    first = factorize_points(x, visible=visible)
    second = factorize_points(x[:, views][:, :, points], visible=visible[:, views][:, :, points])
    torch.testing.assert_close(second.proximity[:, -1], first.proximity[:, -1], rtol=1e-6, atol=0)
    torch.testing.assert_close(reprojected(second), reprojected(first)[:, views][:, :, points], rtol=0, atol=1e-3)


def test_proximity_falls() -> None:
    found = factorize_points(*scene(5, 6, 30, noise=2.0)[:1], max_iterations=40)
    assert found.proximity.shape == (5, 41)
    assert (found.proximity.diff(dim=-1) <= 0).all()
    assert (found.proximity[:, 0] > found.proximity[:, -1]).all()


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_noise_leaves_noise_and_a_start_for_the_bundle(missing: float) -> None:
    """m numbers observed, 11 unknowns a view and 3 a point, 15 of them free."""
    x, visible = scene(50, 8, 50, noise=1.0, missing=missing, seed=5)
    found = factorize_points(x, visible=visible)
    assert (found.status == Status.OK).all()
    m = 2 * torch.isfinite(found.error).sum((-2, -1))
    expected = (2 * (m - 88 - 150 + 15) / m).sqrt()
    ratio = rms(found) / expected
    assert 1.0 < ratio.mean() < 1.35
    assert ratio.max() < 1.6
    ratios = []
    for i in range(10):
        used = torch.isfinite(found.error[i])
        view, point = used.nonzero().unbind(-1)
        best = bundle_adjust_projective(found.P[i], found.X[i], x[i][used], view, point)
        ratios.append(best.residuals.square().mean().sqrt() / expected[i])
    assert 0.96 < torch.stack(ratios).mean() < 1.04
    assert torch.stack(ratios).max() < 1.15


def test_wrong_tracks_do_not_spoil_it() -> None:
    x, visible = scene(10, 8, 80, noise=1.0, missing=0.2, seed=6)
    g = seeded(7)
    wrong = torch.rand(10, 1, 80, generator=g) < 0.2
    x = torch.where(wrong[..., None], torch.rand(x.shape, generator=g, dtype=torch.float64) * 1000, x)
    plain, robust = factorize_points(x, visible=visible), factorize_points(x, visible=visible, robust=True)
    good = torch.isfinite(robust.error) & ~wrong
    assert robust.error[good].median() < 1.1
    assert plain.error[good].median() > 3
    assert robust.weights[good].mean() > 0.6
    # A wrong track still fits two or three of its views.
    assert robust.weights[wrong.expand_as(good) & visible].mean() < 0.25


def test_weights_are_squared_residuals_weights() -> None:
    x, _ = scene(2, 4, 20, noise=1.0)
    w = torch.ones(2, 4, 20, dtype=torch.float64)
    w[:, :, 5] = 0
    dropped = torch.ones(20, dtype=torch.bool)
    dropped[5] = False
    a, b = factorize_points(x, weights=w), factorize_points(x[:, :, dropped])
    assert not a.used_point[:, 5].any()
    torch.testing.assert_close(reprojected(a)[:, :, dropped], reprojected(b), rtol=0, atol=1e-3)


def test_each_problem_of_a_batch_stands_alone() -> None:
    x, visible = scene(6, 4, 20, noise=1.0, missing=0.1)
    x, visible = x.reshape(2, 3, 4, 20, 2), visible.reshape(2, 3, 4, 20)
    together = factorize_points(x, visible=visible)
    alone = factorize_points(x[1, 2], visible=visible[1, 2])
    torch.testing.assert_close(together.proximity[1, 2], alone.proximity, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(reprojected(together)[1, 2], reprojected(alone), rtol=0, atol=1e-5)
    spoiled = x.clone()
    spoiled[0, 0] = torch.nan
    again = factorize_points(spoiled, visible=visible)
    assert again.status[0, 0] == Status.TOO_FEW
    torch.testing.assert_close(again.P[1, 2], together.P[1, 2], rtol=1e-9, atol=1e-9)
    assert factorize_points(x[:, :0]).P.shape == (2, 0, 4, 3, 4)
    single = factorize_points(x.float(), visible=visible)
    assert single.P.dtype == single.error.dtype == torch.float32


def test_the_frame_of_space_is_not_what_rounding_makes_of_the_way(generator: torch.Generator) -> None:
    """The search wanders for long, and rounding grows on its way to the same fit: cameras and points must not tell of it."""
    x, visible = scene(256, 4, 12, noise=3.0, missing=0.2, seed=int(torch.randint(1 << 30, (), generator=generator)))
    rounded = x * (1 + 1e-15 * torch.randn(x.shape, generator=generator, dtype=torch.float64))
    first, second = (factorize_points(some, visible=visible) for some in (x, rounded))
    well = (first.status == Status.OK) & (second.status == Status.OK)
    # Where there are two minima rounding may decide which is found.
    same = well & ((reprojected(first) - reprojected(second)).abs().amax((-3, -2, -1)) < 1e-6)
    assert_share(same[well], 0.9)
    assert int(well.sum()) > 160
    for a, b in ((first.P, second.P), (first.X, second.X)):
        torch.testing.assert_close(a[same], b[same], rtol=0, atol=1e-7)


def test_data_that_do_not_determine_the_answer_say_so() -> None:
    x, visible = scene(7, 4, 20, noise=0.1)
    x = x.clone()
    g = seeded()
    # A planar scene: homographies of one image.
    H = torch.randn(4, 3, 3, generator=g, dtype=torch.float64) * 0.1 + torch.eye(3, dtype=torch.float64)
    x[0] = from_homogeneous(to_homogeneous((x[0, :1] - 500) / 500) @ H.mT)[0] * 500 + 500
    x[1] = x[1, :1]  # four times the same image
    x[2] = 3.0  # one point
    visible[3, :, 5:] = False  # too few points
    visible[4, 1:] = False  # one view
    x[5, :, :, 1] = 2 * x[5, :, :, 0]  # a line in every image
    found = factorize_points(x, visible=visible)
    wanted = [Status.DEGENERATE] * 3 + [Status.TOO_FEW] * 2 + [Status.DEGENERATE, Status.OK]
    assert found.status.tolist() == wanted
    assert not torch.isnan(found.error).any()
    for tensor in (found.P, found.X, found.depths, found.proximity, found.weights):
        assert torch.isfinite(tensor).all()


@pytest.mark.parametrize(("views", "n", "told"), [(2, 40, 0.95), (3, 10, 0.9), (3, 60, 0.98), (8, 30, 0.98)])
def test_noise_is_not_taken_for_a_third_dimension(views: int, n: int, told: float, generator: torch.Generator) -> None:
    """Planes and views from one centre: a fourth dimension always takes some of the noise."""
    batch, kind = 12, {"generator": generator, "dtype": torch.float64}
    x, _ = scene(batch, 1, n)
    H = torch.eye(3, dtype=torch.float64) + 0.1 * torch.randn(batch, views, 3, 3, **kind)
    flat = 500 * from_homogeneous(to_homogeneous((x - 500) / 500) @ H.mT)[0] + 500
    noise = 10 ** (2 * torch.rand(batch, 1, 1, 1, **kind) - 1.5)
    flat = flat + noise * torch.randn(flat.shape, **kind)
    # Homographies must not move points to infinity, where noise is no more what it was.
    near = (flat - 500).abs().amax((-3, -2, -1)) < 2000
    assert_share((factorize_points(flat).status == Status.DEGENERATE)[near], told)
    solid, _ = scene(batch, views, n, noise=0.3)
    assert_share(factorize_points(solid).status == Status.OK, 0.98)
    if views > 2:
        thin = (x - 500) * torch.tensor([1.0, 0.5], dtype=torch.float64)
        thin = torch.stack((thin[..., 0], 0.5 * thin[..., 0]), -1) * (1 + 0.2 * torch.rand(batch, views, 1, 1, **kind)) + 500
        thin = thin + noise * torch.randn(thin.shape, **kind)
        assert_share(factorize_points(thin).status == Status.DEGENERATE, told)


def test_two_halves_that_share_nothing_are_degenerate() -> None:
    x, visible = scene(1, 8, 60)
    visible[:, :4, 30:] = False
    visible[:, 4:, :30] = False
    assert factorize_points(x, visible=visible).status == Status.DEGENERATE


def test_derivative_of_the_reprojections() -> None:
    """On exact data: against the change of the whole answer."""
    x, visible = scene(1, 4, 10, missing=0.1, seed=2)
    x, visible = x[0], visible[0]
    g = seeded()
    direction = torch.randn(x.shape, generator=g, dtype=torch.float64)
    leaf = x.clone().requires_grad_()
    again = reprojected(factorize_points(leaf, visible=visible))
    weight = torch.randn(again.shape, generator=g, dtype=torch.float64)
    used = visible[..., None]
    slope = torch.autograd.grad((weight * again * used).sum(), leaf)[0]
    h = 1e-4
    ends = [(weight * reprojected(factorize_points(x + s * h * direction, visible=visible)) * used).sum() for s in (1, -1)]
    torch.testing.assert_close((slope * direction).sum(), (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-4)
    assert (slope[~visible] == 0).all()


@pytest.mark.usefixtures("unchecked")
def test_wrong_input_is_named() -> None:
    x, visible = scene(1, 3, 10)
    for match, call in (
        ("x", lambda: factorize_points(x[0, 0])),
        ("visible", lambda: factorize_points(x, visible=visible[..., 1:])),
        ("visible", lambda: factorize_points(x, visible=visible.double())),
        ("weights", lambda: factorize_points(x, weights=visible)),
        ("max_iterations", lambda: factorize_points(x, max_iterations=0)),
    ):
        with pytest.raises(ValueError, match=match):
            call()


@pytest.mark.slow
def test_dinosaur(data: Path) -> None:
    """36 views on a turntable, 88 % missing, wrong tracks among them; the published cameras fit to a median of 0.26 px."""
    x = torch.from_numpy(np.loadtxt(data / "vgg/dinosaur/viff.xy")).reshape(-1, 36, 2).transpose(0, 1)
    visible = (x >= 0).all(-1)
    long = visible.sum(0) >= 3
    found = factorize_points(x[:, long], visible=visible[:, long], robust=True)
    assert found.status == Status.OK
    assert found.used_view.all()
    seen = torch.isfinite(found.error)
    assert found.error[seen].median() < 0.23
    assert found.error[seen].quantile(0.9) < 0.8
    assert (found.depths[seen] > 0).all()


@pytest.mark.parametrize("layout", ["plane and a point", "two lines", "five places"])
@pytest.mark.parametrize("v", [3, 6])
def test_noise_does_not_make_up_what_points_leave_open(layout: str, v: int, generator: torch.Generator) -> None:
    """One number of the cameras is open, which noise of half a pixel in several hundred seems to tell."""
    trials, n = 30, 30
    C = 2 * torch.randn(trials, v, 3, generator=generator, dtype=torch.float64) - torch.tensor([0.0, 0.0, 10.0])
    z = torch.nn.functional.normalize(-C, dim=-1)
    up = torch.randn(trials, v, 3, generator=generator, dtype=torch.float64)
    across = torch.nn.functional.normalize(torch.linalg.cross(up, z), dim=-1)
    R = torch.stack((across, torch.linalg.cross(z, across), z), -2)
    X = 1.5 * torch.randn(trials, n, 3, generator=generator, dtype=torch.float64)
    general = X
    if layout == "plane and a point":
        X = torch.cat(
            (X[:, :-1] * torch.tensor([1.0, 1.0, 0.0]) + 0.3 * X[:, :-1, :1] * torch.tensor([0.0, 0.0, 1.0]), X[:, -1:]), 1
        )
    elif layout == "two lines":
        along = torch.randn(trials, n // 2, 2, 1, generator=generator, dtype=torch.float64)
        X = (X[:, None, :2] + along * X[:, None, 2:4]).flatten(1, 2)
    else:
        X = X[:, torch.arange(n) % 5]

    def images(X: torch.Tensor) -> torch.Tensor:
        Y = (X[:, None] - C[:, :, None]) @ R.mT
        x = 800 * Y[..., :2] / Y[..., 2:]
        return x + 0.5 * torch.randn(x.shape, generator=generator, dtype=torch.float64)

    assert (factorize_points(images(X)).status == Status.OK).double().mean() < 0.15
    if layout == "plane and a point":  # once: points in general position are of no layout
        assert (factorize_points(images(general)).status == Status.OK).double().mean() > 0.9


@pytest.mark.parametrize("views", [2, 3])
@pytest.mark.parametrize("noise", [0.0, 0.3, 3.0])
def test_six_points_often_are_six(views: int, noise: float) -> None:
    x, _ = scene(40, views, 6)
    x = x.repeat(1, 1, 5, 1)
    x = x + noise * torch.randn(x.shape, generator=seeded(1), dtype=torch.float64)
    assert (factorize_points(x).status == Status.DEGENERATE).all()
    # Thirty that are apart are enough.
    assert_share(factorize_points(scene(20, views, 30, noise=noise)[0]).status == Status.OK, 0.9)
