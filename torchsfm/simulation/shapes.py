"""Images of ellipses and polygons in front of each other, with the truth about every edge."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry import Ellipse, conic_from_ellipse
from torchsfm.simulation.randomness import where_drawn

_SAMPLES = 720
"""Points on an outline that say which share of it is seen."""
_MARGIN = 4.0
"""What is nearer to the border than this is not called seen, in pixels."""


@dataclass(frozen=True)
class RenderedShapes:
    """Images of shapes; what comes later hides what comes before, ellipses and polygons in turn.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> drawn = torchsfm.render_shapes((), ellipses=1, radius=(15.0, 25.0), width=120, height=90, generator=g)
        >>> drawn.images.shape, drawn.ellipses_seen  # how much of the outline no other shape hides
        (torch.Size([1, 90, 120]), tensor([0.5438], dtype=torch.float64))
        >>> found = torchsfm.images.detect_ellipses(drawn.images)
        >>> bool(torch.cdist(drawn.ellipses.centre, found.ellipse.centre.double()).min() < 0.1)  # pixels
        True
    """

    images: Float[Tensor, "*batch 1 h w"]
    """Grey, with blur and noise."""
    ellipses: Ellipse
    """Of batch (*batch, n)."""
    ellipses_seen: Float[Tensor, "*batch n"]
    """The share of each outline, by length, that nothing hides, that is inside the image and that has the wanted contrast."""
    polygons: Float[Tensor, "*batch m k 2"]
    """Corners, in the order in which x turns to y; side i goes from corner i to the next."""
    sides_seen: Float[Tensor, "*batch m k"]
    """The share of each side that is seen."""


@where_drawn
def render_shapes(
    shape: Sequence[int],
    *,
    ellipses: int = 8,
    rings: int = 0,
    polygons: int = 4,
    corners: int = 4,
    radius: tuple[float, float] = (8.0, 80.0),
    levels: int = 9,
    width: int = 640,
    height: int = 480,
    blur: float = 0.6,
    noise: float = 0.01,
    fine: int = 4,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> RenderedShapes:
    """Draw scenes of grey ellipses and convex polygons that hide parts of each other, and paint them.

    Args:
        shape: Batch dimensions.
        ellipses: Number of ellipses in a scene; their shorter axis is at least 0.4 of the longer.
        rings: How many of them, the last ones, lie within the first ones, with the same centre, axes and right before them.
        polygons: Number of polygons in a scene.
        corners: Of each polygon.
        radius: Smallest and largest longer semi-axis, and half the size of polygons, in pixels, evenly by logarithm.
        levels: Values of grey, evenly from 0.1 to 0.9; only edges between different ones are seen.
        width: Of images.
        height: Of images.
        blur: Standard deviation of the lens's blur, in pixels.
        noise: Standard deviation of the noise of image values.
        fine: Samples for each pixel and axis.
        generator: Source of randomness; torch's own where none is given.
        dtype: Of the numbers.

    Returns:
        Images and truth, on the generator's device, on the CPU where none is given.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> drawn = torchsfm.render_shapes((2,), ellipses=3, radius=(5.0, 20.0), width=80, height=60, generator=g)
        >>> drawn.images.shape, drawn.ellipses.centre.shape
        (torch.Size([2, 1, 60, 80]), torch.Size([2, 3, 2]))
    """
    check_options(
        ellipses=(ellipses, "int >= 0"), rings=(rings, "int >= 0"), polygons=(polygons, "int >= 0"),
        corners=(corners, "int >= 3"), radius=(radius, "2 float > 0"), levels=(levels, "int >= 2"), width=(width, "int >= 8"),
        height=(height, "int >= 8"), blur=(blur, "float > 0"), noise=(noise, "float >= 0"), fine=(fine, "int >= 1"),
    )  # fmt: skip
    if 2 * rings > ellipses:
        raise ValueError(f"rings: wanted at most half of the {ellipses} ellipses, got {rings}")
    batch = tuple(shape)
    scenes = math.prod(batch)

    def uniform(*size: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(scenes, *size, generator=generator, dtype=dtype)

    def places(n: int) -> Tensor:
        return torch.stack((uniform(n, low=0.0, high=width - 1.0), uniform(n, low=0.0, high=height - 1.0)), -1)

    logs = [math.log(r) for r in radius]
    longer = uniform(ellipses, low=logs[0], high=logs[1]).exp()
    axes = torch.stack((longer, longer * uniform(ellipses, low=0.4, high=1.0)), -1)
    centre, angle = places(ellipses), uniform(ellipses, low=-math.pi / 2, high=math.pi / 2)
    if rings:
        inner = uniform(rings, 1, low=0.4, high=0.8)
        axes[:, -rings:] = inner * axes[:, :rings]
        centre[:, -rings:], angle[:, -rings:] = centre[:, :rings], angle[:, :rings]
    turn = uniform(polygons, 1, low=0.0, high=2 * math.pi)
    turn = turn + (torch.arange(corners, dtype=dtype) + uniform(polygons, corners, low=-0.3, high=0.3)) * (
        2 * math.pi / corners
    )
    size = uniform(polygons, 1, low=logs[0], high=logs[1]).exp()[..., None]
    outline = places(polygons)[:, :, None] + size * torch.stack((turn.cos(), turn.sin()), -1)
    # The order in which they are painted: rings after what they are in, all else by chance.
    number = ellipses + polygons
    rank = torch.rand(scenes, number, generator=generator, dtype=dtype)
    if rings:
        rank[:, ellipses - rings : ellipses] = rank[:, :rings] + 1e-9
    order = rank.argsort(-1)
    grey = torch.randint(levels, (scenes, number + 1), generator=generator)
    grain = noise * torch.randn(scenes, 1, height, width, generator=generator, dtype=dtype)
    images = torch.empty(scenes, 1, height, width, dtype=dtype)
    seen = torch.zeros(scenes, ellipses, dtype=dtype), torch.zeros(scenes, polygons, corners, dtype=dtype)
    truth = Ellipse(centre, axes, angle)
    for i in range(scenes):
        own = Ellipse(centre[i], axes[i], angle[i])
        things = [_ellipse(own, k) if k < ellipses else outline[i, k - ellipses] for k in order[i].tolist()]
        images[i] = (
            paint_shapes(things, 0.1 + 0.8 / (levels - 1) * grey[i].to(dtype), width=width, height=height, blur=blur, fine=fine)
            + grain[i]
        )
        for place, k in enumerate(order[i].tolist()):
            shares = _seen(things, place, grey[i], width, height)
            if k < ellipses:
                seen[0][i, k] = shares[0]
            else:
                seen[1][i, k - ellipses] = shares
    return RenderedShapes(
        images.reshape(*batch, 1, height, width),
        Ellipse(*(v.reshape(*batch, *v.shape[1:]) for v in (truth.centre, truth.semi_axes, truth.angle))),
        seen[0].reshape(*batch, ellipses),
        outline.reshape(*batch, polygons, corners, 2),
        seen[1].reshape(*batch, polygons, corners),
    )


def paint_shapes(
    shapes: Sequence[Ellipse | Float[Tensor, "k 2"]],
    levels: Float[Tensor, " n"],
    *,
    width: int,
    height: int,
    blur: float = 0.6,
    fine: int = 6,
) -> Float[Tensor, "1 h w"]:
    """Paint shapes many times finer than pixels, blur them as a lens does and average them as a sensor does.

    Args:
        shapes: Single ellipses, or corners of convex polygons in the order in which x turns to y; later ones on top.
        levels: The value of the background, then of each shape.
        width: Of the image.
        height: Of the image.
        blur: Standard deviation of the blur, in pixels.
        fine: Samples for each pixel and axis.

    Returns:
        The image; edges are within about a hundredth of a sample's size of where they should be.

    Raises:
        ValueError: Wrong kind, shape, number or dtype.

    Example:
        >>> import torch, torchsfm
        >>> disc = torchsfm.Ellipse(torch.tensor([16.0, 12.0]), torch.tensor([8.0, 5.0]), torch.tensor(0.3))
        >>> image = torchsfm.simulation.paint_shapes([disc], torch.tensor([0.2, 0.9]), width=32, height=24)
        >>> image.shape, image[0, 12, 16], image[0, 0, 0]
        (torch.Size([1, 24, 32]), tensor(0.9000), tensor(0.2000))
    """
    check_options(
        shapes=(shapes, Sequence), width=(width, "int >= 1"), height=(height, "int >= 1"), blur=(blur, "float > 0"),
        fine=(fine, "int >= 1"),
    )  # fmt: skip
    check_tensors(levels=(levels, "n>=1"))
    for i, thing in enumerate(shapes):
        check_options(**{f"shapes[{i}]": (thing, Ellipse | Tensor)})
        single = (
            thing.ndim == 2 and thing.shape[1] == 2 and len(thing) > 2 if isinstance(thing, Tensor) else thing.centre.ndim == 1
        )
        if not single:
            got = tuple(thing.shape) if isinstance(thing, Tensor) else f"a batch {tuple(thing.centre.shape[:-1])}"
            raise ValueError(f"shapes[{i}]: wanted a single ellipse or three corners (k, 2) or more, got {got}")
    if len(levels) != len(shapes) + 1:
        raise ValueError(f"levels: wanted {len(shapes) + 1}, one more than shapes, got {len(levels)}")
    reach = math.ceil(4 * blur * fine)
    along = [fine_samples(n, blur, fine, levels) for n in (width, height)]
    maps = levels[:1, None].repeat(len(along[1]), len(along[0]))
    for thing, level in zip(shapes, levels[1:], strict=True):
        # Nothing is covered by what is nowhere; what is endless ends beyond the image.
        low, high = (v.nan_to_num(nan=0.0).clamp(-2.0, 2.0 + max(width, height)).tolist() for v in _box(thing))
        # What is more than a pixel outside is not covered.
        columns, rows = (
            slice(max(0, int((low[k] - 1) * fine) + reach), max(0, int((high[k] + 2) * fine) + reach)) for k in (0, 1)
        )
        y, x = torch.meshgrid(along[1][rows], along[0][columns], indexing="ij")
        part = maps[rows, columns]
        covered = (_depth(thing, torch.stack((x, y), -1)) * fine + 0.5).clamp(0, 1).nan_to_num(nan=0.0)
        part += (level - part) * covered
    return photograph(maps, width, height, blur, fine)


def photograph(maps: Float[Tensor, "h2 w2"], width: int, height: int, blur: float, fine: int) -> Float[Tensor, "1 h w"]:
    """Blur what was sampled finely, beyond the border by four times the blur, as a lens does, and average it to pixels."""
    reach = math.ceil(4 * blur * fine)
    offset = torch.arange(-reach, reach + 1, dtype=maps.dtype, device=maps.device)
    kernel = torch.exp(-0.5 * (offset / (blur * fine)).square())
    kernel = kernel / kernel.sum()
    # Blur and average at once, one axis after the other.
    kernel = torch.stack([torch.nn.functional.pad(kernel, (j, fine - 1 - j)) for j in range(fine)]).mean(0)
    rows = conv2d(maps[None, None], kernel[:, None][None, None], stride=(fine, 1))
    return conv2d(rows, kernel[None, None, None], stride=(1, fine))[0]


def fine_samples(size: int, blur: float, fine: int, like: Tensor) -> Float[Tensor, " n"]:
    """Where the samples that `photograph` wants are along an axis, in pixels."""
    reach = math.ceil(4 * blur * fine)
    return (torch.arange(size * fine + 2 * reach, dtype=like.dtype, device=like.device) - reach + 0.5) / fine - 0.5


def _ellipse(ellipses: Ellipse, k: int) -> Ellipse:
    return Ellipse(ellipses.centre[k], ellipses.semi_axes[k], ellipses.angle[k])


def _box(thing: Ellipse | Tensor) -> tuple[Tensor, Tensor]:
    """The least and largest coordinates."""
    if isinstance(thing, Tensor):
        return thing.amin(0), thing.amax(0)
    reach = thing.semi_axes[0]
    return thing.centre - reach, thing.centre + reach


def _depth(thing: Ellipse | Tensor, x: Tensor) -> Tensor:
    """How far points (..., 2) are inside, right to first order next to the outline."""
    if isinstance(thing, Tensor):
        along = torch.nn.functional.normalize(thing.roll(-1, 0) - thing, dim=-1)
        away = x[..., None, :] - thing
        return (along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0]).amin(-1)
    A = conic_from_ellipse(thing)[:2, :2]
    away = x - thing.centre
    polar = away @ A
    level = (polar * away).sum(-1).clamp_min(1e-12).sqrt()
    depth: Tensor = (1 - level) * level / torch.linalg.vector_norm(polar, dim=-1).clamp_min(1e-12)
    return depth


def _seen(things: Sequence[Ellipse | Tensor], place: int, grey: Tensor, width: int, height: int) -> Tensor:
    """The share of an ellipse's outline (1) or of each side of a polygon (k) that is an edge of the image."""
    thing = things[place]
    if isinstance(thing, Tensor):
        share = (torch.arange(_SAMPLES, dtype=thing.dtype) + 0.5) / _SAMPLES
        x = thing[:, None] + share[:, None] * (thing.roll(-1, 0) - thing)[:, None]
        weight = torch.ones_like(x[..., 0])
    else:
        t = torch.arange(_SAMPLES, dtype=thing.centre.dtype) * (2 * math.pi / _SAMPLES)
        x = thing.points(t)[None]
        weight = (thing.semi_axes[0] * t.sin()).square() + (thing.semi_axes[1] * t.cos()).square()
        weight = weight.sqrt()[None]
    size = x.new_tensor([width, height])
    seen = ((x >= _MARGIN) & (x <= size - 1 - _MARGIN)).all(-1)
    for other in things[place + 1 :]:
        seen &= _depth(other, x) < 0
    beside = grey[:1].expand(seen.shape)
    for other, level in zip(things[:place], grey[1:], strict=False):
        beside = torch.where(_depth(other, x) > 0, level, beside)
    seen &= beside != grey[place + 1]
    total: Tensor = (weight * seen).sum(-1) / weight.sum(-1)
    return total
