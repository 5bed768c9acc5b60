"""Kernels: pieces are joined, whatever the size of the batch."""

import torch
from torch import Tensor

from torchsfm.linalg.kernel import kernel


@kernel(chunk=4)
def doubled(x: Tensor, y: Tensor, *, factor: float = 2.0) -> tuple[Tensor, Tensor]:
    """Rows (2, batch) and (batch)."""
    return factor * x, x[0] + y


def test_pieces_are_joined(generator: torch.Generator) -> None:
    for batch in (0, 1, 3, 4, 5, 11):
        x, y = torch.randn(2, batch, generator=generator), torch.randn(batch, generator=generator)
        a, b = doubled(x, y, factor=3.0)
        assert torch.equal(a, 3 * x)
        assert torch.equal(b, x[0] + y)
