"""Procedural textures: rich at every scale, never repeating, all from a generator.

A texture is a bitmap (3, h, w) in [0, 1] made once per surface; `mip_pyramid` adds its halvings for band-limited lookup.
The bitmap is the truth of the scene: what is sharp in it is a sharp mark painted on the surface.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchsfm.simulation.patterns import (
    BRICK,
    EARTH,
    PAINT,
    PLASTER,
    STONES,
    WOOD,
    Generator,
    add_spots,
    cells,
    color_ramp,
    fractal_noise,
    pick_colors,
    texels,
    uniform,
    uniform_numbers,
)

_FONT = (
    "0e11111f111111 1e11111e11111e 0e11101010110e 1e11111111111e 1f10101e10101f 1f10101e101010 0e11101711110f 1111111f111111 "
    "0e04040404040e 0702020202120c 11121418141211 1010101010101f 111b1515111111 11191513111111 0e11111111110e 1e11111e101010 "
    "0e11111115120d 1e11111e141211 0f10100e01011e 1f040404040404 1111111111110e 11111111110a04 1111111515150a 11110a040a1111 "
    "11110a04040404 1f01020408101f 0e11131519110e 040c040404040e 0e11010204081f 1f02040201110e 02060a121f0202 1f101e0101110e "
    "0608101e11110e 1f010204080808 0e11110e11110e 0e11110f01020c"
)
"""Capital letters and digits, 5 x 7 dots: seven rows of two hexadecimal digits each."""


def _ground(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    noise = fractal_noise(h, w, 2.5 * unit, gain=0.7, generator=generator)
    image = color_ramp(0.5 + 0.22 * noise, pick_colors(EARTH, 6, 0.2, generator))
    for cell, density in ((0.08, 0.6), (0.2, 0.5), (0.55, 0.4)):
        add_spots(image, cell * unit, STONES + EARTH, density=density, generator=generator)
    return image * (1 + 0.10 * fractal_noise(h, w, 0.03 * unit, generator=generator))


def _bricks(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    tall, wide, gap = 0.11 * unit, 0.29 * unit, 0.016 * unit
    rough = 0.004 * unit * fractal_noise(h, w, 0.06 * unit, generator=generator)
    y = texels(h, device)[:, None] + rough
    x = texels(w, device)[None] + rough.roll(7, 0)
    row = (y / tall).floor().clamp_min(0)
    rows = int(row.max()) + 1
    shift = uniform_numbers(rows, generator=generator) * wide
    x = x + shift[row.long()]
    column = (x / wide).floor().clamp_min(0)
    columns = int(column.max()) + 1
    color = pick_colors(BRICK, rows * columns, 0.3, generator)
    fy, fx = y - row * tall, x - column * wide
    mortar = (fy < gap) | (fx < gap)
    stain = fractal_noise(h, w, 1.2 * unit, generator=generator)
    image = color[(row * columns + column).long()].permute(2, 0, 1)
    image = torch.where(mortar, 0.62 + 0.04 * stain, image) * (1 + 0.13 * stain)
    image = image * (1 + 0.12 * fractal_noise(h, w, 0.025 * unit, gain=0.9, generator=generator))
    add_spots(image, 0.07 * unit, STONES, density=0.15, relief=0.3, generator=generator)
    return _posters(image, unit, 4, generator)


def _plaster(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    noise = fractal_noise(h, w, 1.5 * unit, gain=0.72, generator=generator)
    image = color_ramp(0.5 + 0.25 * noise, pick_colors(PLASTER, 5, 0.2, generator))
    flaked = fractal_noise(h, w, 0.9 * unit, gain=0.75, generator=generator) > 1.1
    under = color_ramp(0.5 + 0.3 * noise.roll(h // 3, 0), pick_colors(BRICK, 4, 0.3, generator))
    image = torch.where(flaked, under, image)
    add_spots(image, 0.45 * unit, PAINT, density=0.35, corners=True, generator=generator)
    add_spots(image, 0.06 * unit, STONES, density=0.25, generator=generator)
    return _posters(image, unit, 5, generator)


def _wood(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    wide = 0.14 * unit
    column = (texels(w, device) / wide).floor()
    count = int(column.max()) + 1
    grain = fractal_noise(h, w, 0.05 * unit, gain=0.8, stretch=6.0, generator=generator)
    color = pick_colors(WOOD + PAINT[:3], count, 0.25, generator)
    image = color[column.long()].T[:, None, :] * (1 + 0.2 * grain + 0.1 * fractal_noise(h, w, 0.5 * unit, generator=generator))
    seam = texels(w, device) - column * wide < 0.01 * unit
    image = torch.where(seam, image * 0.35, image)
    add_spots(image, 0.17 * unit, WOOD[1:], density=0.4, relief=0.9, generator=generator)
    add_spots(image, 0.05 * unit, ((0.2, 0.15, 0.1), (0.75, 0.72, 0.7)), density=0.2, generator=generator)
    return _posters(image, unit, 1, generator)


def _painted(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    base = pick_colors(PAINT, 1, 0.2, generator)[0]
    image = base[:, None, None] * (1 + 0.12 * fractal_noise(h, w, 0.5 * unit, gain=0.75, generator=generator))
    for cell, density in ((0.5, 0.9), (0.21, 0.6), (0.09, 0.5)):
        add_spots(image, cell * unit, PAINT, density=density, relief=0.2, corners=True, generator=generator)
    return image * (1 + 0.08 * fractal_noise(h, w, 0.04 * unit, gain=0.9, generator=generator))


def _marble(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    noise = fractal_noise(h, w, 0.5 * unit, gain=0.62, generator=generator)
    veins = (6 * fractal_noise(h, w, 0.7 * unit, gain=0.5, generator=generator)).sin().abs().clamp_min(0.04)
    image = color_ramp(0.5 + 0.25 * noise, pick_colors(STONES + PLASTER, 6, 0.2, generator)) * (0.45 + 0.55 * veins.sqrt())
    add_spots(image, 0.1 * unit, STONES + BRICK, density=0.35, relief=0.3, generator=generator)
    return image


def _mosaic(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    a, b, index, count = cells(h, w, 0.11 * unit, generator)
    color = pick_colors(PAINT, count, 0.3, generator)
    joint = torch.maximum(a.abs(), b.abs()) > 0.45
    image = torch.where(joint, 0.35, color[index].permute(2, 0, 1))
    return image * (1 + 0.15 * fractal_noise(h, w, 0.3 * unit, gain=0.8, generator=generator))


def _poster(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    base, ink = pick_colors(PAINT, 2, 0.2, generator)
    if float((base - ink).abs().sum()) < 0.6:
        ink = (1 - base).clamp(0.05, 0.95)
    image = base[:, None, None] * (1 + 0.06 * fractal_noise(h, w, 0.3 * unit, gain=0.8, generator=generator))
    add_spots(image, 0.35 * unit, PAINT, density=0.5, relief=0.2, corners=True, generator=generator)
    glyphs = torch.tensor([[int(g[2 * r : 2 * r + 2], 16) for r in range(7)] for g in _FONT.split()], device=device)
    dots = (glyphs[:, :, None] >> torch.arange(4, -1, -1, device=device)) & 1
    top = 0.03 * unit
    while top < h - 0.05 * unit:
        dot = uniform(0.008, 0.03, generator) * unit
        y = ((texels(h, device) - top) / dot).floor().long()
        x = ((texels(w, device) - 0.04 * unit) / dot).floor().long()
        letter = (uniform_numbers(w, generator=generator) * len(glyphs)).long()[(x // 6).clamp(0, w - 1)]
        on = dots[letter[None], y.clamp(0, 6)[:, None], (x % 6).clamp(0, 4)[None]] > 0
        on &= ((y >= 0) & (y < 7))[:, None] & ((x >= 0) & (x % 6 < 5) & (x < (w - 0.06 * unit) / dot - 2))[None]
        image = torch.where(on, ink[:, None, None], image)
        top += (8 + 4 * uniform(0.0, 1.0, generator)) * dot
    result: Tensor = image * (1 + 0.06 * fractal_noise(h, w, 0.05 * unit, gain=0.9, generator=generator))
    return result


def _curves(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    """Smooth glaze with a few painted curves, the level lines of a smooth function: nothing there has a corner."""
    base, *inks = pick_colors(PAINT, 3, 0.2, generator)
    field = fractal_noise(h, w, 0.6 * unit, gain=0.4, finest=0.25 * unit, generator=generator)
    shade = fractal_noise(h, w, 1.5 * unit, gain=0.3, finest=0.7 * unit, generator=generator)
    image: Tensor = (base[:, None, None] * (1 + 0.08 * shade)).expand(3, h, w)
    # Distance to the level line in texels, so that lines are of one width.
    slope = torch.stack(torch.gradient(field)).norm(dim=0).clamp_min(1e-6)
    for ink, level in zip((*inks, *inks), (-0.7, 0.0, 0.5, 1.1), strict=True):
        if float((ink - base).abs().sum()) < 0.5:
            ink = (1 - base).clamp(0.05, 0.95)
        cover = (0.012 * unit - (field - level).abs() / slope + 0.5).clamp(0, 1)
        image = torch.lerp(image, ink[:, None, None].expand(3, h, w), cover)
    return image


def _posters(image: Tensor, unit: float, count: int, generator: Generator) -> Tensor:
    """Stick posters at random places on a sheet, as large as it allows."""
    _, h, w = image.shape
    for _ in range(count):
        tall = min(int(uniform(0.5, 1.1, generator) * unit), int(0.6 * h))
        wide = min(int(uniform(0.5, 1.3, generator) * unit), int(0.6 * w))
        top, left = int(uniform(0.0, float(h - tall), generator)), int(uniform(0.0, float(w - wide), generator))
        image[:, top : top + tall, left : left + wide] = _poster(tall, wide, unit, generator)
    return image


STYLES: dict[str, Callable[[int, int, float, Generator], Tensor]] = {
    "ground": _ground,
    "bricks": _bricks,
    "plaster": _plaster,
    "wood": _wood,
    "painted": _painted,
    "marble": _marble,
    "mosaic": _mosaic,
    "poster": _poster,
    "curves": _curves,
}
"""Painters by name: (height, width in texels, texels per unit of the scene, generator) -> (3, height, width)."""


def paint(
    style: str, width: float, height: float, *, texel: float = 0.005, generator: Generator = None
) -> Float[Tensor, "3 h w"]:
    """A texture of the given physical size.

    Args:
        style: One of `STYLES`.
        width: In the unit of the scene (the textures look right where that is about a metre).
        height: In the unit of the scene.
        texel: Size of a texel, in the unit of the scene.
        generator: Source of randomness; torch's own where none is given. The texture lives on its device.

    Returns:
        Colours in [0, 1], float32. The first row and column lie at the sheet's corner.
    """
    if style not in STYLES:
        raise ValueError(f"style: wanted one of {sorted(STYLES)}, got {style!r}")
    if not (width > 0 and height > 0 and texel > 0):
        raise ValueError(f"width, height, texel: wanted positive sizes, got {width}, {height}, {texel}")
    w, h = max(8, math.ceil(width / texel)), max(8, math.ceil(height / texel))
    return STYLES[style](h, w, 1 / texel, generator).clamp(0, 1)


def mip_pyramid(image: Float[Tensor, "3 h w"]) -> tuple[Float[Tensor, "3 _ _"], ...]:
    """The image and its successive halvings by area averaging, down to a few texels."""
    levels = [image]
    while min(levels[-1].shape[1:]) >= 8:
        last = levels[-1]
        # Repeat the last row or column where the size is odd, so that nothing is dropped.
        last = functional.pad(last[None], (0, last.shape[2] % 2, 0, last.shape[1] % 2), mode="replicate")
        levels.append(functional.avg_pool2d(last, 2)[0])
    return tuple(levels)
