"""Cells of the projective line that hold one real root each, of batched polynomials.

On the circle a polynomial of degree n is the form cos(phi)^n p(tan phi). Half the circle is cut into cells of equal angle. On
the chord of a cell the form has n + 1 Bernstein coefficients, one product with a constant matrix for all cells: without a
change of sign among them the cell has no root, with one it has one (Descartes). Few cells have more changes; those are cut in
eight, again by a constant matrix, until their roots are apart or the parts are tiny.
"""

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.linalg.constants import Constant
from torchsfm.linalg.portions import portions
from torchsfm.linalg.rows import take_columns

_CELLS = 2
"""Cells a degree; more of them would cost more than the cuts that they save."""
_PARTS = 8
_CUTS = 3
"""How often a cell is cut in parts, to a few hundredths of a degree at last."""
_CHUNK = 1024
"""Polynomials at a time: their coefficients in all cells fit the cache."""
_GRAIN = 4096
"""Starts are rounded to so many places of a cell: how the products round depends on how many polynomials there are."""


class Parts(NamedTuple):
    """Parts of cells, with the Bernstein coefficients of the form there."""

    number: Int[Tensor, "2 k"]
    """The polynomial and the cell."""
    low: Float[Tensor, " k"]
    """Where each begins, along the chord of a cell from 0 to 1."""
    b: Float[Tensor, "m k"]

    def some(self, which: Tensor) -> "Parts":
        """Those for which this is True."""
        (at,) = which.nonzero(as_tuple=True)
        return Parts(take_columns(self.number, at), self.low.index_select(0, at), take_columns(self.b, at))


class Cells(NamedTuple):
    """Places where roots are, each in the part from `low` to `low + width`, of lengths 0 to 1 along the chord of a cell."""

    item: Int[Tensor, " k"]
    """The polynomial."""
    cell: Int[Tensor, " k"]
    low: Float[Tensor, " k"]
    width: Float[Tensor, " k"]
    start: Float[Tensor, " k"]
    """Where the root is, or the dip between two of them, about."""
    sign: Float[Tensor, " k"]
    """Of the form at `low`: 1 or -1."""


def root_cells(c: Float[Tensor, "m batch"]) -> tuple[Cells, Cells]:
    """Places of one root each, and of two roots or none, the polynomials in columns; neither list is in any order."""
    degree, batch = c.shape[0] - 1, c.shape[1]
    to_cells, to_parts = (t.on(c.device, c.dtype) for t in _matrices(degree))
    number, rows = [], []
    for some in portions(max(batch, 1), _CHUNK, c.device):
        piece = c[:, some]
        b = (to_cells @ piece).view(degree + 1, -1)
        place = _with_changes(b).nonzero()[:, 0]
        rows.append(take_columns(b, place))
        cell, item = _row_and_column(place, piece.shape[1])
        number.append(torch.stack((item.add_(some.start), cell)))
    b = torch.cat(rows, -1)
    where, single, widths = Parts(torch.cat(number, -1), b.new_zeros(b.shape[1]), b), [], []
    for cut in range(_CUTS + 1):
        changes, last = _changes(where.b), cut == _CUTS
        one = changes % 2 == 1 if last else changes == 1
        found, where = where.some(one), where.some(~one)
        single.append(found)
        widths.append(torch.full_like(found.low, _PARTS**-cut))
        if last or not where.number.shape[1]:
            break
        where = _cut(where, to_parts, _PARTS ** -(cut + 1))
    # What is left after the last cut has two roots, or none.
    pair = _cells(where, torch.full_like(where.low, _PARTS**-cut), _dip(where.b))
    where = Parts(*(torch.cat(parts, -1) for parts in zip(*single, strict=True)))
    return _cells(where, torch.cat(widths), _crossing(where.b)), pair


def _with_changes(b: Float[Tensor, "m k"]) -> Tensor:
    """Where the signs of a column are not all the same; that of zero is positive."""
    return (b.amin(0) < 0) & (b.amax(0) >= 0)


def _changes(b: Float[Tensor, "m k"]) -> Tensor:
    """The number of changes of sign of a column."""
    positive = b >= 0
    return (positive[1:] ^ positive[:-1]).sum(0, dtype=torch.int8)


def _crossing(b: Float[Tensor, "m k"]) -> Float[Tensor, " k"]:
    """Where the polygon of the coefficients, from 0 to 1, first passes through zero."""
    positive, degree = b >= 0, len(b) - 1
    before = (positive[1:] == positive[0]).sum(0, dtype=torch.int8).long()
    ends = b.gather(0, torch.stack((before, before + 1)).clamp_max_(degree))
    return (before + ends[0] / (ends[0] - ends[1])) / degree


def _dip(b: Float[Tensor, "m k"]) -> Float[Tensor, " k"]:
    """The vertex of the parabola through both ends, at 0 and 1, with the slope at the begin."""
    slope = (len(b) - 1) * (b[1] - b[0])
    return -0.5 * slope / (b[-1] - b[0] - slope)


def _cells(where: Parts, width: Float[Tensor, " k"], u: Float[Tensor, " k"]) -> Cells:
    """Parts of a width, each with its start at u."""
    u = (u * _GRAIN).round_().div_(_GRAIN).nan_to_num_(0.5).clamp_(0, 1)
    sign = torch.where(where.b[0] < 0, -1.0, 1.0).to(where.b.dtype)
    item, cell = where.number.unbind(0)
    return Cells(item, cell, where.low, width, torch.addcmul(where.low, u, width), sign)


def _cut(where: Parts, to_parts: Tensor, width: float) -> Parts:
    """The parts of some cells, of this width, that may have roots."""
    count = where.b.shape[1]
    parts = (to_parts @ where.b).view(len(where.b), -1)
    place = _with_changes(parts).nonzero()[:, 0]
    part, column = _row_and_column(place, count)
    low = where.low.index_select(0, column).add_(part, alpha=width)
    return Parts(take_columns(where.number, column), low, take_columns(parts, place))


def _row_and_column(place: Int[Tensor, " k"], columns: int) -> tuple[Tensor, Tensor]:
    # Faster than a division of integers. The half keeps what is rounded away from whole numbers: some devices multiply by the
    # reciprocal instead.
    row = place.double().add_(0.5).div_(max(columns, 1)).long()
    return row, place.sub(row, alpha=columns)


@cache
def _matrices(degree: int) -> tuple[Constant, Constant]:
    """From coefficients to Bernstein coefficients in all cells, and from those of one cell to those of its parts.

    The rows are (coefficient, cell) and (coefficient, part).
    """
    cells = _edges(degree)
    to_cells = [
        _blossom([(s, s2 - s)] * k + [(t, t2 - t)] * (degree - k)) for (s, t), (s2, t2) in cells for k in range(degree + 1)
    ]
    whole = torch.tensor(to_cells, dtype=torch.float64).view(len(cells), degree + 1, degree + 1).permute(2, 0, 1)
    parts = []
    for part in range(_PARTS):
        u, step = part / _PARTS, 1 / _PARTS
        for j in range(degree + 1):
            row = _blossom([(u, step)] * j + [(1 - u, -step)] * (degree - j))
            parts.append([math.comb(degree, j) * x for x in row])
    cut = torch.tensor(parts, dtype=torch.float64).view(_PARTS, degree + 1, degree + 1).permute(2, 0, 1)
    return Constant(whole.reshape(-1, degree + 1).contiguous()), Constant(cut.reshape(-1, degree + 1).contiguous())


def _blossom(factors: list[tuple[float, float]]) -> list[float]:
    """Bernstein coefficients of a product of linear functions, each given by its value at 0 and its rise to 1."""
    product = [1.0]
    # Coefficients of u^j (1 - u)^(n - j).
    for value, rise in factors:
        product = [value * a + (value + rise) * b for a, b in zip((*product, 0.0), (0.0, *product), strict=True)]
    return [x / math.comb(len(factors), j) for j, x in enumerate(product)]


def _edges(degree: int) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Sine and cosine at begin and end of all cells, the middle of the first of which is 0."""
    cells = _CELLS * max(degree, 4)
    angles = [(i - 0.5) * math.pi / cells for i in range(cells + 1)]
    ends = [(math.sin(a), math.cos(a)) for a in angles]
    return list(pairwise(ends))


@cache
def chords(degree: int) -> tuple[Constant, Constant]:
    """For each cell a, b, c, d, by which x = (a + u b) / (c + u d) at u of its chord, and whether that is 1 / tan(phi).

    It is so where tan(phi) is larger. A fifth number is the sign that the polynomial, or then its reversal, has before a single
    root in the order of x, if the form is positive at the begin.
    """
    table, inverse = [], []
    for (s, t), (s2, t2) in _edges(degree):
        turned = abs(s + s2) > abs(t + t2)
        a, b, c, d = (t, t2, s, s2) if turned else (s, s2, t, t2)
        # The form is the polynomial times a power of the denominator; 1 / tan(phi) falls.
        sign = math.copysign(1.0, c) ** degree * (-1.0 if turned else 1.0)
        table.append((a, b - a, c, d - c, sign))
        inverse.append(turned)
    return Constant(torch.tensor(table, dtype=torch.float64).mT.contiguous()), Constant(torch.tensor(inverse))
