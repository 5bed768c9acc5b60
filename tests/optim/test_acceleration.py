"""Steps that bend along curved valleys of the cost."""

import importlib

import pytest
import torch
from torch import Tensor

from torchsfm import Status
from torchsfm.optim import Block, Term, sparse_levenberg_marquardt

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
