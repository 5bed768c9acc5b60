"""The arguments of PyTorch3D's `PerspectiveCameras`."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.formats.objects.camera_numbers import HALF_PIXEL, check_alike, intrinsic_matrix, refuse_distortion, refuse_skew
from torchsfm.geometry import Camera, Pose


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
    check_alike(pose, camera)
    refuse_distortion(camera, "PyTorch3D's PerspectiveCameras")
    refuse_skew(camera, "PyTorch3D")
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
    return Pose(flip @ R.mT, T * flip.diagonal(dim1=-2, dim2=-1)), Camera(
        intrinsic_matrix(focal_length, principal_point - HALF_PIXEL)
    )


def _flip(like: Tensor) -> Float[Tensor, "3 3"]:
    """Half a turn about the z axis."""
    return torch.diag(like.new_tensor([-1.0, -1.0, 1.0]))
