"""The switch for compiled functions: the same answers in both modes, for every size of a batch."""

import subprocess
import sys

import pytest
import torch
from chance import stream_seed
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


SIZES = """
import torch
from torchsfm import compile_kernels
from torchsfm.linalg.compilation import kernel

traced = 0

@kernel(chunk=40)
def doubled(x, y, *, factor=2.0):
    global traced
    traced += torch.compiler.is_compiling()
    return factor * x, x[0] + y

compile_kernels()
for dtype in (torch.float64, torch.float32):
    for batch in (0, 1, 2, 17, 33, 200):
        x, y = torch.randn(2, batch, dtype=dtype), torch.randn(batch, dtype=dtype)
        a, b = doubled(x, y)
        assert torch.equal(a, 2 * x) and torch.equal(b, x[0] + y) and b.dtype == dtype
compile_kernels(False)
before = traced
doubled(x, y)
assert 0 < before == traced
"""

SOLVERS = """
import sys
import torch
from torchsfm import camera_p3p, compile_kernels, essential_5pt, fundamental_7pt, homography_4pt
from torchsfm.motion.relative_5pt import relative_5pt

torch.manual_seed(int(sys.argv[1]))
def images(n):
    x = torch.rand(500, n, 2, dtype=torch.float64)
    x[7, 2] = torch.nan
    return x

def rays(n):
    x = torch.randn(500, n, 3, dtype=torch.float64)
    x[7, 2] = torch.nan
    return x

slack = torch.full((500,), 1e-3, dtype=torch.float64)
calls = (homography_4pt, images(4), images(4)), (fundamental_7pt, images(7), images(7)), (camera_p3p, rays(3), rays(3))
for solver, *sample in (*calls, (essential_5pt, rays(5), rays(5)), (relative_5pt, rays(5), rays(5), slack)):
    plain = solver(*sample)
    compile_kernels()
    fast = solver(*sample)
    compile_kernels(False)
    assert not fast.valid[7].any()
    # Solutions may be found in another order, or be lost, where rounding decides: where two nearly coincide.
    one, other = (torch.where(s.valid.view(500, -1, 1), s.model.flatten(2), torch.inf) for s in (plain, fast))
    apart = torch.minimum((one[:, :, None] - other[:, None]).abs().amax(-1), (one[:, :, None] + other[:, None]).abs().amax(-1))
    found = (apart.nan_to_num(nan=0.0).amin(-1) < 1e-6).all(-1)
    assert found.double().mean() > 0.98, (solver.__name__, found.double().mean())
"""


@pytest.mark.slow
@pytest.mark.parametrize("program", [SIZES, SOLVERS], ids=["sizes", "solvers"])
def test_compiled_functions_give_the_same(program: str) -> None:
    # In a process of its own, without the type checker's wrappers that dynamo cannot see through.
    done = subprocess.run([sys.executable, "-c", program, str(stream_seed())], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
