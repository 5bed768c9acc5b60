"""Fused functions: one compilation for all sizes, derivatives and empty sizes as they are, errors instead of surprises."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from torchsfm.linalg.fused import fused


@fused("g 1", "g n")
def total(slope: Tensor, x: Tensor, power: int) -> Tensor:
    """Sums (g)."""
    return (slope * x**power).sum(-1)


def test_a_fused_function_runs_as_it_is(generator: torch.Generator) -> None:
    slope, x = torch.randn(3, 1, generator=generator), torch.randn(3, 5, generator=generator)
    assert torch.equal(total(slope, x, 2), (slope * x**2).sum(-1))


PROGRAM = """
from dataclasses import dataclass
import torch
import torchsfm.linalg.fused as room
from torchsfm import compile_kernels
from torchsfm.linalg.fused import fused

compile_kernels()
compiled = 0
compile_one = room._compile

def counting(*arguments):
    global compiled
    compiled += 1
    return compile_one(*arguments)

room._compile = counting

@dataclass(frozen=True)
class Line:
    slope: torch.Tensor
    power: int = 2
    traceable: bool = True

@fused("g 1", "g n")
def total(line, x, counts):
    assert torch.compiler.is_compiling() == (line.traceable and not x.requires_grad and x.numel() > 0)
    value = line.slope * x.mT[..., 0, :] ** line.power
    return (value if counts is None else value * counts).sum(-1), line

def check(g, n, swapped=False, power=2):
    x = torch.randn(g, 2, n).mT if swapped else torch.randn(g, n, 2)
    line = Line(torch.randn(g, 1), power)
    found, same = total(line, x, None)
    torch.testing.assert_close(found, (line.slope * x[..., 0] ** power).sum(-1), rtol=1e-4, atol=1e-3)
    assert torch.equal(same.slope, line.slope) and same.power == power

for g, n in ((3, 50), (1, 1), (1, 7), (9, 1), (4, 4000)):
    check(g, n)
assert compiled == 1, compiled
check(5, 12, swapped=True)
assert compiled == 2, compiled
total(Line(torch.randn(3, 1)), torch.empty(3, 0, 2), None)
x = torch.randn(3, 4, 2, requires_grad=True)
total(Line(torch.randn(3, 1)), x, None)[0].sum().backward()
assert x.grad is not None
total(Line(torch.randn(3, 1), traceable=False), torch.randn(3, 4, 2), None)
assert compiled == 2, compiled

def message(call):
    try:
        call()
    except (RuntimeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return "no error"

assert "ValueError" in message(lambda: total(Line(torch.randn(2, 1)), torch.randn(3, 4, 2), None))

@fused("g 1", "g n")
def values_matter(line, x):
    return x * float(x.sum())

assert "cannot be compiled" in message(lambda: values_matter(Line(torch.ones(2, 1)), torch.ones(2, 3)))

@fused("g 1", "g n")
def sizes_matter(line, x):
    return x * int(x.shape[1])

assert "for every size" in message(lambda: [sizes_matter(Line(torch.ones(2, 1)), torch.ones(2, n)) for n in range(2, 20)])
compile_kernels(False)
assert torch.equal(values_matter(Line(torch.ones(2, 1)), torch.ones(2, 3)), torch.full((2, 3), 6.0))
"""


@pytest.mark.slow
def test_one_compilation_for_all_sizes() -> None:
    # In a process of its own, without the type checker's wrappers.
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
