"""The angle of a ray to the optical axis and back, smooth on the axis."""

import torch
from torch import Tensor

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
