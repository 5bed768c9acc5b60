"""Projective bundle adjustment: the optimum whatever the frame, its statistics, bad input, derivatives."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust_projective
from torchsfm.bundle.bundle_adjust_projective import _linearize, _residual
from torchsfm.geometry import (
    intrinsics,
    normalize_sphere,
    project_points,
    random_rotation,
    rotation_from_rotvec,
    to_homogeneous,
)
from torchsfm.optim import Cauchy, UnitSphere
from torchsfm.optim.terms import Block, Term, Workspace, lift_of, linearize

F64 = torch.float64
Scene = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def make_scene(generator: torch.Generator, *, views: int = 6, points: int = 60, noise: float = 0.5, seen: float = 0.7) -> Scene:
    """Cameras P on an arc, homogeneous points X, and observations x, view, point in images of 4000 pixels."""
    angle = torch.linspace(-0.7, 0.7, views, dtype=F64)
    R = rotation_from_rotvec(torch.stack((0.1 * torch.cos(3 * angle), angle, torch.zeros_like(angle)), -1))
    t = torch.tensor([0.0, 0.0, 4.0], dtype=F64) + 0.2 * torch.randn(views, 3, generator=generator, dtype=F64)
    K = intrinsics(torch.tensor(3200.0, dtype=F64), torch.tensor([2000.0, 1500.0], dtype=F64))
    P = K @ torch.cat((R, t[:, :, None]), -1)
    X = torch.rand(points, 3, generator=generator, dtype=F64) * 2 - 1
    visible = torch.rand(views, points, generator=generator) < seen
    for k in range(3):
        visible[(torch.arange(points) + k * (views // 3)) % views, torch.arange(points)] = True
    view, point = visible.nonzero().unbind(1)
    x = project_points(P[view], X[point, None])[:, 0]
    return P, to_homogeneous(X), x + noise * torch.randn(x.shape, generator=generator, dtype=F64), view, point


def perturb(P: Tensor, X: Tensor, generator: torch.Generator, size: float = 3e-3) -> tuple[Tensor, Tensor]:
    def near(v: Tensor, size: float) -> Tensor:
        return v * (1 + size * torch.randn(v.shape, generator=generator, dtype=F64))

    return near(P, size), torch.cat((X[:, :3] + 0.02 * torch.randn(len(X), 3, generator=generator, dtype=F64), X[:, 3:]), 1)


def change_frame(P: Tensor, X: Tensor, condition: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The same scene in another projective frame, every vector with a scale and a sign of its own."""
    left, right = (torch.linalg.qr(torch.randn(4, 4, generator=generator, dtype=F64))[0] for _ in range(2))
    spread = torch.logspace(0, -np.log10(condition), 4, dtype=F64)
    H = left @ torch.diag(spread) @ right
    scale_P, scale_X = (torch.randn(n, generator=generator, dtype=F64).exp() for n in (len(P), len(X)))
    scale_P[::2] *= -1
    scale_X[::3] *= -1
    return scale_P[:, None, None] * P @ torch.linalg.inv(H), scale_X[:, None] * X @ H.mT


def test_jacobians(generator: torch.Generator) -> None:
    """The written-out derivatives are those of the residual along the spheres, on both halves of them."""
    P, X, x, view, point = make_scene(generator, views=3, points=12)
    P, X = change_frame(P, X, 10.0, generator)
    blocks = {
        "camera": Block(normalize_sphere(P.flatten(1)), UnitSphere(12)),
        "point": Block(normalize_sphere(X), UnitSphere(4)),
    }
    assert ((blocks["point"].x[:, 3] < 0).any(), (blocks["point"].x[:, 3] > 0).any()) == (True, True)
    values = {name: b.x.mT.contiguous().mT for name, b in blocks.items()}
    lifts = {name: lift_of(b, values[name]) for name, b in blocks.items()}
    scale = 1 + torch.rand(len(x), generator=generator, dtype=F64)
    automatic = Term(_residual, tuple(blocks), (view, point), (x, scale))
    by_hand = Term(_residual, tuple(blocks), (view, point), (x, scale), linearize=_linearize)

    def jacobians(term: Term, wanted: tuple[bool, bool]) -> tuple[Tensor, list[Tensor | None]]:
        out = [x.new_empty((2, s, len(x))).permute(2, 0, 1) if w else None for s, w in zip((11, 3), wanted, strict=True)]
        residual, _ = linearize(term, values, lifts, out, Workspace(x))
        return residual, out

    r, both = jacobians(automatic, (True, True))
    for wanted in ((True, True), (True, False), (False, True)):
        r2, found = jacobians(by_hand, wanted)
        torch.testing.assert_close(r2, r)
        for a, b in zip(both, found, strict=True):
            if b is not None:
                torch.testing.assert_close(b, a, rtol=1e-8, atol=1e-7)


def test_cost_has_its_statistical_size(generator: torch.Generator) -> None:
    """Chi-square with 2 m - 11 v - 3 n + 15 degrees of freedom, and no worse than the truth."""
    P, X, x, view, point = make_scene(generator, views=8, points=300)
    result = bundle_adjust_projective(*perturb(P, X, generator), x, view, point, tolerance=1e-10)
    truth = (project_points(P[view], X[point, None, :3])[:, 0] - x).square().sum() / 2
    freedom = 2 * len(x) - 11 * 8 - 3 * 300 + 15
    assert result.status == Status.OK
    assert result.initial_cost > 10 * truth
    assert result.cost < truth
    assert abs(result.cost / (0.125 * freedom) - 1) < 4 * (2 / freedom) ** 0.5
    again = project_points(result.P[view], (result.X[:, :3] / result.X[:, 3:])[point, None])[:, 0]
    torch.testing.assert_close((again - x).norm(dim=1), result.residuals, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(result.residuals.square().sum() / 2, result.cost, rtol=1e-10)


@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6])
def test_the_frame_does_not_matter(condition: float, generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator)
    start = perturb(P, X, generator)
    one = bundle_adjust_projective(*start, x, view, point, tolerance=1e-12)
    other = change_frame(*start, condition, generator)
    two = bundle_adjust_projective(*other, x, view, point, tolerance=1e-12)
    np.testing.assert_allclose(two.initial_cost, one.initial_cost, rtol=1e-6)
    np.testing.assert_allclose(two.cost, one.cost, rtol=1e-7)
    torch.testing.assert_close(two.residuals, one.residuals, rtol=1e-3, atol=1e-3)
    # The signs of depths and the norms stay those given.
    before, after = ((P[view, 2] * X[point]).sum(1) for P, X in (other, (two.P, two.X)))
    assert (before * after > 0).all()
    torch.testing.assert_close(two.P.flatten(1).norm(dim=1), other[0].flatten(1).norm(dim=1))
    torch.testing.assert_close(two.X.norm(dim=1), other[1].norm(dim=1))


@pytest.mark.reference
def test_scipy_finds_the_same_minimum(generator: torch.Generator) -> None:
    optimize = pytest.importorskip("scipy.optimize")
    P, X, x, view, point = make_scene(generator, views=4, points=20, seen=1.0)
    start = perturb(P, X, generator)
    result = bundle_adjust_projective(*start, x, view, point, tolerance=1e-12)
    scale = torch.tensor([1 / 2000, 1 / 2000, 1.0], dtype=F64)[:, None]
    begin = torch.cat(((scale * start[0]).flatten(), start[1][:, :3].flatten())).numpy()

    def residual(v: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        cameras, points = v[:48].reshape(4, 3, 4), v[48:].reshape(20, 3)
        y = np.einsum("vij,nj->vni", cameras, np.concatenate((points, np.ones((20, 1))), 1))[view.numpy(), point.numpy()]
        return (2000 * y[:, :2] / y[:, 2:] - x.numpy()).ravel()  # type: ignore[no-any-return]

    found = optimize.least_squares(residual, begin, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(result.cost, found.cost, rtol=1e-6)


def test_dinosaur(data: Path, generator: torch.Generator) -> None:
    """36 cameras whose calibration is implausible, tracks with missing data: from disturbed cameras to below the stored fit."""
    io = pytest.importorskip("scipy.io")
    stored = io.loadmat(data / "vgg/dinosaur/dino_Ps.mat")["P"]
    P = torch.stack([torch.tensor(np.asarray(p, dtype=np.float64)) for p in stored.flatten()])
    table = torch.tensor(np.loadtxt(data / "vgg/dinosaur/viff.xy")).reshape(-1, 36, 2)
    seen = (table > 0).all(-1)
    keep = seen.sum(1) >= 3
    point, view = seen[keep].nonzero().unbind(1)
    x = table[keep][point, view]
    P = P / P.flatten(1).norm(dim=1)[:, None, None]
    # Linear triangulation, point by point.
    rows = torch.stack((x[:, :1] * P[view, 2] - P[view, 0], x[:, 1:] * P[view, 2] - P[view, 1]), 1)
    moment = torch.zeros(int(keep.sum()), 4, 4, dtype=F64).index_add_(0, point, rows.mT @ rows)
    X = torch.linalg.eigh(moment).eigenvectors[:, :, 0]
    options = {"loss": Cauchy(1.0), "max_iterations": 100}
    stored_fit = bundle_adjust_projective(P, X, x, view, point, fixed_cameras=torch.ones(36, dtype=torch.bool), **options)
    noisy = P * (1 + 1e-3 * torch.randn(P.shape, generator=generator, dtype=F64))
    result = bundle_adjust_projective(noisy, X, x, view, point, **options)
    assert result.initial_cost > 2 * stored_fit.cost
    assert result.cost < 0.99 * stored_fit.cost
    assert result.residuals.median() < 0.3


def test_fixed_and_unobserved_keep_every_bit(generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator, views=6, points=40)
    P0, X0 = change_frame(*perturb(P, X, generator), 10.0, generator)
    fixed_cameras, fixed_points = torch.arange(6) < 2, torch.arange(40) % 5 == 0
    keep = (view != 5) & (point != 1)
    result = bundle_adjust_projective(
        P0, X0, x[keep], view[keep], point[keep], fixed_cameras=fixed_cameras, fixed_points=fixed_points
    )
    fixed_cameras, fixed_points = fixed_cameras.clone(), fixed_points.clone()
    fixed_cameras[5] = fixed_points[1] = True
    assert torch.equal(result.P[fixed_cameras], P0[fixed_cameras])
    assert torch.equal(result.X[fixed_points], X0[fixed_points])
    assert (result.P[~fixed_cameras] != P0[~fixed_cameras]).flatten(1).any(1).all()
    assert (result.X[~fixed_points] != X0[~fixed_points]).any(1).all()
    assert result.cost < 0.5 * result.initial_cost


def test_bad_values_stay_where_they_are(generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator)
    P0, X0 = perturb(P, X, generator)
    x, X0, P0 = x.clone(), X0.clone(), P0.clone()
    x[3] = torch.nan
    X0[7], X0[8] = torch.inf, 0.0
    P0[2] = torch.nan
    result = bundle_adjust_projective(P0, X0, x, view, point)
    bad = (view == 2) | (point == 7) | (point == 8)
    bad[3] = True
    assert torch.equal(result.used, ~bad)
    assert result.status == Status.OK
    clean = bundle_adjust_projective(P0, X0, x[~bad], view[~bad], point[~bad])
    good_views, good_points = torch.arange(6) != 2, torch.tensor([n not in (7, 8) for n in range(60)])
    assert result.P[good_views].isfinite().all()
    assert result.X[good_points].isfinite().all()
    np.testing.assert_allclose(result.cost, clean.cost, rtol=1e-6)
    assert (result.residuals[bad] == torch.inf).all()


def test_robust_loss(generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator, points=150)
    outlier = torch.rand(len(x), generator=generator) < 0.05
    spoiled = torch.where(outlier[:, None], x + 200 * torch.randn(x.shape, generator=generator, dtype=F64), x)
    start = perturb(P, X, generator, 1e-4)
    robust = bundle_adjust_projective(*start, spoiled, view, point, loss=Cauchy(2.0), max_iterations=100)
    squares = bundle_adjust_projective(*start, spoiled, view, point)
    clean = bundle_adjust_projective(*start, x, view, point, weights=(~outlier).double())
    assert robust.residuals[~outlier].median() < 1.2 * clean.residuals[~outlier].median()
    assert squares.residuals[~outlier].median() > 3 * robust.residuals[~outlier].median()


def test_few_views_and_points(generator: torch.Generator) -> None:
    """Planes, single views and nothing at all: finite numbers and a status."""
    P, X, x, view, point = make_scene(generator)
    flat = X.clone()
    flat[:, 2] = 0
    x_flat = project_points(P[view], flat[point, None, :3])[:, 0] + 0.3
    for P0, X0, seen, keep in (
        (P, flat, x_flat, view >= 0),
        (P, X, x, view == 0),
        (P, X, x, point == 0),
        (P, X, x, view < 0),
    ):
        result = bundle_adjust_projective(P0, X0, seen[keep], view[keep], point[keep])
        assert result.P.isfinite().all()
        assert result.X.isfinite().all()
        assert result.cost <= result.initial_cost
    assert result.status == Status.TOO_FEW


def test_derivatives(generator: torch.Generator) -> None:
    """How residuals and a projective invariant of the structure move with the observations; the frame is free."""
    P, X, x, view, point = make_scene(generator, views=4, points=14, seen=1.0)
    other = change_frame(P, X, 30.0, generator)

    def function(x: Tensor, w: Tensor) -> Tensor:
        result = bundle_adjust_projective(*other, x, view, point, weights=w, tolerance=1e-15)
        d = [torch.linalg.det(result.X[list(i)]) for i in ((0, 1, 2, 3), (0, 1, 4, 5), (0, 1, 2, 5), (0, 1, 4, 3))]
        return d[0] * d[1] / (d[2] * d[3]) + result.residuals[:20].square().sum()

    weights = 0.5 + torch.rand(len(x), generator=generator, dtype=F64)
    leaves = x.clone().requires_grad_(), weights.clone().requires_grad_()
    gradients = torch.autograd.grad(function(*leaves), leaves)
    for k, size in enumerate((1e-2, 1e-3)):
        step = size * torch.randn(leaves[k].shape, generator=generator, dtype=F64)
        plus, minus = (function(*((x, weights + s * step) if k else (x + s * step, weights))) for s in (1, -1))
        torch.testing.assert_close((gradients[k] * step).sum(), (plus - minus) / 2, rtol=1e-4, atol=1e-8)


def test_float32(generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator)
    P0, X0 = perturb(P, X, generator)
    result = bundle_adjust_projective(P0.float(), X0.float(), x.float(), view, point)
    double = bundle_adjust_projective(P0, X0, x, view, point)
    assert result.P.dtype == result.X.dtype == result.residuals.dtype == torch.float32
    np.testing.assert_allclose(result.cost, double.cost, rtol=1e-3)


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes(generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator, points=10)
    with pytest.raises(ValueError, match="X: wanted shape"):
        bundle_adjust_projective(P, X[:, :3], x, view, point)
    with pytest.raises(ValueError, match="point: wanted numbers from 0 to 9"):
        bundle_adjust_projective(P, X, x, view, point + 1)
    with pytest.raises(ValueError, match="view: wanted numbers from 0 to 5"):
        bundle_adjust_projective(P, X, x, view - 1, point)
    with pytest.raises(ValueError, match="of one problem"):
        bundle_adjust_projective(P[None], X[None], x[None], view[None], point[None])


def test_random_rotation_of_the_world_changes_nothing(generator: torch.Generator) -> None:
    P, X, x, view, point = make_scene(generator, points=30)
    T = torch.eye(4, dtype=F64)
    T[:3, :3] = random_rotation(generator=generator, dtype=F64) * 1e3
    one = bundle_adjust_projective(P, X, x, view, point, tolerance=1e-12)
    two = bundle_adjust_projective(P @ torch.linalg.inv(T), X @ T.mT, x, view, point, tolerance=1e-12)
    np.testing.assert_allclose(two.cost, one.cost, rtol=1e-9)
