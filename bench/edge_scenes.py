"""Edges whose places are known: steps, discs, and all that is seen of the outlines of shapes in front of each other."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsfm import Ellipse
from torchsfm.simulation import paint_shapes

F64 = torch.float64
Array = NDArray[np.float64]
SPACING = 0.1
"""Pixels from one sample to the next."""
DARK, CONTRAST, BLUR = 0.1, 0.8, 0.6
"""Of steps and discs; the blur of the lens is in pixels."""


def step(angle: float, offset: float, blur: float, size: int = 64) -> Tensor:
    """Where cos(angle) x + sin(angle) y > offset from the middle of the image, as its pixels see it (h, w), exactly.

    The square of a pixel, seen along the edge, is two boxes one after the other; two integrals of the blurred step are known.
    """
    along = torch.arange(size, dtype=F64) - (size - 1) / 2
    away = along * math.cos(angle) + along[:, None] * math.sin(angle) - offset
    a, b = (max(abs(f(angle)), 1e-3) for f in (math.cos, math.sin))

    def twice(t: Tensor) -> Tensor:
        """The second integral of the blurred step."""
        share = 0.5 * torch.erfc(-t / (blur * math.sqrt(2)))
        density = torch.exp(-0.5 * (t / blur).square()) / math.sqrt(2 * math.pi)
        return 0.5 * ((t.square() + blur**2) * share + blur * t * density)

    corners = [twice(away + (i * a + j * b) / 2) * i * j for i in (-1, 1) for j in (-1, 1)]
    return sum(corners) / (a * b)  # type: ignore[return-value]


def shown(share: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    """The image (1, h, w) of what is bright to these shares."""
    grain = noise * torch.randn(share.shape, generator=generator, dtype=F64) if noise else 0.0
    return (DARK + CONTRAST * (share + grain))[None]


def directions(count: int, generator: torch.Generator, axes: bool = False) -> list[tuple[float, float]]:
    """Angles of edges, all around or only along the axes, and offsets within a pixel."""
    angle, offset = torch.rand(2, count, generator=generator, dtype=F64)
    angle = math.pi / 2 * torch.arange(count) if axes else 2 * math.pi / count * (torch.arange(count) + angle)
    return list(zip(angle.tolist(), (offset - 0.5).tolist(), strict=True))


def disc(centre: Tensor, radius: float, size: int) -> Tensor:
    """What share of each pixel is within a disc, blurred (h, w)."""
    circle = Ellipse(centre, torch.tensor([radius, radius], dtype=F64), torch.tensor(0.0, dtype=F64))
    return paint_shapes([circle], torch.tensor([0.0, 1.0], dtype=F64), width=size, height=size, blur=BLUR, fine=12)[0]


@dataclass(frozen=True)
class DrawnScene:
    """An image and the outlines that are edges of it: not hidden, away from the border, with a contrast."""

    image: Tensor
    """(1, h, w)."""
    x: Array
    """Samples (n, 2), in order along each piece."""
    normal: Array
    """Unit vectors across the outline (n, 2)."""
    contrast: Array
    """To what is beside it (n)."""
    shape: NDArray[np.int64]
    """The number of its ellipse or polygon (n)."""
    piece: NDArray[np.int64]
    """The number of the smooth piece that is seen as a whole (n)."""
    margin: float = 6.0
    """What is nearer to the border is not called seen, in pixels."""
    spacing: float = SPACING


def draw_scene(generator: torch.Generator, count: int = 14, width: int = 512, height: int = 384) -> DrawnScene:
    """Ellipses and polygons in turn, 12 to 90 px large, of nine greys from 0.1 to 0.9; later ones hide earlier ones.

    Args:
        generator: Source of randomness.
        count: How many shapes.
        width: Of the image.
        height: Of the image.
    """

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=F64)

    things: list[Ellipse | Tensor] = []
    for k in range(count):
        centre, radius = uniform(2) * torch.tensor([width, height]), 12 * (90 / 12) ** uniform(1)
        if k % 2:
            turn = 2 * math.pi * (uniform(1) + (torch.arange(5) + 0.6 * uniform(5) - 0.3) / 5)
            things.append(centre + radius * torch.stack((turn.cos(), turn.sin()), -1))
        else:
            axes = radius * torch.cat((torch.ones(1, dtype=F64), 0.4 + 0.6 * uniform(1)))
            things.append(Ellipse(centre, axes, math.pi * (uniform(1)[0] - 0.5)))
    levels = 0.1 + 0.1 * torch.randint(9, (count + 1,), generator=generator).to(F64)
    image = paint_shapes(things, levels, width=width, height=height)
    found: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    margin, pieces = DrawnScene.margin, 0
    limit = torch.tensor([width, height]) - 1 - margin
    for k, thing in enumerate(things):
        for x, normal in outline(thing):
            seen = ((x > margin) & (x < limit)).all(-1)
            for other in things[k + 1 :]:
                seen &= ~within(other, x)
            beside = levels[0].expand(len(x))
            for other, level in zip(things[:k], levels[1:], strict=False):
                beside = torch.where(within(other, x), level, beside)
            contrast = (levels[k + 1] - beside).abs()
            seen &= contrast > 1e-6
            # What is beside may change along the outline: pieces end there, as an edge of another shape ends there.
            breaks = torch.ones(len(x), dtype=torch.bool)
            breaks[1:] = (seen[1:] != seen[:-1]) | (contrast[1:] != contrast[:-1])
            number = breaks.cumsum(0) - 1
            found.append((x[seen], normal[seen], contrast[seen], torch.full((int(seen.sum()),), k), pieces + number[seen]))
            pieces += int(number[-1]) + 1
    columns = [torch.cat(c).numpy() for c in zip(*found, strict=True)]
    return DrawnScene(image, *columns)


def outline(thing: Ellipse | Tensor) -> list[tuple[Tensor, Tensor]]:
    """Samples and normals of each side of a polygon, or all around an ellipse."""
    if isinstance(thing, Tensor):
        sides = []
        for p, q in zip(thing, thing.roll(-1, 0), strict=True):
            d = q - p
            length = float(d.norm())
            share = torch.arange(0.5, max(1.0, length / SPACING), dtype=F64)[:, None] * (SPACING / length)
            sides.append((p + share * d, torch.stack((d[1], -d[0])).expand(len(share), 2) / length))
        return sides
    t = torch.linspace(0, 2 * math.pi, 1 + int(2 * math.pi * float(thing.semi_axes[0]) / SPACING), dtype=F64)[:-1]
    a, b = thing.semi_axes
    c, s = thing.angle.cos(), thing.angle.sin()
    turn = torch.stack((torch.stack((c, s)), torch.stack((-s, c))))
    x = thing.centre + torch.stack((a * t.cos(), b * t.sin()), -1) @ turn
    normal = torch.nn.functional.normalize(torch.stack((b * t.cos(), a * t.sin()), -1), dim=-1) @ turn
    return [(x, normal)]


def within(thing: Ellipse | Tensor, x: Tensor) -> Tensor:
    """Which points (n, 2) a shape covers."""
    if isinstance(thing, Tensor):
        d, away = thing.roll(-1, 0) - thing, x[:, None] - thing
        return (d[:, 0] * away[..., 1] - d[:, 1] * away[..., 0] > 0).all(-1)
    away = x - thing.centre
    c, s = thing.angle.cos(), thing.angle.sin()
    u, v = away[:, 0] * c + away[:, 1] * s, away[:, 1] * c - away[:, 0] * s
    inside: Tensor = (u / thing.semi_axes[0]).square() + (v / thing.semi_axes[1]).square() < 1
    return inside
