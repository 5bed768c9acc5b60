"""What textures are painted with: palettes, noise rich at every scale, cells and spots, all from a generator."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

Generator = torch.Generator | None
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


def uniform_numbers(*shape: int, generator: Generator) -> Tensor:
    """Random numbers between 0 and 1."""
    device = generator.device if generator is not None else None
    return torch.rand(*shape, generator=generator, dtype=torch.float32, device=device)


def texels(count: int, device: torch.device | None) -> Tensor:
    """The coordinates of texels along one axis."""
    return torch.arange(count, dtype=torch.float32, device=device)


def uniform(low: float, high: float, generator: Generator) -> float:
    """A random number between two."""
    return low + (high - low) * float(uniform_numbers(1, generator=generator))


def pick_colors(palette: tuple[tuple[float, float, float], ...], count: int, jitter: float, generator: Generator) -> Tensor:
    """Colours (count, 3): random mixtures of two neighbours in the palette, a little lighter or darker."""
    colors = torch.tensor(palette, dtype=torch.float32, device=generator.device if generator is not None else None)
    a = (uniform_numbers(count, generator=generator) * len(palette)).long().clamp_max(len(palette) - 1)
    mix = 0.3 * uniform_numbers(count, 1, generator=generator)
    chosen = colors[a] * (1 - mix) + colors[(a + 1) % len(palette)] * mix
    return (chosen * (1 + jitter * (2 * uniform_numbers(count, 1, generator=generator) - 1))).clamp(0, 1)


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


def cells(h: int, w: int, cell: float, generator: Generator) -> tuple[Tensor, Tensor, Tensor, int]:
    """Cut the sheet into square cells of a randomly turned lattice: position in the cell (-0.5..0.5), index, count."""
    device = generator.device if generator is not None else None
    angle = uniform(0.0, 2 * math.pi, generator)
    y, x = texels(h, device)[:, None] / cell, texels(w, device)[None] / cell
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
    a, b, index, count = cells(image.shape[1], image.shape[2], cell, generator)
    table = uniform_numbers(count, 6, generator=generator)
    angle, major = 2 * math.pi * table[:, 0], 0.1 + 0.16 * table[:, 1]
    minor = major * (0.4 + 0.6 * table[:, 2])
    da, db = 0.44 * (table[:, 3] - 0.5), 0.44 * (table[:, 4] - 0.5)
    c, s = angle.cos(), angle.sin()
    # p = |first|, q = |second| are 1 on the rim: affine in (a, b), one small table row per cell.
    first = torch.stack((c / major, s / major, -(c * da + s * db) / major), -1)
    second = torch.stack((-s / minor, c / minor, (s * da - c * db) / minor), -1)
    there = (table[:, 5] < density).to(image)
    kind = (uniform_numbers(count, generator=generator) * 3).floor() if corners else torch.zeros_like(table[:, 0])
    color = pick_colors(palette, count, 0.25, generator)
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


def color_ramp(value: Tensor, colors: Tensor) -> Tensor:
    """Colours (3, ...) by linear interpolation in a list of colours; value in 0..1."""
    position = value.clamp(0, 1) * (len(colors) - 1)
    i = position.floor().clamp_max(len(colors) - 2)
    f, i = position - i, i.long()
    return torch.stack([torch.lerp(column[i], column[i + 1], f) for column in colors.T])
