"""The numbers inside a camera by the names users know, for all that estimates, frees or holds them.

A camera is a row `(f, aspect, skew, cx, cy, distortion...)`, so that "focal" is one number. Rows move in one of two ways:

- additive: by what is added to each number, in its own unit;
- relative: focal length and aspect by their logarithms and the skew in focal lengths, so that it follows them; the others as
  before. Steps then mean the same for all cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.cameras import Camera
from torchsfm.geometry.distortion_model import Distortion


@dataclass(frozen=True)
class Intrinsic:
    """What a name of `INTRINSICS` stands for."""

    columns: tuple[int, ...]
    """Its numbers in the row of a camera."""
    labels: tuple[str, ...]
    """What they are called one by one."""
    words: str
    """What it is called in text."""
    additive: str
    """Unit of an additive step."""
    relative: str
    """Unit of a relative step."""


INTRINSICS: dict[str, Intrinsic] = {
    "focal": Intrinsic((0,), ("focal",), "focal length", "pixels along x", "logarithm"),
    "aspect": Intrinsic((1,), ("aspect",), "aspect", "ratio of y to x", "logarithm"),
    "skew": Intrinsic((2,), ("skew",), "skew", "pixels", "focal lengths"),
    "principal_point": Intrinsic((3, 4), ("cx", "cy"), "principal point", "pixels", "pixels"),
}
FOCAL, ASPECT, SKEW, CX, CY = range(5)
HEAD = 5
"""Numbers in front of the distortion."""


def intrinsic_columns(names: Sequence[str], model: type[Distortion] | None = None, argument: str = "free") -> tuple[int, ...]:
    """The numbers of a camera's row that names stand for, name by name.

    Args:
        names: Keys of `INTRINSICS`, or names of the distortion's parameters.
        model: The distortion model, if there is one.
        argument: What to call the names in an error.

    Raises:
        ValueError: A name is unknown.
    """
    columns = {name: intrinsic.columns for name, intrinsic in INTRINSICS.items()}
    columns |= {name: (HEAD + i,) for i, name in enumerate(model.parameter_names if model else ())}
    for name in names:
        if name not in columns:
            raise ValueError(f"{argument}: wanted names among {sorted(columns)}, got {name!r}")
    return tuple(column for name in names for column in columns[name])


def intrinsic_labels(model: type[Distortion] | None = None) -> tuple[str, ...]:
    """What the numbers of a camera's row are called one by one."""
    head = tuple(label for intrinsic in INTRINSICS.values() for label in intrinsic.labels)
    return head + (model.parameter_names if model else ())


def row_from_camera(camera: Camera) -> Float[Tensor, "*batch k"]:
    """Cameras as rows of numbers."""
    K, lens = camera.K, camera.distortion
    f = K[..., 0, 0]
    head = (f, K[..., 1, 1] / f, K[..., 0, 1], K[..., 0, 2], K[..., 1, 2])
    return torch.stack((*head, *(getattr(lens, name) for name in lens.parameter_names)), -1)


def camera_from_row(row: Float[Tensor, "*batch k"], model: type[Distortion]) -> Camera:
    """Cameras from rows of numbers; what stands behind them is not looked at."""
    return Camera(intrinsic_matrix(row), model.from_parameters(row[..., HEAD : HEAD + model.num_parameters]))


def intrinsic_matrix(row: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch 3 3"]:
    """K from rows of numbers, of which the first five count."""
    f, aspect, skew, cx, cy = row[..., :HEAD].unbind(-1)
    zero, one = torch.zeros_like(f), torch.ones_like(f)
    return torch.stack((f, skew, cx, zero, f * aspect, cy, zero, zero, one), -1).reshape(*f.shape, 3, 3)


def move_relative(row: Float[Tensor, "*#batch k"], step: Float[Tensor, "*#batch k"]) -> Float[Tensor, "*batch k"]:
    """Rows after relative steps. Steps along one line add up."""
    f, aspect, skew = row[..., FOCAL], row[..., ASPECT], row[..., SKEW]
    factor = step[..., FOCAL].exp()
    scales = (f * factor, aspect * step[..., ASPECT].exp(), torch.addcmul(skew, f, step[..., SKEW]) * factor)
    return torch.cat((torch.stack(scales, -1), row[..., CX:] + step[..., CX:]), -1)


def relative_derivative(row: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch 5 5"]:
    """The derivatives of the first five numbers by a relative step, at none: row by number, column by step."""
    f, aspect, skew = row[..., FOCAL], row[..., ASPECT], row[..., SKEW]
    D = torch.zeros(*row.shape[:-1], HEAD, HEAD, dtype=row.dtype, device=row.device)
    D[..., FOCAL, FOCAL], D[..., SKEW, FOCAL], D[..., ASPECT, ASPECT], D[..., SKEW, SKEW] = f, skew, aspect, f
    D[..., CX, CX] = D[..., CY, CY] = 1
    return D
