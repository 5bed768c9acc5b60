import torch

from torchsfm.linalg import adjugate_3x3, cross, determinant_3x3, solve

F64 = torch.float64


def test_closed_forms_match_lapack(generator: torch.Generator) -> None:
    A = torch.randn(4, 5, 3, 3, dtype=F64, generator=generator)
    torch.testing.assert_close(determinant_3x3(A), torch.linalg.det(A))
    torch.testing.assert_close(adjugate_3x3(A), torch.linalg.inv(A) * torch.linalg.det(A)[..., None, None])
    a, b = A[..., 0], A[0, 0, :, 1]
    torch.testing.assert_close(cross(a, b), torch.linalg.cross(a, b.expand_as(a)))


def test_derivatives_at_rank_one() -> None:
    a, b = torch.tensor([1.0, 2, 3], dtype=F64), torch.tensor([3.0, -1, 2], dtype=F64)
    A = (a[:, None] * b).requires_grad_()
    assert torch.autograd.gradcheck(determinant_3x3, A)
    assert torch.autograd.gradcheck(adjugate_3x3, A)
    assert torch.autograd.gradgradcheck(determinant_3x3, A)


def test_solve_masks_bad_systems_only(generator: torch.Generator) -> None:
    A = torch.randn(6, 4, 4, dtype=F64, generator=generator)
    b = torch.randn(6, 4, 2, dtype=F64, generator=generator)
    good_x, good = solve(A, b)
    assert good.all()
    torch.testing.assert_close(A @ good_x, b)
    A[1, 2] = 0
    A[3, 0, 0] = float("nan")
    b[4, 0, 0] = float("inf")
    x, ok = solve(A, b)
    assert ok.tolist() == [True, False, True, False, False, True]
    assert torch.equal(x[ok], good_x[ok])
    assert (x[~ok] == 0).all()


def test_solve_broadcasts_columns(generator: torch.Generator) -> None:
    """Also where torch would see a batch of vectors: one 4x4 right-hand side for four systems of four."""
    for batch in ((4,), (3, 4), (5,)):
        A = torch.randn(*batch, 4, 4, dtype=F64, generator=generator)
        b = torch.randn(4, 4, dtype=F64, generator=generator)
        x, good = solve(A, b)
        assert good.all()
        torch.testing.assert_close(A @ x, b.expand_as(A))
        torch.testing.assert_close(solve(A[..., :1, :, :], A)[0], torch.linalg.inv(A[..., :1, :, :]) @ A)
