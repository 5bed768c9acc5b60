"""All real roots of batched polynomials of any degree, by elementwise arithmetic alone.

The projective line is cut into 160 cells of equal angle, x = tan(phi), in four sectors: the polynomial and its reversal, for
arguments between 0 and 1 and between -1 and 0. On the circle the polynomial is the form h(phi) = cos(phi)^n p(tan phi). Values
and derivatives at the nodes tell, by the Bernstein coefficients of the cubic through them, which cells may hold several roots;
those are cut once more, in eight. There a sign change is one root, and a dip towards zero one pair of roots or none. The
cubic gives a start, Newton's method between bounds the root. All arithmetic has the batch in the last dimension.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.polynomial import attach_roots
from torchsfm.linalg.rows import take_columns

_CHUNK = 1024
"""Polynomials to look at a time: their values at all nodes fit the cache."""
_CELLS = 40
"""Cells from 0 to 45 degrees."""
_PARTS = 8
"""Parts of a cell that is looked at more closely."""
_STEP = math.pi / 4 / _CELLS
_NODES = [math.tan(i * _STEP) for i in range(_CELLS)] + [1.0]
_MARGIN = 2.0
"""A cubic's Bernstein coefficient is h + (step / 3) h'; 2 in the place of 3 makes up for what is not cubic."""


class RootList(NamedTuple):
    """Roots x = s / t one after the other; max(|s|, |t|) = 1."""

    item: Int[Tensor, " roots"]
    """The polynomial each belongs to."""
    s: Float[Tensor, " roots"]
    t: Float[Tensor, " roots"]

    def slot(self) -> Int[Tensor, " roots"]:
        """The number of each root among those of its polynomial, in a sorted list."""
        return number_among_equals(self.item)


def number_among_equals(item: Int[Tensor, " k"]) -> Int[Tensor, " k"]:
    """How many equal numbers stand before each one, in a sorted list of numbers from 0 on."""
    count = torch.bincount(item)
    return torch.arange(len(item), device=item.device) - (count.cumsum(0) - count).index_select(0, item)


def real_roots(c: Float[Tensor, "*batch m"]) -> tuple[Float[Tensor, "*batch slots"], Bool[Tensor, "*batch slots"]]:
    """The real roots of polynomials of degree m - 1 >= 2, each in a slot of its own.

    Found are all roots, except where three or more lie within about 0.15 degrees of each other as angles atan(x), and a pair
    of some clusters of four or more within about 6: scale the argument so that the roots of interest are around 1. Two real
    roots that rounding cannot tell from a complex pair may be missing.

    Args:
        c: Coefficients, lowest power first. Leading coefficients may be zero, which makes a root infinite.

    Returns:
        Roots in m - 1 slots and the mask of slots that hold one; infinite roots are left out, other slots are zero. Polynomials
        that are zero or not finite have none. Differentiable.

    Example:
        >>> import torch, torchsfm.linalg
        >>> c = torch.tensor([4.0, 0.0, -5.0, 0.0, 1.0, 0.0], dtype=torch.float64)  # (x^2 - 1) (x^2 - 4)
        >>> roots, valid = torchsfm.linalg.real_roots(c)
        >>> roots[valid].sort().values
        tensor([-2.0000, -1.0000,  1.0000,  2.0000], dtype=torch.float64)
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


def real_root_list(c: Float[Tensor, "m batch"], steps: int = 3, *, in_order: bool = True) -> RootList:
    """The real roots, infinite ones too (t = 0), of polynomials in columns; `steps` of Newton's method end the search.

    The list is as long as there are roots: the only thing here whose shape depends on the data. The roots of one polynomial do
    not depend on which others are in the batch, nor does their order. Sorted by the polynomial only if `in_order`.
    """
    n, batch = c.shape[0] - 1, c.shape[1]
    c = torch.where(torch.isfinite(c).all(0), c, 0)
    cut, turn = _cuts(c.dtype, c.device)
    both = torch.stack((c, c.flip(0)), 1)
    pieces = [_look(both[..., i : i + _CHUNK]) for i in range(0, max(batch, 1), _CHUNK)]
    changes, several = (torch.cat(bits, -1).flatten(0, 2) for bits in zip(*pieces, strict=True))
    both = both.view(n + 1, 2 * batch)
    # A cell has the number (side * 40 + node) * 2 + reversal.
    cell, item = (changes & ~several).nonzero().unbind(1)
    column, path = torch.add(item, cell & 1, alpha=batch), take_columns(turn, cell)
    cell, item = several.nonzero().unbind(1)
    close = torch.add(item, cell & 1, alpha=batch)
    single, pair = _cut_again(take_columns(both, close), take_columns(cut, cell), turn[2].index_select(0, cell))
    column, path = torch.cat((column, close.index_select(0, single[0]))), torch.cat((path, single[1]), -1)
    x, found = _find(take_columns(both, column), path, steps=steps)
    if len(pair[0]):
        other = close.index_select(0, pair[0])
        x2, found2 = _find_two(take_columns(both, other), *pair[1:], steps=steps)
        column, x, found = torch.cat((column, other, other)), torch.cat((x, x2)), torch.cat((found, found2))
    keep = found.nonzero()[:, 0]
    column = column.index_select(0, keep)
    reversed_ = column >= batch
    item = torch.where(reversed_, column - batch, column)
    if in_order:
        item, order = item.sort(stable=True)
        keep, reversed_ = keep.index_select(0, order), reversed_.index_select(0, order)
    x = x.index_select(0, keep)
    return RootList(item, torch.where(reversed_, 1, x), torch.where(reversed_, x, 1))


@cache
def _cuts(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """For each cell the nodes that cut it once more, `(parts + 1, cells)`, and begin, end and angle, `(3, cells)`."""
    cuts, turns = [], []
    for sign in (1, -1):
        for node in range(_CELLS):
            fine = [sign * math.tan((node * _PARTS + i) * _STEP / _PARTS) for i in range(_PARTS + 1)]
            fine[0], fine[-1] = sign * _NODES[node], sign * _NODES[node + 1]
            # The polynomial and its reversal.
            cuts += [fine, fine]
            turns += [[fine[0], fine[-1], sign * _STEP]] * 2
    return tuple(torch.tensor(x, dtype=dtype, device=device).mT.contiguous() for x in (cuts, turns))  # type: ignore[return-value]


def _look(c: Float[Tensor, "m 2 batch"]) -> tuple[Tensor, Tensor]:
    """Which cells, (side, node, reversal, batch), have a change of sign, and which may have two roots or more."""
    n = c.shape[0] - 1
    # The slope is (1 + z^2) p' - n z p, the same positive multiple of h' as the value p is of h.
    k = torch.arange(n + 1, dtype=c.dtype, device=c.device)[:, None, None]
    up, down = c[1:] * k[1:], c[:-1] * (n - k[:-1])
    both = torch.stack((c, torch.cat((up[:1], up[1:] - down[:-1], -down[-1:]))), 1)[:, :, None]
    z = c.new_tensor(_NODES)[:, None, None]
    square = z * z
    even, odd = _horner(both[0::2], square), _horner(both[1::2], square)
    odd *= z
    nodes = c.new_empty(2, *even.shape)
    torch.add(even, odd, out=nodes[0])
    torch.sub(even, odd, out=nodes[1])
    return _several(nodes[:, 0], nodes[:, 1], c.new_tensor([_STEP, -_STEP])[:, None, None, None], 1)


def _horner(c: Tensor, x: Tensor) -> Tensor:
    if c.shape[0] == 1:
        return c[0] + torch.zeros_like(x)
    value = torch.addcmul(c[-2], c[-1], x)
    for i in range(c.shape[0] - 3, -1, -1):
        torch.addcmul(c[i], value, x, out=value)
    return value


def _horner_slope(c: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives; c are rows, lowest power first."""
    *rest, last = c.unbind(0)
    rest.reverse()
    value, slope = torch.addcmul(rest[0], last, x), last + torch.zeros_like(x)
    for row in rest[1:]:
        torch.addcmul(value, slope, x, out=slope)
        torch.addcmul(row, value, x, out=value)
    return value, slope


def _several(p: Tensor, q: Tensor, step: Tensor, dim: int = 0) -> tuple[Tensor, Tensor]:
    """Which cells between neighbours in a dimension change sign, and which may hold two roots or more."""
    third, cells = q * (step / _MARGIN), p.shape[dim] - 1
    positive = p > 0
    back = (p > third) ^ positive
    out = (p > -third) ^ positive
    out, back = out.narrow(dim, 0, cells), back.narrow(dim, 1, cells)
    changes = positive.narrow(dim, 1, cells) ^ positive.narrow(dim, 0, cells)
    return changes, (out & back) | ((out | back) & ~changes)


def _cut_again(
    k: Float[Tensor, "m cells"], x: Float[Tensor, "nodes cells"], turn: Float[Tensor, " cells"]
) -> tuple[tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
    """Of the parts of some cells those with one root, and those with a pair or none.

    For each: the number of the cell, begin, end and angle, and value and slope at the begin, value and slope at the end.
    """
    n, cells = k.shape[0] - 1, k.shape[1]
    p, d = _horner_slope(k[:, None], x)
    q = torch.addcmul((1 + x * x) * d, p, x, value=-n)
    turn = turn / _PARTS
    changes, several = _several(p, q, turn)
    table = torch.stack((x, p, q)).flatten(1)

    def parts(bits: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        part, which = bits.nonzero().unbind(1)
        place = torch.add(which, part, alpha=cells)
        begin, end = take_columns(table, place), take_columns(table, place + cells)
        path = torch.stack((begin[0], end[0], turn.index_select(0, which)))
        return which, path, torch.cat((begin[1:], end[1:]))

    return parts(changes), parts(several & ~changes)


@kernel(chunk=1 << 20)
def _find(k: Tensor, path: Tensor, *, steps: int) -> tuple[Tensor, Tensor]:
    """The root between begin and end, where h has different signs, and whether the search ended there."""
    n = k.shape[0] - 1
    begin, end, turn = path.unbind(0)
    p0, d0 = _horner_slope(k, begin)
    p1, d1 = _horner_slope(k, end)
    d0, d1 = (torch.addcmul((1 + x * x) * d, p, x, value=-n) for x, p, d in ((begin, p0, d0), (end, p1, d1)))
    up = torch.where(p0 > 0, 1.0, -1.0).to(begin.dtype)
    h0, h1, d0, d1 = _along_path(begin, end, turn, (p0, d0, p1, d1), up, n)
    # The Hermite cubic in the angle.
    rise = h1 - h0
    a2, a3 = (3 * rise).sub_(d0, alpha=2).sub_(d1), (d0 + d1).sub_(rise, alpha=2)
    t = torch.full_like(h0, 0.5)
    for half in (0.25, 0.125, 0.0625):
        value = torch.addcmul(h0, torch.addcmul(d0, torch.addcmul(a2, a3, t), t), t)
        t = t + torch.copysign(value.new_tensor(half), value)
    for _ in range(2):
        inner = torch.addcmul(a2, a3, t)
        slope = torch.addcmul(d0, inner, t)
        value = torch.addcmul(h0, slope, t)
        slope.addcmul_(inner.addcmul_(a3, t), t)
        t = (t - value.div_(slope)).clamp_(0, 1)
    x = _turned(begin, t * turn)
    return _newton(k, x, torch.minimum(begin, end), torch.maximum(begin, end), torch.copysign(up, up * turn), steps)


def _along_path(
    begin: Tensor, end: Tensor, turn: Tensor, ends: Sequence[Tensor], up: Tensor, degree: int
) -> tuple[Tensor, ...]:
    """Values at begin and end and derivatives of h over the interval, as that of [0, 1], positive at its begin."""
    p0, d0, p1, d1 = ends
    weight = _power((1 + begin * begin) / (1 + end * end), degree // 2) * up
    return p0.abs(), p1 * weight, d0 * (turn * up), d1 * (weight * turn)


def _turned(begin: Tensor, angle: Tensor) -> Tensor:
    tangent = angle * (1 + angle * angle / 3)
    return (begin + tangent) / (1 - begin * tangent)


def _find_two(k: Tensor, path: Tensor, ends: Tensor, *, steps: int) -> tuple[Tensor, Tensor]:
    """First all first roots, then all second ones, from the dip between them; there are none where h keeps its sign there."""
    n = k.shape[0] - 1
    begin, end, turn = path.unbind(0)
    up = torch.where(ends[0] > 0, 1.0, -1.0).to(begin.dtype)
    h0, h1, d0, d1 = _along_path(begin, end, turn, ends.unbind(0), up, n)
    rise = h1 - h0
    a2, a3 = 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise
    bend = torch.addcmul(a2 * a2, a3, d0, value=-3).clamp_min_(0).sqrt_()
    x = _turned(begin, (-d0 / (a2 + bend)).clamp_(0, 1) * turn)
    p, d = (up * row for row in _horner_slope(k, x))
    # h + h' a + (h'' / 2) a^2 = 0 in the angle a from the dip.
    square = 1 + x * x
    q = square * d - n * x * p
    bend = 2 * bend / (turn * turn) * _power(square / (1 + begin * begin), n // 2)
    root = torch.copysign((q * q - 2 * p * bend).clamp_min(0).sqrt(), turn)
    angle = torch.stack((-root - q, root - q)) / bend
    start = (x + square * angle / (1 - x * angle)).flatten()
    left, right = torch.cat((begin, x)), torch.cat((x, end))
    up = torch.copysign(up, up * turn)
    x, found = _newton(
        torch.cat((k, k), -1), start, torch.minimum(left, right), torch.maximum(left, right), torch.cat((up, -up)), steps
    )
    return x, found & (p < 0).repeat(2)


def _newton(k: Tensor, x: Tensor, low: Tensor, high: Tensor, rise: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """The root between the bounds, at the lower of which h has the sign `rise`, and whether there is one."""
    for i in range(steps + 1):
        p, d = _horner_slope(k, x)
        if i < steps:
            right = p * rise > 0
            low, high = torch.where(right, x, low), torch.where(right, high, x)
        x = x - p.div_(d)
        if i < steps:
            # Rounding may carry a converged root over its bound.
            inside = (x >= low - 1e-10) & (x <= high + 1e-10)
            x = torch.where(inside, x, 0.5 * (low + high))
    return x, (x >= low - 1e-9) & (x <= high + 1e-9)


def _power(x: Tensor, exponent: int) -> Tensor:
    out = x if exponent % 2 else torch.ones_like(x)
    while exponent := exponent // 2:
        x = x * x
        out = out * x if exponent % 2 else out
    return out
