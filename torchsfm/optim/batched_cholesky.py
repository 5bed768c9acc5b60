"""Cholesky factors of many small symmetric blocks at once, elementwise: each entry of a factor is one long row.

Blocks come as the distinct entries of their upper triangle row by row, each row followed by the entry of a right-hand side.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchsfm.linalg import eigh

SPHERE = 1e-5
"""Share of a sphere in the measure of a step, small enough to leave points far away as free as others."""
FLAT = 1e-6
"""Of the Gauss-Newton curvature, a part that counts as none."""
STIFF = 1e8
"""In units of the Gauss-Newton curvature, one that nothing moves against."""
Triangle = list[list[Tensor]]
"""Lower triangular factors, entry by entry, with the reciprocals of the diagonal in its place."""


def place(a: int, b: int, q: int) -> int:
    """The row that holds entry (a, b >= a) of the blocks; b = q is the right-hand side."""
    return a * (q + 1) - a * (a - 1) // 2 + b - a


def diagonal(V: Tensor, q: int) -> Tensor:
    """The diagonals of all blocks, (q, n)."""
    return V[[place(a, a, q) for a in range(q)]]


def floor(diagonal: Tensor, kinds: Tensor | None = None) -> Tensor:
    """A variable that nothing depends on in some direction gets a damping of its own, and does not move.

    Args:
        diagonal: Of the systems, columns first.
        kinds: The number of each column's kind, as where columns have units of their own.
    """
    if diagonal.numel() == 0:
        return diagonal
    top = diagonal.amax(0, keepdim=True)
    least = 1e-12 * top
    if kinds is not None:
        own = diagonal.new_zeros(diagonal.shape).scatter_reduce(0, kinds, diagonal, "amax")[kinds]
        # What is left of a kind by rounding alone is no unit.
        least = torch.maximum(1e-12 * own, 1e-30 * top)
    return torch.where(top > 0, torch.maximum(diagonal, least), torch.ones_like(diagonal))


def measure(V: Tensor, q: int) -> Tensor:
    """The blocks by which steps are measured: V itself, and a little of a sphere, so that what nothing depends on stays."""
    if not q:
        return V
    top = diagonal(V, q).amax(0)
    round_ = torch.where(top > 0, SPHERE * top, torch.ones_like(top))
    measured = (1 - SPHERE) * V
    for a in range(q):
        measured[place(a, a, q)] += round_
    return measured


def hold(V: Tensor, metric: Tensor, q: int, least: float = FLAT) -> Tensor:
    """Make blocks stiff, in place, along directions in which no more than a part is left of the curvature that `metric` has.

    Returns:
        Which blocks (n) were so flat, or bent down.
    """
    measured = measure(metric, q)
    _, curved = factor(V - least * measured, q)
    flat = (~curved).nonzero()[:, 0]
    rows = torch.tensor([[place(min(a, b), max(a, b), q) for b in range(q)] for a in range(q)], device=V.device)
    root = torch.linalg.cholesky_ex(measured[:, flat][rows].permute(2, 0, 1))[0]
    half = torch.linalg.solve_triangular(root, V[:, flat][rows].permute(2, 0, 1), upper=False)
    values, vectors, _ = eigh(torch.linalg.solve_triangular(root, half.mT, upper=False))
    held = root @ (vectors * (values <= least)[:, None])
    stiff = STIFF * held @ held.mT
    for a in range(q):
        for b in range(a, q):
            V[place(a, b, q), flat] += stiff[:, a, b]
    return ~curved


def product(V: Tensor, x: Tensor) -> Tensor:
    """Each block times its vector, (q, n)."""
    q = len(x)
    rows = [torch.stack([V[place(min(a, b), max(a, b), q)] for b in range(q)]) for a in range(q)]
    return torch.stack([(row * x).sum(0) for row in rows])


def factor(V: Tensor | Sequence[Tensor], q: int) -> tuple[Triangle, Tensor]:
    """Cholesky factors `V = L L'`, and which blocks (n) are positive definite."""
    L: Triangle = []
    positive = torch.ones_like(V[0], dtype=torch.bool)
    for a in range(q):
        row: list[Tensor] = []
        for b in range(a + 1):
            value = V[place(b, a, q)]
            if a == b:
                full = value
                for c in range(b):
                    value = value - row[c] * row[c]
                # Rounding must not take a pivot to zero or below.
                least = 1e-15 * full.abs()
                positive &= value > least
                row.append(torch.maximum(value, least).rsqrt())
            else:
                for c in range(b):
                    value = value - row[c] * L[b][c]
                row.append(value * L[b][b])
        L.append(row)
    return L, positive


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
