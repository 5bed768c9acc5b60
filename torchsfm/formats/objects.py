"""Cameras and poses as other libraries hold them in memory: OpenCV, kornia, PyTorch3D, nerfstudio and pycolmap.

Each function has the direction in its name. None of these libraries is needed here but pycolmap, whose objects are made: the
others get arrays or tensors for the arguments of theirs. Where a library puts the centre of the top-left pixel at (0.5, 0.5),
the half pixel is added and taken away.
"""

import tempfile
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.formats.colmap import read_colmap, write_colmap
from torchsfm.geometry import (
    BrownConrady,
    Camera,
    KannalaBrandt,
    NoDistortion,
    Pose,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from torchsfm.reconstruction.reconstruction import Reconstruction

HALF_PIXEL = 0.5
OPENCV_LENS, FISHEYE_LENS = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
"""The order of OpenCV's coefficients."""
NERFSTUDIO_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")


def opencv_from_camera(pose: Pose, camera: Camera) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The arguments of `cv2.projectPoints`, or of `cv2.fisheye.projectPoints` for Kannala-Brandt distortion.

    Pixels are those of OpenCV already.

    Args:
        pose: Camera from world.
        camera: Its inside.

    Returns:
        Rotation vector, translation, K and distortion coefficients (k1, k2, p1, p2, k3), or of a fisheye (k1, k2, k3, k4), as
        double precision NumPy arrays with the batch dimensions in front.

    Raises:
        ValueError: The camera has skew, which OpenCV has not.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.formats import camera_from_opencv, opencv_from_camera
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])))
        >>> rvec, tvec, K, distortion = opencv_from_camera(torchsfm.Pose.identity(), camera)
        >>> tvec.tolist(), distortion.tolist()
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0])
        >>> pose, same = camera_from_opencv(*map(torch.from_numpy, (rvec, tvec, K, distortion)))
        >>> bool(same.K.allclose(camera.K.double()))
        True
    """
    _check_alike(pose, camera)
    _refuse_skew(camera, "OpenCV")
    order = FISHEYE_LENS if isinstance(camera.distortion, KannalaBrandt) else OPENCV_LENS
    numbers = _coefficients(camera, order)
    rows = (rotvec_from_rotation(pose.R), pose.t, camera.K, numbers)
    rvec, tvec, K, distortion = (row.detach().cpu().double().numpy() for row in rows)
    return rvec, tvec, K, distortion


def camera_from_opencv(
    rvec: Float[Tensor, "*batch 3"],
    tvec: Float[Tensor, "*batch 3"],
    K: Float[Tensor, "*batch 3 3"],
    distortion: Float[Tensor, "*batch k"] | None = None,
    *,
    fisheye: bool = False,
) -> tuple[Pose, Camera]:
    """Pose and camera from what OpenCV estimates or takes.

    Args:
        rvec: Rotation vector, camera from world.
        tvec: Translation.
        K: Intrinsics.
        distortion: Coefficients in OpenCV's order: four or five of (k1, k2, p1, p2, k3), or of a fisheye four; none if not
            given.
        fisheye: Whether they are those of `cv2.fisheye`.

    Raises:
        ValueError: There are more or fewer coefficients.

    Example:
        >>> import torch, torchsfm
        >>> rvec, tvec = torch.tensor([0.0, torch.pi / 2, 0.0]), torch.tensor([0.0, 0.0, 5.0])
        >>> K = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]])
        >>> pose, camera = torchsfm.formats.camera_from_opencv(rvec, tvec, K, torch.tensor([0.1, 0.0, 0.0, 0.0]))
        >>> pose.centre.round(decimals=4) + 0.0  # a quarter turn about y
        tensor([5., 0., 0.])
        >>> camera.distortion.k1
        tensor(0.1000)
    """
    check_tensors(rvec=(rvec, "3"), tvec=(tvec, "3"), K=(K, "3 3"), distortion=(distortion, "?k"))
    pose = Pose(rotation_from_rotvec(rvec), tvec)
    if distortion is None:
        return pose, Camera(K)
    count = distortion.shape[-1]
    allowed = (4,) if fisheye else (4, 5)
    if count not in allowed:
        wanted = " or ".join(map(str, allowed))
        raise ValueError(f"distortion: wanted {wanted} coefficients of {'a fisheye' if fisheye else 'OpenCV'}, got {count}")
    numbers = dict(zip(FISHEYE_LENS if fisheye else OPENCV_LENS, distortion.unbind(-1), strict=False))
    if fisheye:
        return pose, Camera(K, KannalaBrandt(**numbers))
    return pose, Camera(K, BrownConrady(**{"k3": torch.zeros_like(distortion[..., 0])} | numbers))


def kornia_from_camera(pose: Pose, camera: Camera, image_size: Int[Tensor, "*batch 2"]) -> dict[str, Tensor]:
    """The arguments of `kornia.geometry.camera.PinholeCamera`, whose pixels are as here.

    Args:
        pose: Camera from world, batch (b,).
        camera: Its inside, without distortion.
        image_size: Width and height in pixels.

    Raises:
        ValueError: The camera has distortion.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.formats import camera_from_kornia, kornia_from_camera
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor([800.0]), torch.tensor([[320.0, 240.0]])))
        >>> given = kornia_from_camera(torchsfm.Pose.identity(1), camera, torch.tensor([[641, 481]]))
        >>> given["intrinsics"].shape, given["height"]
        (torch.Size([1, 4, 4]), tensor([481.]))
        >>> pose, same = camera_from_kornia(given["intrinsics"], given["extrinsics"])
        >>> torch.equal(same.K, camera.K)
        True
    """
    _check_alike(pose, camera)
    _refuse_distortion(camera, "kornia's PinholeCamera")
    width, height = image_size.to(camera.K).unbind(-1)
    return {"intrinsics": _square(camera.K), "extrinsics": _square(pose.matrix()), "height": height, "width": width}


def camera_from_kornia(intrinsics: Float[Tensor, "*batch 4 4"], extrinsics: Float[Tensor, "*batch 4 4"]) -> tuple[Pose, Camera]:
    """Pose and camera from the matrices of a `PinholeCamera` of kornia.

    Args:
        intrinsics: K in pixels in the upper left 3x3.
        extrinsics: The motion from world to camera.

    Example:
        >>> import torch, torchsfm
        >>> K, T = torch.eye(4)[None].clone(), torch.eye(4)[None].clone()
        >>> K[:, :3, :3], T[:, 2, 3] = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])), 5.0
        >>> pose, camera = torchsfm.formats.camera_from_kornia(K, T)
        >>> camera.project(pose.transform(torch.zeros(1, 1, 3)))  # the origin, five ahead of the camera
        tensor([[[320., 240.]]])
    """
    check_tensors(intrinsics=(intrinsics, "4 4"), extrinsics=(extrinsics, "4 4"))
    return Pose(extrinsics[..., :3, :3], extrinsics[..., :3, 3]), Camera(intrinsics[..., :3, :3])


def pytorch3d_from_camera(pose: Pose, camera: Camera, image_size: Int[Tensor, "*batch 2"]) -> dict[str, Any]:
    """The arguments of PyTorch3D's `PerspectiveCameras`, in screen space.

    There x points to the left and y up, points are rows (`X_view = X R + T`), and the top-left corner of the image, not the
    centre of its first pixel, is (0, 0).

    Args:
        pose: Camera from world, batch (b,).
        camera: Its inside, without distortion and skew.
        image_size: Width and height in pixels.

    Raises:
        ValueError: The camera has distortion or skew.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.formats import camera_from_pytorch3d, pytorch3d_from_camera
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor([800.0]), torch.tensor([[320.0, 240.0]])))
        >>> given = pytorch3d_from_camera(torchsfm.Pose.identity(1), camera, torch.tensor([[641, 481]]))
        >>> given["principal_point"], given["R"].diagonal(dim1=-2, dim2=-1)
        (tensor([[320.5000, 240.5000]]), tensor([[-1., -1.,  1.]]))
        >>> arguments = (given[name] for name in ("R", "T", "focal_length", "principal_point"))
        >>> torch.equal(camera_from_pytorch3d(*arguments)[1].K, camera.K)
        True
    """
    _check_alike(pose, camera)
    _refuse_distortion(camera, "PyTorch3D's PerspectiveCameras")
    _refuse_skew(camera, "PyTorch3D")
    flip = _flip(pose.R)
    return {
        "R": (flip @ pose.R).mT,
        "T": pose.t * flip.diagonal(dim1=-2, dim2=-1),
        "focal_length": camera.K.diagonal(dim1=-2, dim2=-1)[..., :2],
        "principal_point": camera.K[..., :2, 2] + HALF_PIXEL,
        "image_size": image_size.flip(-1),
        "in_ndc": False,
    }


def camera_from_pytorch3d(
    R: Float[Tensor, "*batch 3 3"],
    T: Float[Tensor, "*batch 3"],
    focal_length: Float[Tensor, "*batch 2"],
    principal_point: Float[Tensor, "*batch 2"],
) -> tuple[Pose, Camera]:
    """Pose and camera from the arguments of PyTorch3D's `PerspectiveCameras(in_ndc=False)`.

    Args:
        R: Rotations as PyTorch3D holds them: rows times R, axes left, up, forward.
        T: Translations along the same axes.
        focal_length: Along x and y, in pixels.
        principal_point: In pixels, the corner of the image at (0, 0).

    Example:
        >>> import torch, torchsfm
        >>> focal, middle = torch.tensor([[800.0, 800.0]]), torch.tensor([[320.5, 240.5]])
        >>> T = torch.tensor([[1.0, 0.0, 5.0]])  # x points to the left there
        >>> pose, camera = torchsfm.formats.camera_from_pytorch3d(torch.eye(3)[None], T, focal, middle)
        >>> camera.project(pose.transform(torch.zeros(1, 1, 3)))  # and a pixel's centre is half a pixel from its corner
        tensor([[[160., 240.]]])
    """
    check_tensors(R=(R, "3 3"), T=(T, "3"), focal_length=(focal_length, "2"), principal_point=(principal_point, "2"))
    flip = _flip(R)
    return Pose(flip @ R.mT, T * flip.diagonal(dim1=-2, dim2=-1)), Camera(_matrix(focal_length, principal_point - HALF_PIXEL))


def nerfstudio_from_camera(pose: Pose, camera: Camera) -> dict[str, Tensor]:
    """The arguments of nerfstudio's `Cameras`: world from camera with OpenGL's axes, and the lens.

    The camera type is `PERSPECTIVE`, or `FISHEYE` for Kannala-Brandt distortion.

    Args:
        pose: Camera from world.
        camera: Its inside.

    Raises:
        ValueError: The camera has skew, or distortion with other numbers than nerfstudio's.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.formats import camera_from_nerfstudio, nerfstudio_from_camera
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor([800.0]), torch.tensor([[320.0, 240.0]])))
        >>> given = nerfstudio_from_camera(torchsfm.Pose.identity(1), camera)
        >>> given["cx"], given["camera_to_worlds"][0, :, :3].diagonal()
        (tensor([320.5000]), tensor([ 1., -1., -1.]))
        >>> pose, same = camera_from_nerfstudio(**given)
        >>> torch.equal(same.K, camera.K)
        True
    """
    _check_alike(pose, camera)
    _refuse_skew(camera, "nerfstudio")
    inverse = pose.inverse()
    axes = inverse.R * inverse.R.new_tensor([1.0, -1.0, -1.0])
    (fx, fy, _), centre = camera.K.diagonal(dim1=-2, dim2=-1).unbind(-1), camera.K[..., :2, 2] + HALF_PIXEL
    return {
        "camera_to_worlds": torch.cat((axes, inverse.t[..., None]), -1), "fx": fx, "fy": fy, "cx": centre[..., 0],
        "cy": centre[..., 1], "distortion_params": _coefficients(camera, NERFSTUDIO_LENS),
    }  # fmt: skip


def camera_from_nerfstudio(
    camera_to_worlds: Float[Tensor, "*batch 3 4"],
    fx: Float[Tensor, "*batch"],
    fy: Float[Tensor, "*batch"],
    cx: Float[Tensor, "*batch"],
    cy: Float[Tensor, "*batch"],
    distortion_params: Float[Tensor, "*batch 6"] | None = None,
    *,
    fisheye: bool = False,
) -> tuple[Pose, Camera]:
    """Pose and camera from the members of nerfstudio's `Cameras`.

    Args:
        camera_to_worlds: World from camera, with OpenGL's axes.
        fx: Focal lengths, pixels.
        fy: Along y.
        cx: Principal points, pixels from the corner of the image.
        cy: Along y.
        distortion_params: Coefficients (k1, k2, k3, k4, p1, p2); none if not given.
        fisheye: Whether the cameras are fisheyes, of which k1 to k4 count; of others k1 to k3, p1 and p2.

    Example:
        >>> import torch, torchsfm
        >>> back = torch.eye(4)[None, :3].clone()
        >>> back[:, 2, 3] = 5.0  # five from the origin along z; cameras look along -z there
        >>> lens = {name: torch.tensor([value]) for name, value in {"fx": 800.0, "fy": 800.0, "cx": 320.5, "cy": 240.5}.items()}
        >>> pose, camera = torchsfm.formats.camera_from_nerfstudio(camera_to_worlds=back, **lens)
        >>> camera.project(pose.transform(torch.zeros(1, 1, 3)))
        tensor([[[320., 240.]]])
    """
    check_tensors(camera_to_worlds=(camera_to_worlds, "3 4"), distortion_params=(distortion_params, "?6"))
    R = (camera_to_worlds[..., :3] * camera_to_worlds.new_tensor([1.0, -1.0, -1.0])).mT
    pose = Pose(R, -(R @ camera_to_worlds[..., 3:])[..., 0])
    K = _matrix(torch.stack((fx, fy), -1), torch.stack((cx, cy), -1) - HALF_PIXEL)
    if distortion_params is None:
        return pose, Camera(K)
    numbers = dict(zip(NERFSTUDIO_LENS, distortion_params.unbind(-1), strict=True))
    kind = KannalaBrandt if fisheye else BrownConrady
    return pose, Camera(K, kind(**{name: numbers[name] for name in kind.parameter_names}))


def pycolmap_from_model(model: Reconstruction) -> Any:
    """The model as a `pycolmap.Reconstruction`.

    Args:
        model: Cameras, poses, points and tracks.

    Raises:
        ImportError: pycolmap is not installed.
        ValueError: COLMAP has no such cameras.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> same = torchsfm.formats.model_from_pycolmap(torchsfm.formats.pycolmap_from_model(model))
        >>> same.num_points, bool(same.X.allclose(model.X))
        (20, True)
    """
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        write_colmap(model, folder)
        return pycolmap.Reconstruction(folder)


def model_from_pycolmap(reconstruction: Any) -> Reconstruction:
    """The model that a `pycolmap.Reconstruction` holds.

    Args:
        reconstruction: The `pycolmap.Reconstruction`.

    Raises:
        ValueError: It has cameras that have no equal here.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> import pycolmap
        >>> torchsfm.write_colmap(torchsfm.read_model("model.npz"), "sparse")
        >>> torchsfm.formats.model_from_pycolmap(pycolmap.Reconstruction("sparse")).num_registered
        3
    """
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write(folder)
        return read_colmap(Path(folder))


def _check_alike(pose: Pose, camera: Camera) -> None:
    """See that there is a camera for each pose."""
    if pose.R.shape[:-2] != camera.shape:
        raise ValueError(f"camera: wanted batch dimensions {tuple(pose.R.shape[:-2])} as pose has, got {tuple(camera.shape)}")


def _refuse_skew(camera: Camera, library: str) -> None:
    if bool((camera.K[..., 0, 1] != 0).any()):
        raise ValueError(f"camera: wanted no skew, which {library} has not, got {float(camera.K[..., 0, 1].abs().max()):g}")


def _refuse_distortion(camera: Camera, library: str) -> None:
    if not isinstance(camera.distortion, NoDistortion):
        kind = type(camera.distortion).__name__
        raise ValueError(f"camera: wanted no distortion, which {library} has not, got {kind}; undistort the images")


def _coefficients(camera: Camera, order: tuple[str, ...]) -> Float[Tensor, "*batch k"]:
    """The numbers of a lens in another order, zero where it has none of the name.

    Raises:
        ValueError: It has others.
    """
    lens = camera.distortion
    if more := [name for name in lens.parameter_names if name not in order]:
        raise ValueError(f"camera: wanted a lens with the numbers {', '.join(order)}, got {', '.join(more)}")
    zero = torch.zeros_like(camera.K[..., 0, 0])
    return torch.stack([getattr(lens, name) if name in lens.parameter_names else zero for name in order], -1)


def _square(matrix: Float[Tensor, "*batch r c"]) -> Float[Tensor, "*batch 4 4"]:
    """The matrix in the upper left of a unit matrix."""
    rows, columns = matrix.shape[-2:]
    whole = torch.eye(4, dtype=matrix.dtype, device=matrix.device).repeat(*matrix.shape[:-2], 1, 1)
    whole[..., :rows, :columns] = matrix
    return whole


def _matrix(f: Float[Tensor, "*batch 2"], c: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Intrinsics from two focal lengths and the principal point."""
    top = torch.cat((torch.diag_embed(f), c[..., None]), -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 2] = 1
    return torch.cat((top, bottom), -2)


def _flip(like: Tensor) -> Float[Tensor, "3 3"]:
    """Half a turn about the z axis."""
    return torch.diag(like.new_tensor([-1.0, -1.0, 1.0]))
