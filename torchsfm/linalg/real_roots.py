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

from torchsfm.linalg.polynomial import attach_roots

_CELLS = 32
"""Cells from 0 to 45 degrees."""
_CLOSER = 4
"""Cells looked at more closely (two bits of a number say which) ..."""
_PARTS = 8
"""... and the parts they are cut into."""
_STEP = math.pi / 4 / _CELLS
_MARGIN = 2.0
"""A cubic's Bernstein coefficient is h + (step / 3) h'; 2 in the place of 3 makes up for what is not cubic."""


def real_roots(c: Float[Tensor, "*batch m"]) -> tuple[Float[Tensor, "*batch slots"], Bool[Tensor, "*batch slots"]]:
    """The real roots of polynomials of degree m - 1 >= 2, each in a slot of its own.

    Found are all roots, except where three or more lie within about 0.2 degrees of each other as angles atan(x), or more than
    four places have several roots within about 1.4 degrees: scale the argument so that roots of interest are around 1. Two
    real roots that rounding cannot tell from a complex pair may be missing.

    Args:
        c: Coefficients, lowest power first. Leading coefficients may be zero, which makes a root infinite.

    Returns:
        Roots in m - 1 slots and the mask of slots that hold one; infinite roots are left out, other slots are zero. Polynomials
        that are zero or not finite have none. Differentiable.
    """
    with torch.no_grad():
        rows = c.detach().reshape(-1, c.shape[-1]).mT
        s, t, real = real_root_rows(rows.contiguous())
        real = real & (t.abs() > torch.finfo(c.dtype).tiny ** 0.5)
        x = torch.where(real, s / t, 0)
        shape = (*c.shape[:-1], c.shape[-1] - 1)
        x, real = x.mT.reshape(shape), real.mT.reshape(shape)
    return attach_roots(c, x, real), real


def real_root_rows(
    c: Float[Tensor, "m batch"], steps: int = 3
) -> tuple[Float[Tensor, "slots batch"], Float[Tensor, "slots batch"], Bool[Tensor, "slots batch"]]:
    """The real roots x = s / t of polynomials that stand in columns, and which slots hold one; max(|s|, |t|) = 1.

    The homogeneous form holds infinite roots too (t = 0). `steps` of Newton's method end the search.
    """
    n = c.shape[0] - 1
    finite = torch.isfinite(c).all(0)
    c = torch.where(finite, c, 0)
    both = torch.stack((c, c.flip(0)), 1)
    fine = torch.tan(torch.arange(_CELLS * _PARTS + 1, dtype=c.dtype, device=c.device) * (_STEP / _PARTS))
    fine[-1] = 1
    # Rows of values: at the nodes [node, side (+z, -z), value or slope, polynomial or reversal], then at the closer nodes
    # [node, value or slope, cell]. The slope is (1 + z^2) p' - n z p, the same multiple of h' as the value p is of h.
    start = 8 * (_CELLS + 1)
    rows = torch.empty(start + 2 * _CLOSER * (_PARTS + 1), c.shape[1], dtype=c.dtype, device=c.device)
    first = rows[:start].view(_CELLS + 1, 2, 2, 2, -1)
    second = rows[start:].view(_PARTS + 1, 2, _CLOSER, -1)
    _nodes(both, fine[::_PARTS], first)
    changes, several = _several(first[:, :, 0], first[:, :, 1], fine.new_tensor([_STEP, -_STEP])[:, None, None])
    # A cell's number is (node * 2 + side) * 2 + reversal.
    i1, ok1 = _positions((changes & ~several).flatten(0, 2), n)
    close, used = _positions(several.flatten(0, 2), _CLOSER)
    _closer(both, fine, close, second)
    minus = (close & 2) != 0
    changes, several = _several(second[:, 0], second[:, 1], torch.where(minus, -_STEP / _PARTS, _STEP / _PARTS))
    i2, ok2 = _positions((changes & used).flatten(0, 1), n)
    i3, ok3 = _positions((several & ~changes & used).flatten(0, 1), n // 2)
    # Single roots fill the slots from the front, pairs from the back; n slots are enough for both.
    slot = torch.arange(n, device=c.device)
    i2, ok2 = _after(i2, ok2, slot[:, None] - ok1.sum(0))
    back = ((n - 1 - slot) // 2).clamp_max(n // 2 - 1)
    left, right = ok1 | ok2, ((n - 1 - slot) % 2 == 1)[:, None]
    pair = ~left & ok3.index_select(0, back)
    part = torch.where(ok2, i2, i3.index_select(0, back))
    piece, which = part >> 2, part & 3
    cell = torch.where(ok1, i1, close.gather(0, which))
    reverse, minus, node = (cell & 1) != 0, (cell & 2) != 0, (cell >> 2) * _PARTS
    # Both ends of the slot's cell.
    at = torch.where(ok1, (cell >> 2) * 8 + (cell & 2) * 2 + (cell & 1), start + piece * (2 * _CLOSER) + which)
    to_slope = torch.where(ok1, 2, _CLOSER)
    to_next = at + torch.where(ok1, 8, 2 * _CLOSER)
    p0, p1 = rows.gather(0, at), rows.gather(0, to_next)
    q0, q1 = rows.gather(0, at + to_slope), rows.gather(0, to_next + to_slope)
    node = torch.where(ok1, node, node + piece)
    low, high = _look_up(fine, node), _look_up(fine, node + torch.where(ok1, _PARTS, 1))
    step = torch.where(ok1, _STEP, _STEP / _PARTS)
    # From here on the path goes up from low to high, and h is positive at its start.
    weight = _power((1 + low * low) / (1 + high * high), n // 2)
    up = torch.where(p0 > 0, torch.ones_like(p0), -1)
    along = torch.where(minus, -step, step) * up
    begin, dip = _cubic_start(p0.abs(), p1 * weight * up, q0 * along, q1 * weight * along, pair)
    angle = begin * step
    tangent = angle * (1 + angle * angle / 3)
    y = (low + tangent) / (1 - low * tangent)
    # The coefficients of the slot's sector, with the sign of the side in the odd ones.
    k = torch.where(reverse, both[:, 1, None], both[:, 0, None]) * up
    k[1::2] *= torch.where(minus, -torch.ones_like(up), 1)
    y, found = _newton(k, y, low, high, dip / (step * step), pair, right, steps)
    found = found & (left | pair) & finite
    y = torch.where(found, torch.where(minus, -y, y), 0)
    one = torch.ones_like(y)
    return torch.where(reverse, one, y), torch.where(reverse, y, one), found


def _power(x: Tensor, exponent: int) -> Tensor:
    out = x if exponent % 2 else torch.ones_like(x)
    while exponent := exponent // 2:
        x = x * x
        out = out * x if exponent % 2 else out
    return out


def _look_up(table: Float[Tensor, " k"], index: Int[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    return table.index_select(0, index.flatten()).view(index.shape)


def _nodes(both: Float[Tensor, "m 2 batch"], z: Float[Tensor, " nodes"], out: Float[Tensor, "nodes 2 2 2 batch"]) -> None:
    n = both.shape[0] - 1
    k = torch.arange(n + 1, dtype=both.dtype, device=both.device)[:, None, None]
    q = torch.zeros_like(both)
    q[:-1] = both[1:] * k[1:]
    q[1:] -= both[:-1] * (n - k[:-1])
    c = torch.stack((both, q), 1)
    square = (z * z)[:, None, None, None]
    even, odd = _horner(c[0::2], square), _horner(c[1::2], square)
    odd *= z[:, None, None, None]
    torch.add(even, odd, out=out[:, 0])
    torch.sub(even, odd, out=out[:, 1])


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
    third = q * (step / _MARGIN)
    positive = p > 0
    out, back = positive ^ (p > -third), positive ^ (p > third)
    changes = positive[1:] ^ positive[:-1]
    out, back = out[:-1], back[1:]
    return changes, (out & back) | (~changes & (out | back))


def _positions(bits: Bool[Tensor, "cells batch"], count: int) -> tuple[Int[Tensor, "count batch"], Bool[Tensor, "count batch"]]:
    """The first `count` of a multiple of 8 cells whose bit is set, and whether there are that many; 0 where there are not."""
    octets = bits.view(torch.uint8).view(bits.shape[0] // 8, 8, bits.shape[-1])
    byte = octets[:, 7].clone()
    for i in range(6, -1, -1):
        byte.mul_(2).add_(octets[:, i])
    words = -(-byte.shape[0] // 8)
    shift = (torch.arange(byte.shape[0], device=bits.device) % 8)[:, None] * 8
    byte = byte.long() << shift
    word = torch.stack([byte[8 * w : 8 * w + 8].sum(0) for w in range(words)])
    lowest = []
    for _ in range(count):
        bit = word & -word
        lowest.append(bit)
        word = word ^ bit
    bit = torch.stack(lowest)
    # The exponent of a power of two; the 64th bit is a sign.
    index = ((bit.double().view(torch.int64) >> 52) & 0x7FF) - 1023
    ok = bit != 0
    slot = torch.arange(count, device=bits.device)[:, None]
    first, found = index[:, 0], ok[:, 0]
    for w in range(1, words):
        more, more_ok = _after(index[:, w] + w * 64, ok[:, w], slot - found.sum(0))
        first, found = torch.where(found, first, more), found | more_ok
    return torch.where(found, first, 0), found


def _after(index: Tensor, ok: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    take = shift.clamp_min(0)
    return index.gather(0, take), ok.gather(0, take) & (shift >= 0)


def _closer(both: Tensor, fine: Tensor, cell: Int[Tensor, "closer batch"], out: Float[Tensor, "nodes 2 closer batch"]) -> None:
    """Values and slopes at the nodes that cut the given cells once more."""
    n = both.shape[0] - 1
    x = _look_up(fine, (cell >> 2) * _PARTS + torch.arange(_PARTS + 1, device=cell.device)[:, None, None])
    x = torch.where((cell & 2) != 0, -x, x)
    p, d = _horner_slope(torch.where((cell & 1) != 0, both[:, 1, None], both[:, 0, None]), x)
    out[:, 0] = p
    torch.addcmul((1 + x * x) * d, p, x, value=-n, out=out[:, 1])


def _cubic_start(h0: Tensor, h1: Tensor, d0: Tensor, d1: Tensor, pair: Tensor) -> tuple[Tensor, Tensor]:
    """Where in [0, 1] the Hermite cubic has its root, or its dip for a pair, and its second derivative at the dip."""
    rise = h1 - h0
    a2, a3 = 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise
    t = torch.full_like(h0, 0.5)
    for half in (0.25, 0.125, 0.0625):
        value = torch.addcmul(h0, torch.addcmul(d0, torch.addcmul(a2, a3, t), t), t)
        t = t + torch.where(value > 0, half, -half)
    for _ in range(2):
        inner = torch.addcmul(a2, a3, t)
        slope = torch.addcmul(d0, inner, t)
        value = torch.addcmul(h0, slope, t)
        slope.addcmul_(torch.addcmul(inner, a3, t), t)
        t = (t - value / slope).clamp_(0, 1)
    bend = torch.addcmul(a2 * a2, a3, d0, value=-3).clamp_min_(0).sqrt_()
    return torch.where(pair, (-d0 / (a2 + bend)).clamp_(0, 1), t), 2 * bend


def _newton(
    k: Tensor, y: Tensor, low: Tensor, high: Tensor, bend: Tensor, pair: Tensor, right: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Newton's method between bounds that shrink; for a pair the parabola at the dip first. The root and whether it is one."""
    n = k.shape[0] - 1
    p, d = _horner_slope(k, y)
    square = 1 + y * y
    q = square * d - n * y * p
    bend = bend * _power(square / (1 + low * low), n // 2)
    root = (q * q - 2 * p * bend).clamp_min(0).sqrt()
    angle = (torch.where(right, root, -root) - q) / bend
    found = ~pair | (p < 0)
    right = pair & right
    before = (p > 0) | right
    bottom, top = torch.where(before, y, low), torch.where(before & ~(pair & ~right), high, y)
    y = torch.where(pair, y + square * angle / (1 - y * angle), y - p / d)
    for _ in range(steps):
        # Rounding may carry a converged root over its bound.
        inside = (y >= bottom - 1e-10) & (y <= top + 1e-10)
        y = torch.where(inside, y, 0.5 * (bottom + top))
        p, d = _horner_slope(k, y)
        before = (p > 0) ^ right
        bottom, top = torch.where(before, y, bottom), torch.where(before, top, y)
        y = y - p / d
    return y, found & (y >= bottom - 1e-9) & (y <= top + 1e-9)
