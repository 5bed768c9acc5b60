"""Distances to epipolar geometries and their derivatives, against the definitions; the sides of seven points."""

import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.geometry import cross_matrix, random_rotation
from torchsfm.motion import FundamentalEstimator, RelativePoseEstimator
from torchsfm.optim import rotation_exponential
from torchsfm.robust import constant_weights

unit = torch.nn.functional.normalize


def data(rays: bool, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Six models, the second half of them far from the first image's data, forty data, and the slack."""
    kind = {"generator": generator, "dtype": torch.float64}
    R, t = random_rotation(6, **kind), unit(torch.randn(6, 3, **kind), dim=-1)
    R = rotation_exponential(0.3 * unit(torch.randn(6, 3, **kind), dim=-1)) if rays else R
    x1, x2 = torch.rand(2, 40, 2, **kind) * 2 - 1
    if not rays:
        e = unit(torch.randn(6, 3, **kind), dim=-1)
        F = cross_matrix(e) @ torch.randn(6, 3, 3, **kind)
        return torch.cat((F / F.flatten(1).norm(dim=-1)[:, None, None], e[..., None]), -1), x1, x2, x1.new_zeros(())
    ones = torch.ones(40, 1, dtype=torch.float64)
    return torch.cat((R, t[..., None]), -1), 3 * torch.cat((x1, ones), -1), torch.cat((x2, ones), -1), x1.new_tensor(0.02)


def estimator(rays: bool, slack: Tensor) -> FundamentalEstimator | RelativePoseEstimator:
    return RelativePoseEstimator(slack) if rays else FundamentalEstimator()


def by_definition(rays: bool, model: Tensor, a: Tensor, b: Tensor, slack: Tensor) -> Tensor:
    """One datum at a time, the gradient by autograd over the coordinates or the tangents of the unit rays."""
    R, t = model[:, :3], model[:, 3]
    E = cross_matrix(t) @ R if rays else R
    result = []
    for p, q in zip(a, b, strict=True):
        if rays:
            p, q = unit(p, dim=0), unit(q, dim=0)
            bases = [torch.linalg.svd(v[None])[2][1:] for v in (p, q)]
        else:
            p, q = (torch.cat((v, v.new_ones(1))) for v in (p, q))
            bases = [torch.eye(2, 3, dtype=p.dtype)] * 2
        free = torch.zeros(2, 2, dtype=p.dtype, requires_grad=True)
        e = (q + free[1] @ bases[1]) @ E @ (p + free[0] @ bases[0])
        (g,) = torch.autograd.grad(e, free)
        if rays:
            cosine, along1, along2 = q @ R @ p, t @ R @ p, t @ q
            behind = torch.minimum(along2 * cosine - along1, along2 - along1 * cosine) < -slack
        else:
            behind = torch.linalg.cross(t, q) @ (R @ p) < 0
        result.append(torch.inf if behind else float(e.detach() ** 2 / (g * g).sum()))
    return torch.tensor(result, dtype=torch.float64)


@pytest.mark.parametrize("rays", [False, True])
def test_distances_are_those_of_the_definition(rays: bool, generator: torch.Generator) -> None:
    models, a, b, slack = data(rays, generator)
    wanted = torch.stack([by_definition(rays, model, a, b, slack) for model in models])
    assert 0.2 < torch.isfinite(wanted).double().mean() < 0.9
    alone = torch.stack([estimator(rays, slack).squared_residual(model, a, b) for model in models])
    many = estimator(rays, slack.expand(1, 1)).squared_residual(models[None], a[None, None], b[None, None])[0]
    for found in (alone, many):
        torch.testing.assert_close(found, wanted, rtol=1e-7, atol=1e-13)
    coarse = [t[None, None].float() for t in (a, b)]
    single = estimator(rays, slack.float().expand(1, 1)).squared_residual(models[None].float(), *coarse)[0].double()
    sides = torch.isfinite(single) == torch.isfinite(wanted)
    assert_share(sides, 0.99)
    assert (single >= 0).all()
    seen = sides & torch.isfinite(wanted) & (wanted > 1e-4)
    torch.testing.assert_close(single[seen], wanted[seen], rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("rays", [False, True])
def test_the_gradient_of_a_step_vanishes_where_that_of_the_sum_does(rays: bool, generator: torch.Generator) -> None:
    """A step with fixed weights goes downhill by what its gradient promises, and rests at the minimum."""
    models, a, b, slack = data(rays, generator)
    front = torch.isfinite(estimator(rays, slack.expand(1)).squared_residual(models, a[None], b[None])).sum(-1)
    model, wise = models[front.argmax()][None], estimator(rays, slack.expand(1))
    weights = torch.isfinite(wise.squared_residual(model, a[None], b[None])) * torch.rand(1, 40, generator=generator)

    def cost(model: Tensor) -> Tensor:
        squared = wise.squared_residual(model, a[None], b[None])
        return (weights * torch.where(weights > 0, squared, 0)).sum()

    # Near the minimum: data moved onto the model, and off it by little. Distances of rays are angles, whatever their lengths.
    for _ in range(50):
        free = [v.clone().requires_grad_() for v in (a, b)]
        squared = torch.where(weights > 0, wise.squared_residual(model, free[0][None], free[1][None]), 0)
        for v, g in zip((a, b), torch.autograd.grad(squared.sum(), free), strict=True):
            v -= 0.5 * g * (v.square().sum(-1, keepdim=True) if rays else 1)
    a += 1e-3 * torch.randn(a.shape, generator=generator, dtype=a.dtype)
    weights = weights * torch.isfinite(wise.squared_residual(model, a[None], b[None]))
    models = [model]
    for _ in range(100):
        models.append(wise.step(models[-1], a[None], b[None], weigh=constant_weights(weights)))
        # What comes to lie behind a camera counts no more.
        weights = weights * torch.isfinite(wise.squared_residual(models[-1], a[None], b[None]))
    model, costs = models[-1], [float(cost(m)) for m in (models[0], *models[-2:])]
    assert costs[-1] < 0.99 * costs[0]
    assert abs(costs[-1] - costs[-2]) < 1e-9 * costs[-1]
    step = torch.zeros(1, wise.dimension, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(cost(wise.retract(model, step)), step)
    assert slope.abs().max() < 1e-6 * costs[0] ** 0.5
    seen = []

    def weigh(squared: Tensor) -> tuple[Tensor, Tensor]:
        seen.append(squared)
        return weights, weights

    torch.testing.assert_close(wise.step(model, a[None], b[None], weigh=weigh), model, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(seen[0], wise.squared_residual(model, a[None], b[None]))


@pytest.mark.parametrize("forward", [False, True])
def test_seven_points_in_front_orient_their_epipole(forward: bool, generator: torch.Generator) -> None:
    """Also where the camera moves along its axis: all epipolar lines meet in the centre of the image."""
    kind = {"generator": generator, "dtype": torch.float64}
    t = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(200, 3) if forward else torch.randn(200, 3, **kind)
    t = unit(t * torch.randn(200, 1, **kind).sign(), dim=-1)
    R = (
        torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
        if forward
        else rotation_exponential(0.2 * torch.randn(200, 3, **kind))
    )
    X = torch.rand(200, 7, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6], dtype=torch.float64)
    Y = X @ R.mT + t[:, None]
    F = cross_matrix(t) @ R
    F = F / F.flatten(1).norm(dim=-1)[:, None, None]
    solutions = FundamentalEstimator().minimal(X[..., :2] / X[..., 2:], Y[..., :2] / Y[..., 2:])
    found, e = solutions.model[..., :3], solutions.model[..., 3]
    gap = torch.minimum((found - F[:, None]).abs().amax((-2, -1)), (found + F[:, None]).abs().amax((-2, -1)))
    gap = torch.where(solutions.valid, gap, torch.inf)
    best = gap.argmin(-1)
    assert_share(gap.amin(-1) < 1e-6, 0.99)
    # F1 = -F has the opposite epipole: the sign of F [t]x R decides.
    row = torch.arange(200)
    sign = (found[row, best] * F).sum((-2, -1)).sign()
    gap = (e[row, best] - sign[:, None] * t).abs().amax(-1)
    assert_share(gap < 1e-5, 0.99)


def test_seven_points_on_both_sides_orient_nothing(generator: torch.Generator) -> None:
    """One of the points is behind the first camera and in front of the second: the true F is not among the answers."""
    kind = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(200, 7, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6], dtype=torch.float64)
    X[:, 0] = torch.rand(200, 3, **kind) - torch.tensor([0.5, 0.5, 1.2], dtype=torch.float64)
    t = torch.tensor([0.3, -0.2, 1.5], dtype=torch.float64) + 0.1 * torch.randn(200, 3, **kind)
    Y = X + t[:, None]
    assert ((X[:, 0, 2] < 0) & (Y[:, 0, 2] > 0)).all()
    F = cross_matrix(t)
    F = F / F.flatten(1).norm(dim=-1)[:, None, None]
    solutions = FundamentalEstimator().minimal(X[..., :2] / X[..., 2:], Y[..., :2] / Y[..., 2:])
    gap = torch.minimum(*((solutions.model[..., :3] + s * F[:, None]).abs().amax((-2, -1)) for s in (-1, 1)))
    assert not (solutions.valid & (gap < 1e-6)).any()
    assert solutions.valid.any()
