"""All real roots of batched polynomials of any degree, by elementwise arithmetic and products with constant matrices.

`root_cells` tells where each root is alone, and where two may be; Newton's method between bounds finds them. All arithmetic has
the batch in the last dimension.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg.polynomial import attach_roots
from torchsfm.linalg.portions import portions
from torchsfm.linalg.root_cells import Cells, chords, root_cells
from torchsfm.linalg.rows import take_columns

_STEPS = 4
"""Newton steps that all roots take."""
_SETTLED = 1e-9
"""The last of them at a root, at most; after it rounding is left."""
_CAREFUL_STEPS = 12
_CHUNK = 16384
"""Roots at a time: what the steps take stays in the cache."""
_DOUBLE = 1e-11
"""Half the square of the distance of two roots, in the units of `RootList`, below which they may be one."""


class RootList(NamedTuple):
    """Roots x = s / t one after the other; one of s and t is 1, the other not larger, or by half at most."""

    item: Int[Tensor, " roots"]
    """The polynomial each belongs to."""
    s: Float[Tensor, " roots"]
    t: Float[Tensor, " roots"]
    double: Int[Tensor, " few"]
    """Polynomials that may have a double root, by rounding: it may be in the list, once or twice, or be missing."""

    def slot(self) -> Int[Tensor, " roots"]:
        """The number of each root among those of its polynomial, in a sorted list."""
        return number_among_equals(self.item)


def number_among_equals(item: Int[Tensor, " k"]) -> Int[Tensor, " k"]:
    """How many equal numbers stand before each one, in a sorted list of numbers from 0 on."""
    count = torch.bincount(item)
    return torch.arange(len(item), device=item.device) - (count.cumsum(0) - count).index_select(0, item)


def real_roots(c: Float[Tensor, "*batch m"]) -> tuple[Float[Tensor, "*batch slots"], Bool[Tensor, "*batch slots"]]:
    """The real roots of polynomials of degree m - 1 >= 2, each in a slot of its own.

    Found are all roots, except where three or more lie within a few hundredths of a degree, as angles atan(x): scale the
    argument so that the roots of interest are around 1. Two real roots that rounding cannot tell from a complex pair may be
    missing.

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
        rows = c.detach().reshape(-1, c.shape[-1]).mT.double()
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


def real_root_list(c: Float[Tensor, "m batch"], *, in_order: bool = True) -> RootList:
    """The real roots, infinite ones too (t = 0), of polynomials in columns, in float64.

    The list is as long as there are roots: the only thing here whose shape depends on the data. The roots of one polynomial do
    not depend on which others are in the batch, nor does their order. Sorted by the polynomial only if `in_order`.
    """
    c = torch.where(torch.isfinite(c).all(0), c, 0)
    single, pair = root_cells(c)
    both = torch.stack((c, c.flip(0)), 1).flatten(1)
    item, inverse, search = _for_one(both, single)
    x, found = _newton(search)
    double = item[:0]
    if len(pair.item):
        item2, inverse2, search, double = _for_two(both, pair)
        two = (item, item2), (inverse, inverse2), *zip((x, found), _newton(search), strict=True)
        item, inverse, x, found = (torch.cat(parts) for parts in two)
    if not found.all():
        keep = found.nonzero()[:, 0]
        item, x, inverse = (t.index_select(0, keep) for t in (item, x, inverse))
    if in_order:
        # Short numbers are sorted several times faster.
        short = torch.int16 if c.shape[1] < 2**15 else torch.int32
        order = item.to(short).sort(stable=True).indices
        item = item.index_select(0, order)
        x, inverse = x.index_select(0, order), inverse.index_select(0, order)
    return RootList(item, torch.where(inverse, 1, x), torch.where(inverse, x, 1), double)


class Search(NamedTuple):
    """Where a root of each of some polynomials is looked for."""

    k: Float[Tensor, "m roots"]
    """The coefficients."""
    x: Float[Tensor, " roots"]
    """The start."""
    low: Float[Tensor, " roots"]
    high: Float[Tensor, " roots"]
    rise: Float[Tensor, " roots"]
    """The sign of the polynomial at `low`."""


def _for_one(both: Float[Tensor, "m two_batches"], where: Cells) -> tuple[Tensor, Tensor, Search]:
    """The problems, whether x is the inverse of the root, a root of the reversed polynomial, and how to find it."""
    table, inverse = (t.on(both.device) for t in chords(len(both) - 1))
    inverse = inverse.index_select(0, where.cell)
    a, b, c, d, sign = take_columns(table, where.cell).unbind(0)
    start, begin, end = (
        torch.addcmul(a, u, b) / torch.addcmul(c, u, d) for u in (where.start, where.low, where.low + where.width)
    )
    k = take_columns(both, torch.where(inverse, where.item + both.shape[1] // 2, where.item))
    return where.item, inverse, Search(k, start, torch.minimum(begin, end), torch.maximum(begin, end), sign * where.sign)


def _for_two(both: Float[Tensor, "m two_batches"], where: Cells) -> tuple[Tensor, Tensor, Search, Tensor]:
    """The same for two roots with a dip between them, first all first ones, if the polynomial changes its sign there.

    Also which polynomials are about zero at the dip.
    """
    item, inverse, (k, x, low, high, _) = _for_one(both, where)
    p, d, bend = _horner_bend(k, x)
    x = torch.clamp(x - d / bend, low, high)
    p, d, bend = _horner_bend(k, x)
    (two,) = (p * bend < 0).nonzero(as_tuple=True)
    double = item[p.abs() <= _DOUBLE * bend.abs()]
    item, inverse, x, low, high, p, d, bend = (t.index_select(0, two) for t in (item, inverse, x, low, high, p, d, bend))
    root = torch.copysign((d * d - 2 * p * bend).sqrt(), bend)
    rise = torch.where(bend < 0, -1.0, 1.0).to(x.dtype)
    low, high = torch.cat((low, x)), torch.cat((x, high))
    start = torch.clamp(x.repeat(2) + torch.cat((-d - root, root - d)) / bend.repeat(2), low, high)
    search = Search(take_columns(k, two).repeat(1, 2), start, low, high, torch.cat((rise, -rise)))
    return item.repeat(2), inverse.repeat(2), search, double


def _horner_slope(c: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives; c are rows, lowest power first."""
    *rest, last = c.unbind(0)
    rest.reverse()
    value, slope = torch.addcmul(rest[0], last, x), last
    for i, row in enumerate(rest[1:]):
        slope = torch.addcmul(value, slope, x, out=slope if i else None)
        torch.addcmul(row, value, x, out=value)
    return value, slope


def _horner_bend(c: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values, first and second derivatives."""
    value, slope, half = c[-1], torch.zeros_like(x), torch.zeros_like(x)
    for row in c[:-1].flip(0):
        half = torch.addcmul(slope, half, x)
        slope = torch.addcmul(value, slope, x)
        value = torch.addcmul(row, value, x)
    return value, slope, 2 * half


def _newton(search: Search) -> tuple[Tensor, Tensor]:
    """The root of each, and whether there is one."""
    x, found = torch.empty_like(search.x), torch.empty_like(search.x, dtype=torch.bool)
    for some in portions(len(x), _CHUNK, x.device):
        k, own, low, high, _ = (t[..., some] for t in search)
        for _ in range(_STEPS):
            p, d = _horner_slope(k, own)
            step = p.div_(d)
            own = torch.clamp(own - step, low, high)
        x[some], found[some] = own, step.abs_() <= _SETTLED
    if not found.all():
        (rest,) = (~found).nonzero(as_tuple=True)
        x[rest], found[rest] = _bracketed(Search(*(t[..., rest] for t in search._replace(x=x))))
    return x, found


def _bracketed(search: Search) -> tuple[Tensor, Tensor]:
    """The same for the few that need care: between bounds that close in, in half where a step leaves them."""
    k, x, low, high, rise = search
    x = torch.where(x.isfinite(), x, 0.5 * (low + high))
    settled = torch.zeros_like(x, dtype=torch.bool)
    for _ in range(_CAREFUL_STEPS):
        p, d = _horner_slope(k, x)
        right = p * rise > 0
        low, high = torch.where(right, x, low), torch.where(right, high, x)
        step = p.div_(d)
        new = x - step
        # Rounding may carry a converged root over its bound.
        inside = (new >= low - 1e-10) & (new <= high + 1e-10)
        x = torch.where(settled, x, torch.where(inside, new, 0.5 * (low + high)))
        settled |= inside & (step.abs_() <= _SETTLED)
        if settled.all():
            break
    return x, (x >= low - 1e-9) & (x <= high + 1e-9)
