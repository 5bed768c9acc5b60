"""The engine on lines in the plane: a model it has never heard of, in a dataclass."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm._types import Solutions, Status
from torchsfm.robust import Estimator, Weigh, constant_weights, find_structures, ransac, soft_ransac


@dataclass(frozen=True)
class Line:
    """cos(angle) x + sin(angle) y = offset."""

    angle: Tensor
    offset: Tensor


@dataclass(frozen=True)
class LineEstimator:
    scale: Tensor
    """A field per problem: distances are multiplied by it."""

    sample_size: ClassVar[int] = 2
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 1

    def minimal(self, x: Tensor) -> Solutions[Line]:
        d = x[..., 1, :] - x[..., 0, :]
        angle = torch.atan2(d[..., 0], -d[..., 1])
        offset = angle.cos() * x[..., 0, 0] + angle.sin() * x[..., 0, 1]
        return Solutions(Line(angle[..., None], offset[..., None]), (d != 0).any(-1)[..., None])

    def squared_residual(self, model: Line, x: Tensor) -> Tensor:
        distance = model.angle.cos()[..., None] * x[..., 0] + model.angle.sin()[..., None] * x[..., 1]
        return ((distance - model.offset[..., None]) * self.scale[..., None]).square()

    def degenerate(self, x: Tensor) -> Tensor:
        return (x[..., 0, :] == x[..., 1, :]).all(-1)

    def step(self, model: Line, x: Tensor, *, weigh: Weigh) -> Line:
        weights, _ = weigh(self.squared_residual(model, x))
        w = weights[..., None]
        total = w.sum(-2).clamp(min=1e-12)
        c = (w * x).sum(-2) / total
        y = x - c[..., None, :]
        xx, xy, yy = ((weights * y[..., i] * y[..., j]).sum(-1) for i, j in ((0, 0), (0, 1), (1, 1)))
        angle = 0.5 * torch.atan2(2 * xy, xx - yy) + torch.pi / 2
        return Line(angle, angle.cos() * c[..., 0] + angle.sin() * c[..., 1])


def unit(*batch: int) -> LineEstimator:
    return LineEstimator(torch.ones(batch, dtype=torch.float64))


def lines(p: int, n: int, inliers: float, generator: torch.Generator) -> tuple[Tensor, Line, Tensor]:
    """Points in [-50, 50]^2, of which some lie on a line to 0.1."""
    kind = {"generator": generator, "dtype": torch.float64}
    angle, offset = torch.rand(p, **kind) * torch.pi, torch.randn(p, **kind) * 10
    s = torch.rand(p, n, **kind) * 100 - 50
    r = offset[:, None] + 0.1 * torch.randn(p, n, **kind)
    c, d = angle.cos()[:, None], angle.sin()[:, None]
    on = torch.stack((c * r - d * s, d * r + c * s), -1)
    wrong = torch.rand(p, n, generator=generator) >= inliers
    return torch.where(wrong[..., None], torch.rand(p, n, 2, **kind) * 100 - 50, on), Line(angle, offset), wrong


def line_error(a: Line, b: Line) -> Tensor:
    turn = (a.angle - b.angle + torch.pi / 2).remainder(torch.pi) - torch.pi / 2
    same = ((a.angle - b.angle).cos() > 0).double() * 2 - 1
    return turn.abs() + (a.offset - same * b.offset).abs() / 50


def test_the_line_is_an_estimator() -> None:
    assert isinstance(unit(), Estimator)
    assert not isinstance(object(), Estimator)


@pytest.mark.parametrize("inliers", [0.9, 0.5, 0.2])
def test_lines_are_found(inliers: float, generator: torch.Generator) -> None:
    x, truth, wrong = lines(30, 400, inliers, generator)
    result = ransac(unit(30), x, threshold=0.3, generator=generator)
    assert (result.status == Status.OK).all()
    assert (line_error(result.model, truth) < 0.02).all()
    assert ((result.inliers == ~wrong).double().mean(-1) > 0.95).all()
    soft = (1 - (unit(30).squared_residual(result.model, x).sqrt() / 0.3) ** 2).clamp(min=0).sum(-1)
    torch.testing.assert_close(result.support, soft)


def test_fields_and_thresholds_belong_to_their_problem(generator: torch.Generator) -> None:
    x, truth, _ = lines(6, 300, 0.6, generator)
    scale = torch.tensor([1.0, 10.0, 100.0, 1.0, 10.0, 100.0], dtype=torch.float64)
    plain = ransac(unit(6), x, threshold=0.3, generator=seeded(1))
    scaled = ransac(LineEstimator(scale), x, threshold=0.3 * scale, generator=seeded(1))
    assert torch.equal(plain.inliers, scaled.inliers)
    assert (line_error(scaled.model, truth) < 0.02).all()


def test_batch_dimensions_broadcast(generator: torch.Generator) -> None:
    x, _, _ = lines(2, 100, 0.7, generator)
    result = ransac(unit(3, 2), x, threshold=torch.tensor([[0.2], [0.3], [0.4]], dtype=torch.float64))
    assert result.model.angle.shape == result.status.shape == (3, 2)
    assert result.inliers.shape == (3, 2, 100)
    count = result.inliers.sum(-1)
    assert (count[0] <= count[2]).all()
    single = ransac(unit(), x[0], threshold=0.3)
    assert single.model.offset.shape == single.iterations.shape == ()
    for shape in ((0,), (2, 0)):
        empty = ransac(unit(*shape), x.new_zeros(*shape, 5, 2), threshold=0.3)
        assert empty.inliers.shape == (*shape, 5)
        assert empty.model.angle.shape == shape
    nothing = ransac(unit(4), x.new_zeros(4, 0, 2), threshold=0.3)
    assert (nothing.status == Status.TOO_FEW).all()


def test_no_problem_feels_the_others(generator: torch.Generator) -> None:
    """Bit for bit, whatever the sizes of the other problems, their order and their contents."""
    x, _, _ = lines(12, 700, 0.5, generator)
    count = torch.tensor([700, 30, 64, 65, 128, 300, 512, 513, 9, 2, 3, 256])
    mask = torch.arange(700) < count[:, None]
    x[4, 3] = torch.nan
    together = ransac(unit(12), x, threshold=0.3, mask=mask, generator=seeded(7))
    order = torch.randperm(12, generator=generator)
    shuffled = ransac(unit(12), x[order], threshold=0.3, mask=mask[order], generator=seeded(7))
    assert torch.equal(shuffled.model.angle, together.model.angle[order])
    for i in range(12):
        n = int(count[i])
        alone = ransac(unit(), x[i, :n], threshold=0.3, generator=seeded(7))
        assert torch.equal(alone.model.angle, together.model.angle[i])
        assert torch.equal(alone.inliers, together.inliers[i, :n])
        assert torch.equal(alone.status, together.status[i])


def test_iterations_adapt_to_the_inliers(generator: torch.Generator) -> None:
    means = []
    for inliers in (0.9, 0.4, 0.1):
        x, _, _ = lines(8, 500, inliers, generator)
        means.append(ransac(unit(8), x, threshold=0.3, generator=generator).iterations.double().mean())
    assert means[0] == 64
    assert means[0] <= means[1] < means[2]
    x, _, _ = lines(8, 500, 0.1, generator)
    few = ransac(unit(8), x, threshold=0.3, generator=generator, max_iterations=100)
    assert (few.iterations <= 128).all()
    less = ransac(unit(8), x, threshold=0.3, generator=generator, confidence=0.5)
    assert less.iterations.double().mean() < means[2]


def test_noise_alone_is_no_consensus(generator: torch.Generator) -> None:
    for n in (10, 30, 300, 2000):
        x, _, _ = lines(20, n, 0.0, generator)
        result = ransac(unit(20), x, threshold=0.3, generator=generator, max_iterations=2000)
        assert (result.status == Status.NO_CONSENSUS).sum() >= 19


def test_trusted_data_are_found_sooner(generator: torch.Generator) -> None:
    x, truth, wrong = lines(20, 3000, 0.02, generator)
    scores = torch.where(wrong, 0.0, 1.0).double() + 0.3 * torch.randn(20, 3000, generator=generator)
    options = {"threshold": 0.3, "max_iterations": 128}
    blind = ransac(unit(20), x, generator=seeded(), **options)
    guided = ransac(unit(20), x, generator=seeded(), quality=scores, **options)
    hits = lambda r: int((line_error(r.model, truth) < 0.05).sum())  # noqa: E731
    assert hits(guided) >= 18
    assert hits(blind) <= 10


def test_refinement_ignores_what_the_threshold_lets_in(generator: torch.Generator) -> None:
    """With a threshold ten times the noise, the estimate is nearly as good as from the true inliers alone."""
    x, truth, wrong = lines(200, 300, 0.6, generator)
    result = ransac(unit(200), x, threshold=1.0, generator=generator)
    ideal = unit(200).step(truth, x, weigh=constant_weights((~wrong).double()))
    ours, best = line_error(result.model, truth), line_error(ideal, truth)
    assert (ours**2).mean().sqrt() < 1.15 * (best**2).mean().sqrt()


def test_scoring_may_be_coarser(generator: torch.Generator) -> None:
    x, truth, _ = lines(10, 300, 0.5, generator)
    result = ransac(unit(10), x, threshold=0.3, generator=generator, scoring_dtype=torch.float32)
    assert result.model.angle.dtype == torch.float64
    assert (line_error(result.model, truth) < 0.02).all()


@pytest.mark.parametrize("value", [0.0, -1.0, torch.nan, torch.inf])
def test_senseless_thresholds_are_data_failures(value: float, generator: torch.Generator) -> None:
    x, _, _ = lines(2, 50, 0.9, generator)
    result = ransac(unit(2), x, threshold=torch.tensor([0.3, value], dtype=torch.float64), generator=generator)
    assert result.status[0] == Status.OK
    assert result.status[1] != Status.OK
    assert torch.isfinite(result.model.angle).all()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"confidence": 1.0}, "confidence"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"mask": torch.ones(3, 7, dtype=torch.bool)}, "mask"),
        ({"mask": torch.ones(3, 20)}, "mask"),
        ({"quality": torch.ones(3, 19, dtype=torch.float64)}, "quality"),
        ({"threshold": torch.ones(2, dtype=torch.float64)}, "batch"),
    ],
)
def test_wrong_arguments_raise(change: dict[str, object], message: str) -> None:
    x = torch.rand(3, 20, 2, dtype=torch.float64)
    options: dict[str, object] = {"threshold": 0.3, **change}
    with pytest.raises(ValueError, match=message):
        ransac(unit(3), x, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="data"):
        ransac(unit(3), threshold=1.0)
    with pytest.raises(ValueError, match="data"):
        ransac(replace(unit(3)), x, x[:, :5], threshold=1.0)


@pytest.mark.usefixtures("unchecked")
def test_an_incomplete_estimator_is_refused_with_all_that_it_lacks(generator: torch.Generator) -> None:
    class Half:
        sample_size = 2

        def minimal(self, x: Tensor) -> Solutions[Tensor]:
            raise AssertionError

    x = torch.rand(20, 2, generator=generator)
    for door in (ransac, soft_ransac, find_structures):
        with pytest.raises(ValueError, match="Half lacks max_solutions, codimension, degenerate, squared_residual, step"):
            door(Half(), x, threshold=0.1)  # type: ignore[operator]
        with pytest.raises(ValueError, match="estimator: wanted an object, got the class LineEstimator"):
            door(LineEstimator, x, threshold=0.1)  # type: ignore[operator]
