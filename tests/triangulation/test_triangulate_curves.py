"""Curves from known views: exact curves, laws, noise and covariance, gaps, degenerate views, derivatives, a real set."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Curve, camera_from_krt, curve_from_samples, foot_points, project_points, rotation_from_rotvec
from torchsfm.triangulation import CurveTriangulation, triangulate_curves

F64 = torch.float64


def cameras(batch: int, v: int, generator: torch.Generator) -> Tensor:
    """Around the origin, ten units away, of 800 px focal length."""
    kind = {"generator": generator, "dtype": F64}
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
    R = rotation_from_rotvec(0.5 * torch.randn(batch, v, 3, **kind))
    t = torch.tensor([0.0, 0.0, 10.0], dtype=F64) + 0.3 * torch.randn(batch, v, 3, **kind)
    return camera_from_krt(K, R, t)


def space_curves(batch: int, n: int, generator: torch.Generator, *, closed: bool) -> Tensor:
    """Bent rings, or arcs of them."""
    kind = {"generator": generator, "dtype": F64}
    t = torch.arange(n, dtype=F64) * (2 * math.pi / n) * (1.0 if closed else 0.6)
    a = torch.randn(batch, 3, 2, 3, **kind) / torch.tensor([1.0, 4.0, 9.0], dtype=F64)[:, None, None]
    waves = torch.stack([torch.stack(((k * t).cos(), (k * t).sin())) for k in (1, 2, 3)])
    return torch.einsum("bkcd,kcn->bnd", a, waves)


def images(X: Tensor, P: Tensor) -> Tensor:
    return project_points(P, X[:, None])


def distance(found: CurveTriangulation, X: Tensor, *, closed: bool) -> Tensor:
    """Of the samples found from the true curves."""
    truth = curve_from_samples(X, closed=closed)
    return (foot_points(truth, found.curve.x).x - found.curve.x).norm(dim=-1)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("v", [3, 6])
def test_exact_curves(v: int, closed: bool, generator: torch.Generator) -> None:
    P, X = cameras(12, v, generator), space_curves(12, 200, generator, closed=closed)
    found = triangulate_curves(curve_from_samples(images(X, P), closed=closed), P, samples=80, threshold=1.0)
    assert_share(found.status == Status.OK, 0.95)
    gap = distance(found, X, closed=closed)
    assert_share((gap < 1e-3)[found.measured], 0.97)
    assert gap[found.measured].median() < 1e-5
    good = (found.status == Status.OK)[:, None] & found.curve.valid
    assert_share(found.measured[good], 0.8)
    seen = found.error[torch.isfinite(found.error)]
    assert seen.median() < 1e-3
    assert torch.isfinite(found.curve.x).all()


def test_no_view_comes_first_and_no_end_of_a_curve(generator: torch.Generator) -> None:
    P, X = cameras(6, 5, generator), space_curves(6, 160, generator, closed=True)
    x = images(X, P)
    order, turned = torch.randperm(5, generator=generator), torch.arange(5) % 2 == 0
    curve = curve_from_samples(x, closed=True)
    other = torch.where(turned[:, None, None], x.flip(-2), x).roll(37, -2)
    found = triangulate_curves(curve, P, threshold=1.0)
    again = triangulate_curves(curve_from_samples(other[:, order], closed=True), P[:, order], threshold=1.0)
    for one in (found, again):
        assert_share((distance(one, X, closed=True) < 1e-3)[one.measured], 0.97)
    alone = triangulate_curves(Curve(curve.x[2], curve.valid[2], curve.closed[2]), P[2], threshold=1.0)
    torch.testing.assert_close(alone.curve.x, found.curve.x[2], rtol=1e-9, atol=1e-9)


def test_a_straight_curve_is_a_line(generator: torch.Generator) -> None:
    ends = torch.randn(20, 2, 1, 3, dtype=F64, generator=generator)
    t = torch.linspace(0, 1, 50, dtype=F64)[:, None]
    X = ends[:, 0] * (1 - t) + ends[:, 1] * t
    P = cameras(20, 4, generator)
    found = triangulate_curves(curve_from_samples(images(X, P)), P, samples=20)
    assert_share(found.status == Status.OK, 0.9)
    d = torch.nn.functional.normalize(X[:, -1] - X[:, 0], dim=-1)[:, None]
    away = found.curve.x - X[:, :1]
    gap = (away - (away * d).sum(-1, keepdim=True) * d).norm(dim=-1)
    assert gap[found.measured].max() < 1e-8


def test_noise_is_as_the_covariance_says(generator: torch.Generator) -> None:
    """Edges are displaced across, smoothly: neighbours share their noise."""
    P, X = cameras(40, 6, generator), space_curves(40, 240, generator, closed=True)
    x = images(X, P)
    noise = 0.3 * torch.randn(40, 6, 24, 2, dtype=F64, generator=generator)
    smooth = torch.nn.functional.interpolate(noise.flatten(0, 1).mT, 240, mode="linear").mT.reshape(x.shape)
    found = triangulate_curves(curve_from_samples(x + smooth, closed=True), P, samples=24, threshold=3.0)
    assert_share(found.status == Status.OK, 0.95)
    gap = distance(found, X, closed=True)
    # What interpolation leaves of the variance: 2/3 of it on average.
    expected = (found.covariance.diagonal(dim1=-2, dim2=-1).sum(-1) * 0.09 * 2 / 3).sqrt()
    ratio = (gap / expected.clamp(min=1e-12))[found.measured]
    assert 0.6 < ratio.square().clamp(max=9).mean().sqrt() < 1.3


def test_parts_that_views_do_not_see(generator: torch.Generator) -> None:
    P, X = cameras(10, 6, generator), space_curves(10, 200, generator, closed=False)
    valid = torch.rand(10, 6, 1, generator=generator) * 60 < torch.arange(200)
    x = images(X, P)
    x[:, 5] += 200  # another curve
    found = triangulate_curves(curve_from_samples(x, valid=valid), P, threshold=1.0)
    assert_share(found.status == Status.OK, 0.85)
    assert_share((distance(found, X, closed=False) < 1e-2)[found.measured], 0.97)
    counted = torch.isfinite(found.error) & found.measured[:, None]
    assert counted[:, 5].sum() < 0.1 * counted[:, 4].sum()


def test_views_that_tell_nothing(generator: torch.Generator) -> None:
    P, X = cameras(6, 3, generator), space_curves(6, 60, generator, closed=True)
    curve = curve_from_samples(images(X, P), closed=True)
    P = P.clone()
    P[0] = P[0, :1]  # one centre
    P[1, 1:] = torch.nan
    visible = torch.ones(6, 3, dtype=torch.bool)
    visible[2, :2] = False
    x = curve.x.clone()
    x[0] = x[0, :1]
    x[3, 0, 7] = torch.inf
    x[4, 1:, :, 1] += 400  # nothing in common
    found = triangulate_curves(Curve(x, curve.valid, curve.closed), P, visible=visible, threshold=0.5)
    alone = triangulate_curves(Curve(x[5], curve.valid[5], curve.closed[5]), P[5], threshold=0.5)
    assert torch.equal(alone.curve.x, found.curve.x[5])
    assert found.status[:3].tolist() == [Status.DEGENERATE, Status.TOO_FEW, Status.TOO_FEW]
    assert found.status[4] in (Status.NO_CONSENSUS, Status.DEGENERATE)
    assert found.status[5] == alone.status
    for tensor in (found.curve.x, found.covariance):
        assert torch.isfinite(tensor).all()
    assert not torch.isnan(found.error).any()
    # A curve that runs along the epipolar lines.
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
    side = torch.stack([torch.tensor([float(i), 0.0, 5.0], dtype=F64) for i in range(3)])
    level = camera_from_krt(K, torch.eye(3, dtype=F64).expand(3, 3, 3), side)
    line = torch.stack(
        [torch.linspace(-1, 1, 40, dtype=F64), torch.full((40,), 0.3, dtype=F64), torch.zeros(40, dtype=F64)], -1
    )
    flat = triangulate_curves(curve_from_samples(project_points(level, line)), level)
    assert flat.status == Status.DEGENERATE
    assert not flat.measured.any()


@pytest.mark.parametrize("v", [2, 3, 4])
def test_what_takes_a_wrong_turn_is_not_called_measured(v: int, generator: torch.Generator) -> None:
    """Every turn of a helix looks like the next, and views ten degrees apart see it from the same side."""
    t = torch.linspace(0, 6 * math.pi, 400, dtype=F64)
    spin = rotation_from_rotvec(torch.randn(12, 3, dtype=F64, generator=generator))
    X = torch.stack((t.cos(), t.sin(), 0.12 * (t - 3 * math.pi)), -1) @ spin.mT
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
    turn = torch.zeros(v, 3, dtype=F64)
    turn[:, 1] = torch.arange(v) * (math.pi / 18)
    P = camera_from_krt(K, rotation_from_rotvec(turn), torch.tensor([0.0, 0.0, 10.0], dtype=F64).expand(v, 3))
    found = triangulate_curves(curve_from_samples(images(X, P)), P, samples=60)
    gap = distance(found, X, closed=False)[found.measured]
    assert found.measured.sum() > (20, 300, 400)[v - 2]
    assert_share(gap < 0.05, 0.96)


def test_derivatives_are_those_of_the_optimum(generator: torch.Generator) -> None:
    P, X = cameras(1, 5, generator), space_curves(1, 400, generator, closed=True)
    truth = curve_from_samples(X[0], closed=True)
    x, P = images(X[:, ::4], P)[0], P[0]
    d = torch.randn(x.shape, dtype=F64, generator=generator), 1e-3 * torch.randn(P.shape, dtype=F64, generator=generator)

    def samples(s: Tensor | float) -> tuple[Tensor, Tensor]:
        found = triangulate_curves(curve_from_samples(x + s * d[0], closed=True), P + s * d[1], samples=20)
        return found.curve.x, found.measured

    s = torch.zeros((), dtype=F64, requires_grad=True)
    value, measured = samples(s)
    slope = torch.stack([torch.autograd.grad(v, s, retain_graph=True)[0] for v in value.flatten()]).view(value.shape)
    h = 1e-4
    (high, m1), (low, m2) = samples(h), samples(-h)
    tangent = foot_points(truth, value).tangent
    difference = (high - low) / (2 * h)
    rest = difference - slope
    across = (rest - (rest * tangent).sum(-1, keepdim=True) * tangent).norm(dim=-1)
    size = slope.norm(dim=-1)
    checked = measured & m1 & m2
    assert checked.sum() > 10
    # To first order in the distances, which interpolation between samples makes hundredths of a pixel.
    assert (across[checked] < 0.05 * size[checked].median()).float().mean() > 0.8


@pytest.mark.parametrize("views", [[0, 3, 6, 9, 12, 15, 18]])
def test_curves_of_a_turntable(views: list[int], data: Path) -> None:
    folder = data / "curves" / "synthcurves"
    K = torch.from_numpy(np.loadtxt(folder / "calib.intrinsic"))
    number = np.loadtxt(folder / "crv-ids.txt").astype(int)
    X = torch.from_numpy(np.loadtxt(folder / "crv-3D-pts.txt"))
    x, P = [], []
    for i in views:
        x.append(torch.from_numpy(np.loadtxt(folder / f"frame_{i:04d}-pts-2D.txt")))
        pose = torch.from_numpy(np.loadtxt(folder / f"frame_{i:04d}.extrinsic"))
        P.append(camera_from_krt(K, pose[:3], -pose[:3] @ pose[3]))
    images_of = torch.stack(x)
    radius = (X - X.mean(0)).norm(dim=-1).max()
    # A line, an ellipse, an arc, and a closed space curve.
    for chosen, closed in ((7, False), (19, True), (27, False), (36, True)):
        mine = torch.from_numpy(number == chosen)
        found = triangulate_curves(curve_from_samples(images_of[:, mine], closed=closed), torch.stack(P), samples=60)
        assert found.status == Status.OK
        gap = distance(found, X[mine], closed=closed)[found.measured]
        assert gap.mean() < 1e-3 * radius


def test_wrong_arguments(unchecked: None, generator: torch.Generator) -> None:
    P = cameras(1, 3, generator)[0]
    curve = curve_from_samples(torch.rand(3, 9, 2, dtype=F64, generator=generator))
    with pytest.raises(ValueError, match="P: wanted"):
        triangulate_curves(curve, P[:, :2])
    with pytest.raises(ValueError, match="samples"):
        triangulate_curves(curve, P, samples=2)
    with pytest.raises(ValueError, match="threshold"):
        triangulate_curves(curve, P, threshold=0.0)
