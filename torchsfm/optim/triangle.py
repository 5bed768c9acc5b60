"""Cholesky factors of many small symmetric blocks at once, elementwise: each entry of a factor is one long row.

Blocks come as the distinct entries of their upper triangle row by row, each row followed by the entry of a right-hand side.
"""

import torch
from torch import Tensor

Triangle = list[list[Tensor]]
"""Lower triangular factors, entry by entry, with the reciprocals of the diagonal in its place."""


def place(a: int, b: int, q: int) -> int:
    """The row that holds entry (a, b >= a) of the blocks; b = q is the right-hand side."""
    return a * (q + 1) - a * (a - 1) // 2 + b - a


def diagonal(V: Tensor, q: int) -> Tensor:
    """The diagonals of all blocks, (q, n)."""
    return V[[place(a, a, q) for a in range(q)]]


def floor(diagonal: Tensor) -> Tensor:
    """A variable that nothing depends on in some direction gets a damping of its own, and does not move."""
    if diagonal.numel() == 0:
        return diagonal
    least = 1e-12 * diagonal.amax(0, keepdim=True)
    return torch.where(least > 0, torch.maximum(diagonal, least), torch.ones_like(diagonal))


def factor(V: Tensor, damping: Tensor, q: int) -> Triangle:
    """Cholesky factors `V + damping = L L'`; damping (q, n)."""
    L: Triangle = []
    for a in range(q):
        row: list[Tensor] = []
        for b in range(a + 1):
            value = V[place(b, a, q)]
            if a == b:
                full = value + damping[a]
                for c in range(b):
                    value = value - row[c] * row[c]
                # Rounding must not take the pivot below what the damping guarantees.
                row.append(torch.maximum(value + damping[a], 1e-15 * full).rsqrt())
            else:
                for c in range(b):
                    value = value - row[c] * L[b][c]
                row.append(value * L[b][b])
        L.append(row)
    return L


def forward(L: Triangle, z: Tensor) -> Tensor:
    """`L^-1 z`."""
    rows: list[Tensor] = []
    for a, value in enumerate(z.unbind(0)):
        for b in range(a):
            value = value - L[a][b] * rows[b]
        rows.append(value * L[a][a])
    return torch.stack(rows)


def backward(L: Triangle, z: Tensor) -> Tensor:
    """`L'^-1 z`."""
    q = len(L)
    rows: list[Tensor] = [z[0]] * q
    for a in reversed(range(q)):
        value = z[a]
        for b in range(a + 1, q):
            value = value - L[b][a] * rows[b]
        rows[a] = value * L[a][a]
    return torch.stack(rows)
