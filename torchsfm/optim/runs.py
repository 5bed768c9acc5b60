"""Sums over runs: consecutive columns of a matrix that belong to one slot.

Long runs are products of contiguous matrices, one call each. Short ones are worked on all together, column by column.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

SHORT = 16
"""Columns of a run below which a call costs more than the arithmetic."""


@dataclass(frozen=True)
class Runs:
    """Where runs begin and end, and the slot of each."""

    ends: list[tuple[int, int]]
    slots: Tensor
    number: Tensor | None
    """The run of each column where runs are short."""

    def squares(self, Y: Tensor) -> Tensor:
        """`Y Y'` of Y (q, c, m), summed over q: (runs, c, c)."""
        if self.number is None:
            return torch.stack([torch.bmm(Y[:, :, a:b], Y[:, :, a:b].mT) for a, b in self.ends]).sum(1)
        rows = Y.permute(2, 1, 0).contiguous()
        return rows.new_zeros((len(self.ends), *Y.shape[1:2] * 2)).index_add_(0, self.number, rows @ rows.mT)

    def combine(self, steps: Tensor, W: Tensor) -> Tensor:
        """Rows of W (q, c, m) combined by the coefficients (runs, c) of their run: (q, m)."""
        if self.number is None:
            return torch.cat([steps[k] @ W[:, :, a:b] for k, (a, b) in enumerate(self.ends)], -1)
        return (W * steps.mT[:, self.number]).sum(1)

    def lift(self, W: Tensor, at: Tensor) -> Tensor:
        """Columns of W (q, c, m) summed with the factors (q, m), over q too: (runs, c)."""
        if self.number is None:
            column = at[:, :, None]
            return torch.stack([torch.bmm(W[:, :, a:b], column[:, a:b]) for a, b in self.ends]).sum(1)[:, :, 0]
        columns = (W * at[:, None]).sum(0).mT
        return columns.new_zeros((len(self.ends), W.shape[1])).index_add_(0, self.number, columns)


def find_runs(slots: Tensor) -> Runs:
    """The runs of equal slots, one after the other."""
    found, lengths = torch.unique_consecutive(slots, return_counts=True)
    short = slots.numel() < SHORT * found.numel()
    number = torch.arange(found.numel(), device=slots.device).repeat_interleave(lengths) if short else None
    return Runs(list(pairwise([0, *lengths.cumsum(0).tolist()])), found, number)
