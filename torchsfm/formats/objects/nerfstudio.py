"""The arguments of nerfstudio's `Cameras`."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.formats.objects.camera_numbers import HALF_PIXEL, check_alike, coefficients, intrinsic_matrix, refuse_skew
from torchsfm.geometry import BrownConrady, Camera, KannalaBrandt, Pose

LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""The order of its coefficients."""


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
    check_alike(pose, camera)
    refuse_skew(camera, "nerfstudio")
    inverse = pose.inverse()
    axes = inverse.R * inverse.R.new_tensor([1.0, -1.0, -1.0])
    (fx, fy, _), centre = camera.K.diagonal(dim1=-2, dim2=-1).unbind(-1), camera.K[..., :2, 2] + HALF_PIXEL
    return {
        "camera_to_worlds": torch.cat((axes, inverse.t[..., None]), -1), "fx": fx, "fy": fy, "cx": centre[..., 0],
        "cy": centre[..., 1], "distortion_params": coefficients(camera, LENS),
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
    K = intrinsic_matrix(torch.stack((fx, fy), -1), torch.stack((cx, cy), -1) - HALF_PIXEL)
    if distortion_params is None:
        return pose, Camera(K)
    numbers = dict(zip(LENS, distortion_params.unbind(-1), strict=True))
    kind = KannalaBrandt if fisheye else BrownConrady
    return pose, Camera(K, kind(**{name: numbers[name] for name in kind.parameter_names}))
