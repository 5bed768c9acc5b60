"""Quartics in closed form against their roots and against companion matrices."""

import numpy as np
import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.linalg import solve_quartic

F64 = torch.float64


def from_roots(x: Tensor) -> Tensor:
    c = torch.ones(*x.shape[:-1], 1, dtype=x.dtype)
    for root in x.unbind(-1):
        zero = torch.zeros_like(c[..., :1])
        c = torch.cat((zero, c), -1) - root[..., None] * torch.cat((c, zero), -1)
    return c


def gaps(x: Tensor, real: Tensor, wanted: Tensor) -> Tensor:
    gap = (x[:, None, :] - wanted[:, :, None]).abs() / (1 + wanted.abs()[:, :, None])
    return torch.where(real[:, None, :], gap, 9).amin(-1)


def test_random_coefficients_against_numpy(generator: torch.Generator) -> None:
    c = torch.randn(3000, 5, dtype=F64, generator=generator)
    x, real = solve_quartic(c)
    theirs = torch.from_numpy(np.array([np.roots(row[::-1]).astype(complex) for row in c.numpy()]))
    is_real = theirs.imag.abs() < 1e-9 * (1 + theirs.real.abs())
    # Where the leading coefficient is small the others lose digits, and one may stand twice.
    assert_share(real.sum(-1) == is_real.sum(-1), 0.9995)
    assert_share(gaps(x, real, theirs.real)[is_real] < 1e-9, 0.9995)
    assert (gaps(x, real, theirs.real)[is_real & (real.sum(-1) == is_real.sum(-1))[:, None]] < 1e-5).all()
    assert torch.isfinite(x).all()


@pytest.mark.parametrize("spread", [0.0, 1.0, 3.0])
def test_four_real_roots(spread: float, generator: torch.Generator) -> None:
    roots = torch.randn(3000, 4, dtype=F64, generator=generator)
    roots = roots * 10 ** (spread * torch.rand(3000, 1, dtype=F64, generator=generator))
    x, real = solve_quartic(torch.randn(3000, 1, dtype=F64, generator=generator) * from_roots(roots))
    assert_share(real.all(-1), 0.999)
    assert_share(gaps(x, real, roots) < 1e-6, 0.999)


def test_even_quartics_and_zero_roots(generator: torch.Generator) -> None:
    half = torch.randn(1000, 2, dtype=F64, generator=generator)
    roots = torch.cat((half, -half), -1)
    x, real = solve_quartic(from_roots(roots))
    assert_share(gaps(x, real, roots) < 1e-7, 0.999)
    roots[:, 0] = 0
    x, real = solve_quartic(from_roots(roots))
    assert_share(gaps(x, real, roots) < 1e-6, 0.999)
    assert not solve_quartic(torch.tensor([1.0, 0, 0, 0, 1], dtype=F64))[1].any()
    assert not solve_quartic(torch.tensor([2.0, 0, 3, 0, 1], dtype=F64))[1].any()


def test_double_roots_are_found_once(generator: torch.Generator) -> None:
    roots = torch.randn(2000, 4, dtype=F64, generator=generator)
    roots[:, 1] = roots[:, 0]
    x, real = solve_quartic(from_roots(roots))
    assert_share(gaps(x, real, roots) < 1e-5, 0.999)
    assert ((real.sum(-1) == 3) | (real.sum(-1) == 4)).all()


def test_bad_coefficients(generator: torch.Generator) -> None:
    c = torch.randn(6, 5, dtype=F64, generator=generator)
    c[:3] = from_roots(torch.tensor([[1.0, 2, 3, 4]], dtype=F64))
    reference = solve_quartic(c)
    c[1, 4], c[3, 0], c[4] = 0, torch.nan, torch.inf
    c.requires_grad_()
    x, real = solve_quartic(c)
    assert not real[[1, 3, 4]].any()
    assert torch.isfinite(x).all()
    assert torch.equal(x[[0, 2, 5]], reference[0][[0, 2, 5]])
    x.sum().backward()
    assert c.grad is not None
    assert torch.isfinite(c.grad).all()


def test_shapes_and_derivatives(generator: torch.Generator) -> None:
    assert solve_quartic(torch.zeros(0, 5))[0].shape == (0, 4)
    assert solve_quartic(torch.ones(2, 3, 5))[1].shape == (2, 3, 4)
    c = from_roots(torch.randn(3, 4, dtype=F64, generator=generator)).requires_grad_()
    real = solve_quartic(c)[1]
    assert real.all()
    assert torch.autograd.gradcheck(lambda c: solve_quartic(c)[0], (c,), atol=1e-4)
