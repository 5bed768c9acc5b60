"""Edges: where brightness changes most, to a hundredth of a pixel, linked into ordered chains."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.images.corners import to_gray
from torchsfm.images.edge_chains import chain_curvature, link_edgels, order_chains

_ROUNDING = 1 / 255 / math.sqrt(12)
"""Least noise that is believed: that of eight bits."""
_WIDEST = 10.0
"""Largest standard deviation of an edge's profile that three pixels tell, in pixels."""
_MOST_BENT = 0.25
"""Largest shift for curvature, in pixels: at corners there is no circle."""


@dataclass(frozen=True)
class Edges:
    """Edge points (edgels) of images, in slots of which the first ones are `valid`, chain by chain, the longest chain first.

    Edge points of a chain are in consecutive slots, in order: the brighter side is to the left as seen on the screen. What
    empty slots hold is 0, their chain is -1.

    Example:
        >>> import torch, torchsfm
        >>> centre = torch.tensor([60.0, 45.0])
        >>> disc = torchsfm.Ellipse(centre, torch.tensor([20.0, 20.0]), torch.tensor(0.0))
        >>> image = torchsfm.simulation.paint_shapes([disc], torch.tensor([0.2, 0.9]), width=120, height=90)
        >>> found = torchsfm.detect_edges(image)
        >>> outline = found.x[found.chain == 0]  # in order, as are all chains
        >>> found.closed[0], (outline - centre).norm(dim=-1).mean()
        (tensor(True), tensor(19.9996))
    """

    x: Float[Tensor, "*batch n 2"]
    """Pixel positions; (0, 0) is the centre of the top-left pixel."""
    gradient: Float[Tensor, "*batch n 2"]
    """Of the smoothed image, in image values per pixel: it points across the edge to the brighter side."""
    sigma: Float[Tensor, "*batch n"]
    """Standard deviation of the position across the edge, in pixels, for the image's noise. Neighbours are correlated: of `n`
    along an edge about `n / (2 sqrt(pi) blur)` are independent."""
    width: Float[Tensor, "*batch n"]
    """Standard deviation of the smoothed edge's profile across it, in pixels."""
    curvature: Float[Tensor, "*batch n"]
    """Of the chain, in 1/pixel, positive where it turns from the x axis to the y axis."""
    chain: Int[Tensor, "*batch n"]
    """Number of the chain in its image."""
    closed: Bool[Tensor, "*batch n"]
    """Whether the last edge point of its chain is next to the first one."""
    valid: Bool[Tensor, "*batch n"]
    """Which slots hold an edge point."""
    noise: Float[Tensor, "*batch"]
    """Standard deviation of the image's noise, as given or found, in image values."""
    left_out: Int[Tensor, "*batch"]
    """How many edge points of further chains had no slots."""


def detect_edges(
    image: Float[Tensor, "*#batch c h w"],
    max_edgels: int = 100_000,
    *,
    blur: float = 1.0,
    low: float = 0.01,
    high: float = 0.03,
    noise: float | None = None,
    min_edgels: int = 8,
    mask: Bool[Tensor, "*#batch h w"] | None = None,
    straight: bool = False,
) -> Edges:
    """Edges as ordered chains of points with sub-pixel positions.

    Canny's edges (1986): maxima of the gradient of the smoothed image across the edge. The position between pixels is the top
    of a parabola through the logarithms of three neighbouring gradients, exact for the Gaussian profile of a blurred step, and
    is moved outwards by what smoothing moves a bent edge inwards. A chain is kept where one of its
    points has a strong gradient.

    Smoothing draws the sides of thin bars apart: each by 0.06 px where a bar is 4 px wide, by 0.23 at 3 and by 0.53 at 2; with
    a `blur` of 0.5 by 0.004, 0.06 and 0.27 (in an image that a lens blurred by 0.6 px).

    Args:
        image: Grey (c = 1) or red, green, blue images.
        max_edgels: The number of slots for each image; whole chains fill them, the longest first.
        blur: Standard deviation of the smoothing, in pixels.
        low: Smallest gradient of an edge point, in image values per pixel; a step of 1 has 0.4 divided by the `width` of its
            edge. It is never less than four times the noise of gradients.
        high: Gradient that one point of every chain reaches, or six times the noise of gradients.
        noise: Standard deviation of the noise of image values; found from the image (Immerkaer 1996, with the median) if not
            given, and never less than the rounding of eight bits.
        min_edgels: Chains of fewer points are left out.
        mask: Where edges may be.
        straight: Leave edge points where they are, for what is straight: what is measured of its curvature is error.

    Returns:
        The edges. An image without any, or where everything is NaN, has none valid; around a NaN there are none. Within two
        `blur` and two pixels of the border there are none.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, :, 40:] = 1.0  # a step between the columns 39 and 40
        >>> found = torchsfm.detect_edges(image)
        >>> found.x[found.valid][:, 0].mean(), found.chain.max()  # one chain
        (tensor(39.5000), tensor(0))
    """
    batch = check_tensors(image=(image, "c h>=8 w>=8"), mask=(mask, "?h w: bool"))
    check_options(
        max_edgels=(max_edgels, "int >= 1"), blur=(blur, "0.5 <= float <= 20"), low=(low, "float >= 0"),
        high=(high, "float >= 0"), noise=(noise, "?float >= 0"), min_edgels=(min_edgels, "int >= 1"),
        straight=(straight, bool),
    )  # fmt: skip
    channels, height, width = image.shape[-3:]
    if channels not in (1, 3):
        raise ValueError(f"image: wanted 1 or 3 channels, got {channels}")
    gray = to_gray(image.expand(*batch, channels, height, width).reshape(-1, channels, height, width))[:, 0]
    broken = ~gray.isfinite()
    gray = torch.where(broken, 0.0, gray)
    filters = _filters(blur)
    level = _noise(gray, broken) if noise is None else gray.new_full((len(gray),), noise)
    level = level.clamp_min(_ROUNDING)
    gx, gy = _gradient(gray, filters.smooth)
    magnitude = (gx.square() + gy.square()).sqrt()
    allowed = ~_near(broken, len(filters.smooth) // 2 + 2)
    border = int(2 * blur) + 2
    allowed[:, :border] = allowed[:, -border:] = False
    allowed[..., :border] = allowed[..., -border:] = False
    if mask is not None:
        allowed &= mask.expand(*batch, height, width).reshape(-1, height, width)
    floor = (4 * level * filters.noise).clamp_min(low)
    found = _maxima(gx, gy, magnitude, allowed & (magnitude > floor[:, None, None]))
    image_of = found.place // (height * width)
    sigma = level[image_of] * filters.position_noise(found)
    _, preceding = link_edgels(found.x, found.gradient, found.place, (len(gray), height, width))
    chains = order_chains(preceding, image_of)
    x, gradient, sigma, spread, image_of, top, cosine = (
        v.index_select(0, chains.order)
        for v in (found.x, found.gradient, sigma, found.width, image_of, found.top, found.cosine)
    )
    curvature, drawn = chain_curvature(x, chains), 0.5 * _drawn_in(spread, cosine)
    # The radius comes out smaller by the shift.
    curvature = curvature / (1 + drawn * curvature.square())
    if not straight:
        shift = (curvature * drawn).clamp(-_MOST_BENT, _MOST_BENT)
        x = x + (shift / top)[:, None] * gradient
    strong = top >= (6 * level * filters.noise).clamp_min(high)[image_of]
    strong = torch.zeros_like(chains.chain).index_add(0, chains.chain, strong.long())[chains.chain] > 0
    keep = strong & (chains.length >= min_edgels)
    slot, fits, left_out = _slots(keep, image_of, chains.start + chains.length - 1, len(gray), max_edgels)
    rows = fits.nonzero()[:, 0]
    place = (image_of * max_edgels + slot).index_select(0, rows)

    def lay(values: Tensor, empty: float | int = 0) -> Tensor:
        out = values.new_full((len(gray) * max_edgels, *values.shape[1:]), empty)
        return out.index_copy(0, place, values.index_select(0, rows)).reshape(*batch, max_edgels, *values.shape[1:])

    number = _numbers(chains.chain, fits, image_of, len(gray))
    return Edges(
        lay(x), lay(gradient), lay(sigma), lay(spread), lay(curvature), lay(number, -1), lay(chains.closed), lay(fits),
        level.reshape(batch), left_out.reshape(batch),
    )  # fmt: skip


class _Filters(NamedTuple):
    """The smoothing and what it makes of white noise of variance 1."""

    smooth: list[float]
    """The kernel along an axis."""
    noise: float
    """Standard deviation of a derivative of the smoothed image."""
    along: float
    """Variance of the difference of two derivatives two pixels apart, along their direction."""
    across: float
    """The same across their direction."""

    def position_noise(self, found: "_Edgels") -> Tensor:
        """Standard deviation of positions across the edge: that of the two outer gradients, by the parabola."""
        cos2 = found.cosine.square()
        difference = (cos2 * self.along + (1 - cos2) * self.across).sqrt()
        # On the axis the profile is wider by 1 / cosine; across the edge the position counts by the cosine.
        return found.width.square() / found.cosine * difference / (2 * found.outer)


class _Edgels(NamedTuple):
    """A flat list of edge points."""

    place: Tensor
    """Pixel, image by image and row by row."""
    x: Tensor
    gradient: Tensor
    top: Tensor
    """Length of the gradient."""
    width: Tensor
    outer: Tensor
    """Geometric mean of the gradients of the pixels to both sides."""
    cosine: Tensor
    """Of the angle between the gradient and the axis that it is nearest to."""


def _filters(blur: float) -> _Filters:
    reach = math.ceil(4 * blur)
    kernel = [math.exp(-0.5 * (i / blur) ** 2) for i in range(-reach, reach + 1)]
    smooth = [k / sum(kernel) for k in kernel]
    padded = [0.0, 0.0, *smooth, 0.0, 0.0]
    slope = [0.5 * (padded[i + 1] - padded[i - 1]) for i in range(1, len(padded) - 1)]

    def product(kernel: list[float], lag: int) -> float:
        return sum(a * b for a, b in zip(kernel, kernel[lag:], strict=False))

    ss, dd = product(smooth, 0), product(slope, 0)
    along, across = 2 * ss * (dd - product(slope, 2)), 2 * dd * (ss - product(smooth, 2))
    return _Filters(smooth, math.sqrt(ss * dd), along, across)


def _noise(gray: Tensor, broken: Tensor) -> Tensor:
    """The noise of each image (b), from second differences in both directions, which edges hardly change on the whole."""
    d = gray[:, :-2].sub(gray[:, 1:-1], alpha=2).add_(gray[:, 2:])
    d = d[..., :-2].sub(d[..., 1:-1], alpha=2).add_(d[..., 2:]).abs_()
    spoiled = _near(broken, 1)[:, 1:-1, 1:-1]
    middle = d.masked_fill_(spoiled, torch.nan).flatten(1).nanmedian(-1).values
    return torch.where(middle.isnan(), 0.0, middle / (6 * 0.67449))


def _near(mask: Tensor, reach: int) -> Tensor:
    """Where anything within a square of `reach` pixels to each side is true."""
    if not bool(mask.any()):
        return mask
    size = 2 * reach + 1
    return torch.nn.functional.max_pool2d(mask[:, None].float(), size, stride=1, padding=reach)[:, 0] > 0


def _gradient(gray: Tensor, smooth: list[float]) -> tuple[Tensor, Tensor]:
    """Central differences (b, h, w) of the smoothed images along x and y."""
    reach = len(smooth) // 2 + 1
    maps = torch.nn.functional.pad(gray[:, None], (reach,) * 4, mode="replicate")[:, 0]
    for dim in (-1, -2):
        maps = _smoothed(maps, smooth, dim)
    return 0.5 * (maps[:, 1:-1, 2:] - maps[:, 1:-1, :-2]), 0.5 * (maps[:, 2:, 1:-1] - maps[:, :-2, 1:-1])


def _smoothed(maps: Tensor, kernel: list[float], dim: int) -> Tensor:
    """Convolution by a symmetric kernel, the same numbers whatever else is in the batch."""
    half, size = len(kernel) // 2, maps.shape[dim] - len(kernel) + 1
    total = kernel[half] * maps.narrow(dim, half, size)
    for i in range(half):
        total = total.add(maps.narrow(dim, i, size) + maps.narrow(dim, 2 * half - i, size), alpha=kernel[i])
    return total


def _maxima(gx: Tensor, gy: Tensor, magnitude: Tensor, allowed: Tensor) -> _Edgels:
    """Pixels with a larger gradient than both neighbours along the axis that it is nearest to, and the top between them."""
    flat = gx.abs() >= gy.abs()
    # The border is not allowed: what rolls in there is not looked at.
    before = torch.where(flat, magnitude.roll(1, -1), magnitude.roll(1, -2))
    after = torch.where(flat, magnitude.roll(-1, -1), magnitude.roll(-1, -2))
    place = (allowed & (magnitude > before) & (magnitude >= after)).flatten().nonzero()[:, 0]
    height, width = gx.shape[-2:]
    column, row = place % width, place // width % height
    a, b, c, level = (m.flatten().index_select(0, place) for m in (before, magnitude, after, flat))
    tiny = 1e-3 * b
    a, c = torch.maximum(a, tiny), torch.maximum(c, tiny)
    la, lb, lc = a.log(), b.log(), c.log()
    bend = (2 * lb - la - lc).clamp_min(_WIDEST**-2)
    offset = (0.5 * (lc - la) / bend).clamp(-0.5, 0.5)
    step = torch.where(level, 1, width) * torch.where(offset < 0, -1, 1)
    share = offset.abs()
    beside = place + step
    gradient = torch.stack(
        [torch.lerp(g.flatten().index_select(0, place), g.flatten().index_select(0, beside), share) for g in (gx, gy)], -1
    )
    top = gradient.square().sum(-1).sqrt()
    cosine = torch.where(level, gradient[:, 0], gradient[:, 1]).abs() / top
    x = torch.stack((column, row), -1).to(gx.dtype)
    x = x + torch.stack((torch.where(level, offset, 0.0), torch.where(level, 0.0, offset)), -1)
    return _Edgels(place, x, gradient, top, cosine / bend.sqrt(), (a * c).sqrt(), cosine)


def _drawn_in(width: Tensor, cosine: Tensor) -> Tensor:
    """What the curvature is multiplied by in twice the inward shift of an edge, by its angle a to the nearest axis.

    For round smoothing that is its variance. Central differences add a variance of 1/3 along their axis alone: by
    `cos^2(2 a) / 3` less along the edge than across it, where the profile tells it, while the directions of the two differences
    change across a bent edge, which adds `sin^2(2 a) / 3`. And the distance of the middle pixel's neighbours on the axis from
    the edge bends by `sin^2 a`, which moves the top of the parabola.
    """
    square = cosine.square()
    return width.square() + (1 - square) - (8 * square * (square - 1) + 1) / 3


def _slots(keep: Tensor, image: Tensor, last: Tensor, images: int, slots: int) -> tuple[Tensor, Tensor, Tensor]:
    """A slot in its image for each kept edge point, whether its whole chain has slots, and how many have none in each image."""
    per_image = torch.zeros(images, dtype=torch.long, device=keep.device).index_add(0, image, keep.long())
    first = per_image.cumsum(0) - per_image
    running = keep.long().cumsum(0)
    slot = running - 1 - first[image]
    fits = keep & (running[last] - first[image] <= slots) if len(keep) else keep
    placed = torch.zeros_like(per_image).index_add(0, image, fits.long())
    return slot, fits, per_image - placed


def _numbers(chain: Tensor, fits: Tensor, image: Tensor, images: int) -> Tensor:
    """Numbers of the chains that have slots, from 0 in each image."""
    begins = torch.zeros_like(fits)
    begins[1:] = chain[1:] != chain[:-1]
    begins[:1] = True
    begins &= fits
    running = begins.long().cumsum(0)
    per_image = torch.zeros(images, dtype=torch.long, device=chain.device).index_add(0, image, begins.long())
    return running - 1 - (per_image.cumsum(0) - per_image)[image]
