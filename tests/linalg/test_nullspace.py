import pytest
import torch

from torchsfm.linalg import null_vector, nullspace_rows, orthonormal_nullspace

F64 = torch.float64


@pytest.mark.parametrize(("m", "n"), [(5, 9), (7, 9), (1, 4), (3, 4)])
def test_nullspaces_are_orthonormal_and_null(m: int, n: int, generator: torch.Generator) -> None:
    A = torch.randn(50, m, n, dtype=F64, generator=generator)
    N = orthonormal_nullspace(A)
    rows, pivot = nullspace_rows(A.permute(1, 2, 0).contiguous())
    for basis in (N, rows.permute(2, 1, 0)):
        assert (A @ basis).abs().max() < 1e-12
        torch.testing.assert_close(basis.mT @ basis, torch.eye(n - m, dtype=F64).expand(50, -1, -1), atol=1e-13, rtol=0)
    assert (pivot > 0).all()


def test_nullspace_rows_sees_dependent_rows(generator: torch.Generator) -> None:
    A = torch.randn(3, 6, 40, dtype=F64, generator=generator)
    A[2, :, :20] = 2 * A[0, :, :20] - A[1, :, :20]
    _, pivot = nullspace_rows(A)
    assert pivot[:20].max() < 1e-13
    assert pivot[20:].min() > 1e-3


def test_null_vector_keeps_the_accuracy_that_squaring_loses(generator: torch.Generator) -> None:
    # Singular values 1 ... 1e-6 and an exact null vector: A'A alone leaves an error of about 1e-16 / 1e-12.
    U = torch.linalg.qr(torch.randn(30, 20, 9, dtype=F64, generator=generator)).Q
    V = torch.linalg.qr(torch.randn(30, 9, 9, dtype=F64, generator=generator)).Q
    s = torch.cat((torch.logspace(0, -6, 8, dtype=F64), torch.zeros(1, dtype=F64)))
    v, finite = null_vector((U * s) @ V.mT)
    assert finite.all()
    sine = (1 - (v * V[..., -1]).sum(-1) ** 2).clamp_min(0).sqrt()
    distance = (v - V[..., -1] * (v * V[..., -1]).sum(-1, keepdim=True).sign()).norm(dim=-1)
    assert torch.minimum(sine, distance).max() < 1e-8


def test_null_vector_is_the_smallest_singular_vector(generator: torch.Generator) -> None:
    A = torch.randn(20, 12, 5, dtype=F64, generator=generator)
    v, _ = null_vector(A)
    reference = torch.linalg.svd(A).Vh[..., -1, :]
    torch.testing.assert_close((v * reference).sum(-1).abs(), torch.ones(20, dtype=F64))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
def test_null_vector_derivative(generator: torch.Generator) -> None:
    A = torch.randn(3, 8, 5, dtype=F64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: null_vector(a)[0], A, check_forward_ad=True)


def test_null_vector_degenerate_and_not_finite(generator: torch.Generator) -> None:
    A = torch.randn(4, 8, 5, dtype=F64, generator=generator)
    reference, _ = null_vector(A)
    A[1] = 0
    A[2, 3, 3] = float("nan")
    A = A.requires_grad_()
    v, finite = null_vector(A)
    assert finite.tolist() == [True, True, False, True]
    torch.testing.assert_close(v.norm(dim=-1), torch.ones(4, dtype=F64))
    assert torch.equal(v[[0, 3]], reference[[0, 3]])
    v.sum().backward()
    assert A.grad is not None
    assert torch.isfinite(A.grad).all()


def _with_singular_values(
    s: torch.Tensor, rows: int, batch: int, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Matrices, and the vector of the last singular value."""
    U = torch.linalg.qr(torch.randn(batch, rows, len(s), dtype=F64, generator=generator)).Q
    V = torch.linalg.qr(torch.randn(batch, len(s), len(s), dtype=F64, generator=generator)).Q
    return (U * s) @ V.mT, V[..., -1]


def _angle(v: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    return (v - w * (v * w).sum(-1, keepdim=True)).norm(dim=-1)


@pytest.mark.parametrize("least", [0.0, 1e-9, 1e-3, 0.1, 0.5, 0.9, 0.999])
def test_null_vector_next_to_another_singular_value(least: float, generator: torch.Generator) -> None:
    # What the fastest way does not settle the others must: the error is that of rounding over the gap, whatever the noise.
    s = torch.tensor([1.0, 0.8, 0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02], dtype=F64)
    s = torch.cat((s, s.new_tensor([0.02 * least])))
    A, wanted = _with_singular_values(s, 14, 200, generator)
    v, finite = null_vector(A)
    assert finite.all()
    gap = 0.02**2 * (1 - least**2)
    assert _angle(v, wanted).max() < 2e-12 + 1e-14 / gap


def test_null_vector_is_the_same_whatever_stands_beside_it(generator: torch.Generator) -> None:
    # Settled in different ways: as many rows as columns, with a clear, a doubtful and no least singular value.
    clear, _ = _with_singular_values(torch.tensor([1.0, 0.5, 0.2, 1e-9], dtype=F64), 6, 3, generator)
    doubtful, _ = _with_singular_values(torch.tensor([1.0, 0.5, 0.2, 0.1999], dtype=F64), 6, 3, generator)
    A = torch.cat((clear, doubtful, torch.zeros(1, 6, 4, dtype=F64)))
    together = null_vector(A)[0]
    for i in range(len(A)):
        assert torch.equal(null_vector(A[i : i + 1])[0][0], together[i])
    assert torch.equal(null_vector(A.requires_grad_())[0].detach(), together)


def test_null_vector_of_dependent_rows_is_in_their_null_space(generator: torch.Generator) -> None:
    A = torch.randn(20, 8, 9, dtype=F64, generator=generator)
    A[:10, 3] = A[:10, 2] - 2 * A[:10, 6]
    A[10:15, 5] = 0
    v, _ = null_vector(A)
    torch.testing.assert_close(v.norm(dim=-1), torch.ones(20, dtype=F64))
    assert (A @ v[..., None]).abs().max() < 1e-12
