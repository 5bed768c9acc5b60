"""Which samples lie on outlines of smooth surfaces, that no image shows where another does."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.bundle.curves import edge_distances
from torchsfm.geometry import Camera, Pose
from torchsfm.linalg import solve
from torchsfm.linalg.vectors import across
from torchsfm.reconstruction.model.curves import Curves

_SURE = 3.0
"""Standard deviations of a radius that are no chance,"""
_ROUND = 10.0
"""and pixels in the images that it has at least: of paint on what is bent edges lie up to three aside, by shades."""
_NEIGHBOURS = 3
"""Samples before and behind by which it is told: the middle one of all."""
_OFF = 0.1
"""Standard deviation of edges, pixels, at least: of few images some agree by chance."""
_MEDIAN = 0.455
"""Of the square of one normal number."""
_STEP = 1e-4
"""Of the distance of a camera, by which it is told how fast images of samples move."""
_WEAK = 1e-12
"""Of the size of normal equations, which holds what images leave open."""


def on_outlines(curves: Curves, cameras: Camera, poses: Pose) -> Bool[Tensor, "n"]:
    """Which samples lie on an outline.

    Seen along a curve in space, the lines of sight to it meet in a point. Where it is the outline of a smooth surface they
    touch that: all pass on one side of a point, as far away as the surface has its radius there (Giblin & Weiss 1987; Cipolla &
    Blake 1992). So a point and a radius are fitted to the lines of sight of each sample, which three images determine and more
    confirm. A radius of few pixels, or of few standard deviations, is none: edges are rounded, and shades move them.

    Args:
        curves: The curves, with edge points of the images.
        cameras: Of each image (v).
        poses: Of each image (v).
    """
    found = _radii(curves, cameras, poses)

    def usual(values: Tensor) -> Tensor:
        return _smoothed(torch.where(found.left > 0, values, torch.nan), curves.curve)

    # Edges of other curves may be off by more.
    noise = (usual(found.square / found.left) / _MEDIAN).sqrt().clamp(min=_OFF)
    sure, size = usual(found.radius / (noise * found.deviation)), usual(found.radius / found.pixel)
    return (sure.abs() > _SURE) & (size.abs() > _ROUND)


class _Radii(NamedTuple):
    """Circles that the lines of sight of samples touch, in the planes across the curves."""

    radius: Float[Tensor, "n"]
    """Positive on one side of the curve and negative on the other."""
    deviation: Float[Tensor, "n"]
    """Of the radius, for edges that are off by one pixel."""
    pixel: Float[Tensor, "n"]
    """The size of a pixel there."""
    left: Float[Tensor, "n"]
    """Edge points more than the three that determine a circle; negative where there is none."""
    square: Float[Tensor, "n"]
    """What these leave, squared pixels."""


def _radii(curves: Curves, cameras: Camera, poses: Pose) -> _Radii:
    X, tangent, sample = curves.X.double(), curves.tangents().double(), curves.sample
    first, second = (t.mT for t in across(tangent.mT))
    at, seen, pose = X[sample], cameras[curves.view], poses[curves.view]
    sight = at - pose.centre.double()
    aside = torch.nn.functional.normalize(torch.linalg.cross(tangent[sample], sight), dim=-1)
    step = _STEP * torch.linalg.vector_norm(sight, dim=-1, keepdim=True)
    before, after = (seen.project(pose.transform((at + s * step * aside)[:, None]))[:, 0] for s in (-0.5, 0.5))
    normal = torch.nn.functional.normalize(curves.normal, dim=-1)
    # Pixels across the edge for a unit of space across curve and line of sight.
    rate = ((after - before) * normal).sum(-1).double() / step[:, 0]
    off = -edge_distances(poses, cameras, curves.bundle()).double()
    sound = off.isfinite() & rate.isfinite() & (rate != 0)
    rate, off, aside = torch.where(sound, rate, 0), torch.where(sound, off, 0), torch.where(sound[:, None], aside, 0)
    rows = torch.stack(((aside * first[sample]).sum(-1), (aside * second[sample]).sum(-1), torch.ones_like(off)), -1)
    rows = rows * rate[:, None]

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(len(X), *values.shape[1:]).index_add(0, sample, values)

    A, b, number = summed(rows[:, :, None] * rows[:, None]), summed(rows * off[:, None]), summed(sound.double())
    size = A.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    # Where two images show a sample only, or all from one side, the deviation tells.
    inverse, solved = solve(A + torch.where(size > 0, _WEAK * size, 1.0) * eye, eye.expand_as(A))
    fit = (inverse @ b[..., None])[..., 0]
    return _Radii(
        fit[:, 2],
        inverse[:, 2, 2].clamp_min(1e-300).sqrt(),
        number / summed(rate.abs()).clamp_min(1e-300),
        torch.where(solved, number - 3, -1.0),
        (summed(off.square()) - (fit * b).sum(-1)).clamp(min=0),
    )


def _smoothed(values: Float[Tensor, "n"], curve: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """The middle one of what is known of a sample and its neighbours; 0 where nothing is."""
    other = torch.arange(len(values), device=values.device)[:, None]
    other = (other + torch.arange(-_NEIGHBOURS, _NEIGHBOURS + 1, device=values.device)).clamp(0, len(values) - 1)
    near = torch.where(curve[other] == curve[:, None], values[other], torch.nan)
    return near.nanmedian(-1).values.nan_to_num(0.0)
