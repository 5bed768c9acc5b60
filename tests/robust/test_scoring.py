"""Scores, samplers and plane-and-parallax, seen from the doors."""

from typing import Any

import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import rotation_angle, rotation_from_rotvec
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.robust import Degeneracy, InlierCount, LeastMedian, Magsac, Msac, Scoring
from torchsfm.tensors import essential_from_fundamental, pose_from_essential

FOCAL, CENTRE = 800.0, 500.0
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=torch.float64)
SCORINGS = [Msac(), Magsac(), Magsac(2), Magsac(3), InlierCount(), LeastMedian()]


def pixels(X: Tensor) -> Tensor:
    return X[..., :2] / X[..., 2:] * FOCAL + CENTRE


def rays(x: Tensor) -> Tensor:
    return torch.cat(((x - CENTRE) / FOCAL, torch.ones_like(x[..., :1])), -1)


def scene(
    p: int, n: int, inliers: float, generator: torch.Generator, plane: float = 0.0, noise: float = 0.5
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """x1, x2, which are wrong, R, t; a share of the points in a plane."""
    kind: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(p, n, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6])
    normal = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64) / 6
    flat = torch.rand(p, n, 1, generator=generator) < plane
    X = torch.where(flat, X / (X @ normal)[..., None], X)
    R = rotation_from_rotvec((torch.rand(p, 3, **kind) - 0.5) * 0.5)
    t = torch.nn.functional.normalize(torch.randn(p, 3, **kind), dim=-1)
    x1 = pixels(X) + noise * torch.randn(p, n, 2, **kind)
    x2 = pixels(X @ R.mT + t[:, None]) + noise * torch.randn(p, n, 2, **kind)
    wrong = torch.rand(p, n, generator=generator) > inliers
    return x1, torch.where(wrong[..., None], torch.rand(p, n, 2, **kind) * 1000, x2), wrong, R, t


def pose_error(E: Tensor, x1: Tensor, x2: Tensor, wrong: Tensor, R: Tensor, t: Tensor) -> Tensor:
    pose = pose_from_essential(E, rays(x1), rays(x2), (~wrong).double()).model
    turn = rotation_angle(pose[..., :3] @ R.mT)
    return torch.rad2deg(torch.maximum(turn, torch.arccos((pose[..., 3] * t).sum(-1).clamp(-1, 1))))


# ---- scorings by themselves ----


@pytest.mark.parametrize("scoring", SCORINGS, ids=repr)
def test_scorings_rise_with_distance_and_count_weights(scoring: Scoring, generator: torch.Generator) -> None:
    assert isinstance(scoring, Scoring)
    squared = torch.rand(5, 3, 41, generator=generator, dtype=torch.float64) * 2
    limit = torch.full((5,), 1.5, dtype=torch.float64)
    cost = scoring.cost(squared.clone(), limit, None, 1)
    assert cost.shape == (5, 3)
    assert (scoring.cost(squared * 1.2, limit, None, 1) >= cost).all()
    # Data of weight 0 do not count, whatever they are.
    weight = torch.ones(5, 51, dtype=torch.float64)
    weight[:, 41:] = 0
    padded = torch.cat((squared, torch.full((5, 3, 10), 0.1, dtype=torch.float64)), -1)
    torch.testing.assert_close(scoring.cost(padded.clone(), limit, weight, 1), cost)
    squared[0, 0, 0] = torch.nan
    assert torch.isinf(scoring.cost(squared.clone(), limit, None, 1)[0, 0]) or not scoring.needs_threshold


@pytest.mark.parametrize("dof", [2, 3, 4])
def test_magsac_is_the_marginal_over_the_noise(dof: int) -> None:
    """The weight against the integral over sigma of the density of a chi-distribution, on a fine grid."""
    scoring = Magsac(dof)
    quantile = {2: 9.2103, 3: 11.3449, 4: 13.2767}[dof]
    r = torch.linspace(0.05, 0.95, 7, dtype=torch.float64)
    largest = 1 / quantile**0.5  # of sigma, for a threshold of 1
    sigma = (torch.arange(400_000, dtype=torch.float64) + 0.5) / 400_000 * largest
    # d rho / d (r^2 / 2): densities of inliers within their own quantile, evenly spread over sigma.
    density = sigma ** (-dof) * torch.exp(-(r[:, None] ** 2) / (2 * sigma**2)) * (r[:, None] < sigma * quantile**0.5)
    weight = density.mean(-1) * r ** (dof - 1)
    found = scoring.weigh(r**2, 1)
    torch.testing.assert_close(found / found[0], weight / weight[0], rtol=1e-3, atol=1e-4)
    # The loss is the integral of the weight, 1 at the threshold.
    u = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    weights = scoring.weigh(u, 1)
    integral = torch.cat((u.new_zeros(1), ((weights[1:] + weights[:-1]) / 2).cumsum(0)))
    loss = scoring.cost(u[:, None, None], torch.ones(20_001, dtype=torch.float64), None, 1)[:, 0]
    torch.testing.assert_close(loss, integral / integral[-1], rtol=1e-3, atol=1e-3)
    assert loss[-1] == pytest.approx(1)


@pytest.mark.parametrize("scoring", SCORINGS, ids=repr)
def test_every_scoring_finds_the_pose(scoring: Scoring, generator: torch.Generator) -> None:
    x1, x2, wrong, R, t = scene(16, 200, 0.7, generator)
    threshold = 1.5 if scoring.needs_threshold else None
    result = estimate_fundamental(x1, x2, threshold=threshold, scoring=scoring, generator=seeded())
    assert (result.status == Status.OK).all()
    error = pose_error(essential_from_fundamental(result.model, K, K), x1, x2, wrong, R, t)
    assert error.median() < 0.9
    assert ((result.inliers == ~wrong).double().mean(-1) > 0.93).all()
    turned = estimate_essential(
        rays(x1), rays(x2), threshold=None if threshold is None else 1.5 / FOCAL, scoring=scoring, generator=seeded()
    )
    assert pose_error(turned.model, x1, x2, wrong, R, t).median() < 0.5


def test_the_threshold_is_found_where_none_is_given(generator: torch.Generator) -> None:
    for noise in (0.2, 2.0):
        x1, x2, wrong, _, _ = scene(16, 300, 0.75, generator, plane=1.0, noise=noise)
        result = estimate_homography(x1, x2, threshold=None, generator=seeded())
        # The quantile 0.99 of a distance in two dimensions is 3.03 standard deviations; outliers raise the median by a quarter.
        assert (result.threshold / (3.03 * noise)).median().log().abs() < 0.35
        assert ((result.inliers == ~wrong).double().mean(-1) > 0.95).all()
        given = estimate_homography(x1, x2, threshold=2.5, generator=seeded())
        torch.testing.assert_close(given.threshold, torch.full_like(given.threshold, 2.5))


def test_a_threshold_that_is_wanted_must_be_given(generator: torch.Generator) -> None:
    x1, x2, *_ = scene(1, 20, 1.0, generator)
    with pytest.raises(ValueError, match="threshold: Msac wants one"):
        estimate_fundamental(x1, x2, threshold=None, scoring=Msac())
    with pytest.raises(ValueError, match="dof"):
        Magsac(7)


# ---- samplers ----


def test_trusted_data_end_the_search_early(generator: torch.Generator) -> None:
    # Of a few pairs the median of errors is chance: each search ends at its own one of several sets of inliers.
    x1, x2, wrong, R, t = scene(48, 400, 0.4, generator)
    order = torch.rand(48, 400, generator=generator, dtype=torch.float64) + 0.8 * (~wrong)
    plain = estimate_fundamental(x1, x2, threshold=1.5, generator=seeded(), max_iterations=30_000)
    guided = estimate_fundamental(x1, x2, threshold=1.5, quality=order, generator=seeded(), max_iterations=30_000)
    assert (guided.status == Status.OK).all()
    assert guided.iterations.double().mean() < 0.2 * plain.iterations.double().mean()
    errors = [pose_error(essential_from_fundamental(r.model, K, K), x1, x2, wrong, R, t) for r in (plain, guided)]
    assert errors[1].median() < 1.2 * errors[0].median() + 0.1
    # An order that means nothing costs time at most.
    lost = estimate_fundamental(x1, x2, threshold=1.5, quality=-order, generator=seeded(), max_iterations=30_000)
    assert (lost.status == Status.OK).all()


def test_a_weight_counts_as_so_many_data(generator: torch.Generator) -> None:
    """Twice the weight is twice the datum, 0 is none, and likely data are drawn more often."""
    x1, x2, *_ = scene(4, 120, 0.7, generator, plane=1.0)
    kept = torch.rand(4, 120, generator=generator) < 0.8
    masked = estimate_homography(x1, x2, threshold=1.5, mask=kept, generator=seeded())
    weighted = estimate_homography(x1, x2, threshold=1.5, weights=kept.double(), generator=seeded())
    torch.testing.assert_close(masked.model, weighted.model, rtol=1e-5, atol=1e-8)
    twice = torch.ones(4, 120, dtype=torch.float64)
    twice[:, :40] = 2
    double = [torch.cat((x, x[:, :40]), 1) for x in (x1, x2)]
    first = estimate_homography(x1, x2, threshold=1.5, weights=twice, generator=seeded())
    second = estimate_homography(*double, threshold=1.5, generator=seeded())
    torch.testing.assert_close(first.model, second.model, rtol=2e-2, atol=1e-5)
    torch.testing.assert_close(first.support, second.support, rtol=2e-2, atol=0.5)
    y1, y2, bad, _, _ = scene(4, 400, 0.35, generator)
    likely = torch.where(bad, 0.2, 1.0).double()
    plain = estimate_fundamental(y1, y2, threshold=1.5, generator=seeded(), max_iterations=30_000)
    helped = estimate_fundamental(y1, y2, threshold=1.5, weights=likely, generator=seeded(), max_iterations=30_000)
    assert (helped.status == Status.OK).all()
    assert helped.iterations.double().mean() < 0.1 * plain.iterations.double().mean()


def test_the_model_moves_with_the_weights(generator: torch.Generator) -> None:
    x1, x2, *_ = scene(3, 80, 0.8, generator, plane=1.0)
    weights = torch.rand(3, 80, generator=generator, dtype=torch.float64) + 0.5
    direction = torch.randn(3, 80, generator=generator, dtype=torch.float64)
    functional = torch.randn(3, 3, 3, generator=generator, dtype=torch.float64)

    def solve(w: Tensor) -> Tensor:
        model = estimate_homography(x1, x2, threshold=2.0, weights=w, generator=seeded()).model
        return (model * functional).sum((-2, -1))

    free = weights.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(solve(free).sum(), [free])
    step = 1e-4
    difference = (solve(weights + step * direction) - solve(weights - step * direction)) / (2 * step)
    torch.testing.assert_close((gradient * direction).sum(-1), difference, rtol=5e-3, atol=1e-9)


# ---- planes ----


def test_a_dominant_plane_does_not_win(generator: torch.Generator) -> None:
    """Nine in ten of the right matches in a plane: found through the others, and reported as good."""
    x1, x2, wrong, R, t = scene(24, 400, 0.8, generator, plane=0.9, noise=0.3)
    result = estimate_fundamental(x1, x2, threshold=1.0, generator=seeded())
    error = pose_error(essential_from_fundamental(result.model, K, K), x1, x2, wrong, R, t)
    assert_share(error < 10, 0.9)
    assert error.median() < 2
    assert_share(result.degeneracy == Degeneracy.NONE, 0.85)
    found = (result.inliers & ~wrong).sum() / (~wrong).sum()
    assert found > 0.95
