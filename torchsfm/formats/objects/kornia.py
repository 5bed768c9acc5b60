"""The arguments of kornia's `PinholeCamera`."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.formats.objects.camera_numbers import check_alike, refuse_distortion
from torchsfm.geometry import Camera, Pose


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
    check_alike(pose, camera)
    refuse_distortion(camera, "kornia's PinholeCamera")
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


def _square(matrix: Float[Tensor, "*batch r c"]) -> Float[Tensor, "*batch 4 4"]:
    """The matrix in the upper left of a unit matrix."""
    rows, columns = matrix.shape[-2:]
    whole = torch.eye(4, dtype=matrix.dtype, device=matrix.device).repeat(*matrix.shape[:-2], 1, 1)
    whole[..., :rows, :columns] = matrix
    return whole
