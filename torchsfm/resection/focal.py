"""What the solvers for a camera of unknown focal length share: data in rows, cameras from null spaces, and back.

The image is centred on the principal point and scaled to radius 1, the world to the points. Rows have the batch last.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.rows import combine_rows


class Scaled(NamedTuple):
    """Points of an image and of the world in units of their own."""

    x: Float[Tensor, "4 2 batch"]
    X: Float[Tensor, "4 4 batch"]
    """Homogeneous, last coordinate 1."""
    pixel: Float[Tensor, " batch"]
    """Pixels per unit of x."""
    centre: Float[Tensor, "3 batch"]
    size: Float[Tensor, " batch"]
    good: Tensor
    """Finite, and neither image nor world a single point."""


def scaled(x: Float[Tensor, "4 2 batch"], X: Float[Tensor, "4 3 batch"]) -> Scaled:
    """Scale the points; harmless numbers where they are of no use."""
    good = (torch.isfinite(x).all(0) & torch.isfinite(X[:, :2]).all(0)).all(0) & torch.isfinite(X[:, 2]).all(0)
    x, X = torch.where(good, x, 1.0), torch.where(good, X, 1.0)
    pixel = x.abs().amax(0).amax(0)
    centre = 0.25 * (X[0] + X[1] + X[2] + X[3])
    X = X - centre
    size = X.abs().amax(0).amax(0)
    good = good & (pixel > 0) & (size > 0)
    pixel, size = torch.where(good, pixel, 1.0), torch.where(good, size, 1.0)
    X = torch.cat((X / size, torch.ones_like(X[:, :1])), 1)
    return Scaled(x / pixel, X, pixel, centre, size, good)


def incidence_rows(x: Tensor, X: Tensor) -> Tensor:
    """Two rows of 12 for each point, unit covectors orthogonal to (x, y, 1) times the homogeneous point."""
    u, v = x[:, 0], x[:, 1]
    one = torch.ones_like(u)
    n = torch.stack((u, v, one), 1)
    n = n * (u * u + v * v + 1).rsqrt()[:, None]
    # A frame around n, whose last coordinate is positive.
    a = -1 / (1 + n[:, 2])
    b = n[:, 0] * n[:, 1] * a
    first = torch.stack((1 + n[:, 0] * n[:, 0] * a, b, -n[:, 0]), 1)
    second = torch.stack((b, 1 + n[:, 1] * n[:, 1] * a, -n[:, 1]), 1)
    normals = torch.stack((first, second), 1).flatten(0, 1)
    points = X.repeat_interleave(2, 0)
    return (normals[:, :, None] * points[:, None]).flatten(1, 2)


def camera_of(P: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R (3, 3, batch), t (3, batch) and f from P (3, 4, batch) ~ diag(f, f, 1) [R | t], of any scale and sign.

    The first two rows of R are taken from P, orthogonal and of equal length up to rounding or noise.
    """
    a, b, c = P[0, :3], P[1, :3], P[2, :3]
    n = _cross(a, b)
    along = combine_rows(n, c)
    sign = torch.copysign(torch.ones_like(along), along)
    square = 0.5 * (combine_rows(a, a) + combine_rows(b, b))
    # n = |a| |b| times the third row of R, so that its product with c has the length of c.
    depth = along.abs() / square
    f = square.sqrt() / depth
    a = a * combine_rows(a, a).rsqrt()
    third = n * combine_rows(n, n).rsqrt()
    second = _cross(third, a)
    R = torch.stack((a * sign, second * sign, third))
    scale = sign / depth
    t = torch.stack((P[0, 3] * scale / f, P[1, 3] * scale / f, P[2, 3] * scale))
    return R, t, f


def world_camera(R: Tensor, t: Tensor, f: Tensor, data: Scaled, item: Tensor) -> Tensor:
    """P (12, batch) in pixels and in the world's frame, third row of length 1."""
    pixel, centre, size = data.pixel[item], data.centre[:, item], data.size[item]
    t = torch.stack([t[i] * size - combine_rows(R[i], centre) for i in range(3)])
    focal = f * pixel
    P = torch.cat((R, t[:, None]), 1)
    return torch.cat((P[:2] * focal, P[2:])).flatten(0, 1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
