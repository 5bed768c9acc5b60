"""Derivatives of few numbers come of one sweep, and are those that come one by one of many."""

from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm.optim import Block, Huber, RigidMotion, Term, dense, levenberg_marquardt, terms

F64 = torch.float64


@pytest.fixture
def sweeps(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """One entry for each time that something is differentiated."""
    done: list[bool] = []
    grad = torch.autograd.grad

    def counted(*args: Any, **kwargs: Any) -> Any:
        done.append(True)
        return grad(*args, **kwargs)

    monkeypatch.setattr(torch.autograd, "grad", counted)
    return done


def seen(pose: Tensor, point: Tensor, x: Tensor) -> Tensor:
    X = (pose[:, :9].unflatten(1, (3, 3)) @ point[:, :, None])[:, :, 0] + pose[:, 9:]
    return torch.cat((X[:, :2] / X[:, 2:] - x, x.new_ones(len(x), 1)), -1)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_terms(count: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, sweeps: list[bool]) -> None:
    """Of a row that depends on nothing, too."""
    kind = {"generator": generator, "dtype": F64}
    still = torch.cat((torch.eye(3, dtype=F64).flatten(), torch.tensor([0.0, 0.0, 5.0], dtype=F64)))
    blocks = {
        "pose": Block(RigidMotion().retract(still, 0.1 * torch.randn(3, 6, **kind)), RigidMotion()),
        "point": Block(torch.randn(4, 3, **kind)),
    }
    x = {name: block.x.mT.contiguous().mT for name, block in blocks.items()}
    index = tuple(torch.randint(n, (count,), generator=generator) for n in (3, 4))
    term = Term(seen, ("pose", "point"), index, (torch.randn(count, 2, **kind),), Huber(0.1))

    def found() -> tuple[list[Tensor], int]:
        before = len(sweeps)
        lifts = {name: terms.lift_of(block, x[name]) for name, block in blocks.items()}
        out = [torch.full((count, 3, k), torch.nan, dtype=F64) for k in (6, 3)]
        residual, scale = terms.linearize(term, x, lifts, list(out), terms.Workspace(x["pose"]))
        assert scale is not None
        return [*out, residual, scale], len(sweeps) - before

    together, few = found()
    monkeypatch.setattr(terms, "FEW", -1)
    singly, many = found()
    assert few == 2
    assert many == 12 + 3
    for a, b in zip(together, singly, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_dense_problems(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, sweeps: list[bool]) -> None:
    """Jacobians, and exact Hessians where what is left of the cost is large."""
    t = torch.linspace(0, 3, 30, dtype=F64).expand(5, 30)
    y = (-t).exp() + 0.3 * torch.randn(5, 30, generator=generator, dtype=F64)

    def decay(x: Tensor, t: Tensor, y: Tensor) -> Tensor:
        a, b, c = (x[..., i, None] for i in range(3))
        return (a * torch.exp(-b * t) + c - y)[..., None]

    def found() -> tuple[Tensor, int]:
        before = len(sweeps)
        return levenberg_marquardt(decay, torch.ones(5, 3, dtype=F64), t, y, function_tolerance=1e-12).x, len(sweeps) - before

    together, few = found()
    monkeypatch.setattr(dense, "FEW", -1)
    monkeypatch.setattr(dense, "FEW_BENT", -1)
    singly, many = found()
    assert few < 0.6 * many
    torch.testing.assert_close(together, singly, rtol=1e-6, atol=1e-6)


def test_data_of_which_each_number_is_hardly_used(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, sweeps: list[bool]
) -> None:
    """As covariances: the work of a Hessian goes by the residuals."""
    kind = {"generator": generator, "dtype": F64}
    A, x, covariance = torch.randn(5, 30, 3, **kind), torch.randn(5, 3, **kind), torch.ones(5, 1 << 15, dtype=F64)

    def residual(x: Tensor, A: Tensor, covariance: Tensor) -> Tensor:
        return (covariance[..., :1] * (A @ x[..., None])[..., 0].sin())[..., None]

    problem = dense.dense_problem(residual, torch.add, 3, None, None, x, (A, covariance), None, (30, 1))
    here, hessians, numbers = problem.linearize(x), [], []
    for most in (dense.FEW_BENT, -1):
        monkeypatch.setattr(dense, "FEW_BENT", most)
        before = len(sweeps)
        hessians.append(problem.curve(here, torch.ones(5, dtype=torch.bool)).hessian)
        numbers.append(len(sweeps) - before)
    assert numbers == [2, 4]
    torch.testing.assert_close(*hessians, rtol=1e-12, atol=1e-12)
