"""The normal equations of the retained variables, one square per slot: memory in proportion to the slots that occur.

Slots may share columns (views of one camera), so the matrix is the sum of the squares, each put in its place.
"""

import torch
from torch import Tensor

from torchsfm.optim.layout import Layout


class Squares:
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
        S = self._nothing.new_zeros((self.size + 2, self.size + 2))
        for columns, values in zip(self.columns, self.values, strict=True):
            add_squares(S, columns, values)
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


def add_squares(S: Tensor, columns: Tensor, values: Tensor, scale: float = 1.0) -> None:
    """Add squares `values (slots, c, c)` to S where `columns (slots, c)` say."""
    places = columns[:, :, None] * S.shape[1] + columns[:, None]
    S.view(-1).index_add_(0, places.flatten(), values.flatten(), alpha=scale)
