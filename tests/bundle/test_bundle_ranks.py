"""Bundles over several processes: each step and each answer is that of one process."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import processes
import pytest
import torch
import torch.distributed
from test_bundle_adjust import make_scene, perturb
from test_rigs import disturb
from test_rigs import make_scene as make_rig
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import CentrePrior, PointPrior, Rig, bundle_adjust
from torchsfm.geometry import BundleProblem
from torchsfm.optim import Block, Cauchy, Huber, Term, sparse_levenberg_marquardt
from torchsfm.optim.ranks import Ranks, share

F64 = torch.float64
Case = tuple[BundleProblem, dict[str, Any]]


def scene(generator: torch.Generator, **options: Any) -> BundleProblem:
    """A bundle to adjust; points come in no order, so that the parts of ranks have ragged sizes."""
    poses, cameras, X, x, view, point, group = make_scene(generator, **options)
    start, X = perturb(poses, X, generator)
    return BundleProblem(start, cameras, group, X, x, view, point)


def spoiled(problem: BundleProblem, generator: torch.Generator) -> BundleProblem:
    """Every tenth observation far off."""
    x = problem.x.clone()
    x[::10] += 60 * torch.randn(x[::10].shape, generator=generator, dtype=F64)
    return BundleProblem(problem.poses, problem.cameras, problem.camera_index, problem.X, x, problem.view, problem.point)


def cases(generator: torch.Generator) -> dict[str, Case]:
    """Every kind of term, and parts without anything in them."""
    own, shared = scene(generator, groups=8), scene(generator, points=60)
    few = scene(generator, points=2, views=6)
    known = torch.zeros(100, dtype=torch.bool)
    known[::7] = True
    first = torch.arange(8) < 2
    free = ("focal", "k1", "k2")
    index = torch.arange(0, 8, 2)
    centre = CentrePrior(index, own.poses.centre[index] + 0.01 * torch.randn(4, 3, generator=generator, dtype=F64), 0.02)
    place = PointPrior(torch.arange(5), own.X[:5], 0.05)
    stands = CentrePrior(torch.arange(6), few.poses.centre, 0.02)
    some = (torch.rand(len(own.x), generator=generator, dtype=F64) * 2).floor()
    missing = own.x.clone()
    missing[::13] = torch.nan
    holes = BundleProblem(own.poses, own.cameras, own.camera_index, own.X, missing, own.view, own.point)
    body, rig, cameras, X, x, view, point = make_rig(generator)
    start = Rig(disturb(rig.cam_from_rig, generator), rig.sensor, rig.frame)
    moved = X + 0.02 * torch.randn(X.shape, generator=generator, dtype=F64)
    bodies = BundleProblem(start.view_poses(disturb(body, generator)), cameras, rig.sensor, moved, x, view, point)
    near = PointPrior(torch.arange(5), moved[:5], 0.05)
    return {
        "own intrinsics": (own, {"free": free}),
        "iterative": (own, {"free": free, "linear_solver": "pcg"}),
        "shared intrinsics": (shared, {"free": (*free, "principal_point"), "intrinsics_sigma": {"principal_point": 3.0}}),
        "shared, iterative": (shared, {"free": free, "linear_solver": "pcg", "gauge": "first"}),
        "robust": (spoiled(own, generator), {"loss": Cauchy(1.0), "free": free}),
        "robust, iterative": (spoiled(shared, generator), {"loss": Huber(1.0), "linear_solver": "pcg"}),
        "priors": (own, {"priors": [centre, place], "weights": some}),
        "priors, iterative": (own, {"priors": [centre, place], "linear_solver": "pcg"}),
        "held": (own, {"fixed_points": known, "fixed_poses": first}),
        "no free camera": (own, {"fixed_poses": torch.ones(8, dtype=torch.bool), "free": ()}),
        "holes": (holes, {"free": free}),
        "two points": (few, {"free": (), "fixed_poses": torch.ones(6, dtype=torch.bool)}),
        "two points, iterative": (few, {"free": (), "priors": [stands], "linear_solver": "pcg"}),
        "poses eliminated": (scene(generator, points=12, views=60), {"free": ()}),
        "rig": (bodies, {"rig": start, "free": ()}),
        "rig, iterative": (bodies, {"rig": start, "linear_solver": "pcg", "free": ()}),
        "rig, all at once": (
            spoiled(bodies, generator),
            {"rig": start, "loss": Cauchy(1.0), "free": ("focal",), "priors": [near]},
        ),
    }


def adjust(found: dict[str, Case]) -> dict[str, Any]:
    """The costs after each step and the answer of every case."""
    answers = {}
    group = torch.distributed.group.WORLD if torch.distributed.is_initialized() else None
    for name, (problem, options) in found.items():
        course: dict[int, float] = {}
        result = bundle_adjust(problem, **({"tolerance": 1e-8} | options), group=group, progress=course.__setitem__)
        tensors = (result.poses.R, result.poses.t, result.cameras.K, result.X, result.residuals, result.used)
        answers[name] = ([result.initial_cost, *course.values()], tensors, result.status)
    return answers


@pytest.mark.parametrize("count", [pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(4, marks=pytest.mark.slow)])
def test_costs_and_answers_are_those_of_one_process(count: int, generator: torch.Generator, tmp_path: Path) -> None:
    found = cases(generator)
    alone = adjust(found)
    ranks = processes.run_ranks(count, tmp_path, adjust, found)
    for name, (costs, tensors, status) in alone.items():
        for rank in ranks:
            own_costs, own_tensors, own_status = rank[name]
            assert own_status == status, name
            assert len(own_costs) == len(costs), name
            # Conjugate gradients that end early are sensitive to rounding.
            assert own_costs == pytest.approx(costs, rel=1e-9 if "iterative" in name else 1e-10, abs=1e-16), name
            for mine, one, first in zip(own_tensors, tensors, ranks[0][name][1], strict=True):
                assert torch.equal(mine, first), name
                torch.testing.assert_close(mine, one, rtol=1e-6, atol=1e-6, msg=name)


def count_bytes(problem: BundleProblem, options: dict[str, Any]) -> list[tuple[str, int]]:
    """What a rank sends in one adjustment."""
    processes.count_collectives()
    bundle_adjust(problem, **options, group=torch.distributed.group.WORLD)
    return processes.SENT


def test_conjugate_gradients_send_the_cameras_once(generator: torch.Generator, tmp_path: Path) -> None:
    """Each iteration sends 72 bytes a camera of nine unknowns; what a step sends besides does not grow with points."""
    options = {"free": ("focal", "k1", "k2"), "linear_solver": "pcg", "max_iterations": 3, "tolerance": 0.0}
    sent, ends = {}, {}
    for points in (60, 240):
        problem = scene(generator, points=points, views=20, groups=20, seen=0.3)
        (found, other) = processes.run_ranks(2, tmp_path / str(points), count_bytes, problem, options)
        assert found == other
        assert sum(size == 72 * 20 for _, size in found) > 6
        # At the end the points, the residuals and which of them count are put together.
        ends[points] = [size for kind, size in found if kind == "gather"][1:]
        sent[points] = [size for kind, size in found if kind == "reduce"]
    largest = 20 * 9 * 9 * 8 + 8
    for sizes in sent.values():
        steps = [size for size in sizes if size == largest]
        assert max(sizes) == largest
        assert 1 <= len(steps) <= 6
        others = [size for size in sizes if size not in (largest, 72 * 20, 2 * 72 * 20)]
        assert max(others) <= 20 * 12
    assert sum(ends[240]) > 2 * sum(ends[60])


def engine(blocks: dict[str, Block], terms: list[Term], eliminate: str | None) -> list[Any]:
    """The engine's answers to a problem of its own by both solvers, and the derivative of one by the data of the first term."""
    group = torch.distributed.group.WORLD if torch.distributed.is_initialized() else None
    options: Any = {"eliminate": eliminate, "function_tolerance": 1e-9, "group": group}
    answers: list[Any] = []
    for solver in ("dense", "sparse", "pcg"):
        result = sparse_levenberg_marquardt(blocks, terms, linear_solver=solver, **options)
        answers.append((result.cost, result.status, result.used, (*result.x.values(), *result.residuals)))
    d = terms[0].data[0].clone().requires_grad_()
    result = sparse_levenberg_marquardt(blocks, [replace(terms[0], data=(d,)), *terms[1:]], **options)
    return [*answers, torch.autograd.grad(result.x["station"].square().sum(), d)[0]]


def difference(a: Tensor, b: Tensor, d: Tensor) -> Tensor:
    return b - a - d


def bend(a: Tensor, d: Tensor) -> Tensor:
    return 10 * (a.square() - d)


@pytest.mark.parametrize("eliminate", ["mark", None])
def test_problems_of_ones_own(eliminate: str | None, generator: torch.Generator, tmp_path: Path) -> None:
    """More ranks than variables to eliminate; one that only one rank sees; residuals of what is held; derivatives."""
    i, j = torch.arange(15) % 5, torch.arange(15) // 5  # each mark from five: two alone leave a robust cost flat between them
    blocks = {
        "station": Block(torch.randn(6, 2, generator=generator, dtype=F64), fixed=torch.arange(6) == 0),
        "mark": Block(torch.randn(3, 2, generator=generator, dtype=F64)),
    }
    goal = 1 + torch.rand(2, 2, generator=generator, dtype=F64)
    weights = torch.tensor([2.0, 1.0], dtype=F64)
    terms = [
        Term(difference, ("station", "mark"), (i, j), (torch.randn(15, 2, generator=generator, dtype=F64),), loss=Huber(1.0)),
        Term(bend, ("station",), (torch.tensor([5, 0]),), (goal,), weights=weights),
    ]
    *alone, slope = engine(blocks, terms, eliminate)
    for *rank, own_slope in processes.run_ranks(3, tmp_path, engine, blocks, terms, eliminate):
        torch.testing.assert_close(own_slope, slope, rtol=1e-6, atol=1e-8)
        for (cost, status, used, tensors), (own_cost, own_status, own_used, own_tensors) in zip(alone, rank, strict=True):
            assert own_status == status
            assert own_cost == pytest.approx(cost, rel=1e-9)
            assert all(torch.equal(a, b) for a, b in zip(own_used, used, strict=True))
            assert torch.equal(own_tensors[0][0], blocks["station"].x[0])
            for a, b in zip(own_tensors, tensors, strict=True):
                torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


def chain(blocks: dict[str, Block], terms: list[Term]) -> Any:
    """The minimum of a problem so large that it is asked how to solve it."""
    group = torch.distributed.group.WORLD if torch.distributed.is_initialized() else None
    return sparse_levenberg_marquardt(blocks, terms, eliminate="mark", group=group).x


def test_a_rank_that_has_nothing_to_eliminate(generator: torch.Generator, tmp_path: Path) -> None:
    """A long chain and a single mark: all ranks ask the same questions all the same."""
    many = torch.arange(1000)
    blocks = {
        "station": Block(torch.zeros(len(many), 2, dtype=F64), fixed=many == 0),
        "mark": Block(torch.zeros(1, 2, dtype=F64)),
    }
    ways = torch.randn(len(many) - 1, 2, generator=generator, dtype=F64)
    terms = [
        Term(difference, ("station", "station"), (many[:-1], many[1:]), (ways,)),
        Term(difference, ("station", "mark"), (many[:3], torch.zeros(3).long()), (ways[:3],)),
    ]
    alone = chain(blocks, terms)
    for rank in processes.run_ranks(2, tmp_path, chain, blocks, terms):
        torch.testing.assert_close(rank, alone, rtol=1e-9, atol=1e-9)


@dataclass(frozen=True)
class Member:
    """One of several processes that have nothing to say to each other."""

    number: int
    count: int

    def rank(self) -> int:
        return self.number

    def size(self) -> int:
        return self.count


def test_neighbours_are_on_one_rank(generator: torch.Generator) -> None:
    """Points that four stations in a row see, in any order: each rank has few stations, all points once, and even shares."""
    first = torch.randint(37, (400,), generator=generator)
    i, j = (first[:, None] + torch.arange(4)).flatten(), torch.arange(400).repeat_interleave(4)
    blocks = {"station": Block(torch.zeros(40, 2)), "mark": Block(torch.randn(400, 2, generator=generator))}
    terms = [Term(difference, ("station", "mark"), (i, j), (torch.randn(1600, 2, generator=generator),))]
    seen = torch.zeros(400)
    for rank in range(4):
        mine = share(blocks, terms, "mark", Ranks(Member(rank, 4)))
        station, mark = mine.terms[0].index
        assert len(torch.unique(station)) <= 40 // 4 + 8
        assert abs(len(mark) - 400) <= 4
        assert torch.equal(mine.blocks["mark"].x, blocks["mark"].x[mine.places["mark"]][int(seen.sum()) :][: len(mark) // 4])
        own = mine.places["mark"][int(seen.sum()) :][: len(mine.blocks["mark"].x)]
        assert torch.equal(terms[0].data[0][torch.isin(j, own)], mine.terms[0].data[0])
        seen[own] += 1
    assert bool((seen == 1).all())


def stopped(problem: BundleProblem) -> tuple[int, int]:
    """The steps and the status of an adjustment that the last rank ends after two."""
    last = torch.distributed.get_rank() + 1 == torch.distributed.get_world_size()
    result = bundle_adjust(problem, group=torch.distributed.group.WORLD, progress=lambda k, _: not (last and k == 2))
    return result.iterations, int(result.status)


def test_any_rank_ends_it_for_all(generator: torch.Generator, tmp_path: Path) -> None:
    (first, second) = processes.run_ranks(2, tmp_path, stopped, scene(generator))
    assert first == second == (2, int(Status.INTERRUPTED))
