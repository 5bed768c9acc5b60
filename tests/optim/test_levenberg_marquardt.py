import dataclasses
import importlib

import numpy as np
import pytest
import torch
from chance import assert_share
from scipy.optimize import least_squares
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim import (
    Cauchy,
    GemanMcClure,
    Huber,
    RigidMotion,
    SoftL1,
    UnitSphere,
    levenberg_marquardt,
    rotation_exponential,
)

F64 = torch.float64


def decay(x: Tensor, t: Tensor, y: Tensor) -> Tensor:
    """y = a exp(-b t) + c, one component."""
    a, b, c = (x[..., i, None] for i in range(3))
    return (a * torch.exp(-b * t) + c - y)[..., None]


def decay_data(generator: torch.Generator, *batch: int, noise: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    truth = 0.5 + torch.rand((*batch, 3), generator=generator, dtype=F64) * 2
    t = torch.linspace(0, 3, 30, dtype=F64).expand(*batch, 30)
    y = decay(truth, t, torch.zeros_like(t))[..., 0] + noise * torch.randn((*batch, 30), generator=generator, dtype=F64)
    return truth, t, y


@pytest.mark.parametrize("loss", [None, SoftL1(0.1), Huber(0.1), Cauchy(0.1)])
def test_minimum_is_scipys(generator: torch.Generator, loss: object) -> None:
    _, t, y = decay_data(generator, 20)
    y[:, 4] += 1
    result = levenberg_marquardt(decay, torch.ones(20, 3, dtype=F64), t, y, loss=loss)
    assert (result.status == Status.OK).all()
    names = {"NoneType": "linear", "SoftL1": "soft_l1", "Huber": "huber", "Cauchy": "cauchy"}
    for i in range(20):
        reference = least_squares(
            lambda x, i=i: decay(torch.tensor(x), t[i], y[i])[:, 0].numpy(),
            result.x[i].numpy() if loss == Cauchy(0.1) else np.ones(3),
            loss=names[type(loss).__name__],
            f_scale=0.1 if loss else 1.0,
            xtol=1e-12,
            ftol=1e-14,
            gtol=1e-12,
        )
        np.testing.assert_allclose(result.cost[i].item(), reference.cost, rtol=1e-7)
        np.testing.assert_allclose(result.x[i].numpy(), reference.x, rtol=1e-4)


def test_batched_is_looped_and_shapes(generator: torch.Generator) -> None:
    _, t, y = decay_data(generator, 2, 3)
    start = torch.ones(2, 3, 3, dtype=F64)
    together = levenberg_marquardt(decay, start, t, y)
    assert together.x.shape == (2, 3, 3)
    assert together.status.shape == together.cost.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            alone = levenberg_marquardt(decay, start[i, j], t[i, j], y[i, j])
            assert alone.status.shape == ()
            torch.testing.assert_close(alone.x, together.x[i, j], rtol=1e-9, atol=1e-12)
    shared = levenberg_marquardt(decay, start, t[:1, :1], y)
    torch.testing.assert_close(shared.x, together.x)
    empty = levenberg_marquardt(decay, start[:0], t[:0], y[:0])
    assert empty.x.shape == (0, 3, 3)


def test_one_bad_element_changes_no_other(generator: torch.Generator) -> None:
    _, t, y = decay_data(generator, 30)
    start = torch.ones(30, 3, dtype=F64)
    clean = levenberg_marquardt(decay, start, t, y)
    dirty = y.clone()
    dirty[3, 2] = torch.nan
    dirty[17] = torch.inf
    result = levenberg_marquardt(decay, start, t, dirty)
    bad = torch.zeros(30, dtype=torch.bool)
    bad[[3, 17]] = True
    assert (result.status[bad] == Status.NOT_FINITE).all()
    assert result.x.isfinite().all()
    assert torch.equal(result.x[~bad], clean.x[~bad])
    assert torch.equal(result.cost[~bad], clean.cost[~bad])
    weights = torch.ones(30, 30, dtype=torch.bool)
    weights[3, 2] = False
    masked = levenberg_marquardt(decay, start, t, dirty, weights=weights)
    assert masked.status[3] == Status.OK
    keep = torch.arange(30) != 2
    without = levenberg_marquardt(decay, start[3], t[3][keep], y[3][keep])
    torch.testing.assert_close(masked.x[3], without.x, rtol=1e-7, atol=1e-9)


def test_status_too_few_and_iteration_limit(generator: torch.Generator) -> None:
    _, t, y = decay_data(generator, 4)
    weights = torch.ones(4, 30, dtype=torch.bool)
    weights[1, 2:] = False
    result = levenberg_marquardt(decay, torch.ones(4, 3, dtype=F64), t, y, weights=weights, max_iterations=1)
    assert result.status.tolist() == [Status.NOT_CONVERGED, Status.TOO_FEW, Status.NOT_CONVERGED, Status.NOT_CONVERGED]
    assert (result.cost <= result.initial_cost).all()


def test_given_jacobian_is_used(generator: torch.Generator) -> None:
    _, t, y = decay_data(generator, 5)

    def linearize(x: Tensor, t: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        a, b = x[..., 0, None], x[..., 1, None]
        e = torch.exp(-b * t)
        return decay(x, t, y), torch.stack((e, -a * t * e, torch.ones_like(e)), -1)[..., None, :]

    start = torch.ones(5, 3, dtype=F64)
    a = levenberg_marquardt(decay, start, t, y)
    b = levenberg_marquardt(decay, start, t, y, linearize=linearize)
    torch.testing.assert_close(a.x, b.x, rtol=1e-8, atol=1e-10)


def test_given_cost_bends_what_is_minimised(generator: torch.Generator) -> None:
    """It is asked for nothing but derivatives, which may be those of a function that only touches the cost at x."""
    _, t, y = decay_data(generator, 5)
    y, asked = y + 0.3 * torch.randn(y.shape, generator=generator, dtype=F64), 0

    def local_cost(x: Tensor, t: Tensor, y: Tensor) -> Tensor:
        nonlocal asked
        asked += 1
        return decay(x, t, y).square().sum((-1, -2)) / 2 + 7 + (x - x.detach()).pow(3).sum(-1)

    start = torch.ones(5, 3, dtype=F64)
    a = levenberg_marquardt(decay, start, t, y)
    b = levenberg_marquardt(decay, start, t, y, local_cost=local_cost)
    assert asked
    torch.testing.assert_close(a.x, b.x, rtol=1e-12, atol=1e-12)
    assert torch.equal(a.iterations, b.iterations)


def test_rigid_motion_and_dataclass_parameters(generator: torch.Generator) -> None:
    @dataclasses.dataclass(frozen=True)
    class Motion:
        rotation: Tensor
        translation: Tensor

    points = torch.randn(40, 10, 3, generator=generator, dtype=F64)
    rotation = rotation_exponential(torch.randn(40, 3, generator=generator, dtype=F64))
    translation = torch.randn(40, 3, generator=generator, dtype=F64)
    target = points @ rotation.mT + translation[:, None]

    def retract(m: Motion, delta: Tensor) -> Motion:
        turn = rotation_exponential(delta[..., :3])
        return Motion(turn @ m.rotation, m.translation + delta[..., 3:])

    start = Motion(torch.eye(3, dtype=F64).expand(40, 3, 3), torch.zeros(40, 3, dtype=F64))
    result = levenberg_marquardt(
        lambda m, p, q: p @ m.rotation.mT + m.translation[..., None, :] - q, start, points, target, retract=retract, size=6
    )
    torch.testing.assert_close(result.x.rotation, rotation, rtol=0, atol=1e-8)
    torch.testing.assert_close(result.x.translation, translation, rtol=0, atol=1e-8)

    manifold = RigidMotion()
    packed = levenberg_marquardt(
        lambda m, p, q: p @ m[..., :9].unflatten(-1, (3, 3)).mT + m[..., None, 9:] - q,
        torch.cat((start.rotation.flatten(1), start.translation), 1),
        points,
        target,
        retract=manifold.retract,
        size=manifold.tangent,
    )
    torch.testing.assert_close(packed.x[:, :9].unflatten(-1, (3, 3)), rotation, rtol=0, atol=1e-8)


def test_unseen_direction_stays(generator: torch.Generator) -> None:
    """A free scale (gauge) is held by the damping, and the minimum found all the same."""
    target = torch.randn(6, 4, generator=generator, dtype=F64)
    target = target / target.norm(dim=-1, keepdim=True)
    start = target + 0.3 * torch.randn(6, 4, generator=generator, dtype=F64)

    def residual(x: Tensor, d: Tensor) -> Tensor:
        return (x / x.norm(dim=-1, keepdim=True) - d)[..., None, :]

    result = levenberg_marquardt(residual, start, target)
    torch.testing.assert_close(result.x / result.x.norm(dim=-1, keepdim=True), target, rtol=0, atol=1e-7)
    sphere = UnitSphere(4)
    kept = levenberg_marquardt(residual, start, target, retract=sphere.retract, size=3)
    torch.testing.assert_close(kept.x.norm(dim=-1), start.norm(dim=-1))


@pytest.mark.parametrize("loss", [None, SoftL1(0.1)])
def test_derivative_of_the_minimum(generator: torch.Generator, loss: object) -> None:
    _, t, y = decay_data(generator, 2, noise=0.1)
    t, y = t[:, ::3], y[:, ::3]
    weights = 0.5 + torch.rand(2, 10, generator=generator, dtype=F64)
    start = levenberg_marquardt(decay, torch.ones(2, 3, dtype=F64), t, y, weights=weights, loss=loss).x

    def fit(t: Tensor, y: Tensor, weights: Tensor) -> Tensor:
        result = levenberg_marquardt(
            decay, start, t, y, weights=weights, loss=loss, function_tolerance=1e-25, step_tolerance=1e-12
        )
        return result.x

    inputs = tuple(v.clone().requires_grad_() for v in (t, y, weights))
    away = torch.randn(2, 3, generator=generator, dtype=F64)
    gradients = torch.autograd.grad((fit(*inputs) * away).sum(), inputs)
    for i, gradient in enumerate(gradients):
        step = 1e-5 * torch.randn(2, 10, generator=generator, dtype=F64)
        plus, minus = (fit(*(v + sign * step * (i == j) for j, v in enumerate((t, y, weights)))) for sign in (1, -1))
        numeric = ((plus - minus) * away).sum() / 2
        torch.testing.assert_close((gradient * step).sum(), numeric, rtol=1e-4, atol=1e-12)
    assert not fit(t, y, weights).requires_grad
    assert torch.equal(fit(*inputs), fit(t, y, weights))


def outlying_data(generator: torch.Generator, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Few measurements, three in ten of them wrong by about one."""
    truth, t, y = decay_data(generator, count)
    t, y = t[:, ::2], y[:, ::2]
    wrong = torch.rand(y.shape, generator=generator) < 0.3
    return truth, t, torch.where(wrong, y + torch.randn(y.shape, generator=generator, dtype=F64), y)


@pytest.mark.parametrize("loss", [Cauchy(0.1), GemanMcClure(0.2)])
def test_thirty_steps_to_the_last_digit(generator: torch.Generator, loss: object) -> None:
    """Wrong data make Gauss-Newton crawl; the last ten digits cost a few Newton steps all the same."""
    truth, t, y = outlying_data(generator, 400)
    first = levenberg_marquardt(decay, truth, t, y, loss=loss, max_iterations=200)
    rest = levenberg_marquardt(
        decay, first.x, t, y, loss=loss, max_iterations=200, function_tolerance=1e-20, step_tolerance=0.0
    )
    assert_share(first.iterations + rest.iterations <= 30, 0.97)
    # The default call promised that no more than its tolerance is left to gain.
    ok = first.status == Status.OK
    assert (rest.cost >= first.cost * (1 - 1e-9))[ok].all()


@pytest.mark.parametrize("loss", [Cauchy(0.1), GemanMcClure(0.2)])
def test_derivatives_with_wrong_data(generator: torch.Generator, loss: object) -> None:
    """Those of the default call are within 1e-3 of central differences of the minimum, or are not said to be OK and zero."""
    truth, t, y = outlying_data(generator, 50)
    away = torch.randn(3, generator=generator, dtype=F64)
    leaf = y.clone().requires_grad_()
    result = levenberg_marquardt(decay, truth, t, leaf, loss=loss)
    (gradient,) = torch.autograd.grad((result.x @ away).sum(), leaf)
    ok = result.status == Status.OK
    assert ok.sum() >= 40
    assert (gradient[~ok] == 0).all()
    step = 1e-7 * torch.randn(y.shape, generator=generator, dtype=F64)
    options = {"function_tolerance": 1e-25, "step_tolerance": 0.0, "max_iterations": 200}
    plus, minus = (
        levenberg_marquardt(decay, result.x.detach(), t, y + sign * step, loss=loss, **options).x @ away for sign in (1, -1)
    )
    # A sum of many terms may come near zero by chance.
    error = ((gradient * step).sum(-1) - (plus - minus) / 2).abs() / (gradient * step).norm(dim=-1)
    assert (error[ok] < 1e-3).all()


def test_no_derivative_where_there_is_no_minimum(generator: torch.Generator) -> None:
    _, t, y = decay_data(generator, 6)
    leaf = y.clone().requires_grad_()
    start = torch.ones(6, 3, dtype=F64)
    start[::2] = levenberg_marquardt(decay, start, t, y).x[::2]
    result = levenberg_marquardt(decay, start, t, leaf, max_iterations=2)
    assert result.status.tolist() == [Status.OK, Status.NOT_CONVERGED] * 3
    (gradient,) = torch.autograd.grad(result.x.sum(), leaf)
    assert (gradient[1::2] == 0).all()
    assert (gradient[::2] != 0).any(-1).all()


def test_statistical_efficiency(generator: torch.Generator) -> None:
    """Over many noisy problems the scatter of the estimate is the Cramer-Rao bound's."""
    truth = torch.tensor([2.0, 1.0, 0.5], dtype=F64).expand(2000, 3)
    t = torch.linspace(0, 3, 30, dtype=F64).expand(2000, 30)
    y = decay(truth, t, torch.zeros_like(t))[..., 0] + 0.02 * torch.randn(2000, 30, generator=generator, dtype=F64)
    result = levenberg_marquardt(decay, torch.ones_like(truth), t, y)
    jacobian = torch.func.jacrev(lambda x: decay(x, t[0], torch.zeros_like(t[0]))[:, 0])(truth[0])
    bound = 0.02**2 * torch.linalg.inv(jacobian.T @ jacobian)
    whitened = torch.linalg.solve(bound, (result.x - truth)[..., None])
    ratio = ((result.x - truth)[:, None] @ whitened).mean() / 3
    assert 0.9 < ratio < 1.1


def test_wrong_shapes(unchecked: None) -> None:
    with pytest.raises(ValueError, match="residual"):
        levenberg_marquardt(lambda x, t: x - t, torch.ones(4, 3), torch.ones(4, 3))
    with pytest.raises(ValueError, match="size"):
        levenberg_marquardt(lambda x: x[0][..., None], (torch.ones(4, 3),))
    with pytest.raises(ValueError, match="data: wanted batch dimensions"):
        levenberg_marquardt(lambda x, t: x[..., :1, None] - t[:, None], torch.ones(4, 3), torch.ones(7))
    with pytest.raises(ValueError, match="weights: wanted shape"):
        levenberg_marquardt(lambda x: x[..., None], torch.ones(4, 3), weights=torch.ones(4, 2, 3))
    with pytest.raises(ValueError, match="local_cost: wanted without weights"):
        levenberg_marquardt(lambda x: x[..., None], torch.ones(4, 3), weights=torch.ones(4, 3), local_cost=lambda x: x[:, 0])
    with pytest.raises(ValueError, match="weights: wanted device"):
        levenberg_marquardt(lambda x: x[..., None], torch.ones(4, 3), weights=torch.ones(4, 3, device="meta"))


def test_pieces_change_nothing(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    _, t, y = decay_data(generator, 23)
    start = torch.ones(23, 3, dtype=F64)
    whole = levenberg_marquardt(decay, start, t, y)
    monkeypatch.setattr(importlib.import_module("torchsfm.optim.levenberg_marquardt"), "PIECE", 5 * 90)
    cut = levenberg_marquardt(decay, start, t, y)
    for name in ("x", "cost", "initial_cost"):
        torch.testing.assert_close(getattr(cut, name), getattr(whole, name), rtol=1e-9, atol=1e-12)
    assert torch.equal(cut.status, whole.status)
    assert cut.iterations.shape == (23,)
