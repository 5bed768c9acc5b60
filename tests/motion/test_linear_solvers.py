"""The laws of the linear solvers: eight points or more for F, four or more for H."""

from collections.abc import Callable

import pytest
import torch
from chance import assert_share
from torch import Tensor
from two_view_scenes import F64, distance, fundamental, pixels, two_views

from torchsfm.linalg import determinant_3x3
from torchsfm.motion import fundamental_7pt, fundamental_8pt, homography_4pt, homography_dlt

Solver = Callable[..., Tensor]
SOLVERS = {"fundamental_8pt": fundamental_8pt, "homography_dlt": homography_dlt}
LEAST = {fundamental_8pt: 8, homography_dlt: 4}


@pytest.fixture(params=SOLVERS)
def solve(request: pytest.FixtureRequest) -> Solver:
    return SOLVERS[request.param]


def sample(solve: Solver, count: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    if solve is fundamental_8pt:
        X1, X2, E = two_views("random", count, n, generator)
        return pixels(X1), pixels(X2), fundamental(E)
    x1 = torch.rand(count, n, 2, dtype=F64, generator=generator) * 640
    spread = torch.tensor([[0.2, 0.2, 100], [0.2, 0.2, 100], [2e-4, 2e-4, 0.1]], dtype=F64)
    H = torch.eye(3, dtype=F64) + torch.randn(count, 3, 3, dtype=F64, generator=generator) * spread
    y = torch.nn.functional.pad(x1, (0, 1), value=1.0) @ H.mT
    return x1, y[..., :2] / y[..., 2:], H / H.norm(dim=(-2, -1), keepdim=True)


def error(found: Tensor, truth: Tensor) -> Tensor:
    return distance(found[..., None, :, :], torch.ones(1, dtype=torch.bool), truth)


@pytest.mark.parametrize("extra", [0, 1, 20])
def test_exact_data(solve: Solver, extra: int, generator: torch.Generator) -> None:
    x1, x2, truth = sample(solve, 1000, LEAST[solve] + extra, generator)
    model = solve(x1, x2)
    assert_share(error(model, truth) < 1e-8, 0.999)
    torch.testing.assert_close(model.norm(dim=(-2, -1)), torch.ones(1000, dtype=F64))
    single = solve(x1.float(), x2.float())
    assert single.dtype == torch.float32
    assert_share(error(single, truth) < 1e-2, 0.95)


def test_fundamental_has_rank_two(generator: torch.Generator) -> None:
    x1, x2, _ = sample(fundamental_8pt, 50, 12, generator)
    x2 = x2 + torch.randn(x2.shape, dtype=F64, generator=generator)
    F = fundamental_8pt(x1, x2)
    s = torch.linalg.svdvals(F)
    assert (s[:, 2] < 1e-14 * s[:, 0]).all()
    assert (determinant_3x3(F).abs() < 1e-14).all()


def test_noise_averages_out(solve: Solver, generator: torch.Generator) -> None:
    x1, x2, truth = sample(solve, 60, 400, generator)
    x1, x2 = (x + 0.5 * torch.randn(x.shape, dtype=F64, generator=generator) for x in (x1, x2))
    few = error(solve(x1[:, :25], x2[:, :25]), truth).median()
    many = error(solve(x1, x2), truth).median()
    # Four times fewer than 16 times more points would give: F is biased by the normalisation of its scale.
    assert many < 0.5 * few


def test_weights(solve: Solver, generator: torch.Generator) -> None:
    n = LEAST[solve] + 6
    x1, x2, truth = sample(solve, 30, n, generator)
    noisy = x2 + torch.randn(x2.shape, dtype=F64, generator=generator)
    # A weight of 2 is a point twice; 0 is a point that is not there, whatever stands in its place.
    weights = torch.ones(30, n, dtype=F64)
    weights[:, 0] = 2
    twice = solve(torch.cat((x1, x1[:, :1]), 1), torch.cat((noisy, noisy[:, :1]), 1))
    assert error(solve(x1, noisy, weights), twice).max() < 1e-9
    bad1, bad2 = x1.clone(), x2.clone()
    bad1[:, 1], bad2[:, 2], bad1[:, 3] = 1e5, float("nan"), float("inf")
    weights[:, 1:4] = 0
    assert error(solve(bad1, bad2, weights), truth).max() < 1e-7
    torch.testing.assert_close(solve(x1, noisy, weights * 1e6), solve(x1, noisy, weights), rtol=1e-6, atol=1e-10)


def test_agrees_with_the_minimal_solver(generator: torch.Generator) -> None:
    x1, x2, _ = sample(homography_dlt, 200, 4, generator)
    assert (error(homography_dlt(x1, x2), homography_4pt(x1, x2).model[:, 0]) < 1e-8).all()


def test_similarities_change_nothing(solve: Solver, generator: torch.Generator) -> None:
    x1, x2, _ = sample(solve, 20, 15, generator)
    x2 = x2 + torch.randn(x2.shape, dtype=F64, generator=generator)
    S = torch.tensor([[0.0, -30, 900], [30, 0, -5000], [0, 0, 1]], dtype=F64)
    model, moved = solve(x1, x2), solve(x1 @ S[:2, :2].mT + S[:2, 2], x2)
    expected = model @ torch.linalg.inv(S)
    assert error(moved, expected).max() < 1e-8


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_batches(solve: Solver, shape: tuple[int, ...], generator: torch.Generator) -> None:
    x1, x2, _ = sample(solve, 6, 11, generator)
    count = torch.Size(shape).numel()
    reference = solve(x1, x2)
    model = solve(x1[:count].reshape(*shape, 11, 2), x2[:count].reshape(*shape, 11, 2))
    assert model.shape == (*shape, 3, 3)
    # LAPACK's last bit may depend on where a matrix lies in memory.
    torch.testing.assert_close(model.reshape(-1, 3, 3), reference[:count], rtol=1e-9, atol=1e-13)
    assert solve(x1[:, None], x2[:2], torch.ones(11, dtype=F64)).shape == (6, 2, 3, 3)


def test_degenerate_elements_leave_neighbours_alone(solve: Solver, generator: torch.Generator) -> None:
    x1, x2, _ = sample(solve, 9, 12, generator)
    weights = torch.ones(9, 12, dtype=F64)
    reference = solve(x1, x2, weights)
    x1[1], x2[1] = x1[1, :1], x2[1, :1]
    x1[2, ..., 1] = x1[2, ..., 0]
    x1[3, 4, 0] = float("nan")
    x2[4, 0, 1] = float("inf")
    weights[5] = 0
    weights[6, 3:] = 0
    weights[7, 2] = -1
    for x in (x1, x2, weights):
        x.requires_grad_()
    model = solve(x1, x2, weights)
    assert torch.isfinite(model).all()
    assert torch.equal(model[[0, 8]], reference[[0, 8]])
    torch.testing.assert_close(model.norm(dim=(-2, -1)), torch.ones(9, dtype=F64))
    model.sum().backward()
    for x in (x1, x2, weights):
        assert x.grad is not None
        assert torch.isfinite(x.grad).all()


def test_planar_points_leave_a_solution(generator: torch.Generator) -> None:
    x1, x2, _ = sample(homography_dlt, 30, 20, generator)
    F = fundamental_8pt(x1, x2)
    h1, h2 = (torch.nn.functional.pad(x, (0, 1), value=1.0) for x in (x1, x2))
    line = h1 @ F.mT
    distance_to_line = ((h2 * line).sum(-1) / line[..., :2].norm(dim=-1)).abs()
    # The rank is enforced on one of many solutions, which costs some accuracy.
    assert distance_to_line.median() < 10


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own, where its forward derivatives are first used
def test_derivatives(solve: Solver, generator: torch.Generator) -> None:
    n = LEAST[solve] + 2
    x1, x2, _ = sample(solve, 2, n, generator)
    x1, x2 = x1 / 640 - 0.5, x2 / 640 - 0.5 + 0.01 * torch.randn(2, n, 2, dtype=F64, generator=generator)
    weights = 0.5 + torch.rand(2, n, dtype=F64, generator=generator)
    inputs = tuple(x.requires_grad_() for x in (x1, x2, weights))
    assert torch.autograd.gradcheck(solve, inputs, atol=1e-4, rtol=1e-3, check_forward_ad=True)
    weights = weights.detach()
    weights[:, 0] = 0
    x1.grad = None
    solve(x1, x2, weights.requires_grad_()).sum().backward()
    assert x1.grad is not None
    assert (x1.grad[:, 0] == 0).all()


def test_wrong_arguments(solve: Solver, unchecked: None) -> None:
    good = torch.zeros(10, 2)
    with pytest.raises(ValueError, match="wanted"):
        solve(good[:3], good[:3])
    with pytest.raises(ValueError, match="x2"):
        solve(good, good[:9])
    with pytest.raises(ValueError, match="weights"):
        solve(good, good, torch.ones(9))


@pytest.mark.reference
def test_against_opencv(generator: torch.Generator) -> None:
    cv2 = pytest.importorskip("cv2")
    x1, x2, _ = sample(fundamental_8pt, 20, 40, generator)
    x2 = x2 + 0.3 * torch.randn(x2.shape, dtype=F64, generator=generator)
    F = fundamental_8pt(x1, x2)
    for i in range(20):
        theirs, _ = cv2.findFundamentalMat(x1[i].numpy(), x2[i].numpy(), cv2.FM_8POINT)
        assert error(F[i], torch.from_numpy(theirs)) < 1e-4


def test_seven_of_eight_points_contain_the_same_matrix(generator: torch.Generator) -> None:
    x1, x2, _ = sample(fundamental_8pt, 100, 8, generator)
    minimal = fundamental_7pt(x1[:, :7], x2[:, :7])
    assert_share(distance(minimal.model, minimal.valid, fundamental_8pt(x1, x2)) < 1e-7, 0.99)
