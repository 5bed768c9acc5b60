"""A camera as one row of numbers, `(fx, fy / fx, cx, cy, skew, distortion...)`, so that "focal" is one number.

Behind them a row has ones and zeros for the numbers that are optimised: which of them are free in this camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry import Camera, DistortionModel
from torchsfm.optim import Term

COORDINATES: dict[str, tuple[int, ...]] = {"focal": (0,), "aspect": (1,), "principal_point": (2, 3), "skew": (4,)}
"""Columns of a camera row by the names users know."""


def camera_rows(camera: Camera) -> Float[Tensor, "g k"]:
    """Cameras as rows of numbers."""
    K = camera.K
    fx = K[:, 0, 0]
    head = torch.stack((fx, K[:, 1, 1] / fx, K[:, 0, 2], K[:, 1, 2], K[:, 0, 1]), -1)
    names = camera.distortion.parameter_names
    return torch.cat((head, *(getattr(camera.distortion, name)[:, None] for name in names)), -1)


def camera_from_rows(rows: Float[Tensor, "g k"], model: type[DistortionModel]) -> Camera:
    """Cameras from rows of numbers."""
    fx, aspect, cx, cy, skew = rows[:, :5].unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack((fx, skew, cx, zero, fx * aspect, cy, zero, zero, one), -1).reshape(-1, 3, 3)
    return Camera(K, model.from_parameters(rows[:, 5 : 5 + model.num_parameters]))  # type: ignore[arg-type]


def free_columns(names: Sequence[str], model: type[DistortionModel]) -> tuple[int, ...]:
    """The columns of a camera row that names stand for, in order.

    Raises:
        ValueError: A name is unknown.
    """
    columns = dict(COORDINATES)
    columns.update({name: (5 + i,) for i, name in enumerate(model.parameter_names)})
    for name in names:
        if name not in columns:
            raise ValueError(f"free: wanted names among {sorted(columns)}, got {name!r}")
    return tuple(sorted({c for name in names for c in columns[name]}))


def free_switches(
    columns: Sequence[int], fixed: Mapping[str, Tensor] | None, model: type[DistortionModel], cameras: Tensor
) -> Float[Tensor, "g k"]:
    """One where a column is free in a camera, zero where a name in `fixed` holds it.

    Raises:
        ValueError: A name is unknown, or a mask does not fit `cameras`, their K.
    """
    switches = torch.ones((len(cameras), len(columns)), dtype=torch.float64, device=cameras.device)
    for name, mask in (fixed or {}).items():
        check_tensors(cameras=(cameras, "g 3 3"), **{f"fixed_intrinsics[{name!r}]": (mask, "g: bool")})
        for column in free_columns((name,), model):
            if column in columns:
                switches[:, columns.index(column)] = (~mask).to(torch.float64)
    return switches


@dataclass(frozen=True)
class Switched:
    """Rows of which some columns are free, each where its switch at the end of the row is one: `x[free] + switch delta`."""

    size: int
    """Numbers before the switches."""
    free: tuple[int, ...]

    @property
    def ambient(self) -> int:
        """Numbers stored."""
        return self.size + len(self.free)

    @property
    def tangent(self) -> int:
        """Degrees of freedom, free or held."""
        return len(self.free)

    def retract(self, x: Float[Tensor, "*#b n"], delta: Float[Tensor, "*#b d"]) -> Float[Tensor, "*b n"]:
        """Addition in the free coordinates."""
        index = torch.tensor(self.free, dtype=torch.long, device=x.device)
        switched = delta * x[..., self.size :]
        step = torch.zeros((*switched.shape[:-1], self.ambient), dtype=x.dtype, device=x.device)
        return x + step.index_add(-1, index, switched)


def intrinsics_prior(sigma: Mapping[str, float | Tensor], mean: Camera) -> Term:
    """Gaussian priors on intrinsics by the names users know, one width for all cameras or one for each; "focal" is relative."""
    rows, model = camera_rows(mean), type(mean.distortion)
    columns, scales = [], []
    for name, value in sigma.items():
        for column in free_columns((name,), model):
            columns.append(column)
            unit = rows[:, column].abs() if name == "focal" else torch.ones_like(rows[:, column])
            scales.append(unit * value)
    picked = torch.tensor(columns, device=rows.device)
    return Term(
        lambda camera, mean, scale: (camera[:, picked] - mean) / scale,
        ("camera",),
        (torch.arange(rows.shape[0], device=rows.device),),
        (rows[:, picked], torch.stack(scales, -1)),
    )
