import dataclasses

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim import Block, Huber, Term, layout, schur, schur_matrix_free, solver_choice, sparse_levenberg_marquardt

F64 = torch.float64


@pytest.fixture
def chain(generator: torch.Generator) -> tuple[dict[str, Block], list[Term]]:
    """Stations along a road measure landmarks near them; two stations share a scale. Priors hold both ends."""
    stations, marks = 24, 200
    station = torch.stack((torch.arange(stations, dtype=F64), torch.zeros(stations, dtype=F64)), 1)
    centre = torch.rand(marks, generator=generator, dtype=F64) * (stations - 1)
    mark = torch.stack((centre, 1 + torch.rand(marks, generator=generator, dtype=F64)), 1)
    near = (station[:, None, 0] - centre).abs() < 5
    i, j = near.nonzero().unbind(1)
    scale = 1 + 0.1 * torch.randn(stations // 2, 1, generator=generator, dtype=F64)

    def measure(s: Tensor, k: Tensor, m: Tensor, d: Tensor) -> Tensor:
        return (k * (m - s) - d) / 0.01

    d = scale[i // 2] * (mark[j] - station[i]) + 0.01 * torch.randn(len(i), 2, generator=generator, dtype=F64)
    hold = Term(lambda s, o: (s - o) / 0.01, ("station",), (torch.tensor([0, 23]),), (station[[0, 23]],))
    start = station + 0.1 * torch.randn(station.shape, generator=generator, dtype=F64)
    blocks = {
        "station": Block(start),
        "scale": Block(torch.ones_like(scale)),
        "mark": Block(mark + 0.1 * torch.randn(mark.shape, generator=generator, dtype=F64)),
    }
    return blocks, [Term(measure, ("station", "scale", "mark"), (i, i // 2, j), (d,)), hold]


@pytest.mark.parametrize("eliminate", ["mark", None])
@pytest.mark.parametrize("loss", [None, Huber(1.0)])
def test_the_minimum_is_the_dense_one(chain: tuple[dict[str, Block], list[Term]], eliminate: str | None, loss: object) -> None:
    blocks, terms = chain
    terms = [dataclasses.replace(terms[0], loss=loss), terms[1]]
    options = {"eliminate": eliminate, "function_tolerance": 1e-9, "max_iterations": 60}
    dense = sparse_levenberg_marquardt(blocks, terms, linear_solver="dense", **options)
    inexact = sparse_levenberg_marquardt(blocks, terms, linear_solver="pcg", **options)
    assert inexact.cost == pytest.approx(dense.cost, rel=1e-6)
    if loss is None:
        assert dense.status == inexact.status == Status.OK
        for name in blocks:
            torch.testing.assert_close(inexact.x[name], dense.x[name], rtol=0, atol=1e-4)


def test_solved_to_the_end_it_is_the_dense_step(
    chain: tuple[dict[str, Block], list[Term]], monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks, terms = chain
    found = layout.lay_out(blocks, terms, "mark")
    x = {name: b.x for name, b in blocks.items()}
    dense, promised, *_ = schur.Elimination(blocks, found, "dense").linearize(x).step(1e-4)
    monkeypatch.setattr(schur_matrix_free, "FORCING", 0.0)
    iterative, model, solved, *_ = schur.Elimination(blocks, found, "pcg").linearize(x).step(1e-4)
    assert solved
    torch.testing.assert_close(model, promised)
    for name, step in dense.items():
        torch.testing.assert_close(iterative[name], step, rtol=1e-7, atol=1e-9)


def test_steps_that_are_not_solved_to_the_end_are_no_end(
    chain: tuple[dict[str, Block], list[Term]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Conjugate gradients that came to their limit promise less than is left."""
    monkeypatch.setattr(schur_matrix_free, "ITERATIONS", 2)
    options = {"eliminate": "mark", "linear_solver": "pcg", "function_tolerance": 1e-4, "max_iterations": 200}
    assert sparse_levenberg_marquardt(*chain, **options).status == Status.NOT_CONVERGED


def test_clusters_are_what_occurs_together(chain: tuple[dict[str, Block], list[Term]]) -> None:
    """A scale has two stations: three clusters of each pair; with a scale for each station there is one cluster for both."""
    blocks, terms = chain
    x = {name: b.x for name, b in blocks.items()}
    shared = schur.Elimination(blocks, layout.lay_out(blocks, terms, "mark"), "pcg")
    assert [tuple(g.shape) for g in shared.plan.groups] == [(12, 1), (24, 2)]
    own = blocks | {"scale": Block(torch.ones(24, 1, dtype=F64))}
    i, _, j = terms[0].index
    terms = [dataclasses.replace(terms[0], index=(i, i, j)), terms[1]]
    single = schur.Elimination(own, layout.lay_out(own, terms, "mark"), "pcg")
    assert [tuple(g.shape) for g in single.plan.groups] == [(24, 3)]
    assert sorted(single.plan.groups[0].flatten().tolist()) == list(range(72))
    assert x.keys() == own.keys()


def test_auto_takes_it_for_large_systems_only(chain: tuple[dict[str, Block], list[Term]]) -> None:
    blocks, terms = chain
    small = layout.lay_out(blocks, terms, "mark")
    assert not solver_choice.too_large(small)
    assert solver_choice.too_large(dataclasses.replace(small, size=solver_choice.LARGEST + 1))


def test_memory_does_not_grow_with_the_square_of_the_retained(generator: torch.Generator) -> None:
    """Thirty thousand retained numbers, whose dense system would take 7 GB."""
    stations, marks = 15_000, 20_000
    j = torch.arange(marks).repeat_interleave(3)
    i = (j * 7919 + torch.arange(3).repeat(marks) * 13) % stations
    truth = torch.randn(stations, 2, generator=generator, dtype=F64), torch.randn(marks, 2, generator=generator, dtype=F64)
    d = truth[1][j] - truth[0][i]
    term = Term(lambda s, m, d: m - s - d, ("station", "mark"), (i, j), (d,))
    blocks = {"station": Block(torch.zeros(stations, 2, dtype=F64)), "mark": Block(torch.zeros(marks, 2, dtype=F64))}
    result = sparse_levenberg_marquardt(blocks, [term], eliminate="mark", max_iterations=3)
    assert result.cost < 1e-3 * result.initial_cost


def test_wrong_solver(chain: tuple[dict[str, Block], list[Term]], unchecked: None) -> None:
    with pytest.raises(ValueError, match="linear_solver"):
        sparse_levenberg_marquardt(*chain, linear_solver="qr")


@pytest.mark.parametrize("solver", ["dense", "sparse", "pcg"])
def test_steps_have_no_part_along_motions_at_rest(
    chain: tuple[dict[str, Block], list[Term]], solver: solver_choice.Solver
) -> None:
    blocks, terms = chain
    road = torch.tensor([1.0, 0.0], dtype=F64)
    blocks["station"] = dataclasses.replace(blocks["station"], rest=lambda x: road.expand(len(x), 2)[..., None])
    found = layout.lay_out(blocks, terms, "mark")
    system = schur.Elimination(blocks, found, solver).linearize({name: b.x for name, b in blocks.items()})
    # Measured by what the residuals say of each station.
    precision = system.diagonal[:48].view(24, 2)
    part = (system.step(1e-4).delta["station"] * precision)[:, 0].sum() / precision[:, 0].sum()
    free = dataclasses.replace(system, rest=None).step(1e-4).delta["station"]
    assert part.abs() < 1e-5 * (free * precision)[:, 0].sum().abs() / precision[:, 0].sum()
    result = sparse_levenberg_marquardt(blocks, terms, linear_solver=solver, eliminate="mark", max_iterations=200)
    assert result.status == Status.OK
