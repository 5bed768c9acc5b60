"""Ellipses in space and ellipsoids from their images: exact, at the Cramer-Rao bound, and the laws of every door."""

import math

import pytest
import torch
from chance import assert_share
from scipy.stats import chi2
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import (
    Ellipsoid,
    camera_centre,
    conic_from_ellipse,
    dual_conic,
    dual_quadric_from_ellipsoid,
    ellipse_distance,
    ellipse_from_conic,
    plane_conic_from_dual_quadric,
    project_quadric,
    random_rotation,
    rotation_from_rotvec,
)
from torchsfm.images import fit_ellipse
from torchsfm.simulation import SimulatedConics, simulate_conics
from torchsfm.triangulation import ConicTriangulation, conics_2view, triangulate_conics, triangulate_quadrics

F64 = torch.float64


def off(found: ConicTriangulation, truth: Ellipsoid) -> Tensor:
    """The largest entry by which dual quadrics with -1 in their corner differ."""
    return (found.Q_dual - dual_quadric_from_ellipsoid(truth)).abs().amax((-2, -1))


def coordinates(found: Ellipsoid, truth: Ellipsoid) -> Tensor:
    """Where an ellipse is in the coordinates of the covariance, as seen from the truth."""
    e1, e2 = (truth.axes[..., i, :] / truth.axes[..., i, :].norm(dim=-1, keepdim=True) for i in (0, 1))
    e3 = torch.linalg.cross(e1, e2)
    D = found.axes.mT @ found.axes
    plane = found.plane[..., :3]
    plane = plane * (plane * e3).sum(-1, keepdim=True).sign()
    values, V = torch.linalg.eigh(D)
    root = V @ (values.clamp_min(0).sqrt()[..., None] * V.mT)
    entry = lambda a, b: (a[..., None, :] @ root @ b[..., None])[..., 0, 0]  # noqa: E731
    turns = -(plane * e2).sum(-1), (plane * e1).sum(-1)
    return torch.cat((found.centre, torch.stack((*turns, entry(e1, e1), entry(e1, e2), entry(e2, e2)), -1)), -1)


@pytest.mark.parametrize("views", [2, 3, 6])
def test_exact_images_give_their_ellipse(views, generator):
    scene = simulate_conics((100,), conics=5, views=views, generator=generator)
    found = triangulate_conics(scene.C, scene.P)
    assert_share(off(found, scene.model) < 1e-10, 0.999)
    assert_share(found.status == Status.OK, 0.999)
    plane = found.plane_conic
    Q = plane.frame @ dual_conic(plane.C) @ plane.frame.mT
    assert ((Q / Q[..., 3:, 3:] - found.Q_dual / found.Q_dual[..., 3:, 3:]).abs() < 1e-8).all()


def test_exact_outlines_give_their_ellipsoid(generator):
    scene = simulate_conics((100,), conics=5, views=4, flat=False, generator=generator)
    found = triangulate_quadrics(scene.C, scene.P)
    assert_share(off(found, scene.model) < 1e-8, 0.999)
    assert_share(found.status == Status.OK, 0.999)


def test_two_views_have_two_planes_of_which_one_parts_the_centres(generator):
    scene = simulate_conics((2000,), views=2, generator=generator)
    (C1, C2), (P1, P2) = scene.C[:, :, 0].unbind(1), scene.P.unbind(1)
    found = conics_2view(C1, C2, P1, P2)
    truth = dual_quadric_from_ellipsoid(scene.model)
    near = (found.model / found.model[..., 3:, 3:] + truth).abs().amax((-2, -1))
    assert_share(found.valid.all(-1), 0.999)
    assert_share(near.amin(-1) < 1e-9, 0.999)
    planes, _ = plane_conic_from_dual_quadric(found.model)
    c = torch.nn.functional.pad(camera_centre(scene.P), (0, 1), value=1.0)
    same = (planes.plane[:, :, None] * c[:, None]).sum(-1).prod(-1) > 0
    assert_share(same.sum(-1) == 1, 0.999)
    assert_share(same.gather(1, near.argmin(-1, keepdim=True)), 0.999)
    # Each is the dual quadric of a conic with these images.
    for P, C in ((P1, C1), (P2, C2)):
        image = dual_conic(project_quadric(P[:, None], found.model))
        image, C = image / image[..., 2:, 2:], C[:, None] / C[:, None, 2:, 2:]
        assert_share((image - C).abs().amax((-2, -1)) < 1e-7 * C.abs().amax((-2, -1)), 0.999)


def test_a_plane_without_two_views_is_none(generator):
    scene = simulate_conics((3,), views=2, generator=generator)
    (C1, C2), (P1, P2) = scene.C[:, :, 0].unbind(1), scene.P.unbind(1)
    wanted = conics_2view(C1, C2, P1, P2)
    bad1, bad2, badP = C1.clone(), C2.clone(), P2.clone()
    bad1[0], badP[1] = math.nan, P1[1]
    found = conics_2view(bad1, bad2, P1, badP)
    assert not found.valid[:2].any()
    assert found.model.isfinite().all()
    assert torch.equal(found.model[2], wanted.model[2])
    assert torch.equal(found.valid[2], wanted.valid[2])


@pytest.mark.parametrize("views", [2, 3])
def test_noise_is_spread_no_farther_than_it_must(views, generator):
    """Edge points with 0.5 pixels: chi-square of the true covariance, and the right plane."""
    trials, sigma = 600, 0.5
    scene = simulate_conics((trials,), views=views, noise=sigma, generator=generator)
    fits = fit_ellipse(scene.x)
    weights = torch.full(scene.x.shape[:-1], sigma**-2, dtype=F64)
    exact, _ = ellipse_from_conic(scene.C)
    ideal = exact.points(torch.arange(60, dtype=F64) * (2 * math.pi / 60))
    truth = triangulate_conics(scene.C, scene.P, x=ideal, weights=weights)
    bound = truth.covariance[:, 0]
    C = conic_from_ellipse(fits.model)
    for options in ({"x": scene.x, "weights": weights}, {"covariance": sigma**2 * fits.covariance}):
        found = triangulate_conics(C, scene.P, **options)
        assert_share(found.status == Status.OK, 0.99)
        assert_share((found.model.plane[..., :3] * scene.model.plane[..., :3]).sum(-1).abs() > 0.95, 0.99)
        good = (found.status == Status.OK)[:, 0]
        here = coordinates(found.model, truth.model) - coordinates(truth.model, truth.model)
        square = (here * torch.linalg.solve(bound[:, None], here[..., None])[..., 0]).sum(-1)[good, 0]
        few = 1 + 4 * (2 / (8 * trials)) ** 0.5
        assert square.median() < chi2(8).median() * 1.05**2 * few
        assert square.mean() < 8 * 1.05**2 * (1 + 8 / trials**0.5)


def test_residuals_are_as_large_as_the_noise(generator):
    scene = simulate_conics((100,), views=3, noise=0.3, generator=generator)
    found = triangulate_conics(scene.C, scene.P, x=scene.x)
    # Of 180 distances eight are taken up.
    square = (found.error**2 / 0.09 * 180).sum()
    assert 1e-6 < chi2(172 * 100).cdf(float(square)) < 1 - 1e-6
    image, _ = ellipse_from_conic(dual_conic(project_quadric(scene.P[:, :, None], found.Q_dual[:, None])))
    distance = ellipse_distance(image, scene.x)
    torch.testing.assert_close(distance.square().mean((1, 3)).sqrt(), found.error, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_batches_are_loops(batch, generator):
    scene = simulate_conics(batch, conics=2, views=3, noise=0.3, points=12, generator=generator)
    found = triangulate_conics(scene.C, scene.P, x=scene.x)
    assert found.status.shape == (*batch, 2)
    assert found.covariance.shape == (*batch, 2, 8, 8)
    flat = [t.reshape(-1, *t.shape[len(batch) :]) for t in (scene.C, scene.P, scene.x, found.Q_dual)]
    for C, P, x, Q in zip(*flat, strict=True):
        torch.testing.assert_close(triangulate_conics(C, P, x=x).Q_dual, Q, rtol=1e-6, atol=1e-7)


def test_views_left_out_do_not_count(generator):
    scene = simulate_conics((4,), conics=2, views=5, noise=0.3, points=12, generator=generator)
    visible = torch.ones(4, 5, 2, dtype=torch.bool)
    visible[:, 3], visible[1:, 4, 0] = False, False
    spoiled = torch.where(visible[..., None, None], scene.C, math.nan)
    x = torch.where(visible[..., None, None], scene.x, math.inf)
    found = triangulate_conics(spoiled, scene.P, visible=visible, x=x)
    assert (found.status == Status.OK).all()
    three = triangulate_conics(scene.C[:, :3], scene.P[:, :3], x=scene.x[:, :3])
    torch.testing.assert_close(found.Q_dual[1:, 0], three.Q_dual[1:, 0], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(found.covariance[1:, 0], three.covariance[1:, 0], rtol=1e-4, atol=1e-9)


def test_what_the_data_do_not_say_is_told(generator):
    scene = simulate_conics((8,), views=3, generator=generator)
    C, P = scene.C.clone(), scene.P.clone()
    C[0, 1] = math.nan
    P[1, 2, 0] = math.inf
    P[2] = P[2, :1]
    C[3, 0, 0] = torch.diag(torch.tensor([1.0, -1, -1], dtype=F64))
    visible = torch.ones(8, 3, 1, dtype=torch.bool)
    visible[4, 1:] = False
    # Seen from behind: the world turned about the camera centre, and the camera too, is the same picture.
    P[5] = torch.cat((P[5, :, :, :3], -P[5, :, :, 3:] + 0 * P[5, :, :, :1]), -1)
    found = triangulate_conics(C, P, visible=visible)
    wanted = [Status.NOT_FINITE, Status.NOT_FINITE, Status.DEGENERATE, Status.DEGENERATE, Status.TOO_FEW, Status.BEHIND]
    assert found.status[:6, 0].tolist() == wanted
    assert all(t.isfinite().all() for t in (found.model.centre, found.model.axes, found.covariance, found.error))
    alone = triangulate_conics(scene.C, scene.P)
    torch.testing.assert_close(found.Q_dual[6:], alone.Q_dual[6:], rtol=0, atol=0)
    assert (triangulate_quadrics(scene.C[:, :2], scene.P[:, :2]).status == Status.TOO_FEW).all()


def test_a_plane_seen_from_nearly_one_place_is_told(generator):
    scene = simulate_conics((150,), views=2, generator=generator)
    P = scene.P.clone()
    P[:, 1] = P[:, 0]
    P[:, 1, :, 3] += torch.tensor([800 * 0.15, 0, 0], dtype=F64)  # a fortieth of the distance
    C = dual_conic(project_quadric(P[:, :, None], dual_quadric_from_ellipsoid(scene.model)[:, None]))
    t = torch.arange(40, dtype=F64) * (2 * math.pi / 40)
    x = ellipse_from_conic(C)[0].points(t)
    x = x + 0.5 * torch.randn(x.shape, generator=generator, dtype=F64)
    found = triangulate_conics(C, P, x=x)
    wrong = (found.model.plane[..., :3] * scene.model.plane[..., :3]).sum(-1).abs() < 0.95
    assert wrong.double().mean() > 0.1
    assert_share(~(wrong & (found.status == Status.OK)), 0.95)


def arcs(scene: SimulatedConics, degrees: float, sigma: float, generator: torch.Generator) -> Tensor:
    """Edge points (*batch, v, n, 30, 2) of arcs that begin anywhere."""
    ellipse, _ = ellipse_from_conic(scene.C)
    begin = torch.rand(*ellipse.angle.shape, 1, generator=generator, dtype=F64) * (2 * math.pi)
    t = begin + torch.linspace(0, math.radians(degrees), 30, dtype=F64)
    cos, sin = ellipse.angle.cos()[..., None], ellipse.angle.sin()[..., None]
    u, v = ellipse.semi_axes[..., :1] * t.cos(), ellipse.semi_axes[..., 1:] * t.sin()
    x = ellipse.centre[..., None, :] + torch.stack((u * cos - v * sin, u * sin + v * cos), -1)
    return x + sigma * torch.randn(x.shape, generator=generator, dtype=F64)


@pytest.mark.parametrize("views", [2, 3, 5])
@pytest.mark.parametrize("degrees", [46.0, 140.0])
def test_arcs_of_noisy_points_give_no_wrong_ellipse(views, degrees, generator):
    """Of short arcs next to nothing is known, and fits end anywhere; of longer ones hardly an answer is refused."""
    sigma = 0.5
    scene = simulate_conics((200,), views=views, generator=generator)
    x = arcs(scene, degrees, sigma, generator)
    fits = fit_ellipse(x)
    points = {"x": x, "weights": torch.full(x.shape[:-1], sigma**-2, dtype=F64)}
    for given in (points, {"covariance": sigma**2 * fits.covariance}):
        found = triangulate_conics(conic_from_ellipse(fits.model), scene.P, **given)
        good = (found.status == Status.OK)[:, 0]
        e = coordinates(scene.model, found.model) - coordinates(found.model, found.model)
        spread = found.covariance + 1e-30 * torch.eye(8, dtype=F64)
        square = (e * torch.linalg.solve(spread, e[..., None])[..., 0]).sum(-1)
        wrong = good & (square[:, 0] > 100)
        if degrees > 90:
            assert_share(good, 0.8)
        # Eight degrees of freedom: 100 is far out, but what covariances of ellipses say is true only near them.
        assert_share(~wrong, 0.97)


def test_images_of_different_ellipses_are_no_ellipse(generator):
    scene = simulate_conics((100,), conics=3, views=3, noise=0.5, generator=generator)
    wrong = torch.arange(3)[:, None] + torch.arange(3)
    x = torch.stack([scene.x[:, v, wrong[v] % 3] for v in range(3)], 1)
    fits = fit_ellipse(x)
    C = conic_from_ellipse(fits.model)
    assert_share(triangulate_conics(C, scene.P, x=x).status != Status.OK, 0.999)
    assert_share(triangulate_conics(C, scene.P, covariance=fits.covariance).status != Status.OK, 0.95)


def test_the_world_may_move_and_cameras_have_any_scale(generator):
    scene = simulate_conics((20,), views=3, noise=0.3, points=20, generator=generator)
    found = triangulate_conics(scene.C, scene.P, x=scene.x)
    R = rotation_from_rotvec(torch.tensor([0.3, -1.0, 0.5], dtype=F64))
    S = torch.eye(4, dtype=F64)
    S[:3, :3], S[:3, 3] = 3 * R, torch.tensor([10.0, -20, 5], dtype=F64)
    factor = torch.tensor([-2.0, 30.0, 0.01], dtype=F64)[:, None, None]
    moved = triangulate_conics(-7 * scene.C, factor * (scene.P @ torch.linalg.inv(S)), x=scene.x)
    Q = S @ found.Q_dual @ S.mT
    torch.testing.assert_close(moved.Q_dual, Q, rtol=1e-6, atol=1e-4)
    assert torch.equal(moved.status, found.status)
    torch.testing.assert_close(moved.error, found.error, rtol=1e-6, atol=1e-9)
    order = torch.tensor([2, 0, 1])
    again = triangulate_conics(scene.C[:, order], scene.P[:, order], x=scene.x[:, order])
    torch.testing.assert_close(again.Q_dual, found.Q_dual, rtol=1e-6, atol=1e-7)


def test_projective_maps_of_the_world_map_the_conics(generator):
    """Distances in images do not know of the world's frame, not even of its plane at infinity."""
    scene = simulate_conics((20,), views=3, noise=0.3, points=20, generator=generator)
    found = triangulate_conics(scene.C, scene.P, x=scene.x)
    H = torch.eye(4, dtype=F64)
    H[:3, :3] = (
        random_rotation(generator=generator, dtype=F64) @ (0.3 * torch.randn(3, generator=generator, dtype=F64)).exp().diag()
    )
    H[:3, 3] = torch.randn(3, generator=generator, dtype=F64)
    # Ellipses and cameras stay on one side of the plane that goes to infinity.
    H[3, :3] = 0.02 * torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=F64), dim=0)
    moved = triangulate_conics(scene.C, scene.P @ torch.linalg.inv(H), x=scene.x)
    good = (found.status == Status.OK) & (moved.status == Status.OK)
    assert_share(good, 0.9)
    Q = H @ found.Q_dual @ H.T
    a, b = (q / torch.linalg.matrix_norm(q, keepdim=True) * -q[..., 3:, 3:].sign() for q in (moved.Q_dual, Q))
    assert (torch.linalg.matrix_norm(a - b) < 1e-6)[good].all()
    torch.testing.assert_close(moved.error[good], found.error[good], rtol=1e-6, atol=0)


@pytest.mark.parametrize("given", ["x", "C"])
def test_derivatives_are_those_of_the_optimum(given, generator):
    scene: SimulatedConics = simulate_conics((2,), views=3, noise=0.5, points=10, generator=generator)
    weigh = torch.randn(4, 4, generator=generator, dtype=F64)
    fits = conic_from_ellipse(fit_ellipse(scene.x).model)
    first = scene.x if given == "x" else fits / fits.norm(dim=(-2, -1), keepdim=True)

    def value(data: Tensor, P: Tensor) -> Tensor:
        found = triangulate_conics(scene.C, P, x=data) if given == "x" else triangulate_conics(0.5 * (data + data.mT), P)
        assert (found.status == Status.OK).all()
        return (found.Q_dual * weigh).sum((-3, -2, -1))

    inputs = [t.clone().requires_grad_() for t in (first, scene.P)]
    slopes = torch.autograd.grad(value(*inputs).sum(), inputs)
    step = 1e-5
    for i, slope in enumerate(slopes):
        direction = torch.randn(inputs[i].shape, generator=generator, dtype=F64) * inputs[i].detach().abs()
        ends = [[t.detach() + (k * step * direction if j == i else 0) for j, t in enumerate(inputs)] for k in (1, -1)]
        with torch.no_grad():
            difference = (value(*ends[0]) - value(*ends[1])).sum() / (2 * step)
        torch.testing.assert_close((slope * direction).sum(), difference, rtol=2e-3, atol=1e-3)


def test_edge_points_or_covariances_but_not_both(generator):
    scene = simulate_conics((), generator=generator)
    with pytest.raises(ValueError, match="covariance"):
        triangulate_conics(scene.C, scene.P, x=scene.x, covariance=torch.eye(5, dtype=F64).expand(3, 1, 5, 5))
    with pytest.raises(ValueError, match="weights"):
        triangulate_conics(scene.C, scene.P, weights=torch.ones(3, 1, 60, dtype=F64))
