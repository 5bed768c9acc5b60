"""The one descent: batches of any shape, their ends, and what stops them from outside."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim.dense import DenseSystem, dense_system, passable
from torchsfm.optim.descent import Options, descend
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, pick

F64 = torch.float64
OPTIONS = Options(200, 1e-12)


@dataclass(frozen=True)
class Valleys(Problem[DenseSystem]):
    """Rosenbrock's valleys (*batch) of their own steepness: (steepness (y - x^2), 1 - x), whose minimum is 0 at (1, 1)."""

    steepness: Tensor

    def pick(self, at: Places) -> "Valleys":
        return Valleys(pick(at, self.steepness))

    def linearize(self, x: Tensor) -> DenseSystem:
        u, v = x.unbind(-1)
        r = torch.stack((self.steepness * (v - u * u), 1 - u), -1)
        zero, one = torch.zeros_like(u), torch.ones_like(u)
        J = torch.stack((-2 * self.steepness * u, self.steepness, -one, zero), -1).unflatten(-1, (2, 2))
        return dense_system(x, r.square().sum(-1) / 2, (J.mT @ r[..., None])[..., 0], J.mT @ J)

    def advance(self, here: DenseSystem, step: Step) -> DenseSystem:
        return passable(self.linearize(here.x + step.delta))

    def rounding(self, here: DenseSystem) -> Tensor:
        return torch.zeros_like(here.cost)


def starts(generator: torch.Generator, *batch: int) -> tuple[Valleys, Tensor]:
    steepness = 1 + 30 * torch.rand(batch, generator=generator, dtype=F64)
    return Valleys(steepness), torch.randn(*batch, 2, generator=generator, dtype=F64)


def test_a_batch_of_any_shape_is_its_elements_one_by_one(generator: torch.Generator) -> None:
    problem, x = starts(generator, 3, 4)
    together = descend(problem, x, OPTIONS)
    assert (together.status == Status.OK).all()
    torch.testing.assert_close(together.x, torch.ones_like(x), rtol=0, atol=1e-5)
    flat = descend(Valleys(problem.steepness.flatten()), x.flatten(0, 1), OPTIONS)
    for name in ("x", "cost", "initial_cost", "iterations", "status"):
        assert torch.equal(getattr(flat, name), getattr(together, name).flatten(0, 1)), name
    # As many as differ leave the batch at different times; none of them notices.
    assert together.iterations.unique().numel() > 1
    for i in range(3):
        for j in range(4):
            alone = descend(Valleys(problem.steepness[i, j]), x[i, j], OPTIONS)
            assert alone.status.shape == ()
            torch.testing.assert_close(alone.x, together.x[i, j], rtol=0, atol=1e-5)
    assert descend(Valleys(problem.steepness[:0]), x[:0], OPTIONS).x.shape == (0, 4, 2)


def test_every_end_has_its_status(generator: torch.Generator) -> None:
    """At the minimum, without data, without numbers, and with too few steps; neighbours keep every bit."""
    problem, x = starts(generator, 6)
    x[1] = 1.0
    clean = descend(problem, x, OPTIONS)
    x[2], x[3] = torch.nan, torch.inf
    enough = torch.arange(6) != 4
    found = descend(problem, x, OPTIONS, enough=enough)
    wanted = [Status.OK, Status.OK, Status.NOT_FINITE, Status.NOT_FINITE, Status.TOO_FEW, Status.OK]
    assert found.status.tolist() == wanted
    assert found.iterations[1:5].tolist() == [0] * 4
    assert torch.equal(found.x[4], x[4])
    for good in (0, 1, 5):
        assert torch.equal(found.x[good], clean.x[good])
    short = descend(problem, x, replace(OPTIONS, max_iterations=1))
    assert short.status[[0, 5]].tolist() == [Status.NOT_CONVERGED] * 2
    assert (short.cost <= short.initial_cost)[[0, 5]].all()


@dataclass(frozen=True)
class Claims(Problem[DenseSystem]):
    """A cost that never changes, though at 0 its gradient says that it does."""

    cost: Tensor
    least: float

    def pick(self, at: Places) -> "Claims":
        return replace(self, cost=pick(at, self.cost))

    def linearize(self, x: Tensor) -> DenseSystem:
        one = torch.ones_like(x)
        return dense_system(x, self.cost, torch.where(x == 0, one, -one), one[..., None])

    def advance(self, here: DenseSystem, step: Step) -> DenseSystem:
        return self.linearize(here.x + step.delta)

    def rounding(self, here: DenseSystem) -> Tensor:
        return torch.full_like(here.cost, self.least)


def test_no_step_gains_and_more_is_promised() -> None:
    cost = torch.tensor([2.0, 3.0, 1e-9], dtype=F64)
    found = descend(Claims(cost, 1e-6), torch.zeros(3, 1, dtype=F64), OPTIONS)
    # Of the last one no more than all of its cost can be left to gain, and that is nothing.
    assert found.status.tolist() == [Status.NOT_CONVERGED, Status.NOT_CONVERGED, Status.OK]
    assert (found.x == 0).all()


def test_progress_is_told_of_all_elements(generator: torch.Generator) -> None:
    """Of those that ended too; costs never rise, and False ends the descent where it is."""
    problem, x = starts(generator, 9)
    costs: list[Tensor] = []
    whole = descend(problem, x, replace(OPTIONS, progress=lambda _, cost: costs.append(cost)))
    told = torch.stack([whole.initial_cost, *costs])
    assert (told.diff(dim=0) <= 0).all()
    assert torch.equal(told[-1], whole.cost)
    assert len(costs) == whole.iterations.max()
    cut = descend(problem, x, replace(OPTIONS, progress=lambda k, _: k < 2))
    assert (cut.status[whole.iterations > 2] == Status.INTERRUPTED).all()
    assert torch.equal(cut.cost, told[2])


def test_interrupts(generator: torch.Generator) -> None:
    """They go through, unless the best so far was asked for."""
    problem, x = starts(generator, 4)

    def stop(iteration: int, cost: Tensor) -> None:
        if iteration == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        descend(problem, x, replace(OPTIONS, progress=stop))
    found = descend(problem, x, replace(OPTIONS, progress=stop, interruptible=True))
    assert (found.status == Status.INTERRUPTED).all()
    assert (found.cost <= found.initial_cost).all()


@dataclass(frozen=True)
class Bent:
    """A place of a cost whose exact Hessian is positive nowhere: only steps without it solve."""

    x: Tensor
    cost: Tensor
    tried: list[float]
    """Dampings tried with the exact Hessian."""

    def steepest(self) -> Tensor:
        return torch.ones_like(self.cost)

    def along(self, delta: Tensor) -> Tensor:
        return -torch.ones_like(self.cost)

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        bent = exact is not None and bool(exact)
        if bent:
            self.tried.append(float(damping))
        # Each step gains half of what the last one gained.
        promise = torch.full_like(self.cost, torch.inf) if bent else (self.cost - 1) / 2
        none = torch.zeros_like(self.cost) > 0
        return Step(torch.zeros_like(self.x), promise, torch.full_like(self.cost, not bent) > 0, none, none)


@dataclass(frozen=True)
class Crawling(Problem[Bent]):
    """Steps that gain little by little."""

    @property
    def patience(self) -> int:
        return 0

    def pick(self, at: Places) -> "Crawling":
        return self

    def linearize(self, x: Tensor) -> Bent:
        return Bent(x, 1 + 1e-3 * x, [])

    def advance(self, here: Bent, step: Step) -> Bent:
        return replace(here, cost=here.cost - step.promise)

    def rounding(self, here: Bent) -> Tensor:
        return torch.zeros_like(here.cost)


def test_damping_that_was_too_weak_for_the_exact_hessian_is_not_tried_again() -> None:
    found = descend(Crawling(), torch.tensor(1.0, dtype=F64), Options(200, 1e-9))
    tried = found.end.tried
    assert found.status == Status.OK
    assert len(tried) > 4
    # Ever more of it until it is as much as may be, then that alone.
    assert tried == sorted(tried)
    most = tried[-1]
    assert tried.index(most) < 6
    assert set(tried[tried.index(most) :]) == {most}
