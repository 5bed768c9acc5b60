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

Generator = torch.Generator | None

_FONT = (
    "0e11111f111111 1e11111e11111e 0e11101010110e 1e11111111111e 1f10101e10101f 1f10101e101010 0e11101711110f 1111111f111111 "
    "0e04040404040e 0702020202120c 11121418141211 1010101010101f 111b1515111111 11191513111111 0e11111111110e 1e11111e101010 "
    "0e11111115120d 1e11111e141211 0f10100e01011e 1f040404040404 1111111111110e 11111111110a04 1111111515150a 11110a040a1111 "
    "11110a04040404 1f01020408101f 0e11131519110e 040c040404040e 0e11010204081f 1f02040201110e 02060a121f0202 1f101e0101110e "
    "0608101e11110e 1f010204080808 0e11110e11110e 0e11110f01020c"
)
"""Capital letters and digits, 5 x 7 dots: seven rows of two hexadecimal digits each."""

EARTH = ((0.36, 0.29, 0.20), (0.47, 0.40, 0.29), (0.30, 0.34, 0.18), (0.42, 0.44, 0.26), (0.55, 0.49, 0.38))
STONES = (
    (0.55, 0.54, 0.52),
    (0.42, 0.40, 0.38),
    (0.66, 0.62, 0.55),
    (0.50, 0.38, 0.31),
    (0.32, 0.33, 0.36),
    (0.75, 0.73, 0.69),
)
BRICK = ((0.56, 0.27, 0.20), (0.62, 0.34, 0.25), (0.47, 0.23, 0.19), (0.67, 0.42, 0.31), (0.40, 0.25, 0.23))
WOOD = ((0.55, 0.38, 0.22), (0.48, 0.31, 0.17), (0.63, 0.46, 0.29), (0.42, 0.28, 0.18))
PAINT = (
    (0.85, 0.82, 0.74), (0.13, 0.22, 0.38), (0.76, 0.24, 0.16), (0.89, 0.66, 0.20), (0.20, 0.46, 0.42), (0.12, 0.12, 0.14),
    (0.55, 0.68, 0.76), (0.46, 0.55, 0.25), (0.63, 0.36, 0.50),
)  # fmt: skip
PLASTER = ((0.80, 0.74, 0.62), (0.72, 0.66, 0.56), (0.85, 0.80, 0.70), (0.66, 0.58, 0.48))


def _rand(*shape: int, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    return torch.rand(*shape, generator=generator, dtype=torch.float32, device=device)


def _texels(count: int, device: torch.device | None) -> Tensor:
    return torch.arange(count, dtype=torch.float32, device=device)


def _uniform(low: float, high: float, generator: Generator) -> float:
    return low + (high - low) * float(_rand(1, generator=generator))


def _pick(palette: tuple[tuple[float, float, float], ...], count: int, jitter: float, generator: Generator) -> Tensor:
    """Colours (count, 3): random mixtures of two neighbours in the palette, a little lighter or darker."""
    colors = torch.tensor(palette, dtype=torch.float32, device=generator.device if generator is not None else None)
    a = (_rand(count, generator=generator) * len(palette)).long().clamp_max(len(palette) - 1)
    mix = 0.3 * _rand(count, 1, generator=generator)
    chosen = colors[a] * (1 - mix) + colors[(a + 1) % len(palette)] * mix
    return (chosen * (1 + jitter * (2 * _rand(count, 1, generator=generator) - 1))).clamp(0, 1)


def fractal_noise(
    h: int,
    w: int,
    cell: float,
    *,
    gain: float = 0.65,
    stretch: float = 1.0,
    finest: float = 1.5,
    generator: Generator = None,
) -> Float[Tensor, "h w"]:
    """Value noise: octaves of smoothly interpolated random grids, scaled to a standard deviation near 1.

    Args:
        h: Height in texels.
        w: Width in texels.
        cell: Grid spacing of the coarsest octave, in texels.
        gain: Amplitude of an octave over that of the next coarser one.
        stretch: How many times longer the cells are in y than in x.
        finest: Octaves go down to this spacing, in texels.
        generator: Source of randomness.
    """
    total = torch.zeros(h, w, dtype=torch.float32, device=generator.device if generator is not None else None)
    amplitude, power = 1.0, 0.0
    while cell >= finest:
        tall = cell * stretch
        rows, columns = math.ceil(h / tall) + 3, math.ceil(w / cell) + 3
        grid = torch.randn(1, 1, rows, columns, generator=generator, dtype=torch.float32, device=total.device)
        size = (max(h + 2, round(rows * tall)), max(w + 2, round(columns * cell)))
        # Only the rows and columns that are kept need computing.
        fine = _resize(grid[0, 0], size, h, w)
        total.add_(fine, alpha=amplitude)
        power += amplitude**2
        amplitude, cell = amplitude * gain, cell / 2
    return total / math.sqrt(max(power, 1e-12)) * 1.4


def _resize(grid: Tensor, size: tuple[int, int], h: int, w: int) -> Tensor:
    """The middle (h, w) of the bicubic enlargement of a grid to `size`, one axis after the other by small matrices."""
    out = grid
    for length, kept in ((size[0], h), (size[1], w)):
        first = (length - kept) // 2
        n = out.shape[0]
        position = (torch.arange(first, first + kept, dtype=torch.float32, device=grid.device) + 0.5) * (n / length) - 0.5
        base = position.floor()
        f = position - base
        index = (base.long()[:, None] + torch.arange(-1, 3, device=grid.device)).clamp(0, n - 1)
        # Cubic B-spline weights: smooth, and no overshoot.
        weight = torch.stack(((1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, 1 + 3 * f + 3 * f**2 - 3 * f**3, f**3), -1) / 6
        out = sum(weight[:, k, None] * out[index[:, k]] for k in range(4)).T  # type: ignore[union-attr]
    return out.contiguous()


def _cells(h: int, w: int, cell: float, generator: Generator) -> tuple[Tensor, Tensor, Tensor, int]:
    """Cut the sheet into square cells of a randomly turned lattice: position in the cell (-0.5..0.5), index, count."""
    device = generator.device if generator is not None else None
    angle = _uniform(0.0, 2 * math.pi, generator)
    y, x = _texels(h, device)[:, None] / cell, _texels(w, device)[None] / cell
    a, b = math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y
    i, j = a.floor(), b.floor()
    first, columns = i - i.min(), int(j.max() - j.min()) + 1
    index = (first * columns + (j - j.min())).long()
    return a - i - 0.5, b - j - 0.5, index, (int(first.max()) + 1) * columns


def add_spots(
    image: Float[Tensor, "3 h w"],
    cell: float,
    palette: tuple[tuple[float, float, float], ...],
    *,
    density: float = 0.7,
    relief: float = 0.5,
    corners: bool = False,
    generator: Generator = None,
) -> None:
    """Paint at most one random ellipse (or, with `corners`, also diamonds and rectangles) into every cell, in place.

    Args:
        image: The sheet.
        cell: Cell size in texels; spots are up to 0.45 of it in radius.
        palette: Colours to choose from.
        density: Share of cells that get a spot.
        relief: How much darker a spot is at its lower rim than in its middle, as if it were lit from above.
        corners: Whether shapes with corners are among them.
        generator: Source of randomness.
    """
    a, b, index, count = _cells(image.shape[1], image.shape[2], cell, generator)
    table = _rand(count, 6, generator=generator)
    angle, major = 2 * math.pi * table[:, 0], 0.1 + 0.16 * table[:, 1]
    minor = major * (0.4 + 0.6 * table[:, 2])
    da, db = 0.44 * (table[:, 3] - 0.5), 0.44 * (table[:, 4] - 0.5)
    c, s = angle.cos(), angle.sin()
    # p = |first|, q = |second| are 1 on the rim: affine in (a, b), one small table row per cell.
    first = torch.stack((c / major, s / major, -(c * da + s * db) / major), -1)
    second = torch.stack((-s / minor, c / minor, (s * da - c * db) / minor), -1)
    there = (table[:, 5] < density).to(image)
    kind = (_rand(count, generator=generator) * 3).floor() if corners else torch.zeros_like(table[:, 0])
    color = _pick(palette, count, 0.25, generator)
    chosen = torch.cat((first, second, there[:, None], kind[:, None]), -1)[index]
    p = chosen[..., 0] * a + chosen[..., 1] * b + chosen[..., 2]
    q = chosen[..., 3] * a + chosen[..., 4] * b + chosen[..., 5]
    shape = chosen[..., 7]
    r = (p.square() + q.square()).sqrt()
    if corners:
        r = torch.where(shape == 1, torch.maximum(p.abs(), q.abs()) * 1.3, torch.where(shape == 2, p.abs() + q.abs(), r))
    inside = ((r < 1) & (chosen[..., 6] > 0)).nonzero(as_tuple=True)
    light = 1 - relief * (0.5 * r[inside].square() + 0.25 * (p[inside] + q[inside]))
    image[:, inside[0], inside[1]] = (color[index[inside]].T * light).clamp(0, 1)


def _ramp(value: Tensor, colors: Tensor) -> Tensor:
    """Colours (3, ...) by linear interpolation in a list of colours; value in 0..1."""
    position = value.clamp(0, 1) * (len(colors) - 1)
    i = position.floor().clamp_max(len(colors) - 2)
    f, i = position - i, i.long()
    return torch.stack([torch.lerp(column[i], column[i + 1], f) for column in colors.T])


def _ground(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    noise = fractal_noise(h, w, 2.5 * unit, gain=0.7, generator=generator)
    image = _ramp(0.5 + 0.22 * noise, _pick(EARTH, 6, 0.2, generator))
    for cell, density in ((0.08, 0.6), (0.2, 0.5), (0.55, 0.4)):
        add_spots(image, cell * unit, STONES + EARTH, density=density, generator=generator)
    return image * (1 + 0.10 * fractal_noise(h, w, 0.03 * unit, generator=generator))


def _bricks(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    tall, wide, gap = 0.11 * unit, 0.29 * unit, 0.016 * unit
    rough = 0.004 * unit * fractal_noise(h, w, 0.06 * unit, generator=generator)
    y = _texels(h, device)[:, None] + rough
    x = _texels(w, device)[None] + rough.roll(7, 0)
    row = (y / tall).floor().clamp_min(0)
    rows = int(row.max()) + 1
    shift = _rand(rows, generator=generator) * wide
    x = x + shift[row.long()]
    column = (x / wide).floor().clamp_min(0)
    columns = int(column.max()) + 1
    color = _pick(BRICK, rows * columns, 0.3, generator)
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
    image = _ramp(0.5 + 0.25 * noise, _pick(PLASTER, 5, 0.2, generator))
    flaked = fractal_noise(h, w, 0.9 * unit, gain=0.75, generator=generator) > 1.1
    under = _ramp(0.5 + 0.3 * noise.roll(h // 3, 0), _pick(BRICK, 4, 0.3, generator))
    image = torch.where(flaked, under, image)
    add_spots(image, 0.45 * unit, PAINT, density=0.35, corners=True, generator=generator)
    add_spots(image, 0.06 * unit, STONES, density=0.25, generator=generator)
    return _posters(image, unit, 5, generator)


def _wood(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    wide = 0.14 * unit
    column = (_texels(w, device) / wide).floor()
    count = int(column.max()) + 1
    grain = fractal_noise(h, w, 0.05 * unit, gain=0.8, stretch=6.0, generator=generator)
    color = _pick(WOOD + PAINT[:3], count, 0.25, generator)
    image = color[column.long()].T[:, None, :] * (1 + 0.2 * grain + 0.1 * fractal_noise(h, w, 0.5 * unit, generator=generator))
    seam = _texels(w, device) - column * wide < 0.01 * unit
    image = torch.where(seam, image * 0.35, image)
    add_spots(image, 0.17 * unit, WOOD[1:], density=0.4, relief=0.9, generator=generator)
    add_spots(image, 0.05 * unit, ((0.2, 0.15, 0.1), (0.75, 0.72, 0.7)), density=0.2, generator=generator)
    return _posters(image, unit, 1, generator)


def _painted(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    base = _pick(PAINT, 1, 0.2, generator)[0]
    image = base[:, None, None] * (1 + 0.12 * fractal_noise(h, w, 0.5 * unit, gain=0.75, generator=generator))
    for cell, density in ((0.5, 0.9), (0.21, 0.6), (0.09, 0.5)):
        add_spots(image, cell * unit, PAINT, density=density, relief=0.2, corners=True, generator=generator)
    return image * (1 + 0.08 * fractal_noise(h, w, 0.04 * unit, gain=0.9, generator=generator))


def _marble(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    noise = fractal_noise(h, w, 0.5 * unit, gain=0.62, generator=generator)
    veins = (6 * fractal_noise(h, w, 0.7 * unit, gain=0.5, generator=generator)).sin().abs().clamp_min(0.04)
    image = _ramp(0.5 + 0.25 * noise, _pick(STONES + PLASTER, 6, 0.2, generator)) * (0.45 + 0.55 * veins.sqrt())
    add_spots(image, 0.1 * unit, STONES + BRICK, density=0.35, relief=0.3, generator=generator)
    return image


def _mosaic(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    a, b, index, count = _cells(h, w, 0.11 * unit, generator)
    color = _pick(PAINT, count, 0.3, generator)
    joint = torch.maximum(a.abs(), b.abs()) > 0.45
    image = torch.where(joint, 0.35, color[index].permute(2, 0, 1))
    return image * (1 + 0.15 * fractal_noise(h, w, 0.3 * unit, gain=0.8, generator=generator))


def _poster(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    device = generator.device if generator is not None else None
    base, ink = _pick(PAINT, 2, 0.2, generator)
    if float((base - ink).abs().sum()) < 0.6:
        ink = (1 - base).clamp(0.05, 0.95)
    image = base[:, None, None] * (1 + 0.06 * fractal_noise(h, w, 0.3 * unit, gain=0.8, generator=generator))
    add_spots(image, 0.35 * unit, PAINT, density=0.5, relief=0.2, corners=True, generator=generator)
    glyphs = torch.tensor([[int(g[2 * r : 2 * r + 2], 16) for r in range(7)] for g in _FONT.split()], device=device)
    dots = (glyphs[:, :, None] >> torch.arange(4, -1, -1, device=device)) & 1
    top = 0.03 * unit
    while top < h - 0.05 * unit:
        dot = _uniform(0.008, 0.03, generator) * unit
        y = ((_texels(h, device) - top) / dot).floor().long()
        x = ((_texels(w, device) - 0.04 * unit) / dot).floor().long()
        letter = (_rand(w, generator=generator) * len(glyphs)).long()[(x // 6).clamp(0, w - 1)]
        on = dots[letter[None], y.clamp(0, 6)[:, None], (x % 6).clamp(0, 4)[None]] > 0
        on &= ((y >= 0) & (y < 7))[:, None] & ((x >= 0) & (x % 6 < 5) & (x < (w - 0.06 * unit) / dot - 2))[None]
        image = torch.where(on, ink[:, None, None], image)
        top += (8 + 4 * _uniform(0.0, 1.0, generator)) * dot
    result: Tensor = image * (1 + 0.06 * fractal_noise(h, w, 0.05 * unit, gain=0.9, generator=generator))
    return result


def _curves(h: int, w: int, unit: float, generator: Generator) -> Tensor:
    """Smooth glaze with a few painted curves, the level lines of a smooth function: nothing there has a corner."""
    base, *inks = _pick(PAINT, 3, 0.2, generator)
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
        tall = min(int(_uniform(0.5, 1.1, generator) * unit), int(0.6 * h))
        wide = min(int(_uniform(0.5, 1.3, generator) * unit), int(0.6 * w))
        top, left = int(_uniform(0.0, float(h - tall), generator)), int(_uniform(0.0, float(w - wide), generator))
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
