"""The normal equations of the retained variables, one square per slot: memory in proportion to the slots that occur.

Residuals are sorted by slot, so those of a slot are a run of columns. Long runs are products of contiguous matrices, one call
each; short ones are worked on all together, column by column. Slots may share columns (views of one camera), so the matrix is
the sum of the squares, each put in its place.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from torchsfm.optim.layout import Layout

SHORT = 16
"""Columns of a run below which a call costs more than the arithmetic."""


@dataclass(frozen=True)
class Runs:
    """Where runs begin, how long they are, and the slot of each."""

    starts: Tensor
    lengths: Tensor
    slots: Tensor
    number: Tensor | None
    """The run of each column where runs are short."""

    @cached_property
    def ends(self) -> list[tuple[int, int]]:
        """Where each begins and ends."""
        return list(pairwise([0, *self.lengths.cumsum(0).tolist()]))

    def squares(self, Y: Tensor) -> Tensor:
        """`Y Y'` of Y (q, c, m), summed over q: (runs, c, c)."""
        return self.products(Y, Y)

    def products(self, Y: Tensor, Z: Tensor) -> Tensor:
        """`Y Z'` of Y (q, c, m) and Z (q, k, m), summed over q: (runs, c, k)."""
        if self.number is None:
            return torch.stack([torch.bmm(Y[:, :, a:b], Z[:, :, a:b].mT) for a, b in self.ends]).sum(1)
        rows = Y.permute(2, 1, 0).contiguous()
        other = rows if Z is Y else Z.permute(2, 1, 0).contiguous()
        return rows.new_zeros((len(self.slots), Y.shape[1], Z.shape[1])).index_add_(0, self.number, rows @ other.mT)

    def combine(self, steps: Tensor, W: Tensor) -> Tensor:
        """Rows of W (q, c, m) combined by the coefficients (runs, c) of their run: (q, m)."""
        if self.number is None:
            rows = steps[:, None, None].expand(-1, len(W), 1, -1)
            return torch.cat([torch.bmm(row, part) for row, part in zip(rows, self._parts(W), strict=True)], -1)[:, 0]
        return (W * steps.mT[:, self.number]).sum(1)

    def lift(self, W: Tensor, at: Tensor) -> Tensor:
        """Columns of W (q, c, m) summed with the factors (q, m), over q too: (runs, c)."""
        if self.number is None:
            # A row from the left: with a column from the right the same product takes several times as long.
            rows = self._parts(at[:, None])
            return torch.stack([torch.bmm(row, part.mT) for row, part in zip(rows, self._parts(W), strict=True)]).sum(1)[:, 0]
        columns = (W * at[:, None]).sum(0).mT
        return columns.new_zeros((len(self.slots), W.shape[1])).index_add_(0, self.number, columns)

    def _parts(self, W: Tensor) -> tuple[Tensor, ...]:
        """The columns of each run."""
        return torch.split(W, [b - a for a, b in self.ends], -1)


def find_runs(slots: Tensor) -> Runs:
    """The runs of equal slots, one after the other."""
    found, lengths = torch.unique_consecutive(slots, return_counts=True)
    short = slots.numel() < SHORT * found.numel()
    number = torch.arange(found.numel(), device=slots.device).repeat_interleave(lengths) if short else None
    return Runs(lengths.cumsum(0) - lengths, lengths, found, number)


class RetainedBlocks:
    """`U` and its gradient; each square has the gradient as one more row and column."""

    def __init__(self, layout: Layout, some: Tensor) -> None:
        self.size = layout.size
        self._nothing = some.new_zeros(0)
        wide = [piece.columns.new_full((piece.columns.shape[0], 1), layout.size) for piece in layout.pieces]
        self.columns = [torch.cat((p.columns, w), 1) for p, w in zip(layout.pieces, wide, strict=True)]
        self.values = [some.new_zeros((*c.shape, c.shape[1])) for c in self.columns]

    def clear(self) -> None:
        """Start a linearisation."""
        for values in self.values:
            values.zero_()

    def dense(self) -> Tensor:
        """The matrix (size + 2, size + 2): row and column `size` are the gradient, the last ones belong to fixed variables."""
        return self.filled(DenseMatrix(self.size))

    def filled(self, matrix: "Matrix") -> Tensor:
        """The numbers of a matrix of some form."""
        S = matrix.zeros(self._nothing)
        for columns, values in zip(self.columns, self.values, strict=True):
            add_squares(S, matrix, columns, values)
        return S

    def diagonal(self) -> Tensor:
        """The diagonal (size)."""
        return self._sum([values.diagonal(dim1=1, dim2=2) for values in self.values])

    def gradient(self) -> Tensor:
        """The gradient (size)."""
        return self._sum([values[:, -1] for values in self.values])

    def product(self, x: Tensor) -> Tensor:
        """`U x`, (size)."""
        full = torch.cat((x, x.new_zeros(2)))
        return self._sum([(v @ full[c][:, :, None])[:, :, 0] for c, v in zip(self.columns, self.values, strict=True)])

    def _sum(self, parts: list[Tensor]) -> Tensor:
        out = self._nothing.new_zeros(self.size + 2)
        for columns, part in zip(self.columns, parts, strict=True):
            out.index_add_(0, columns.flatten(), part.flatten())
        return out[: self.size]


@runtime_checkable
class Matrix(Protocol):
    """Where the entries of a symmetric matrix are, with a column for the gradient and one for what belongs to nobody."""

    def zeros(self, some: Tensor) -> Tensor:
        """The numbers of the matrix."""

    def places(self, row: Tensor, column: Tensor) -> Tensor:
        """Where entries of either triangle are among the numbers."""

    def squares(self, columns: Tensor) -> Tensor:
        """Where squares over columns (n, c) are, (n, c, c), both triangles of each."""


class DenseMatrix:
    """All entries, (size + 2, size + 2); of both triangles where squares are added, else of the lower one."""

    def __init__(self, size: int) -> None:
        self._wide = size + 2

    def zeros(self, some: Tensor) -> Tensor:
        """The matrix."""
        return some.new_zeros((self._wide, self._wide))

    def places(self, row: Tensor, column: Tensor) -> Tensor:
        """Where entries of either triangle are in the lower one."""
        return torch.maximum(row, column) * self._wide + torch.minimum(row, column)

    def squares(self, columns: Tensor) -> Tensor:
        """Where squares over columns (n, c) are, (n, c, c)."""
        return columns[:, :, None] * self._wide + columns[:, None]


def add_squares(S: Tensor, matrix: Matrix, columns: Tensor, values: Tensor, scale: float = 1.0) -> None:
    """Add squares `values (slots, c, c)` to the numbers S of a matrix where `columns (slots, c)` say."""
    S.view(-1).index_add_(0, matrix.squares(columns).flatten(), values.flatten(), alpha=scale)
