"""Which numbers of which cameras are adjusted, and what is known of them; cameras are rows of `intrinsic_parameters`.

Behind its numbers a row may have ones and zeros for those that are optimised: which of them are free in this camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry import Camera, Distortion
from torchsfm.geometry.intrinsic_parameters import FOCAL, intrinsic_columns, row_from_camera
from torchsfm.optim import Term


def free_columns(names: Sequence[str], model: type[Distortion]) -> tuple[int, ...]:
    """The columns of a camera row that names stand for, in order.

    Raises:
        ValueError: A name is unknown.
    """
    return tuple(sorted(set(intrinsic_columns(names, model))))


def free_switches(
    columns: Sequence[int], fixed: Mapping[str, Tensor] | None, model: type[Distortion], cameras: Tensor
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
    rows, model = row_from_camera(mean), type(mean.distortion)
    columns, scales = [], []
    for name, value in sigma.items():
        for column in free_columns((name,), model):
            columns.append(column)
            unit = rows[:, column].abs() if column == FOCAL else torch.ones_like(rows[:, column])
            scales.append(unit * value)
    picked = torch.tensor(columns, device=rows.device)
    return Term(
        lambda camera, mean, scale: (camera[:, picked] - mean) / scale,
        ("camera",),
        (torch.arange(rows.shape[0], device=rows.device),),
        (rows[:, picked], torch.stack(scales, -1)),
    )
