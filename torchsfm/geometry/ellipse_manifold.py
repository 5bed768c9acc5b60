"""Ellipses in space as parameters."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.quadrics import Ellipsoid, principal_axes
from torchsfm.geometry.rotations import rotation_from_rotvec


@dataclass(frozen=True)
class Ellipse3D:
    """Ellipses `c + (u, v) S w`, |w| = 1, with orthonormal u and v and a symmetric S: `(c, u, v, S11, S12, S22)` in 12 numbers.

    A step moves the centre by three numbers, turns the plane about u and about v by two, and adds three to S, so that a circle
    is an ellipse like any other: its axes need no direction. Lengths of a step are in units of the ellipse's own size, that of
    `ellipse_size`, so that all its numbers are of one kind.
    """

    ambient: int = 12
    tangent: int = 8

    def retract(self, x: Float[Tensor, "*#b 12"], delta: Float[Tensor, "*#b 8"]) -> Float[Tensor, "*b 12"]:
        """The ellipse after the step."""
        u, v = x[..., 3:6], x[..., 6:9]
        turn = rotation_from_rotvec(delta[..., 3:4] * u + delta[..., 4:5] * v)
        frame = torch.stack((u, v), -2).expand(*turn.shape[:-2], 2, 3) @ turn.mT
        size = ellipse_size(x)[..., None]
        centre, root = x[..., :3] + size * delta[..., :3], x[..., 9:] + size * delta[..., 5:]
        return torch.cat((centre, frame.flatten(-2), root), -1)


def ellipse_size(x: Float[Tensor, "*batch 12"]) -> Float[Tensor, "*batch"]:
    """The quadratic mean of the semi-axes."""
    size: Tensor = torch.linalg.vector_norm(x[..., [9, 10, 10, 11]], dim=-1) * 0.5**0.5
    return size


def ellipse_row(ellipse: Ellipsoid) -> Float[Tensor, "*batch 12"]:
    """Flat ellipsoids as rows of `Ellipse3D`, u and v along their axes; what is no ellipse has NaN."""
    axes = ellipse.axes[..., :2, :]
    lengths = torch.linalg.vector_norm(axes, dim=-1)
    good = lengths.detach() > 0
    lengths = torch.where(good, lengths, torch.nan)
    u, v = (axes / lengths[..., None]).unbind(-2)
    a, b = lengths.unbind(-1)
    return torch.cat((ellipse.centre, u, v, torch.stack((a, torch.zeros_like(a), b), -1)), -1)


def ellipse_from_row(x: Float[Tensor, "*batch 12"]) -> Ellipsoid:
    """The flat ellipsoids of rows of `Ellipse3D`; axes of equal length have no derivative of their direction."""
    columns = spanning(x.movedim(-1, 0)).movedim((0, 1), (-2, -1))
    squares, directions = principal_axes(columns @ columns.mT)
    there = squares.detach()[..., :2] > 0
    lengths = torch.where(there, torch.where(there, squares[..., :2], 1.0).sqrt(), 0.0)
    axes = torch.nn.functional.pad(lengths[..., None] * directions[..., :2, :], (0, 0, 0, 1))
    return Ellipsoid(x[..., :3], axes)


def spanning(x: Float[Tensor, "12 *n"]) -> Float[Tensor, "3 2 *n"]:
    """The columns by which w makes points from the centre; coordinates first."""
    u, v = x[3:6], x[6:9]
    return torch.stack((x[9] * u + x[10] * v, x[10] * u + x[11] * v), 1)
