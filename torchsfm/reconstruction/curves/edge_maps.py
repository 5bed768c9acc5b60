"""Edges of several images as maps: which edge point is the nearest to a pixel, and how far are images of points from it?"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.linalg.rows import take_columns

_REACH = 3
"""Farthest pixel, along an axis, that an edge point is looked for from."""
_FELT = 2.5
"""Distance of an edge, in pixels, that a pixel still feels."""
_KEPT = 1 << 29
"""Bytes, the most, of maps that are kept."""


class EdgePoints(NamedTuple):
    """Edge points of an image in the coordinates of a camera without distortion, chain by chain, in order."""

    x: Float[Tensor, "n 2"]
    tangent: Float[Tensor, "n 2"]
    """Unit vectors forwards: the brighter side is to the left as seen on the screen."""
    chain: Int[Tensor, "n"]


class Nearest(NamedTuple):
    """Of the edge point nearest to a point of an image."""

    r: Float[Tensor, "v *batch"]
    """Distance across the edge, to the left of its direction."""
    tangent: Float[Tensor, "v *batch 2"]
    """0 where there is none within reach."""


@dataclass(frozen=True)
class EdgeMap:
    """The edge points of one image, to be found by place."""

    points: EdgePoints
    table: Int[Tensor, "h w"]
    """The nearest edge point of each pixel; the number of all, which is none, where none is near."""

    @classmethod
    def of(cls, points: EdgePoints, height: int, width: int) -> "EdgeMap":
        """That of an image of such a size."""
        n, device = len(points.x), points.x.device
        steps = torch.arange(-_REACH, _REACH + 1, device=device)
        offset = torch.cartesian_prod(steps, steps).T[:, :, None]
        none = torch.iinfo(torch.long).max
        x, y = points.x.T
        column, row = points.x.round().long().T[:, None] + offset
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        # The nearest, by squares of fortieths of a pixel; of equals the first.
        square = (((column - x).square() + (row - y).square()) * 1600).long()
        key = square * (n + 1) + torch.arange(n, device=device)
        best = torch.full((height * width,), none, device=device)
        best.scatter_reduce_(0, (row * width + column)[inside], key[inside], "amin")
        return cls(points, torch.where(best < none, best % (n + 1), n).view(height, width).int())

    @cached_property
    def closeness(self) -> Float[Tensor, "h w"]:
        """The biweight of each pixel's distance from an edge: 1 on it, 0 where it is not felt; single precision."""
        h, w = self.table.shape
        x, y = torch.nn.functional.pad(self.points.x, (0, 0, 0, 1), value=-1e6)[self.table.flatten()].T
        row, column = (torch.arange(size, device=x.device, dtype=x.dtype) for size in (h, w))
        square = (column - x.view(h, w)).square() + (row[:, None] - y.view(h, w)).square()
        felt: Tensor = (1 - square.float() / _FELT**2).clamp(min=0).square()
        return felt


@dataclass(frozen=True)
class EdgeMaps:
    """Some images' edge points, to be found by place."""

    table: Int[Tensor, "v h w"]
    """The nearest edge point of each pixel, in one list of all images; the last one, which is none, where none is near."""
    x: Float[Tensor, "n 2"]
    tangent: Float[Tensor, "n 2"]

    @classmethod
    def of(cls, maps: Sequence[EdgeMap]) -> "EdgeMaps":
        """Those of images of one size."""
        number = [len(own.points.x) for own in maps]
        first = [sum(number[:i]) for i in range(len(maps))]
        tables = [torch.where(m.table < n, m.table + k, sum(number)) for m, n, k in zip(maps, number, first, strict=True)]
        x, tangent = (torch.cat([getattr(own.points, name) for own in maps]) for name in ("x", "tangent"))
        # Beyond all edges is one at a great distance.
        return cls(torch.stack(tables), torch.cat((x, x.new_full((1, 2), -1e6))), torch.cat((tangent, tangent.new_zeros(1, 2))))

    def near(self, y: Float[Tensor, "v *batch 2"]) -> Nearest:
        """The edge points nearest to points of each image, as far as a pixel's nearest tells."""
        index = self.nearest(y)
        # Coordinates by themselves: arithmetic on every other number is slow.
        place, tangent = (take_columns(rows.T, index.flatten()).view(2, *index.shape) for rows in (self.x, self.tangent))
        away = y.movedim(-1, 0) - place
        return Nearest(away[1] * tangent[0] - away[0] * tangent[1], tangent.movedim(0, -1))

    def nearest(self, y: Float[Tensor, "v *batch 2"]) -> Int[Tensor, "v *batch"]:
        """Which edge points these are; the last one, which is none, where none is near."""
        v, h, w = self.table.shape
        place = y.nan_to_num(nan=-9, posinf=-9, neginf=-9).clamp(-9, 1e6).round().long()
        column, row = place.unbind(-1)
        inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
        image = torch.arange(v, device=y.device).view(v, *[1] * (y.ndim - 2))
        flat = torch.where(inside, (image * h + row) * w + column, 0)
        return torch.where(inside, self.table.flatten()[flat], len(self.x) - 1)


class MapsOfImages:
    """The maps of images of one size, each made when it is first asked for; those asked for last are kept."""

    def __init__(self, points: Sequence[EdgePoints], size: tuple[int, int]) -> None:
        """`size` is height and width."""
        self.points = points
        # Four bytes a pixel for the nearest edge, and as many for how close it is.
        kept = max(1, _KEPT // (8 * size[0] * size[1]))
        self._made = lru_cache(kept)(lambda image: EdgeMap.of(points[image], *size))

    def __getitem__(self, image: int) -> EdgeMap:
        """That of an image."""
        return self._made(image)
