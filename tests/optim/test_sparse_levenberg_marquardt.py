import dataclasses
import sys
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim import (
    Block,
    Cauchy,
    Huber,
    RigidMotion,
    SoftL1,
    SparseResult,
    Term,
    UnitSphere,
    layout,
    schur,
    schur_grouped,
    schur_matrix_free,
    schur_pairwise,
    solver_choice,
    sparse_covariance,
    sparse_levenberg_marquardt,
)
from torchsfm.optim.manifold import rotation_exponential

F64 = torch.float64


def pinhole(pose: Tensor, focal: Tensor, point: Tensor, x: Tensor) -> Tensor:
    """A camera that shares its focal length: three blocks in one residual."""
    R = pose[:, :9].unflatten(1, (3, 3))
    X = (R @ point[:, :, None])[:, :, 0] + pose[:, 9:]
    return focal * X[:, :2] / X[:, 2:] - x


@dataclasses.dataclass
class Scene:
    pose: Tensor
    focal: Tensor
    point: Tensor
    x: Tensor
    view: Tensor
    camera: Tensor
    seen: Tensor

    def blocks(self, **fixed: Tensor) -> dict[str, Block]:
        return {
            "pose": Block(self.pose, RigidMotion(), fixed.get("pose")),
            "focal": Block(self.focal, None, fixed.get("focal")),
            "point": Block(self.point, None, fixed.get("point")),
        }

    def term(self, **options: object) -> Term:
        index = (self.view, self.camera[self.view], self.seen)
        return Term(pinhole, ("pose", "focal", "point"), index, (self.x,), **options)


@pytest.fixture
def scene(generator: torch.Generator) -> Scene:
    """Six views by two cameras, twenty points, each seen in two thirds of them, half a pixel of noise."""
    views, points = 6, 20
    rotation = rotation_exponential(0.2 * torch.randn(views, 3, generator=generator, dtype=F64))
    translation = torch.randn(views, 3, generator=generator, dtype=F64) * 0.5 + torch.tensor([0.0, 0.0, 6.0], dtype=F64)
    pose = torch.cat((rotation.flatten(1), translation), 1)
    point = torch.randn(points, 3, generator=generator, dtype=F64)
    focal = torch.tensor([[500.0], [700.0]], dtype=F64)
    camera = torch.tensor([0, 1, 0, 0, 1, 1])
    order = torch.rand(views, points, generator=generator)
    # Two views of every point at least.
    order.scatter_(0, order.argsort(0)[:2], -1.0)
    pick = order.flatten().argsort()[: views * points * 2 // 3]
    view, seen = pick // points, pick % points
    x = pinhole(pose[view], focal[camera[view]], point[seen], torch.zeros(1, dtype=F64))
    x = x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64)
    pose = RigidMotion().retract(pose, 0.02 * torch.randn(views, 6, generator=generator, dtype=F64))
    point = point + 0.05 * torch.randn(point.shape, generator=generator, dtype=F64)
    return Scene(pose, focal * 1.05, point, x, view, camera, seen)


def solve(blocks: dict[str, Block], terms: list[Term], **options: object) -> object:
    return sparse_levenberg_marquardt(blocks, terms, eliminate="point", function_tolerance=1e-14, max_iterations=200, **options)


def scipy_cost(scene: Scene, loss: str, scale: float, start: dict[str, Tensor]) -> float:
    manifold = RigidMotion()

    def residual(z: np.ndarray) -> np.ndarray:
        z = torch.as_tensor(z)
        pose = manifold.retract(start["pose"], z[:36].view(6, 6))
        focal, point = start["focal"] + z[36:38, None], start["point"] + z[38:].view(-1, 3)
        r = pinhole(pose[scene.view], focal[scene.camera[scene.view]], point[scene.seen], scene.x)
        # SciPy's losses act on single numbers: give it the length of each residual.
        return (r.norm(dim=1) if loss != "linear" else r.flatten()).numpy()

    found = least_squares(
        residual, np.zeros(38 + 60), loss=loss, f_scale=scale, x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-9
    )
    return float(found.cost)


@pytest.mark.parametrize("coupling", ["groups", "pairs"])
@pytest.mark.parametrize("loss", [None, Huber(0.5), SoftL1(0.5)])
def test_no_minimum_of_scipys_is_lower(scene: Scene, loss: object, coupling: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schur, "estimate_pairs", lambda layout: torch.inf if coupling == "groups" else 0.0)
    monkeypatch.setattr(schur_grouped, "ATOM", 4)
    result = solve(scene.blocks(), [scene.term(loss=loss)])
    assert result.status == Status.OK
    name, scale = ("linear", 1.0) if loss is None else ({Huber: "huber", SoftL1: "soft_l1"}[type(loss)], loss.scale)
    # From our own minimum SciPy finds nothing better, so it is one.
    np.testing.assert_allclose(result.cost, scipy_cost(scene, name, scale, result.x), rtol=1e-7)
    dof = 2 * scene.x.shape[0] - (36 + 2 + 60 - 7)
    if loss is None:
        assert abs(result.cost / (0.125 * dof) - 1) < 4 * (2 / dof) ** 0.5


def undamped_step(blocks: dict[str, Block], terms: list[Term], eliminate: str | None) -> dict[str, Tensor]:
    """Where a step leads. Eliminated variables are damped by their blocks, others by the diagonal: undamped ones all agree."""
    found, x = layout.lay_out(blocks, terms, eliminate), {name: b.x for name, b in blocks.items()}
    step, _, solved, *_ = schur.Elimination(blocks, found, "dense").linearize(x).step(1e-12)
    assert solved
    return schur.move(blocks, found, x, step)


@pytest.mark.parametrize("cameras", [2, 1])
def test_both_couplings_and_no_elimination_agree(scene: Scene, cameras: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where all views have a camera in common, which pairs of residuals then leave out."""
    scene.focal, scene.camera = scene.focal[:cameras], scene.camera % cameras
    blocks = scene.blocks(pose=torch.arange(6) < 2)
    expected = undamped_step(blocks, [scene.term()], None)
    for seconds in (0.0, torch.inf):
        monkeypatch.setattr(schur, "estimate_pairs", lambda layout, seconds=seconds: seconds)
        monkeypatch.setattr(schur_grouped, "ATOM", 4)
        monkeypatch.setattr(schur_grouped, "VISIT", 0.0)
        found = undamped_step(blocks, [scene.term()], "point")
        for name, x in expected.items():
            torch.testing.assert_close(found[name], x, rtol=1e-7, atol=1e-9)


def test_small_chunks_change_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = sparse_levenberg_marquardt(scene.blocks(), [scene.term(loss=Cauchy(1.0))], eliminate="point", max_iterations=4)
    for seconds in (0.0, torch.inf):
        monkeypatch.setattr(schur, "CHUNK", 7)
        monkeypatch.setattr(schur_grouped, "CHUNK", 7)
        monkeypatch.setattr(schur_matrix_free, "CHUNK", 7)
        monkeypatch.setattr(schur_pairwise, "BATCH", 16)
        monkeypatch.setattr(schur, "estimate_pairs", lambda layout, seconds=seconds: seconds)
        cut = sparse_levenberg_marquardt(scene.blocks(), [scene.term(loss=Cauchy(1.0))], eliminate="point", max_iterations=4)
        torch.testing.assert_close(cut.x["point"], whole.x["point"], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("seconds", [0.0, torch.inf])
def test_more_than_sixty_slots(generator: torch.Generator, seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Averages over a long chain: each point links two to four of a hundred one-number variables."""
    monkeypatch.setattr(schur, "estimate_pairs", lambda layout: seconds)
    monkeypatch.setattr(schur_grouped, "ATOM", 8)
    links = [(p, (p * 37 + k * (1 + p % 5)) % 100) for p in range(300) for k in range(2 + p % 3)]
    point, camera = torch.tensor(links).T
    offset = torch.randn(len(links), 1, generator=generator, dtype=F64)
    term = Term(lambda c, p, o: torch.sin(c) + p - o, ("c", "p"), (camera, point), (offset,))
    blocks = {"c": Block(torch.zeros(100, 1, dtype=F64)), "p": Block(torch.zeros(300, 1, dtype=F64))}
    kept = sparse_levenberg_marquardt(blocks, [term], max_iterations=3)
    found = sparse_levenberg_marquardt(blocks, [term], eliminate="p", max_iterations=3)
    torch.testing.assert_close(found.x["p"], kept.x["p"], rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(found.x["c"], kept.x["c"], rtol=1e-8, atol=1e-9)


def test_fixed_and_unobserved_stay_bit_for_bit(scene: Scene) -> None:
    pose = torch.tensor([True, False, False, True, False, False])
    point = torch.zeros(20, dtype=torch.bool)
    point[:9] = True
    focal = torch.tensor([False, True])
    keep = (scene.view != 4) & (scene.seen != 15)
    scene.view, scene.seen, scene.x = scene.view[keep], scene.seen[keep], scene.x[keep]
    result = solve(scene.blocks(pose=pose, point=point, focal=focal), [scene.term()])
    assert result.status == Status.OK
    pose[4], point[15] = True, True
    for name, still in (("pose", pose), ("point", point), ("focal", focal)):
        before, after = scene.blocks()[name].x, result.x[name]
        assert torch.equal(before[still], after[still])
        assert (before[~still] != after[~still]).any(-1).all()
    reference = sparse_levenberg_marquardt(
        scene.blocks(pose=pose, point=point, focal=focal), [scene.term()], function_tolerance=1e-14, max_iterations=200
    )
    np.testing.assert_allclose(result.cost, reference.cost, rtol=1e-10)
    everything = solve(
        {n: dataclasses.replace(b, fixed=torch.ones(len(b.x), dtype=torch.bool)) for n, b in scene.blocks().items()},
        [scene.term()],
    )
    assert everything.status == Status.TOO_FEW
    assert everything.cost == everything.initial_cost == pytest.approx(everything.residuals[0].square().sum().item() / 2)


def test_bad_numbers_are_left_out(scene: Scene) -> None:
    good = solve(scene.blocks(), [scene.term(weights=(torch.arange(len(scene.view)) > 2).double())])
    scene.x[0, 0], scene.x[1, 1], scene.x[2] = torch.nan, torch.inf, torch.nan
    result = solve(scene.blocks(), [scene.term()])
    assert result.used[0].tolist() == [False] * 3 + [True] * (len(scene.view) - 3)
    assert all(v.isfinite().all() for v in result.x.values())
    for name in result.x:
        torch.testing.assert_close(result.x[name], good.x[name], rtol=1e-6, atol=1e-6)
    scene.x[:] = torch.nan
    nothing = solve(scene.blocks(), [scene.term()])
    assert nothing.status == Status.NOT_FINITE
    assert all(torch.equal(nothing.x[name], block.x) for name, block in scene.blocks().items())


def test_several_terms_priors_and_homogeneous_points(scene: Scene) -> None:
    """Points as unit 4-vectors with a prior on poses and one on points: terms on retained and on eliminated blocks alone."""

    def homogeneous(pose: Tensor, focal: Tensor, point: Tensor, x: Tensor) -> Tensor:
        X = (pose[:, :9].unflatten(1, (3, 3)) @ point[:, :3, None])[:, :, 0] + pose[:, 9:] * point[:, 3:]
        return focal * X[:, :2] / X[:, 2:] - x

    point = torch.nn.functional.normalize(torch.cat((scene.point, torch.ones(20, 1, dtype=F64)), 1), dim=1)
    blocks = scene.blocks() | {"point": Block(point, UnitSphere(4))}
    centre = Term(lambda pose, mean: 3 * (pose[:, 9:] - mean), ("pose",), (torch.arange(6),), (scene.pose[:, 9:],))
    known = Term(lambda p, mean: 10 * (p[:, :3] / p[:, 3:] - mean), ("point",), (torch.arange(5),), (scene.point[:5],))
    main = dataclasses.replace(scene.term(), residual=homogeneous)
    result = solve(blocks, [main, centre, known])
    euclidean = Term(lambda p, mean: 10 * (p - mean), ("point",), (torch.arange(5),), (scene.point[:5],))
    reference = sparse_levenberg_marquardt(
        scene.blocks(), [scene.term(), centre, euclidean], function_tolerance=1e-14, max_iterations=200
    )
    np.testing.assert_allclose(result.cost, reference.cost, rtol=1e-9)
    torch.testing.assert_close(result.x["point"].norm(dim=1), torch.ones(20, dtype=F64))
    # Points seen twice are known to a few millimetres only.
    torch.testing.assert_close(result.x["point"][:, :3] / result.x["point"][:, 3:], reference.x["point"], rtol=0, atol=5e-3)


def test_a_point_twice_in_a_view_and_in_two_terms(scene: Scene) -> None:
    """Repeated observations and a second kind of term make blocks that meet themselves."""
    again = dataclasses.replace(scene.term(), index=tuple(i[:10] for i in scene.term().index), data=(scene.x[:10] + 1,))
    twice = dataclasses.replace(
        scene.term(), index=tuple(i.repeat(2) for i in scene.term().index), data=(scene.x.repeat(2, 1),)
    )
    blocks = scene.blocks(pose=torch.arange(6) < 2)
    for terms in ([scene.term(), again], [twice]):
        expected = undamped_step(blocks, terms, None)
        for coupling in (0.0, torch.inf):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(schur, "estimate_pairs", lambda layout, coupling=coupling: coupling)
                found = undamped_step(blocks, terms, "point")
            for name, x in expected.items():
                torch.testing.assert_close(found[name], x, rtol=1e-7, atol=1e-9)


def test_float32_comes_back_as_float32(scene: Scene) -> None:
    blocks = {name: dataclasses.replace(b, x=b.x.float()) for name, b in scene.blocks().items()}
    term = dataclasses.replace(scene.term(), data=(scene.x.float(),))
    result = sparse_levenberg_marquardt(blocks, [term], eliminate="point", function_tolerance=1e-8)
    assert result.status == Status.OK
    assert all(v.dtype == torch.float32 for v in result.x.values())
    np.testing.assert_allclose(result.cost, solve(scene.blocks(), [scene.term()]).cost, rtol=1e-4)


@pytest.mark.parametrize("way", ["raise", "return"])
def test_interrupt_returns_the_best_so_far(scene: Scene, way: str) -> None:
    before = scene.point.clone()
    costs = []

    def stop(iteration: int, cost: float) -> bool | None:
        costs.append(cost)
        if iteration == 2 and way == "raise":
            raise KeyboardInterrupt
        return iteration < 2

    result = solve(scene.blocks(), [scene.term()], progress=stop)
    assert result.status == Status.INTERRUPTED
    assert result.iterations == len(costs) == 2
    assert result.cost == costs[-1] < result.initial_cost
    same = sparse_levenberg_marquardt(
        scene.blocks(), [scene.term()], eliminate="point", function_tolerance=0.0, max_iterations=2
    )
    assert torch.equal(same.x["point"], result.x["point"])
    assert torch.equal(scene.point, before)


def test_interrupt_inside_a_step(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    plain = schur.Elimination.linearize

    def linearize(self: schur.Elimination, x: dict[str, Tensor]) -> object:
        calls.append(x)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return plain(self, x)

    monkeypatch.setattr(schur.Elimination, "linearize", linearize)
    result = solve(scene.blocks(), [scene.term()])
    assert result.status == Status.INTERRUPTED
    assert torch.equal(result.x["point"], calls[2]["point"].contiguous())
    assert result.cost < result.initial_cost


def test_wrong_arguments(scene: Scene) -> None:
    with pytest.raises(ValueError, match="eliminate"):
        sparse_levenberg_marquardt(scene.blocks(), [scene.term()], eliminate="lines")
    with pytest.raises(ValueError, match=r"terms\[0\].*'line'"):
        solve(scene.blocks(), [dataclasses.replace(scene.term(), blocks=("pose", "focal", "line"))])
    with pytest.raises(ValueError, match="one length"):
        solve(scene.blocks(), [dataclasses.replace(scene.term(), data=(scene.x[:-1],))])
    between = Term(lambda a, b: a - b, ("point", "point"), (torch.tensor([0]), torch.tensor([1])))
    with pytest.raises(ValueError, match="two variables"):
        solve(scene.blocks(), [between])


def test_layout_drops_what_cannot_move(scene: Scene) -> None:
    pose = torch.ones(6, dtype=torch.bool)
    pose[2] = False
    blocks = scene.blocks(pose=pose, focal=torch.ones(2, dtype=torch.bool), point=torch.arange(20) >= 10)
    found = layout.lay_out(blocks, [scene.term()], "point")
    assert found.size == 6
    assert found.families[0].points == 10
    assert sum(p.slots.numel() for p in found.pieces) == int(((scene.view == 2) | (scene.seen < 10)).sum())


@pytest.mark.parametrize("solver", ["dense", "sparse", "pcg"])
def test_two_families_are_eliminated_as_one_is(generator: torch.Generator, solver: solver_choice.Solver) -> None:
    """Stations see marks of the plane and walls of one number: which of them are eliminated changes nothing but the work."""
    stations, marks, walls = 5, 60, 70
    place = torch.randn(stations, 2, generator=generator, dtype=F64)
    mark = 3 * torch.randn(marks, 2, generator=generator, dtype=F64)
    wall = 3 * torch.randn(walls, 1, generator=generator, dtype=F64)
    s, m = torch.cartesian_prod(torch.arange(stations), torch.arange(marks)).unbind(1)
    t, w = torch.cartesian_prod(torch.arange(stations), torch.arange(walls)).unbind(1)
    noise = [0.1 * torch.randn(len(k), 1, generator=generator, dtype=F64) for k in (s, t)]
    terms = [
        Term(lambda p, X, d: (X - p).norm(dim=1, keepdim=True) - d, ("station", "mark"), (s, m), (
            (mark[m] - place[s]).norm(dim=1, keepdim=True) + noise[0],)),
        Term(lambda p, h, d: h - p[:, :1].sin() - d, ("station", "wall"), (t, w), (
            wall[w] - place[t, :1].sin() + noise[1],), loss=Cauchy(0.5)),
    ]  # fmt: skip
    held = torch.arange(stations) == 0
    blocks = {
        "station": Block(place + 0.1 * torch.randn(stations, 2, generator=generator, dtype=F64) * ~held[:, None], None, held),
        "mark": Block(mark + 0.1 * torch.randn(marks, 2, generator=generator, dtype=F64)),
        "wall": Block(wall),
    }
    found = [
        sparse_levenberg_marquardt(
            blocks, terms, eliminate=eliminate, linear_solver=solver, function_tolerance=1e-14, max_iterations=200
        )
        for eliminate in (None, "mark", ("mark", "wall"), ("wall", "mark"))
    ]
    for other in found[1:]:
        assert other.cost == pytest.approx(found[0].cost, rel=1e-9)
        torch.testing.assert_close(other.x["wall"], found[0].x["wall"], rtol=0, atol=1e-5)
    spread = [sparse_covariance(blocks, terms, eliminate=eliminate) for eliminate in (None, ("mark", "wall"))]
    for name in blocks:
        torch.testing.assert_close(spread[1].blocks[name], spread[0].blocks[name], rtol=1e-6, atol=1e-9)
    assert spread[0].redundancy == spread[1].redundancy


def test_a_residual_of_two_families_is_refused() -> None:
    one = torch.zeros(1, dtype=torch.long)
    blocks = {"a": Block(torch.zeros(1, 1, dtype=F64)), "b": Block(torch.zeros(1, 1, dtype=F64))}
    term = Term(lambda a, b: a + b, ("a", "b"), (one, one))
    with pytest.raises(ValueError, match="'a' and 'b'"):
        sparse_levenberg_marquardt(blocks, [term], eliminate=("a", "b"))


def test_steps_are_lengthened_where_the_loss_bends_down(monkeypatch: pytest.MonkeyPatch) -> None:
    """Next to the minimum between two groups of data, nine tenths of the Gauss-Newton curvature are not there."""
    y = torch.tensor([0.9, -0.9], dtype=torch.float64).repeat(50)[:, None]
    term = Term(lambda x, y: x - y, ("x",), (torch.zeros(100, dtype=torch.int64),), (y,), loss=Cauchy(1.0))
    start = {"x": Block(torch.full((1, 1), 0.2, dtype=torch.float64))}
    engine = sys.modules[sparse_levenberg_marquardt.__module__]

    def minimum() -> SparseResult:
        return sparse_levenberg_marquardt(start, [term], function_tolerance=1e-7)

    found = minimum()
    monkeypatch.setattr(engine, "FARTHEST", 1.0)
    plain = minimum()
    assert found.status == Status.OK
    assert found.cost < (1 + 1e-7) * plain.cost
    assert found.iterations <= plain.iterations / 2


def test_a_minimum_is_not_linearised_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each linearisation is one that a step is taken from."""
    places: list[float] = []
    plain = schur.Elimination.linearize

    def counted(self: schur.Elimination, x: dict[str, Tensor], *ends: Any) -> Any:
        places.append(float(x["x"]))
        return plain(self, x, *ends)

    monkeypatch.setattr(schur.Elimination, "linearize", counted)
    y = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    term = Term(lambda x, y: x - y, ("x",), (torch.zeros(2, dtype=torch.int64),), (y,))
    # So far from the minimum costs tell what steps gain, not slopes.
    found = sparse_levenberg_marquardt({"x": Block(y[:1])}, [term], function_tolerance=1e-2, initial_damping=1e-2)
    assert found.status == Status.OK
    assert len(places) == found.iterations
