"""Images with edges whose place is known, painted many times finer, blurred as by a lens and averaged as by a sensor."""

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

FINE = 6


def paint(inside: Tensor, blur: float = 0.6) -> Tensor:
    """The image (1, h, w) of what is bright where the distance `inside`, over the fine grid in pixels, is positive."""
    covered = (inside * FINE + 0.5).clamp(0, 1)
    reach = math.ceil(4 * blur * FINE)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=covered.dtype) / (blur * FINE)).square())
    kernel = kernel / kernel.sum()
    maps = pad(covered[None, None], (reach,) * 4, mode="replicate")
    maps = conv2d(conv2d(maps, kernel[None, None, :, None]), kernel[None, None, None])[0, 0]
    h, w = (n // FINE for n in maps.shape)
    return maps.reshape(h, FINE, w, FINE).mean((1, 3))[None]


def grid(size: int) -> tuple[Tensor, Tensor]:
    """The coordinates x and y of the fine samples, in pixels."""
    along = (torch.arange(size * FINE, dtype=torch.float64) + 0.5) / FINE - 0.5
    return along.expand(size * FINE, -1), along[:, None].expand(-1, size * FINE)


def half_plane(angle: float, offset: float, size: int = 64, blur: float = 0.6) -> Tensor:
    """Bright where cos(angle) x + sin(angle) y > offset, from the middle of the image; without painting, exactly."""
    x, y = grid(size)
    middle = (size - 1) / 2
    away = (x - middle) * math.cos(angle) + (y - middle) * math.sin(angle) - offset
    return (0.5 + 0.5 * torch.erf(away / (blur * math.sqrt(2)))).reshape(size, FINE, size, FINE).mean((1, 3))[None]


def disc(cx: float, cy: float, radius: float, size: int = 64, blur: float = 0.6) -> Tensor:
    """A bright disc."""
    x, y = grid(size)
    return paint(radius - ((x - cx).square() + (y - cy).square()).sqrt(), blur)


def polygon(corners: Tensor, size: int = 64, blur: float = 0.6) -> Tensor:
    """A bright convex polygon; corners (n, 2) in the order in which x turns to y."""
    x, y = grid(size)
    along = corners.roll(-1, 0) - corners
    along = along / along.norm(dim=-1, keepdim=True)
    away = [a[0] * (y - p[1]) - a[1] * (x - p[0]) for a, p in zip(along, corners, strict=True)]
    return paint(torch.stack(away).amin(0), blur)
