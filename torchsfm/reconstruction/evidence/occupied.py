"""Which pixels of images have image points, and whether what is there looks like a given one."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchsfm.reconstruction.mapping.mapping import Mapping

ALIKE = 0.85
"""Descriptors of one point, seen from like viewpoints, have at least this cosine; those of others rarely do."""
SPARSE = 8
"""Entries of a table of occupied pixels, at least, for each that is occupied."""
ROWS = 2048
"""Descriptors looked at together."""


@dataclass(frozen=True)
class Occupied:
    """The image points at or beside each pixel of each image."""

    pixel: Int[Tensor, "m"]
    """Pixels that are occupied, in ascending order, one for each point there."""
    some: Bool[Tensor, "s"]
    """Whether any pixel is occupied whose last binary digits these are: nearly all places are empty, and known to be so."""
    point: Int[Tensor, "m"]
    looks: "Looks | None"
    width: int
    height: int

    @classmethod
    def of(cls, mapping: Mapping) -> "Occupied":
        """All image points of a model's images, those of no point of the model too."""
        graph = mapping.graph
        width, height = (int(n) + 2 for n in graph.image_size.amax(0))
        x = graph.x.round().long() + 1
        step = torch.tensor([-1, 0, 1])
        column, row = x[:, 0, None, None] + step, x[:, 1, None, None] + step[:, None]
        pixel = ((graph.view[:, None, None] * height + row) * width + column).flatten()
        order = pixel.argsort()
        some = torch.zeros(1 << (SPARSE * max(len(pixel), 1)).bit_length(), dtype=torch.bool)
        some[pixel & (len(some) - 1)] = True
        looks = None if graph.descriptors is None else Looks.of(graph.descriptors())
        return cls(pixel[order], some, order // 9, looks, width, height)

    def at(self, view: Int[Tensor, "n"], place: Int[Tensor, "2 *k n"], like: Int[Tensor, "n"]) -> Bool[Tensor, "*k n"]:
        """Whether an image has a point at a pixel, or beside it, that looks like a given one where that is known."""
        column, row = place + 1
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        pixel = (view * self.height + row) * self.width + column
        found: Tensor = inside & self.some[pixel & (len(self.some) - 1)]
        maybe = found.nonzero(as_tuple=True)
        pixel, like = pixel[maybe], like[maybe[-1]]
        last, there = len(self.pixel) - 1, torch.searchsorted(self.pixel, pixel)
        own, alike = torch.arange(len(pixel)), torch.zeros_like(pixel, dtype=torch.bool)
        while len(own):
            # Of the points at a pixel one after the other, until one looks like it.
            held = (there <= last) & (self.pixel[there.clamp(max=last)] == pixel[own])
            own, there = own[held], there[held]
            fits = self.looks.alike(like[own], self.point[there]) if self.looks is not None else torch.ones_like(there) > 0
            alike[own[fits]] = True
            own, there = own[~fits], there[~fits] + 1
        found[maybe] = alike
        return found


@dataclass(frozen=True)
class Looks:
    """What image points look like."""

    descriptors: UInt8[Tensor, "n d"]
    length: Float[Tensor, "n"]

    @classmethod
    def of(cls, descriptors: UInt8[Tensor, "n d"]) -> "Looks":
        """With the lengths of the descriptors."""
        lengths = [torch.linalg.vector_norm(some.float(), dim=1) for some in torch.split(descriptors, ROWS)]
        return cls(descriptors, torch.cat(lengths).clamp(min=1e-12))

    def alike(self, first: Int[Tensor, "k"], second: Int[Tensor, "k"]) -> Bool[Tensor, "k"]:
        """Whether two image points look the same."""
        products = [
            (self.descriptors[a].float() * self.descriptors[b].float()).sum(-1)
            for a, b in zip(torch.split(first, ROWS), torch.split(second, ROWS), strict=True)
        ]
        return torch.cat(products) > ALIKE * self.length[first] * self.length[second]
