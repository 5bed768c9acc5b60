import math

import pytest
import torch
from chance import seeded
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsfm._types import tensor_map
from torchsfm.geometry import (
    BrownConrady,
    Camera,
    KannalaBrandt,
    NoDistortion,
    Pose,
    Radial,
    camera_centre,
    camera_from_krt,
    intrinsics,
    krt_from_camera,
    point_depths,
    project_points,
    random_rotation,
)

F64 = torch.float64


def make(*shape, generator):
    f = 500 + 1000 * torch.rand(shape, generator=generator, dtype=F64)
    c = 300 + 100 * torch.rand((*shape, 2), generator=generator, dtype=F64)
    aspect = 0.8 + 0.4 * torch.rand(shape, generator=generator, dtype=F64)
    skew = torch.randn(shape, generator=generator, dtype=F64)
    t = torch.randn((*shape, 3), generator=generator, dtype=F64)
    return intrinsics(f, c, aspect, skew), random_rotation(*shape, generator=generator, dtype=F64), t


def test_intrinsics_by_hand():
    K = intrinsics(torch.tensor(2.0), torch.tensor([3.0, 4.0]), aspect=1.5, skew=0.25)
    assert K.tolist() == [[2, 0.25, 3], [0, 3, 4], [0, 0, 1]]
    assert intrinsics(torch.ones(5, 1), torch.zeros(4, 2)).shape == (5, 4, 3, 3)
    assert intrinsics(torch.tensor(1.0), torch.zeros(2), torch.ones(3)).shape == (3, 3, 3)


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 2**31), st.floats(-1e3, 1e3).filter(lambda x: abs(x) > 1e-3))
def test_krt_comes_back_from_any_multiple_of_the_camera(seed, factor):
    K, R, t = make(6, generator=seeded(seed))
    P = factor * camera_from_krt(K, R, t)
    K2, R2, t2 = krt_from_camera(P)
    torch.testing.assert_close(K2, K, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(R2, R, rtol=0, atol=1e-12)
    torch.testing.assert_close(t2, t, rtol=1e-10, atol=1e-11)
    centre = camera_centre(P)
    torch.testing.assert_close(centre, Pose(R, t).centre, rtol=1e-9, atol=1e-10)
    homogeneous = camera_centre(P, homogeneous=True)
    torch.testing.assert_close(
        (P / abs(factor) @ homogeneous[..., None]).squeeze(-1), torch.zeros(6, 3, dtype=F64), atol=1e-9, rtol=0
    )
    torch.testing.assert_close(homogeneous.norm(dim=-1), torch.ones(6, dtype=F64))


def test_krt_of_any_regular_matrix(generator):
    P = torch.randn(500, 3, 4, generator=generator, dtype=F64)
    K, R, t = krt_from_camera(P)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(500, dtype=F64))
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=F64).expand(500, 3, 3), atol=1e-13, rtol=0)
    assert (K.diagonal(dim1=-2, dim2=-1) > 0).all()
    assert (K[:, 2, 2] == 1).all()
    again = camera_from_krt(K, R, t)
    scale = (P * again).sum((-2, -1)) / again.square().sum((-2, -1))
    torch.testing.assert_close(scale[:, None, None] * again, P, rtol=1e-8, atol=1e-8)


def test_krt_gradients(generator):
    K, R, t = make(3, generator=generator)
    P = (-2 * camera_from_krt(K, R, t) / 1000).requires_grad_()
    assert torch.autograd.gradcheck(krt_from_camera, P)
    assert torch.autograd.gradcheck(camera_centre, P)
    assert torch.autograd.gradcheck(lambda P: camera_centre(P, homogeneous=True), P)


def test_cameras_without_decomposition_stay_finite_and_alone(generator):
    K, R, t = make(generator=generator)
    good = camera_from_krt(K, R, t)
    affine = torch.tensor([[1.0, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]], dtype=F64)
    P = torch.stack([good, affine, torch.zeros(3, 4, dtype=F64), torch.full((3, 4), math.nan, dtype=F64)]).requires_grad_()
    results = krt_from_camera(P)
    for result, alone in zip(results, krt_from_camera(good), strict=True):
        assert result.isfinite().all()
        assert result[0].equal(alone)
    assert results[0][1].equal(torch.eye(3, dtype=F64))
    sum(result.sum() for result in results).backward()
    assert P.grad.isfinite().all()
    centre = camera_centre(affine, homogeneous=True)
    assert centre.abs().tolist() == [0, 0, 1, 0]
    assert camera_centre(P[:3]).isfinite().all()
    assert camera_centre(affine)[2].abs() > 1e15


@pytest.mark.parametrize("shapes", [((), ()), ((4,), ()), ((2, 1), (3,)), ((0,), ())])
def test_project_points_and_depths(shapes, generator):
    K, R, t = make(*shapes[0], generator=generator)
    X = torch.randn(*shapes[1], 7, 3, generator=generator, dtype=F64)
    X_cam = Pose(R, t).transform(X)
    factor = -0.01
    P = factor * camera_from_krt(K, R, t)
    torch.testing.assert_close(point_depths(P, X), X_cam[..., 2])
    x = project_points(P, X)
    assert x.shape == (*torch.broadcast_shapes(*shapes), 7, 2)
    torch.testing.assert_close(x, Camera(K).project(X_cam), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_project_points_is_finite_always(dtype):
    P = torch.eye(3, 4, dtype=dtype).requires_grad_()
    rows = [[1, 2, 0], [0, 0, 0], [1, 2, -4], [math.nan, 0, 1], [math.inf, 0, 1], [1, -2, 1e-30], [1, 2, 4]]
    X = torch.tensor(rows, dtype=dtype, requires_grad=True)
    x = project_points(P, X)
    assert x.isfinite().all()
    assert x[0, 0] > 0.1 / torch.finfo(dtype).eps
    assert x[5, 1] < -0.1 / torch.finfo(dtype).eps
    assert x[2].tolist() == [-0.25, -0.5]
    assert x[6].tolist() == [0.25, 0.5]
    x.sum().backward()
    assert X.grad.isfinite().all()
    assert P.grad.isfinite().all()


def test_depth_of_cameras_at_infinity_is_zero():
    affine = torch.tensor([[1.0, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
    assert (point_depths(affine, torch.ones(4, 3)) == 0).all()


@pytest.mark.parametrize("shape", [(), (2, 3), (0,)])
def test_camera_projects_and_unprojects(shape, generator):
    K, _, _ = make(*shape, generator=generator)
    p = torch.tensor([-0.2, 0.05, 0.001, -0.002, 0.01], dtype=F64).expand(*shape, 5)
    camera = Camera(K, BrownConrady.from_parameters(p))
    d = torch.randn(*shape, 20, 3, generator=generator, dtype=F64) * 0.2
    d[..., 2] = 1
    x = camera.project(d * 3)
    found, valid = camera.unproject(x)
    assert valid.all()
    assert camera.in_domain(d).all()
    torch.testing.assert_close(found, d, rtol=0, atol=1e-12)
    u = camera.distortion.project(d)
    torch.testing.assert_close(x, (torch.nn.functional.pad(u, (0, 1), value=1.0) @ K.mT)[..., :2])


def test_cameras_are_gathered_by_index(generator):
    K, _, _ = make(3, generator=generator)
    k = 0.1 * torch.randn(3, 2, generator=generator, dtype=F64)
    cameras = Camera(K, Radial.from_parameters(k))
    index = torch.tensor([2, 0, 2, 1])
    gathered = cameras[index]
    assert gathered.shape == (4,)
    X = torch.randn(4, 5, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0.0, 5.0], dtype=F64)
    for i, camera in enumerate(index.tolist()):
        assert gathered.project(X)[i].equal(cameras[camera].project(X[i]))
    assert Camera(K)[index].project(X).shape == (4, 5, 2)
    assert Camera(K)[1:].shape == (2,)
    half = tensor_map(lambda tensor: tensor.float(), cameras)
    assert half.K.dtype == half.distortion.k2.dtype == torch.float32


def test_cameras_are_stacked_and_project_points_from_poses(generator):
    def make(lens):
        K = intrinsics(torch.rand(4, generator=generator, dtype=torch.float64) + 1, torch.zeros(2, dtype=torch.float64))
        return Camera(K, lens(*(0.01 * torch.randn(4, generator=generator, dtype=torch.float64) for _ in lens.parameter_names)))

    for lens in (NoDistortion, BrownConrady):
        cameras = [make(lens) for _ in range(3)]
        stacked = Camera.stack(cameras)
        assert stacked.shape == (3, 4)
        pose = Pose(
            random_rotation(3, 4, generator=generator, dtype=torch.float64),
            torch.tensor([0, 0, 5], dtype=torch.float64).expand(3, 4, 3),
        )
        X = torch.randn(10, 3, generator=generator, dtype=torch.float64)
        x = project_points(pose, X, stacked)
        for i, camera in enumerate(cameras):
            torch.testing.assert_close(x[i], camera.project(pose[i].transform(X)))
        torch.testing.assert_close(project_points(pose.matrix(), X, stacked), x)
        single = project_points(pose.to(dtype=torch.float32), X.float(), stacked.to(dtype=torch.float32))
        torch.testing.assert_close(single.double(), x, rtol=1e-3, atol=1e-3)
        if lens is NoDistortion:
            torch.testing.assert_close(project_points(stacked.K @ pose.matrix(), X), x)
    torch.testing.assert_close(project_points(pose, X), project_points(pose.matrix(), X))
    with pytest.raises(ValueError, match=r"cameras\[1\]: wanted distortion BrownConrady"):
        Camera.stack([cameras[0], make(NoDistortion)])


def test_degenerate_intrinsics_and_pixels_are_masked(generator):
    K, _, _ = make(4, generator=generator)
    K[1, 0, 0] = 0
    K[2, 1, 1] = math.nan
    K[3, 0, 2] = math.inf
    K.requires_grad_()
    k = torch.full((4,), -0.1, dtype=F64)
    x = torch.full((4, 3, 2), 310.0, dtype=F64)
    x[:, 1] = math.nan
    x.requires_grad_()
    camera = Camera(K, Radial(k, k))
    d, valid = camera.unproject(x)
    assert valid.tolist() == [[True, False, True]] + [[False] * 3] * 3
    assert d.isfinite().all()
    assert d[0].equal(Camera(K[0], Radial(k[0], k[0])).unproject(x[0])[0])
    d.sum().backward()
    assert x.grad.isfinite().all()
    assert K.grad.isfinite().all()


def test_camera_gradients(generator):
    K, _, _ = make(generator=generator)
    p = torch.tensor([-0.02, 0.008, -0.006, 0.001], dtype=F64, requires_grad=True)
    K = (K / 1000).requires_grad_()
    d = torch.randn(6, 3, generator=generator, dtype=F64) * 0.5
    d[:, 2] = 1
    x = Camera(K, KannalaBrandt.from_parameters(p)).project(d).detach().requires_grad_()

    def unproject(x, K, p):
        upper = K * torch.ones(3, 3, dtype=F64).triu()
        return Camera(upper, KannalaBrandt.from_parameters(p)).unproject(x)[0]

    assert torch.autograd.gradcheck(unproject, (x, K, p))
    assert torch.autograd.gradcheck(
        lambda d, K, p: Camera(K, KannalaBrandt.from_parameters(p)).project(d), (d.requires_grad_(), K, p)
    )


@pytest.mark.reference
def test_opencv_decomposes_and_projects_alike(generator):
    cv2 = pytest.importorskip("cv2")
    K, R, t = make(5, generator=generator)
    P = camera_from_krt(K, R, t)
    for one, K1, R1, t1 in zip(P, *krt_from_camera(P), strict=True):
        K2, R2, centre = cv2.decomposeProjectionMatrix(one.numpy())[:3]
        torch.testing.assert_close(K1, torch.from_numpy(K2 / K2[2, 2]))
        torch.testing.assert_close(R1, torch.from_numpy(R2))
        torch.testing.assert_close(Pose(R1, t1).centre, torch.from_numpy(centre[:3, 0] / centre[3, 0]))


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_are_named():
    K = torch.eye(3).expand(4, 3, 3)
    with pytest.raises(ValueError, match="K: wanted shape"):
        Camera(torch.eye(4))
    with pytest.raises(ValueError, match=r"distortion.k1: wanted shape \(4,\)"):
        Camera(K, Radial(torch.tensor(0.0), torch.tensor(0.0)))
    with pytest.raises(ValueError, match="dtype"):
        Camera(K, Radial(torch.zeros(4, dtype=F64), torch.zeros(4, dtype=F64)))
    with pytest.raises(ValueError, match="batch dimensions do not broadcast"):
        project_points(torch.zeros(3, 3, 4), torch.zeros(2, 5, 3))
    with pytest.raises(ValueError, match="X: wanted shape"):
        project_points(torch.zeros(3, 4), torch.zeros(5, 2))
    with pytest.raises(ValueError, match="x: wanted shape"):
        Camera(K).unproject(torch.zeros(5, 3))
