"""The angle of a ray to the optical axis and back, smooth on the axis."""

import torch
from torch import Tensor

from torchsfm.geometry.radial import even_polynomial, powers, slope_coefficients

SERIES = 1e-3
"""Squared angle or tangent below which power series replace quotients."""


def fisheye_from_tangent(X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor]:
    """Compute angle / radius and the squared angle of rays to the optical axis; smooth on the axis in front.

    Rays may point backwards (up to the angle pi). Exactly behind there is no answer: the quotient is then 1.
    """
    q = X * X + Y * Y
    front = (Z > 0) & (q < SERIES * Z * Z)
    depth = torch.where(front, Z, 1.0)
    t = torch.where(front, q, 0.0) / (depth * depth)
    series = (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t / 9)))) / depth
    rest = (~front) & (q > 0)
    r = torch.where(rest, q, 1.0).sqrt()
    quotient = torch.atan2(r, torch.where(rest, Z, 1.0)) / r
    ratio = torch.where(front, series, torch.where(rest, quotient, 1.0))
    return ratio, ratio * ratio * q


def tangent_from_fisheye(s: Tensor) -> tuple[Tensor, Tensor]:
    """From the squared angle, compute the factor of (x, y) by the angle and the z coordinate of a ray.

    The ray has z = 1 up to about 89.9 degrees off the axis, and unit length beyond.
    """
    small = s < SERIES
    angle = torch.where(small, 1.0, s).sqrt()
    cosine = torch.cos(angle)
    flat = small | (cosine > 2e-3)
    sinc = torch.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), torch.sin(angle) / angle)
    cosine = torch.where(small, 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56))), cosine)
    factor = torch.where(flat, sinc / torch.where(flat, cosine, 1.0), sinc)
    return factor, torch.where(flat, 1.0, cosine)


def fisheye_slopes(ray: Tensor, k: Tensor, out: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Project rays (3, ...) with radius theta h(theta^2); also return the derivatives (2, ...) by each coefficient.

    `out` (2, 3, ...) gets those by the ray. With the radius r across the axis, the image is (X, Y) g, g = theta h / r: it grows
    by g in every direction, outwards by what the slope c Z of the image's radius is more or less, and by -c r along the axis.
    """
    X, Y, Z = ray
    ratio, s = fisheye_from_tangent(X, Y, Z)
    g = ratio * even_polynomial(s, k.unbind(0))
    q = torch.addcmul(X * X, Y, Y)
    square = torch.addcmul(q, Z, Z)
    c = even_polynomial(s, slope_coefficients(k.unbind(0))) / torch.where(square > 0, square, 1.0)
    # On the axis this is multiplied by zero.
    bend = torch.addcmul(-g, c, Z) / torch.where(q > 0, q, 1.0)
    across = ray[:2]
    bent_x, bent_y = across * bend
    (xx, xy, _), (yx, yy, _), by_depth = *out, out[:, 2]
    torch.addcmul(g, X, bent_x, out=xx)
    torch.addcmul(g, Y, bent_y, out=yy)
    yx.copy_(torch.mul(X, bent_y, out=xy))
    torch.mul(across, -c, out=by_depth)
    return across * g, powers(across * ratio, s, len(k))
