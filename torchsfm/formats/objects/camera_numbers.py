"""What cameras of other libraries can hold of ours, and K of their numbers."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.formats.joining import cameras_within
from torchsfm.geometry import Camera, NoDistortion, Pose

HALF_PIXEL = 0.5


def check_alike(pose: Pose, camera: Camera) -> None:
    """See that there is a camera for each pose.

    Raises:
        ValueError: There are more or fewer.
    """
    if pose.R.shape[:-2] != camera.shape:
        raise ValueError(f"camera: wanted batch dimensions {tuple(pose.R.shape[:-2])} as pose has, got {tuple(camera.shape)}")


def refuse_skew(camera: Camera, library: str) -> None:
    """See that there is none.

    Raises:
        ValueError: There is.
    """
    if bool((camera.K[..., 0, 1] != 0).any()):
        raise ValueError(f"camera: wanted no skew, which {library} has not, got {float(camera.K[..., 0, 1].abs().max()):g}")


def refuse_distortion(camera: Camera, library: str) -> None:
    """See that there is none.

    Raises:
        ValueError: There is.
    """
    if cameras_within(camera, NoDistortion) is None:
        kind = type(camera.distortion).__name__
        raise ValueError(f"camera: wanted no distortion, which {library} has not, got {kind}; undistort the images")


def coefficients(camera: Camera, order: tuple[str, ...]) -> Float[Tensor, "*batch k"]:
    """The numbers of a lens in another order, zero where it has none of the name.

    Raises:
        ValueError: It has others.
    """
    lens = camera.distortion
    if more := [name for name in lens.parameter_names if name not in order]:
        raise ValueError(f"camera: wanted a lens with the numbers {', '.join(order)}, got {', '.join(more)}")
    zero = torch.zeros_like(camera.K[..., 0, 0])
    return torch.stack([getattr(lens, name) if name in lens.parameter_names else zero for name in order], -1)


def intrinsic_matrix(f: Float[Tensor, "*batch 2"], c: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Intrinsics from two focal lengths and the principal point."""
    top = torch.cat((torch.diag_embed(f), c[..., None]), -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 2] = 1
    return torch.cat((top, bottom), -2)
