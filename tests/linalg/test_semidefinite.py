"""Pseudo-inverses of matrices with a small null space, small ones and large ones."""

import pytest
import torch
from torch import Tensor

from torchsfm.linalg import semidefinite
from torchsfm.linalg.semidefinite import pseudo_inverse

F64 = torch.float64


def made(eigenvalues: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A matrix with these eigenvalues, and its pseudo-inverse."""
    n = len(eigenvalues)
    Q = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=F64))[0]
    inverse = torch.where(eigenvalues > 0, 1 / eigenvalues, 0.0)
    return (Q * eigenvalues) @ Q.mT, (Q * inverse) @ Q.mT


@pytest.mark.parametrize("n", [30, 400])
@pytest.mark.parametrize("nullity", [0, 1, 7])
def test_the_null_space_is_left_out(n: int, nullity: int, generator: torch.Generator) -> None:
    eigenvalues = 10 ** (-6 * torch.rand(n, generator=generator, dtype=F64))
    eigenvalues[:nullity] = 0
    A, wanted = made(eigenvalues, generator)
    found = pseudo_inverse(A.tril(), 1e-11)
    assert bool(found.ok)
    assert found.rank == n - nullity
    root = found.root()
    for inverse in (found.inverse, root @ root.mT):
        torch.testing.assert_close(inverse, wanted, rtol=0, atol=1e-8 * float(wanted.norm()))


def test_weak_directions_are_no_null_space(generator: torch.Generator) -> None:
    """Between what counts and what is rounding there may be no gap of many digits."""
    eigenvalues = torch.ones(400, dtype=F64)
    eigenvalues[:12] = 1e-9
    eigenvalues[:7] = 1e-14
    A, _ = made(eigenvalues, generator)
    assert pseudo_inverse(A, 1e-11).rank == 393


def test_a_large_null_space_is_found_too(generator: torch.Generator) -> None:
    eigenvalues = torch.linspace(0.5, 2, 300, dtype=F64)
    eigenvalues[:40] = 0
    A, wanted = made(eigenvalues, generator)
    found = pseudo_inverse(A, 1e-11)
    assert found.rank == 260
    torch.testing.assert_close(found.inverse, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("n", [3, 300])
def test_what_is_not_finite_has_no_inverse(n: int) -> None:
    A = torch.eye(n, dtype=F64)
    A[-1, 0] = torch.nan
    found = pseudo_inverse(A, 1e-11)
    assert not bool(found.ok)
    assert not bool(found.inverse.isfinite().any())


def test_both_ways_agree(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    eigenvalues = 10 ** (-4 * torch.rand(300, generator=generator, dtype=F64))
    eigenvalues[:7] = 0
    A, _ = made(eigenvalues, generator)
    by_factor = pseudo_inverse(A, 1e-11).inverse
    monkeypatch.setattr(semidefinite, "SMALL", 300)
    torch.testing.assert_close(by_factor, pseudo_inverse(A, 1e-11).inverse, rtol=0, atol=1e-8 * float(by_factor.norm()))
