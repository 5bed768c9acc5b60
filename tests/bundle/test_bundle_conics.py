"""Ellipses of space in a bundle, together with points and alone."""

import dataclasses
import math

import pytest
import torch
from chance import assert_unit_variance
from structure_scenes import (
    adjusted,
    first_two,
    moved,
    views_on_an_arc,
    whitened,
    with_a_rig_of_one,
    with_points,
    with_the_first_camera_where_it_was,
    without_points,
)
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import BundleConics, bundle_adjust, bundle_covariance
from torchsfm.bundle.blocks import Bundle
from torchsfm.geometry import (
    BundleProblem,
    Ellipse,
    Ellipsoid,
    conic_from_ellipse,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from torchsfm.images import fit_ellipse
from torchsfm.optim import Huber
from torchsfm.optim.terms import term_residual
from torchsfm.triangulation import triangulate_conics

F64 = torch.float64
LENSES = ("none", "radial", "fisheye")
EDGE = 40
"""Edge points of an image."""


@dataclasses.dataclass(frozen=True)
class Scene:
    problem: BundleProblem
    model: Ellipsoid
    edges: Tensor
    """Exact edge points (k, e, 2)."""
    view: Tensor
    conic: Tensor

    def measured(self, edges: Tensor, sigma: float = 1.0) -> BundleConics:
        fit = fit_ellipse(edges)
        return BundleConics(self.model, fit.model, self.view, self.conic, fit.covariance * sigma**2)


def make_scene(
    generator: torch.Generator, *, lens: str = "none", views: int = 4, points: int = 20, conics: int = 6, circle: bool = False
) -> Scene:
    """Views on an arc; ellipses that face them, up to 30 degrees."""

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    poses, camera = views_on_an_arc(generator, lens, views, 0.05)
    tilt = torch.cat((rand(conics, 2) - 0.5, 6 * rand(conics, 1)), -1)
    lengths = torch.stack((0.2 + 0.3 * rand(conics), torch.zeros(conics, dtype=F64)), -1)
    lengths[:, 1] = lengths[:, 0] * (1.0 if circle else 0.4 + 0.5 * rand(conics))
    axes = torch.nn.functional.pad(lengths[..., None] * rotation_from_rotvec(tilt).mT[:, :2], (0, 0, 0, 1))
    model = Ellipsoid(1.6 * rand(conics, 3) - 0.8, axes)
    view, conic = torch.cartesian_prod(torch.arange(views), torch.arange(conics)).unbind(1)
    t = torch.arange(EDGE, dtype=F64) * (2 * math.pi / EDGE)
    on = model.centre[:, None] + torch.stack((t.cos(), t.sin(), 0 * t), -1) @ model.axes
    edges = camera.project(poses[view].transform(on[conic]))
    problem = with_points(poses, camera, 2 * rand(points, 3) - 1)
    return Scene(problem, model, edges, view, conic)


def disturbed(
    problem: BundleProblem, conics: BundleConics, generator: torch.Generator, size: float = 0.01
) -> tuple[BundleProblem, BundleConics]:
    """All but the first two poses, points and ellipses moved."""

    def randn(*shape: int) -> Tensor:
        return size * torch.randn(*shape, generator=generator, dtype=F64)

    problem = moved(problem, generator, size)
    model = conics.model
    axes = (1 + randn(len(model.centre), 1, 1)) * model.axes @ rotation_from_rotvec(3 * randn(len(model.centre), 3))
    return problem, dataclasses.replace(conics, model=Ellipsoid(model.centre + randn(*model.centre.shape), axes))


def dual(model: Ellipsoid) -> Tensor:
    return torch.cat((model.axes.mT @ model.axes, model.centre[..., None]), -1)


@pytest.mark.parametrize("circle", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_exact_data_are_recovered(generator: torch.Generator, lens: str, circle: bool) -> None:
    scene = make_scene(generator, lens=lens, circle=circle)
    problem, conics = disturbed(scene.problem, scene.measured(scene.edges), generator)
    result = bundle_adjust(problem, fixed_poses=first_two(problem), structure=[conics], tolerance=1e-14)
    assert result.status == Status.OK
    # The image of an ellipse through a lens is none, but what an ellipse fitted to it has of that is in both to first order.
    limit = 1e-7 if lens == "none" else 1e-4
    assert (dual(adjusted(result, BundleConics).model) - dual(scene.model)).abs().max() < limit
    assert result.structure_residuals[0].shape == (len(scene.view), 5)


def test_ellipses_alone_determine_poses(generator: torch.Generator) -> None:
    scene = make_scene(generator, conics=8)
    problem, conics = disturbed(scene.problem, scene.measured(scene.edges), generator)
    result = bundle_adjust(
        without_points(problem), free=(), fixed_poses=first_two(problem), structure=[conics], tolerance=1e-14
    )
    assert (result.poses.t - scene.problem.poses.t).abs().max() < 1e-6
    assert (dual(adjusted(result, BundleConics).model) - dual(scene.model)).abs().max() < 1e-6


def test_cameras_held_it_is_triangulation(generator: torch.Generator) -> None:
    """To a small part of the standard deviations: both compare the same five numbers, along other lines."""
    scene = make_scene(generator)
    noisy = scene.edges + 0.3 * torch.randn(scene.edges.shape, generator=generator, dtype=F64)
    conics = scene.measured(noisy, 0.3)
    held = {"free": (), "fixed_poses": torch.ones(len(scene.problem.poses.t), dtype=torch.bool)}
    found = bundle_adjust(without_points(scene.problem), structure=[conics], tolerance=1e-12, **held)
    C = bundle_covariance(without_points(scene.problem), sigma=1.0, structure=[conics], **held).structure[0]
    shape = (len(scene.problem.poses.t), len(scene.model.centre))
    P = scene.problem.cameras.K @ torch.cat((scene.problem.poses.R, scene.problem.poses.t[..., None]), -1)
    ellipse, covariance = conics.ellipse, conics.ellipse_covariance
    assert covariance is not None
    apart = triangulate_conics(
        conic_from_ellipse(ellipse).reshape(*shape, 3, 3), P, covariance=covariance.reshape(*shape, 5, 5)
    )
    sigma = C.diagonal(dim1=-2, dim2=-1)[:, :3].sqrt()
    assert ((adjusted(found, BundleConics).model.centre - apart.model.centre).abs() < 0.05 * sigma).all()
    torch.testing.assert_close(C[:, :3, :3], apart.covariance[:, :3, :3], rtol=0.05, atol=0.02 * float(C[:, :3, :3].max()))


@pytest.mark.parametrize("lens", ["none", "radial"])
def test_errors_are_those_of_the_covariance(generator: torch.Generator, lens: str) -> None:
    """Of poses and of centres of ellipses, in units of the covariance."""
    poses, centres = [], []
    scene = make_scene(generator, lens=lens, points=8)
    held = first_two(scene.problem)
    # Points have the same noise as edges; their weights say so.
    C = bundle_covariance(
        scene.problem, sigma=1.0, structure=[scene.measured(scene.edges, 0.2)], fixed_poses=held,
        weights=torch.full_like(scene.problem.x[:, 0], 25.0),
    )  # fmt: skip
    for _ in range(6):
        noise = [0.2 * torch.randn(x.shape, generator=generator, dtype=F64) for x in (scene.problem.x, scene.edges)]
        noisy = dataclasses.replace(scene.problem, x=scene.problem.x + noise[0])
        seen = scene.measured(scene.edges + noise[1], 0.2)
        weights = torch.full_like(noisy.x[:, 0], 25.0)
        result = bundle_adjust(noisy, structure=[seen], tolerance=1e-9, fixed_poses=held, weights=weights)
        turn = result.poses @ scene.problem.poses.inverse()
        poses.append(whitened(torch.cat((rotvec_from_rotation(turn.R), turn.t), -1)[~held], C.poses[~held]))
        centres.append(whitened(adjusted(result, BundleConics).model.centre - scene.model.centre, C.structure[0][:, :3, :3]))
    # Errors within a trial depend on each other, those of one pose or ellipse in several do not.
    for scores in (poses, centres):
        assert_unit_variance(torch.stack(scores).movedim(1, -1).flatten(0, 1), dim=0)


def test_a_rig_of_one_changes_nothing(generator: torch.Generator) -> None:
    scene = make_scene(generator)
    noisy = scene.edges + 0.3 * torch.randn(scene.edges.shape, generator=generator, dtype=F64)
    problem, conics = disturbed(scene.problem, scene.measured(noisy, 0.3), generator)
    plain, rigged = with_a_rig_of_one(problem, conics)
    torch.testing.assert_close(
        dual(adjusted(rigged, BundleConics).model), dual(adjusted(plain, BundleConics).model), rtol=0, atol=1e-6
    )


def test_what_is_held_or_unseen_keeps_every_bit(generator: torch.Generator) -> None:
    scene = make_scene(generator, conics=9)
    noisy = scene.edges + 0.3 * torch.randn(scene.edges.shape, generator=generator, dtype=F64)
    problem, conics = disturbed(scene.problem, scene.measured(noisy, 0.3), generator)
    fixed = torch.zeros(9, dtype=torch.bool)
    fixed[3] = True
    weights = (conics.conic != 5).to(F64)
    centre = conics.ellipse.centre.clone()
    centre[conics.conic == 7] = torch.nan
    axes = conics.model.axes.clone()
    axes[8] = 0
    changed = dataclasses.replace(
        conics, fixed=fixed, weights=weights, ellipse=dataclasses.replace(conics.ellipse, centre=centre),
        model=Ellipsoid(conics.model.centre, axes),
    )  # fmt: skip
    result = bundle_adjust(problem, structure=[changed])
    assert result.status == Status.OK
    after = adjusted(result, BundleConics).model
    same = ((after.centre == changed.model.centre).all(1)) & (after.axes == changed.model.axes).flatten(1).all(1)
    assert same.nonzero()[:, 0].tolist() == [3, 5, 7, 8]
    assert after.centre.isfinite().all()
    assert after.axes.isfinite().all()
    dead = (conics.conic == 5) | (conics.conic == 7) | (conics.conic == 8)
    assert torch.equal(result.structure_residuals[0].isinf().all(1), dead)
    # They are as if they were not there.
    keep = ~dead
    image = conics.ellipse
    assert conics.ellipse_covariance is not None
    others = dataclasses.replace(
        conics, fixed=fixed, ellipse=Ellipse(image.centre[keep], image.semi_axes[keep], image.angle[keep]),
        view=conics.view[keep], conic=conics.conic[keep], ellipse_covariance=conics.ellipse_covariance[keep],
    )  # fmt: skip
    again = bundle_adjust(problem, structure=[others])
    assert again.cost == pytest.approx(result.cost, rel=1e-9)
    covariance = bundle_covariance(problem, structure=[changed]).structure[0]
    assert torch.equal(covariance[3], torch.zeros(8, 8, dtype=F64))
    assert covariance[[5, 7, 8]].diagonal(dim1=1, dim2=2).isinf().all()


def test_a_loss_resists_wrong_ellipses(generator: torch.Generator) -> None:
    scene = make_scene(generator, conics=10)
    noisy = scene.edges + 0.2 * torch.randn(scene.edges.shape, generator=generator, dtype=F64)
    wrong = torch.rand(len(noisy), generator=generator) < 0.1
    wrong[-1] = True
    noisy[wrong] += 15 * torch.randn(int(wrong.sum()), 1, 2, generator=generator, dtype=F64)
    problem, conics = disturbed(scene.problem, scene.measured(noisy, 0.2), generator, 0.002)
    gaps, held = [], first_two(problem)
    for loss in (None, Huber(1.0)):
        # Twenty steps show where it goes; against wrong ellipses the last digits take long.
        robust = dataclasses.replace(conics, loss=loss)
        result = bundle_adjust(problem, fixed_poses=held, structure=[robust], max_iterations=20)
        gaps.append((adjusted(result, BundleConics).model.centre - scene.model.centre).norm(dim=-1).median())
    assert gaps[1] < 0.5 * gaps[0]


def test_the_world_comes_back_with_its_ellipses(generator: torch.Generator) -> None:
    scene = make_scene(generator)
    noisy = scene.edges + 0.3 * torch.randn(scene.edges.shape, generator=generator, dtype=F64)
    problem, conics = disturbed(scene.problem, scene.measured(noisy, 0.3), generator)
    with_the_first_camera_where_it_was(problem, conics)


def test_derivatives_by_measured_ellipses(generator: torch.Generator) -> None:
    scene = make_scene(generator, lens="radial", conics=2, views=3)
    noisy = scene.edges + 0.5 * torch.randn(scene.edges.shape, generator=generator, dtype=F64)
    conics = scene.measured(noisy, 0.5)
    problem = without_points(scene.problem)
    probe = torch.randn(2, 3, 4, generator=generator, dtype=F64)

    def found(place: Tensor) -> Tensor:
        ellipse = Ellipse(place[:, :2], place[:, 2:4], place[:, 4])
        some = dataclasses.replace(conics, ellipse=ellipse)
        held = torch.ones(3, dtype=torch.bool)
        result = bundle_adjust(problem, free=(), fixed_poses=held, structure=[some], tolerance=1e-16, max_iterations=100)
        return (dual(adjusted(result, BundleConics).model) * probe).sum()

    at = torch.cat((conics.ellipse.centre, conics.ellipse.semi_axes, conics.ellipse.angle[:, None]), -1)
    place = at.clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(place), place)
    step = torch.randn(at.shape, generator=generator, dtype=F64) * torch.tensor([1, 1, 1, 1, 0.01], dtype=F64)
    numeric = (found(at + 1e-4 * step) - found(at - 1e-4 * step)) / 2e-4
    torch.testing.assert_close((slope * step).sum(), numeric.detach(), rtol=1e-4, atol=1e-7)


def test_residuals_have_second_derivatives(generator: torch.Generator) -> None:
    """By the ellipse: twice through the search for where its image meets the normals."""
    scene = make_scene(generator, lens="radial", conics=1, views=2, points=0)
    problem, conics = disturbed(scene.problem, scene.measured(scene.edges), generator)
    blocks, terms = Bundle(problem, structure=(conics,)).problem()
    x = {name: block.x for name, block in blocks.items()}

    def residual(delta: Tensor) -> Tensor:
        moved = blocks["conic"].retract(x["conic"], delta)
        return term_residual(terms[1], x | {"conic": moved}).flatten()[3]

    delta = torch.zeros(1, 8, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(residual, delta, eps=1e-5, atol=1e-4)
    assert torch.autograd.gradgradcheck(residual, delta, eps=1e-5, atol=1e-3, rtol=1e-3)
