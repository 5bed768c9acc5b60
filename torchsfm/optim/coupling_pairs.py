"""The coupling of eliminated and retained variables as one small matrix per residual, multiplied pair by pair.

Two residuals of the same eliminated variable couple their slots. Pairs are sorted by the block of the system they add to and
cut into runs, padded with a row of zeros, so that a batched product sums over a run. Best where each eliminated variable sees
few of many retained ones.
"""

import torch
from torch import Tensor

from torchsfm.optim.layout import Layout
from torchsfm.optim.terms import Workspace

PAIR = 1.5e-7
"""Seconds per pair, on a usual core."""
RESIDUAL = 2.5e-7
"""Seconds per residual, to divide by the Cholesky factors and sum over slots."""
BATCH = 4096
"""Pairs multiplied at once."""


class PairCoupling:
    """`W` as a matrix (q, c) for each coupled residual, pieces one after the other."""

    def __init__(self, layout: Layout, some: Tensor) -> None:
        self.size, self.q, self.points = layout.size, layout.point_size, layout.points
        coupled = [piece for piece in layout.pieces if piece.coupled]
        self.width = max(piece.columns.shape[1] for piece in coupled)
        self._first: list[int] = []
        columns, slots, points, ends = [], [], [], []
        rows = count = 0
        for piece in layout.pieces:
            self._first.append(rows)
            if not piece.coupled or piece.point is None:
                continue
            # Narrower slots are padded with the column that collects what belongs to nobody.
            blank = piece.columns.new_full((piece.columns.shape[0], self.width - piece.columns.shape[1]), layout.size + 1)
            columns.append(torch.cat((piece.columns, blank), 1))
            slots.append(piece.slots + count)
            points.append(piece.point)
            ends.append(torch.bincount(piece.slots, minlength=piece.columns.shape[0]))
            rows += piece.slots.numel()
            count += piece.columns.shape[0]
        self.columns, self.point = torch.cat(columns), torch.cat(points)
        self._lengths: list[int] = torch.cat(ends).tolist()
        self._plan(torch.cat(slots), count)
        # One row of zeros more, for padding.
        self._W = some.new_zeros((rows + 1, self.q, self.width))
        self._Y = torch.zeros_like(self._W)
        self._work = Workspace(some)

    def _plan(self, slots: Tensor, count: int) -> None:
        order = torch.argsort(self.point * count + slots)
        point = self.point[order]
        at = torch.arange(order.numel(), device=order.device)
        first, second = [], []
        for distance in range(1, order.numel()):
            at = at[at < order.numel() - distance]
            at = at[point[at] == point[at + distance]]
            if not at.numel():
                break
            first.append(order[at])
            second.append(order[at + distance])
        left = torch.cat(first) if first else order[:0]
        right = torch.cat(second) if second else order[:0]
        key = slots[left] * count + slots[right]
        sort = torch.argsort(key)
        left, right = left[sort], right[sort]
        blocks, sizes = torch.unique_consecutive(key[sort], return_counts=True)
        mean = left.numel() / max(blocks.numel(), 1)
        self._run = 16 if mean > 24 else 8 if mean > 8 else 4
        runs = -torch.div(-sizes, self._run, rounding_mode="floor")
        starts = (runs.cumsum(0) - runs) * self._run - (sizes.cumsum(0) - sizes)
        place = torch.arange(left.numel(), device=left.device) + starts.repeat_interleave(sizes)
        padded = int(runs.sum()) * self._run
        blank = torch.full((padded,), slots.numel(), device=left.device)
        self._left, self._right = blank.index_copy(0, place, left), blank.index_copy(0, place, right)
        self._block = torch.arange(blocks.numel(), device=blocks.device).repeat_interleave(runs)
        self._row = self.columns[torch.div(blocks, count, rounding_mode="floor")] if count else self.columns
        self._column = self.columns[blocks % count] if count else self.columns

    def clear(self) -> None:
        """Start a linearisation; every row is written, so there is nothing to do."""

    def add(self, piece: int, start: int, J: Tensor, P: Tensor) -> None:
        """Store the products of Jacobians J (d, c, m) and P (d, q, m), those of a piece's residuals from `start` on."""
        d, c, m = J.shape
        begin = self._first[piece] + start
        rows = self._W[begin : begin + m]
        for a in range(self.q):
            product = torch.mul(J[0], P[0, a], out=self._work.get("product", c, m))
            for k in range(1, d):
                product.addcmul_(J[k], P[k, a])
            rows[:, a, :c] = product.mT

    def reduce(self, S: Tensor, L: list[list[Tensor]], z: Tensor) -> Tensor:
        """Subtract `W V^-1 W'` from S, with `V = L L'`; return `W L'^-1 z`."""
        wide, q, c = S.shape[0], self.q, self.width
        inverse = _invert(L)
        step = BATCH
        for begin in range(0, self.point.numel(), step):
            span = slice(begin, begin + step)
            chosen = self._work.get("inverse", self.point[span].numel(), q, q)
            torch.index_select(inverse, 0, self.point[span], out=chosen)
            torch.bmm(chosen, self._W[:-1][span], out=self._Y[:-1][span])
        right = S.new_zeros(wide)
        squares, sums = [], []
        at = z.mT.index_select(0, self.point)
        begin = 0
        for length in self._lengths:
            Y = self._Y[begin : begin + length].view(-1, c)
            squares.append(Y.mT @ Y)
            sums.append(Y.mT @ at[begin : begin + length].reshape(-1))
            begin += length
        right.index_add_(0, self.columns.flatten(), torch.cat(sums))
        place = self.columns[:, :, None] * wide + self.columns[:, None]
        S.view(-1).index_add_(0, place.flatten(), torch.stack(squares).flatten(), alpha=-1)
        flat = self._Y.view(-1, q * c)
        total = S.new_zeros((self._row.shape[0], c * c))
        for begin in range(0, self._left.numel(), step):
            sides = []
            for name, index in (("left", self._left), ("right", self._right)):
                chosen = index[begin : begin + step]
                out = self._work.get(name, chosen.numel(), q * c)
                sides.append(torch.index_select(flat, 0, chosen, out=out).view(-1, self._run * q, c))
            block = self._block[begin // self._run : (begin + step) // self._run]
            product = self._work.get("pairs", block.numel(), c, c)
            total.index_add_(0, block, torch.bmm(sides[0].mT, sides[1], out=product).view(-1, c * c))
        place = self._row[:, :, None] * wide + self._column[:, None]
        off = torch.zeros_like(S)
        off.view(-1).index_add_(0, place.flatten(), total.view(-1))
        S -= off
        S -= off.mT
        return right

    def product(self, kept: Tensor) -> Tensor:
        """`W' kept`."""
        steps = kept[self.columns]
        parts, begin = [], 0
        for step, length in zip(steps, self._lengths, strict=True):
            parts.append(self._W[begin : begin + length].view(-1, self.width) @ step)
            begin += length
        each = torch.cat(parts).view(-1, self.q)
        return kept.new_zeros((self.points, self.q)).index_add_(0, self.point, each).mT

    def lift(self, point: Tensor) -> Tensor:
        """`W point`."""
        at = point.mT.index_select(0, self.point)
        sums, begin = [], 0
        for length in self._lengths:
            span = slice(begin, begin + length)
            sums.append(self._W[span].view(-1, self.width).mT @ at[span].reshape(-1))
            begin += length
        return point.new_zeros(self.size + 2).index_add_(0, self.columns.flatten(), torch.cat(sums))


def estimate_pairs(layout: Layout) -> float:
    """Seconds that a reduction pair by pair takes, about."""
    count = torch.zeros(layout.points, device=layout.pieces[0].slots.device)
    rows = 0
    for piece in layout.pieces:
        if piece.coupled and piece.point is not None:
            count += torch.bincount(piece.point, minlength=layout.points)
            rows += piece.point.numel()
    return float((count * (count - 1)).sum()) / 2 * PAIR + rows * RESIDUAL


def _invert(L: list[list[Tensor]]) -> Tensor:
    """`L^-1` as matrices (n, q, q); L holds reciprocals on its diagonal."""
    q = len(L)
    zero = torch.zeros_like(L[0][0])
    rows: list[list[Tensor]] = []
    for a in range(q):
        row = []
        for b in range(q):
            if b > a:
                row.append(zero)
            elif b == a:
                row.append(L[a][a])
            else:
                total = L[a][b] * rows[b][b]
                for c in range(b + 1, a):
                    total = total + L[a][c] * rows[c][b]
                row.append(-total * L[a][a])
        rows.append(row)
    return torch.stack([entry for row in rows for entry in row], -1).view(-1, q, q)
