"""The numbers inside a camera by the names users know, for all that estimates, frees or holds them.

A camera is a row `(f, aspect, skew, cx, cy, distortion...)`, so that "focal" is one number. Rows move in one of two ways:

- additive: by what is added to each number, in its own unit;
- relative: focal length and aspect by their logarithms and the skew in focal lengths, so that it follows them; the others as
  before. Steps then mean the same for all cameras.
"""

from collections.abc import Mapping, Sequence
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


def move_intrinsics(K: Float[Tensor, "*batch 3 3"], step: Mapping[int, Float[Tensor, "*batch"]]) -> Float[Tensor, "*batch 3 3"]:
    """K after relative steps of some of its numbers, by column; steps of one number add up. The others keep every bit."""
    fx, fy, skew, cx, cy = K[..., 0, 0], K[..., 1, 1], K[..., 0, 1], K[..., 0, 2], K[..., 1, 2]
    if SKEW in step:
        skew = skew + fx * step[SKEW]
    if FOCAL in step:
        factor = step[FOCAL].exp()
        fx, fy, skew = fx * factor, fy * factor, skew * factor
    if ASPECT in step:
        fy = fy * step[ASPECT].exp()
    if CX in step:
        cx = cx + step[CX]
    if CY in step:
        cy = cy + step[CY]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack((fx, skew, cx, zero, fy, cy, zero, zero, one), -1).reshape(*fx.shape, 3, 3)


def move_camera(camera: Camera, columns: Sequence[int], step: Float[Tensor, "*batch q"]) -> Camera:
    """Cameras after relative steps of the numbers in `columns`."""
    if not columns:
        return camera
    by = dict(zip(columns, step.unbind(-1), strict=True))
    lens, model = camera.distortion, type(camera.distortion)
    moved = [getattr(lens, name) + by.get(HEAD + i, 0.0) for i, name in enumerate(model.parameter_names)]
    return Camera(move_intrinsics(camera.K, by), model(*moved))


def intrinsics_slopes(K: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 5 3 3"]:
    """The derivative of K by a relative step of each of its numbers."""
    fx, skew, fy = K[..., 0, 0], K[..., 0, 1], K[..., 1, 1]
    D = K.new_zeros(*K.shape[:-2], HEAD, 3, 3)
    D[..., FOCAL, 0, 0], D[..., FOCAL, 0, 1], D[..., FOCAL, 1, 1] = fx, skew, fy
    D[..., ASPECT, 1, 1] = fy
    D[..., SKEW, 0, 1] = fx
    D[..., CX, 0, 2] = D[..., CY, 1, 2] = 1
    return D


def intrinsics_from_relative(theta: Float[Tensor, "*batch 5"]) -> Float[Tensor, "*batch 3 3"]:
    """K of the relative numbers: the steps to it from the identity."""
    eye = torch.eye(3, dtype=theta.dtype, device=theta.device).expand(*theta.shape[:-1], 3, 3)
    return move_intrinsics(eye, dict(enumerate(theta.unbind(-1))))


def relative_from_intrinsics(K: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 5"]:
    """The relative numbers of K: logarithms of focal length and aspect, skew in focal lengths, principal point."""
    f, fy = K[..., 0, 0], K[..., 1, 1]
    return torch.stack((f.log(), (fy / f).log(), K[..., 0, 1] / f, K[..., 0, 2], K[..., 1, 2]), -1)
