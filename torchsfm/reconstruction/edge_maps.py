"""Edges of several images as maps: which edge point is the nearest to a pixel, and how far are images of points from it?"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

_REACH = 3
"""Farthest pixel, along an axis, that an edge point is looked for from."""


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
class EdgeMaps:
    """Some images' edge points, to be found by place."""

    table: Int[Tensor, "v h w"]
    """The nearest edge point of each pixel, in one list of all images; the last one, which is none, where none is near."""
    x: Float[Tensor, "n 2"]
    tangent: Float[Tensor, "n 2"]

    def near(self, y: Float[Tensor, "v *batch 2"]) -> Nearest:
        """The edge points nearest to points of each image, as far as a pixel's nearest tells."""
        index = self.nearest(y)
        tangent = self.tangent[index]
        away = y - self.x[index]
        return Nearest(away[..., 1] * tangent[..., 0] - away[..., 0] * tangent[..., 1], tangent)

    def nearest(self, y: Float[Tensor, "v *batch 2"]) -> Int[Tensor, "v *batch"]:
        """Which edge points these are; the last one, which is none, where none is near."""
        return self.look_up(self.table, y, len(self.x) - 1)

    def closeness(self, threshold: float) -> Float[Tensor, "v h w"]:
        """The biweight of each pixel's distance from an edge: 1 on it, 0 beyond the threshold."""
        h, w = self.table.shape[1:]
        rows, columns = torch.meshgrid(
            *(torch.arange(n, device=self.x.device, dtype=self.x.dtype) for n in (h, w)), indexing="ij"
        )
        pixels = torch.stack((columns, rows), -1)
        squares = [(pixels - self.x[table]).square().sum(-1).float() for table in self.table]
        return (1 - torch.stack(squares) / threshold**2).clamp(min=0).square()

    @staticmethod
    def look_up(table: Tensor, y: Float[Tensor, "v *batch 2"], empty: float | int) -> Tensor:
        """What a table of each image holds at the pixels nearest to points, `empty` outside."""
        v, h, w = table.shape
        place = y.nan_to_num(nan=-9, posinf=-9, neginf=-9).clamp(-9, 1e6).round().long()
        column, row = place.unbind(-1)
        inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
        image = torch.arange(v, device=y.device).view(v, *[1] * (y.ndim - 2))
        flat = torch.where(inside, (image * h + row) * w + column, 0)
        return torch.where(inside, table.flatten()[flat], empty)


def edge_maps(points: list[EdgePoints], height: int, width: int) -> EdgeMaps:
    """Maps of the edge points of images of one size."""
    x, tangent = torch.cat([p.x for p in points]), torch.cat([p.tangent for p in points])
    n, device = len(x), x.device
    steps = torch.arange(-_REACH, _REACH + 1, device=device)
    offset = torch.cartesian_prod(steps, steps)
    extent, none = torch.tensor([width, height], device=device), torch.iinfo(torch.long).max
    tables, first = [], 0
    for own in points:
        pixel = own.x.round().long()[:, None] + offset
        inside = ((pixel >= 0) & (pixel < extent)).all(-1)
        # The nearest, by squares of fortieths of a pixel; of equals the first.
        square = ((pixel - own.x[:, None]).square().sum(-1) * 1600).long()
        key = square * (n + 1) + torch.arange(first, first + len(own.x), device=device)[:, None]
        best = torch.full((height * width,), none, device=device)
        best.scatter_reduce_(0, (pixel[..., 1] * width + pixel[..., 0])[inside], key[inside], "amin")
        tables.append(torch.where(best < none, best % (n + 1), n).view(height, width))
        first += len(own.x)
    # Beyond all edges is one at a great distance.
    return EdgeMaps(
        torch.stack(tables), torch.cat((x, x.new_full((1, 2), -1e6))), torch.cat((tangent, tangent.new_zeros(1, 2)))
    )
