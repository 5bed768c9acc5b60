import numpy as np
import pytest
import torch
from chance import assert_share
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchsfm.linalg import companion_roots, evaluate, real_roots, solve_cubic, solve_quadratic

F64 = torch.float64
SOLVERS = {2: solve_quadratic, 3: solve_cubic}


def from_roots(roots: Tensor, lead: Tensor | float = 1.0) -> Tensor:
    """Coefficients, lowest power first, of lead * prod (x - r)."""
    c = torch.ones(*roots.shape[:-1], 1, dtype=roots.dtype)
    for r in roots.unbind(-1):
        c = torch.nn.functional.pad(c, (1, 0)) - torch.nn.functional.pad(c * r[..., None], (0, 1))
    return c * lead


def missed(found: Tensor, real: Tensor, truth: Tensor) -> Tensor:
    """For each true root the distance, as an angle, to the nearest root found."""
    gap = torch.sin(torch.atan(truth)[..., :, None] - torch.atan(found)[..., None, :]).abs()
    return torch.where(real[..., None, :], gap, 9).amin(-1)


@pytest.mark.parametrize("degree", [2, 3])
def test_closed_forms_find_all_real_roots(degree: int, generator: torch.Generator) -> None:
    truth = torch.randn(2000, degree, dtype=F64, generator=generator) * 3
    lead = torch.randn(2000, 1, dtype=F64, generator=generator).exp()
    roots, real = SOLVERS[degree](from_roots(truth, lead))
    assert_share(real, 0.999)  # rounding may turn two very close roots into a complex pair
    separation = (truth[:, :, None] - truth[:, None]).abs() + 9 * torch.eye(degree, dtype=F64)
    apart = separation.amin((-2, -1)) > 0.05
    assert missed(roots, real, truth)[apart].max() < 1e-11


def test_quadratic_without_cancellation_and_linear() -> None:
    c = torch.tensor([[1.0, -1e9, 1.0], [-6.0, 3.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=F64)
    roots, real = solve_quadratic(c)
    assert real.tolist() == [[True, True], [False, True], [False, False], [True, False], [False, False]]
    torch.testing.assert_close(roots[0].sort().values, torch.tensor([1e-9, 1e9], dtype=F64), rtol=1e-15, atol=0)
    assert roots[1, 1] == 2
    assert torch.isfinite(roots).all()


def test_cubic_with_one_real_root(generator: torch.Generator) -> None:
    truth, a, b = torch.randn(3, 1000, dtype=F64, generator=generator)
    b = b.abs() + 0.1
    pair = torch.stack((a * a + b * b, -2 * a, torch.ones_like(a)), -1)
    c = torch.nn.functional.pad(pair, (1, 0)) - torch.nn.functional.pad(pair * truth[:, None], (0, 1))
    roots, real = solve_cubic(c)
    assert (real.sum(-1) == 1).all()
    assert missed(roots, real, truth[:, None]).max() < 1e-12


def test_cubic_triple_and_degenerate() -> None:
    c = torch.tensor(
        [[0.0, 0, 0, 2], [-1, 3, -3, 1], [1, 2, 3, 0], [float("nan"), 1, 1, 1], [1, 1, 1, float("inf")]], dtype=F64
    )
    roots, real = solve_cubic(c)
    assert torch.isfinite(roots).all()
    assert real[:2].any(-1).all()
    assert not real[2:].any()
    assert roots[0][real[0]].abs().max() < 1e-90
    assert (roots[1][real[1]] - 1).abs().max() < 1e-5


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4))
def test_cubic_agrees_with_numpy(coefficients: list[float]) -> None:
    # Cubes of smaller numbers underflow.
    coefficients = [c if abs(c) > 1e-60 else 0.0 for c in coefficients]
    c = torch.tensor(coefficients, dtype=F64)
    roots, real = solve_cubic(c)
    assert torch.isfinite(roots).all()
    scale = c.abs().amax() * roots.abs().clamp_min(1) ** 3
    assert (evaluate(c, roots).abs()[real] <= 1e-12 * scale[real]).all()
    if abs(coefficients[3]) > 1e-3:
        reference = np.roots(coefficients[::-1])
        simple = reference[
            (abs(reference.imag) < 1e-12) & (abs(reference[:, None] - reference + np.eye(len(reference))).min(1) > 1e-2)
        ]
        assert (missed(roots, real, torch.from_numpy(simple.real.copy())) < 1e-9).all()


@pytest.mark.parametrize("degree", [2, 3, 4, 5, 6, 8, 10, 13])
def test_real_roots_of_random_polynomials(degree: int, generator: torch.Generator) -> None:
    c = torch.randn(1500, degree + 1, dtype=F64, generator=generator)
    roots, real = real_roots(c)
    reference, is_root = companion_roots(c)
    slope = evaluate(c[..., 1:] * torch.arange(1, degree + 1), reference)
    # Pairs that are nearly double are not asked for.
    simple = is_root & (slope.abs() > 1e-5 * evaluate(c.abs(), reference.abs()))
    distance = missed(roots, real, reference)
    lost = (distance > 1e-9) & simple
    assert lost.sum() <= 0.0005 * simple.sum()
    wrong = (missed(reference, is_root, roots) > 1e-4) & real
    assert wrong.sum() <= 0.0005 * simple.sum()
    assert_share(evaluate(c, roots).abs()[real] <= 1e-13 * evaluate(c.abs(), roots.abs())[real], 0.999)


def test_real_roots_pairs_and_clusters(generator: torch.Generator) -> None:
    middle = torch.randn(800, 1, dtype=F64, generator=generator)
    gap = 10 ** (-4 * torch.rand(800, 1, dtype=F64, generator=generator))
    rest = torch.randn(800, 3, 2, dtype=F64, generator=generator)
    c = from_roots(torch.cat((middle, middle + gap), -1))
    for k in range(3):  # and three complex pairs
        a, b = rest[:, k].unbind(-1)
        pair = torch.stack((a * a + b * b + 0.1, -2 * a, torch.ones_like(a)), -1)
        c = sum(torch.nn.functional.pad(c * pair[:, i : i + 1], (i, 2 - i)) for i in range(3))
    roots, real = real_roots(c)
    distance = missed(roots, real, torch.cat((middle, middle + gap), -1))
    assert_share((distance < 1e-6).all(-1), 0.995)


@pytest.mark.parametrize("degrees", [1, 6])
def test_four_roots_within_few_degrees(degrees: float, generator: torch.Generator) -> None:
    """Polynomials all of whose roots are real; as angles, no two of the four are nearer than a twentieth of a degree."""
    angle = torch.rand(5000, 7, dtype=F64, generator=generator) * torch.pi
    near = angle[:, :1] + torch.deg2rad(degrees * torch.rand(5000, 4, dtype=F64, generator=generator))
    c = torch.ones(5000, 1, dtype=F64)
    for a in torch.cat((near, angle[:, 1:]), -1).split(1, -1):
        c = torch.nn.functional.pad(c, (1, 0)) * a.cos() - torch.nn.functional.pad(c, (0, 1)) * a.sin()
    apart = near.sort(-1).values.diff(dim=-1).amin(-1) > torch.deg2rad(near.new_tensor(0.05))
    assert_share(real_roots(c)[1].all(-1)[apart], 0.997)


def test_real_roots_at_zero_and_infinity() -> None:
    c = torch.tensor(
        [[0.0, 0, -1, 0, 1], [0, 1, 2, 0, 0], [0, 0, 0, 0, 0], [1, float("nan"), 0, 0, 1], [1, 0, 0, 0, 1]], dtype=F64
    )
    roots, real = real_roots(c)
    assert torch.isfinite(roots).all()
    assert missed(roots[:1], real[:1], torch.tensor([[-1.0, 1.0]], dtype=F64)).max() < 1e-12
    assert missed(roots[1:2], real[1:2], torch.tensor([[0.0, -0.5]], dtype=F64)).max() < 1e-12
    assert not real[2:].any()


@pytest.mark.parametrize("solver", [real_roots, companion_roots, solve_cubic])
def test_roots_batch_equals_loop(solver, generator: torch.Generator) -> None:
    c = torch.randn(3, 7, 4, dtype=F64, generator=generator)
    c[1, 2] = float("nan")
    roots, real = solver(c)
    assert roots.shape == real.shape == (3, 7, 3)
    for i in range(3):
        for j in range(7):
            one, ok = solver(c[i, j])
            assert torch.equal(one, roots[i, j])
            assert torch.equal(ok, real[i, j])
    assert solver(c[:0])[0].shape == (0, 7, 3)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
@pytest.mark.parametrize("solver", [real_roots, solve_cubic, solve_quadratic])
def test_derivatives_of_roots(solver, generator: torch.Generator) -> None:
    truth = torch.tensor([[-2.0, 0.25, 3.0], [1.0, 1.5, -7.0]], dtype=F64)[:, : 2 if solver is solve_quadratic else 3]
    c = from_roots(truth, 2.0).requires_grad_()
    assert solver(c)[1].all()
    assert torch.autograd.gradcheck(lambda c: solver(c)[0], c, check_forward_ad=True)
    # No real root and a double one: no derivative, and no NaN.
    c = torch.tensor([[1.0, 0, 1, 0], [0, 0, 1, 1]], dtype=F64)[:, : truth.shape[1] + 1].clone().requires_grad_()
    solver(c)[0].sum().backward()
    assert c.grad is not None
    assert torch.isfinite(c.grad[0]).all()
