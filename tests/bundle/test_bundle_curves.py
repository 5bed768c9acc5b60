"""Curves in a bundle: samples that move across, seen as image curves no point of which corresponds to any in another view."""

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
from torchsfm.bundle import BundleCurves, BundleLines, RelativePosePrior, bundle_adjust, bundle_covariance
from torchsfm.bundle.blocks import Bundle
from torchsfm.geometry import (
    BundleProblem,
    Similarity,
    pluecker_from_points,
    random_rotation,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from torchsfm.optim import Huber
from torchsfm.optim.terms import prepare, term_residual

F64 = torch.float64


@dataclasses.dataclass(frozen=True)
class Scene:
    problem: BundleProblem
    curves: BundleCurves
    centre: Tensor
    """Of the helix that each sample is on, (n, 3)."""
    axes: Tensor
    """Two directions of its turn and that of its rise, (n, 3, 3); without the first two it is straight."""
    place: Tensor
    """Of each sample."""

    def at(self, sample: Tensor, place: Tensor) -> Tensor:
        turn = torch.stack((place.cos() - 1, place.sin(), place), -1)
        return self.centre[sample] + (turn[..., None, :] @ self.axes[sample])[..., 0, :]

    def project(self, sample: Tensor, view: Tensor, place: Tensor) -> Tensor:
        cameras = self.problem.cameras[self.problem.camera_index[view]]
        return cameras.project(self.problem.poses[view].transform(self.at(sample, place)[:, None]))[:, 0]


def make_scene(
    generator: torch.Generator,
    *,
    lens: str = "none",
    views: int = 5,
    points: int = 30,
    samples: int = 24,
    noise: float = 0.0,
    apart: float = 0.3,
    bend: float = 1.0,
) -> Scene:
    """Views on an arc; of each sample an edge point some pixels along the image curve, noise across it."""
    poses, camera = views_on_an_arc(generator, lens, views)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    X = 2 * rand(points, 3) - 1
    problem = with_points(poses, camera, X)
    problem = dataclasses.replace(problem, x=problem.x + noise * randn(*problem.x.shape))
    # Curves that run towards a camera have images with cusps: of many, those that do so the least.
    many = 8 * samples
    axes = random_rotation(many, generator=generator, dtype=F64) * torch.tensor([0.5 * bend, 0.5 * bend, 0.8])[:, None]
    x, view = problem.x[:0], problem.view[:0]
    empty = BundleCurves(X[:0], X[:0], x, x, view, view)
    scene = Scene(problem, empty, 2 * rand(many, 3) - 1, axes, 0.5 * randn(many))
    seen, sample = torch.cartesian_prod(torch.arange(views), torch.arange(many)).unbind(1)
    h = 1e-4
    ends = [scene.project(sample, seen, scene.place[sample] + step) for step in (-h, h)]
    speed = (ends[1] - ends[0]).norm(dim=-1).reshape(views, many) / (2 * h)
    best = speed.amin(0).topk(samples).indices
    scene = Scene(problem, empty, scene.centre[best], scene.axes[best], scene.place[best])
    seen, sample = torch.cartesian_prod(torch.arange(views), torch.arange(samples)).unbind(1)
    speed, here = speed[:, best].flatten(), scene.place
    tangent = scene.at(torch.arange(samples), here + h) - scene.at(torch.arange(samples), here - h)
    place = here[sample] + apart * (2 * rand(len(sample)) - 1) / speed
    before, image, after = (scene.project(sample, seen, place + step) for step in (-h, 0, h))
    first, second = (after - before) / (2 * h), (after - 2 * image + before) / h**2
    normal = torch.stack((-first[:, 1], first[:, 0]), -1) / first.norm(dim=-1, keepdim=True)
    curvature = (normal * second).sum(-1) / first.square().sum(-1)
    image = image + noise * randn(len(image))[:, None] * normal
    curves = BundleCurves(scene.at(torch.arange(samples), here), tangent, image, 3 * normal, seen, sample, curvature)
    return dataclasses.replace(scene, curves=curves)


def disturbed(scene: Scene, generator: torch.Generator, size: float = 0.003) -> tuple[BundleProblem, BundleCurves]:
    """All but the first two poses moved, points, and samples across their curves."""
    problem = moved(scene.problem, generator, size)
    along = scene.curves.tangent / scene.curves.tangent.norm(dim=-1, keepdim=True)
    move = size * torch.randn(along.shape, generator=generator, dtype=F64)
    samples = scene.curves.X + move - (move * along).sum(-1, keepdim=True) * along
    return problem, dataclasses.replace(scene.curves, X=samples)


@pytest.mark.parametrize("lens", LENSES)
def test_residuals_are_distances_from_image_curves(generator: torch.Generator, lens: str) -> None:
    """Of what a sample that is off shows, to the true image curve, wherever on it the edge point is."""
    scene = make_scene(generator, lens=lens, apart=2.0)
    _, curves = disturbed(scene, generator)
    blocks, terms = Bundle(scene.problem, structure=(curves,)).problem()
    found = term_residual(terms[1], {name: b.x for name, b in blocks.items()})[:, 0]
    share = torch.linspace(-0.1, 0.1, 20001, dtype=F64)
    for k in range(0, len(curves.x), 7):
        view, sample = curves.view[k].expand(len(share)), curves.sample[k].expand(len(share))
        image = scene.project(sample, view, scene.place[sample] + share)
        camera = scene.problem.cameras[0]
        own = camera.project(scene.problem.poses[view[:1]].transform(curves.X[sample[:1], None]))[0, 0]
        nearest = (image - own).norm(dim=-1).min(0)
        assert 0 < nearest.indices < len(share) - 1
        torch.testing.assert_close(found[k].abs(), nearest.values, rtol=2e-3, atol=3e-3)
        # Positive to the side of the normal.
        side = ((own - image[nearest.indices]) * curves.normal[k]).sum()
        assert side * found[k] > -1e-2


@pytest.mark.parametrize("lens", LENSES)
def test_exact_data_are_recovered(generator: torch.Generator, lens: str) -> None:
    scene = make_scene(generator, lens=lens)
    problem, curves = disturbed(scene, generator)
    result = bundle_adjust(problem, fixed_poses=first_two(problem), structure=[curves], tolerance=1e-14)
    assert result.cost < 1e-6
    assert (adjusted(result, BundleCurves).X - scene.curves.X).abs().max() < 1e-4
    assert (result.poses.t - scene.problem.poses.t).abs().max() < 1e-6
    assert result.structure_residuals[0].shape == (len(curves.x), 1)
    assert result.structure_residuals[0].abs().max() < 1e-3


def test_curves_alone_determine_poses(generator: torch.Generator) -> None:
    scene = make_scene(generator, samples=60, views=6, apart=0.1)
    problem, curves = disturbed(scene, generator)
    result = bundle_adjust(
        without_points(problem), free=(), fixed_poses=first_two(problem), structure=[curves], tolerance=1e-14
    )
    assert (result.poses.t - scene.problem.poses.t).abs().max() < 1e-5
    assert (rotvec_from_rotation((result.poses @ scene.problem.poses.inverse()).R)).abs().max() < 1e-5


@pytest.mark.parametrize("lens", ["none", "radial"])
def test_two_samples_of_a_straight_curve_are_a_line(generator: torch.Generator, lens: str) -> None:
    """What they say of cameras is what a segment says whose ends are the images of the samples."""
    scene = make_scene(generator, lens=lens, apart=0.0, bend=0.0, samples=10, points=8)
    other = dataclasses.replace(scene, place=scene.place + 0.8)
    both = [
        torch.stack(
            [s.project(scene.curves.sample, scene.curves.view, s.place[scene.curves.sample]) for s in (scene, other)], 1
        ),
        torch.stack([s.at(torch.arange(10), s.place) for s in (scene, other)], 1),
    ]
    lines = BundleLines(pluecker_from_points(*both[1].unbind(1)), both[0], scene.curves.view, scene.curves.sample)
    d = both[0][:, 1] - both[0][:, 0]
    twice = BundleCurves(
        both[1].flatten(0, 1), (both[1][:, 1] - both[1][:, 0]).repeat_interleave(2, 0), both[0].flatten(0, 1),
        torch.stack((-d[:, 1], d[:, 0]), -1).repeat_interleave(2, 0), scene.curves.view.repeat_interleave(2),
        2 * scene.curves.sample.repeat_interleave(2) + torch.arange(2).repeat(len(d)),
    )  # fmt: skip
    if lens != "none":
        # A lens bends the chord: the normals are those at the ends.
        ahead = [s.project(scene.curves.sample, scene.curves.view, s.place[scene.curves.sample] + 1e-6) for s in (scene, other)]
        d = (torch.stack(ahead, 1) - both[0]).flatten(0, 1)
        twice = dataclasses.replace(twice, normal=torch.stack((-d[:, 1], d[:, 0]), -1))
    options = {"sigma": 0.3, "fixed_poses": first_two(scene.problem)}
    of_lines, of_curves = (bundle_covariance(scene.problem, structure=[some], **options) for some in (lines, twice))
    for mine, other in ((of_curves.poses, of_lines.poses), (of_curves.cameras, of_lines.cameras)):
        # In units of the standard deviations: correlations may be next to nothing.
        sigma = other.diagonal(dim1=1, dim2=2).sqrt().clamp_min(1e-100)
        unit = sigma[:, :, None] * sigma[:, None]
        torch.testing.assert_close(mine / unit, other / unit, rtol=0, atol=1e-6)


@pytest.mark.parametrize("lens", ["none", "radial"])
def test_errors_are_those_of_the_covariance(generator: torch.Generator, lens: str) -> None:
    """Of poses and of samples across, in units of the covariance, which is the Cramer-Rao bound: chi-square of 6 and of 2."""
    poses, samples = [], []
    scene = make_scene(generator, lens=lens, points=12, samples=20)
    held = first_two(scene.problem)
    options = {"sigma": 0.2, "fixed_poses": held}
    C = bundle_covariance(scene.problem, structure=[scene.curves], **options)
    alone = bundle_covariance(scene.problem, **options)
    assert (C.poses[~held].diagonal(dim1=1, dim2=2) < 0.98 * alone.poses[~held].diagonal(dim1=1, dim2=2)).all()
    values, vectors = torch.linalg.eigh(C.structure[0])
    along = torch.nn.functional.normalize(scene.curves.tangent, dim=-1)
    assert (C.structure[0] @ along[..., None]).abs().max() < 1e-9 * values[:, 1].min()
    to_unit = (vectors / values.clamp_min(1e-300).sqrt()[:, None])[..., 1:].mT
    normal = scene.curves.normal / scene.curves.normal.norm(dim=-1, keepdim=True)
    for _ in range(10):
        noise = 0.2 * torch.randn(scene.problem.x.shape, generator=generator, dtype=F64)
        aside = 0.2 * torch.randn(len(normal), 1, generator=generator, dtype=F64)
        noisy = dataclasses.replace(scene.problem, x=scene.problem.x + noise)
        seen = dataclasses.replace(scene.curves, x=scene.curves.x + aside * normal)
        result = bundle_adjust(noisy, structure=[seen], tolerance=1e-9, fixed_poses=held)
        turn = result.poses @ scene.problem.poses.inverse()
        step = torch.cat((rotvec_from_rotation(turn.R), turn.t), -1)[~held]
        poses.append(whitened(step, C.poses[~held]))
        samples.append((to_unit @ (adjusted(result, BundleCurves).X - scene.curves.X)[..., None])[..., 0])
    # Errors within a trial depend on each other, those of one pose or sample in several do not.
    for scores in (poses, samples):
        assert_unit_variance(torch.stack(scores).movedim(1, -1).flatten(0, 1), dim=0)


def test_a_rig_of_one_changes_nothing(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5)
    problem, curves = disturbed(scene, generator)
    plain, rigged = with_a_rig_of_one(problem, curves)
    assert (adjusted(rigged, BundleCurves).X - adjusted(plain, BundleCurves).X).abs().max() < 1e-6


def test_what_is_held_or_unseen_keeps_every_bit(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5)
    problem, curves = disturbed(scene, generator)
    fixed = torch.zeros(len(curves.X), dtype=torch.bool)
    fixed[3] = True
    weights = (curves.sample != 5).to(F64)
    x, normal, tangent = curves.x.clone(), curves.normal.clone(), curves.tangent.clone()
    x[curves.sample == 7], normal[curves.sample == 9], tangent[11] = torch.nan, 0.0, 0.0
    changed = dataclasses.replace(curves, fixed=fixed, weights=weights, x=x, normal=normal, tangent=tangent)
    result = bundle_adjust(problem, structure=[changed], tolerance=1e-13, max_iterations=200)
    after = adjusted(result, BundleCurves).X
    assert (after == curves.X).all(1).nonzero()[:, 0].tolist() == [3, 5, 7, 9, 11]
    assert after.isfinite().all()
    dead = torch.isin(curves.sample, torch.tensor([5, 7, 9, 11]))
    assert torch.equal(result.structure_residuals[0].isinf().all(1), dead)
    # They are as if they were not there.
    some = {name: getattr(curves, name)[~dead] for name in ("x", "normal", "curvature", "view", "sample")}
    others = dataclasses.replace(curves, fixed=fixed, **some)
    again = bundle_adjust(problem, structure=[others], tolerance=1e-13, max_iterations=200)
    assert again.cost == pytest.approx(result.cost, rel=1e-7)
    covariance = bundle_covariance(problem, structure=[changed]).structure[0]
    assert torch.equal(covariance[3], torch.zeros(3, 3, dtype=F64))
    assert covariance[[5, 7, 9, 11]].diagonal(dim1=1, dim2=2).isinf().all()


def test_a_loss_resists_wrong_edges(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.2, samples=60)
    problem, curves = disturbed(scene, generator)
    wrong = torch.rand(len(curves.x), generator=generator) < 0.1
    x = torch.where(wrong[:, None], curves.x + 20 * torch.randn(curves.x.shape, generator=generator, dtype=F64), curves.x)
    off = [
        (adjusted(bundle_adjust(problem, fixed_poses=first_two(problem), structure=[some]), BundleCurves).X - scene.curves.X)
        .norm(dim=-1)
        .median()
        for loss in (None, Huber(0.5))
        for some in [dataclasses.replace(curves, x=x, loss=loss)]
    ]
    assert off[1] < 0.5 * off[0]


def test_the_world_comes_back_with_its_curves(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5)
    problem, curves = disturbed(scene, generator)
    free, first = with_the_first_camera_where_it_was(problem, curves)
    # Directions turn with the world: across the curve is where it was.
    turn = first.poses.R[0].mT @ free.poses.R[0]
    torch.testing.assert_close(adjusted(first, BundleCurves).tangent, curves.tangent @ turn.mT, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["x", "normal", "curvature"])
def test_derivatives_by_image_curves(generator: torch.Generator, name: str) -> None:
    scene = make_scene(generator, lens="radial", noise=0.5, samples=6, points=8, views=4)
    problem, curves = disturbed(scene, generator)
    probe = torch.randn(curves.X.shape, generator=generator, dtype=F64)

    def found(values: Tensor) -> Tensor:
        some = dataclasses.replace(curves, **{name: values})
        held = torch.arange(4) != 2
        result = bundle_adjust(problem, free=(), fixed_poses=held, structure=[some], tolerance=1e-16, max_iterations=100)
        return (adjusted(result, BundleCurves).X * probe).sum() + result.poses.t[2].sum()

    values = getattr(curves, name)
    leaf = values.clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(leaf), leaf)
    step = torch.randn(values.shape, generator=generator, dtype=F64)
    size = {"x": 1e-4, "normal": 1e-3, "curvature": 3e-5}[name]
    numeric = (found(values + size * step) - found(values - size * step)) / (2 * size)
    torch.testing.assert_close((slope * step).sum(), numeric.detach(), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("rigged", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_the_written_derivatives_are_those_of_the_residuals(generator: torch.Generator, lens: str, rigged: bool) -> None:
    """By every variable, with skew and numbers held in some cameras."""
    scene = make_scene(generator, lens=lens, noise=1.0, apart=3.0)
    problem, curves = disturbed(scene, generator)
    blocks, terms = with_all_free(problem, curves, rigged, generator)
    blocks, terms, _ = prepare(blocks, terms[1:2])
    assert_written_derivatives(blocks, terms[0], 1, curves.x)


@pytest.mark.usefixtures("unchecked")
def test_wrong_curves(generator: torch.Generator) -> None:
    scene = make_scene(generator)
    curves = scene.curves
    with pytest.raises(ValueError, match=r"weights: wanted"):
        dataclasses.replace(curves, weights=torch.ones(3, dtype=F64))
    with pytest.raises(ValueError, match=r"curvature: wanted"):
        dataclasses.replace(curves, curvature=torch.ones(3, dtype=F64))
    with pytest.raises(ValueError, match=r"sample: wanted numbers from 0 to 23"):
        dataclasses.replace(curves, sample=curves.sample + 1)
    with pytest.raises(ValueError, match=r"structure.view: wanted numbers from 0 to 4"):
        bundle_adjust(scene.problem, structure=[dataclasses.replace(curves, view=curves.view + 1)])


@pytest.mark.parametrize("solver", ["dense", "sparse", "pcg"])
@pytest.mark.parametrize("turns", [False, True])
def test_noise_does_not_carry_the_world_away(generator: torch.Generator, turns: bool, solver: str) -> None:
    """Samples cannot follow the world, so that their residuals say a little of where it is, by noise alone."""
    scene = make_scene(generator, noise=0.5)
    problem, curves = disturbed(scene, generator)
    pairs = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4]])
    motions = scene.problem.poses[pairs[:, 1]] @ scene.problem.poses[pairs[:, 0]].inverse()
    # How cameras turn says nothing of where they are.
    known = RelativePosePrior(pairs, motions, torch.tensor([0.01] * 3 + [torch.inf] * 3, dtype=F64))
    priors = (known,) if turns else ()
    result = bundle_adjust(problem, free=(), structure=[curves], priors=priors, linear_solver=solver, max_iterations=12)
    assert result.status == Status.OK
    before, after = problem.poses, result.poses
    assert (after.centre.mean(0) - before.centre.mean(0)).norm() < 0.02
    assert (after.centre.std(0).norm() / before.centre.std(0).norm() - 1).abs() < 0.02
    assert rotvec_from_rotation(after.R.mT @ before.R).mean(0).norm() < 0.01


def test_derivatives_in_a_free_world(generator: torch.Generator) -> None:
    scene = make_scene(generator, noise=0.5, samples=8, points=12, views=4)
    problem, curves = disturbed(scene, generator)

    def found(x: Tensor) -> Tensor:
        some = dataclasses.replace(curves, x=x)
        result = bundle_adjust(problem, free=(), structure=[some], tolerance=1e-16, max_iterations=100)
        assert result.status == Status.OK
        away = (result.poses.centre[1:] - result.poses.centre[0]).norm(dim=-1)
        return away[0] / away[1]

    leaf = curves.x.clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(leaf), leaf)
    step = torch.randn(curves.x.shape, generator=generator, dtype=F64)
    numeric = (found(curves.x + 1e-3 * step) - found(curves.x - 1e-3 * step)) / 2e-3
    torch.testing.assert_close((slope * step).sum(), numeric.detach(), rtol=1e-2, atol=1e-6)


def test_samples_that_are_held_say_where_the_world_is(generator: torch.Generator) -> None:
    scene = make_scene(generator)
    held = dataclasses.replace(scene.curves, fixed=torch.ones(len(scene.curves.X), dtype=torch.bool))
    turn = rotation_from_rotvec(torch.tensor([0.02, -0.01, 0.01], dtype=F64))
    away = Similarity(torch.tensor(1.01, dtype=F64), turn, torch.tensor([0.01, 0.02, -0.01], dtype=F64))
    elsewhere = dataclasses.replace(
        scene.problem, poses=away.transform_pose(scene.problem.poses), X=away.transform(scene.problem.X)
    )
    result = bundle_adjust(elsewhere, free=(), structure=[held], tolerance=1e-14)
    assert result.status == Status.OK
    torch.testing.assert_close(result.poses.centre, scene.problem.poses.centre, rtol=0, atol=1e-3)
    with pytest.raises(ValueError, match="gauge"):
        bundle_adjust(elsewhere, free=(), structure=[held], gauge="first")


@pytest.mark.parametrize("noise", [0.1, 0.5, 2.0])
def test_covariances_in_a_free_world(generator: torch.Generator, noise: float) -> None:
    """By adjusted samples they are those by exact ones: noise says nothing of the gauge."""
    scene = make_scene(generator, noise=noise)
    problem, curves = disturbed(scene, generator)
    result = bundle_adjust(problem, free=(), structure=[curves])
    there = dataclasses.replace(problem, poses=result.poses, X=result.X)
    found = bundle_covariance(there, free=(), structure=result.structure, sigma=1.0)
    exact = bundle_covariance(scene.problem, free=(), structure=[scene.curves], sigma=1.0)
    assert found.nullity == exact.nullity == 7
    for name in ("poses", "X"):
        a, b = (getattr(some, name).diagonal(dim1=1, dim2=2).sqrt() for some in (found, exact))
        torch.testing.assert_close(a, b, rtol=0.3, atol=0)
