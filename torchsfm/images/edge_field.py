"""The nearest edge point of like direction anywhere in an image, by looking it up."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

_CELLS = 2_000_000
"""Most entries of a map: of larger images several pixels share one."""
_DIRECTIONS = 12
"""Maps for edges of all directions, the bright side told; each holds those up to as many degrees off as maps are apart."""


class EdgeField(NamedTuple):
    """Edge points of one image chain by chain, and which of them is nearest to any pixel."""

    x: Float[Tensor, "n 2"]
    normal: Float[Tensor, "n 2"]
    """Unit vectors to the bright side."""
    chain: Int[Tensor, " n"]
    start: Int[Tensor, " k"]
    """Where each chain starts in the list."""
    length: Int[Tensor, " k"]
    closed: Tensor
    """Which chains are, (k)."""
    nearest: Int[Tensor, "b h w"]
    """Index of the nearest edge point whose normal has about that direction; -1 in maps without any. Of 32 bits, as they
    are large."""
    cell: float
    """Side of what an entry of these maps stands for, in pixels."""

    def look_up(
        self, x: Float[Tensor, "*batch 2"], normal: Float[Tensor, "*batch 2"]
    ) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """The nearest edge point of like direction, and how far it is; infinitely far beyond the image."""
        h, w = self.nearest.shape[1:]
        column, row = (x / self.cell).nan_to_num(-1.0, -1.0, -1.0).round().clamp(-1, max(h, w)).long().unbind(-1)
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        index = self.nearest[_direction(normal), row.clamp(0, h - 1), column.clamp(0, w - 1)].long()
        there = inside & (index >= 0)
        index = index.clamp(min=0)
        if len(self.x) == 0:
            return index, torch.full_like(x[..., 0], torch.inf)
        return index, torch.where(there, (self.x[index] - x).norm(dim=-1), torch.inf)


def edge_field(
    x: Float[Tensor, "n 2"],
    gradient: Float[Tensor, "n 2"],
    chain: Int[Tensor, " n"],
    closed: Tensor,
    size: tuple[int, int],
) -> EdgeField:
    """Make edge points ready to be looked up.

    Args:
        x: Edge points, chain by chain, in order.
        gradient: Of the image there.
        chain: Number of the chain of each, from 0 without gaps.
        closed: Whether its chain is closed.
        size: Height and width of the image.
    """
    import cv2

    normal = torch.nn.functional.normalize(gradient, dim=-1)
    cell = max(1.0, math.sqrt(size[0] * size[1] / _CELLS))
    height, width = (int(t / cell) + 1 for t in size)
    length = chain.bincount()
    start = length.cumsum(0) - length
    column, row = (
        t.clamp(0, s - 1).numpy() for t, s in zip((x / cell).round().long().cpu().unbind(-1), (width, height), strict=True)
    )
    angle = torch.atan2(normal[:, 1], normal[:, 0]).cpu().numpy()
    maps = np.full((_DIRECTIONS, height, width), -1, dtype=np.int32)
    for k in range(_DIRECTIONS):
        off = np.abs((angle - 2 * math.pi * k / _DIRECTIONS + math.pi) % (2 * math.pi) - math.pi)
        near = np.flatnonzero(off < 2 * math.pi / _DIRECTIONS)
        if len(near) == 0:
            continue
        empty = np.ones((height, width), dtype=np.uint8)
        empty[row[near], column[near]] = 0
        _, label = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        table = np.zeros(int(label.max()) + 1, dtype=np.int32)
        table[label[row[near], column[near]]] = near
        maps[k] = table[label]
    return EdgeField(x, normal, chain, start, length, closed[start], torch.from_numpy(maps).to(x.device), cell)


def _direction(normal: Float[Tensor, "*batch 2"]) -> Int[Tensor, "*batch"]:
    angle = torch.atan2(normal[..., 1], normal[..., 0])
    return (angle * (_DIRECTIONS / (2 * math.pi))).round().long() % _DIRECTIONS
