"""A sparse factor: the solution is the dense one, whatever meets whatever, and chains cost in proportion to their length."""

import dataclasses

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim import (
    Block,
    Cauchy,
    Huber,
    Term,
    covariance,
    elimination_order,
    layout,
    marginal_covariance,
    pair_covariance,
    schur,
    solver_choice,
    sparse_covariance,
    sparse_levenberg_marquardt,
)
from torchsfm.optim.elimination_order import members, order_elimination
from torchsfm.optim.fronts import Fronts
from torchsfm.optim.sparsity import depth

F64 = torch.float64
Edges = list[tuple[int, int]]


@pytest.fixture
def many_fronts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small systems in many fronts, too."""
    monkeypatch.setattr(elimination_order, "VISIT", 0.0)
    monkeypatch.setattr(elimination_order, "ENTRY", 0.0)


def graph(count: int, edges: Edges) -> list[int]:
    partners = [0] * count
    for a, b in edges:
        if a != b:
            partners[a] |= 1 << b
            partners[b] |= 1 << a
    return partners


def chain(count: int, reach: int) -> Edges:
    return [(i, j) for i in range(count) for j in range(i + 1, min(i + reach, count))]


def ring(count: int, reach: int) -> Edges:
    return [(i, j % count) for i in range(count) for j in range(i + 1, i + reach)]


def grid(side: int) -> Edges:
    across = [(side * a + b, side * a + b + 1) for a in range(side) for b in range(side - 1)]
    return across + [(side * a + b, side * a + b + side) for a in range(side - 1) for b in range(side)]


def star(count: int) -> Edges:
    return [(0, i) for i in range(1, count)]


GRAPHS: dict[str, tuple[int, Edges]] = {
    "chain": (60, chain(60, 4)),
    "ring": (60, ring(60, 4)),
    "grid": (49, grid(7)),
    "star": (30, star(30)),
    "parts": (40, chain(20, 3) + [(i + 20, j + 20) for i, j in ring(15, 3)]),
    "all": (12, chain(12, 12)),
    "nothing": (7, []),
    "one": (1, []),
}


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.usefixtures("many_fronts")
def test_the_solution_is_the_dense_one(name: str, generator: torch.Generator) -> None:
    count, edges = GRAPHS[name]
    partners = graph(count, edges)
    widths = torch.randint(1, 5, (count,), generator=generator).tolist()
    columns = list(torch.randperm(sum(widths), generator=generator).split(widths))
    found = order_elimination(tuple(partners), tuple(widths), 1.0)
    assert found is not None
    fronts, size = Fronts(found, columns), sum(widths)
    A = torch.zeros(size, size, dtype=F64)
    for i in range(count):
        for j in (i, *members(partners[i])):
            A[columns[i][:, None], columns[j]] = torch.randn(widths[i], widths[j], generator=generator, dtype=F64)
    A = A + A.mT + torch.diag(2 * A.abs().sum(0) + 2 * A.abs().sum(1) + 1)
    row, column = A.nonzero().unbind(1)
    numbers = fronts.zeros(A)
    places = fronts.places(row, column)
    assert int(places.max()) < fronts.total
    assert torch.equal(places, fronts.places(column, row))
    numbers[places] = A[row, column]
    weight = torch.rand(size, generator=generator, dtype=F64)
    right = torch.randn(size, 3, generator=generator, dtype=F64)
    torch.testing.assert_close(fronts.product(numbers, right[:, 0]), A @ right[:, 0])
    factor = fronts.factor(numbers, weight)
    assert factor is not None
    torch.testing.assert_close((A + weight.diag()) @ factor.solve(right), right)
    # Every one is tried: a front that is not positive is found wherever it is.
    for k in range(size):
        assert fronts.factor(numbers, weight - 2 * (A + weight.diag()).trace() * torch.eye(size, dtype=F64)[k]) is None


@pytest.mark.parametrize("edges", [chain, ring])
def test_long_ones_cost_in_proportion(edges: object) -> None:
    assert callable(edges)
    short, long = (order_elimination(tuple(graph(n, edges(n, 10))), (6,) * n, 100.0) for n in (500, 1000))
    assert short is not None
    assert long is not None
    total = [sum(f.seconds for f in found) for found in (short, long)]
    assert total[1] < 2.5 * total[0]
    # Dense: a thousand times as many operations.
    assert sum(f.width * (f.width + f.beyond) ** 2 for f in long) < 6000**3 / 100


def test_what_all_have_to_do_with_is_last() -> None:
    found = order_elimination(tuple(graph(201, [(i + 1, j + 1) for i, j in chain(200, 3)] + star(201))), (6,) * 201, 1.0)
    assert found is not None
    assert 0 in found[-1].pivots


def test_where_much_fills_in_it_is_left() -> None:
    everything = tuple(graph(100, chain(100, 100)))
    assert order_elimination(everything, (6,) * 100, 1e-3) is None
    assert order_elimination(everything, (6,) * 100, 1.0) is not None


def test_how_far_it_is_from_end_to_end() -> None:
    assert depth(graph(60, chain(60, 2))) == 59
    assert depth(graph(60, ring(60, 2))) == 30
    assert depth(graph(49, grid(7))) == 12
    assert depth(graph(5, [])) == 0
    # What all have to do with is no way.
    assert depth(graph(61, [(i + 1, j + 1) for i, j in chain(60, 2)] + star(61))) == 59
    assert depth(graph(90, chain(60, 2) + [(i + 60, j + 60) for i, j in chain(30, 2)])) == 59


def measure(s: Tensor, k: Tensor, m: Tensor, around: Tensor, d: Tensor) -> Tensor:
    way = m - s - around
    return (k * way + 0.05 * torch.sin(way) - d) / 0.01


def apart(a: Tensor, b: Tensor, d: Tensor) -> Tensor:
    return (b - a - d) / 0.05


def road(
    stations: int, generator: torch.Generator, *, off: float = 0.1, closed: bool = False, dtype: torch.dtype = F64
) -> tuple[dict[str, Block], list[Term]]:
    """Stations along a road or around a block measure two kinds of landmarks near them; some share a scale; some are fixed."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    station = torch.stack((torch.arange(stations, dtype=dtype), torch.zeros(stations, dtype=dtype)), 1)
    blocks = {"station": Block(station + off * normal(stations, 2)), "scale": Block(1 + 0.1 * off * normal(3, 1))}
    terms = []
    for name in ("mark", "sign"):
        centre = torch.rand(5 * stations, generator=generator, dtype=dtype) * stations
        mark = torch.stack((centre, 1 + centre.sin()), 1)
        gap = (station[:, None, 0] - centre).abs()
        i, j = ((torch.minimum(gap, stations - gap) if closed else gap) < 4).nonzero().unbind(1)
        # The way on from the last station leads to the first.
        around = torch.zeros(len(i), 2, dtype=dtype)
        if closed:
            around[:, 0] = stations * ((mark[j] - station[i])[:, 0] / stations).round()
        way = mark[j] - station[i] - around
        way = way + 0.05 * way.sin()
        blocks[name] = Block(mark + off * normal(*mark.shape), fixed=torch.rand(len(mark), generator=generator) < 0.05)
        terms.append(Term(measure, ("station", "scale", name), (i, i % 3, j), (around, way + 0.01 * normal(*way.shape))))
    i = torch.arange(stations - 1)
    terms.append(Term(apart, ("station", "station"), (i, i + 1), ((station[1:] - station[:-1]).clone(),)))
    hold = torch.zeros(stations, dtype=torch.bool)
    hold[stations // 3] = True
    blocks["station"] = dataclasses.replace(blocks["station"], fixed=hold)
    return blocks, terms


def stepped(blocks: dict[str, Block], terms: list[Term], solver: solver_choice.Solver, curved: bool = False) -> object:
    found = layout.lay_out(blocks, terms, ("mark", "sign"))
    engine = schur.Elimination(blocks, found, solver)
    assert (engine.fronts is not None) == (solver == "sparse")
    x = {name: b.x for name, b in blocks.items()}
    system = engine.linearize(x)
    return (engine.curve(x, system) if curved else system).step(1e-4)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("rest", [False, True])
@pytest.mark.usefixtures("many_fronts")
def test_steps_are_the_dense_ones(closed: bool, curved: bool, rest: bool, generator: torch.Generator) -> None:
    # Far from the minimum the exact Hessian is not positive, and a step of few columns goes where the cost bends down.
    blocks, terms = road(60, generator, closed=closed, off=1e-4)
    if rest:
        across = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=F64)
        free = dataclasses.replace(blocks["station"], fixed=None, rest=lambda x: across.expand(len(x), 2, 2))
        blocks = {**blocks, "station": free} | {
            name: dataclasses.replace(blocks[name], fixed=None) for name in ("mark", "sign")
        }
    delta, promise, solved, *_ = stepped(blocks, terms, "dense", curved)
    found, same, also, *_ = stepped(blocks, terms, "sparse", curved)
    assert bool(solved)
    assert bool(also)
    torch.testing.assert_close(same, promise, rtol=1e-6, atol=0)
    for name, step in delta.items():
        torch.testing.assert_close(found[name], step, rtol=1e-4, atol=1e-6 * float(step.abs().max()))


@pytest.mark.parametrize("loss", [None, Huber(1.0), Cauchy(1.0)])
def test_the_minimum_is_the_dense_one(loss: object, generator: torch.Generator) -> None:
    blocks, terms = road(60, generator)
    terms = [dataclasses.replace(term, loss=loss) for term in terms]
    dense, sparse = (
        sparse_levenberg_marquardt(blocks, terms, eliminate=("mark", "sign"), linear_solver=solver, function_tolerance=1e-12)
        for solver in ("dense", "sparse")
    )
    assert dense.status == sparse.status == Status.OK
    assert sparse.cost == pytest.approx(dense.cost, rel=1e-9)
    for name in blocks:
        torch.testing.assert_close(sparse.x[name], dense.x[name], rtol=0, atol=1e-5)


def test_single_precision(generator: torch.Generator) -> None:
    blocks, terms = road(60, generator, dtype=torch.float32)
    found = sparse_levenberg_marquardt(blocks, terms, eliminate=("mark", "sign"), linear_solver="sparse")
    assert found.status == Status.OK
    assert all(x.dtype == torch.float32 for x in found.x.values())


def test_auto_takes_it_for_what_is_long(generator: torch.Generator) -> None:
    """Not for what is small, and not where all have to do with all."""
    for stations, wanted in ((60, False), (2500, True)):
        blocks, terms = road(stations, generator)
        found = layout.lay_out(blocks, terms, ("mark", "sign"))
        assert (solver_choice.plan_fronts(found, "auto") is not None) == wanted
    j = torch.arange(20_000).repeat_interleave(3)
    i = torch.randint(2500, (len(j),), generator=generator)
    term = Term(lambda s, m, d: m - s - d, ("station", "mark"), (i, j), (torch.zeros(len(j), 2, dtype=F64),))
    crowd = {"station": Block(torch.zeros(2500, 2, dtype=F64)), "mark": Block(torch.zeros(20_000, 2, dtype=F64))}
    assert solver_choice.plan_fronts(layout.lay_out(crowd, [term], "mark"), "auto") is None


def test_what_is_not_determined_is_damped(generator: torch.Generator) -> None:
    """Two roads with nothing between them, and nothing held."""
    blocks, terms = road(40, generator)
    blocks = {name: dataclasses.replace(b, fixed=None) for name, b in blocks.items()}
    blocks["scale"] = dataclasses.replace(blocks["scale"], fixed=torch.ones(3, dtype=torch.bool))
    apart_terms = [term.select((term.index[0] != 19).nonzero()[:, 0]) for term in terms[:2]]
    found = sparse_levenberg_marquardt(blocks, apart_terms, eliminate=("mark", "sign"), linear_solver="sparse")
    dense = sparse_levenberg_marquardt(blocks, apart_terms, eliminate=("mark", "sign"), linear_solver="dense")
    assert found.status == Status.OK
    assert found.cost == pytest.approx(dense.cost, rel=1e-6)


def test_derivatives_are_the_dense_ones(generator: torch.Generator) -> None:
    blocks, terms = road(30, generator)
    grads = []
    for solver in ("dense", "sparse"):
        d = terms[0].data[1].clone().requires_grad_()
        mine = [dataclasses.replace(terms[0], data=(terms[0].data[0], d)), *terms[1:]]
        found = sparse_levenberg_marquardt(blocks, mine, eliminate=("mark", "sign"), linear_solver=solver)
        found.x["station"].square().sum().backward()
        grads.append(d.grad)
    torch.testing.assert_close(*grads, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.usefixtures("many_fronts")
def test_entries_of_the_inverse_and_the_last_front(name: str, generator: torch.Generator) -> None:
    count, edges = GRAPHS[name]
    partners, last = graph(count, edges), 1 << count // 2 | 1
    for i in members(last):
        partners[i] |= last & ~(1 << i)
    columns = list(torch.arange(2 * count).split(2))
    found = order_elimination(tuple(partners), (2,) * count, 1.0, last)
    assert found is not None
    assert sum(1 << i for i in found[-1].pivots) == last
    fronts = Fronts(found, columns)
    A = torch.zeros(2 * count, 2 * count, dtype=F64)
    for i in range(count):
        for j in (i, *members(partners[i])):
            A[columns[i][:, None], columns[j]] = torch.randn(2, 2, generator=generator, dtype=F64)
    A = A + A.mT + torch.diag(2 * A.abs().sum(0) + 2 * A.abs().sum(1) + 1)
    row, column = A.nonzero().unbind(1)
    numbers = fronts.zeros(A)
    numbers[fronts.places(row, column)] = A[row, column]
    weight = torch.rand(2 * count, generator=generator, dtype=F64)
    inverse, factor, left = torch.linalg.inv(A + weight.diag()), fronts.factor(numbers, weight), fronts.last(numbers, weight)
    assert factor is not None
    assert left is not None
    torch.testing.assert_close(factor.inverse()[fronts.places(row, column)], inverse[row, column])
    own = fronts.fronts[-1].pivots
    torch.testing.assert_close(torch.linalg.inv(left), inverse[own[:, None], own])


def taken(monkeypatch: pytest.MonkeyPatch, worth: float) -> None:
    monkeypatch.setattr(solver_choice, "WORTH", worth)
    monkeypatch.setattr(solver_choice, "FLOP", 1.0)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("gauge", [False, True])
@pytest.mark.usefixtures("many_fronts")
def test_covariances_are_the_dense_ones(
    closed: bool, gauge: bool, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks, terms = road(300, generator, closed=closed, off=1e-3)
    if gauge:
        blocks = {name: dataclasses.replace(b, fixed=None) for name, b in blocks.items()}
    eliminate = ("mark", "sign")
    dense = sparse_covariance(blocks, terms, eliminate=eliminate, of_eliminated=False)
    of_scale, of_station = (marginal_covariance(blocks, terms, name, eliminate=eliminate) for name in ("scale", "station"))
    taken(monkeypatch, 0.0)
    planned = []
    monkeypatch.setattr(
        covariance, "plan_fronts", lambda *a, **k: planned.append(solver_choice.plan_fronts(*a, **k)) or planned[-1]
    )
    sparse = sparse_covariance(blocks, terms, eliminate=eliminate, of_eliminated=False, joint=False)
    torch.testing.assert_close(marginal_covariance(blocks, terms, "scale", eliminate=eliminate), of_scale, rtol=1e-6, atol=0)
    if not gauge:
        found = marginal_covariance(blocks, terms, "station", eliminate=eliminate)
        torch.testing.assert_close(found, of_station, rtol=1e-6, atol=1e-12)
    assert all(isinstance(fronts, Fronts) for fronts in planned)
    assert sparse.joint.numel() == 0
    assert dense.joint.numel()
    assert (sparse.nullity, sparse.redundancy, sparse.square_sum) == (dense.nullity, dense.redundancy, dense.square_sum)
    assert dense.nullity == 2 * gauge
    for name in ("station", "scale"):
        torch.testing.assert_close(sparse.blocks[name], dense.blocks[name], rtol=1e-5, atol=1e-10)
        assert torch.equal(sparse.determined[name], dense.determined[name])
    assert all(torch.equal(sparse.determined[name], dense.determined[name]) for name in eliminate)


@pytest.mark.usefixtures("many_fronts")
def test_covariances_of_pairs_are_the_dense_ones(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks, terms = road(300, generator, off=1e-3)
    blocks["scale"] = dataclasses.replace(blocks["scale"], fixed=torch.ones(3, dtype=torch.bool))
    eliminate, step = ("mark", "sign"), torch.arange(299)
    near = torch.stack((step, step + 1), 1)
    dense = pair_covariance(blocks, terms, "station", near, eliminate=eliminate)
    whole = sparse_covariance(blocks, terms, eliminate=eliminate, of_eliminated=False)
    place = whole.columns["station"]
    a, b = (torch.where(place >= 0, place, 0)[i] for i in near.unbind(1))
    free = (place[near] >= 0).all(-1).all(-1)[:, None, None]
    torch.testing.assert_close(dense[1], torch.where(free, whole.joint[a[:, :, None], b[:, None]], 0.0), rtol=1e-6, atol=1e-12)
    taken(monkeypatch, 0.0)
    planned = []
    monkeypatch.setattr(
        covariance, "plan_fronts", lambda *a, **k: planned.append(solver_choice.plan_fronts(*a, **k)) or planned[-1]
    )
    sparse = pair_covariance(blocks, terms, "station", near, eliminate=eliminate)
    for one, other in zip(sparse, dense, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-12)
    assert isinstance(planned[0], Fronts)
    # What is far apart has no entry in the factor.
    far = torch.tensor([[3, 290], [3, 4]])
    found = pair_covariance(blocks, terms, "station", far, eliminate=eliminate)[1]
    a, b = (place[i] for i in far.unbind(1))
    torch.testing.assert_close(found, whole.joint[a[:, :, None], b[:, None]], rtol=1e-6, atol=1e-12)


@pytest.mark.usefixtures("many_fronts")
def test_covariances_of_two_parts_are_left_to_the_dense_factor(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One front cannot hold both."""
    blocks, terms = road(300, generator, off=1e-3)
    blocks = {name: dataclasses.replace(b, fixed=None) for name, b in blocks.items()}
    blocks["scale"] = dataclasses.replace(blocks["scale"], fixed=torch.ones(3, dtype=torch.bool))
    half = [term.select(((term.index[0] < 148) == (term.index[-1] < 745)).nonzero()[:, 0]) for term in terms[:2]]
    half = [t.select(((t.index[0] - 150).abs() > 3).nonzero()[:, 0]) for t in half]
    dense = sparse_covariance(blocks, half, eliminate=("mark", "sign"), of_eliminated=False)
    taken(monkeypatch, 0.0)
    sparse = sparse_covariance(blocks, half, eliminate=("mark", "sign"), of_eliminated=False, joint=False)
    assert sparse.nullity == dense.nullity
    torch.testing.assert_close(sparse.blocks["station"], dense.blocks["station"], rtol=1e-5, atol=1e-10)
