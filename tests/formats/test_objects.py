"""Cameras and poses as other libraries hold them, by what these project."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from small_model import make

from torchsfm.formats import (
    camera_from_kornia,
    camera_from_nerfstudio,
    camera_from_opencv,
    camera_from_pytorch3d,
    kornia_from_camera,
    model_from_pycolmap,
    nerfstudio_from_camera,
    opencv_from_camera,
    pycolmap_from_model,
    pytorch3d_from_camera,
)
from torchsfm.geometry import DISTORTION_MODELS, Camera, Pose, random_rotation

F64 = torch.float64
COUNT = 20
SIZE = torch.tensor([[800, 600]] * COUNT)


def views(lens: str, generator: torch.Generator) -> tuple[Pose, Camera, torch.Tensor]:
    """Cameras with two focal lengths each, and points in front of each."""
    R = random_rotation(COUNT, generator=generator, dtype=F64)
    t = torch.randn(COUNT, 3, generator=generator, dtype=F64)
    pose = Pose(R, t)
    K = torch.eye(3, dtype=F64).repeat(COUNT, 1, 1)
    K[:, 0, 0], K[:, 1, 1] = (800 + 200 * torch.rand(2, COUNT, generator=generator, dtype=F64)).unbind(0)
    K[:, :2, 2] = torch.tensor([399.5, 299.5]) + 20 * torch.randn(COUNT, 2, generator=generator, dtype=F64)
    kind = DISTORTION_MODELS[lens]
    numbers = 0.02 * torch.randn(COUNT, kind.num_parameters, generator=generator, dtype=F64)
    X_cam = torch.randn(COUNT, 30, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0.0, 6.0], dtype=F64)
    return pose, Camera(K, kind.from_parameters(numbers)), pose.inverse().transform(X_cam)


def same(found: tuple[Pose, Camera], pose: Pose, camera: Camera, X: torch.Tensor) -> None:
    """Both show the points at the same places."""
    back, inside = found
    torch.testing.assert_close(inside.project(back.transform(X)), camera.project(pose.transform(X)), rtol=0, atol=1e-8)


@pytest.mark.parametrize("lens", list(DISTORTION_MODELS))
def test_opencv(lens: str, generator: torch.Generator) -> None:
    cv2 = pytest.importorskip("cv2")
    pose, camera, X = views(lens, generator)
    given = opencv_from_camera(pose, camera)
    fisheye = lens == "kannala_brandt" or len(given[3][0]) == 4
    project: Callable[..., tuple[np.ndarray, np.ndarray]] = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    expected = camera.project(pose.transform(X))
    for i in range(COUNT):
        points = X[i, :, None].numpy()
        x, _ = project(points, *(row[i] for row in given))
        np.testing.assert_allclose(x[:, 0], expected[i].numpy(), rtol=0, atol=1e-6)
    same(camera_from_opencv(*map(torch.from_numpy, given), fisheye=fisheye), pose, camera, X)
    plain = camera_from_opencv(*map(torch.from_numpy, given[:3]))
    assert torch.equal(plain[1].K, camera.K)


def test_kornia(generator: torch.Generator) -> None:
    pinholes = pytest.importorskip("kornia.geometry.camera")
    pose, camera, X = views("pinhole", generator)
    given = kornia_from_camera(pose, camera, SIZE)
    theirs = pinholes.PinholeCamera(**given)
    torch.testing.assert_close(theirs.project(X), camera.project(pose.transform(X)), rtol=0, atol=1e-6)
    same(camera_from_kornia(given["intrinsics"], given["extrinsics"]), pose, camera, X)


def test_pytorch3d(generator: torch.Generator) -> None:
    """Against the formulas of its documentation: rows, x to the left and y up, the image's corner at (0, 0)."""
    pose, camera, X = views("pinhole", generator)
    given = pytorch3d_from_camera(pose, camera, SIZE)
    assert given["in_ndc"] is False
    assert given["image_size"].tolist() == [[600, 800]] * COUNT
    view = X @ given["R"] + given["T"][:, None]
    # Normalised: the shorter side goes from -1 to 1, x to the left; then the screen, to the right and down.
    half = given["image_size"].min(-1).values.double()[:, None] / 2
    height, width = given["image_size"].double().unbind(-1)
    centre = torch.stack((width, height), -1) / 2
    f, p = given["focal_length"] / half, -(given["principal_point"] - centre) / half
    ndc = f[:, None] * view[..., :2] / view[..., 2:] + p[:, None]
    screen = centre[:, None] - half[:, None] * ndc
    torch.testing.assert_close(screen - 0.5, camera.project(pose.transform(X)), rtol=0, atol=1e-8)
    back = camera_from_pytorch3d(*(given[name] for name in ("R", "T", "focal_length", "principal_point")))
    same(back, pose, camera, X)


@pytest.mark.parametrize("lens", list(DISTORTION_MODELS))
def test_nerfstudio(lens: str, generator: torch.Generator) -> None:
    """Against the formulas of its documentation: OpenGL's axes, pixel centres at halves, six numbers of a lens."""
    pose, camera, X = views(lens, generator)
    given = nerfstudio_from_camera(pose, camera)
    R, centre = given["camera_to_worlds"][..., :3], given["camera_to_worlds"][..., 3]
    view = (X - centre[:, None]) @ R  # x to the right, y up, z backwards
    u = torch.stack((view[..., 0], -view[..., 1]), -1) / -view[..., 2:]
    k1, k2, k3, k4, p1, p2 = given["distortion_params"][:, None].unbind(-1)
    r2 = u.square().sum(-1)
    if lens in ("kannala_brandt", "fisheye"):
        r = r2.sqrt()
        theta = r.atan()
        theta2 = theta.square()
        u = u * (theta * (1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))) / r)[..., None]
    else:
        x, y = u.unbind(-1)
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = torch.stack(
            (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)), -1
        )
    pixels = u * torch.stack((given["fx"], given["fy"]), -1)[:, None] + torch.stack((given["cx"], given["cy"]), -1)[:, None]
    torch.testing.assert_close(pixels - 0.5, camera.project(pose.transform(X)), rtol=0, atol=1e-8)
    same(camera_from_nerfstudio(**given, fisheye=lens in ("kannala_brandt", "fisheye")), pose, camera, X)


@pytest.mark.parametrize("lens", list(DISTORTION_MODELS))
def test_pycolmap(lens: str) -> None:
    pytest.importorskip("pycolmap")
    model = make(lens)
    theirs = pycolmap_from_model(model)
    expected = model.projections()
    points = {name: image for image in theirs.images.values() for name in [image.name]}
    for i in range(3):
        image = points[model.names[i]]
        rows = (model.view == i).nonzero()[:, 0]
        X = model.X[model.point[rows]].numpy()
        seen = image.cam_from_world() * X if callable(image.cam_from_world) else image.cam_from_world * X
        x = theirs.cameras[image.camera_id].img_from_cam(seen)
        np.testing.assert_allclose(np.asarray(x) - 0.5, expected[rows].numpy(), rtol=0, atol=1e-6)
    back = model_from_pycolmap(theirs)
    assert back.num_points == model.num_points
    torch.testing.assert_close(back.residuals().sort().values, model.residuals().sort().values, rtol=0, atol=1e-4)


def test_what_others_cannot_hold_is_refused(generator: torch.Generator) -> None:
    pose, camera, _ = views("pinhole", generator)
    K = camera.K.clone()
    K[:, 0, 1] = 3.0
    skewed = Camera(K)
    for convert in (opencv_from_camera, nerfstudio_from_camera):
        with pytest.raises(ValueError, match="skew"):
            convert(pose, skewed)
        with pytest.raises(ValueError, match="batch dimensions"):
            convert(pose[:3], camera)
    with pytest.raises(ValueError, match="skew"):
        pytorch3d_from_camera(pose, skewed, SIZE)
    _, bent, _ = views("radial", generator)
    for convert_sized in (kornia_from_camera, pytorch3d_from_camera):
        with pytest.raises(ValueError, match="distortion"):
            convert_sized(pose, bent, SIZE)
        idle = type(bent.distortion).from_parameters(torch.zeros_like(bent.distortion.parameters()))
        assert convert_sized(pose, Camera(camera.K, idle), SIZE).keys() == convert_sized(pose, camera, SIZE).keys()
    with pytest.raises(ValueError, match="4 or 5 coefficients"):
        camera_from_opencv(pose.t, pose.t, K, torch.zeros(COUNT, 8, dtype=F64))
