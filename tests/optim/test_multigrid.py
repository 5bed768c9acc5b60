"""Variables that meet in pairs: the preconditioner is the inverse for few of them, positive for all, and sees along chains."""

import pytest
import torch
from torch import Tensor

from torchsfm.optim import Block, Term, schur_matrix_free, sparse_levenberg_marquardt
from torchsfm.optim.layout import lay_out
from torchsfm.optim.multigrid import FEW, PairGraph
from torchsfm.optim.schur import Elimination
from torchsfm.optim.terms import prepare


def between(a: Tensor, b: Tensor, way: Tensor, A: Tensor) -> Tensor:
    return (A @ (b - a - way)[..., None])[..., 0]


def near(a: Tensor, at: Tensor) -> Tensor:
    return 0.1 * (a - at)


def places(count: int, edges: int, generator: torch.Generator) -> tuple[dict[str, Block], list[Term]]:
    """Places joined at random, some with themselves or twice; some are fixed, some observed, some neither."""
    normal = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    i, j = torch.randint(count, (2, edges), generator=generator)
    j[:3] = i[:3]
    i[3:6], j[3:6] = j[6:9], i[6:9]
    block = Block(normal(count, 2), fixed=torch.rand(count, generator=generator) < 0.1)
    seen = torch.randint(count, (count // 4,), generator=generator)
    terms = [
        Term(between, ("x", "x"), (i, j), (normal(edges, 2), normal(edges, 2, 2))),
        Term(near, ("x",), (seen,), (normal(len(seen), 2),)),
    ]
    return {"x": block}, terms


def system(blocks: dict[str, Block], terms: list[Term]) -> tuple[Elimination, PairGraph]:
    double, counted, _ = prepare(blocks, terms)
    engine = Elimination(double, lay_out(double, counted, None), "pcg")
    engine.linearize({name: block.x for name, block in double.items()})
    assert isinstance(engine.plan, PairGraph)
    return engine, engine.plan


def test_few_variables_are_solved_for(generator: torch.Generator) -> None:
    blocks, terms = places(FEW // 2, 400, generator)
    engine, plan = system(blocks, terms)
    size = engine.layout.size
    weight = 1e-3 + torch.rand(size, generator=generator, dtype=torch.float64)
    A = engine.squares.dense()[:size, :size] + weight.diag()
    right = torch.randn(size, generator=generator, dtype=torch.float64)
    found = plan.preconditioner(engine.squares, [], weight)(right)
    assert torch.allclose(A @ found, right, atol=1e-9)


def test_the_preconditioner_is_symmetric_and_positive(generator: torch.Generator) -> None:
    # Sparse enough to fall into parts, some of them a variable alone.
    blocks, terms = places(FEW, 5 * FEW // 4, generator)
    engine, plan = system(blocks, terms)
    size = engine.layout.size
    apply = plan.preconditioner(engine.squares, [], torch.full((size,), 1e-2, dtype=torch.float64))
    M = torch.stack([apply(row) for row in torch.eye(size, dtype=torch.float64)])
    assert float((M - M.mT).abs().max()) < 1e-9 * float(M.abs().max())
    assert float(torch.linalg.eigvalsh(M)[0]) > 0


@pytest.mark.parametrize("views", [1000, 16000])
def test_long_chains_take_no_more_iterations(views: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    products: list[int] = []

    def counted(apply: schur_matrix_free.Apply, *rest: object) -> tuple[Tensor, bool]:
        products.append(0)

        def one(x: Tensor) -> Tensor:
            products[-1] += 1
            return apply(x)

        return plain(one, *rest)  # type: ignore[arg-type]

    plain = schur_matrix_free.conjugate_gradients
    monkeypatch.setattr(schur_matrix_free, "conjugate_gradients", counted)
    start = torch.arange(views - 3)
    i, j = start.repeat(3), torch.cat([start + k for k in (1, 2, 3)])
    x = torch.stack((torch.arange(views), torch.zeros(views)), 1).double()
    noise = 0.1 * torch.randn(len(i), 2, generator=generator, dtype=torch.float64)
    eye = torch.eye(2, dtype=torch.float64).expand(len(i), 2, 2)
    term = Term(between, ("x", "x"), (i, j), (x[j] - x[i] + noise, eye))
    blocks = {"x": Block(torch.zeros_like(x), fixed=torch.arange(views) == 0)}
    found = sparse_levenberg_marquardt(blocks, [term], linear_solver="pcg", function_tolerance=1e-8)
    (r,) = found.residuals
    slope = torch.zeros_like(x).index_add_(0, j, r).index_add_(0, i, -r)
    assert float(slope[1:].abs().max()) < 1e-4
    assert max(products) <= 8
