"""All real roots of batched polynomials of any degree, by elementwise arithmetic alone.

The projective line is cut into 80 cells of equal angle, x = tan(phi), in four sectors: the polynomial and its reversal, for
arguments between 0 and 1 and between -1 and 0. On the circle the polynomial is the form h(phi) = cos(phi)^n p(tan phi). Values
and derivatives at the nodes tell, by the Bernstein coefficients of the cubic through them, which cells may hold several roots;
those are cut once more, in sixteen. There a sign change is one root, and a dip towards zero one pair of roots or none. The
cubic gives a start, Newton's method between bounds the root.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg.compilation import kernel
from torchsfm.linalg.polynomial import attach_roots
from torchsfm.linalg.rows import take_columns

_CELLS = 20
"""Cells from 0 to 45 degrees."""
_PARTS = 16
"""Parts of a cell that is looked at more closely."""
_STEP = math.pi / 4 / _CELLS
_MARGIN = 2.0
"""A cubic's Bernstein coefficient is h + (step / 3) h'; 2 in the place of 3 makes up for what is not cubic."""


class RootList(NamedTuple):
    """Roots x = s / t one after the other, sorted by the polynomial they belong to; max(|s|, |t|) = 1."""

    item: Int[Tensor, " roots"]
    s: Float[Tensor, " roots"]
    t: Float[Tensor, " roots"]

    def slot(self) -> Int[Tensor, " roots"]:
        """The number of each root among those of its polynomial."""
        count = torch.bincount(self.item)
        return torch.arange(len(self.item), device=self.item.device) - (count.cumsum(0) - count).index_select(0, self.item)


class _Cells(NamedTuple):
    """Cells with a root or two, one after the other: the path goes from the node `low` on, away from zero."""

    item: Tensor
    reverse: Tensor
    minus: Tensor
    low: Tensor
    """Number of the node on the fine scale."""
    values: Tensor
    """Value and slope at the start, value and slope at the end, (4, cells)."""


def real_roots(c: Float[Tensor, "*batch m"]) -> tuple[Float[Tensor, "*batch slots"], Bool[Tensor, "*batch slots"]]:
    """The real roots of polynomials of degree m - 1 >= 2, each in a slot of its own.

    Found are all roots, except where three or more lie within about 0.15 degrees of each other as angles atan(x), or four or
    more within about 2.5: scale the argument so that the roots of interest are around 1. Two real roots that rounding cannot
    tell from a complex pair may be missing.

    Args:
        c: Coefficients, lowest power first. Leading coefficients may be zero, which makes a root infinite.

    Returns:
        Roots in m - 1 slots and the mask of slots that hold one; infinite roots are left out, other slots are zero. Polynomials
        that are zero or not finite have none. Differentiable.
    """
    with torch.no_grad():
        rows = c.detach().reshape(-1, c.shape[-1]).mT
        roots = real_root_list(rows.contiguous())
        place = (roots.item, roots.slot().clamp_max(c.shape[-1] - 2))
        finite = roots.t.abs() > torch.finfo(c.dtype).tiny ** 0.5
        x = rows.new_zeros(rows.shape[1], c.shape[-1] - 1)
        x[place] = torch.where(finite, roots.s / roots.t, 0)
        real = torch.zeros_like(x, dtype=torch.bool)
        real[place] = finite
        shape = (*c.shape[:-1], c.shape[-1] - 1)
        x, real = x.reshape(shape), real.reshape(shape)
    return attach_roots(c, x, real), real


def real_root_list(c: Float[Tensor, "m batch"], steps: int = 3) -> RootList:
    """The real roots, infinite ones too (t = 0), of polynomials in columns; `steps` of Newton's method end the search.

    The list is as long as there are roots: the only thing here whose shape depends on the data. The roots of one polynomial do
    not depend on which others are in the batch, nor does their order.
    """
    n, batch = c.shape[0] - 1, c.shape[1]
    c = torch.where(torch.isfinite(c).all(0), c, 0)
    both = torch.stack((c, c.flip(0)), 1)
    fine = torch.tan(torch.arange(_CELLS * _PARTS + 1, dtype=c.dtype, device=c.device) * (_STEP / _PARTS))
    fine[-1] = 1
    nodes = _nodes(both, fine[::_PARTS])
    changes, several = _several(nodes[:, :, 0], nodes[:, :, 1], fine.new_tensor([_STEP, -_STEP])[:, None, None])
    both = both.view(n + 1, 2 * batch)
    values = nodes.view(-1)

    def cells(bits: Tensor) -> _Cells:
        place = bits.reshape(-1).nonzero()[:, 0]
        cell = place // batch
        item = place - cell * batch
        # Cells count (node * 2 + side) * 2 + reversal, values (node * 2 + side) * 4 + slope * 2 + reversal.
        at = ((cell >> 1) * 4 + (cell & 1)) * batch + item
        offsets = torch.tensor([[0], [2], [8], [10]], device=c.device) * batch
        return _Cells(item, cell & 1, (cell & 2) != 0, (cell >> 2) * _PARTS, _look_up(values, at + offsets))

    single = cells(changes & ~several)
    close = cells(several)
    p, q = _closer(both, fine, close, batch)
    changes, several = _several(p, q, torch.where(close.minus, -_STEP / _PARTS, _STEP / _PARTS))

    def parts(bits: Tensor) -> _Cells:
        part, which = bits.nonzero().unbind(1)
        ends = torch.stack((p[part, which], q[part, which], p[part + 1, which], q[part + 1, which]))
        item, reverse, minus, low = (x.index_select(0, which) for x in close[:4])
        return _Cells(item, reverse, minus, low + part, ends)

    sub = parts(changes)
    pair = parts(several & ~changes)
    # Each root has a cell, a pair's cell stands twice.
    groups = (single, sub, pair, pair)
    item, reverse, minus, low, ends = (torch.cat(x, -1) for x in zip(*groups, strict=True))
    kind = torch.cat([x.item.new_full(x.item.shape, i) for i, x in enumerate(groups)])
    bottom, top = _look_up(fine, low), _look_up(fine, low + torch.where(kind == 0, _PARTS, 1))
    y, found = _refine(take_columns(both, reverse * batch + item), bottom, top, minus, ends, kind, steps=steps)
    keep = found.nonzero()[:, 0]
    item, order = item.index_select(0, keep).sort(stable=True)
    keep = keep.index_select(0, order)
    y = torch.where(minus, -y, y).index_select(0, keep)
    reversed_ = reverse.index_select(0, keep) == 1
    one = torch.ones_like(y)
    return RootList(item, torch.where(reversed_, one, y), torch.where(reversed_, y, one))


def _look_up(table: Float[Tensor, " k"], index: Int[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    return table.index_select(0, index.reshape(-1)).view(index.shape)


def _nodes(both: Float[Tensor, "m 2 batch"], z: Float[Tensor, " nodes"]) -> Float[Tensor, "nodes 2 2 2 batch"]:
    """What cells are judged by, at [node, side (+z, -z), value or slope, polynomial or reversal].

    The slope is (1 + z^2) p' - n z p, the same positive multiple of h' as the value p is of h.
    """
    n = both.shape[0] - 1
    k = torch.arange(n + 1, dtype=both.dtype, device=both.device)[:, None, None]
    q = torch.zeros_like(both)
    q[:-1] = both[1:] * k[1:]
    q[1:] -= both[:-1] * (n - k[:-1])
    c = torch.stack((both, q), 1)
    square = (z * z)[:, None, None, None]
    even, odd = _horner(c[0::2], square), _horner(c[1::2], square)
    odd *= z[:, None, None, None]
    out = torch.empty(len(z), 2, *even.shape[1:], dtype=z.dtype, device=z.device)
    torch.add(even, odd, out=out[:, 0])
    torch.sub(even, odd, out=out[:, 1])
    return out


def _horner(c: Tensor, x: Tensor) -> Tensor:
    if c.shape[0] == 1:
        return c[0] + torch.zeros_like(x)
    value = torch.addcmul(c[-2], c[-1], x)
    for i in range(c.shape[0] - 3, -1, -1):
        torch.addcmul(c[i], value, x, out=value)
    return value


def _horner_slope(c: Tensor | Sequence[Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives; c are rows, lowest power first."""
    *rest, last = c if isinstance(c, Sequence) else c.unbind(0)
    rest.reverse()
    value, slope = torch.addcmul(rest[0], last, x), last + torch.zeros_like(x)
    for row in rest[1:]:
        torch.addcmul(value, slope, x, out=slope)
        torch.addcmul(row, value, x, out=value)
    return value, slope


def _several(p: Tensor, q: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Which cells between neighbours in the first dimension change sign, and which may hold two roots or more."""
    third = q * (step / _MARGIN)
    positive = p > 0
    out, back = positive ^ (p > -third), positive ^ (p > third)
    changes = positive[1:] ^ positive[:-1]
    out, back = out[:-1], back[1:]
    return changes, (out & back) | (~changes & (out | back))


def _closer(both: Float[Tensor, "m columns"], fine: Tensor, close: _Cells, batch: int) -> tuple[Tensor, Tensor]:
    """Values and slopes at the nodes that cut the given cells once more."""
    n = both.shape[0] - 1
    x = _look_up(fine, close.low + torch.arange(_PARTS + 1, device=fine.device)[:, None])
    x = torch.where(close.minus, -x, x)
    p, d = _horner_slope(take_columns(both, close.reverse * batch + close.item)[:, None], x)
    return p, torch.addcmul((1 + x * x) * d, p, x, value=-n)


@kernel(chunk=1 << 20)
def _refine(
    k: Tensor, bottom: Tensor, top: Tensor, minus: Tensor, ends: Tensor, kind: Tensor, *, steps: int
) -> tuple[Tensor, Tensor]:
    """The root between bottom and top, as a distance from zero along its side, and whether it is one."""
    n = k.shape[0] - 1
    whole, right = kind == 0, kind == 3
    pair = kind >= 2
    step = torch.where(whole, _STEP, _STEP / _PARTS)
    # From here on h is positive where the path starts, and x counts along the path.
    weight = _power((1 + bottom * bottom) / (1 + top * top), n // 2)
    up = torch.where(ends[0] > 0, torch.ones_like(bottom), -1)
    along = torch.where(minus, -step, step) * up
    begin, bend = _cubic_start(ends[0].abs(), ends[2] * weight * up, ends[1] * along, ends[3] * weight * along, pair)
    angle = begin * step
    tangent = angle * (1 + angle * angle / 3)
    y = (bottom + tangent) / (1 - bottom * tangent)
    odd = torch.where(minus, -up, up)
    rows = [row * (odd if i % 2 else up) for i, row in enumerate(k.unbind(0))]
    p, d = _horner_slope(rows, y)
    # For a pair, h + h' a + (h'' / 2) a^2 = 0 in the angle a from the dip.
    square = 1 + y * y
    q = square * d - n * y * p
    bend = bend / (step * step) * _power(square / (1 + bottom * bottom), n // 2)
    root = (q * q - 2 * p * bend).clamp_min(0).sqrt()
    angle = (torch.where(right, root, -root) - q) / bend
    found = ~pair | (p < 0)
    before = (p > 0) | right
    bottom, top = torch.where(before, y, bottom), torch.where(before & (right | ~pair), top, y)
    y = torch.where(pair, y + square * angle / (1 - y * angle), y - p / d)
    for _ in range(steps):
        # Rounding may carry a converged root over its bound.
        inside = (y >= bottom - 1e-10) & (y <= top + 1e-10)
        y = torch.where(inside, y, 0.5 * (bottom + top))
        p, d = _horner_slope(rows, y)
        before = (p > 0) ^ right
        bottom, top = torch.where(before, y, bottom), torch.where(before, top, y)
        y = y - p / d
    return y, found & (y >= bottom - 1e-9) & (y <= top + 1e-9)


def _power(x: Tensor, exponent: int) -> Tensor:
    out = x if exponent % 2 else torch.ones_like(x)
    while exponent := exponent // 2:
        x = x * x
        out = out * x if exponent % 2 else out
    return out


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
