import pytest
import torch
from chance import assert_share

from torchsfm._types import Status
from torchsfm.geometry import random_rotation, rotation_angle, rotvec_from_rotation
from torchsfm.resection import camera_epnp, camera_planar, camera_pnp

F64 = torch.float64


@pytest.fixture
def make_views(generator):
    """Rays, points in the world, true R and t: a box of points, thinned towards a plane, 6 away."""

    def make(*batch, n=10, thickness=1.0, noise=0.0):
        X = 4 * torch.rand(*batch, n, 3, generator=generator, dtype=F64) - 2
        X[..., 2] *= thickness
        turn = random_rotation(*batch, generator=generator, dtype=F64)
        R = random_rotation(*batch, generator=generator, dtype=F64)
        t = 0.3 * torch.randn(*batch, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0, 6])
        Y = X @ R.mT + t[..., None, :]
        d = Y / Y[..., 2:]
        d[..., :2] += noise * torch.randn(*batch, n, 2, generator=generator, dtype=F64)
        return d, X @ turn.mT + 5, R @ turn.mT, t - (R @ turn.mT).sum(-1) * 5

    return make


def turn(model, R):
    return rotation_angle(model[..., :3] @ R.mT)


def sines(model, d, X):
    Y = X @ model[..., :3].mT + model[..., None, :, 3]
    across = torch.linalg.cross(*torch.broadcast_tensors(Y, d), dim=-1)
    return across.norm(dim=-1) / (Y.norm(dim=-1) * d.norm(dim=-1))


@pytest.mark.parametrize("n", [4, 5, 6, 20])
@pytest.mark.parametrize("thickness", [1.0, 1e-2, 1e-6, 0.0])
def test_exact_data(make_views, n, thickness):
    d, X, R, t = make_views(400, n=n, thickness=thickness)
    found = camera_pnp(d, X)
    assert (found.status == Status.OK).all()
    good = (turn(found.model, R) < 1e-8) & ((found.model[..., 3] - t).norm(dim=-1) < 1e-7)
    assert_share(good, 0.999)
    torch.testing.assert_close(found.model[..., :3] @ found.model[..., :3].mT, torch.eye(3, dtype=F64).expand(400, 3, 3))
    assert (found.error[good] < 1e-8).all()


@pytest.mark.parametrize("n", [4, 5, 6, 20])
@pytest.mark.parametrize("thickness", [1.0, 1e-2, 2e-3, 1e-6, 0.0])
def test_exact_data_by_control_points(make_views, n, thickness):
    d, X, R, t = make_views(400, n=n, thickness=thickness)
    found = camera_epnp(d, X)
    good = (turn(found.model, R) < 1e-7) & ((found.model[..., 3] - t).norm(dim=-1) < 1e-6)
    # Four points leave four coefficients, which the approximations may take to another minimum.
    assert_share(good, 0.999 if n > 4 or thickness == 0 else 0.75)
    assert_share(found.status == Status.OK, 0.99)
    assert (found.error[good] < 1e-8).all()


@pytest.mark.parametrize(("n", "thickness"), [(6, 1.0), (20, 1.0), (20, 0.02), (20, 0.0)])
def test_control_points_lead_to_the_minimum(make_views, n, thickness):
    d, X, *_ = make_views(400, n=n, thickness=thickness, noise=2e-3)
    found, best = camera_epnp(d, X), camera_pnp(d, X)
    assert (found.error >= best.error * (1 - 1e-7)).all()
    assert_share(found.error <= best.error * (1 + 1e-6), 0.98)


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp])
def test_rays_in_all_directions(generator, solve):
    Y = torch.randn(500, 8, 3, generator=generator, dtype=F64)
    R = random_rotation(500, generator=generator, dtype=F64)
    t = torch.randn(500, 3, generator=generator, dtype=F64)
    found = solve(2 * Y, (Y - t[:, None]) @ R)
    assert (found.status == Status.OK).all()
    assert_share(turn(found.model, R) < 1e-8, 0.998)


@pytest.mark.parametrize("thickness", [1.0, 0.02])
@pytest.mark.parametrize("n", [6, 30])
def test_errors_meet_the_cramer_rao_bound(make_views, generator, n, thickness):
    sigma = 1e-3
    d, X, R, t = make_views(n=n, thickness=thickness)
    e = sigma * torch.randn(1500, n, 3, generator=generator, dtype=F64)
    u = torch.nn.functional.normalize(d, dim=-1)
    found = camera_pnp(u + e - (e * u).sum(-1, keepdim=True) * u, X)
    delta = torch.zeros(6, dtype=F64)

    def residual(delta):
        S = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3, dtype=F64), delta[:3].expand(3, 3), dim=-1))
        Y = torch.nn.functional.normalize((X @ R.mT + t) @ S.mT + delta[3:], dim=-1)
        return torch.linalg.cross(u, Y, dim=-1).flatten()

    J = torch.autograd.functional.jacobian(residual, delta)
    bound = sigma**2 * torch.linalg.inv(J.mT @ J)
    w = rotvec_from_rotation(found.model[..., :3] @ R.mT)
    v = found.model[..., 3] - torch.linalg.cross(w, t.expand(1500, 3)) - t
    e = torch.cat((w, v), -1)
    ratio = (torch.linalg.solve(bound, e.T).T * e).sum(-1).mean() / 6
    assert 0.9 < ratio < 1.1


def test_weights_and_absent_points(make_views, generator):
    d, X, *_ = make_views(20, n=12, noise=1e-3)
    w = torch.rand(20, 12, generator=generator, dtype=F64) + 0.1
    w[:, 8:] = 0
    d[:, 8:], X[:, 9:] = torch.nan, torch.inf
    found, short = camera_pnp(d, X, weights=w), camera_pnp(d[:, :8], X[:, :8], weights=w[:, :8])
    assert (found.status == Status.OK).all()
    torch.testing.assert_close(found.model, short.model)
    doubled = camera_pnp(*(torch.cat((a[:, :8], a[:, :4]), 1) for a in (d, X)))
    w = torch.ones(20, 8, dtype=F64)
    w[:, :4] = 2
    torch.testing.assert_close(camera_pnp(d[:, :8], X[:, :8], weights=w).model, doubled.model, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])
def test_the_gradient_vanishes(make_views, solve):
    d, X, *_ = make_views(30, n=9, thickness=0.0, noise=2e-3)
    found = solve(d, X)
    models = found.model if solve is camera_planar else found.model[:, None]
    valid = found.valid if solve is camera_planar else (found.status == Status.OK)[:, None]
    delta = torch.zeros(*models.shape[:2], 6, dtype=F64, requires_grad=True)
    S = torch.linalg.matrix_exp(
        torch.linalg.cross(torch.eye(3, dtype=F64).expand(*models.shape[:2], 3, 3), delta[..., None, :3])
    )
    moved = S.mT @ models
    moved = torch.cat((moved[..., :3], moved[..., 3:] + delta[..., 3:, None]), -1)
    (g,) = torch.autograd.grad(sines(moved, d[:, None], X[:, None]).square()[valid].sum(), delta)
    assert_share(g[valid].abs() < 1e-7, 0.97)


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])
def test_statuses_and_neighbours(make_views, solve):
    d, X, *_ = make_views(12, n=8, thickness=0.0 if solve is camera_planar else 1.0, noise=1e-3)
    good = solve(d, X)
    w = torch.ones(12, 8, dtype=F64)
    bad_d, bad_X = d.clone(), X.clone()
    bad_d[0, 3] = torch.nan
    bad_X[1, 0, 2] = torch.inf
    bad_d[2, 1] = 0
    w[3, 3:] = 0
    w[4] = 0
    bad_X[5] = bad_X[5, :1]
    bad_X[6] = bad_X[6, :1] + torch.arange(8, dtype=F64)[:, None] * (bad_X[6, 1] - bad_X[6, 0])
    bad_d[7] = bad_d[7, :1]
    w[8, 2] = torch.nan
    bad_X[9] *= 1e200
    found = solve(bad_d, bad_X, weights=w)
    assert found.status[:3].tolist() == [Status.NOT_FINITE] * 3
    assert found.status[3:5].tolist() == [Status.TOO_FEW] * 2
    assert (found.status[5:8] == Status.DEGENERATE).all()
    assert found.status[8] == Status.NOT_FINITE
    assert found.model.isfinite().all()
    assert found.error.isfinite().all()
    assert torch.equal(found.model[10:], good.model[10:])
    assert (found.status[10:] == Status.OK).all()


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])
@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_shapes(make_views, solve, batch):
    d, X, R, _ = make_views(*batch, n=6, thickness=0.0)
    found = solve(d, X)
    slots = (2,) if solve is camera_planar else ()
    assert found.model.shape == (*batch, *slots, 3, 4)
    assert found.pose.shape == (*batch, *slots)
    assert found.pose.matrix().equal(found.model)
    assert found.error.shape == (*batch, *slots)
    assert found.status.shape == batch
    single = solve(d.float(), X.float())
    assert single.model.dtype == torch.float32
    if R.numel():
        best = single.model[..., 0, :, :] if slots else single.model
        assert (turn(best.double(), R) < 1e-2).all()


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])
def test_batched_is_the_same_as_one_by_one(make_views, solve):
    d, X, *_ = make_views(5, n=7, thickness=0.0, noise=1e-3)
    whole = solve(d, X).model
    for i in range(5):
        torch.testing.assert_close(solve(d[i], X[i]).model, whole[i], rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(solve(d[:, None], X[0]).model[0, 0], whole[0], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])
def test_derivatives_of_the_optimum(make_views, generator, solve):
    d, X, *_ = make_views(2, n=6, thickness=0.0, noise=1e-3)
    w = torch.rand(2, 6, generator=generator, dtype=F64) + 0.5
    best = (lambda f: f.model[:, 0]) if solve is camera_planar else (lambda f: f.model)
    inputs = tuple(a.requires_grad_() for a in (d, X, w))
    optimum = lambda d, X, w: best(solve(d, X, weights=w))  # noqa: E731
    assert torch.autograd.gradcheck(optimum, inputs, eps=1e-5, atol=1e-4, rtol=2e-3, fast_mode=True)


def test_both_planar_poses(make_views):
    d, X, R, t = make_views(2000, n=8, thickness=0.0)
    found = camera_planar(d, X)
    assert (found.status == Status.OK).all()
    assert found.valid[:, 0].all()
    assert 0.5 < found.valid[:, 1].double().mean() < 1
    assert (found.error[:, 0] <= found.error[:, 1]).all()
    assert_share(turn(found.model[:, 0], R) < 1e-7, 0.998)
    assert_share((found.model[:, 0, :, 3] - t).norm(dim=-1) < 1e-6, 0.998)
    rms = sines(found.model, d[:, None], X[:, None]).square().mean(-1).sqrt()
    torch.testing.assert_close(rms, found.error)
    second = found.valid[:, 1]
    assert_share(found.error[second, 1] > 1e-5, 0.995)


def test_a_small_far_plane_is_ambiguous(make_views, generator):
    """Weak perspective and noise: the true pose is one of the two, and often not the better one."""
    d, X, R, _ = make_views(1000, n=6, thickness=0.0)
    d = (X - X.mean(-2, keepdim=True)) @ R.mT + torch.tensor([0.0, 0, 200])
    d = d / d[..., 2:]
    d[..., :2] += 2e-4 * torch.randn(1000, 6, 2, generator=generator, dtype=F64)
    found = camera_planar(d, X)
    best = turn(found.model[:, 0], R)
    either = torch.where(found.valid, turn(found.model, R[:, None]), torch.inf).amin(-1)
    assert_share(best > 0.3, 0.2)
    assert_share(either < 0.3, 0.9)


def test_points_in_no_plane_are_reported(make_views):
    d, X, *_ = make_views(50, n=8, thickness=0.5)
    assert (camera_planar(d, X).status == Status.DEGENERATE).all()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])
def test_wrong_arguments(make_views, solve):
    d, X, *_ = make_views(3, n=6)
    with pytest.raises(ValueError, match="wanted n = 6"):
        solve(d, X[:, :5])
    with pytest.raises(ValueError, match="wanted dtype"):
        solve(d, X.float())
    with pytest.raises(ValueError, match="wanted shape"):
        solve(d[..., :2], X)


@pytest.mark.reference
@pytest.mark.parametrize("thickness", [1.0, 0.0])
def test_opencv_by_control_points_is_not_better(make_views, thickness):
    cv2 = pytest.importorskip("cv2")
    import numpy as np

    d, X, R, _ = make_views(200, n=10, thickness=thickness, noise=2e-3)
    error = []
    for i in range(200):
        _, r, _ = cv2.solvePnP(X[i].numpy(), d[i, :, :2].numpy().copy(), np.eye(3), None, flags=cv2.SOLVEPNP_EPNP)
        error.append(rotation_angle(torch.tensor(cv2.Rodrigues(r)[0]) @ R[i].mT))
    ours = turn(camera_epnp(d, X).model, R)
    assert ours.median() < torch.stack(error).median()
    assert ours.quantile(0.9) < torch.stack(error).quantile(0.9)


@pytest.mark.reference
def test_opencv_is_not_better(make_views):
    cv2 = pytest.importorskip("cv2")
    import numpy as np

    for thickness, flag in ((1.0, cv2.SOLVEPNP_SQPNP), (0.02, cv2.SOLVEPNP_SQPNP), (0.0, cv2.SOLVEPNP_IPPE)):
        d, X, R, _ = make_views(200, n=10, thickness=thickness, noise=1e-3)
        # OpenCV's planar method wants points in a plane through the origin.
        V = torch.linalg.svd(X - X.mean(-2, keepdim=True))[2] if thickness == 0 else torch.eye(3, dtype=F64).expand(200, 3, 3)
        V = V * torch.linalg.det(V)[:, None, None]
        flat = (X - X.mean(-2, keepdim=True)) @ V.mT
        flat[..., 2] = 0 if thickness == 0 else flat[..., 2]
        theirs = []
        for i in range(200):
            _, r, *_ = cv2.solvePnP(flat[i].numpy(), d[i, :, :2].numpy().copy(), np.eye(3), None, flags=flag)
            theirs.append(torch.from_numpy(cv2.Rodrigues(r)[0]) @ V[i])
        ours = turn(camera_pnp(d, X).model, R)
        theirs = turn(torch.stack(theirs), R)
        assert ours.median() < 1.1 * theirs.median()
        assert ours.quantile(0.95) < 1.1 * theirs.quantile(0.95)
        assert ours.max() < 0.2


def test_a_real_image(pose6dscene):
    x, X, K, truth = pose6dscene
    d = torch.cat((x, torch.ones_like(x[:, :1])), -1) @ torch.linalg.inv(K).T
    found = camera_pnp(d, X)
    assert found.status == Status.OK
    assert torch.rad2deg(turn(found.model, truth[:, :3])) < 1
    assert found.error < 5e-3


ALL = pytest.mark.parametrize("solve", [camera_pnp, camera_epnp, camera_planar])


def seen_by(generator, X, noise):
    R = random_rotation(*X.shape[:-2], generator=generator, dtype=F64)
    Y = X @ R.mT + torch.tensor([0.0, 0, 6])
    return Y / Y[..., 2:] + noise * torch.randn(Y.shape, generator=generator, dtype=F64)


@ALL
@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-3])
@pytest.mark.parametrize("n", [4, 5, 30])
def test_three_points_often_are_three(generator, solve, noise, n):
    X = torch.randn(40, 3, 3, generator=generator, dtype=F64)[:, torch.arange(n) % 3]
    assert (solve(seen_by(generator, X, noise), X).status != Status.OK).all()


@ALL
@pytest.mark.parametrize("n", [20, 200])
def test_off_a_line_by_less_than_noise(generator, solve, n):
    along = torch.nn.functional.normalize(torch.randn(40, 1, 3, generator=generator, dtype=F64), dim=-1)
    X = (2 * torch.rand(40, n, 1, generator=generator, dtype=F64) - 1) * along
    off = torch.randn(X.shape, generator=generator, dtype=F64)
    if solve is camera_planar:
        across = torch.linalg.cross(along, torch.randn(along.shape, generator=generator, dtype=F64))
        off = off[..., :1] * torch.nn.functional.normalize(across, dim=-1)
    assert (solve(seen_by(generator, X + 1e-3 * off, 3e-3), X + 1e-3 * off).status == Status.DEGENERATE).all()
    # Much more than the noise determines it.
    d = seen_by(generator, X + 0.3 * off, 1e-4)
    assert_share(solve(d, X + 0.3 * off).status == Status.OK, 0.98)


def test_a_plane_wants_two_points_off_every_line(generator):
    X = torch.zeros(40, 10, 3, dtype=F64)
    X[..., 0] = torch.randn(40, 10, generator=generator, dtype=F64)
    X[:, 3, 1] = 1
    for noise in (0.0, 1e-4):
        assert (camera_planar(seen_by(generator, X, noise), X).status != Status.OK).all()
    X[:, 4, 1] = 0.5
    assert_share(camera_planar(seen_by(generator, X, 0.0), X).status == Status.OK, 0.9)


@ALL
@pytest.mark.parametrize("noise", [1e-5, 3e-4, 2.5e-3])
def test_points_apart_are_enough(generator, solve, noise):
    for n in (10, 100, 1000):
        X = torch.randn(100, n, 3, generator=generator, dtype=F64)
        X[..., 2] *= solve is not camera_planar
        assert_share(solve(seen_by(generator, X, noise), X).status == Status.OK, 0.98)


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp])
def test_four_points_lead_to_the_least_minimum(generator, solve):
    """Three of them have up to four poses."""
    d = torch.randn(400, 4, 3, generator=generator, dtype=F64)
    R = random_rotation(400, generator=generator, dtype=F64)
    Y = d + torch.tensor([0.0, 0, 6])
    found = solve(Y, Y @ R)
    assert_share((turn(found.model, R) < 1e-5) & (found.status == Status.OK), 0.98)
    # Other points that count for nothing change nothing.
    more = [torch.cat((torch.randn(400, 2, 3, generator=generator, dtype=F64), a), 1) for a in (Y, Y @ R)]
    weights = torch.tensor([0.0, 0, 1, 1, 1, 1], dtype=F64)
    assert_share(turn(solve(*more, weights=weights).model, R) < 1e-5, 0.98)


@pytest.mark.parametrize("solve", [camera_pnp, camera_epnp])
def test_a_second_pose_that_fits_as_well_is_told(generator, solve):
    """A plane that is far away has two; so have three points, one of them seen twice, if noise parts them."""
    X = torch.rand(400, 6, 3, generator=generator, dtype=F64) - 0.5
    X[..., 2] = 0
    R = random_rotation(400, generator=generator, dtype=F64)
    Y = X @ R.mT + torch.tensor([0.0, 0, 10])
    noisy = Y / Y[..., 2:] + 3e-3 * torch.randn(Y.shape, generator=generator, dtype=F64)
    found = solve(noisy, X)
    good = found.status == Status.OK
    assert (good & (turn(found.model, R) > 0.5)).sum() <= 0.1 * 400
    # Near enough, they are one.
    Y = 4 * X @ R.mT + torch.tensor([0.0, 0, 6])
    found = solve(Y / Y[..., 2:] + 3e-4 * torch.randn(Y.shape, generator=generator, dtype=F64), 4 * X)
    assert_share(found.status == Status.OK, 0.9)

    X = torch.randn(400, 3, 3, generator=generator, dtype=F64)[:, [0, 1, 2, 0]]
    assert_share(solve(seen_by(generator, X, 1e-2), X).status != Status.OK, 0.95)
