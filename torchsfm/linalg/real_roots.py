"""All real roots of batched polynomials of any degree, in fixed slots, by elementwise arithmetic alone.

The projective line is cut into 128 cells of equal angle, x = tan(phi), in four sectors: the polynomial and its reversal, for
arguments between 0 and 1 and between -1 and 0. On the circle the polynomial is the form h(phi) = cos(phi)^n p(tan phi). Values
and derivatives at the nodes tell, by the Bernstein coefficients of the cubic through them, which cells may hold several roots;
up to four of those are cut once more, in eight. There a sign change is one root, and a dip towards zero one pair of roots or
none. The cubic gives a start, Newton's method between bounds the root. Cells are found and counted by the bits of whole
numbers: no sorting, no branch, no shape that depends on the data.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_CELLS = 32
"""Cells from 0 to 45 degrees."""
_CLOSER = 4
"""Cells looked at more closely ..."""
_PARTS = 8
"""... and the parts they are cut into."""
_STEP = math.pi / 4 / _CELLS
_MARGIN = 2.0
"""A cubic's Bernstein coefficient is h + (step / 3) h'; 2 in the place of 3 makes up for what is not cubic."""
_WORD = 48
"""Bits of a word: whole numbers below 2^53 are exact in float64."""


def real_roots(c: Float[Tensor, "*batch m"]) -> tuple[Float[Tensor, "*batch slots"], Bool[Tensor, "*batch slots"]]:
    """The real roots of polynomials of degree m - 1 >= 2, each in a slot of its own.

    Found are all roots, except where three or more lie within about 0.2 degrees of each other as angles atan(x), or more than
    four places have several roots within about 1.4 degrees: scale the argument so that roots of interest are around 1. Two
    real roots that rounding cannot tell from a complex pair may be missing.

    Args:
        c: Coefficients, lowest power first. Leading coefficients may be zero, which makes a root infinite.

    Returns:
        Roots in m - 1 slots and the mask of slots that hold one; infinite roots are left out, other slots are zero. Polynomials
        that are zero or not finite have none. Not differentiable.
    """
    with torch.no_grad():
        rows = c.detach().reshape(-1, c.shape[-1]).mT
        s, t, real = real_root_rows(rows.contiguous())
        real = real & (t.abs() > torch.finfo(c.dtype).tiny ** 0.5)
        x = torch.where(real, s / t, 0)
        shape = (*c.shape[:-1], c.shape[-1] - 1)
        return x.mT.reshape(shape), real.mT.reshape(shape)


def real_root_rows(
    c: Float[Tensor, "m batch"],
) -> tuple[Float[Tensor, "slots batch"], Float[Tensor, "slots batch"], Bool[Tensor, "slots batch"]]:
    """The real roots x = s / t of polynomials that stand in columns, and which slots hold one; max(|s|, |t|) = 1.

    The homogeneous form holds infinite roots too (t = 0).
    """
    n = c.shape[0] - 1
    finite = torch.isfinite(c).all(0)
    c = torch.where(finite, c, 0)
    both = torch.stack((c, c.flip(0)), 1)
    z, first = _nodes(both)
    values = first[:, :, 0], first[:, :, 1]
    changes, several = _several(*values, z.new_tensor([_STEP, -_STEP])[:, None, None])
    single = (changes & ~several).flatten(0, 2)
    i1, ok1 = _positions(single, n)
    close, used = _positions(several.flatten(0, 2), _CLOSER)
    second = _closer(both, z, close)
    minus = (close & 2) != 0
    changes, several = _several(second[:, 0], second[:, 1], torch.where(minus, -_STEP / _PARTS, _STEP / _PARTS))
    i2, ok2 = _positions((changes & used).flatten(0, 1), n)
    i3, ok3 = _positions((several & ~changes & used).flatten(0, 1), n // 2)
    # Single roots fill the slots from the front, pairs from the back; n slots are enough for both.
    slot = torch.arange(n, device=c.device)
    i2, ok2 = _after(i2, ok2, slot[:, None] - ok1.sum(0))
    back = (n - 1 - slot) // 2
    back = back.clamp_max(n // 2 - 1)
    left, right = ok1 | ok2, ((n - 1 - slot) % 2 == 1)[:, None]
    pair = ~left & ok3[back]
    part = torch.where(ok2 & ~ok1, i2, i3[back])
    piece = part // _CLOSER
    parent = close.gather(0, part - piece * _CLOSER)
    cell = torch.where(ok1, i1, parent)
    reverse, minus, g = (cell & 1) != 0, (cell & 2) != 0, cell >> 2
    # Values at both ends of the slot's cell.
    rows = torch.cat((first.flatten(0, 3), second.flatten(0, 2)))
    at = torch.where(
        ok1, g * 8 + (cell & 2) * 2 + (cell & 1), first.shape[0] * 8 + piece * 2 * _CLOSER + part - piece * _CLOSER
    )
    to_slope = torch.where(ok1, 2, _CLOSER)
    to_next = torch.where(ok1, 8, 2 * _CLOSER)
    p0, p1 = rows.gather(0, at), rows.gather(0, at + to_next)
    q0, q1 = rows.gather(0, at + to_slope), rows.gather(0, at + to_next + to_slope)
    step = torch.where(ok1, _STEP, _STEP / _PARTS)
    tiles = torch.tan(torch.arange(_PARTS, dtype=c.dtype, device=c.device) * (_STEP / _PARTS))
    low = _turn(z[g], tiles[torch.where(ok1, 0, piece)])
    high = _turn(low, torch.where(ok1, math.tan(_STEP), math.tan(_STEP / _PARTS)))
    # From here on the path goes up from low to high, and h is positive at its start.
    weight = ((1 + low * low) / (1 + high * high)) ** (n // 2)
    up = torch.copysign(torch.ones_like(p0), p0)
    along = torch.where(minus, -step, step) * up
    start, dip = _cubic_start(p0.abs(), p1 * weight * up, q0 * along, q1 * weight * along, pair)
    y = _turn(low, start * step * (1 + (start * step) ** 2 / 3))
    # The coefficients of the slot's sector, with the sign of the side in the odd ones.
    k = torch.where(reverse, both[:, 1, None], both[:, 0, None]) * up
    k[1::2] = torch.where(minus, -k[1::2], k[1::2])
    y, found = _newton(k, y, low, high, dip / (step * step), pair, right, n)
    found = found & (left | pair) & finite
    y = torch.where(found, torch.where(minus, -y, y), 0)
    one = torch.ones_like(y)
    return torch.where(reverse, one, y), torch.where(reverse, y, one), found


def _turn(z: Tensor, tangent: Tensor | float) -> Tensor:
    """The tangent of the sum of two angles."""
    return (z + tangent) / (1 - z * tangent)


def _nodes(both: Float[Tensor, "m 2 batch"]) -> tuple[Float[Tensor, " nodes"], Float[Tensor, "nodes 2 2 2 batch"]]:
    """The nodes z, and at [node, side (+z, -z), value or slope, polynomial or reversal] what the cells are judged by.

    The slope is (1 + z^2) p' - n z p, a positive multiple of h' as the value p is of h, both with the same factor.
    """
    n = both.shape[0] - 1
    z = torch.tan(torch.arange(_CELLS + 1, dtype=both.dtype, device=both.device) * _STEP)
    z[-1] = 1
    k = torch.arange(n + 1, dtype=both.dtype, device=both.device)[:, None, None]
    q = torch.zeros_like(both)
    q[:-1] = both[1:] * k[1:]
    q[1:] -= both[:-1] * (n - k[:-1])
    c = torch.stack((both, q), 1)
    square = (z * z)[:, None, None, None]
    even, odd = _horner(c[0::2], square), _horner(c[1::2], square)
    odd = odd * z[:, None, None, None]
    return z, torch.stack((even + odd, even - odd), 1)


def _horner(c: Tensor, x: Tensor) -> Tensor:
    value = c[-1].expand(torch.broadcast_shapes(c.shape[1:], x.shape)).clone()  # type: ignore[no-untyped-call]
    for i in range(c.shape[0] - 2, -1, -1):
        torch.addcmul(c[i], value, x, out=value)
    return value


def _horner_slope(c: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives; c has one dimension more than x, in front."""
    value, slope = torch.addcmul(c[-2], c[-1], x), c[-1].expand_as(x).clone()
    for i in range(c.shape[0] - 3, -1, -1):
        torch.addcmul(value, slope, x, out=slope)
        torch.addcmul(c[i], value, x, out=value)
    return value, slope


def _several(p: Tensor, q: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Which cells between neighbours in the first dimension change sign, and which may hold two roots or more."""
    positive = p > 0
    third = q * (step / _MARGIN)
    out, back = positive ^ ((p + third) > 0), positive ^ ((p - third) > 0)
    changes = positive[1:] ^ positive[:-1]
    out, back = out[:-1], back[1:]
    return changes, (out & back) | (~changes & (out | back))


def _positions(bits: Bool[Tensor, "cells batch"], count: int) -> tuple[Int[Tensor, "count batch"], Bool[Tensor, "count batch"]]:
    """The first `count` cells whose bit is set, and whether there are that many; 0 where there are not."""
    index, ok = _word_positions(bits[:_WORD], count)
    for start in range(_WORD, bits.shape[0], _WORD):
        more, more_ok = _word_positions(bits[start : start + _WORD], count)
        more, more_ok = _after(more, more_ok, torch.arange(count, device=bits.device)[:, None] - ok.sum(0))
        index, ok = torch.where(ok, index, more + start), ok | more_ok
    return torch.where(ok, index, 0), ok


def _after(index: Tensor, ok: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    take = shift.clamp_min(0)
    return index.gather(0, take), ok.gather(0, take) & (shift >= 0)


def _word_positions(bits: Tensor, count: int) -> tuple[Tensor, Tensor]:
    powers = 2.0 ** torch.arange(bits.shape[0], dtype=torch.float64, device=bits.device)
    # Sums of powers of two are exact in any order.
    word = (powers @ bits.double()).long()
    lowest = []
    for _ in range(count):
        bit = word & -word
        lowest.append(bit)
        word = word ^ bit
    bit = torch.stack(lowest)
    # The exponent of a power of two.
    return ((bit.double().view(torch.int64) >> 52) - 1023).clamp_min(0), bit != 0


def _closer(both: Tensor, z: Tensor, cell: Int[Tensor, "closer batch"]) -> Float[Tensor, "parts 2 closer batch"]:
    """Values and slopes at the nodes that cut the given cells once more."""
    n = both.shape[0] - 1
    tiles = torch.tan(torch.arange(_PARTS + 1, dtype=z.dtype, device=z.device) * (_STEP / _PARTS))[:, None, None]
    x = _turn(z[cell >> 2], tiles)
    x = torch.where((cell & 2) != 0, -x, x)
    k = torch.where((cell & 1) != 0, both[:, 1, None], both[:, 0, None])
    p, d = _horner_slope(k, x)
    return torch.stack((p, (1 + x * x) * d - n * x * p), 1)


def _cubic_start(h0: Tensor, h1: Tensor, d0: Tensor, d1: Tensor, pair: Tensor) -> tuple[Tensor, Tensor]:
    """Where in [0, 1] the Hermite cubic has its root, or its dip for a pair, and its second derivative at the dip."""
    rise = h1 - h0
    a2, a3 = 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise
    t = torch.full_like(h0, 0.5)
    for half in (0.25, 0.125, 0.0625):
        value = ((a3 * t + a2) * t + d0) * t + h0
        t = torch.where(value > 0, t + half, t - half)
    for _ in range(2):
        value = ((a3 * t + a2) * t + d0) * t + h0
        t = (t - value / ((3 * a3 * t + 2 * a2) * t + d0)).clamp(0, 1)
    bend = (a2 * a2 - 3 * a3 * d0).clamp_min(0).sqrt()
    return torch.where(pair, (-d0 / (a2 + bend)).clamp(0, 1), t), 2 * bend


def _newton(
    k: Tensor, y: Tensor, low: Tensor, high: Tensor, bend: Tensor, pair: Tensor, right: Tensor, n: int
) -> tuple[Tensor, Tensor]:
    """Newton's method between bounds that shrink; for a pair the parabola at the dip first. The root and whether it is one."""
    p, d = _horner_slope(k, y)
    square = 1 + y * y
    q = square * d - n * y * p
    bend = bend * (square / (1 + low * low)) ** (n // 2)
    root = (q * q - 2 * p * bend).clamp_min(0).sqrt()
    angle = (torch.where(right, root, -root) - q) / bend
    found = ~pair | (p < 0)
    right = pair & right
    before = (p > 0) | right
    bottom, top = torch.where(before, y, low), torch.where(before & ~(pair & ~right), high, y)
    y = torch.where(pair, y + square * angle / (1 - y * angle), y - p / d)
    for _ in range(3):
        # Rounding may carry a converged root over its bound.
        inside = (y >= bottom - 1e-10) & (y <= top + 1e-10)
        y = torch.where(inside, y, 0.5 * (bottom + top))
        p, d = _horner_slope(k, y)
        before = (p > 0) ^ right
        bottom, top = torch.where(before, y, bottom), torch.where(before, top, y)
        y = y - p / d
    return y, found & (y >= bottom - 1e-9) & (y <= top + 1e-9)
