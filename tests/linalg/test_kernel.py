"""Kernels: pieces are joined, whatever the size of the batch; and no compiler is imported."""

import subprocess
import sys

import torch
from torch import Tensor

from torchsfm.linalg.kernel import kernel


@kernel(chunk=4)
def doubled(x: Tensor, y: Tensor, *, factor: float = 2.0) -> tuple[Tensor, Tensor]:
    """Rows (2, batch) and (batch)."""
    return factor * x, x[0] + y


def test_pieces_are_joined(generator: torch.Generator) -> None:
    for batch in (0, 1, 3, 4, 5, 11):
        x, y = torch.randn(2, batch, generator=generator), torch.randn(batch, generator=generator)
        a, b = doubled(x, y, factor=3.0)
        assert torch.equal(a, 3 * x)
        assert torch.equal(b, x[0] + y)


def test_no_compiler_is_imported() -> None:
    program = (
        "import sys, torch, torchsfm\n"
        "x = torch.rand(3, 4, 2, dtype=torch.float64, requires_grad=True)\n"
        "torchsfm.homography_4pt(x, torch.rand(3, 4, 2, dtype=torch.float64)).model.sum().backward()\n"
        "d = torch.rand(2, 5, 3, dtype=torch.float64, requires_grad=True)\n"
        "torchsfm.essential_5pt(d, torch.rand(2, 5, 3, dtype=torch.float64)).model.sum().backward()\n"
        "assert 'torch._dynamo' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
