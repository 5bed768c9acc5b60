"""Fits of ellipses: exact, at the Cramer-Rao bound, honest about short arcs, and the laws of every door."""

import math

import pytest
import torch
from chance import assert_share, assert_unit_variance
from scipy.stats import chi2
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Ellipse, ellipse_distance
from torchsfm.images import EllipseFit, fit_ellipse

F64 = torch.float64


def ellipses(*batch: int, generator: torch.Generator) -> Ellipse:
    size = 40 + 60 * torch.rand(batch, generator=generator, dtype=F64)
    ratio = 0.3 + 0.6 * torch.rand(batch, generator=generator, dtype=F64)
    angle = math.pi * (torch.rand(batch, generator=generator, dtype=F64) - 0.5)
    centre = 200 + 100 * torch.randn(*batch, 2, generator=generator, dtype=F64)
    return Ellipse(centre, torch.stack((size, ratio * size), -1), angle)


def along(arc: float, n: int, generator: torch.Generator, *batch: int) -> Tensor:
    """Parameters evenly along an arc that begins anywhere."""
    start = 2 * math.pi * torch.rand(*batch, 1, generator=generator, dtype=F64)
    return start + math.radians(arc) * torch.arange(n, dtype=F64) / (n if arc == 360 else n - 1)


def parameters(e: Ellipse) -> Tensor:
    return torch.cat((e.centre, e.semi_axes, e.angle[..., None]), -1)


def same(a: EllipseFit, b: EllipseFit, tolerance: float) -> None:
    torch.testing.assert_close(parameters(a.model), parameters(b.model), rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(a.covariance, b.covariance, rtol=100 * tolerance, atol=tolerance)
    assert torch.equal(a.status, b.status)


@pytest.mark.parametrize("arc", [360, 180, 60])
def test_exact_points_give_their_ellipse(arc, generator):
    ellipse = ellipses(300, generator=generator)
    found = fit_ellipse(ellipse.points(along(arc, 12, generator, 300)))
    error = (parameters(found.model) - parameters(ellipse)).abs()
    error[:, 4] = torch.minimum(error[:, 4], (error[:, 4] - math.pi).abs())
    assert_share(error.amax(-1) < 1e-6, 0.999)
    assert_share(found.status == Status.OK, 0.999)
    assert (found.error < 1e-8).all()


@pytest.mark.parametrize(("arc", "limit"), [(360, 1.05), (180, 1.05), (120, 1.1)])
def test_noise_is_spread_no_farther_than_it_must(arc, limit, generator):
    """Ellipses of 100 by 50 pixels, 100 points, 0.5 pixels: root mean square error and bias against the Cramer-Rao bound."""
    trials, sigma = 1500, 0.5
    one = lambda *v: torch.tensor(v, dtype=F64)  # noqa: E731
    ellipse = Ellipse(one(320.0, 240.0), one(100.0, 50.0), one(0.4)[0])
    t = along(arc, 100, generator)
    bound = sigma * fit_ellipse(ellipse.points(t)).covariance.diagonal().sqrt()
    if arc == 120:  # a side of the ellipse, not its end: the scatter is that of CURVES' table
        t = t - t[0] + math.radians(30)
        bound = sigma * fit_ellipse(ellipse.points(t)).covariance.diagonal().sqrt()
    x = ellipse.points(t) + sigma * torch.randn(trials, 100, 2, generator=generator, dtype=F64)
    found = fit_ellipse(x)
    assert_share(found.status == Status.OK, 0.995)
    good = found.status == Status.OK
    score = (parameters(found.model)[good] - parameters(ellipse)) / bound
    score[:, 4] = (score[:, 4] * bound[4] + math.pi / 2).remainder(math.pi).sub(math.pi / 2) / bound[4]
    few = 4 * (2 / trials) ** 0.5
    assert (score.square().mean(0).sqrt() < limit * (1 + few)).all(), score.square().mean(0).sqrt()
    if arc >= 180:
        assert (score.mean(0).abs() < 0.1 + 5 / trials**0.5).all(), score.mean(0)


def test_covariances_are_what_errors_have(generator):
    trials, sigma = 3000, 0.2
    ellipse = ellipses(trials, generator=generator)
    t = along(360, 40, generator, trials)
    x = ellipse.points(t) + sigma * torch.randn(trials, 40, 2, generator=generator, dtype=F64)
    found = fit_ellipse(x, weights=torch.full((40,), sigma**-2, dtype=F64))
    error = parameters(found.model) - parameters(ellipse)
    error[:, 4] = (error[:, 4] + math.pi / 2).remainder(math.pi) - math.pi / 2
    square = (error * torch.linalg.solve(found.covariance, error)).sum(-1)
    # To first order chi-square with five degrees of freedom.
    total = float(square.sum())
    assert chi2(5 * trials).cdf(total / 1.03) < 1 - 1e-6
    assert chi2(5 * trials).cdf(total * 1.03) > 1e-6


def test_residuals_are_as_large_as_the_noise(generator):
    ellipse = ellipses(200, generator=generator)
    x = ellipse.points(along(360, 50, generator, 200)) + 0.3 * torch.randn(200, 50, 2, generator=generator, dtype=F64)
    found = fit_ellipse(x)
    torch.testing.assert_close(found.error, ellipse_distance(found.model, x).square().mean(-1).sqrt(), rtol=1e-9, atol=0)
    # Each fit takes up five of its fifty.
    assert_unit_variance(found.error / 0.3 * 50**0.5, lost=5 * 200 - 49 * 200)


@pytest.mark.parametrize("arc", [45, 30, 15])
def test_arcs_that_are_too_short_are_told(arc, generator):
    ellipse = Ellipse(*(torch.tensor(v, dtype=F64) for v in ([320.0, 240.0], [100.0, 50.0], 0.4)))
    x = ellipse.points(along(arc, 60, generator, 100)) + 0.5 * torch.randn(100, 60, 2, generator=generator, dtype=F64)
    found = fit_ellipse(x)
    wrong = ((found.model.semi_axes / ellipse.semi_axes - 1).abs() > 0.5).any(-1)
    assert wrong.double().mean() > 0.3
    assert_share(~(wrong & (found.status == Status.OK)), 0.95)
    assert_share(found.status != Status.OK, 0.9)


def test_bad_points_are_told_and_change_no_others(generator):
    ellipse = ellipses(8, generator=generator)
    x = ellipse.points(along(360, 10, generator, 8)) + 0.3 * torch.randn(8, 10, 2, generator=generator, dtype=F64)
    bad = x.clone()
    bad[0, 3, 0] = math.nan
    bad[1] = x[1, :1]
    bad[2] = x[2, :1] + torch.arange(10, dtype=F64)[:, None] * torch.tensor([1.0, 0.3], dtype=F64)
    bad[3, 0] = math.inf
    bad[4, 5:] = math.nan
    mask = torch.ones(8, 10, dtype=torch.bool)
    mask[4, 4:] = False
    mask[5] = False
    found = fit_ellipse(bad, mask=mask)
    assert found.status[:6].tolist() == [
        Status.NOT_FINITE, Status.DEGENERATE, Status.DEGENERATE, Status.NOT_FINITE, Status.TOO_FEW, Status.TOO_FEW
    ]  # fmt: skip
    assert all(v.isfinite().all() for v in (parameters(found.model), found.covariance, found.error))
    alone = fit_ellipse(x)
    assert torch.equal(found.model.centre[6:], alone.model.centre[6:])
    assert torch.equal(found.status[6:], alone.status[6:])


def test_points_left_out_do_not_count(generator):
    ellipse = ellipses(5, generator=generator)
    x = ellipse.points(along(300, 20, generator, 5)) + 0.2 * torch.randn(5, 20, 2, generator=generator, dtype=F64)
    mask = torch.rand(5, 20, generator=generator) < 0.7
    mask[:, :8] = True
    spoiled = torch.where(mask[..., None], x, math.nan)
    found = fit_ellipse(spoiled, mask=mask)
    same(found, fit_ellipse(x, weights=mask.double()), 1e-9)
    for i in range(5):
        alone = fit_ellipse(x[i, mask[i]])
        torch.testing.assert_close(parameters(found.model)[i], parameters(alone.model), rtol=1e-7, atol=1e-7)


def test_images_of_points_have_images_of_ellipses(generator):
    """A similarity of the image, the order of the points, and a factor of the weights change nothing but units."""
    ellipse = ellipses(20, generator=generator)
    x = ellipse.points(along(250, 30, generator, 20)) + 0.3 * torch.randn(20, 30, 2, generator=generator, dtype=F64)
    found = fit_ellipse(x)
    order = torch.randperm(30, generator=generator)
    torch.testing.assert_close(parameters(fit_ellipse(x[:, order]).model), parameters(found.model), rtol=1e-6, atol=1e-6)
    moved = fit_ellipse(7 * x.flip(-1) - 50, weights=torch.tensor([3.0], dtype=F64).expand(30))
    torch.testing.assert_close(moved.model.centre, 7 * found.model.centre.flip(-1) - 50, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(moved.model.semi_axes, 7 * found.model.semi_axes, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(moved.error, 7 * found.error, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(moved.covariance[:, 2:4, 2:4], found.covariance[:, 2:4, 2:4] / 3, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_batches_are_loops(batch, generator):
    ellipse = ellipses(*batch, generator=generator)
    x = ellipse.points(along(300, 9, generator, *batch)) + 0.3 * torch.randn(*batch, 9, 2, generator=generator, dtype=F64)
    found = fit_ellipse(x)
    assert found.status.shape == batch
    assert found.model.centre.shape == (*batch, 2)
    assert found.covariance.shape == (*batch, 5, 5)
    for one, p in zip(x.reshape(-1, 9, 2), parameters(found.model).reshape(-1, 5), strict=True):
        torch.testing.assert_close(parameters(fit_ellipse(one).model), p, rtol=1e-7, atol=1e-7)


def test_derivatives_are_those_of_the_optimum(generator):
    ellipse = ellipses(2, generator=generator)
    x = ellipse.points(along(300, 6, generator, 2)) + 1.0 * torch.randn(2, 6, 2, generator=generator, dtype=F64)
    w = 0.5 + torch.rand(2, 6, generator=generator, dtype=F64)
    direction = [torch.randn(v.shape, generator=generator, dtype=F64) for v in (x, w)]
    inputs = x.requires_grad_(), w.requires_grad_()
    found = fit_ellipse(x, weights=w)
    assert (found.status == Status.OK).all()
    weigh = torch.randn(2, 5, generator=generator, dtype=F64)
    slopes = torch.autograd.grad((parameters(found.model) * weigh).sum(), inputs)
    along_direction = sum((s * d).sum((-1, -2) if s.ndim == 3 else -1) for s, d in zip(slopes, direction, strict=True))
    step = 1e-4
    with torch.no_grad():
        ends = [
            fit_ellipse(x + k * step * direction[0], weights=w + k * step * direction[1], max_iterations=200) for k in (1, -1)
        ]
    difference = (parameters(ends[0].model) - parameters(ends[1].model)) / (2 * step)
    torch.testing.assert_close(along_direction, (difference * weigh).sum(-1), rtol=1e-3, atol=1e-4)


def test_single_precision_comes_back_single(generator):
    x = ellipses(generator=generator).points(along(360, 20, generator))
    found = fit_ellipse(x.float())
    assert found.model.centre.dtype == found.covariance.dtype == torch.float32
    torch.testing.assert_close(parameters(found.model).double(), parameters(fit_ellipse(x).model), rtol=1e-4, atol=1e-3)
