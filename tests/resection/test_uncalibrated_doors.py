"""Robust doors for cameras that are not calibrated: accuracy, units, ragged batches, real data."""

import numpy as np
import pytest
import torch
from chance import assert_share, seeded

from torchsfm._types import Status
from torchsfm.geometry import Camera, Pose, krt_from_camera, random_rotation, rotation_angle
from torchsfm.resection import estimate_camera, estimate_camera_focal, estimate_camera_projective, refine_camera, resect_cameras
from torchsfm.robust import Degeneracy

F64 = torch.float64
C = torch.tensor([500.0, 400.0], dtype=F64)
DOORS = {
    "focal": lambda x, X, **options: estimate_camera_focal(x, X, C.to(x.dtype), **options),
    "projective": estimate_camera_projective,
}
every_door = pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)


@pytest.fixture
def images(generator):
    """Points in images of different focal length, some replaced: x, X, which are wrong, P."""

    def make(p, n, inliers, noise=1.0, thickness=1.0):
        def uniform(*shape):
            return torch.rand(*shape, generator=generator, dtype=F64)

        X = uniform(p, n, 3) * 4 - 2
        X[..., 2] *= thickness
        R = random_rotation(p, generator=generator, dtype=F64)
        t = torch.randn(p, 3, generator=generator, dtype=F64) * 0.3 + torch.tensor([0.0, 0, 6])
        f = 600 + 900 * uniform(p)
        K = torch.diag_embed(torch.stack((f, f, torch.ones_like(f)), -1))
        K[:, :2, 2] = C
        P = K @ torch.cat((R, t[..., None]), -1)
        x = project(P, X) + noise * torch.randn(p, n, 2, generator=generator, dtype=F64)
        wrong = uniform(p, n) > inliers
        return torch.where(wrong[..., None], uniform(p, n, 2) * torch.tensor([1000.0, 800]), x), X, wrong, P

    return make


def project(P, X):
    h = X @ P[..., :3].mT + P[..., None, :, 3]
    return h[..., :2] / h[..., 2:]


def gap(P, Q, X):
    """Root-mean-square distance in pixels between the images of points by two cameras."""
    return (project(P, X) - project(Q, X)).square().sum(-1).mean(-1).sqrt()


@every_door
@pytest.mark.parametrize(("inliers", "n"), [(0.9, 100), (0.5, 300)])
def test_cameras_are_right(images, door, inliers, n):
    x, X, wrong, P = images(16, n, inliers)
    found = door(x, X, threshold=3.0, generator=seeded())
    assert (found.status == Status.OK).all()
    assert (gap(found.model, P, X) < 1.5).all()
    # Eleven parameters at most, each of which takes its share of the noise.
    assert gap(found.model, P, X).median() < 1.3 * (11 / (n * inliers)) ** 0.5
    error = (project(found.model, X) - x).norm(dim=-1)
    assert torch.equal(found.inliers, error < 3.0)
    assert (found.inliers & ~wrong).sum() > 0.95 * (~wrong).sum()
    assert torch.allclose(found.model[:, 2, :3].norm(dim=-1), torch.ones(16, dtype=F64))


def test_the_focal_length_meets_the_bound(images):
    x, X, wrong, P = images(60, 120, 0.6)
    found = estimate_camera_focal(x, X, C, threshold=4.0, generator=seeded(), covariance=True)
    K, R, _ = krt_from_camera(found.model)
    assert torch.allclose(K[:, 0, 0], K[:, 1, 1])
    assert torch.allclose(K[:, :2, 2], C.expand(60, 2))
    truth, R0, t0 = krt_from_camera(P)
    best = refine_camera(x, X, Pose(R0, t0), Camera(truth), free=("focal",), weights=~wrong)
    ours = (K[:, 0, 0] / truth[:, 0, 0]).log()
    ideal = (best.camera.K[:, 0, 0] / truth[:, 0, 0]).log()
    assert ours.square().mean() < 1.2 * ideal.square().mean()
    assert rotation_angle(R @ R0.mT).square().mean() < 1.2 * rotation_angle(best.pose.R @ R0.mT).square().mean()
    spread = found.covariance[:, 6, 6]
    assert 0.6 < (ours.square() / spread).mean() < 1.6


@every_door
def test_units_of_image_and_world_do_not_matter(images, door):
    x, X, _, P = images(6, 200, 0.6)
    plain = door(x, X, threshold=3.0, generator=seeded())
    moved = door(x, X * 1e4 + 3e6, threshold=3.0, generator=seeded())
    assert_share(plain.inliers == moved.inliers, 0.998)
    assert (gap(moved.model, P, X * 1e4 + 3e6) > 0).all()
    assert torch.allclose(project(moved.model, X * 1e4 + 3e6), project(plain.model, X), atol=0.05)


@every_door
def test_ragged_extremes_in_one_batch(images, door):
    x, X, _, P = images(7, 600, 0.6)
    mask = torch.arange(600) < torch.tensor([0, 3, 50, 600, 600, 600, 600])[:, None]
    x[4] = torch.rand(600, 2, generator=seeded(), dtype=F64) * 1000
    x[5], X[5] = x[5, :1], X[5, :1]
    x[6, ::2] = torch.nan
    found = door(x, X, threshold=3.0, mask=mask, generator=seeded(), max_iterations=2000)
    wanted = [Status.TOO_FEW, Status.TOO_FEW, Status.OK, Status.OK, Status.NO_CONSENSUS, Status.DEGENERATE, Status.OK]
    assert found.status.tolist() == wanted
    assert found.model.isfinite().all()
    assert (gap(found.model, P, X)[[2, 3, 6]] < 3).all()
    alone = door(x[3], X[3], threshold=3.0, generator=seeded(), max_iterations=2000)
    assert torch.equal(alone.inliers, found.inliers[3])


def test_planes(images):
    x, X, _, P = images(12, 200, 0.7, noise=0.3, thickness=0.0)
    found = estimate_camera_focal(x, X, C, threshold=2.0, generator=seeded())
    assert (found.degeneracy == Degeneracy.PLANAR).all()
    tilted = P[:, 2, 2].abs() < 0.8
    K, K0 = krt_from_camera(found.model)[0], krt_from_camera(P)[0]
    assert ((K[:, 0, 0] / K0[:, 0, 0]).log().abs()[tilted] < 0.05).all()
    blind = estimate_camera_projective(x, X, threshold=2.0, generator=seeded())
    assert ((blind.status != Status.OK) | (blind.degeneracy == Degeneracy.PLANAR)).all()


@every_door
def test_derivatives(images, door):
    x, X, wrong, _ = images(2, 60, 0.8)
    x.requires_grad_()
    found = door(x, X, threshold=3.0, generator=seeded())
    (g,) = torch.autograd.grad(found.model[..., 0, :].sum(), x)
    assert g.isfinite().all()
    assert_share(g[~wrong] != 0, 0.9)
    assert (g[~found.inliers & wrong].abs().amax() if wrong.any() else torch.zeros(())) == 0


def test_a_real_image_of_unknown_focal_length(pose6dscene):
    x, X, K, truth = pose6dscene
    found = estimate_camera_focal(x, X, K[:2, 2], threshold=4.0, generator=seeded())
    assert found.status == Status.OK
    assert found.inliers.sum() >= 90
    matrix, R, _ = krt_from_camera(found.model)
    assert (matrix[0, 0] / K[0, 0]).log().abs() < 0.05
    assert torch.rad2deg(rotation_angle(R @ truth[:, :3].T)) < 2
    wrong = torch.rand(len(x), generator=seeded()) < 0.5
    spoiled = torch.where(wrong[:, None], torch.rand(len(x), 2, generator=seeded(1), dtype=F64) * 480, x)
    again = estimate_camera_focal(spoiled, X, K[:2, 2], threshold=4.0, generator=seeded())
    assert again.status == Status.OK
    assert (krt_from_camera(again.model)[0][0, 0] / K[0, 0]).log().abs() < 0.1


# ---- lists of cameras ------------------------------------------------------------------------------------------------


@pytest.fixture
def sequence(images, generator):
    """One world seen by nine cameras, of which some see little: x, X, K, visible, [R | t]."""
    _, X, _, P = images(9, 120, 1.0)
    X = X[0]
    visible = torch.rand(9, 120, generator=generator) < 0.7
    x = project(P, X) + 0.5 * torch.randn(9, 120, 2, generator=generator, dtype=F64)
    K, R, t = krt_from_camera(P)
    x[~visible] = torch.nan
    visible[7] = False
    visible[8, 3:] = False
    return x, X, K, visible, torch.cat((R, t[..., None]), -1)


@pytest.mark.parametrize("threshold", [None, 3.0])
@pytest.mark.parametrize("calibrated", [True, False])
def test_every_camera_of_a_list(sequence, generator, threshold, calibrated):
    x, X, K, visible, P = sequence
    wrong = torch.zeros_like(visible)
    if threshold is not None:
        wrong = (torch.rand(visible.shape, generator=generator) < 0.3) & visible
        x = torch.where(wrong[..., None], 800 * torch.rand(x.shape, generator=generator, dtype=F64), x)
    found = resect_cameras(x, X, K if calibrated else None, threshold=threshold, visible=visible, generator=seeded())
    assert found.model.shape == (9, 3, 4)
    assert (found.status[:7] == Status.OK).all()
    assert found.status[7:].tolist() == [Status.TOO_FEW] * 2 or (calibrated and threshold is not None)
    full = K @ found.model if calibrated else found.model
    assert (gap(full, K @ P, X)[:7] < 0.6).all()
    assert (found.error[:7] < 1.2).all()
    assert not (found.inliers & ~visible).any()
    assert (found.inliers & wrong)[:7].sum() < 0.05 * wrong.sum() + 1
    assert found.model.isfinite().all()
    assert found.error.isfinite().all()


@pytest.mark.parametrize(
    ("calibrated", "thickness"), [(False, (1.0, 1.0, 1e-3)), (False, (1.0, 1e-3, 1e-3)), (True, (1.0, 1e-3, 1e-3))]
)
def test_cameras_that_nearly_flat_points_leave_open(images, calibrated, thickness):
    """Nearly a plane, or nearly a line: within their noise other cameras see the points in the same places."""
    _, X, _, P = images(20, 60, 1.0)
    X = X[0] * torch.tensor(thickness, dtype=F64)
    x = project(P, X) + 0.5 * torch.randn(20, 60, 2, generator=seeded(), dtype=F64)
    K = krt_from_camera(P)[0] if calibrated else None
    found = resect_cameras(x, X, K, threshold=3.0, generator=seeded())
    assert (found.status != Status.OK).all()


@pytest.mark.parametrize("calibrated", [True, False])
def test_batches_of_lists(sequence, calibrated):
    x, X, K, visible, _ = sequence
    K = K if calibrated else None
    one = resect_cameras(x, X, K, visible=visible)
    two = resect_cameras(torch.stack((x, x)), torch.stack((X, X + 1)), K, visible=visible)
    assert two.model.shape == (2, 9, 3, 4)
    torch.testing.assert_close(two.model[0], one.model, rtol=1e-7, atol=1e-7)
    shifted = two.model[1, :7, :, 3] + two.model[1, :7, :, :3].sum(-1)
    torch.testing.assert_close(shifted, one.model[:7, :, 3], rtol=1e-5, atol=1e-5)
    none = resect_cameras(x[:0], X, None if K is None else K[:0])
    assert none.model.shape == (0, 3, 4)


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(sequence):
    x, X, K, _, _ = sequence
    with pytest.raises(ValueError, match="wanted n = 120"):
        resect_cameras(x, X[:5])
    with pytest.raises(ValueError, match="wanted v = 9"):
        resect_cameras(x, X, K[:5])
    with pytest.raises(ValueError, match="wanted dtype"):
        estimate_camera_focal(x, X, C.float(), threshold=1.0)
    with pytest.raises(ValueError, match="wanted shape"):
        estimate_camera_projective(x[..., :1], X, threshold=1.0)


@pytest.mark.parametrize("folder", ["model_house", "corridor", "merton1", "library"])
def test_oxford_sequences(oxford, folder):
    """The stored cameras were adjusted together with the points; one from the points alone fits its image as well."""
    scene = oxford(folder)
    x, visible, P, X = scene.x, scene.visible, scene.P, scene.X
    stored = torch.where(visible, (project(P, X.expand(len(P), -1, -1)) - x).square().sum(-1), 0).sum(-1)
    stored = (stored / visible.sum(-1)).sqrt()
    for threshold in (None, 3.0):
        found = resect_cameras(x, X, threshold=threshold, visible=visible, generator=seeded())
        assert (found.status == Status.OK).all()
        # The robust optimum is that of another cost.
        assert (found.error <= stored * (1 + 1e-6 if threshold is None else 1.03)).all()
        assert (found.inliers.sum(-1) > 0.9 * visible.sum(-1)).all()


@pytest.mark.parametrize(("number", "angle", "distance"), [(1, 2.5, 0.1), (2, 4.0, 0.5)])
def test_a_staircase_with_many_wrong_matches(data, number, angle, distance):
    """7-Scenes stairs: three of four matches wrong, and a reference pose good to centimetres and degrees only."""
    path = data / "absolute_pose" / "stairs_points_lines" / f"localization_test_data_stairs_{number}.npz"
    scene = {k: torch.tensor(v.astype(float)) for k, v in np.load(path).items() if k in ("p2ds", "p3ds", "K", "R_gt", "t_gt")}
    centre = -scene["R_gt"].T @ scene["t_gt"]
    x, X, K = scene["p2ds"], scene["p3ds"], scene["K"]
    for threshold in (3.0, 6.0):
        known = estimate_camera(x, X, K, threshold=threshold, generator=seeded())
        matrix, R, t = krt_from_camera(estimate_camera_focal(x, X, K[:2, 2], threshold=threshold, generator=seeded()).model)
        assert (matrix[0, 0] / K[0, 0]).log().abs() < 0.07
        for turn, shift in ((known.model[:, :3], known.model[:, 3]), (R, t)):
            assert torch.rad2deg(rotation_angle(turn @ scene["R_gt"].T)) < angle
            assert (-turn.T @ shift - centre).norm() < distance
