"""Problems that are badly put: a status or a ValueError, finite numbers, and nothing else changed."""

import dataclasses

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim import Block, SparseResult, Term, sparse_levenberg_marquardt

F64 = torch.float64
Problem = tuple[dict[str, Block], Term]


def measure(s: Tensor, m: Tensor, d: Tensor) -> Tensor:
    """Distance and height of a mark from a station."""
    away = m - s
    return torch.stack((away.square().sum(1).sqrt(), away[:, 1]), 1) - d


def make(generator: torch.Generator, stations: int = 5, marks: int = 12) -> Problem:
    station = torch.randn(stations, 2, generator=generator, dtype=F64) * 3
    mark = torch.randn(marks, 2, generator=generator, dtype=F64) * 3
    i, j = torch.cartesian_prod(torch.arange(stations), torch.arange(marks)).T
    d = measure(station[i], mark[j], torch.zeros(1, 2, dtype=F64))
    d = d + 0.01 * torch.randn(d.shape, generator=generator, dtype=F64)
    start = {
        "station": station + 0.1 * torch.randn(station.shape, generator=generator, dtype=F64),
        "mark": mark + 0.1 * torch.randn(mark.shape, generator=generator, dtype=F64),
    }
    fixed = torch.arange(stations) < 2
    blocks = {"station": Block(start["station"], None, fixed), "mark": Block(start["mark"])}
    return blocks, Term(measure, ("station", "mark"), (i, j), (d,))


@pytest.fixture
def problem(generator: torch.Generator) -> Problem:
    return make(generator)


@pytest.fixture(params=["dense", "sparse", "pcg"])
def solver(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def solve(blocks: dict[str, Block], term: Term, solver: str) -> SparseResult:
    result = sparse_levenberg_marquardt(
        blocks, [term], eliminate="mark", function_tolerance=1e-12, linear_solver=solver, max_iterations=100
    )
    assert all(v.isfinite().all() for v in result.x.values())
    return result


def test_two_problems_that_do_not_meet(generator: torch.Generator, solver: str) -> None:
    """Together they end where each ends alone."""
    (a, left), (b, right) = make(generator), make(generator, 4, 9)
    blocks = {
        name: Block(
            torch.cat((a[name].x, b[name].x)),
            None,
            None if name == "mark" else torch.cat((a[name].fixed, b[name].fixed)),
        )
        for name in a
    }
    index = (torch.cat((left.index[0], right.index[0] + 5)), torch.cat((left.index[1], right.index[1] + 12)))
    both = dataclasses.replace(left, index=index, data=(torch.cat((left.data[0], right.data[0])),))
    together, one, two = solve(blocks, both, solver), solve(a, left, solver), solve(b, right, solver)
    assert together.status == Status.OK
    assert together.cost == pytest.approx(one.cost + two.cost, rel=1e-9)
    for name in a:
        torch.testing.assert_close(together.x[name], torch.cat((one.x[name], two.x[name])), rtol=0, atol=1e-5)


def test_a_variable_without_observations_keeps_every_bit(problem: Problem, solver: str) -> None:
    blocks, term = problem
    keep = ((term.index[0] != 3) & (term.index[1] != 7)).nonzero()[:, 0]
    result = solve(blocks, term.select(keep), solver)
    assert result.status == Status.OK
    assert torch.equal(result.x["station"][3], blocks["station"].x[3])
    assert torch.equal(result.x["mark"][7], blocks["mark"].x[7])
    # As if it were not there.
    without = {"station": blocks["station"], "mark": Block(blocks["mark"].x[:7])}
    some = term.select(((term.index[0] != 3) & (term.index[1] < 7)).nonzero()[:, 0])
    alone = solve(without, some, solver)
    beyond = solve(blocks, some, solver)
    assert torch.equal(beyond.x["mark"][:7], alone.x["mark"])
    assert torch.equal(beyond.x["mark"][7:], blocks["mark"].x[7:])


def test_observations_twice_are_observations_of_double_weight(problem: Problem, solver: str) -> None:
    blocks, term = problem
    rows = torch.arange(len(term.index[0]))
    twice = solve(blocks, term.select(torch.cat((rows, rows[:20]))), solver)
    weights = torch.ones(len(rows), dtype=F64)
    weights[:20] = 2
    heavy = solve(blocks, dataclasses.replace(term, weights=weights), solver)
    assert twice.status == Status.OK
    assert twice.cost == pytest.approx(heavy.cost, rel=1e-9)
    torch.testing.assert_close(twice.x["mark"], heavy.x["mark"], rtol=0, atol=1e-5)


def test_observations_that_are_not_numbers_are_not_there(problem: Problem, solver: str) -> None:
    blocks, term = problem
    d = term.data[0].clone()
    d[4], d[9, 1], d[30] = torch.nan, torch.inf, -torch.inf
    result = solve(blocks, dataclasses.replace(term, data=(d,)), solver)
    good = d.isfinite().all(1)
    assert torch.equal(result.used[0], good)
    without = solve(blocks, term.select(good.nonzero()[:, 0]), solver)
    for name in blocks:
        assert torch.equal(result.x[name], without.x[name])
    # A mark that only such observations show stays where it is.
    d[term.index[1] == 5] = torch.nan
    lost = solve(blocks, dataclasses.replace(term, data=(d,)), solver)
    assert torch.equal(lost.x["mark"][5], blocks["mark"].x[5])


def test_nothing_to_improve(problem: Problem, solver: str) -> None:
    blocks, term = problem
    exact = measure(blocks["station"].x[term.index[0]], blocks["mark"].x[term.index[1]], torch.zeros(1, 2, dtype=F64))
    result = solve(blocks, dataclasses.replace(term, data=(exact,)), solver)
    assert result.status == Status.OK
    assert result.cost == result.initial_cost == 0
    assert all(torch.equal(result.x[name], blocks[name].x) for name in blocks)


def test_directions_that_nothing_depends_on(problem: Problem, solver: str) -> None:
    """Heights alone: every mark, and every station, is free to move sideways, and does not."""
    blocks, term = problem
    heights = dataclasses.replace(term, residual=lambda s, m, d: (m - s)[:, 1:] - d[:, 1:])
    result = solve(blocks, heights, solver)
    assert result.status == Status.OK
    for name in blocks:
        torch.testing.assert_close(result.x[name][:, 0], blocks[name].x[:, 0], rtol=0, atol=1e-9)
    # A mark seen once cannot be determined by its height; the others do not mind.
    one = (term.index[1] != 2) | (torch.cumsum(term.index[1] == 2, 0) == 1)
    few = solve(blocks, heights.select(one.nonzero()[:, 0]), solver)
    assert few.status == Status.OK
    none = solve(blocks, heights.select((term.index[1] != 2).nonzero()[:, 0]), solver)
    assert few.cost == pytest.approx(none.cost, rel=1e-6)


def test_a_residual_that_fails_on_the_way(problem: Problem, solver: str) -> None:
    """Square roots of what a long step makes negative: such a step is rejected."""
    blocks, term = problem
    height = blocks["mark"].x[term.index[1], 1]
    bend = dataclasses.replace(
        term, residual=lambda s, m, d: torch.cat((measure(s, m, d), (m[:, 1:] - height.min() + 1e-3).sqrt() - 3), 1)
    )
    result = solve(blocks, bend, solver)
    assert result.cost < result.initial_cost


@pytest.mark.parametrize("bad", [-1, 12])
def test_wrong_indices(problem: Problem, bad: int, unchecked: None) -> None:
    blocks, term = problem
    index = term.index[1].clone()
    index[3] = bad
    with pytest.raises(ValueError, match=r"terms\[0\].index: wanted numbers from 0 to 11 for 'mark'"):
        sparse_levenberg_marquardt(blocks, [dataclasses.replace(term, index=(term.index[0], index))], eliminate="mark")
    with pytest.raises(ValueError, match="int tensor"):
        sparse_levenberg_marquardt(blocks, [dataclasses.replace(term, index=(term.index[0], index.double()))])
