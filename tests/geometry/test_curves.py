"""Curves: the smooth curve through samples, nearest points, crossings with lines, laws, gaps and bad samples."""

import math

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import Curve, curve_crossings, curve_from_samples, foot_points
from torchsfm.geometry.curve_places import curve_places

F64 = torch.float64


def ellipse(n: int, share: float = 1.0) -> Tensor:
    t = share * 2 * math.pi * torch.arange(n, dtype=F64) / n
    return torch.stack((t.cos(), 0.5 * t.sin()), -1)


def off(x: Tensor) -> Tensor:
    """How far from that ellipse, to first order."""
    F = x[..., 0] ** 2 + 4 * x[..., 1] ** 2 - 1
    return F.abs() / (2 * torch.stack((x[..., 0], 4 * x[..., 1]), -1).norm(dim=-1))


def test_the_cubic_is_of_third_order(generator: torch.Generator) -> None:
    y = 2 * torch.randn(400, 2, dtype=F64, generator=generator)
    error = []
    for n in (32, 64, 128):
        curve = curve_from_samples(ellipse(n), closed=True)
        foot = foot_points(curve, y)
        assert foot.within.all()
        error.append(off(foot.x).max())
        assert off(curve.resample(77).x).max() < 2 * error[-1]
    assert error[0] > 6 * error[1] > 36 * error[2]
    assert error[2] < 1e-5


def test_feet_are_the_nearest_points(generator: torch.Generator) -> None:
    t = torch.arange(40, dtype=F64) * (2 * math.pi / 40)
    waves = torch.stack([f(k * t) for k in (1, 2, 3) for f in (torch.cos, torch.sin)], -1)
    x = waves @ (torch.randn(3, 2, 6, 3, dtype=F64, generator=generator) / torch.tensor([1, 1, 3, 3, 6, 6.0])[:, None])
    y = 2 * torch.randn(3, 2, 50, 3, dtype=F64, generator=generator)
    curve = curve_from_samples(x, closed=torch.tensor([True, False]).expand(3, 2))
    foot = foot_points(curve, y)
    gap = y - foot.x
    across = (gap * foot.tangent).sum(-1).abs() / gap.norm(dim=-1)
    # At a sample two cubics meet; at an open end the curve ends.
    at_sample = (foot.x[..., None, :] - x[..., None, :, :]).norm(dim=-1).amin(-1) < 1e-9
    assert (across[~at_sample & foot.within] < 1e-6).float().mean() > 0.97
    dense = curve.resample(4000).x
    nearest = (y[..., None, :] - dense[..., None, :, :]).norm(dim=-1).amin(-1)
    assert (gap.norm(dim=-1) < nearest + 1e-3).float().mean() > 0.97
    assert foot.within[:, 0].all()
    ends = ((foot.x - x[..., :1, :]).norm(dim=-1) < 1e-12) | ((foot.x - x[..., -1:, :]).norm(dim=-1) < 1e-12)
    assert (ends | foot.within)[:, 1].all()
    alone = foot_points(Curve(curve.x[1, 1], curve.valid[1, 1], curve.closed[1, 1]), y[1, 1])
    torch.testing.assert_close(alone.x, foot.x[1, 1])


def test_derivatives_of_feet_across_the_curve(generator: torch.Generator) -> None:
    x = ellipse(24).requires_grad_()
    y = 2 * torch.randn(9, 2, dtype=F64, generator=generator)
    d = torch.randn(24, 2, dtype=F64, generator=generator)

    def distances(x: Tensor) -> Tensor:
        foot = foot_points(curve_from_samples(x, closed=True), y)
        normal = torch.stack((-foot.tangent[..., 1], foot.tangent[..., 0]), -1)
        return ((y - foot.x) * normal).sum(-1)

    slope = torch.stack([(torch.autograd.grad(r, x, retain_graph=True)[0] * d).sum() for r in distances(x)])
    h = 1e-6
    difference = (distances(x + h * d) - distances(x - h * d)) / (2 * h)
    # Where the foot is at a sample, two cubics meet.
    assert ((slope - difference).abs() < 1e-5).float().mean() > 0.8


def test_open_ends() -> None:
    half = curve_from_samples(ellipse(65, 64 / 65 * 0.5 * 65 / 64))
    y = torch.tensor([[1.0, -0.5], [0.0, 2.0], [3.0, 0.3]], dtype=F64)
    assert foot_points(half, y).within.tolist() == [False, True, True]
    assert foot_points(curve_from_samples(ellipse(64), closed=True), y).within.all()


def test_crossings_of_lines(generator: torch.Generator) -> None:
    curve = curve_from_samples(ellipse(256), closed=True)
    angle = 2 * math.pi * torch.rand(100, dtype=F64, generator=generator)
    away = 1.3 * torch.rand(100, dtype=F64, generator=generator) - 0.65
    normal = torch.stack((angle.cos(), angle.sin()), -1)
    found = curve_crossings(curve, 7 * torch.cat((normal, -away[:, None]), -1), 3)
    reach = (normal[:, 0] ** 2 + 0.25 * normal[:, 1] ** 2).sqrt()
    clear = (away.abs() - reach).abs() > 1e-3
    assert (found.valid.sum(-1) == torch.where(away.abs() < reach, 2, 0))[clear].all()
    x = found.x[found.valid]
    assert off(x).max() < 3e-4
    on = ((found.x * normal[:, None]).sum(-1) - away[:, None])[found.valid]
    assert on.abs().max() < 1e-12
    tangent = torch.stack((-4 * x[:, 1], x[:, 0]), -1)
    sine = (tangent * normal[:, None].expand_as(found.x)[found.valid]).sum(-1).abs() / tangent.norm(dim=-1)
    assert (found.sine[found.valid] - sine).abs().max() < 0.05
    assert (found.x[~found.valid] == 0).all()


def test_resampling_reversal_and_length() -> None:
    closed, open_ = curve_from_samples(ellipse(200), closed=True), curve_from_samples(ellipse(100, 0.5))
    spacing = (closed.resample(50).x - closed.resample(50).x.roll(-1, 0)).norm(dim=-1)
    assert (spacing.max() - spacing.min()) < 1e-2 * spacing.mean()
    assert (open_.resample(9).x[[0, -1]] - open_.x[[0, -1]]).abs().max() < 1e-12
    for curve in (closed, open_):
        back = curve.reversed()
        torch.testing.assert_close(back.length, curve.length)
        torch.testing.assert_close(back.reversed().x, curve.x)
        inner = slice(1, -1)
        torch.testing.assert_close(back.reversed().tangents()[inner], -_flipped(back)[inner])
    assert (closed.reversed().x[0] == closed.x[0]).all()
    assert (closed.length - 4.844224).abs() < 1e-3


def _flipped(curve: Curve) -> Tensor:
    """Tangents of a curve in the order of its reverse."""
    index = torch.arange(len(curve.x))
    index = (len(index) - index) % len(index) if curve.closed else len(index) - 1 - index
    return curve.tangents()[index]


def test_samples_that_are_none() -> None:
    x = ellipse(20).repeat(4, 1, 1)
    x[0, 3] = torch.nan
    x[1, 5] = x[1, 4]
    valid = torch.ones(4, 20, dtype=torch.bool)
    valid[2, 10:] = False
    valid[3, 1:] = False
    curve = curve_from_samples(x, valid=valid, closed=True)
    assert curve.number.tolist() == [19, 19, 10, 1]
    assert torch.isfinite(curve.x).all()
    foot = foot_points(curve, torch.zeros(3, 2, dtype=F64))
    assert foot.within.any(-1).tolist() == [True, True, True, False]
    assert torch.isfinite(foot.x).all()
    assert curve.resample(5).number.tolist() == [5, 5, 5, 0]
    broken = Curve(x, torch.ones_like(valid), torch.zeros(4, dtype=torch.bool))
    assert foot_points(broken, torch.zeros(1, 2, dtype=F64)).within.any(-1).tolist() == [False, True, True, True]


def test_wrong_arguments(unchecked: None) -> None:
    curve = curve_from_samples(ellipse(8))
    with pytest.raises(ValueError, match="closed"):
        curve_from_samples(ellipse(8), closed="no")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="y: wanted"):
        foot_points(curve, torch.zeros(3, 3, dtype=F64))
    with pytest.raises(ValueError, match="line: wanted"):
        curve_crossings(curve, torch.zeros(3, 2, dtype=F64), 2)
    with pytest.raises(ValueError, match="most"):
        curve_crossings(curve, torch.zeros(3, 3, dtype=F64), 0)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_slopes_of_exact_samples_are_of_fourth_order(share: float) -> None:
    """Closed curves, and open ones up to their ends."""
    error = []
    for n in (64, 128, 256):
        places = curve_places(curve_from_samples(ellipse(n, share), closed=share == 1))
        finer = places.through_exact_samples()
        at = places.spread(1000)
        error.append(float(off(finer.at(at)[0]).max()))
        assert error[-1] < float(off(places.at(at)[0]).max()) / 2
    assert error[0] > 10 * error[1] > 100 * error[2]
    few = curve_places(curve_from_samples(ellipse(4), closed=True))
    torch.testing.assert_close(few.through_exact_samples().segments.slope, few.segments.slope)
