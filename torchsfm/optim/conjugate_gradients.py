"""The reduced system solved without ever being formed, by preconditioned conjugate gradients.

A product with `S = U - W V^-1 W'` takes two passes over W, so memory grows with the residuals and not with pairs of retained
variables (Agarwal et al. 2010). The preconditioner inverts diagonal blocks of S (Schur-Jacobi), one for each cluster of
variables that only ever occur together, such as the pose and the intrinsics of one photograph.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from torchsfm.optim.coupling_rows import RowCoupling
from torchsfm.optim.layout import Layout
from torchsfm.optim.squares import Squares
from torchsfm.optim.triangle import Triangle, backward, forward

Apply = Callable[[Tensor], Tensor]
FORCING = 0.1
"""Stop when the residual, in the norm of the preconditioner, has come down to this fraction (Agarwal et al. 2010), and an
iteration adds less than this fraction, divided by their number, to the decrease of the model (Nash & Sofer 1990). The second
test alone, which is Ceres', ends after two iterations while a few bad points have most of the cost, and the shape never moves.
"""
ITERATIONS = 500


@dataclass(frozen=True)
class Clusters:
    """A partition of the retained columns, clusters of one width together."""

    groups: list[Tensor]
    """Columns of the clusters of each width, (clusters, width)."""
    places: list[Tensor]
    """Where the entries of each piece's squares go in the blocks one after the other, at their end if nowhere."""
    coupled: Tensor
    """The same for the squares of a `RowCoupling`."""
    total: int


def find_clusters(layout: Layout, coupling: RowCoupling | None) -> Clusters:
    """Put variables that occur in the same slots together."""
    device = layout.pieces[0].columns.device
    owner = _owners(layout, device)
    variables = int(owner[-1])
    generator = torch.Generator().manual_seed(0)
    mark = torch.randint(2**62, (variables + 1,), generator=generator).to(device)
    # The first column of each variable stands for it.
    head = torch.ones_like(owner, dtype=torch.bool)
    head[1:] = owner[1:] != owner[:-1]
    columns = [coupling.columns] if coupling is not None else [p.columns for p in layout.pieces]
    met, keys = [], []
    for c in columns:
        counts = head[c] & (c < layout.size)
        key = torch.where(counts, mark[owner[c]], 0).sum(1)
        met.append(owner[c][counts])
        keys.append((key ^ (key >> 31))[:, None].expand_as(c)[counts] * 0x5851F42D4C957F2D)
    pairs = torch.unique(torch.stack((torch.cat(met), torch.cat(keys))), dim=1)
    signature = torch.zeros_like(mark).index_add_(0, *pairs)
    alone = torch.ones_like(mark, dtype=torch.bool).index_fill_(0, pairs[0], False)
    _, cluster = torch.unique(torch.where(alone, mark, signature)[:variables], return_inverse=True)
    return _lay_blocks(layout, coupling, cluster[owner[: layout.size]])


def _owners(layout: Layout, device: torch.device) -> Tensor:
    """The number of the variable that each column belongs to; one more for the columns at the end."""
    ends = [*list(layout.first.values())[1:], layout.size]
    owner = torch.empty(layout.size + 2, dtype=torch.int64, device=device)
    count = 0
    for (name, start), end in zip(layout.first.items(), ends, strict=True):
        number = layout.free[name].numel()
        owner[start:end] = count + torch.arange(number, device=device).repeat_interleave((end - start) // number)
        count += number
    owner[layout.size :] = count
    return owner


def _lay_blocks(layout: Layout, coupling: RowCoupling | None, cluster: Tensor) -> Clusters:
    """Where each cluster's block stands, given the cluster of each column."""
    widths = torch.bincount(cluster)
    order = torch.argsort(cluster, stable=True)
    starts = widths.cumsum(0) - widths
    position = torch.empty_like(cluster)
    position[order] = torch.arange(order.numel(), device=order.device) - starts.repeat_interleave(widths)
    offset = torch.empty_like(widths)
    groups, total = [], 0
    for width in torch.unique(widths).tolist():
        chosen = (widths == width).nonzero()[:, 0]
        offset[chosen] = total + torch.arange(chosen.numel(), device=chosen.device) * width * width
        groups.append(order[starts[chosen][:, None] + torch.arange(width, device=chosen.device)])
        total += chosen.numel() * width * width

    def places(columns: Tensor) -> Tensor:
        inside = columns < layout.size
        safe = torch.where(inside, columns, 0)
        mine, at = torch.where(inside, cluster[safe], -1), position[safe]
        together = (mine[:, :, None] == mine[:, None]) & inside[:, :, None]
        found = offset[mine.clamp_min(0)][:, :, None] + at[:, :, None] * widths[mine.clamp_min(0)][:, :, None] + at[:, None]
        return torch.where(together, found, total).flatten()

    empty = layout.pieces[0].columns[:0]
    pieces = [places(piece.columns) for piece in layout.pieces]
    return Clusters(groups, pieces, places(empty if coupling is None else coupling.columns), total)


class _SchurJacobi:
    """The inverses of the diagonal blocks."""

    def __init__(self, clusters: Clusters, squares: Squares, coupled: Tensor | None, weight: Tensor) -> None:
        flat = weight.new_zeros(clusters.total + 1)
        for place, values in zip(clusters.places, squares.values, strict=True):
            flat.index_add_(0, place, values[:, :-1, :-1].flatten())
        if coupled is not None:
            flat.index_add_(0, clusters.coupled, coupled[:, :-1, :-1].flatten(), alpha=-1)
        ends = [0]
        for group in clusters.groups:
            ends.append(ends[-1] + group.numel() * group.shape[1])
        self._groups = clusters.groups
        self._inverse = []
        for group, (start, end) in zip(clusters.groups, pairwise(ends), strict=True):
            block = flat[start:end].view(-1, group.shape[1], group.shape[1]) + torch.diag_embed(weight[group])
            lower, info = torch.linalg.cholesky_ex(block)
            # Where rounding spoils a block, its diagonal has to do.
            plain = torch.diag_embed(block.diagonal(dim1=1, dim2=2).abs().clamp_min(1e-300).sqrt())
            self._inverse.append(torch.cholesky_inverse(torch.where((info == 0)[:, None, None], lower, plain)))

    def __call__(self, r: Tensor) -> Tensor:
        out = torch.empty_like(r)
        for group, inverse in zip(self._groups, self._inverse, strict=True):
            out[group] = torch.bmm(inverse, r[group][:, :, None])[:, :, 0]
        return out


def solve_reduced(
    squares: Squares, coupling: RowCoupling | None, clusters: Clusters, L: Triangle, z: Tensor, weight: Tensor
) -> tuple[Tensor, bool]:
    """The step of the retained variables for a damping `weight`, to the accuracy of `FORCING`, and whether there is one.

    Args:
        squares: U and the gradient.
        coupling: W.
        clusters: The preconditioner's blocks.
        L: The factors of V.
        z: `L^-1 h`.
        weight: Added to the diagonal, (size).
    """
    right = squares.gradient()
    coupled = None if coupling is None else coupling.squares(L, z)
    if coupling is not None and coupled is not None:
        columns, share = coupling.columns.flatten(), coupled[:, :-1, -1].flatten()
        full = torch.cat((right, right.new_zeros(2)))
        right = full.index_add_(0, columns, share, alpha=-1)[: len(right)]
    precondition = _SchurJacobi(clusters, squares, coupled, weight)

    def apply(x: Tensor) -> Tensor:
        out = squares.product(x) + weight * x
        if coupling is not None:
            inner = coupling.product(torch.cat((x, x.new_zeros(2))))
            out -= coupling.lift(backward(L, forward(L, inner)))[: len(x)]
        return out

    return conjugate_gradients(apply, precondition, -right, FORCING)


def conjugate_gradients(apply: Apply, precondition: Apply, b: Tensor, forcing: float) -> tuple[Tensor, bool]:
    """Solve `A x = b` from zero; return x and whether A was found to be positive on the way."""
    x, r = torch.zeros_like(b), b
    z = precondition(r)
    p, rz = z, float(r @ z)
    first, model = rz, 0.0
    for iteration in range(1, ITERATIONS + 1):
        if not rz > 1e-30 * first:
            return x, True
        product = apply(p)
        curvature = float(p @ product)
        if not curvature > 0:
            return x, False
        alpha = rz / curvature
        x, r = x + alpha * p, r - alpha * product
        before, model = model, float(x @ (b + r))
        z = precondition(r)
        last, rz = rz, float(r @ z)
        if rz <= forcing**2 * first and iteration * (model - before) <= forcing * model:
            return x, True
        p = z + rz / last * p
    return x, True
