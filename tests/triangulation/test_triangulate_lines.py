import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import (
    Line3D,
    pluecker_from_points,
    point_line_distance,
    project_lines,
    project_points,
    random_rotation,
    rotvec_from_rotation,
    to_homogeneous,
    transform_lines,
)
from torchsfm.optim import Cauchy, rotation_exponential
from torchsfm.triangulation import LineFault, triangulate_lines
from torchsfm.triangulation.line_problem import LineProblem

F64 = torch.float64


def segments(make_scene, image_of, *batch: int, v: int, n: int, **options) -> tuple[Tensor, Tensor, Tensor]:
    """Segments (*b, v, n, 2, 2), cameras, and their ends in space (*b, n, 2, 3)."""
    x, P, X = make_scene(*batch, v=v, n=2 * n, **options)
    return x.unflatten(-2, (n, 2)), P, X.unflatten(-2, (n, 2))


def pluecker(X: Tensor) -> Tensor:
    L = pluecker_from_points(X[..., 0, :], X[..., 1, :])
    return L / L[..., :3].norm(dim=-1, keepdim=True)


def steps(L: Tensor, M: Tensor) -> Tensor:
    """The step of `Line3D` from each L to M, by the rotation between their frames."""

    def frame(L: Tensor) -> tuple[Tensor, Tensor]:
        u1, u2 = (torch.nn.functional.normalize(v, dim=-1) for v in (L[..., 3:], L[..., :3]))
        angle = torch.atan2(L[..., :3].norm(dim=-1), L[..., 3:].norm(dim=-1))
        return torch.stack((u1, u2, torch.linalg.cross(u1, u2)), -1), angle

    (U, a), (V, b) = frame(L), frame(M)
    found = torch.cat((rotvec_from_rotation(U.mT @ V), (b - a)[..., None]), -1)
    moved = Line3D().retract(L, found)
    torch.testing.assert_close(moved / moved[..., :3].norm(dim=-1, keepdim=True), M, rtol=1e-7, atol=1e-7)
    return found


@pytest.mark.parametrize("v", [2, 3, 8])
@pytest.mark.parametrize(("depth", "origin"), [(10.0, 0.0), (100.0, 0.0), (10.0, 1e4)])
def test_exact_lines_are_found(make_scene, image_of, v, depth, origin):
    l, P, X = segments(make_scene, image_of, 100, v=v, n=5, depth=depth, origin=origin)  # noqa: E741
    found = triangulate_lines(l, P)
    wanted = pluecker(X)
    error = (found.model - wanted).norm(dim=-1) / wanted.norm(dim=-1)
    good = found.status == Status.OK
    assert_share(error[good] < 1e-6, 0.999)
    # Two views that are near each other, for their distance, leave many lines in one plane with both but for a pixel.
    assert_share(good, (0.6 if depth > 10 else 0.9) if v == 2 else 0.95)
    assert ((found.model[..., :3] * found.model[..., 3:]).sum(-1).abs() < 1e-12 * wanted.norm(dim=-1)).all()
    assert (found.error[good] < 1e-7).all()
    ends = (found.ends - X).norm(dim=-1).amax(-1) / X.norm(dim=-1).amax(-1)
    assert_share(ends[good] < 1e-5, 0.999)


@pytest.mark.parametrize("depth", [10.0, 30.0, 100.0])
def test_the_angle_is_that_of_the_planes_of_sight(make_scene, image_of, depth):
    l, P, _ = segments(make_scene, image_of, v=4, n=50, depth=depth)  # noqa: E741
    h = to_homogeneous(l)
    image = torch.linalg.cross(h[..., 0, :], h[..., 1, :])
    normal = torch.nn.functional.normalize((image @ P)[..., :3], dim=-1)

    def between(i: int, j: int) -> Tensor:
        sine = torch.linalg.cross(normal[i], normal[j]).norm(dim=-1)
        return torch.atan2(sine, (normal[i] * normal[j]).sum(-1).abs())

    two, four = triangulate_lines(l[:2], P[:2]), triangulate_lines(l, P)
    good = two.status == Status.OK
    assert good.any()
    torch.testing.assert_close(two.angle[good], between(0, 1)[good], rtol=1e-5, atol=1e-7)
    good = four.status == Status.OK
    largest = torch.stack([between(i, j) for i in range(4) for j in range(i)]).amax(0)
    assert (four.angle <= largest + 1e-6)[good].all()
    assert (four.angle >= largest / 4)[good].all()


def test_bare_lines_are_found(make_scene, image_of):
    _, P, X = segments(make_scene, image_of, v=4, n=300)
    wanted = pluecker(X)
    line = project_lines(P, wanted) * torch.linspace(-3, 2, 300, dtype=F64)[:, None]
    found = triangulate_lines(line, P)
    assert_share(((found.model - wanted).norm(dim=-1) < 1e-6) | ((found.model + wanted).norm(dim=-1) < 1e-6), 0.999)
    assert_share(found.status == Status.OK, 0.98)


@pytest.mark.parametrize("v", [3, 8])
@pytest.mark.parametrize("iterations", [0, 30])
def test_errors_are_at_the_cramer_rao_bound(make_scene, image_of, generator, v, iterations):
    """From J'J of the truth; the start, which takes no iteration, nearly reaches it too."""
    l, P, X = segments(make_scene, image_of, v=v, n=40, depth=6.0)  # noqa: E741
    long = (l[..., 0, :] - l[..., 1, :]).norm(dim=-1).amin(0) > 60
    l, X = l[:, long], X[long]  # noqa: E741
    sigma, trials = 0.5, 150
    weights = torch.full(l.shape[:2], sigma**-2, dtype=F64)
    noisy = l + sigma * torch.randn((trials, *l.shape), generator=generator, dtype=F64)
    found = triangulate_lines(noisy, P, weights=weights, max_iterations=iterations)
    truth = triangulate_lines(l, P, weights=weights)
    e = steps(truth.model.expand_as(found.model), found.model)
    square = (e[..., None, :] @ torch.linalg.inv(truth.covariance) @ e[..., None])[..., 0, 0]
    assert len(X) > 10
    # Of each line the mean over trials; 1.05, and five standard deviations of the mean over all.
    chance = 5 * (2 / 4 / trials / len(X)) ** 0.5
    assert float((square.mean(0) / 4).median()) < (1.05 if iterations else 1.1) + chance


def test_normalised_errors_are_chi_square(make_scene, image_of, generator):
    l, P, X = segments(make_scene, image_of, v=5, n=60, depth=6.0)  # noqa: E741
    long = (l[..., 0, :] - l[..., 1, :]).norm(dim=-1).amin(0) > 60
    l, X = l[:, long], X[long]  # noqa: E741
    sigma = 0.2
    noisy = l + sigma * torch.randn((120, *l.shape), generator=generator, dtype=F64)
    found = triangulate_lines(noisy, P, weights=torch.full(l.shape[:2], sigma**-2, dtype=F64))
    assert (found.status == Status.OK).all()
    e = steps(found.model, pluecker(X).expand_as(found.model))
    square = (e * torch.linalg.solve(found.covariance, e)).sum(-1)
    assert abs(float(square.mean()) - 4) < 0.1 + 5 * (8 / square.numel()) ** 0.5
    # The noise of two residuals a view, four of them taken by the line.
    assert abs(float((found.error.square() * 10).mean()) / 6 - 1) < 0.05
    # Where the line is at its ends: across it, two directions.
    d, away = found.model[..., None, :3], X - found.ends
    away = away - (away * d).sum(-1, keepdim=True) * d
    inverse = torch.linalg.pinv(found.end_covariance, hermitian=True, rtol=1e-8)
    at_end = (away[..., None, :] @ inverse @ away[..., None])[..., 0, 0]
    assert abs(float(at_end.mean()) - 2) < 0.1 + 5 * (4 / at_end.numel()) ** 0.5


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(make_scene, image_of, generator, shape, dtype):
    l, P, _ = segments(make_scene, image_of, *shape, v=4, n=2, noise=0.3)  # noqa: E741
    visible = torch.rand(*shape, 4, 2, generator=generator) < 0.8
    l, P = l.to(dtype), P.to(dtype)  # noqa: E741
    found = triangulate_lines(l, P, visible=visible)
    assert found.model.shape == (*shape, 2, 6)
    assert found.ends.shape == (*shape, 2, 2, 3)
    assert found.covariance.shape == (*shape, 2, 4, 4)
    assert found.end_covariance.shape == (*shape, 2, 2, 3, 3)
    assert found.model.dtype == found.error.dtype == dtype
    for index in torch.cartesian_prod(*(torch.arange(s) for s in (*shape, 2))).reshape(-1, len(shape) + 1).tolist():
        *b, i = index
        seen = visible[*b, :, i]
        alone = triangulate_lines(l[*b, :, [i]][seen], P[tuple(b)][seen]) if bool(seen.sum() > 1) else None
        if alone is None:
            assert int(found.status[tuple(index)]) == Status.TOO_FEW
            assert int(found.fault[tuple(index)]) == LineFault.TOO_FEW
            continue
        tolerance = {"rtol": 1e-5, "atol": 1e-5} if dtype == torch.float64 else {"rtol": 2e-3, "atol": 2e-3}
        torch.testing.assert_close(found.model[tuple(index)], alone.model[0], **tolerance)
        assert int(found.status[tuple(index)]) == int(alone.status[0])


def test_what_leaves_no_line_is_told(make_scene, image_of, generator):
    _, P, X = segments(make_scene, image_of, v=4, n=6)
    centre = -torch.linalg.solve(P[..., :3], P[..., 3])

    def fault(P: Tensor, X: Tensor, noise: float = 0.0) -> tuple[int, int]:
        x = image_of(P, X)[:, None]
        x = x + noise * torch.randn(x.shape, generator=generator, dtype=F64)
        found = triangulate_lines(x, P)
        assert bool(found.model.isfinite().all() and found.ends.isfinite().all() and found.covariance.isfinite().all())
        return int(found.status[0]), int(found.fault[0])

    def camera(centre: Tensor) -> Tensor:
        return torch.cat((P[0, :, :3], -P[0, :, :3] @ centre[:, None]), -1)

    for noise in (0.0, 0.3):
        a, b = centre[0], centre[1]
        two = torch.stack((camera(a), camera(b)))
        # In a plane with both centres.
        target = X[0, 0]
        inside = torch.stack((target, target + 0.7 * (b - a) + 0.2 * (target - a)))
        assert fault(two, inside, noise) == (Status.DEGENERATE, LineFault.EPIPOLAR_PLANE)
        assert fault(two[[0, 1, 1]], inside, noise) == (Status.DEGENERATE, LineFault.EPIPOLAR_PLANE)
        row = torch.stack([camera(a + t * (b - a)) for t in (0.0, 1.0, 2.3)])
        assert fault(row, inside, noise) == (Status.DEGENERATE, LineFault.COLLINEAR_CENTRES)
        c = target + 1.3 * (b - a) - 2.1 * (target - a)
        flat = torch.stack((two[0], two[1], camera(c)))
        assert fault(flat, inside, noise) == (Status.DEGENERATE, LineFault.PLANE_OF_CENTRES)
        assert fault(two[[0, 0, 0]], X[0], noise) == (Status.DEGENERATE, LineFault.ONE_CENTRE)
    assert fault(two[:1], X[0]) == (Status.TOO_FEW, LineFault.TOO_FEW)
    assert fault(P, X[0]) == (Status.OK, LineFault.NONE)
    behind = triangulate_lines(image_of(P, X[:1].flatten(0, 1) - torch.tensor([0.0, 0, 60]))[:, None], P)
    assert int(behind.status[0]) == Status.BEHIND


@pytest.mark.parametrize("v", [2, 3, 8])
@pytest.mark.parametrize("sigma", [1.0, 0.1])
def test_segments_of_points_are_no_lines(make_scene, generator, v, sigma):
    """What noise alone has drawn apart; and what is exact and short all the same is a line."""
    x, P, _ = make_scene(v=v, n=200)
    l = x[..., None, :] + sigma * torch.randn((*x.shape[:2], 2, 2), generator=generator, dtype=F64)  # noqa: E741
    found = triangulate_lines(l, P, weights=torch.full(l.shape[:2], sigma**-2, dtype=F64))
    assert_share(found.status == Status.DEGENERATE, 0.98)


def test_short_segments_are_lines_where_little_noise_is_in_them(make_scene, image_of, generator):
    _, P, X = segments(make_scene, image_of, v=5, n=200)
    X = X[:, :1] + torch.stack((torch.zeros_like(X[:, 0]), 0.01 * torch.nn.functional.normalize(X[:, 1] - X[:, 0], dim=-1)), 1)
    l = image_of(P, X.flatten(0, 1)).unflatten(-2, (200, 2))  # noqa: E741
    found = triangulate_lines(l, P)
    assert_share(found.status == Status.OK, 0.9)
    assert ((found.model - pluecker(X)).norm(dim=-1) < 1e-4)[found.status == Status.OK].all()
    noisy = triangulate_lines(l + torch.randn(l.shape, generator=generator, dtype=F64), P)
    assert_share(noisy.status == Status.DEGENERATE, 0.97)
    assert bool((noisy.fault[noisy.status == Status.DEGENERATE] == LineFault.SHORT).any())


def test_two_planes_meet_without_a_descent(make_scene, image_of, generator, monkeypatch):
    l, P, X = segments(make_scene, image_of, v=2, n=300)  # noqa: E741
    monkeypatch.setattr(LineProblem, "advance", None)
    found = triangulate_lines(l, P)
    good = found.status == Status.OK
    # Some lie nearly in a plane with both centres.
    assert good.sum() > 150
    assert ((found.model - pluecker(X)).norm(dim=-1) < 1e-6)[good].all()
    assert (found.error < 1e-6)[good].all()
    noisy = triangulate_lines(l.flip(-2) + 0.5 * torch.randn(l.shape, generator=generator, dtype=F64), P)
    assert (noisy.error < 1e-6)[noisy.status == Status.OK].all()


@pytest.mark.parametrize("v", [3, 8])
@pytest.mark.parametrize("level", [False, True])
def test_the_errors_say_whether_planes_of_sight_are_one(generator, v, level):
    """Lines seen within half a degree are lines where they leave no error; in the plane of the centres they never are."""
    centre = torch.randn(v, 3, generator=generator, dtype=F64) * (1.0 if level else 3e-3)
    X = torch.randn(300, 2, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0, 6])
    if level:
        centre[:, 1], X[..., 1] = 0, 0
    R = rotation_exponential(torch.tensor([0.3, 0, 0], dtype=F64))
    K = torch.tensor([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]], dtype=F64)
    P = K @ torch.cat((R.expand(v, 3, 3), -R @ centre[..., None]), -1)
    l = project_points(P[:, None], X)  # noqa: E741
    if level:
        for noise in (1e-3, 0.1, 0.3):
            moved = l + noise * torch.randn(l.shape, generator=generator, dtype=F64)
            assert_share(triangulate_lines(moved, P).status == Status.DEGENERATE, 0.995)
        return
    found = triangulate_lines(l, P)
    good = (found.status == Status.OK) | (found.status == Status.BEHIND)
    assert_share(good, 0.99)
    assert_share(((found.model - pluecker(X)).norm(dim=-1) < 1e-5)[good], 0.99)


@pytest.mark.parametrize("v", [3, 8])
def test_directions_are_no_farther_off_than_is_said(make_scene, image_of, generator, v):
    """Segments of a few pixels, where noise makes lines seem to point at a camera."""
    _, P, X = segments(make_scene, image_of, v=v, n=600)
    long = torch.logspace(-2, 0, 600, dtype=F64)[:, None]
    X = X[:, :1] + torch.stack((torch.zeros_like(X[:, 0]), long * torch.nn.functional.normalize(X[:, 1] - X[:, 0], dim=-1)), 1)
    l = image_of(P, X.flatten(0, 1)).unflatten(-2, (600, 2))  # noqa: E741
    found = triangulate_lines(l + torch.randn(l.shape, generator=generator, dtype=F64), P)

    def directions(delta: Tensor) -> Tensor:
        return torch.nn.functional.normalize(Line3D().retract(found.model[:, None], delta)[..., :3], dim=-1)

    delta = 1e-6 * torch.eye(4, dtype=F64).expand(600, 4, 4)
    J = (directions(delta) - directions(-delta)).mT / 2e-6
    d, wanted = found.model[:, :3], pluecker(X)[:, :3]
    wanted = wanted * torch.where((d * wanted).sum(-1, keepdim=True) < 0, -1, 1)
    across = torch.nn.functional.normalize(wanted - d * (d * wanted).sum(-1, keepdim=True), dim=-1)
    e = across * torch.acos((d * wanted).sum(-1, keepdim=True).clamp(max=1))
    inverse = torch.linalg.pinv(J @ found.covariance @ J.mT, hermitian=True, rtol=1e-9)
    # Of two degrees of freedom hardly one in ten billion is as much, but in angles errors are not quite normal.
    square = (e[:, None] @ inverse @ e[..., None])[:, 0, 0]
    good = found.status == Status.OK
    assert good[long[:, 0] > 0.5].double().mean() > 0.9
    assert_share((square < 50)[good], 0.97)


def test_bad_values_are_told_and_spoil_nothing(make_scene, image_of):
    l, P, _ = segments(make_scene, image_of, v=4, n=7, noise=0.2)  # noqa: E741
    good = triangulate_lines(l, P)
    bad = l.clone()
    bad[1, 1, 0, 0] = torch.nan
    bad[2, 2] = torch.inf
    bad[3, 3, 1] = bad[3, 3, 0]  # a point
    visible = torch.ones(4, 7, dtype=torch.bool)
    visible[1:, 4] = False
    bad[2, 5] = torch.nan
    visible[2, 5] = False
    found = triangulate_lines(bad, P, visible=visible)
    assert found.status[[1, 2, 4]].tolist() == [Status.NOT_FINITE, Status.NOT_FINITE, Status.TOO_FEW]
    assert found.status[[0, 3, 5, 6]].tolist() == [Status.OK] * 4
    for i in (0, 6):
        assert torch.equal(found.model[i], good.model[i])
    for name in ("model", "ends", "angle", "covariance", "end_covariance", "error"):
        assert bool(getattr(found, name).isfinite().all()), name
    without = triangulate_lines(l[[0, 1, 3]], P[[0, 1, 3]])
    torch.testing.assert_close(found.model[5], without.model[5], rtol=1e-6, atol=1e-6)


def test_the_world_may_move_and_views_change_places(make_scene, image_of, generator):
    l, P, _ = segments(make_scene, image_of, v=4, n=20, noise=0.3)  # noqa: E741
    found = triangulate_lines(l, P)
    S = torch.eye(4, dtype=F64)
    S[:3, :3] = 2.5 * torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=F64))[0]
    S[:3, 3] = torch.tensor([30.0, -20, 5])
    moved = triangulate_lines(l, P @ torch.linalg.inv(S) * torch.tensor([1.0, -2, 0.3, 5])[:, None, None])
    wanted = transform_lines(S, found.model)
    wanted = wanted / wanted[:, :3].norm(dim=-1, keepdim=True)
    torch.testing.assert_close(moved.model, wanted, rtol=1e-6, atol=1e-6)
    assert torch.equal(moved.status, found.status)
    torch.testing.assert_close(moved.ends, found.ends @ S[:3, :3].T + S[:3, 3], rtol=1e-6, atol=1e-6)
    turned = triangulate_lines(l.flip(-2)[[2, 0, 3, 1]], P[[2, 0, 3, 1]])
    torch.testing.assert_close(turned.model, -found.model, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(turned.ends, found.ends.flip(-2), rtol=1e-5, atol=1e-5)


def test_projective_maps_of_the_world_map_the_lines(make_scene, image_of, generator):
    """Distances in images do not know of the world's frame, not even of its plane at infinity."""
    l, P, _ = segments(make_scene, image_of, v=4, n=40, noise=0.3)  # noqa: E741
    found = triangulate_lines(l, P)
    H = torch.eye(4, dtype=F64)
    H[:3, :3] = (
        random_rotation(generator=generator, dtype=F64) @ (0.3 * torch.randn(3, generator=generator, dtype=F64)).exp().diag()
    )
    H[:3, 3] = torch.randn(3, generator=generator, dtype=F64)
    # Points and cameras stay on one side of the plane that goes to infinity.
    H[3, :3] = 0.01 * torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=F64), dim=0)
    moved = triangulate_lines(l, P @ torch.linalg.inv(H))
    ends = to_homogeneous(found.ends) @ H.T
    assert (ends[..., 3] > 0).all()
    wanted = pluecker(ends[..., :3] / ends[..., 3:])
    good = (found.status == Status.OK) & (moved.status == Status.OK)
    assert_share(good, 0.8)
    torch.testing.assert_close(moved.error[good], found.error[good], rtol=1e-7, atol=0)
    apart = torch.minimum((moved.model - wanted).norm(dim=-1), (moved.model + wanted).norm(dim=-1))
    assert (apart < 1e-5 * wanted.norm(dim=-1))[good].all()


def test_a_loss_takes_the_weight_of_a_wrong_view(make_scene, image_of):
    l, P, X = segments(make_scene, image_of, v=8, n=30, noise=0.1)  # noqa: E741
    l[0] += torch.tensor([9.0, -7.0])
    plain, robust = triangulate_lines(l, P), triangulate_lines(l, P, loss=Cauchy(0.3))
    wanted = pluecker(X)
    off = [(found.model - wanted).norm(dim=-1).median() for found in (plain, robust)]
    assert off[1] < 0.3 * off[0]


def test_derivatives_are_those_of_the_minimum(make_scene, image_of):
    l, P, _ = segments(make_scene, image_of, v=4, n=2, noise=0.5, depth=5.0)  # noqa: E741
    weights = torch.linspace(0.5, 2, 8, dtype=F64).reshape(4, 2)
    inputs = tuple(t.clone().requires_grad_() for t in (l, P, weights))

    def model(l: Tensor, P: Tensor, weights: Tensor) -> Tensor:  # noqa: E741
        return triangulate_lines(l, P, weights=weights).model

    assert torch.autograd.gradcheck(model, inputs, eps=1e-5, atol=1e-5, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize(
    ("name", "stored"), [("model_house", 0.565), ("corridor", 0.309), ("merton1", 0.627), ("library", 0.697)]
)
def test_oxford_lines(oxford, name, stored):
    """No farther from the measured ends than the lines published with the images."""
    scene = oxford(name)
    found = triangulate_lines(scene.segments, scene.P, visible=scene.segments_visible)

    def error(L: Tensor) -> float:
        away = point_line_distance(scene.segments, project_lines(scene.P, L)[..., None, :])
        return float(away[scene.segments_visible].square().mean().sqrt())

    assert error(found.model) < min(stored, error(pluecker(scene.L)))
    # The cameras of two of the sets see everything behind them, points too.
    assert_share((found.status == Status.OK) | (found.status == Status.BEHIND), 0.99)


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument(make_scene, image_of):
    l, P, _ = segments(make_scene, image_of, v=3, n=4)  # noqa: E741
    with pytest.raises(ValueError, match="P: wanted v = 3"):
        triangulate_lines(l, P[:2])
    with pytest.raises(ValueError, match="l: wanted shape"):
        triangulate_lines(l[..., 0, 0], P)
    with pytest.raises(ValueError, match="weights"):
        triangulate_lines(l, P, weights=torch.ones(3, 5, dtype=F64))
    with pytest.raises(ValueError, match="max_iterations"):
        triangulate_lines(l, P, max_iterations=-1)
    with pytest.raises(ValueError, match="loss"):
        triangulate_lines(l, P, loss="huber")
