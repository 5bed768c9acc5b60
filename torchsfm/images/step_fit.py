"""Where a straight step of brightness is, from the pixels beside it: a blurred step is fitted to their values.

The top of the gradient, which edge points are at, uses a part of what pixels tell. All of it is in the least squares of
`base + contrast * Phi((q - shift - turn t) / spread)` over pixels t along and q across the segment, where noise is all that is
left of them: where there is more, as of texture or another edge, the step is no model of what is seen.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_REACHES = (6.0, 3.0)
"""How far to both sides pixels are looked at, in pixels: levels are told better from afar, but more is there that disturbs."""
_INSET = 0.5
"""What is left out at each end, as corners bend it."""
_NOISY = 1.5
"""Standard deviation of what is left, in those of the image's noise, up to which that is noise."""
_LOOKS, _BESIDE = 12, 2.5
"""How many pixels along each side, how many spreads away, are looked at first,"""
_UNEVEN = 6.0
"""and their variance, in that of the noise, at which there is more than that."""
_TREND, _ROUGH = 4.5, 0.01
"""Mean of what is left in a strip, in its standard deviations, and in contrasts, that noise and the shape of pixels explain."""
_STEPS = 4
_MOST = 0.5
"""Farthest that a step is from where its edge points are, in pixels."""
_SPREAD = (0.3, 3.0)
"""Spreads of a step that is one, in pixels."""
_UPPER = [(i, j) for i in range(5) for j in range(i, 5)]


class StepFit(NamedTuple):
    """Lines where steps are."""

    good: Bool[Tensor, " n"]
    """Where there is a step, and nothing else but noise."""
    middle: Float[Tensor, "n 2"]
    """The point of the line at which place and direction have independent errors."""
    direction: Float[Tensor, "n 2"]
    half: Float[Tensor, " n"]
    """Distance from there of the two points whose errors, as independent ones, are those of the line."""
    variance: Float[Tensor, " n"]
    """Of each of the two across the line."""


class _Pixels(NamedTuple):
    """Pixels beside segments, in the order of these."""

    of: Int[Tensor, " m"]
    t: Float[Tensor, " m"]
    q: Float[Tensor, " m"]
    value: Float[Tensor, " m"]


def fit_steps(
    gray: Float[Tensor, "b h w"],
    level: Float[Tensor, " n"],
    image: Int[Tensor, " n"],
    ends: Float[Tensor, "n 2 2"],
    spread: Float[Tensor, " n"],
) -> StepFit:
    """Fit steps, which are brighter to the left from the first end to the second, as seen on the screen.

    Args:
        gray: Images.
        level: Standard deviation of the noise of each segment's image.
        image: In which image each segment is.
        ends: Of segments, in pixels.
        spread: Standard deviations of the profiles of their steps, about, in pixels.
    """
    zero = torch.zeros_like(ends[:, 0], dtype=torch.float64)
    found = StepFit(torch.zeros_like(image, dtype=torch.bool), zero, zero, zero[:, 0], zero[:, 0])
    even = _even(gray, level, image, ends.double(), spread.double())
    for reach in _REACHES:
        (at,) = (even & ~found.good).nonzero(as_tuple=True)
        if len(at):
            near = _fit(gray, level[at], image[at], ends[at], spread[at], reach)
            found = StepFit(*(old.index_copy(0, at, new) for old, new in zip(found, near, strict=True)))
    return found


def _even(gray: Tensor, level: Tensor, image: Tensor, ends: Tensor, spread: Tensor) -> Tensor:
    """Where little more than noise is seen along both sides of segments, at a few pixels: what else there is takes no time."""
    height, width = gray.shape[1:]
    middle, half = ends.mean(1), 0.5 * (ends[:, 1] - ends[:, 0])
    direction = half / torch.linalg.vector_norm(half, dim=-1, keepdim=True).clamp_min(1e-9)
    off = _BESIDE * spread.clamp_min(1.0)[:, None] * torch.stack((direction[:, 1], -direction[:, 0]), -1)
    t = torch.linspace(-0.9, 0.9, _LOOKS, dtype=ends.dtype, device=ends.device)[:, None]
    # (n, side, look, coordinate)
    at = middle[:, None, None] + torch.stack((off, -off), 1)[:, :, None] + half[:, None, None] * t
    column, row = at[..., 0].round().long().clamp(0, width - 1), at[..., 1].round().long().clamp(0, height - 1)
    value = gray[image[:, None, None], row, column].double()
    variance = (value - value.mean(-1, keepdim=True)).square().mean(-1)
    even: Tensor = (variance <= (_UNEVEN * level.double().square())[:, None]).all(-1)
    return even


def _fit(gray: Tensor, level: Tensor, image: Tensor, ends: Tensor, spread: Tensor, reach: float) -> StepFit:
    n, ends, level = len(image), ends.double(), level.double()
    middle, half = ends.mean(1), 0.5 * (ends[:, 1] - ends[:, 0])
    length = torch.linalg.vector_norm(half, dim=-1).clamp_min(1e-9)
    direction = half / length[:, None]
    normal = torch.stack((direction[:, 1], -direction[:, 0]), -1)
    strips = math.ceil(2 * reach)
    of, t, q, value = _beside(gray, image, middle, direction, length - _INSET, reach)
    # Numbers of about one size.
    t = t / length[of]

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(n, *values.shape[1:]).index_add(0, of, values)

    number, bright, all_ = total(torch.stack((torch.ones_like(q), (q > 0).double(), value), -1)).unbind(-1)
    above = total(torch.where(q > 0, value, 0.0))
    low = (all_ - above) / (number - bright).clamp_min(1)
    # shift, turn, spread, base, contrast
    x = torch.stack(
        (torch.zeros_like(low), torch.zeros_like(low), spread.double().clamp(*_SPREAD), low, above / bright.clamp_min(1) - low)
    )
    left, information = x[0], [x[0]]
    for step in range(_STEPS + 1):
        shift, turn, s, base, contrast = x[:, of].unbind(0)
        u = (q - shift - turn * t) / s
        profile = 0.5 * torch.erfc(u * -math.sqrt(0.5))
        slope = contrast / s * torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)
        r = value - base - contrast * profile
        rows = (-slope, -slope * t, -slope * u, torch.ones_like(u), profile)
        if step == _STEPS:
            weight = slope * slope
            left, *information = total(torch.stack((r * r, weight, weight * t, weight * t * t), -1)).unbind(-1)
            strip = of * strips + (q + reach).long().clamp(max=strips - 1)
            plain = _even_strips(r, strip, (n, strips), level, x[4])
            break
        sums = total(torch.stack([*(rows[i] * rows[j] for i, j in _UPPER), *(row * r for row in rows)], -1))
        N = sums.new_zeros(n, 5, 5)
        for k, (i, j) in enumerate(_UPPER):
            N[:, i, j] = N[:, j, i] = sums[:, k]
        scale = N.diagonal(dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
        moved = torch.linalg.solve_ex(N * scale[:, :, None] * scale[:, None], sums[:, -5:] * scale)[0] * scale
        moved = moved.nan_to_num(0, 0, 0).mT
        before = x
        x = x + moved
        x[2] = x[2].clamp(0.7 * before[2], 1.4 * before[2])
    variance = left / (number - 5).clamp_min(1)
    whole, first, second = (v.clamp_min(1e-300) if i != 1 else v for i, v in enumerate(information))
    centre = first / whole
    wide = (second / whole - centre * centre).clamp_min(0).sqrt()
    shift, turn, s, _, contrast = x.unbind(0)
    good = (variance <= (_NOISY * level) ** 2) & (number > 20) & (contrast > 0) & (s > _SPREAD[0]) & (s < _SPREAD[1])
    good &= (shift.abs() + turn.abs() <= _MOST) & (wide > 0.1) & plain
    slope = turn / length
    along = direction + slope[:, None] * normal
    point = middle + (shift + turn * centre)[:, None] * normal + (centre * length)[:, None] * direction
    size = (1 + slope * slope).sqrt()
    variance = 2 * torch.maximum(variance, level * level) / whole
    return StepFit(good, point, along / size[:, None], wide * length * size, variance)


def _even_strips(r: Tensor, strip: Tensor, size: tuple[int, int], level: Tensor, contrast: Tensor) -> Tensor:
    """Whether what is left may be noise (n) in the mean of each strip, a pixel wide, along segments: of another step it is not.

    Args:
        r: What is left of pixels.
        strip: The number of the strip of each, segment by segment.
        size: How many segments, and strips of each.
        level: The standard deviation of noise.
        contrast: Of the steps, of which a hundredth is what a pixel is no part of a Gaussian profile by.
    """
    rows = r.new_zeros(size[0] * size[1], 2).index_add(0, strip, torch.stack((r, torch.ones_like(r)), -1))
    total, number = rows.view(*size, 2).unbind(-1)
    most = _TREND * level[:, None] * number.sqrt() + _ROUGH * contrast.abs()[:, None] * number
    even: Tensor = (total.abs() <= most).all(-1)
    return even


def _beside(gray: Tensor, image: Tensor, middle: Tensor, direction: Tensor, half: Tensor, reach: float) -> _Pixels:
    """The pixels up to `half` along and `reach` across lines, column by column, or row by row of what is upright."""
    height, width = gray.shape[1:]
    flat = direction[:, 0].abs() >= direction[:, 1].abs()
    d = torch.where(flat[:, None], direction, direction.flip(-1))
    m = torch.where(flat[:, None], middle, middle.flip(-1))
    margin = reach * d[:, 1].abs() + half * d[:, 0].abs()
    first = (m[:, 0] - margin).ceil()
    number = ((m[:, 0] + margin).floor() - first + 1).clamp_min(0).long()
    of = torch.arange(len(image), device=image.device).repeat_interleave(number)
    place = torch.arange(len(of), device=of.device) - (number.cumsum(0) - number)[of]
    u = first[of] + place
    most = math.ceil(reach * math.sqrt(2))
    crossing = (m[of, 1] + (u - m[of, 0]) * (d[:, 1] / d[:, 0])[of]).round()
    v = crossing[:, None] + torch.arange(-most, most + 1, device=u.device)
    of, u, v = of[:, None].expand(v.shape).flatten(), u[:, None].expand(v.shape).flatten(), v.flatten()
    x, y = torch.where(flat[of], u, v), torch.where(flat[of], v, u)
    a, b = x - middle[of, 0], y - middle[of, 1]
    c, s = direction[of].unbind(-1)
    t, q = a * c + b * s, a * s - b * c
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (t.abs() <= half[of]) & (q.abs() <= reach)
    of, t, q = of[inside], t[inside], q[inside]
    row = ((image[of] * height + y[inside].long()) * width) + x[inside].long()
    value = gray.reshape(-1)[row].double()
    sound = value.isfinite()
    return _Pixels(of[sound], t[sound], q[sound], value[sound])
