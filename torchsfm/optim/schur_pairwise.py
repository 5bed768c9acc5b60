"""The Schur complement pair by pair: residuals of the same eliminated variable couple their slots.

Pairs are sorted by the block of the system they add to and cut into runs, padded with a row of zeros, so that a batched product
sums over a run. Best where each eliminated variable sees few of many retained ones. Columns that all slots have in common (a
camera of all photographs) meet each residual with the sum over its variable's others: no pairs for these.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.optim.batched_cholesky import Triangle
from torchsfm.optim.layout import Family
from torchsfm.optim.retained_blocks import DenseMatrix, Matrix, add_squares
from torchsfm.optim.schur_matrix_free import RowCoupling
from torchsfm.optim.terms import Workspace

PAIR = 1.1e-7
"""Seconds per pair, on a usual core."""
RESIDUAL = 1.3e-7
"""Seconds per residual, to divide by the Cholesky factors and sum over slots."""
BATCH = 4096
"""Pairs multiplied at once."""
SHORT = 2**31
"""Numbers that half the length will do for, which take half the time to sort and to gather."""


@dataclass(frozen=True)
class _Pairs:
    """Which residuals are multiplied, and where that goes."""

    run: int
    """Pairs of a run."""
    left: Tensor
    right: Tensor
    block: Tensor
    """Of each run."""
    places: Tensor
    """Of the entries of all blocks,"""
    twice: Tensor
    """and those that count twice."""


class PairCoupling:
    """`W` as a matrix for each residual, and the plan of all pairs."""

    def __init__(self, family: Family, some: Tensor, matrix: Matrix | None = None, like: "PairCoupling | None" = None) -> None:
        """Plan what is done once per problem.

        Args:
            family: The eliminated variables.
            some: A number of the kind wanted.
            matrix: Where the entries of the system are; all of them, if not given.
            like: Another one of the same family and matrix, whose plan will do.
        """
        self._matrix = matrix or DenseMatrix(family.size)
        self._rows = RowCoupling(family, some)
        same = (self._rows.columns == self._rows.columns[:1]).all(0)
        self._common, self._own = same.nonzero()[:, 0], (~same).nonzero()[:, 0]
        self._pairs: _Pairs = self._plan(self._rows.slots, self._rows.columns.shape[0]) if like is None else like._pairs
        # One row of zeros more, for padding.
        self._Y = some.new_zeros((self._rows.slots.numel() + 1, self._rows.q, len(self._own)))
        self._work = Workspace(some)

    def clear(self) -> None:
        """Start a linearisation."""
        self._rows.clear()

    def add(self, piece: int, start: int, J: Tensor, P: Tensor) -> None:
        """Store the products of Jacobians J (d, c, m) and P (d, q, m), those of a piece's residuals from `start` on."""
        self._rows.add(piece, start, J, P)

    def product(self, kept: Tensor) -> Tensor:
        """`W' kept`."""
        return self._rows.product(kept)

    def lift(self, point: Tensor) -> Tensor:
        """`W point`."""
        return self._rows.lift(point)

    def _plan(self, slots: Tensor, count: int) -> _Pairs:
        left, right, key = pairs_of_points(self._rows.point, slots, count)
        key, sort = torch.sort(key)
        blocks, sizes = torch.unique_consecutive(key, return_counts=True)
        blocks = blocks.long()
        mean = left.numel() / max(blocks.numel(), 1)
        run = 32 if mean > 96 else 16 if mean > 24 else 8 if mean > 8 else 4
        runs = -torch.div(-sizes, run, rounding_mode="floor")
        starts = (runs.cumsum(0) - runs) * run - (sizes.cumsum(0) - sizes)
        place = torch.arange(left.numel(), device=left.device) + starts.repeat_interleave(sizes)
        padded = int(runs.sum()) * run
        blank = torch.full((padded,), slots.numel(), device=left.device, dtype=torch.int32)
        block = torch.arange(blocks.numel(), device=blocks.device).repeat_interleave(runs)
        # Entries (r, c) and (c, r) both go below the diagonal, so one on it counts twice.
        columns = self._rows.columns[:, self._own]
        row = columns[torch.div(blocks, max(count, 1), rounding_mode="floor")][:, :, None]
        column = columns[blocks % max(count, 1)][:, None]
        return _Pairs(
            run,
            blank.index_copy(0, place, left.index_select(0, sort)),
            blank.index_copy(0, place, right.index_select(0, sort)),
            block,
            self._matrix.places(row, column).flatten(),
            (row == column).flatten().nonzero()[:, 0],
        )

    def reduce(self, S: Tensor, L: Triangle, z: Tensor) -> None:
        """Subtract `W V^-1 W'` from the numbers S of the matrix, with `V = L L'`, and `W L'^-1 z` from its column `size`."""
        q, c, pairs = self._rows.q, len(self._own), self._pairs
        columns = torch.nn.functional.pad(self._rows.columns, (0, 1), value=self._rows.size)
        add_squares(S, self._matrix, columns, self._squares(L, z), -1.0)
        if not c:
            return
        flat = self._Y.view(-1, q * c)
        total = S.new_zeros((pairs.places.numel() // (c * c), c * c))
        for begin in range(0, pairs.left.numel(), BATCH):
            sides = []
            for name, index in (("left", pairs.left), ("right", pairs.right)):
                chosen = index[begin : begin + BATCH]
                out = self._work.get(name, chosen.numel(), q * c)
                sides.append(torch.index_select(flat, 0, chosen, out=out).view(-1, pairs.run * q, c))
            block = pairs.block[begin // pairs.run : (begin + BATCH) // pairs.run]
            product = self._work.get("pairs", block.numel(), c, c)
            total.index_add_(0, block, torch.bmm(sides[0].mT, sides[1], out=product).view(-1, c * c))
        entries = total.view(-1)
        entries[pairs.twice] *= 2
        S.view(-1).index_add_(0, pairs.places, entries, alpha=-1)

    def _squares(self, L: Triangle, z: Tensor) -> Tensor:
        """The squares of slots, and what the common columns of each variable's other residuals make with them; keeps Y."""
        common, own, width = self._common, self._own, self._rows.width + 1
        total = self._rows.totals(L, common) if len(common) else None
        found = z.new_zeros((self._rows.columns.shape[0], width, width + len(common)))
        for chunk, Y in self._rows.whitened(L, z, total):
            Y[:, width:] -= Y[:, common]
            found.index_add_(0, chunk.runs.slots, chunk.runs.products(Y[:, :width], Y))
            for a, rows in enumerate(Y):
                self._Y[chunk.start : chunk.end, a] = rows.index_select(0, own).mT
        squares, met = found[:, :, :width], found[:, :-1, width:]
        squares[:, :-1, common] += met
        squares[:, common[:, None], own] += met[:, own].mT
        return squares


def pairs_of_points(point: Tensor, slots: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """All pairs of residuals of one point, the one with the earlier slot on the left, and a number for the slots of each.

    Residuals are sorted by slot.
    """
    point, order = torch.sort(point, stable=True)
    at = torch.arange(order.numel(), device=order.device)
    later = torch.bincount(point).cumsum(0)[point] - at - 1
    total = int(later.sum())
    kind = torch.int32 if max(total, count**2) < SHORT else torch.int64
    order, at, slots = order.to(kind), at.to(kind), slots[order].to(kind)
    # Those of a point are next to each other: each meets all after it.
    left = at.repeat_interleave(later)
    first = at + 1 - (later.cumsum(0) - later).to(kind)
    right = first.repeat_interleave(later) + torch.arange(total, dtype=kind, device=at.device)
    key = (slots * count).repeat_interleave(later) + slots.index_select(0, right)
    return order.index_select(0, left).int(), order.index_select(0, right).int(), key


def estimate_pairs(family: Family) -> float:
    """Seconds that a reduction pair by pair takes, about."""
    count = torch.zeros(family.points, dtype=torch.float64, device=family.pieces[0].slots.device)
    rows = 0
    for piece in family.pieces:
        if piece.coupled and piece.point is not None:
            count += torch.bincount(piece.point, minlength=family.points)
            rows += piece.point.numel()
    return float((count * (count - 1)).sum()) / 2 * PAIR + rows * RESIDUAL
