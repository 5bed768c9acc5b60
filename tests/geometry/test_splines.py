"""Cubic B-splines: against SciPy, exact where curves are splines, laws of affine maps, and what has no spline."""

import itertools
import math

import pytest
import torch

from torchsfm.geometry import Curve, Spline, curve_from_samples, fit_spline

F64 = torch.float64


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("k", [4, 5, 17])
def test_points_are_those_of_scipy(k: int, closed: bool, generator: torch.Generator) -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    control, t = (torch.randn(k, 3, generator=generator, dtype=F64), torch.rand(50, generator=generator, dtype=F64))
    spline = Spline(control, closed)
    whole = torch.cat((control, control[:3])) if closed else control
    expected = interpolate.BSpline(spline.knots().numpy(), whole.numpy(), 3)(t.numpy())
    torch.testing.assert_close(spline.at(t), torch.from_numpy(expected))
    ends = spline.at(torch.tensor([0.0, 1.0], dtype=F64))
    torch.testing.assert_close(ends, ends[:1].expand(2, 3) if closed else control[[0, -1]])
    weights = spline.weights(t)
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(t))


@pytest.mark.parametrize("closed", [True, False])
def test_a_fit_improves_with_control_points(closed: bool, generator: torch.Generator) -> None:
    t = torch.arange(300, dtype=F64) * (2 * math.pi / 300) * (1.0 if closed else 0.7)
    a = torch.randn(2, 3, 2, 3, generator=generator, dtype=F64) / torch.tensor([1.0, 4.0, 9.0], dtype=F64)[:, None, None]
    waves = torch.stack([torch.stack(((k * t).cos(), (k * t).sin())) for k in (1, 2, 3)])
    curve = curve_from_samples(torch.einsum("bkcd,kcn->bnd", a, waves), closed=closed)
    gaps = [fit_spline(curve, k, closed=closed)[1].amax(-1) for k in (8, 16, 32, 64)]
    size = curve.length
    assert (gaps[-1] < 3e-3 * size).all()
    assert all((after < 1.1 * before + 1e-4 * size).all() for before, after in itertools.pairwise(gaps))
    # A moved and scaled curve has the moved and scaled spline.
    spline, _ = fit_spline(curve, 16, closed=closed)
    shift = 1e3 * torch.randn(3, generator=generator, dtype=F64)
    other, _ = fit_spline(Curve(5 * curve.x + shift, curve.valid, curve.closed), 16, closed=closed)
    torch.testing.assert_close(other.control, 5 * spline.control + shift, rtol=1e-9, atol=1e-6)


def test_straight_samples_give_a_straight_spline_and_batches_are_loops(generator: torch.Generator) -> None:
    ends = torch.randn(2, 2, 1, 3, generator=generator, dtype=F64)
    x = ends[0] + torch.rand(2, 30, 1, generator=generator, dtype=F64).sort(1).values * (ends[1] - ends[0])
    valid = torch.arange(30) < torch.tensor([30, 12])[:, None]
    curve = curve_from_samples(x, valid=valid)
    spline, gap = fit_spline(curve, 6)
    # What holds a spline together where it has few samples hardly shows, and never beside the line.
    assert (gap.amax(-1) < 1e-4 * curve.length).all()
    d = torch.nn.functional.normalize(ends[1] - ends[0], dim=-1)
    away = spline.control - ends[0]
    assert (away - (away * d).sum(-1, keepdim=True) * d).abs().max() < 1e-9
    for i in range(2):
        alone, _ = fit_spline(Curve(curve.x[i], curve.valid[i], curve.closed[i]), 6)
        torch.testing.assert_close(alone.control, spline.control[i], rtol=1e-9, atol=1e-12)


def test_what_has_no_spline(generator: torch.Generator) -> None:
    x = torch.randn(4, 10, 3, generator=generator, dtype=F64)
    x[1] = 2.0
    x[2, 3] = torch.nan
    valid = torch.ones(4, 10, dtype=torch.bool)
    valid[3] = False
    spline, gap = fit_spline(Curve(x, valid, torch.zeros(4, dtype=torch.bool)), 5)
    assert torch.isfinite(spline.control).all()
    assert torch.isinf(gap).all(-1).tolist() == [False, True, True, True]
    alone, _ = fit_spline(Curve(x[0], valid[0], torch.tensor(False)), 5)
    torch.testing.assert_close(alone.control, spline.control[0], rtol=1e-9, atol=1e-12)


def test_wrong_arguments(unchecked: None) -> None:
    curve = curve_from_samples(torch.rand(9, 3, dtype=F64))
    with pytest.raises(ValueError, match="controls"):
        fit_spline(curve, 3)
    with pytest.raises(ValueError, match="closed"):
        fit_spline(curve, 4, closed=1)  # type: ignore[arg-type]
