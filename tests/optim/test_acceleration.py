"""Steps that bend along curved valleys of the cost."""

import importlib
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsfm import Status
from torchsfm.bundle.blocks import Bundle
from torchsfm.optim import Block, Term, schur, sparse_levenberg_marquardt
from torchsfm.optim.layout import lay_out
from torchsfm.optim.schur import Elimination
from torchsfm.optim.solver_choice import Solver
from torchsfm.optim.terms import prepare
from torchsfm.simulation import random_bundle_problem

# The package gives its name to the function.
engine = importlib.import_module("torchsfm.optim.sparse_levenberg_marquardt")


@pytest.mark.parametrize("solver", ["dense", "sparse", "pcg"])
def test_steps_follow_rosenbrocks_valley(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def steps() -> int:
        def residual(p: Tensor) -> Tensor:
            return torch.stack((1000 * (p[:, 1] - p[:, 0] ** 2), 1 - p[:, 0]), -1)

        start = Block(torch.tensor([[-1.2, 1.0]], dtype=torch.float64))
        term = Term(residual, ("p",), (torch.zeros(1, dtype=torch.int64),))
        options = {"max_iterations": 1000, "function_tolerance": 1e-12, "linear_solver": solver}
        found = sparse_levenberg_marquardt({"p": start}, [term], **options)
        assert found.status == Status.OK
        torch.testing.assert_close(found.x["p"], torch.ones(1, 2, dtype=torch.float64), rtol=0, atol=1e-6)
        return found.iterations

    bent = steps()
    monkeypatch.setattr(engine, "SMALL", 0.0)  # no bend is small enough: straight steps
    assert 1.5 * bent < steps()


@pytest.mark.parametrize("solver", ["dense", "sparse", "pcg"])
@pytest.mark.parametrize("seconds", [0.0, torch.inf])
def test_factors_serve_again(
    solver: Solver, seconds: float, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a dense system, with other residuals that have the same derivatives; others keep none."""
    monkeypatch.setattr(schur, "estimate_pairs", lambda family: seconds)
    given = random_bundle_problem(5, 40, 100, noise=0.5, generator=generator).problem
    blocks, terms = Bundle(given, free=("focal", "k1")).problem()
    blocks, terms, _ = prepare(blocks, terms)
    noise = torch.randn(given.x.shape, generator=generator, dtype=torch.float64)
    shifted = [replace(terms[0], data=(terms[0].data[0] + noise,)), *terms[1:]]
    x = {name: b.x for name, b in blocks.items()}
    system, other = (Elimination(blocks, lay_out(blocks, some, "point"), solver).linearize(x) for some in (terms, shifted))
    assert system.again(other) is None, "no step yet"
    system.step(1e-3)
    again = system.again(other)
    assert (again is None) == (solver != "dense")
    for name, step in (again or {}).items():
        torch.testing.assert_close(step, other.step(1e-3).delta[name], rtol=1e-9, atol=1e-12)
