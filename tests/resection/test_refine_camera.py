import pytest
import torch

from torchsfm._types import Status
from torchsfm.geometry import BrownConrady, Camera, NoDistortion, Pose, Radial, krt_from_camera, rotvec_from_rotation
from torchsfm.optim import Cauchy, Huber
from torchsfm.resection import refine_camera

K = torch.tensor([[900.0, 0.0, 640.0], [0.0, 950.0, 360.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.fixture
def make_problem(make_scene, generator):
    """Pixels, points, true poses and a camera."""

    def make(*batch, n=30, noise=0.0, distortion=None):
        Y, X, P = make_scene(*batch, n=n, width=0.6)
        lens = distortion if distortion is not None else NoDistortion()
        camera = Camera(K.expand(*batch, 3, 3), lens)
        x = camera.project(Y)
        x = x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)
        return x, X, Pose.from_matrix(P), camera

    return make


def perturbed(pose, size, generator):
    return pose.retract(size * torch.randn(*pose.shape, 6, generator=generator, dtype=torch.float64))


def step_between(found, truth):
    """The perturbation (w, v) that leads from the true pose to the one found."""
    R = found.R @ truth.R.mT
    return torch.cat((rotvec_from_rotation(R), found.t - (R @ truth.t[..., None])[..., 0]), -1)


def lens(batch, *values):
    full = [torch.full(batch, v, dtype=torch.float64) for v in values]
    return Radial(*full) if len(values) == 2 else BrownConrady(*full)


@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02), (-0.1, 0.02, 0.001, -0.002, 0.003)])
def test_exact_data(make_problem, generator, distortion):
    x, X, pose, camera = make_problem(20, distortion=lens((20,), *distortion) if distortion else None)
    found = refine_camera(x, X, perturbed(pose, 0.05, generator), camera)
    assert (found.status == Status.OK).all()
    assert step_between(found.pose, pose).abs().max() < 1e-9
    assert (found.error < 1e-8).all()
    assert found.in_front.all()
    assert found.model.shape == (20, 3, 4)


def test_far_worlds(make_problem, generator):
    x, X, pose, camera = make_problem(10)
    start = perturbed(pose, 0.02, generator)
    shift = torch.tensor([4e5, -5e6, 200.0], dtype=torch.float64)
    far = Pose(start.R, start.t - start.R @ shift)
    found = refine_camera(x, X + shift, far, camera)
    here = Pose(found.pose.R, found.pose.t + found.pose.R @ shift)
    assert (found.status == Status.OK).all()
    assert step_between(here, pose).abs().max() < 1e-7


@pytest.mark.parametrize("free", [(), ("focal",), ("focal", "principal_point", "k1")])
def test_errors_meet_the_cramer_rao_bound(make_problem, generator, free):
    sigma = 0.7
    x, X, pose, camera = make_problem(n=60, distortion=lens((), -0.05, 0.01))
    noisy = x + sigma * torch.randn(1500, 60, 2, generator=generator, dtype=torch.float64)
    found = refine_camera(noisy, X, pose, camera, free=free)
    assert (found.status == Status.OK).all()
    bound = sigma**2 * refine_camera(x, X, pose, camera, free=free).covariance
    e = step_between(found.pose, Pose(pose.R.expand(1500, 3, 3), pose.t.expand(1500, 3)))
    if "focal" in free:
        e = torch.cat((e, (found.camera.K[:, :1, 0] / K[0, 0]).log()), -1)
    if "k1" in free:
        e = torch.cat((e, found.camera.K[:, :2, 2] - K[:2, 2], found.camera.distortion.k1[:, None] + 0.05), -1)
    p = e.shape[-1]
    assert bound.shape == (p, p)
    ratio = (torch.linalg.solve(bound, e.T).T * e).sum(-1).mean() / p
    assert 0.9 < ratio < 1.1
    variance = e.square().mean(0) / bound.diagonal()
    assert (variance < 1.25).all()


@pytest.mark.parametrize(
    "free", [("focal",), ("focal", "aspect"), ("principal_point",), ("k1", "k2"), ("focal", "k1", "aspect", "principal_point")]
)
def test_the_inside_is_found(make_problem, generator, free):
    x, X, pose, truth = make_problem(8, n=60, distortion=lens((8,), -0.1, 0.02))
    matrix, k1, k2 = truth.K.clone(), truth.distortion.k1, truth.distortion.k2
    if "focal" in free:
        matrix[:, 0, 0] *= 1.05
        matrix[:, 1, 1] *= 1.05
    if "aspect" in free:
        matrix[:, 1, 1] *= 0.97
    if "principal_point" in free:
        matrix[:, :2, 2] += 15
    start = Camera(matrix, Radial(k1 * 0.5 if "k1" in free else k1, k2 * 0 if "k2" in free else k2))
    found = refine_camera(x, X, perturbed(pose, 0.02, generator), start, free=free)
    assert (found.status == Status.OK).all()
    assert torch.allclose(found.camera.K, truth.K, rtol=1e-8, atol=1e-6)
    assert torch.allclose(found.camera.distortion.k1, k1, atol=1e-8)
    assert torch.allclose(found.camera.distortion.k2, k2, atol=1e-8)


def test_the_gradient_vanishes(make_problem, generator):
    x, X, pose, camera = make_problem(5, noise=2.0)
    weights = torch.rand(5, 30, generator=generator, dtype=torch.float64)
    for loss in (None, Huber(1.0), Cauchy(2.0)):
        found = refine_camera(x, X, perturbed(pose, 0.02, generator), camera, weights=weights, loss=loss)
        delta = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
        square = (camera.project(found.pose.retract(delta).transform(X)) - x).square().sum(-1)
        cost = (weights * (square if loss is None else loss(square))).sum() / 2
        (slope,) = torch.autograd.grad(cost, delta)
        scale = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert (slope * scale).abs().max() < 1e-6
        assert torch.allclose(found.cost.sum(), cost)
        assert torch.allclose(found.error, ((weights * square).sum(-1) / weights.sum(-1)).sqrt())


def test_outliers_do_not_matter_under_a_robust_loss(make_problem, generator):
    x, X, pose, camera = make_problem(20, n=80, noise=0.3)
    clean = refine_camera(x, X, pose, camera)
    wild = torch.rand(20, 80, generator=generator) < 0.15
    bad = torch.where(wild[..., None], x + 200 * torch.randn(x.shape, generator=generator, dtype=torch.float64), x)
    found = refine_camera(bad, X, perturbed(pose, 0.01, generator), camera, loss=Cauchy(1.0))
    scale = clean.covariance.diagonal(dim1=-2, dim2=-1).sqrt() * 0.3
    assert (step_between(found.pose, pose) / scale).square().mean().sqrt() < 1.5
    plain = refine_camera(bad, X, perturbed(pose, 0.01, generator), camera)
    assert (step_between(plain.pose, pose) / scale).square().mean().sqrt() > 10


def test_ragged_batches(make_problem, generator):
    x, X, pose, camera = make_problem(6, noise=1.0)
    count = [30, 4, 12, 20, 3, 7]
    mask = torch.arange(30) < torch.tensor(count)[:, None]
    hidden_x, hidden_X = x.clone(), X.clone()
    hidden_x[~mask], hidden_X[~mask] = torch.nan, torch.inf
    start = perturbed(pose, 0.005, generator)
    found = refine_camera(hidden_x, hidden_X, start, camera, weights=mask)
    assert (found.status == Status.OK).all()
    for i, k in enumerate(count):
        one = refine_camera(x[i, :k], X[i, :k], start[i], camera[i])
        assert torch.allclose(one.model, found.model[i], atol=1e-7)
        assert torch.allclose(one.covariance, found.covariance[i], rtol=1e-3, atol=1e-12)


def test_statuses_and_neighbours(make_problem, generator):
    x, X, pose, camera = make_problem(8, n=10, noise=0.5)
    good = refine_camera(x, X, pose, camera)
    bx, bX, bR, bK = x.clone(), X.clone(), pose.R.clone(), camera.K.clone()
    bx[0, 3] = torch.nan
    bX[1, 2, 1] = torch.inf
    bR[2] = torch.nan
    bK[3, 0, 0] = torch.nan
    weights = torch.ones(8, 10, dtype=torch.float64)
    weights[4, 2:] = 0
    line = torch.linspace(0, 1, 10, dtype=torch.float64)[:, None]
    bX[5] = bX[5, :1] * (1 - line) + bX[5, 1:2] * line
    bx[5] = camera.K.new_tensor(0.0)
    bx[5] = camera[5].project(pose[5].transform(bX[5]))
    bX[6] = pose[6].centre - (bX[6] - pose[6].centre)
    found = refine_camera(bx, bX, Pose(bR, pose.t), Camera(bK), weights=weights)
    assert found.status.tolist()[:6] == [Status.NOT_FINITE] * 4 + [Status.TOO_FEW, Status.DEGENERATE]
    assert found.status[6] == Status.BEHIND
    assert not found.in_front[6].any()
    assert found.status[7] == Status.OK
    assert torch.equal(found.model[7], good.model[7])
    assert torch.equal(found.covariance[7], good.covariance[7])
    for part in (found.model, found.covariance, found.error, found.cost):
        assert part.isfinite().all()


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_shapes(make_problem, batch):
    x, X, pose, camera = make_problem(*batch, n=8, noise=0.5)
    found = refine_camera(x, X, pose, camera, free=("focal",))
    assert found.pose.R.shape == (*batch, 3, 3)
    assert found.camera.K.shape == (*batch, 3, 3)
    assert found.covariance.shape == (*batch, 7, 7)
    assert found.in_front.shape == (*batch, 8)
    for part in (found.error, found.cost, found.iterations, found.status):
        assert part.shape == batch


def test_one_camera_and_one_world_for_many_images(make_problem, generator):
    x, X, pose, _ = make_problem(n=12)
    starts = perturbed(Pose(pose.R.expand(5, 3, 3), pose.t.expand(5, 3)), 0.02, generator)
    found = refine_camera(x, X, starts, Camera(K))
    assert (found.status == Status.OK).all()
    assert (found.model - pose.matrix()).abs().max() < 1e-9
    assert found.camera.K.shape == (5, 3, 3)


def test_single_precision(make_problem, generator):
    x, X, pose, _ = make_problem(10)
    start = perturbed(pose, 0.02, generator)
    found = refine_camera(x.float(), X.float(), Pose(start.R.float(), start.t.float()), Camera(K.float()))
    assert found.model.dtype == torch.float32
    assert (found.model - pose.matrix().float()).abs().max() < 1e-3
    assert (found.error < 0.01).all()


@pytest.mark.parametrize("free", [(), ("focal", "k1")])
def test_derivatives_of_the_optimum(make_problem, generator, free):
    x, X, pose, camera = make_problem(n=7, noise=2.0, distortion=lens((), -0.05, 0.01))
    S = torch.diag(torch.tensor([1e-3, 1e-3, 1.0], dtype=torch.float64))
    w = torch.rand(7, generator=generator, dtype=torch.float64) + 0.5
    inputs = tuple(t.detach().clone().requires_grad_() for t in (x * 1e-3, X, w, S @ K, camera.distortion.k2))

    def solve(x, X, w, matrix, k2):
        found = refine_camera(x, X, pose, Camera(matrix, Radial(camera.distortion.k1, k2)), weights=w, free=free)
        return found.model, found.camera.K

    assert torch.autograd.gradcheck(solve, inputs, fast_mode=True)


def test_robust_optima_have_derivatives(make_problem):
    x, X, pose, _ = make_problem(n=10, noise=2.0)
    x = (x * 1e-3).requires_grad_()
    S = torch.diag(torch.tensor([1e-3, 1e-3, 1.0], dtype=torch.float64))
    loss = Cauchy(2e-3)
    assert torch.autograd.gradcheck(lambda x: refine_camera(x, X, pose, Camera(S @ K), loss=loss).model, (x,), fast_mode=True)


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(make_problem):
    x, X, pose, camera = make_problem(n=8)
    with pytest.raises(ValueError, match="free: wanted names among"):
        refine_camera(x, X, pose, camera, free=("k1",))
    with pytest.raises(ValueError, match="free: wanted distinct names"):
        refine_camera(x, X, pose, camera, free=("focal", "focal"))
    with pytest.raises(ValueError, match="X: wanted n = 8"):
        refine_camera(x, X[:5], pose, camera)


@pytest.mark.reference
def test_opencv_refines_to_the_same_pose(make_problem, generator):
    cv2 = pytest.importorskip("cv2")
    x, X, pose, camera = make_problem(5, noise=1.0)
    start = perturbed(pose, 0.01, generator)
    found = refine_camera(x, X, start, camera)
    for i in range(5):
        r, t = cv2.Rodrigues(start.R[i].numpy())[0], start.t[i].numpy()[:, None].copy()
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
        r, t = cv2.solvePnPRefineLM(X[i].numpy(), x[i].numpy(), K.numpy(), None, r, t, criteria)
        R = torch.tensor(cv2.Rodrigues(r)[0])
        assert torch.allclose(torch.cat((R, torch.tensor(t)), -1), found.model[i], atol=1e-6)


@pytest.mark.parametrize("folder", ["model_house", "corridor"])
def test_oxford_sequences(oxford, folder):
    scene = oxford(folder)
    x, visible, P, X = scene.x, scene.visible, scene.P, scene.X
    # The worlds are mirror images; mirrored back, the cameras are K [R | t].
    mirror = torch.sign(torch.linalg.det(P[:, :, :3]))[0]
    P, X = torch.cat((P[..., :3] * mirror, P[..., 3:]), -1), (X * mirror).expand(len(P), -1, -1)
    matrix, R, t = krt_from_camera(P)
    found = refine_camera(x, X, Pose(R, t), Camera(matrix), weights=visible)
    assert (found.status == Status.OK).all()
    h = X @ P[..., :3].mT + P[..., None, :, 3]
    stored = (h[..., :2] / h[..., 2:] - x).square().sum(-1)
    stored = ((stored * visible).sum(-1) / visible.sum(-1)).sqrt()
    assert (found.error <= stored * (1 + 1e-9)).all()
    assert (found.error > 0.7 * stored).all()


def test_a_real_image(pose6dscene):
    x, X, intrinsics, truth = pose6dscene
    found = refine_camera(x, X, Pose.from_matrix(truth), Camera(intrinsics))
    assert found.status == Status.OK
    assert found.error < 1.5
    assert step_between(found.pose, Pose.from_matrix(truth))[:3].norm() < 0.02


@pytest.mark.parametrize("loss", [None, Cauchy(2.0)])
@pytest.mark.parametrize("unit", [1e-12, 1e-8, 1e8, 1e12])
def test_the_unit_of_the_world_is_free(make_problem, generator, unit, loss):
    x, X, pose, camera = make_problem(10, noise=1.0)
    start = perturbed(pose, 0.05, generator)
    found = refine_camera(x, X, start, camera, loss=loss)
    again = refine_camera(x, X * unit, Pose(start.R, start.t * unit), camera, loss=loss)
    assert (found.status == Status.OK).all()
    assert (again.status == Status.OK).all()
    torch.testing.assert_close(again.cost, found.cost, rtol=1e-5, atol=0)
    torch.testing.assert_close(again.pose.t / unit, found.pose.t, rtol=1e-4, atol=1e-4)
