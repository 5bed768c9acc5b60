"""Which images see the surface that a curve lies on edge-on: what they show there may be an outline, and is drawn together."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Camera, Pose
from torchsfm.linalg import eigh
from torchsfm.reconstruction.curves.fusion import near_pairs
from torchsfm.reconstruction.model.curves import Curves

_AROUND = 45.0
"""Pixels, at the usual depth, around a sample whose samples tell its surface;"""
_EVERY = 4
"""of so many samples along a curve one is asked, and asks."""
_FLAT = 0.5
"""Of the standard deviation of those samples in the narrower direction of their plane, how much is left across it, at most;"""
_WIDE = 0.02
"""and how wide that direction is at least, in the distance to which samples are asked: one straight curve has no plane."""
_SLANT = 0.25
"""Sine of the angle between a line of sight and a surface that is seen edge-on: 14 degrees."""


def seen_edge_on(curves: Curves, cameras: Camera, poses: Pose) -> Bool[Tensor, "k"]:
    """Which edge points are of images that look along the surface of their sample.

    On the rim of what is smooth every curve runs along the outline, which is no fixed curve and has the same tangent: edges of
    the outline lie next to samples then, beyond them in every image. Surfaces are those of the samples around, where these lie
    in a plane; nothing is said elsewhere.

    Args:
        curves: The curves, with edge points of the images.
        cameras: Of each image (v).
        poses: Of each image (v).
    """
    X = curves.X.double()
    sight = poses.centre.double()[curves.view] - X[curves.sample]
    far = torch.linalg.vector_norm(sight, dim=-1)
    if not len(far):
        return curves.view < 0
    pixel = far / cameras.K.double()[curves.view, 0, 0]
    normal, flat = _surfaces(X, curves.curve, _AROUND * float(pixel.median()))
    slanted: Tensor = (sight * normal[curves.sample]).sum(-1).abs() < _SLANT * far
    return flat[curves.sample] & slanted


def _surfaces(
    X: Float[Tensor, "n 3"], curve: Int[Tensor, "n"], radius: float
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Unit normals of the planes through the samples around each sample, and which samples have one."""
    rank = torch.arange(len(X), device=X.device) - torch.searchsorted(curve, curve)
    asked = rank % _EVERY == 0
    Y = X[asked]
    a, b = near_pairs(Y, radius)
    step = Y[b] - Y[a]
    number = 1 + torch.bincount(a, minlength=len(Y))[:, None].double()
    mean = torch.zeros_like(Y).index_add(0, a, step) / number
    square = Y.new_zeros(len(Y), 9).index_add(0, a, (step[:, :, None] * step[:, None]).flatten(1)) / number
    spread, axes, known = eigh(square.view(-1, 3, 3) - mean[:, :, None] * mean[:, None])
    across, narrow, _ = spread.clamp(min=0).sqrt().unbind(-1)
    flat = known & (across < _FLAT * narrow) & (narrow > _WIDE * radius)
    own = asked.cumsum(0) - 1
    return axes[own, :, 0], flat[own]
