import pytest
import torch
from torch import Tensor

from torchsfm.optim import attach_implicit, attach_optimum

F64 = torch.float64


def linear(y: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return (a @ y[..., None])[..., 0] - b


def solve(a: Tensor, b: Tensor) -> Tensor:
    return attach_implicit(linear, torch.linalg.lstsq(a.detach(), b.detach()[..., None]).solution[..., 0], a, b)


@pytest.fixture
def system(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    return (
        torch.randn(5, 3, 3, generator=generator, dtype=F64, requires_grad=True),
        torch.randn(5, 3, generator=generator, dtype=F64, requires_grad=True),
    )


def test_derivative_of_a_linear_system(system: tuple[Tensor, Tensor]) -> None:
    assert torch.autograd.gradcheck(solve, system)


def test_inside_function_transforms(system: tuple[Tensor, Tensor]) -> None:
    a, b = (v.detach() for v in system)
    wanted = torch.linalg.inv(a)
    found = torch.func.vmap(torch.func.jacrev(solve, argnums=1))(a, b)
    torch.testing.assert_close(found, wanted)


def test_value_is_untouched_and_free_without_gradient(system: tuple[Tensor, Tensor]) -> None:
    calls = []

    def watched(y: Tensor, a: Tensor, b: Tensor) -> Tensor:
        calls.append(1)
        return linear(y, a, b)

    y = torch.linalg.solve(*system).detach() + 1e-9
    assert attach_implicit(watched, y, *(v.detach() for v in system)) is not None
    with torch.no_grad():
        attach_implicit(watched, y, *system)
    assert not calls
    assert torch.equal(attach_implicit(watched, y, *system), y)
    assert calls


def test_redundant_equations_and_several_trailing_dimensions(generator: torch.Generator) -> None:
    """A rotation-like matrix root: Y'Y = A with Y symmetric, nine unknowns, eighteen equations."""
    root = torch.randn(4, 3, 3, generator=generator, dtype=F64)
    root = root @ root.mT + torch.eye(3, dtype=F64)
    square = (root @ root).requires_grad_()

    def equations(y: Tensor, a: Tensor) -> Tensor:
        return torch.cat(((y @ y - (a + a.mT) / 2).flatten(-2), (y - y.mT).flatten(-2)), -1)

    def matrix_root(a: Tensor) -> Tensor:
        values, vectors = torch.linalg.eigh(((a + a.mT) / 2).detach())
        return attach_implicit(equations, vectors @ torch.diag_embed(values.sqrt()) @ vectors.mT, a, dims=2)

    assert torch.autograd.gradcheck(matrix_root, (square,), eps=1e-6)


def test_singular_and_invalid_elements_have_zero_gradient(generator: torch.Generator) -> None:
    a = torch.randn(5, 3, 3, generator=generator, dtype=F64)
    a[1] = 0
    a[2] = torch.nan
    a[3, 2] = a[3, 1]
    b = torch.randn(5, 3, generator=generator, dtype=F64)
    valid = torch.tensor([True, True, True, True, False])
    a.requires_grad_()
    b.requires_grad_()
    y = attach_implicit(linear, torch.ones(5, 3, dtype=F64), a, b, valid=valid)
    assert torch.equal(y, torch.ones_like(y))
    y.sum().backward()
    for gradient in (a.grad, b.grad):
        assert gradient.isfinite().all()
        assert gradient[0].abs().sum() > 0
        assert (gradient[1:] == 0).all()


def test_slots_share_a_sample(generator: torch.Generator) -> None:
    """Both roots of a quadratic; the sample carries a slot dimension of size 1, and one slot is not a solution."""
    c = torch.tensor([[1.0, -3.0, 2.0], [1.0, 0.0, 1.0]], dtype=F64, requires_grad=True)
    valid = torch.tensor([[True, True], [False, False]])

    def roots(c: Tensor) -> Tensor:
        half = -c[:, 1].detach() / (2 * c[:, 0].detach())
        discriminant = (half.square() - c[:, 2].detach() / c[:, 0].detach()).clamp_min(0).sqrt()
        y = torch.stack((half - discriminant, half + discriminant), -1)[..., None]
        return attach_implicit(
            lambda y, c: (c[..., :1] * y + c[..., 1:2]) * y + c[..., 2:], y, c[:, None], valid=valid[: len(c)]
        )

    assert torch.autograd.gradcheck(roots, (c[:1].detach().requires_grad_(),))
    (gradient,) = torch.autograd.grad(roots(c).sum(), c)
    assert (gradient[1] == 0).all()


def test_optimum(generator: torch.Generator) -> None:
    b = torch.randn(6, 2, generator=generator, dtype=F64, requires_grad=True)

    def centre(b: Tensor) -> Tensor:
        """The minimum of |y - b^3|^2 + |y|^4, by Newton's method."""
        y = torch.zeros_like(b.detach())
        for _ in range(60):
            g = 2 * (y - b.detach() ** 3) + 4 * y.square().sum(-1, keepdim=True) * y
            h = (2 + 4 * y.square().sum(-1))[:, None, None] * torch.eye(2, dtype=F64) + 8 * y[:, :, None] * y[:, None]
            y = y - torch.linalg.solve(h, g)
        return attach_optimum(lambda y, b: (y - b**3).square().sum(-1) + y.square().sum(-1).square(), y, b)

    assert torch.autograd.gradcheck(centre, (b,))


def test_numbers_without_dimensions() -> None:
    a = torch.tensor(2.0, dtype=F64, requires_grad=True)
    root = attach_implicit(lambda y, a: (y * y - a)[..., None], a.detach().sqrt(), a, dims=0)
    assert root.shape == ()
    assert torch.allclose(torch.autograd.grad(root, a)[0], 0.5 / a.detach().sqrt())
    valid = torch.tensor(False)
    nothing = attach_implicit(lambda y, a: (y * y - a)[..., None], a.detach().sqrt(), a, dims=0, valid=valid)
    assert torch.autograd.grad(nothing, a)[0] == 0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
def test_optimum_in_forward_mode_and_inside_function_transforms() -> None:
    def optimum(x: Tensor) -> Tensor:
        # The y that makes |y - x^2|^2 + |y - 1|^2 least.
        objective = lambda y, x: ((y - x * x) ** 2 + (y - 1) ** 2).sum(-1)  # noqa: E731
        return attach_optimum(objective, (x.detach() ** 2 + 1) / 2, x)

    x = torch.tensor([[0.5, -2.0], [3.0, 1.0]], dtype=F64)
    tangent = torch.tensor([[1.0, 2.0], [-1.0, 0.5]], dtype=F64)
    with torch.autograd.forward_ad.dual_level():
        moved = torch.autograd.forward_ad.unpack_dual(optimum(torch.autograd.forward_ad.make_dual(x, tangent)))
        assert torch.allclose(moved.tangent, x * tangent)
    assert torch.allclose(torch.func.grad(lambda x: optimum(x).sum())(x), x)
