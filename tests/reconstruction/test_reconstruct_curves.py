"""Curves from photographs of a box with a disc on it: all of them, in place, whatever the world; and what is missing."""

from dataclasses import replace

import pytest
import torch
from painted_box import FOCAL, SIZE, camera, orbit, photograph, true_curves
from torch import Tensor
from torch.nn.functional import normalize

from torchsfm.bundle import bundle_adjust_model
from torchsfm.geometry import Camera, Similarity, project_points, random_rotation
from torchsfm.geometry.cameras import intrinsics
from torchsfm.geometry.distortion import Radial
from torchsfm.linalg.vectors import across
from torchsfm.optim import Cauchy
from torchsfm.reconstruction import Curves, Reconstruction, reconstruct_curves
from torchsfm.reconstruction.curves.edge_on import seen_edge_on
from torchsfm.reconstruction.curves.from_edges import curves_of_edges, curves_of_other_cameras
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.simulation import look_at, render_sequence
from torchsfm.simulation.surfaces import Sphere
from torchsfm.simulation.textured_scene import TexturedScene, texture_surface

VIEWS = 12
PIXEL = 6.5 / FOCAL
"""In the world, where the box is."""


@pytest.fixture(scope="module")
def images() -> list[Tensor]:
    return list(photograph(orbit(VIEWS)))


@pytest.fixture(scope="module")
def found(images: list[Tensor]) -> Curves:
    return reconstruct_curves(images, camera(VIEWS), orbit(VIEWS))


def samples(found: Curves) -> Tensor:
    return found.X


def test_every_curve_is_found_and_nothing_else(found: Curves) -> None:
    truth, x = true_curves(), samples(found)
    gap = torch.cdist(x, torch.cat(list(truth.values()))).amin(-1)
    assert gap.mean() < 0.4 * PIXEL
    assert (gap < 2 * PIXEL).float().mean() > 0.99
    for name in ("upper", "upright", "circle"):
        assert (torch.cdist(truth[name], x).amin(-1) < 4 * PIXEL).float().mean() > 0.95, name
    # The circle goes around, and each curve is there once.
    assert found.closed.sum() == 1
    assert len(found) < 20
    assert found.length().sum() < 1.05 * sum(len(v) for v in truth.values()) * 0.005


def test_samples_are_at_the_least_distances_from_all_their_edges(found: Curves) -> None:
    """Else edges are said to be worse than they are: what is fused of pieces lies between them."""
    none = torch.zeros(0, dtype=torch.long)
    model = Reconstruction(
        names=tuple(f"{i}.png" for i in range(VIEWS)), image_size=torch.full((VIEWS, 2), SIZE), cameras=camera(1),
        camera_index=torch.zeros(VIEWS, dtype=torch.long), poses=orbit(VIEWS), registered=torch.ones(VIEWS, dtype=torch.bool),
        X=none.double().reshape(0, 3), color=none.double().reshape(0, 3), x=none.double().reshape(0, 2), view=none, point=none,
        curves=found,
    )  # fmt: skip
    before, after = model.curve_residuals(), model
    for _ in range(3):
        fit = bundle_adjust_model(
            after, free=(), fixed_poses=model.registered, loss=Cauchy(float(before.median())), max_iterations=5
        )
        after = fit.model
    assert before.median() < 1.6 * after.curve_residuals().median()
    truth = torch.cat(list(true_curves().values()))
    assert torch.cdist(found.X, truth).amin(-1).mean() < 0.2 * PIXEL


def test_edges_are_found_against_changing_backgrounds() -> None:
    """Of few images: an upright edge is the outline in some, between two faces in others, light on either side."""
    poses = orbit(8)
    few = reconstruct_curves(list(photograph(poses)), camera(8), poses)
    upright = true_curves()["upright"]
    assert (torch.cdist(upright, samples(few)).amin(-1) < 4 * PIXEL).float().mean() > 0.9
    gap = torch.cdist(samples(few), torch.cat(list(true_curves().values()))).amin(-1)
    assert (gap < 2 * PIXEL).float().mean() > 0.99


def test_what_is_said_of_samples(found: Curves) -> None:
    assert (found.number.diff() <= 0).all()
    assert torch.isfinite(found.sigma).all()
    assert 0.1 * PIXEL < found.sigma.median() < 3 * PIXEL
    assert found.color.min() >= 0
    assert found.color.max() <= 1
    # Edges in most images that see a curve, on its image and square to it.
    support = found.support()
    assert (support >= 3).float().mean() > 0.99
    assert support.double().mean() > 0.4 * VIEWS
    y = project_points(orbit(VIEWS)[found.view], found.X[found.sample, None], camera(VIEWS)[found.view])[:, 0]
    across = ((y - found.x) * found.normal).sum(-1)
    assert across.abs().mean() < 0.3
    ahead = found.X + 0.1 * PIXEL * found.tangents()
    y = project_points(orbit(VIEWS)[found.view], ahead[found.sample, None], camera(VIEWS)[found.view])[:, 0] - y
    assert ((y * found.normal).sum(-1).abs() < 0.6 * y.norm(dim=-1)).all()


def test_splines_stay_near_the_samples(found: Curves) -> None:
    splines = found.splines(PIXEL)
    t = torch.linspace(0, 1, 400, dtype=torch.float64)
    for i, spline in enumerate(splines):
        x = found.X[found.curve == i]
        assert spline.closed == bool(found.closed[i])
        assert torch.cdist(x, spline.at(t)).amin(-1).max() < 3 * PIXEL
        assert len(spline.control) <= max(4, len(x))


def test_the_world_may_be_another_one(images: list[Tensor], found: Curves, generator: torch.Generator) -> None:
    t = 10 * torch.randn(3, generator=generator, dtype=torch.float64)
    moved = Similarity(torch.tensor(0.02).double(), random_rotation(generator=generator, dtype=torch.float64), t)
    other = reconstruct_curves(images, camera(VIEWS), moved.transform_pose(orbit(VIEWS)))
    mapped = moved.transform(samples(found))
    assert torch.cdist(mapped, samples(other)).amin(-1).max() < 0.02 * 3 * PIXEL
    assert abs(len(mapped) - len(samples(other))) < 0.05 * len(mapped)


def test_an_image_may_be_missing_and_lenses_may_distort(found: Curves) -> None:
    bent = Radial(torch.full((VIEWS,), -0.3).double(), torch.full((VIEWS,), 0.05).double())
    cameras = replace(camera(VIEWS), distortion=bent)
    some: list[Tensor | None] = list(photograph(orbit(VIEWS), cameras[0]))
    some[3] = None
    other = reconstruct_curves(some, cameras, orbit(VIEWS))
    assert (other.view != 3).all()
    gap = torch.cdist(samples(other), torch.cat(list(true_curves().values()))).amin(-1)
    assert gap.mean() < 0.5 * PIXEL
    assert (gap < 2 * PIXEL).float().mean() > 0.98
    assert len(samples(other)) > 0.7 * len(samples(found))


def test_nothing_to_see(images: list[Tensor]) -> None:
    blank = [torch.full_like(image, 0.5) for image in images]
    for seen in (blank, [None] * VIEWS, [images[0], *blank[1:]]):
        none = reconstruct_curves(seen, camera(VIEWS), orbit(VIEWS))
        assert len(none) == len(none.X) == len(none.x) == 0
        assert none.splines(1.0) == []


def test_wrong_arguments(unchecked: None, images: list[Tensor]) -> None:
    with pytest.raises(ValueError, match=f"images: wanted {VIEWS}"):
        reconstruct_curves([None] * (VIEWS - 1), camera(VIEWS), orbit(VIEWS))
    with pytest.raises(ValueError, match=f"images: wanted {VIEWS}"):
        reconstruct_curves([None] * (VIEWS + 1), camera(VIEWS), orbit(VIEWS))
    with pytest.raises(ValueError, match="wanted one of each"):
        reconstruct_curves(images, Camera(camera(1).K), orbit(VIEWS))
    with pytest.raises(ValueError, match="threshold"):
        reconstruct_curves(images, camera(VIEWS), orbit(VIEWS), threshold=0.0)


def test_edges_are_not_those_of_what_hides_a_curve_nor_of_the_rim(generator: torch.Generator) -> None:
    """A painted ball from all around: on its rim every curve runs along the outline, and lies a little inside of it."""
    views, size, radius, middle = 16, 200, 6.0, torch.zeros(3, dtype=torch.float64)
    ball = texture_surface(Sphere(middle, radius), "curves", texel=0.06, generator=generator)
    around = torch.arange(views, dtype=torch.float64) * (2 * torch.pi / views)
    out = torch.stack((around.cos(), around.sin(), 0.6 * (3 * around).sin()), -1)
    poses = look_at(4 * radius * normalize(out, dim=-1), middle)
    K = intrinsics(torch.tensor(325.0, dtype=torch.float64), torch.full((2,), (size - 1) / 2, dtype=torch.float64))
    scene = TexturedScene((ball,), torch.tensor([0.0, 0.0, 1.0]), ambient=1.0)
    shown = render_sequence(
        scene, poses=poses, camera=Camera(K), width=size, height=size, noise=0.01, points=1, generator=generator
    )
    edges, cameras = [ImageEdges.of(image) for image in shown.images], Camera(K.repeat(views, 1, 1))

    def silent(stage: str, done: int, total: int) -> None:
        """Says nothing."""

    def behind(found: Curves) -> Tensor:
        X = found.X[found.sample]
        return (((poses.centre[found.view] - X) * X).sum(-1) < 0).double().mean()

    by_all = curves_of_edges(edges, (size, size), cameras, poses, points=None, progress=silent)
    found = curves_of_edges(edges, (size, size), cameras, poses, points=None, finders_alone=True, progress=silent)
    assert len(found.X) > 150
    assert behind(found) < 0.15 < behind(by_all)
    later = curves_of_other_cameras(found, edges, (size, size), cameras, poses)
    assert behind(later) < 0.15
    # Those that look along the ball show no edges of what is painted on it.
    assert seen_edge_on(by_all, cameras, poses).double().mean() > 0.15
    assert seen_edge_on(later, cameras, poses).double().mean() < 0.01
    # Those that found a sample are three at least; where so many do not look along the ball, they show it.
    sight = normalize(poses.centre[:, None] - found.X, dim=-1)
    facing = ((sight * normalize(found.X, dim=-1)).sum(-1) > 0.35).sum(0)
    assert int((facing >= 4).sum()) > 50
    assert (found.support() >= 3)[facing >= 4].double().mean() > 0.9


def test_which_images_see_a_surface_edge_on(generator: torch.Generator) -> None:
    """Circles painted on a ball, which each of many cameras around it sees, also from behind; a wire is on no surface."""
    views, circles, samples, radius = 24, 120, 24, 2.0
    middle = radius * normalize(torch.randn(circles, 3, generator=generator, dtype=torch.float64), dim=-1)
    first, second = (normalize(v, dim=0).mT for v in across(normalize(middle, dim=-1).mT))
    angle = torch.arange(samples).double() * (2 * torch.pi / samples)
    around = angle.cos()[:, None] * first[:, None] + angle.sin()[:, None] * second[:, None]
    X = radius * normalize((middle[:, None] + 0.25 * around).flatten(0, 1), dim=-1)
    wire = torch.linspace(-3, 3, 200, dtype=torch.float64)[:, None] * torch.ones(3, dtype=torch.float64) + 20
    poses = look_at(5 * radius * normalize(torch.randn(views, 3, generator=generator, dtype=torch.float64), dim=-1), 0 * X[0])
    K = intrinsics(torch.tensor(600.0, dtype=torch.float64), torch.tensor([320.0, 240.0], dtype=torch.float64))
    n = len(X) + len(wire)
    view, sample = torch.cartesian_prod(torch.arange(views), torch.arange(n)).unbind(1)
    curve = torch.cat((torch.arange(circles).repeat_interleave(samples), torch.full((len(wire),), circles)))
    place, none = torch.cat((X, wire)), torch.zeros(len(view), 2, dtype=torch.float64)
    curves = Curves(
        place, curve, torch.zeros(circles + 1, dtype=torch.bool), torch.zeros_like(place), place[:, 0], none, none, none[:, 0],
        none[:, 0], view, sample,
    )  # fmt: skip
    found = seen_edge_on(curves, Camera(K.repeat(views, 1, 1)), poses).view(views, n)
    sight = normalize(poses.centre[:, None] - X, dim=-1)
    slant = (sight * normalize(X, dim=-1)).sum(-1).abs()
    on_ball = found[:, : len(X)]
    assert on_ball[slant < 0.15].double().mean() > 0.9
    assert on_ball[slant > 0.4].double().mean() < 0.02
    assert not found[:, len(X) :].any()
