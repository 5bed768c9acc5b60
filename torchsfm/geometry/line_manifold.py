"""3D lines as parameters: the orthonormal representation."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.rotations import rotation_from_rotvec


@dataclass(frozen=True)
class Line3D:
    """Pluecker lines `(d, m)` with `d . m = 0`, moved by four numbers (Bartoli & Sturm 2005, 4.2).

    A line is `d = sin(phi) u2`, `m = cos(phi) u1` with `(u1, u2, u1 x u2)` a rotation. A step `(w, s)` turns the rotation from
    the right by `exp(w)` and phi by s. The length of the 6-vector is kept. For a line through the origin (m = 0) or at
    infinity (d = 0) the turn about the vector that is left does nothing, so its place has one direction less until it has
    moved away: put the origin where no line passes. A 6-vector that is no line comes back as one, the shorter part made
    perpendicular to the longer.

    Example:
        >>> import torch
        >>> from torchsfm.geometry import Line3D
        >>> L = torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        >>> moved = Line3D().retract(L, torch.tensor([0.1, 0.0, 0.2, 0.3]))
        >>> d, m = moved.split(3)
        >>> bool((d @ m).abs() < 1e-6)  # a line still
        True
    """

    ambient: int = 6
    """Numbers stored."""
    tangent: int = 4
    """Degrees of freedom."""

    def retract(self, x: Float[Tensor, "*#b 6"], delta: Float[Tensor, "*#b 4"]) -> Float[Tensor, "*b 6"]:
        """The line after the step."""
        d, m = x[..., :3], x[..., 3:]
        direction, moment = _length(d), _length(m)
        # The frame stands on the longer of the two, so that it turns little where the other one vanishes.
        steep = direction >= moment
        first = torch.where(steep, d, m)
        u = first / _length(first).clamp_min(torch.finfo(x.dtype).tiny)
        second = torch.where(steep, m, d)
        second = second - (second * u).sum(-1, keepdim=True) * u
        # Where the other vector vanishes any direction across serves.
        across = _across(u)
        small = _length(second)
        tiny = small <= 1e-14 * _length(first)
        v = torch.where(tiny, across, second / torch.where(tiny, torch.ones_like(small), small))
        small = torch.where(tiny, torch.zeros_like(small), small)
        u1, u2 = torch.where(steep, v, u), torch.where(steep, u, v)
        cos, sin = torch.where(steep, small, moment), torch.where(steep, direction, small)
        frame = torch.stack((u1, u2, torch.linalg.cross(u1, u2)), -1) @ rotation_from_rotvec(delta[..., :3])
        angle = delta[..., 3:]
        new_cos = cos * angle.cos() - sin * angle.sin()
        new_sin = sin * angle.cos() + cos * angle.sin()
        return torch.cat((new_sin * frame[..., 1], new_cos * frame[..., 0]), -1)


def line_tangents(line: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 6 4"]:
    """The derivatives of lines along the steps of `Line3D`: columns orthogonal to each other and to the line."""
    d, m = line[..., :3], line[..., 3:]
    u1, u2 = (v / _length(v).clamp_min(1e-300) for v in (m, d))
    u3 = torch.linalg.cross(u1, u2)
    sin, cos = _length(d), _length(m)
    zero = torch.zeros_like(d)
    upper = torch.stack((sin * u3, zero, -sin * u1, cos * u2), -1)
    lower = torch.stack((zero, -cos * u3, cos * u2, -sin * u1), -1)
    return torch.cat((upper, lower), -2)


def world_covariance(
    C: Float[Tensor, "n 4 4"],
    line: Float[Tensor, "n 6"],
    model: Float[Tensor, "n 6"],
    origin: Float[Tensor, "n 3"],
    unit: Float[Tensor, "n"],
) -> Float[Tensor, "n 4 4"]:
    """The covariance along steps of `Line3D` from lines of the world, of that along steps in frames of their own.

    Args:
        C: Covariances of steps from `line`.
        line: Lines about `origin`, moments in `unit`.
        model: The same lines in the world, of unit direction.
        origin: The origins of the frames.
        unit: Their units.

    Returns:
        The covariances; zero for lines through the world's origin, where those steps say too little.
    """
    size = _length(line[:, :3])[:, 0].clamp_min(1e-300)[:, None, None]
    inner = line_tangents(line) / size
    dd, dm = inner[:, :3], inner[:, 3:]
    moved = torch.cat((dd, unit[:, None, None] * dm + torch.linalg.cross(origin[..., None].expand_as(dd), dd, dim=-2)), -2)
    outer = line_tangents(model)
    square = outer.square().sum(-2)
    determined = (square > 1e-20 * model.square().sum(-1, keepdim=True)).all(-1)
    G = (outer.mT @ moved) / torch.where(determined[:, None], square, 1.0)[..., None]
    return torch.where(determined[:, None, None], G @ C @ G.mT, 0.0)


def _length(v: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    return length


def _across(u: Tensor) -> Tensor:
    """A unit vector across each unit vector."""
    least = u.abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(u).scatter(-1, least, 1.0)
    v = torch.linalg.cross(u, axis)
    unit: Tensor = v / _length(v).clamp_min(torch.finfo(v.dtype).tiny)
    return unit
