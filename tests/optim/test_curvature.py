"""The exact Hessian in sparse form is the one that automatic differentiation of the whole cost gives."""

import pytest
import torch
from torch import Tensor

from torchsfm.bundle import bundle_adjust
from torchsfm.optim import Block, Cauchy, Huber, RigidMotion, Term, schur, sparse_levenberg_marquardt
from torchsfm.optim.layout import lay_out
from torchsfm.optim.schur import Elimination
from torchsfm.optim.terms import term_cost, term_residual
from torchsfm.simulation import random_bundle_problem

F64 = torch.float64


def pinhole(pose: Tensor, focal: Tensor, point: Tensor, x: Tensor) -> Tensor:
    X = (pose[:, :9].unflatten(1, (3, 3)) @ point[:, :, None])[:, :, 0] + pose[:, 9:]
    return focal * X[:, :2] / X[:, 2:] - x


@pytest.fixture
def problem(generator: torch.Generator) -> tuple[dict[str, Block], list[Term]]:
    """Six views by two cameras of which two poses and some points are held, and a prior on the cameras."""
    views, points = 6, 12
    pose = torch.cat(
        (torch.eye(3, dtype=F64).flatten().expand(views, 9), torch.tensor([0.0, 0.0, 6.0], dtype=F64).expand(views, 3)), 1
    )
    pose = RigidMotion().retract(pose, 0.3 * torch.randn(views, 6, generator=generator, dtype=F64))
    point = torch.randn(points, 3, generator=generator, dtype=F64)
    focal = torch.tensor([[500.0], [700.0]], dtype=F64)
    view, seen = torch.cartesian_prod(torch.arange(views), torch.arange(points)).T
    index = (view, view % 2, seen)
    x = pinhole(pose[view], focal[view % 2], point[seen], torch.zeros(1, dtype=F64))
    x = x + 2 * torch.randn(x.shape, generator=generator, dtype=F64)
    weights = 0.5 + torch.rand(len(x), generator=generator, dtype=F64)
    blocks = {
        "pose": Block(pose, RigidMotion(), torch.arange(views) < 2),
        "focal": Block(focal),
        "point": Block(point, None, torch.arange(points) >= 10),
    }
    known = Term(lambda f: torch.sin(f / 50), ("focal",), (torch.arange(2),))
    return blocks, [Term(pinhole, ("pose", "focal", "point"), index, (x,), weights=weights), known]


@pytest.mark.parametrize("loss", [None, Cauchy(3.0), Huber(2.0)])
@pytest.mark.parametrize("eliminate", ["point", "pose", None])
@pytest.mark.parametrize("seconds", [0.0, torch.inf])
def test_the_step_is_newtons(
    problem: tuple[dict[str, Block], list[Term]],
    loss: object,
    eliminate: str | None,
    seconds: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(schur, "estimate_pairs", lambda layout: seconds)
    blocks, (main, known) = problem
    terms = [Term(main.residual, main.blocks, main.index, main.data, loss, main.weights), known]
    x = sparse_levenberg_marquardt(blocks, terms, eliminate=eliminate, function_tolerance=1e-3).x
    blocks = {name: Block(x[name].mT.contiguous().mT, b.manifold, b.fixed) for name, b in blocks.items()}
    x = {name: b.x for name, b in blocks.items()}
    layout = lay_out(blocks, terms, eliminate)
    engine = schur.Elimination(blocks, layout, "dense")
    step, promise, solved, *_ = engine.curve(x, engine.linearize(x)).step(1e-13)
    assert solved
    widths = {name: (layout.free[name].numel(), blocks[name].tangent) for name in step}

    def cost(flat: Tensor) -> Tensor:
        rest = iter(flat.split([a * b for a, b in widths.values()]))
        steps = {name: next(rest).view(shape) for name, shape in widths.items()}
        moved = {
            n: x[n].index_copy(0, layout.free[n], b.retract(x[n][layout.free[n]], steps[n])) if n in steps else x[n]
            for n, b in blocks.items()
        }
        return torch.stack([term_cost(t, term_residual(t, moved)) for t in terms]).sum()

    zero = torch.zeros(sum(a * b for a, b in widths.values()), dtype=F64)
    slope, H = torch.func.jacrev(cost)(zero), torch.func.jacrev(torch.func.jacrev(cost))(zero)
    newton = -torch.linalg.solve(H, slope)
    torch.testing.assert_close(torch.cat([step[name].flatten() for name in widths]), newton, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(promise, -(slope @ newton) / 2, rtol=1e-6, atol=0)


def test_a_few_bad_steps_do_not_hold_back_the_others(generator: torch.Generator) -> None:
    """Of a step, each eliminated variable takes the part that is best for it alone."""
    offset = torch.randn(40, 1, generator=generator, dtype=F64)
    index = torch.arange(40)
    term = Term(lambda c, p, o: torch.atan(p - o) + 0 * c, ("c", "p"), (index * 0, index), (offset,))
    blocks = {"c": Block(torch.zeros(1, 1, dtype=F64)), "p": Block(torch.zeros(40, 1, dtype=F64))}
    x = {name: b.x for name, b in blocks.items()}
    engine = schur.Elimination(blocks, lay_out(blocks, [term], "p"), "dense")
    order = engine.layout.free["p"]
    # Overshoot for some, the very step for others.
    factor = torch.where(torch.arange(40) % 2 == 0, 1.0, 4.0).double()[:, None]
    step = {"c": torch.zeros(1, 1, dtype=F64), "p": (offset * factor)[order]}
    trial = schur.move(blocks, engine.layout, x, step)
    better = engine.settling.shorten(x, step, trial)["p"]
    torch.testing.assert_close(better, offset)


def test_eliminated_variables_settle_each_at_its_own_minimum(generator: torch.Generator) -> None:
    """Gauss-Newton steps overshoot from afar, for ever where they are not damped, and for each variable as it needs."""
    offset = 3 * torch.randn(40, 1, generator=generator, dtype=F64)
    index = torch.arange(40)
    term = Term(lambda c, p, o: torch.atan(p - o) + 0 * c, ("c", "p"), (index * 0, index), (offset,))
    blocks = {"c": Block(torch.zeros(1, 1, dtype=F64)), "p": Block(torch.zeros(40, 1, dtype=F64))}
    x = {name: b.x for name, b in blocks.items()}
    settling = schur.Elimination(blocks, lay_out(blocks, [term], "p"), "dense").settling
    once, often = settling.settle(x)["p"], settling.settle(x, 60, 1e-20)["p"]
    torch.testing.assert_close(often, offset, rtol=0, atol=1e-8)
    better = torch.atan(once - offset).square() < torch.atan(offset).square()
    assert torch.equal(once[~better], x["p"][~better])
    assert not bool(better.all())
    assert torch.equal(settling.settle(x, 40, torch.inf)["p"], once)


@pytest.mark.parametrize("eliminate", ["p", None])
def test_no_derivative_along_a_flat_valley(eliminate: str | None, generator: torch.Generator) -> None:
    """Two linked places between two far measurements: the answer follows these across the line they lie on, not along it."""
    n = 12

    def noise() -> Tensor:
        return torch.randn(n, 2, generator=generator, dtype=F64)

    start, along = 5 * noise(), torch.nn.functional.normalize(noise(), dim=-1)
    a, b = start - 9 * along, start + 7 * along
    blocks, each = {"p": Block(start + 0.1 * noise()), "q": Block(start + 0.1 * noise())}, torch.arange(n)
    first = a.clone().requires_grad_()
    far = [Term(lambda x, m: x - m, (name,), (each,), (m,), Huber(1.0)) for name, m in (("p", first), ("q", b))]
    link = Term(lambda p, q: q - p, ("p", "q"), (each, each))
    found = sparse_levenberg_marquardt(blocks, [*far, link], eliminate=eliminate)
    k1, k2 = (1 / (found.x[name] - m).detach().norm(dim=1) for name, m in (("p", a), ("q", b)))
    share = {"p": k1 * (k2 + 1) / (k1 + k2 + k1 * k2), "q": k1 / (k1 + k2 + k1 * k2)}
    across = torch.eye(2, dtype=F64) - along[:, :, None] * along[:, None]
    for name, k in ((name, k) for name in ("p", "q") for k in range(2)):
        (slope,) = torch.autograd.grad(found.x[name][:, k].sum(), first, retain_graph=True)
        torch.testing.assert_close(slope, share[name][:, None] * across[:, k], rtol=1e-4, atol=1e-5)


def test_newton_steps_are_for_the_last_digits(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a thousandth of the cost may be left, their Hessian costs more than they gain."""
    problems = [random_bundle_problem(6, 40, 160, noise=1.0, outliers=0.2, generator=generator).problem for _ in range(4)]
    calls = []
    curve = Elimination.curve
    monkeypatch.setattr(Elimination, "curve", lambda *a, **k: calls.append(1) or curve(*a, **k))

    def newton_steps(tolerance: float) -> int:
        calls.clear()
        for problem in problems:
            bundle_adjust(problem, free=("focal", "k1"), loss=Cauchy(1.0), tolerance=tolerance, max_iterations=60)
        return len(calls)

    assert newton_steps(1e-3) == 0
    assert newton_steps(1e-9) > 0
