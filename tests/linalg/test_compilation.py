"""The switch for compiled kernels: the same answers, every batch size, errors instead of a silent fall back."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from torchsfm.linalg.compilation import kernel


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


def test_eager_mode_imports_no_compiler() -> None:
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


PROGRAM = """
import torch
from torchsfm import compile_kernels, homography_4pt
from torchsfm.linalg.compilation import kernel

@kernel(chunk=4)
def doubled(x, y, *, factor=2.0):
    return factor * x, x[0] + y

@kernel
def broken(x):
    return (x * len(x[0].nonzero().tolist()),)

def message(call):
    try:
        call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "no error"

x1, x2 = torch.rand(2, 500, 4, 2, dtype=torch.float64)
x1[7, 2] = torch.nan
plain = homography_4pt(x1, x2)
compile_kernels()
fast = homography_4pt(x1, x2)
assert torch.equal(fast.valid, plain.valid) and not fast.valid[7].any()
torch.testing.assert_close(fast.model, plain.model, rtol=1e-6, atol=1e-9)
for dtype in (torch.float64, torch.float32):
    for batch in (1, 2, 17, 33, 20000):
        x, y = torch.randn(2, batch, dtype=dtype), torch.randn(batch, dtype=dtype)
        a, b = doubled(x, y)
        assert torch.equal(a, 2 * x) and torch.equal(b, x[0] + y) and b.dtype == dtype
text = message(lambda: broken(torch.ones(1, 40)))
assert "Unsupported" in text or "data-dependent" in text.lower(), text
torch.use_deterministic_algorithms(True)
text = message(lambda: doubled(x, y))
assert "compiled more than once" in text, text
"""


@pytest.mark.slow
def test_compiled_kernels_give_the_same_or_an_error() -> None:
    # In a process of its own, without the type checker's wrappers that dynamo cannot see through.
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
