"""The soft selection: its derivatives against finite differences and against the exact expectation over all samples."""

from dataclasses import dataclass
from itertools import permutations
from typing import ClassVar

import pytest
import torch
from chance import assert_share, seeded
from scenes import make_scene
from torch import Tensor

from torchsfm._types import Solutions, Status
from torchsfm.motion import FundamentalEstimator, HomographyEstimator, RelativePoseEstimator
from torchsfm.robust import SoftSelection, Weigh, soft_ransac

F64 = torch.float64


@dataclass(frozen=True)
class Mean:
    """A number as a mean of two numbers, which may not be the same: small enough to look at all samples."""

    sample_size: ClassVar[int] = 2
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 1

    def minimal(self, x: Tensor) -> Solutions[Tensor]:
        model = (0.7 * x[..., 0, :] + 0.3 * x[..., 1, :])[..., None, :]
        return Solutions(model, torch.ones(model.shape[:-1], dtype=torch.bool))

    def squared_residual(self, model: Tensor, x: Tensor) -> Tensor:
        return (x[..., 0] - model).square()

    def degenerate(self, x: Tensor) -> Tensor:
        return x[..., 0, 0] == x[..., 1, 0]

    def step(self, model: Tensor, x: Tensor, *, weigh: Weigh) -> Tensor:
        weights, _ = weigh(self.squared_residual(model, x))
        return (weights * x[..., 0]).sum(-1, keepdim=True) / weights.sum(-1, keepdim=True)


X = torch.tensor([[0.0], [0.3], [1.0], [2.5]], dtype=F64)
LOGITS = torch.tensor([0.3, -0.5, 0.8, 0.1], dtype=F64)
SEEDS = 500
OPTIONS = {"threshold": 0.8, "temperature": 0.15, "sharpness": 3.0}


def loss_of(model: Tensor) -> Tensor:
    return (model[..., 0] - 0.4) ** 2 + model[..., 0]


def exact_expectation(logits: Tensor, hypotheses: int) -> Tensor:
    """The mean of L over all ordered samples of one or two hypotheses, written out."""
    share = logits.softmax(-1)
    pairs = list(permutations(range(4), 2))
    q = torch.stack([share[i] * share[j] / (1 - share[i]) for i, j in pairs])
    model = torch.stack([0.7 * X[i] + 0.3 * X[j] for i, j in pairs])
    ratio = (X[:, 0] - model) ** 2 / OPTIONS["threshold"] ** 2
    score = torch.sigmoid(OPTIONS["sharpness"] * (1 - ratio)).sum(-1) / (4 * OPTIONS["temperature"])
    loss = loss_of(model)
    if hypotheses == 1:
        return (q * loss).sum()
    both = torch.stack((score[:, None].expand(12, 12), score[None].expand(12, 12))).softmax(0)
    return (q[:, None] * q * (both[0] * loss[:, None] + both[1] * loss)).sum()


@pytest.mark.parametrize("hypotheses", [1, 2])
def test_the_derivative_by_logits_is_that_of_the_expectation(hypotheses: int) -> None:
    logits = LOGITS.clone().requires_grad_()
    exact = exact_expectation(logits, hypotheses)
    (slope,) = torch.autograd.grad(exact, logits)
    step = 1e-5 * torch.eye(4, dtype=F64)
    for i in range(4):
        rise = exact_expectation(LOGITS + step[i], hypotheses) - exact_expectation(LOGITS - step[i], hypotheses)
        assert abs(float(rise) / 2e-5 - float(slope[i])) < 1e-8
    generator = seeded()
    values, slopes = [], []
    for _ in range(SEEDS):
        selection = soft_ransac(Mean(), X, logits=logits, hypotheses=hypotheses, generator=generator, **OPTIONS)
        mean = selection.expectation(loss_of(selection.model))
        values.append(mean.detach())
        slopes.append(torch.autograd.grad(mean, logits)[0])
    for found, wanted in ((torch.stack(values), exact.detach()), (torch.stack(slopes), slope)):
        noise = found.std(0) / SEEDS**0.5
        assert ((found.mean(0) - wanted).abs() < 4 * noise).all()
        assert (noise < 0.15 * wanted.abs().max()).all()


def test_samples_have_the_probabilities_they_say(generator: torch.Generator) -> None:
    selection = soft_ransac(Mean(), X, logits=LOGITS, hypotheses=20_000, generator=generator, **OPTIONS)
    first, second = selection.sample.unbind(-1)
    assert (first != second).all()
    for i, j in permutations(range(4), 2):
        here = (first == i) & (second == j)
        said = selection.log_sampling[here][0].exp()
        assert abs(here.double().mean() - said) < 4 * (said / 20_000) ** 0.5
    torch.testing.assert_close(selection.probability.sum((-2, -1)), torch.tensor(1.0, dtype=F64))


@pytest.mark.parametrize("kind", [FundamentalEstimator, HomographyEstimator, RelativePoseEstimator])
def test_derivatives_by_the_data(kind: type, generator: torch.Generator) -> None:
    scene = make_scene(kind, (2,), 20, generator, 1e-3)

    def expected(*data: Tensor) -> Tensor:
        selection = soft_ransac(scene.estimator, *data, threshold=5e-3, hypotheses=4, temperature=0.1, generator=seeded(1))
        return selection.expectation(scene.error(selection.model, scene.model[:, None, None]))

    data = [d.clone().requires_grad_() for d in scene.data]
    slopes = torch.autograd.grad(expected(*data).sum(), data)
    for _ in range(3):
        step = [1e-7 * torch.randn(d.shape, dtype=F64, generator=generator) for d in data]
        ahead, behind = (expected(*(d.detach() + s * e for d, e in zip(data, step, strict=True))).sum() for s in (1, -1))
        said = sum((a * b).sum() for a, b in zip(slopes, step, strict=True))
        torch.testing.assert_close(0.5 * (ahead - behind), said, rtol=1e-3, atol=1e-11)


def test_a_problem_is_the_same_alone_and_in_a_batch(generator: torch.Generator) -> None:
    scene = make_scene(FundamentalEstimator, (3, 2), 40, generator, 1e-3)
    mask = torch.rand(3, 2, 40, generator=generator) < 0.8
    logits = torch.randn(3, 2, 40, generator=generator, dtype=F64)
    options = {"threshold": 3e-3, "hypotheses": 8}
    together = soft_ransac(scene.estimator, *scene.data, logits=logits, mask=mask, generator=seeded(5), **options)
    assert together.model.shape == (3, 2, 8, 3, 3, 4)
    assert mask[..., None, :].expand(3, 2, 8, 40).gather(-1, together.sample).all()
    for i in range(3):
        own = [d[i, 1] for d in scene.data]
        alone = soft_ransac(scene.estimator, *own, logits=logits[i, 1], mask=mask[i, 1], generator=seeded(5), **options)
        assert torch.equal(alone.sample, together.sample[i, 1])
        assert torch.equal(alone.model, together.model[i, 1])
        torch.testing.assert_close(alone.probability, together.probability[i, 1])
        assert torch.equal(alone.best(), together.best()[i, 1])
    other = soft_ransac(scene.estimator, *scene.data, logits=logits, mask=mask, generator=torch.Generator(), **options)
    assert not torch.equal(other.sample, together.sample)


def test_good_hypotheses_are_probable(generator: torch.Generator) -> None:
    scene = make_scene(HomographyEstimator, (20,), 100, generator, 1e-3)
    wrong = torch.rand(20, 100, generator=generator) < 0.4
    data = scene.spoil(scene.data, wrong, generator)
    uniform = soft_ransac(scene.estimator, *data, threshold=4e-3, generator=generator)
    told = soft_ransac(scene.estimator, *data, threshold=4e-3, logits=(~wrong).double() * 4, generator=generator)
    error = lambda s: s.expectation(scene.error(s.model, scene.model[:, None, None]))  # noqa: E731
    assert_share(scene.error(uniform.best(), scene.model) < 0.1, 0.9)
    assert error(told).median() < error(uniform).median()
    sharp = soft_ransac(scene.estimator, *data, threshold=4e-3, temperature=1e-4, generator=generator)
    assert_share(sharp.probability.amax((-2, -1)) > 0.99, 0.9)
    assert uniform.probability.amax((-2, -1)).mean() < sharp.probability.amax((-2, -1)).mean()


def test_bad_problems_leave_neighbours_alone(generator: torch.Generator) -> None:
    scene = make_scene(FundamentalEstimator, (6,), 30, generator, 1e-3)
    mask = torch.ones(6, 30, dtype=torch.bool)
    data = [d.clone() for d in scene.data]
    logits = torch.zeros(6, 30, dtype=F64)
    reference = soft_ransac(scene.estimator, *data, threshold=3e-3, logits=logits, hypotheses=4, generator=seeded(2))
    mask[1, 3:] = False
    data[0][2] = torch.nan
    data[0][3], data[1][3] = data[0][3, :1], data[1][3, :1]
    data[1][4, ::2] = torch.inf
    for t in (*data, logits):
        t.requires_grad_()
    found = soft_ransac(scene.estimator, *data, threshold=3e-3, logits=logits, mask=mask, hypotheses=4, generator=seeded(2))
    assert found.status.tolist() == [Status.OK, Status.TOO_FEW, Status.NOT_FINITE, Status.DEGENERATE, Status.OK, Status.OK]
    assert torch.equal(found.probability[[0, 5]], reference.probability[[0, 5]])
    assert (found.probability[1:4] == 0).all()
    loss = scene.error(found.model, scene.model[:, None, None])
    loss = torch.where(torch.rand(loss.shape, generator=generator) < 0.1, torch.inf, loss)
    mean = found.expectation(loss)
    assert (mean[1:4] == 0).all()
    mean.sum().backward()
    for t in (*data, logits):
        assert t.grad is not None
        assert torch.isfinite(t.grad).all()


def test_float32_and_thresholds(generator: torch.Generator) -> None:
    scene = make_scene(HomographyEstimator, (4,), 30, generator, 1e-3)
    threshold = torch.tensor([1e-3, 3e-3, 1e-2, 1e-1])
    found = soft_ransac(scene.estimator, *(d.float() for d in scene.data), threshold=threshold, generator=generator)
    assert found.probability.dtype == found.model.dtype == torch.float32
    assert (found.support.amax((-2, -1)).diff() > 0).all()


def test_wrong_arguments(unchecked: None) -> None:
    x = torch.zeros(5, 1)
    for options in ({"temperature": 0.0}, {"sharpness": -1.0}, {"hypotheses": 0}, {"logits": torch.zeros(4)}):
        with pytest.raises(ValueError, match="wanted"):
            soft_ransac(Mean(), x, threshold=1.0, **options)
    with pytest.raises(ValueError, match="sample"):
        soft_ransac(Mean(), x[:1], threshold=1.0)
    with pytest.raises(ValueError, match="data"):
        soft_ransac(Mean(), threshold=1.0)
    selection = soft_ransac(Mean(), x, threshold=1.0, hypotheses=3)
    assert isinstance(selection, SoftSelection)
    with pytest.raises(ValueError, match="loss"):
        selection.expectation(torch.zeros(4, 1))


@pytest.mark.parametrize("size", [1e30, 1e300])
def test_samples_however_unlikely_have_finite_logarithms(size: float) -> None:
    logits = (size * LOGITS).requires_grad_()
    found = soft_ransac(Mean(), X, logits=logits, generator=seeded(), **OPTIONS)
    assert torch.isfinite(found.log_sampling).all()
    found.expectation(loss_of(found.model)).backward()
    assert torch.isfinite(logits.grad).all()
