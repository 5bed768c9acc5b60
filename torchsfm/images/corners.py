"""Corners: points where the image changes in every direction."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors

_SOBEL = ((-0.125, 0.0, 0.125), (-0.25, 0.0, 0.25), (-0.125, 0.0, 0.125))


@dataclass(frozen=True)
class Corners:
    """Corners of images, in slots of which `valid` ones hold a corner, strongest first.

    Example:
        >>> import torch, torchsfm
        >>> images = torch.zeros(2, 60, 80)
        >>> images[0, 20:40, 30:50] = 1.0  # a square, and an empty image
        >>> found = torchsfm.images.detect_corners(images[:, None])
        >>> found.valid.sum(-1), bool((found.score[0, :-1] >= found.score[0, 1:]).all())  # the best first
        (tensor([4, 0]), True)
    """

    x: Float[Tensor, "*batch n 2"]
    """Pixel positions; (0, 0) is the centre of the top-left pixel, and what empty slots hold."""
    score: Float[Tensor, "*batch n"]
    """The response; 0 in empty slots."""
    valid: Bool[Tensor, "*batch n"]
    """Which slots hold a corner: the first ones of each image."""


def detect_corners(
    image: Float[Tensor, "*#batch c h w"],
    max_corners: int = 1000,
    *,
    response: Literal["gftt", "harris"] = "gftt",
    quality: float = 0.01,
    min_distance: int = 5,
    border: int = 4,
    mask: Bool[Tensor, "*#batch h w"] | None = None,
) -> Corners:
    """The strongest corners of each image, to a fraction of a pixel.

    The response is the smaller eigenvalue of the structure tensor (Shi and Tomasi, CVPR 1994) or Harris and Stephens' (1988).
    Its local maxima are moved to the point where the edges around them meet (Foerstner and Guelch, 1987); where that point is
    ill-defined, or more than three pixels away, to the top of a quadratic surface through the response.

    Args:
        image: Grey (c = 1) or red, green, blue images.
        max_corners: The number of slots for each image.
        response: Which response to use.
        quality: Smallest response, as a share of the strongest in the same image.
        min_distance: No two corners share a square of this many pixels to each side, before the sub-pixel step.
        border: Corners nearer than this to the edge of the image are left out.
        mask: Where corners may be.

    Returns:
        Corners in descending order of response. An image without any, or one with NaN where it counts, has none valid there.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 20:40, 30:50] = 1.0  # a square
        >>> found = torchsfm.images.detect_corners(image)
        >>> found.valid.sum(), found.x[found.valid].mean(0)
        (tensor(4), tensor([39.5000, 29.5000]))
    """
    batch = check_tensors(image=(image, "c h>=8 w>=8"), mask=(mask, "?h w: bool"))
    check_options(
        max_corners=(max_corners, "int >= 1"), response=(response, ("gftt", "harris")), quality=(quality, "float >= 0"),
        min_distance=(min_distance, "int >= 1"), border=(border, "int >= 1"),
    )  # fmt: skip
    channels, height, width = image.shape[-3:]
    if channels not in (1, 3):
        raise ValueError(f"image: wanted 1 or 3 channels, got {channels}")
    gray = to_gray(image.expand(*batch, channels, height, width).reshape(-1, channels, height, width))
    tensor = structure_tensor(gray)
    strength = corner_response(tensor, response)
    strength = torch.where(strength.isfinite(), strength, 0.0)
    # Of equal neighbours the first alone is a maximum: double precision has room for the pixel's number behind the response's.
    order = torch.arange(height * width, device=image.device, dtype=torch.float64).reshape(height, width)
    key = strength.double() * (1 - order * 2.0**-51)
    keep = (key == box_maximum(key, min_distance)) & (strength > 0)
    keep &= strength > quality * strength.amax((-2, -1), keepdim=True)
    keep[..., :border, :] = keep[..., -border:, :] = False
    keep[..., :border] = keep[..., -border:] = False
    if mask is not None:
        keep &= mask.expand(*batch, height, width).reshape(-1, 1, height, width)
    slots = min(max_corners, height * width)
    score, flat = torch.where(keep, strength, 0.0).flatten(1).topk(slots)
    # Nothing is done for slots that are empty in all images.
    slots = int((score > 0).sum(-1).amax()) if len(score) else 0
    score, flat = score[:, :slots], flat[:, :slots]
    valid = score > 0
    offset = _sub_pixel(gray, tensor, strength, flat)
    x = torch.stack([flat % width, flat // width], -1) + offset
    x = torch.where(valid[..., None], x, 0.0)
    empty = max_corners - slots
    x = torch.nn.functional.pad(x, (0, 0, 0, empty))
    score, valid = (torch.nn.functional.pad(t, (0, empty)) for t in (score, valid))
    return Corners(x.reshape(*batch, max_corners, 2), score.reshape(*batch, max_corners), valid.reshape(*batch, max_corners))


def box_maximum(maps: Float[Tensor, "*batch h w"], radius: int) -> Float[Tensor, "*batch h w"]:
    """The largest value in the square of `radius` pixels to each side; by doubling, so that the size hardly matters."""
    for dim in (-1, -2):
        length, size = maps.shape[dim], 2 * radius + 1
        pad = (radius, radius) if dim == -1 else (0, 0, radius, radius)
        maps = torch.nn.functional.pad(maps, pad, value=-torch.inf)
        reach = 1
        while reach < size:
            step = min(reach, size - reach)
            count = maps.shape[dim] - step
            maps = torch.maximum(maps.narrow(dim, 0, count), maps.narrow(dim, step, count))
            reach += step
        maps = maps.narrow(dim, 0, length)
    return maps


def to_gray(image: Float[Tensor, "*batch c h w"]) -> Float[Tensor, "*batch 1 h w"]:
    """Luma of red, green, blue images (ITU-R BT.601); grey images as they are."""
    if image.shape[-3] == 1:
        return image
    weights = image.new_tensor([0.299, 0.587, 0.114])
    return (image * weights[:, None, None]).sum(-3, keepdim=True)


def structure_tensor(gray: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Products of Sobel derivatives xx, xy, yy, averaged by a 7 x 7 Gaussian of one pixel."""
    gradient = image_gradient(gray)
    gx, gy = gradient[:, :1], gradient[:, 1:]
    return _blur(torch.cat([gx * gx, gx * gy, gy * gy], 1))


def image_gradient(gray: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 2 h w"]:
    """Sobel derivatives along x and y, in image values per pixel."""
    kernel = gray.new_tensor(_SOBEL)
    padded = torch.nn.functional.pad(gray, (1, 1, 1, 1), mode="replicate")
    return torch.nn.functional.conv2d(padded, torch.stack([kernel, kernel.mT])[:, None])


def corner_response(tensor: Float[Tensor, "b 3 h w"], response: Literal["gftt", "harris"]) -> Float[Tensor, "b 1 h w"]:
    """The response map of a structure tensor."""
    xx, xy, yy = tensor[:, :1], tensor[:, 1:2], tensor[:, 2:]
    if response == "gftt":
        return (xx + yy - ((xx - yy).square() + 4 * xy.square()).sqrt()) / 2
    return xx * yy - xy.square() - (xx + yy).square() * 0.04


def _blur(maps: Tensor) -> Tensor:
    channels = maps.shape[1]
    steps = torch.arange(-3, 4, device=maps.device, dtype=maps.dtype)
    kernel = torch.exp(-0.5 * steps.square())
    kernel = (kernel / kernel.sum()).expand(channels, 1, 7)
    maps = torch.nn.functional.pad(maps, (3, 3, 3, 3), mode="reflect")
    maps = torch.nn.functional.conv2d(maps, kernel[:, :, :, None], groups=channels)
    return torch.nn.functional.conv2d(maps, kernel[:, :, None], groups=channels)


def _sub_pixel(gray: Tensor, tensor: Tensor, strength: Tensor, flat: Tensor) -> Tensor:
    """Offsets (b, n, 2) from the pixels `flat` (b, n) to the corners."""
    surface = _top_of_surface(strength, flat)
    junction, good = _junction(gray, flat)
    return torch.where(good[..., None], junction, surface)


def _patches(maps: Tensor, flat: Tensor, radius: int) -> Tensor:
    """Square windows (b, n, c, 2 radius + 1, 2 radius + 1) of maps (b, c, h, w) around the pixels `flat` (b, n)."""
    size = 2 * radius + 1
    maps = torch.nn.functional.pad(maps, (radius, radius, radius, radius), mode="replicate")
    width = maps.shape[-1]
    inner = width - 2 * radius
    start = flat // inner * width + flat % inner
    steps = torch.arange(size, device=flat.device)
    index = start[..., None] + (steps[:, None] * width + steps).flatten()
    (b, n), channels = flat.shape, maps.shape[1]
    values = maps.flatten(2).gather(2, index.reshape(b, 1, n * size * size).expand(b, channels, n * size * size))
    return values.reshape(b, channels, n, size, size).transpose(1, 2)


def _top_of_surface(strength: Tensor, flat: Tensor) -> Tensor:
    p = _patches(strength, flat, 1)[:, :, 0]
    gx, gy = 0.5 * (p[..., 1, 2] - p[..., 1, 0]), 0.5 * (p[..., 2, 1] - p[..., 0, 1])
    xx = p[..., 1, 2] - 2 * p[..., 1, 1] + p[..., 1, 0]
    yy = p[..., 2, 1] - 2 * p[..., 1, 1] + p[..., 0, 1]
    xy = 0.25 * (p[..., 2, 2] - p[..., 2, 0] - p[..., 0, 2] + p[..., 0, 0])
    det = xx * yy - xy * xy
    peak = (det > 1e-12 * (xx.abs() + yy.abs()).square()) & (xx + yy < 0)
    safe = torch.where(peak, det, 1.0)
    offset = torch.stack([(xy * gy - yy * gx) / safe, (xy * gx - xx * gy) / safe], -1)
    return torch.where(peak[..., None], offset.clamp(-0.5, 0.5), 0.0)


def _junction(gray: Tensor, flat: Tensor, radius: int = 4, rounds: int = 8) -> tuple[Tensor, Tensor]:
    """Foerstner's point: the least squares intersection of the edges around it. The window follows the point."""
    margin = 3  # how far the point may move
    reach = radius + margin
    gradient = _patches(image_gradient(gray), flat, reach)
    gx, gy = gradient[:, :, 0], gradient[:, :, 1]
    steps = torch.arange(-reach, reach + 1, device=gray.device, dtype=gray.dtype)
    px, py = steps.expand(len(steps), -1), steps[:, None].expand(-1, len(steps))
    offset = torch.zeros(*flat.shape, 2, dtype=gray.dtype, device=gray.device)
    good = torch.ones_like(flat, dtype=torch.bool)
    xx, xy, yy = gx * gx, gx * gy, gy * gy
    for _ in range(rounds):
        away = (px - offset[..., :1, None]).square() + (py - offset[..., 1:, None]).square()
        weight = torch.exp(-0.5 * away / (0.5 * radius) ** 2)
        a, b, c = (weight * xx).sum((-2, -1)), (weight * xy).sum((-2, -1)), (weight * yy).sum((-2, -1))
        u = (weight * (xx * px + xy * py)).sum((-2, -1))
        v = (weight * (xy * px + yy * py)).sum((-2, -1))
        det, trace = a * c - b * b, a + c
        good = good & (det > 0.02 * trace.square()) & trace.isfinite()
        safe = torch.where(good, det, 1.0)
        moved = torch.stack([(c * u - b * v) / safe, (a * v - b * u) / safe], -1)
        good = good & (moved.square().sum(-1) <= margin**2)
        offset = torch.where(good[..., None], moved, offset)
    return offset, good
