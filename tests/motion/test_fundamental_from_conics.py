"""F from conics: exact scenes by family, the noise it must have, what does not determine it, and the laws of every door."""

import math
import sys

import pytest
import torch
from chance import assert_share, seeded
from scipy.stats import chi2
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Ellipse, conic_from_ellipse, dual_conic, ellipse_from_conic, project_points, project_quadric
from torchsfm.images import fit_ellipse
from torchsfm.motion import fundamental_from_conics
from torchsfm.motion.two_views.coplanar_conics import invariants, may_be_coplanar
from torchsfm.motion.two_views.fundamental_from_conics import ConicEpipolarFit
from torchsfm.simulation import SimulatedConics, simulate_conics
from torchsfm.tensors import fundamental_from_cameras

F64 = torch.float64


def truth(scene: SimulatedConics) -> Tensor:
    F = fundamental_from_cameras(scene.P[..., 0, :, :], scene.P[..., 1, :, :])
    return F / F.norm(dim=(-2, -1), keepdim=True)


def off(F: Tensor, wanted: Tensor) -> Tensor:
    return torch.minimum((F - wanted).norm(dim=(-2, -1)), (F + wanted).norm(dim=(-2, -1)))


@pytest.mark.parametrize(
    ("conics", "flat", "share"),
    [
        (6, True, 0.999),
        pytest.param(4, True, 0.99, marks=pytest.mark.slow),
        pytest.param(5, False, 0.999, marks=pytest.mark.slow),
    ],
)
def test_exact_conics_give_their_fundamental_matrix(conics, flat, share, generator):
    scene = simulate_conics((10,), conics=conics, views=2, flat=flat, generator=generator)
    found = fundamental_from_conics(scene.C[:, 0], scene.C[:, 1], starts=40, generator=generator)
    # Of cameras that are close together epipoles are known to fewer digits.
    wrong = off(found.model, truth(scene)) > 1e-6
    assert_share(~wrong, share)
    assert_share(found.status == Status.OK, share)
    assert not (wrong & (found.status == Status.OK)).any()
    assert (torch.linalg.svdvals(found.model)[:, 2] < 1e-12).all()


def test_coplanar_conics_are_told(generator):
    scenes = [simulate_conics((4,), conics=6, views=2, coplanar=True, noise=noise, generator=generator) for noise in (0.0, 0.3)]
    C = torch.cat((scenes[0].C, conic_from_ellipse(fit_ellipse(scenes[1].x).model)))
    found = fundamental_from_conics(C[:, 0], C[:, 1], starts=32, generator=generator)
    assert (found.status == Status.DEGENERATE).all()


@pytest.mark.parametrize(("conics", "noise"), [(4, 0.3), (6, 1.0)])
def test_noisy_coplanar_conics_are_told(conics, noise, generator, monkeypatch):
    scene = simulate_conics((20,), conics=conics, views=2, coplanar=True, noise=noise, generator=generator)
    C = conic_from_ellipse(fit_ellipse(scene.x).model)
    flat: list[Tensor] = []

    def remember(*data):
        flat.append(may_be_coplanar(*data))
        return flat[-1]

    monkeypatch.setattr(sys.modules[ConicEpipolarFit.__module__], "may_be_coplanar", remember)
    found = fundamental_from_conics(C[:, 0], C[:, 1], starts=8, generator=generator)
    assert_share(flat[0], 0.97)
    assert (found.status[flat[0]] != Status.OK).all()
    apart = simulate_conics((20,), conics=conics, views=2, noise=noise, generator=generator)
    C = conic_from_ellipse(fit_ellipse(apart.x).model)
    fundamental_from_conics(C[:, 0], C[:, 1], starts=8, generator=generator)
    assert_share(~flat[1], 0.97)


def test_conics_of_a_plane_have_the_same_invariants_in_all_images(generator):
    D = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)
    D = D + D.mT
    H = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    S = torch.randn(2, 6, 6, generator=generator, dtype=torch.float64)
    S = S @ S.mT
    upper = torch.triu_indices(3, 3)
    value, variance = invariants(D[:, upper[0], upper[1]], S)
    torch.testing.assert_close(invariants((H @ D @ H.mT)[:, upper[0], upper[1]], S)[0], value)
    slope = torch.autograd.functional.jacobian(lambda c: invariants(c, S)[0], D[:, upper[0], upper[1]])
    wanted = torch.einsum("ijkn,knm,ijkm->ij", slope, S, slope)
    torch.testing.assert_close(variance[~torch.eye(2, dtype=torch.bool)], wanted[~torch.eye(2, dtype=torch.bool)])


def test_points_off_the_plane_of_conics_are_enough(generator):
    scene = simulate_conics((10,), conics=4, views=2, coplanar=True, generator=generator)
    X = 2 * torch.rand(10, 1, 10, 3, generator=generator, dtype=torch.float64) - 1
    y = torch.cat((X, torch.ones_like(X[..., :1])), -1) @ scene.P.mT
    x = y[..., :2] / y[..., 2:]
    found = fundamental_from_conics(scene.C[:, 0], scene.C[:, 1], x1=x[:, 0], x2=x[:, 1], generator=generator, starts=8)
    assert (found.status == Status.OK).all()
    assert off(found.model, truth(scene)).max() < 1e-6


def test_four_conics_with_two_answers_are_told():
    # Edge points were 0.5 px off; the true matrix is dearer than another one by less than the square of a standard deviation.
    shapes = torch.tensor(
        [
            [
                [423.38, 462.82, 34.55, 21.05, 0.2276], [543.75, 394.95, 54.19, 51.58, -1.5498],
                [415.94, 395.0, 32.96, 30.06, -0.1579], [501.69, 444.79, 69.5, 59.31, 0.3133],
            ],
            [
                [392.98, 311.76, 31.98, 19.83, -0.9033], [448.64, 437.4, 61.36, 46.15, -0.2837],
                [478.8, 326.75, 33.12, 32.15, 0.5077], [404.8, 395.08, 74.32, 70.79, -1.4677],
            ],
        ],
        dtype=F64,
    )  # fmt: skip
    t = torch.arange(60, dtype=F64) * (2 * math.pi / 60)
    fits = fit_ellipse(Ellipse(shapes[..., :2], shapes[..., 2:4], shapes[..., 4]).points(t))
    C, S = conic_from_ellipse(fits.model), 0.25 * fits.covariance
    told = [fundamental_from_conics(*C, covariance1=S[0], covariance2=S[1], generator=seeded(k)).status for k in range(12)]
    # A search misses the other answer in 3 of 60 cases.
    assert_share(torch.stack(told) == Status.DEGENERATE, 0.95)


def bound(scene: SimulatedConics, covariance: Tensor) -> Tensor:
    """The Cramer-Rao bound of F as nine numbers: of all second cameras and conics in space that the images allow."""

    def ellipse(C: Tensor) -> Tensor:
        e, _ = ellipse_from_conic(C)
        return torch.cat((e.centre, e.semi_axes, e.angle[..., None]), -1)

    def images(p: Tensor) -> Tensor:
        P = torch.stack((scene.P[0], p[:12].view(3, 4)))
        centre, axes = p[12:].view(-1, 3, 3).split((1, 2), 1)
        Q = axes.mT @ axes
        h = torch.nn.functional.pad(centre[:, 0], (0, 1), value=1.0)
        dual = torch.nn.functional.pad(Q, (0, 1, 0, 1)) - h[:, :, None] * h[:, None]
        return ellipse(dual_conic(project_quadric(P[:, None], dual)))

    m = scene.model
    p = torch.cat((scene.P[1].flatten(), torch.cat((m.centre[:, None], m.axes[:, :2]), 1).flatten()))
    J = torch.autograd.functional.jacobian(images, p)
    white = torch.linalg.inv(torch.linalg.cholesky(covariance))
    J = (white @ J.reshape(*covariance.shape[:-1], -1)).reshape(-1, len(p))

    def F(q: Tensor) -> Tensor:
        G = fundamental_from_cameras(scene.P[0], q[:12].view(3, 4))
        return (G / G.norm()).flatten()

    G = torch.autograd.functional.jacobian(F, p)
    scale = J.norm(dim=0).clamp_min(1e-12)
    inner = torch.linalg.pinv(J / scale, rtol=1e-9)
    half = (G / scale) @ inner
    return half @ half.T


def test_noise_is_spread_no_farther_than_it_must(generator):
    """Six conics with edge points of 0.1 pixels: in the coordinates of the bound errors are chi-square of seven."""
    trials, sigma = 20, 0.1
    scene = simulate_conics((), conics=6, views=2, generator=generator)
    t = torch.arange(60, dtype=F64) * (2 * math.pi / 60)
    exact = ellipse_from_conic(scene.C)[0].points(t)
    least = bound(scene, sigma**2 * fit_ellipse(exact).covariance)
    fits = fit_ellipse(exact + sigma * torch.randn(trials, *exact.shape, generator=generator, dtype=F64))
    C, S = conic_from_ellipse(fits.model), sigma**2 * fits.covariance
    found = fundamental_from_conics(
        C[:, 0], C[:, 1], covariance1=S[:, 0], covariance2=S[:, 1], starts=32, generator=generator
    )  # fmt: skip
    good = found.status == Status.OK
    assert_share(good, 0.95)
    wanted = truth(scene)
    signed = found.model * (found.model * wanted).sum((-2, -1), keepdim=True).sign()
    values, V = torch.linalg.eigh(least)
    score = ((signed - wanted).flatten(-2) @ V[:, 2:] / values[2:].sqrt())[good]
    n = int(good.sum())
    assert float(score.square().sum()) < 1.1**2 * chi2(7 * n).ppf(1 - 1e-6)
    # The residuals are as large as the noise: twelve numbers, seven of them taken up.
    square = float((12 * found.error[good] ** 2).sum())
    assert 1e-6 < chi2(5 * n).cdf(square) < 1 - 1e-6


@pytest.mark.slow
def test_points_help(generator):
    """Three conics are too few; with eight points they are not."""
    scene = simulate_conics((6,), conics=4, views=2, noise=0.3, generator=generator)
    X = torch.randn(6, 12, 3, generator=generator, dtype=F64)
    x1, x2 = (project_points(P, X) + 0.3 * torch.randn(6, 12, 2, generator=generator, dtype=F64) for P in scene.P.unbind(1))
    fits = fit_ellipse(scene.x)
    C, S = conic_from_ellipse(fits.model), 0.09 * fits.covariance
    one, two = C.unbind(1)
    known = {"covariance1": S[:, 0, :3], "covariance2": S[:, 1, :3]}
    three = fundamental_from_conics(one[:, :3], two[:, :3], x1=x1, x2=x2, starts=4, generator=generator, **known)
    assert (three.status == Status.OK).all()
    assert (off(three.model, truth(scene)) < 0.1).all()


def test_bad_conics_are_told_and_change_no_others(generator):
    scene = simulate_conics((4,), conics=5, views=2, generator=generator)
    one, two = (C.clone() for C in scene.C.unbind(1))
    one[0, 1] = math.nan
    two[1, 2] = torch.diag(torch.tensor([1.0, -1, -1], dtype=F64))
    mask = torch.ones(4, 5, dtype=torch.bool)
    mask[2, 3:] = False
    options = {"starts": 16, "mask": mask}
    found = fundamental_from_conics(one, two, generator=seeded(3), **options)
    assert found.status.tolist() == [Status.NOT_FINITE, Status.DEGENERATE, Status.TOO_FEW, Status.OK]
    assert found.model.isfinite().all()
    alone = fundamental_from_conics(*scene.C.unbind(1), generator=seeded(3), **options)
    torch.testing.assert_close(found.model[3], alone.model[3], rtol=0, atol=0)


def test_projective_maps_of_the_images_map_the_matrix(generator):
    scene = simulate_conics((4,), conics=6, views=2, generator=generator)
    middle = ellipse_from_conic(scene.C)[0].centre.mean((0, 1, 2))
    # Of pixels, seen from a little aside.
    H = torch.eye(3, dtype=F64) + 0.1 * torch.randn(2, 3, 3, generator=generator, dtype=F64)
    H[:, 2] = torch.cat((1e-4 * torch.randn(2, 2, generator=generator, dtype=F64), torch.ones(2, 1, dtype=F64)), -1)
    shift = torch.eye(3, dtype=F64)
    shift[:2, 2] = -middle
    back = torch.linalg.inv(H @ shift)
    moved = [back[i].T @ scene.C[:, i] @ back[i] for i in (0, 1)]
    assert all(ellipse_from_conic(C)[1].all() for C in moved)
    found = fundamental_from_conics(*moved, starts=40, generator=generator)
    F = (H[1] @ shift).T @ found.model @ (H[0] @ shift)
    assert (found.status == Status.OK).all()
    assert (off(F / F.norm(dim=(-2, -1), keepdim=True), truth(scene)) < 1e-6).all()


@pytest.mark.parametrize("batch", [(2, 1), (0,)])
def test_shapes(batch, generator):
    scene = simulate_conics(batch, conics=5, views=2, generator=generator)
    found = fundamental_from_conics(scene.C[..., 0, :, :, :], scene.C[..., 1, :, :, :], starts=32, generator=generator)
    assert found.model.shape == (*batch, 3, 3)
    assert found.status.shape == found.error.shape == batch


@pytest.mark.slow
def test_derivatives_are_those_of_the_optimum(generator):
    scene = simulate_conics((), conics=6, views=2, noise=0.3, generator=generator)
    C = conic_from_ellipse(fit_ellipse(scene.x).model)
    C = C / C.norm(dim=(-2, -1), keepdim=True)
    weigh, direction = torch.randn(3, 3, generator=generator, dtype=F64), torch.randn(C.shape, generator=generator, dtype=F64)
    direction = (direction + direction.mT) * C.abs()

    def value(conics: Tensor) -> Tensor:
        found = fundamental_from_conics(*conics.unbind(0), starts=16, generator=seeded(5))
        assert found.status == Status.OK
        return (found.model * found.model[2, 1].sign().detach() * weigh).sum()

    inputs = C.requires_grad_()
    (slope,) = torch.autograd.grad(value(inputs), inputs)
    step = 1e-8
    with torch.no_grad():
        difference = (value(C + step * direction) - value(C - step * direction)) / (2 * step)
    # The whitening is not followed, which the residuals weigh.
    torch.testing.assert_close((slope * direction).sum(), difference, rtol=0.1, atol=1e-3 * float(slope.abs().max()))
