"""What `cv2.projectPoints` and `cv2.fisheye.projectPoints` take."""

from typing import Any

import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.formats.objects.camera_numbers import check_alike, coefficients, refuse_skew
from torchsfm.geometry import BrownConrady, Camera, KannalaBrandt, Pose, rotation_from_rotvec, rotvec_from_rotation

LENS, FISHEYE_LENS = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
"""The order of OpenCV's coefficients."""


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
    check_alike(pose, camera)
    refuse_skew(camera, "OpenCV")
    order = FISHEYE_LENS if isinstance(camera.distortion, KannalaBrandt) else LENS
    numbers = coefficients(camera, order)
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
    numbers = dict(zip(FISHEYE_LENS if fisheye else LENS, distortion.unbind(-1), strict=False))
    if fisheye:
        return pose, Camera(K, KannalaBrandt(**numbers))
    return pose, Camera(K, BrownConrady(**{"k3": torch.zeros_like(distortion[..., 0])} | numbers))
