import pytest
import torch

from torchsfm.linalg import nearest_psd, nearest_rank, nearest_rotation

F64 = torch.float64


def test_nearest_rotation_is_one_and_none_is_nearer(generator: torch.Generator) -> None:
    A = torch.randn(200, 3, 3, dtype=F64, generator=generator)
    R = nearest_rotation(A)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=F64).expand(200, -1, -1))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(200, dtype=F64))
    turns = nearest_rotation(torch.eye(3, dtype=F64) + 0.3 * torch.randn(50, 1, 3, 3, dtype=F64, generator=generator))
    assert ((turns @ R - A).norm(dim=(-2, -1)) >= (R - A).norm(dim=(-2, -1)) - 1e-12).all()


def test_nearest_rank_is_eckart_young(generator: torch.Generator) -> None:
    for shape, rank in (((3, 3), 2), ((5, 3), 1), ((3, 6), 2), ((4, 4), 4)):
        A = torch.randn(7, *shape, dtype=F64, generator=generator)
        B = nearest_rank(A, rank)
        s, t = torch.linalg.svdvals(A), torch.linalg.svdvals(B)
        torch.testing.assert_close(t[..., :rank], s[..., :rank])
        assert (t[..., rank:] < 1e-12).all()
        torch.testing.assert_close((A - B).norm(dim=(-2, -1)), s[..., rank:].norm(dim=-1), atol=1e-12, rtol=1e-9)


def test_nearest_rank_out_of_range(unchecked: None) -> None:
    with pytest.raises(ValueError, match="rank"):
        nearest_rank(torch.eye(3), 4)


def test_nearest_psd_is_higham(generator: torch.Generator) -> None:
    A = torch.randn(50, 4, 4, dtype=F64, generator=generator)
    B = nearest_psd(A)
    assert torch.equal(B, B.mT)
    assert torch.linalg.eigvalsh(B).min() > -1e-13
    S = 0.5 * (A + A.mT)
    # The residual is negative semidefinite and orthogonal to the answer.
    assert torch.linalg.eigvalsh(S - B).max() < 1e-13
    assert ((S - B) * B).sum((-2, -1)).abs().max() < 1e-12


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (nearest_rotation, (3, 3)),
        (nearest_rotation, (4, 4)),
        (nearest_psd, (4, 4)),
        (lambda A: nearest_rank(A, 2), (3, 3)),
        (lambda A: nearest_rank(A, 1), (4, 2)),
        (lambda A: nearest_rank(A, 2), (3, 5)),
    ],
)
def test_derivatives(function, shape: tuple[int, int], generator: torch.Generator) -> None:
    A = torch.randn(3, *shape, dtype=F64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(function, A, check_forward_ad=True)


def test_derivatives_where_singular_values_coincide() -> None:
    eye = torch.eye(3, dtype=F64).requires_grad_()
    assert torch.autograd.gradcheck(nearest_rotation, eye)
    essential = torch.diag(torch.tensor([1.0, 1, 0], dtype=F64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda A: nearest_rank(A, 2), essential)


@pytest.mark.parametrize("function", [nearest_rotation, nearest_psd, lambda A: nearest_rank(A, 2)])
def test_bad_elements_stay_alone(function, generator: torch.Generator) -> None:
    A = torch.randn(4, 3, 3, dtype=F64, generator=generator)
    reference = function(A)
    A[1, 0, 0], A[2] = float("nan"), 0
    A.requires_grad_()
    B = function(A)
    assert torch.isfinite(B).all()
    assert torch.equal(B[[0, 3]], reference[[0, 3]])
    B.sum().backward()
    assert A.grad is not None
    assert torch.isfinite(A.grad).all()
    assert function(A[:0]).shape == (0, 3, 3)


@pytest.mark.parametrize(
    "s", [(1, 0.1, 1e-3), (1, 1e-4, 1e-7), (1, 1e-6, 0), (1, 0.5, 0.45), (1, 1, 1), (1, 0, 0), (1, 1e-14, 0)]
)
@pytest.mark.parametrize("size", [1e-30, 1.0, 1e40])
def test_rank_two_of_three(s, size, generator):
    """Next to, and far from, matrices whose nearest one is not unique, the distance is the least singular value."""
    U, V = (torch.linalg.qr(torch.randn(50, 3, 3, dtype=torch.float64, generator=generator)).Q for _ in range(2))
    values = torch.tensor(s, dtype=torch.float64)
    A = (U * values) @ V.mT
    B = nearest_rank(A * size, 2) / size
    assert ((A - B).norm(dim=(-2, -1)) - values[2]).abs().max() < 2e-14
    assert torch.linalg.svdvals(B)[..., 2].max() < 2e-14
    one = torch.stack([nearest_rank(a * size, 2) / size for a in A])
    assert torch.equal(one, B)
    assert torch.equal(nearest_rank((A * size).requires_grad_(), 2).detach() / size, B)
