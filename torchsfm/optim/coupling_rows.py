"""The coupling of eliminated and retained variables as one small matrix per residual.

`W` is stored chunk by chunk, in each coordinate by coordinate (q, c, residuals), residuals sorted by slot, so that products
with it run over contiguous memory, a slot at a time. Nothing here grows with pairs of retained variables.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.optim.layout import CHUNK, Layout
from torchsfm.optim.runs import Runs, find_runs
from torchsfm.optim.terms import Workspace
from torchsfm.optim.triangle import Triangle


@dataclass(frozen=True)
class _Chunk:
    """Residuals worked on at once, and the runs of one slot among them."""

    start: int
    end: int
    runs: Runs


class RowCoupling:
    """`W` as a matrix (q, c) for each coupled residual, pieces one after the other."""

    def __init__(self, layout: Layout, some: Tensor) -> None:
        self.size, self.q, self.points = layout.size, layout.point_size, layout.points
        coupled = [piece for piece in layout.pieces if piece.coupled]
        self.width = max(piece.columns.shape[1] for piece in coupled)
        self._chunks: dict[tuple[int, int], _Chunk] = {}
        columns, slots, points = [], [], []
        rows = count = 0
        for k, piece in enumerate(layout.pieces):
            if not piece.coupled or piece.point is None:
                continue
            # Narrower slots are padded with the column that collects what belongs to nobody.
            blank = piece.columns.new_full((piece.columns.shape[0], self.width - piece.columns.shape[1]), layout.size + 1)
            columns.append(torch.cat((piece.columns, blank), 1))
            slots.append(piece.slots + count)
            points.append(piece.point)
            for start in range(0, piece.slots.numel(), CHUNK):
                part = slots[-1][start : start + CHUNK]
                self._chunks[k, start] = _Chunk(rows + start, rows + start + part.numel(), find_runs(part))
            rows += piece.slots.numel()
            count += piece.columns.shape[0]
        self.columns, self.slots, self.point = torch.cat(columns), torch.cat(slots), torch.cat(points)
        self._W = some.new_zeros(self.q * self.width * rows)
        self._work = Workspace(some)

    def _block(self, chunk: _Chunk) -> Tensor:
        """The part of W that belongs to a chunk, (q, c, m)."""
        size = self.q * self.width
        return self._W[size * chunk.start : size * chunk.end].view(self.q, self.width, -1)

    def clear(self) -> None:
        """Start a linearisation; every row is written, so there is nothing to do."""

    def add(self, piece: int, start: int, J: Tensor, P: Tensor) -> None:
        """Store the products of Jacobians J (d, c, m) and P (d, q, m), those of a piece's residuals from `start` on."""
        d, c, _ = J.shape
        W = self._block(self._chunks[piece, start])
        for a in range(self.q):
            out = W[a, :c]
            torch.mul(J[0], P[0, a], out=out)
            for k in range(1, d):
                out.addcmul_(J[k], P[k, a])

    def squares(self, L: Triangle, z: Tensor, rows: Tensor | None = None) -> Tensor:
        """`Y Y'` of each slot alone, with `Y = W L'^-1` and z (q, points) as one more row: (slots, c + 1, c + 1).

        `rows (residuals, q, c)` gets Y.
        """
        q, c = self.q, self.width
        entries = torch.stack([entry for row in L for entry in row] + list(z))
        out = z.new_zeros((self.columns.shape[0], c + 1, c + 1))
        for chunk in self._chunks.values():
            W, m = self._block(chunk), chunk.end - chunk.start
            index = self.point[chunk.start : chunk.end].expand(len(entries), -1)
            at = torch.gather(entries, 1, index, out=self._work.get("at", len(entries), m))
            Y = self._work.get("Y", q, c + 1, m)
            Y[:, c] = at[-q:]
            place = 0
            for a in range(q):
                row = W[a]
                for b in range(a):
                    torch.addcmul(row, Y[b, :c], at[place + b], value=-1, out=Y[a, :c])
                    row = Y[a, :c]
                torch.mul(row, at[place + a], out=Y[a, :c])
                place += a + 1
                if rows is not None:
                    rows[chunk.start : chunk.end, a] = Y[a, :c].mT
            out.index_add_(0, chunk.runs.slots, chunk.runs.squares(Y))
        return out

    def product(self, kept: Tensor) -> Tensor:
        """`W' kept`, (q, points); kept has the columns of the gradient and of fixed variables too."""
        steps = kept[self.columns]
        each = [c.runs.combine(steps[c.runs.slots], self._block(c)) for c in self._chunks.values()]
        return kept.new_zeros((self.q, self.points)).index_add_(1, self.point, torch.cat(each, 1))

    def lift(self, point: Tensor) -> Tensor:
        """`W point`, with the columns of the gradient and of fixed variables."""
        out = point.new_zeros(self.size + 2)
        for chunk in self._chunks.values():
            index = self.point[chunk.start : chunk.end].expand(self.q, -1)
            at = torch.gather(point, 1, index, out=self._work.get("lifted", *index.shape))
            out.index_add_(0, self.columns[chunk.runs.slots].flatten(), chunk.runs.lift(self._block(chunk), at).flatten())
        return out
