"""Lines in a bundle, together with points and alone."""

import dataclasses

import pytest
import torch
from chance import assert_unit_variance
from structure_scenes import (
    LENSES,
    adjusted,
    assert_written_derivatives,
    first_two,
    moved,
    views_on_an_arc,
    whitened,
    with_a_rig_of_one,
    with_all_free,
    with_points,
    with_the_first_camera_where_it_was,
    without_points,
)
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import BundleLines, bundle_adjust, bundle_covariance
from torchsfm.bundle.blocks import Bundle
from torchsfm.geometry import (
    BundleProblem,
    Camera,
    intrinsics,
    line_to_line_distance,
    pluecker_from_points,
    point_to_line_distance,
    rotvec_from_rotation,
)
from torchsfm.geometry.line_manifold import line_tangents
from torchsfm.optim import Block, Cauchy, Huber, Loss, RigidMotion, Term, sparse_levenberg_marquardt
from torchsfm.optim.curvature import curvature
from torchsfm.optim.terms import Workspace, linearize, prepare, term_residual

F64 = torch.float64


@dataclasses.dataclass(frozen=True)
class Scene:
    problem: BundleProblem
    lines: BundleLines
    ends: Tensor
    """Of the lines in space, (l, 2, 3)."""


def make_scene(
    generator: torch.Generator, *, lens: str = "none", views: int = 5, points: int = 30, lines: int = 12, noise: float = 0.0
) -> Scene:
    """Views on an arc; segments whose ends do not correspond, noise across them."""
    poses, camera = views_on_an_arc(generator, lens, views)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    X, ends = 2 * rand(points, 3) - 1, 2 * rand(lines, 2, 3) - 1
    ends[:, 1] = ends[:, 0] + (ends[:, 1] - ends[:, 0]) * 1.2 / (ends[:, 1] - ends[:, 0]).norm(dim=-1, keepdim=True)
    seen, line = torch.cartesian_prod(torch.arange(views), torch.arange(lines)).unbind(1)
    share = torch.stack((0.3 * rand(len(line)), 0.7 + 0.3 * rand(len(line))), -1)[..., None]
    on = ends[line, None, 0] * (1 - share) + ends[line, None, 1] * share
    image = camera.project(poses[seen].transform(on))
    problem = with_points(poses, camera, X)
    problem = dataclasses.replace(problem, x=problem.x + noise * randn(*problem.x.shape))
    L = pluecker_from_points(ends[:, 0], ends[:, 1])
    return Scene(problem, BundleLines(L, image + noise * randn(*image.shape), seen, line), ends)


def disturbed(scene: Scene, generator: torch.Generator, size: float = 0.02) -> tuple[BundleProblem, BundleLines]:
    """All but the first two poses, points and lines moved."""
    problem = moved(scene.problem, generator, size)
    ends = scene.ends + size * torch.randn(scene.ends.shape, generator=generator, dtype=F64)
    return problem, dataclasses.replace(scene.lines, L=pluecker_from_points(ends[:, 0], ends[:, 1]))


def gap(lines: BundleLines, ends: Tensor) -> Tensor:
    """How far lines are from the ends of the true ones."""
    return point_to_line_distance(ends, lines.L[:, None]).amax(-1)


@pytest.mark.parametrize("lens", LENSES)
def test_residuals_are_distances_from_the_image_of_the_line(generator: torch.Generator, lens: str) -> None:
    scene = make_scene(generator, lens=lens)
    lines = dataclasses.replace(
        scene.lines, x=scene.lines.x + 2 * torch.randn(scene.lines.x.shape, generator=generator, dtype=F64)
    )
    bundle = Bundle(scene.problem, structure=(lines,))
    blocks, terms = bundle.problem()
    # As if the intrinsics had moved since the rays were taken: the camera is another one.
    row = blocks["camera"].x * 1.02
    found = term_residual(terms[1], {name: b.x for name, b in blocks.items()} | {"camera": row})
    share = torch.linspace(-0.5, 1.5, 20001, dtype=F64)[:, None]
    distortion = type(scene.problem.cameras.distortion).from_parameters(row[0, 5:])
    camera = Camera(intrinsics(row[0, 0], row[0, 3:5], row[0, 1]), distortion)
    for k in range(0, len(lines.x), 7):
        a, b = scene.ends[lines.line[k]]
        curve = camera.project(scene.problem.poses[lines.view[k]].transform(a + share * (b - a)))
        nearest = torch.cdist(lines.x[k], curve).amin(1)
        # The curve is sampled every twentieth of a pixel.
        torch.testing.assert_close(found[k].abs(), nearest, rtol=1e-3, atol=3e-3)


@pytest.mark.parametrize("lens", LENSES)
def test_exact_data_are_recovered(generator: torch.Generator, lens: str) -> None:
    scene = make_scene(generator, lens=lens)
    problem, lines = disturbed(scene, generator)
    result = bundle_adjust(problem, fixed_poses=first_two(problem), structure=[lines], tolerance=1e-14)
    assert result.status == Status.OK
    assert result.cost < 1e-12
    assert (gap(adjusted(result, BundleLines), scene.ends) < 1e-8).all()
    assert (result.X - scene.problem.X).abs().max() < 1e-8
    assert result.structure_residuals[0].shape == lines.x.shape[:2]
    assert result.structure_residuals[0].abs().max() < 1e-6


def test_lines_alone_determine_poses(generator: torch.Generator) -> None:
    scene = make_scene(generator, lines=25, views=6)
    problem, lines = disturbed(scene, generator)
    result = bundle_adjust(without_points(problem), free=(), fixed_poses=first_two(problem), structure=[lines], tolerance=1e-14)
    assert (result.poses.t - scene.problem.poses.t).abs().max() < 1e-7
    assert (gap(adjusted(result, BundleLines), scene.ends) < 1e-7).all()


def test_held_lines_are_points_that_slide_along_them(generator: torch.Generator) -> None:
    """Poses from segments against held lines are those from points on them, each with its place along the line free."""
    scene = make_scene(generator, lens="radial", noise=1.0)
    problem, lines = disturbed(scene, generator)
    held = dataclasses.replace(scene.lines, fixed=torch.ones(len(lines.L), dtype=torch.bool))
    result = bundle_adjust(without_points(problem), free=(), structure=[held], tolerance=1e-15)
    assert torch.equal(adjusted(result, BundleLines).L, held.L)
    blocks, _ = Bundle(problem, free=()).problem()
    bundle = Bundle(problem, free=(), structure=(held,))
    projection = bundle.problem()[1][0].residual
    a, b = scene.ends[held.line].unbind(1)

    def residual(pose: Tensor, camera: Tensor, place: Tensor, a: Tensor, d: Tensor, x: Tensor) -> Tensor:
        return projection(pose, camera, a + place * d, x)

    terms = [
        Term(
            residual, ("pose", "camera", f"place{k}"),
            (held.view, torch.zeros_like(held.view), torch.arange(len(held.view))), (a, b - a, held.x[:, k]),
        )
        for k in range(2)
    ]  # fmt: skip
    places = {f"place{k}": Block(torch.full((len(held.view), 1), 0.2 + 0.6 * k, dtype=F64)) for k in range(2)}
    camera = dataclasses.replace(blocks["camera"], fixed=torch.ones(1, dtype=torch.bool))
    slid = sparse_levenberg_marquardt(
        {"pose": Block(blocks["pose"].x, RigidMotion()), "camera": camera, **places}, terms,
        eliminate=tuple(places), function_tolerance=1e-15, max_iterations=100,
    )  # fmt: skip
    assert slid.cost == pytest.approx(result.cost, rel=1e-6)
    torch.testing.assert_close(slid.x["pose"][:, 9:], result.poses.t, rtol=0, atol=1e-5)


@pytest.mark.parametrize("lens", ["none", "radial"])
def test_errors_are_those_of_the_covariance(generator: torch.Generator, lens: str) -> None:
    """Of poses and of lines, in units of the covariance: chi-square of 6 and of 4."""
    poses, lines = [], []
    scene = make_scene(generator, lens=lens, points=12, lines=10)
    held = first_two(scene.problem)
    C = bundle_covariance(scene.problem, sigma=0.2, structure=[scene.lines], fixed_poses=held)
    for _ in range(10):
        noise = [0.2 * torch.randn(x.shape, generator=generator, dtype=F64) for x in (scene.problem.x, scene.lines.x)]
        noisy = dataclasses.replace(scene.problem, x=scene.problem.x + noise[0])
        seen = dataclasses.replace(scene.lines, x=scene.lines.x + noise[1])
        result = bundle_adjust(noisy, structure=[seen], tolerance=1e-9, fixed_poses=held)
        turn = result.poses @ scene.problem.poses.inverse()
        poses.append(whitened(torch.cat((rotvec_from_rotation(turn.R), turn.t), -1)[~held], C.poses[~held]))
        lines.append(whitened(line_steps(scene.lines.L, adjusted(result, BundleLines).L), C.structure[0]))
    # Errors within a trial depend on each other, those of one pose or line in several do not.
    for scores in (poses, lines):
        assert_unit_variance(torch.stack(scores).movedim(1, -1).flatten(0, 1), dim=0)


def line_steps(L: Tensor, M: Tensor) -> Tensor:
    """The first-order step of `Line3D` from lines to others near them, by least squares on its derivative."""
    L, M = (v / v[:, :3].norm(dim=1, keepdim=True) for v in (L, M))
    M = M * (L * M).sum(1, keepdim=True).sign()
    size = L.norm(dim=1, keepdim=True)
    M = M / M.norm(dim=1, keepdim=True) * size
    return torch.linalg.lstsq(line_tangents(L), (M - L)[..., None]).solution[..., 0]


def test_a_rig_of_one_changes_nothing(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5)
    problem, lines = disturbed(scene, generator)
    plain, rigged = with_a_rig_of_one(problem, lines)
    assert (line_to_line_distance(adjusted(rigged, BundleLines).L, adjusted(plain, BundleLines).L) < 1e-6).all()


def test_what_is_held_or_unseen_keeps_every_bit(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5)
    problem, lines = disturbed(scene, generator)
    fixed = torch.zeros(len(lines.L), dtype=torch.bool)
    fixed[3] = True
    weights = (lines.line != 5).to(F64)
    x = lines.x.clone()
    x[lines.line == 7] = torch.nan
    changed = dataclasses.replace(lines, fixed=fixed, weights=weights, x=x)
    result = bundle_adjust(problem, structure=[changed])
    after = adjusted(result, BundleLines).L
    same = (after == lines.L).all(1)
    assert same.nonzero()[:, 0].tolist() == [3, 5, 7]
    assert after.isfinite().all()
    dead = (lines.line == 5) | (lines.line == 7)
    assert torch.equal(result.structure_residuals[0].isinf().all(1), dead)
    # They are as if they were not there.
    keep = ~dead
    others = dataclasses.replace(lines, fixed=fixed, x=x[keep], view=lines.view[keep], line=lines.line[keep])
    again = bundle_adjust(problem, structure=[others])
    assert again.cost == pytest.approx(result.cost, rel=1e-9)
    covariance = bundle_covariance(problem, structure=[changed]).structure[0]
    assert torch.equal(covariance[3], torch.zeros(4, 4, dtype=F64))
    assert covariance[[5, 7]].diagonal(dim1=1, dim2=2).isinf().all()


def test_a_loss_resists_wrong_segments(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.2, lines=20)
    problem, lines = disturbed(scene, generator, 0.005)
    wrong = torch.rand(len(lines.x), generator=generator) < 0.1
    x = torch.where(wrong[:, None, None], lines.x + 40 * torch.randn(lines.x.shape, generator=generator, dtype=F64), lines.x)
    gaps = [
        gap(
            adjusted(bundle_adjust(problem, fixed_poses=first_two(problem), structure=[some]), BundleLines), scene.ends
        ).median()
        for loss in (None, Huber(0.5))
        for some in [dataclasses.replace(lines, x=x, loss=loss)]
    ]
    assert gaps[1] < 0.3 * gaps[0]


def test_the_world_comes_back_with_its_lines(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5)
    problem, lines = disturbed(scene, generator)
    with_the_first_camera_where_it_was(problem, lines)


def test_derivatives_by_segments(generator: torch.Generator) -> None:
    scene = make_scene(generator, lens="radial", noise=0.5, lines=4, points=8, views=3)
    problem, lines = disturbed(scene, generator)
    held = torch.ones(3, dtype=torch.bool)
    probe = torch.randn(lines.L.shape, generator=generator, dtype=F64)

    def found(x: Tensor) -> Tensor:
        some = dataclasses.replace(lines, x=x)
        result = bundle_adjust(problem, free=(), fixed_poses=held, structure=[some], tolerance=1e-16, max_iterations=100)
        return (adjusted(result, BundleLines).L * probe).sum()

    x = lines.x.clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(x), x)
    step = torch.randn(x.shape, generator=generator, dtype=F64)
    numeric = (found(lines.x + 1e-4 * step) - found(lines.x - 1e-4 * step)) / 2e-4
    torch.testing.assert_close((slope * step).sum(), numeric.detach(), rtol=1e-5, atol=1e-7)


@pytest.mark.usefixtures("unchecked")
def test_wrong_lines(generator: torch.Generator) -> None:
    scene = make_scene(generator)
    lines = scene.lines
    with pytest.raises(ValueError, match=r"weights: wanted"):
        dataclasses.replace(lines, weights=torch.ones(3, dtype=F64))
    with pytest.raises(ValueError, match=r"x: wanted"):
        dataclasses.replace(lines, x=lines.x[:, 0])
    with pytest.raises(ValueError, match=r"line: wanted numbers from 0 to 11"):
        dataclasses.replace(lines, line=lines.line + 1)
    with pytest.raises(ValueError, match=r"structure.view: wanted numbers from 0 to 4"):
        bundle_adjust(scene.problem, structure=[dataclasses.replace(lines, view=lines.view + 1)])
    with pytest.raises(ValueError, match="one of a kind"):
        bundle_adjust(scene.problem, structure=[lines, lines])
    with pytest.raises(ValueError, match=r"structure\[0\]"):
        bundle_adjust(scene.problem, structure=[lines.L])  # type: ignore[list-item]


@pytest.mark.parametrize("rigged", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_the_written_derivatives_are_those_of_the_residuals(generator: torch.Generator, lens: str, rigged: bool) -> None:
    """By every variable, where cameras have moved since the rays were taken, with skew and numbers held in some cameras."""
    scene = make_scene(generator, lens=lens, noise=1.0)
    problem, lines = disturbed(scene, generator, 0.002)
    blocks, terms = with_all_free(problem, lines, rigged, generator)
    blocks["camera"] = dataclasses.replace(blocks["camera"], x=blocks["camera"].x * 1.003)
    blocks, terms, _ = prepare(blocks, terms[1:2])
    found = assert_written_derivatives(blocks, terms[0], 2, lines.x)
    # Those of eliminated variables alone.
    only = [None] * (len(found) - 2) + [torch.empty_like(found[-2])]
    linearize(terms[0], {name: block.x for name, block in blocks.items()}, {}, only, Workspace(lines.x))
    torch.testing.assert_close(only[-1], found[-2])


@pytest.mark.parametrize("loss", [None, Cauchy(0.5)])
@pytest.mark.parametrize("rigged", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_the_written_second_derivatives_are_those_of_the_cost(
    generator: torch.Generator, lens: str, rigged: bool, loss: Loss | None
) -> None:
    scene = make_scene(generator, lens=lens, noise=1.0, views=4, lines=5)
    problem, lines = disturbed(scene, generator, 0.002)
    lines = dataclasses.replace(lines, loss=loss, weights=0.5 + torch.rand(len(lines.x), generator=generator, dtype=F64))
    blocks, terms = with_all_free(problem, lines, rigged, generator)
    blocks["camera"] = dataclasses.replace(blocks["camera"], x=blocks["camera"].x * 1.003)
    blocks, (term,), _ = prepare(blocks, terms[1:2])
    every = [True] * len(term.blocks)
    some = [[bool(k >> i & 1) for i in range(len(every))] for k in range(1, 2 ** len(every))]
    # All subsets of the variables where the lens is the longest.
    for wanted in some if lens == "brown" and loss is None else [every]:
        assert_written_curvature(blocks, term, wanted)


def assert_written_curvature(blocks: dict[str, Block], term: Term, wanted: list[bool]) -> None:
    assert term.bend is not None
    x = {name: block.x for name, block in blocks.items()}
    slots = torch.arange(len(term.index[0])), torch.arange(len(term.index[0]))
    found, other = (curvature(some, x, blocks, wanted, "line", slots) for some in (term, dataclasses.replace(term, bend=None)))
    for mine, exact in zip(found, other, strict=True):
        assert mine.shape == exact.shape
        if exact.numel():
            torch.testing.assert_close(mine, exact, rtol=1e-6, atol=1e-7 * float(exact.abs().max()))


def test_lines_turn_about_the_farthest_view(generator: torch.Generator) -> None:
    """A line close by the camera it turned about let one adjustment of photographs take 300 steps instead of 50."""
    scene = make_scene(generator)
    blocks, _ = Bundle(scene.problem, structure=[scene.lines]).problem()
    centres, L = scene.problem.poses.centre, scene.lines.L
    apart = point_to_line_distance(centres[:, None], L)
    used = point_to_line_distance(blocks["line"].x[:, 6:9], L)
    torch.testing.assert_close(used, apart.amax(0), rtol=1e-9, atol=1e-12)
    assert bool((apart[0] < apart.amax(0)).any()), "the first view is not always the farthest"
