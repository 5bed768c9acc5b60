"""Decompositions that never raise, and keep the elements of a batch apart."""

from collections.abc import Callable

import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.linalg import (
    decompositions,
    eigh,
    eigvals,
    eigvalsh,
    inverse,
    null_vector,
    qr,
    solve,
    svd,
    svdvals,
    triangular_factor,
)

F64 = torch.float64
NAN, INF = float("nan"), float("inf")
Guarded = Callable[[Tensor], tuple[Tensor, ...]]


def symmetric(function: Guarded) -> Guarded:
    return lambda A: function(0.5 * A + 0.5 * A.mT)


FUNCTIONS: dict[str, Guarded] = {
    "eigh": symmetric(eigh),
    "eigvalsh": symmetric(eigvalsh),
    "eigvals": eigvals,
    "svd": svd,
    "svdvals": svdvals,
    "qr": qr,
    "triangular_factor": triangular_factor,
    "solve": lambda A: solve(A, A.mT),
    "inverse": inverse,
}
guarded = pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)


def wild(number: int, n: int, dtype: torch.dtype, generator: torch.Generator) -> Tensor:
    """Matrices with numbers of all sizes that there are, on some of which LAPACK's iterations do not end."""
    low, high = (-45, 38) if dtype == torch.float32 else (-320, 308)
    A = torch.randn(number, n, n, generator=generator, dtype=F64)
    return (A * 10.0 ** torch.randint(low, high, (number, 1, n), generator=generator).double()).to(dtype)


@guarded
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_bad_elements_are_marked_and_alone(function: Guarded, dtype: torch.dtype, generator: torch.Generator) -> None:
    A = torch.randn(40, 5, 5, generator=generator, dtype=dtype)
    good = torch.rand(40, generator=generator) < 0.5
    worst = torch.tensor([NAN, INF, -INF, torch.finfo(dtype).max], dtype=dtype)
    bad = A.clone()
    bad[~good, 3, 1] = worst[torch.randint(4, (int((~good).sum()),), generator=generator)]
    *parts, ok = function(bad)
    *wanted, all_ok = function(A)
    assert all_ok.all()
    assert ok[good].all()
    assert not (ok & ~bad.isfinite().flatten(1).all(-1)).any()
    for part, reference in zip(parts, wanted, strict=True):
        assert torch.equal(part[good], reference[good])
        assert part.isfinite().all()
        if part.ndim == 2:
            assert not part[~ok].any()


@guarded
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_nothing_raises_whatever_the_sizes(function: Guarded, dtype: torch.dtype, generator: torch.Generator) -> None:
    for n in range(2, 12):
        tame = torch.randn(400, n, n, generator=generator, dtype=dtype)
        mixed = tame.clone()
        mixed[1::2] = wild(200, n, dtype, generator)
        *parts, ok = function(mixed)
        *wanted, _ = function(tame)
        assert ok[::2].all()
        for part, reference in zip(parts, wanted, strict=True):
            assert part.isfinite().all()
            assert torch.equal(part[::2], reference[::2])


def test_what_is_ok_is_a_decomposition(generator: torch.Generator) -> None:
    A = torch.cat((wild(200, 6, F64, generator), torch.randn(200, 6, 6, generator=generator, dtype=F64)))
    A = A / A.abs().amax((-2, -1), keepdim=True).clamp_min(1e-300)
    S = A + A.mT
    values, vectors, ok = eigh(S)
    U, s, Vh, fine = svd(A)
    Q, R, _ = qr(A)
    assert_share(ok, 0.95)
    assert (vectors * values[:, None] @ vectors.mT - S)[ok].abs().max() < 1e-13
    assert (U * s[:, None] @ Vh - A)[fine].abs().max() < 1e-13
    assert (Q @ R - A).abs().max() < 1e-13


@pytest.mark.parametrize("function", [FUNCTIONS[name] for name in ("eigh", "svd", "qr")])
def test_derivatives_are_zero_where_there_is_no_decomposition(function: Guarded, generator: torch.Generator) -> None:
    A = torch.randn(4, 3, 3, generator=generator, dtype=F64)
    A[1, 0, 0], A[2, 2, 1] = NAN, INF
    A.requires_grad_()
    *parts, ok = function(A)
    (gradient,) = torch.autograd.grad(sum(part.sum() for part in parts), A)
    assert ok.tolist() == [True, False, False, True]
    assert gradient.isfinite().all()
    assert not gradient[1:3].any()
    assert (gradient[[0, 3]].abs().amax((-2, -1)) > 0).all()


@guarded
def test_shapes(function: Guarded, generator: torch.Generator) -> None:
    A = torch.randn(2, 3, 4, 4, generator=generator, dtype=F64)
    *parts, ok = function(A)
    assert ok.shape == (2, 3)
    for part, mapped in zip(parts, torch.func.vmap(lambda a: function(a)[:-1])(A), strict=True):
        torch.testing.assert_close(part, mapped)
    assert function(A[:, :0])[-1].shape == (2, 0)
    assert function(A[0, 0])[-1].shape == ()


@pytest.mark.parametrize("power", [-1040, -600, 600, 1000])
def test_null_vectors_do_not_depend_on_the_unit(power: int, generator: torch.Generator) -> None:
    A = torch.randn(30, 8, 5, generator=generator, dtype=F64)
    v, _ = null_vector(A)
    moved, finite = null_vector(A * 2.0 ** (power // 2) * 2.0 ** (power - power // 2))
    assert finite.all()
    torch.testing.assert_close(moved, v)


def test_what_gives_up_in_a_batch_only_takes_no_neighbour_along(generator: torch.Generator) -> None:
    A = torch.randn(8, 5, 5, generator=generator)
    A[2, 0, 0], A[5, 0, 0] = 7.0, 7.0

    def scale(a: Tensor) -> tuple[Tensor, ...]:
        """Twice a matrix; on some of a batch it gives up, on none alone, and alone it is rounded otherwise."""
        if a.ndim == 2:
            return (torch.nextafter(2 * a, torch.full_like(a, INF)),)
        if bool((a[:, 0, 0] == 7).any()):
            k = int((a[:, 0, 0] == 7).to(torch.int8).argmax())
            raise torch.linalg.LinAlgError(f"linalg.scale: (Batch element {k}): The algorithm failed to converge.")
        return (2 * a,)

    (found,) = decompositions._attempt(scale, A)
    given_up = torch.arange(8) % 3 == 2
    assert torch.equal(found[~given_up], 2 * A[~given_up])
    assert found[given_up].isnan().all()
