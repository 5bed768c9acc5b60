"""Cameras and curves from images of curves alone: exact data, laws, noise, what the data do not determine, what is wrong."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration.camera_information import camera_information
from torchsfm.geometry import (
    Curve,
    camera_from_krt,
    curve_from_samples,
    from_homogeneous,
    project_points,
    rotation_from_rotvec,
    to_homogeneous,
)
from torchsfm.motion import CurveFactorization, factorize_curves
from torchsfm.motion.many_views import curve_verdict, factorization_curves
from torchsfm.triangulation import triangulate_points_dlt

F64 = torch.float64
K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)


def cameras(batch: int, v: int, generator: torch.Generator, *, arc: float = 40.0) -> Tensor:
    """On an arc around the curves, ten units away, turned a little."""
    kind = {"generator": generator, "dtype": F64}
    turn = torch.linspace(-0.5, 0.5, v, dtype=F64)[:, None] * math.radians(arc) * torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    R = rotation_from_rotvec(0.15 * torch.randn(batch, v, 3, **kind)) @ rotation_from_rotvec(turn)
    t = torch.tensor([0.0, 0.0, 10.0], dtype=F64) + 0.3 * torch.randn(batch, v, 3, **kind)
    return camera_from_krt(K, R, t)


def space_curves(batch: int, c: int, n: int, generator: torch.Generator) -> Tensor:
    """Bent rings of about one unit."""
    kind = {"generator": generator, "dtype": F64}
    t = torch.arange(n, dtype=F64) * (2 * math.pi / n)
    a = torch.randn(batch, c, 3, 2, 3, **kind) / torch.tensor([1.0, 4.0, 9.0], dtype=F64)[:, None, None]
    a = 1.5 * a / a.square().sum((-3, -2, -1), keepdim=True).sqrt()
    waves = torch.stack([torch.stack(((k * t).cos(), (k * t).sin())) for k in (1, 2, 3)])
    return torch.einsum("bckwd,kwn->bcnd", a, waves) + 0.7 * torch.randn(batch, c, 1, 3, **kind)


def images(X: Tensor, P: Tensor) -> Tensor:
    """(b, v, c, n, 2)."""
    return torch.stack([project_points(P, X[:, None, k]) for k in range(X.shape[1])], 2)


def camera_error(found: CurveFactorization, x: Tensor) -> Tensor:
    """How far true points in correspondence are from any points that the cameras found would see there, root mean square."""
    exact = x[..., ::20, :].flatten(2, 3)
    X = triangulate_points_dlt(exact, found.P, homogeneous=True)
    seen = from_homogeneous(X[:, None] @ found.P.mT)[0]
    return (seen - exact).square().sum(-1).mean((-2, -1)).sqrt()


def test_exact_curves_that_begin_alike(generator: torch.Generator) -> None:
    """Equal shares of their lengths are tens of pixels off the points that belong together."""
    P, X = cameras(6, 6, generator), space_curves(6, 3, 500, generator)
    x = images(X, P)
    found = factorize_curves(curve_from_samples(x, closed=True), aligned=True)
    right = camera_error(found, x) < 1e-3
    assert_share(right, 0.95)
    assert_share(found.status == Status.OK, 0.9)
    assert right[found.status == Status.OK].all()
    typical = torch.where(torch.isfinite(found.error), found.error, torch.nan).flatten(1).nanmedian(-1).values
    assert_share(typical < 1e-6, 0.9)
    assert_share(found.measured, 0.9)
    seen = from_homogeneous(found.X.flatten(1, 2)[:, None] @ found.P.mT)[0].unflatten(2, (3, 40))
    torch.testing.assert_close(seen[right][found.measured[right][:, None].expand(-1, 6, -1, -1)],
        found.x[right][found.measured[right][:, None].expand(-1, 6, -1, -1)], rtol=0, atol=1e-2)  # fmt: skip


def test_curves_that_begin_anywhere_and_run_either_way(generator: torch.Generator) -> None:
    P, X = cameras(4, 5, generator, arc=20.0), space_curves(4, 3, 300, generator)
    x = images(X, P)
    slot = torch.arange(300)
    back = torch.rand(4, 5, 3, 1, generator=generator) < 0.5
    start = torch.randint(300, (4, 5, 3, 1), generator=generator)
    index = (torch.where(back, -slot, slot) + start) % 300
    curves = curve_from_samples(x.gather(-2, index[..., None].expand_as(x)), closed=True)
    found = factorize_curves(curves, samples=24)
    right = camera_error(found, x) < 0.05
    assert_share(right, 0.6)
    assert right[found.status == Status.OK].all()


def test_open_curves(generator: torch.Generator) -> None:
    P, X = cameras(4, 6, generator), space_curves(4, 4, 1000, generator)[:, :, :600]
    x = images(X, P)
    found = factorize_curves(curve_from_samples(x), aligned=True)
    right = camera_error(found, x) < 1e-2
    assert_share(right, 0.97)
    assert right[found.status == Status.OK].all()


@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_noise(noise: float, generator: torch.Generator) -> None:
    """Samples eight pixels apart: nearer ones would have to be smoothed."""
    P, X = cameras(4, 6, generator), space_curves(4, 3, 400, generator)
    x = images(X, P)
    apart = x[..., ::8, :]
    noisy = apart + noise * torch.randn(apart.shape, generator=generator, dtype=F64)
    found = factorize_curves(curve_from_samples(noisy, closed=True), aligned=True)
    assert_share(found.status == Status.OK, 0.97)
    error = camera_error(found, x)
    assert (error[found.status == Status.OK] < max(3 * noise, 0.5)).all()
    seen = torch.where(torch.isfinite(found.error), found.error, torch.nan)
    assert (seen.square().flatten(1).nanmean(-1).sqrt()[found.status == Status.OK] < noise).all()


def least_error(P: Tensor, X: Tensor, x: Tensor, points: Tensor) -> Tensor:
    """The least expected mean square of `camera_error`, for unit noise of normal distances of samples X seen at x.

    Cramer and Rao's bound, for samples that are unknown across their curves.
    """
    P = P / torch.linalg.matrix_norm(P)[..., None, None]
    along = torch.nn.functional.normalize(x.roll(-1, -2) - x.roll(1, -2), dim=-1).flatten(2, 3)
    v = P.shape[1]

    def information(Y: Tensor, normal: Tensor | None) -> Tensor:
        ones = torch.ones(*P.shape[:2], Y.shape[1], dtype=F64)
        return camera_information(P, to_homogeneous(Y), ones, torch.zeros(*ones.shape, 2, 1, dtype=F64), normal=normal).matrix

    values, vectors = torch.linalg.eigh(information(X.flatten(1, 2), torch.stack((-along[..., 1], along[..., 0]), -1)))
    # Scales of cameras and the frame are free.
    values, vectors = values[:, v + 15 :], vectors[..., v + 15 :]
    lost = (vectors * (information(points, None) @ vectors)).sum(1) / values
    return lost.sum(-1) / (v * points.shape[1])


def test_all_that_is_measured_counts(generator: torch.Generator) -> None:
    """Eight times as many measured points as samples: these alone leave five times the least mean square error and more."""
    P, X = cameras(4, 6, generator), space_curves(4, 3, 320, generator)
    x, noise = images(X, P), 0.1
    found = factorize_curves(curve_from_samples(x + noise * torch.randn(x.shape, generator=generator, dtype=F64), closed=True),
        aligned=True)  # fmt: skip
    assert (found.status == Status.OK).all()
    least = noise**2 * least_error(P, X, x, X[:, :, ::20].flatten(1, 2))
    # Of one scene the mean square has a standard deviation of less than half of itself: several numbers of cameras make it.
    assert float((camera_error(found, x).square() / least).mean()) < 1.2 + 3 * 0.5 / len(P) ** 0.5


def test_more_samples_than_were_measured(generator: torch.Generator) -> None:
    """What noise makes of a curve that is drawn from one measured point to the next is smooth, and no sign of wrong cameras."""
    P, X = cameras(4, 6, generator), space_curves(4, 3, 400, generator)
    x, noise = images(X, P), 0.3
    apart = x[..., ::10, :]
    apart = apart + noise * torch.randn(apart.shape, generator=generator, dtype=F64)
    found = factorize_curves(curve_from_samples(apart, closed=True), samples=80, aligned=True)
    assert_share(found.status == Status.OK, 0.97)
    assert (camera_error(found, x)[found.status == Status.OK] < 3 * noise).all()


def test_what_curves_do_not_determine(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor are they put together anew then: no way to do so would determine more."""
    anew, search = [], factorization_curves._search_anew

    def counted(*args: Any) -> Any:
        anew.append(True)
        return search(*args)

    monkeypatch.setattr(factorization_curves, "_search_anew", counted)
    P, X = cameras(2, 5, generator), space_curves(2, 3, 300, generator)
    flat = X.clone()
    flat[..., 2] = 0.3 * X[..., 0] + 0.2
    s = torch.linspace(-1, 1, 100, dtype=F64)[:, None]
    ends = torch.randn(2, 3, 2, 1, 3, generator=generator, dtype=F64)
    lines = ends[:, :, 0] + s * ends[:, :, 1]
    R = rotation_from_rotvec(0.2 * torch.randn(2, 5, 3, generator=generator, dtype=F64))
    still = camera_from_krt(K, R, torch.tensor([0.0, 0.0, 10.0], dtype=F64) @ R.mT)
    noise = 0.3 * torch.randn(2, 5, 3, 50, 2, generator=generator, dtype=F64)
    statuses = []
    for x, closed in (
        (images(flat, P), True),
        (images(lines, P), False),
        (images(X, still), True),
        (images(flat, P)[..., ::6, :] + noise, True),
        (images(X, still)[..., ::6, :] + noise, True),
    ):
        found = factorize_curves(curve_from_samples(x, closed=closed), samples=24, aligned=True)
        statuses.append(found.status)
    told = torch.cat(statuses)
    assert (told != Status.OK).all()
    assert_share(told == Status.DEGENERATE, 0.8)
    assert len(anew) <= int((told != Status.DEGENERATE).sum())


def test_flat_curves_that_begin_anywhere_are_told(generator: torch.Generator) -> None:
    """One curve of a plane whose points are put together wrongly makes a fourth dimension that none of the others has."""
    P, X = cameras(6, 5, generator), space_curves(6, 3, 300, generator)
    X[..., 2] = 0.3 * X[..., 0] + 0.2
    x = images(X, P)
    back = torch.rand(6, 5, 3, 1, generator=generator) < 0.5
    slot, start = torch.arange(300), torch.randint(300, (6, 5, 3, 1), generator=generator)
    index = (torch.where(back, -slot, slot) + start) % 300
    x = x.gather(-2, index[..., None].expand_as(x))[..., ::6, :]
    x = x + 0.3 * torch.randn(x.shape, generator=generator, dtype=F64)
    found = factorize_curves(curve_from_samples(x, closed=True), samples=24)
    assert (found.status != Status.OK).all()


@pytest.mark.usefixtures("unchecked")
def test_planes_are_fitted_closely_where_that_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of noise alone homographies leave what space does, and three times that at most."""
    left = {curve_verdict._ROUGHLY: [2.0, 20.0, 20.0, 60.0], curve_verdict._CLOSELY: [0.0, 2.0, 10.0, 2.0]}
    asked = []

    def left_by(images: object, found: object, tolerance: float) -> Tensor:
        asked.append(tolerance)
        return torch.tensor(left[tolerance]).double()

    monkeypatch.setattr(curve_verdict, "_left_by_plane", left_by)
    end = SimpleNamespace(end=SimpleNamespace(cost=torch.ones(4, dtype=F64)))
    found: Any = SimpleNamespace(end=end, measured=torch.ones(4, 3, 40, dtype=torch.bool))
    flat = curve_verdict._flat(None, found, torch.full((4,), 5), torch.full((4,), 10**9))  # type: ignore[arg-type]
    assert flat.tolist() == [True, True, False, False]
    assert asked == [curve_verdict._ROUGHLY, curve_verdict._CLOSELY]
    left[curve_verdict._ROUGHLY][1:3] = [60.0, 60.0]
    curve_verdict._flat(None, found, torch.full((4,), 5), torch.full((4,), 10**9))  # type: ignore[arg-type]
    assert asked[2:] == [curve_verdict._ROUGHLY]


def test_images_of_other_curves_have_no_consensus(generator: torch.Generator) -> None:
    P, X = cameras(1, 6, generator), space_curves(2, 3, 200, generator)
    x = images(X[:1], P)
    x[:, 3, 1] = images(X[1:], P)[:, 3, 1]
    found = factorize_curves(curve_from_samples(x, closed=True), aligned=True)
    assert (found.status != Status.OK).all()


def test_too_few(generator: torch.Generator) -> None:
    P, X = cameras(2, 2, generator), space_curves(2, 3, 60, generator)
    found = factorize_curves(curve_from_samples(images(X, P), closed=True))
    assert (found.status == Status.TOO_FEW).all()
    assert not found.used_view.any()
    assert (found.P == 0).all()


def test_too_few_curves(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrong cameras come as near to one curve, and to two in three views, as right ones: nothing is searched for then."""
    monkeypatch.setattr(factorization_curves, "_search", None)
    for v, c in ((6, 1), (3, 2)):
        P, X = cameras(2, v, generator), space_curves(2, c, 200, generator)
        found = factorize_curves(curve_from_samples(images(X, P), closed=True), aligned=True)
        assert (found.status == Status.TOO_FEW).all()
        assert torch.isinf(found.error).all()
        assert not found.measured.any()


def test_laws(generator: torch.Generator) -> None:
    """Views and curves in any order; a batch is its elements; a curve that is not shown changes no other problem."""
    P, X = cameras(2, 5, generator), space_curves(2, 3, 200, generator)
    x = images(X, P)
    curves = curve_from_samples(x, closed=True)
    found = factorize_curves(curves, aligned=True)
    views, order = torch.randperm(5, generator=generator), torch.randperm(3, generator=generator)
    shuffled = curve_from_samples(x[:, views][:, :, order], closed=True)
    other = factorize_curves(shuffled, aligned=True)
    alone = factorize_curves(Curve(curves.x[1], curves.valid[1], curves.closed[1]), aligned=True)
    both = (found.status == Status.OK) & (other.status == Status.OK)
    assert both.any()
    assert (camera_error(other, x[:, views])[both] < 1e-2).all()
    assert alone.status == found.status[1]
    torch.testing.assert_close(alone.x, found.x[1], rtol=0, atol=1e-2)
    hidden = x.clone()
    hidden[0, 2, 1] = torch.nan
    less = factorize_curves(curve_from_samples(hidden, closed=True), aligned=True)
    assert torch.isinf(less.error[0, 2, 1]).all()
    assert torch.isfinite(less.P).all()
    torch.testing.assert_close(less.x[1:], found.x[1:], rtol=0, atol=1e-2)
    empty = factorize_curves(Curve(curves.x[:0], curves.valid[:0], curves.closed[:0]))
    assert empty.P.shape == (0, 5, 3, 4)
    single = factorize_curves(curve_from_samples(x[1, :2].float(), closed=True), aligned=True)
    assert single.P.dtype == torch.float32
