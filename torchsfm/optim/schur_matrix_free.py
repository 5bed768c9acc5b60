"""The reduced system solved without ever being formed, by preconditioned conjugate gradients.

`W` is stored as one small matrix per residual, chunk by chunk, in each coordinate by coordinate (q, c, residuals), residuals
sorted by slot, so that products with it run over contiguous memory, a slot at a time. A product with `S = U - W V^-1 W'` takes
two passes over W, so memory grows with the residuals and not with pairs of retained variables (Agarwal et al. 2010). The
preconditioner inverts diagonal blocks of S (Schur-Jacobi), one for each cluster of variables that only ever occur together,
such as the pose and the intrinsics of one photograph.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from torchsfm.optim.batched_cholesky import Triangle, backward, forward
from torchsfm.optim.layout import CHUNK, Family, Layout
from torchsfm.optim.ranks import Ranks
from torchsfm.optim.retained_blocks import RetainedBlocks, Runs, find_runs
from torchsfm.optim.terms import Workspace

Apply = Callable[[Tensor], Tensor]
FORCING = 0.1
"""Stop when the residual, in the norm of the preconditioner, has come down to this fraction (Agarwal et al. 2010), and an
iteration adds less than this fraction, divided by their number, to the decrease of the model (Nash & Sofer 1990). The second
test alone, which is Ceres', ends after two iterations while a few bad points have most of the cost, and the shape never moves.
"""
ITERATIONS = 500


@dataclass(frozen=True)
class Chunk:
    """Residuals worked on at once, and the runs of one slot among them."""

    start: int
    end: int
    runs: Runs


class RowCoupling:
    """`W` as a matrix (q, c) for each coupled residual, pieces one after the other."""

    def __init__(self, family: Family, some: Tensor) -> None:
        self.size, self.q, self.points = family.size, family.point_size, family.points
        coupled = [piece for piece in family.pieces if piece.coupled]
        self.width = max(piece.columns.shape[1] for piece in coupled)
        self._chunks: dict[tuple[int, int], Chunk] = {}
        columns, slots, points = [], [], []
        rows = count = 0
        for k, piece in enumerate(family.pieces):
            if not piece.coupled or piece.point is None:
                continue
            # Narrower slots are padded with the column that collects what belongs to nobody.
            blank = piece.columns.new_full((piece.columns.shape[0], self.width - piece.columns.shape[1]), family.size + 1)
            columns.append(torch.cat((piece.columns, blank), 1))
            slots.append(piece.slots + count)
            points.append(piece.point)
            for start in range(0, piece.slots.numel(), CHUNK):
                part = slots[-1][start : start + CHUNK]
                self._chunks[k, start] = Chunk(rows + start, rows + start + part.numel(), find_runs(part))
            rows += piece.slots.numel()
            count += piece.columns.shape[0]
        self.columns, self.slots, self.point = torch.cat(columns), torch.cat(slots), torch.cat(points)
        self._W = some.new_zeros(self.q * self.width * rows)
        self._work = Workspace(some)

    def _block(self, chunk: Chunk) -> Tensor:
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

    def squares(self, L: Triangle, z: Tensor) -> Tensor:
        """`Y Y'` of each slot alone, with `Y = W L'^-1` and z (q, points) as one more row: (slots, c + 1, c + 1)."""
        out = z.new_zeros((self.columns.shape[0], self.width + 1, self.width + 1))
        for chunk, Y in self.whitened(L, z):
            out.index_add_(0, chunk.runs.slots, chunk.runs.squares(Y))
        return out

    def whitened(self, L: Triangle, z: Tensor, beside: Tensor | None = None) -> Iterator[tuple[Chunk, Tensor]]:
        """The chunks with `Y = W L'^-1`, and z as one more row, (q, c + 1, m); each is overwritten by the next.

        `beside (q, k, points)` are more rows, of each residual those of its eliminated variable.
        """
        q, c = self.q, self.width
        entries = torch.stack([entry for row in L for entry in row] + list(z))
        more = 0 if beside is None else beside.shape[1]
        for chunk in self._chunks.values():
            W, m = self._block(chunk), chunk.end - chunk.start
            point = self.point[chunk.start : chunk.end]
            at = torch.gather(entries, 1, point.expand(len(entries), -1), out=self._work.get("at", len(entries), m))
            Y = self._work.get("Y", q, c + 1 + more, m)
            Y[:, c] = at[-q:]
            place = 0
            for a in range(q):
                row = W[a]
                for b in range(a):
                    torch.addcmul(row, Y[b, :c], at[place + b], value=-1, out=Y[a, :c])
                    row = Y[a, :c]
                torch.mul(row, at[place + a], out=Y[a, :c])
                place += a + 1
                if beside is not None:
                    Y[a, c + 1 :] = torch.gather(beside[a], 1, point.expand(more, -1), out=self._work.get("beside", more, m))
            yield chunk, Y

    def totals(self, L: Triangle, some: Tensor) -> Tensor:
        """Of some columns of Y the sum over the residuals of each eliminated variable, (q, columns, points)."""
        total = self._W.new_zeros((self.q * len(some), self.points))
        for chunk in self._chunks.values():
            rows = self._block(chunk).index_select(1, some).flatten(0, 1)
            total.index_add_(1, self.point[chunk.start : chunk.end], rows)
        return forward(L, total.view(self.q, len(some), -1))

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


@dataclass(frozen=True)
class Clusters:
    """A partition of the retained columns, clusters of one width together."""

    groups: list[Tensor]
    """Columns of the clusters of each width, (clusters, width)."""
    places: list[Tensor]
    """Where the entries of each piece's squares go in the blocks one after the other, at their end if nowhere."""
    coupled: list[Tensor]
    """The same for the squares of each `RowCoupling`."""
    total: int
    ranks: Ranks

    def preconditioner(self, squares: RetainedBlocks, coupled: list[Tensor], weight: Tensor) -> Apply:
        """The inverse of the system's blocks, given the squares of each coupling."""
        return _SchurJacobi(self, squares, coupled, weight)


@runtime_checkable
class Plan(Protocol):
    """How the reduced system is divided."""

    @property
    def ranks(self) -> Ranks:
        """The processes that share it."""

    def preconditioner(self, squares: RetainedBlocks, coupled: list[Tensor], weight: Tensor) -> Apply:
        """An approximate inverse: of U, less the squares of each coupling, damped."""


def find_clusters(layout: Layout, couplings: Sequence[RowCoupling]) -> Clusters:
    """Put variables that occur in the same slots together, on whichever rank."""
    device = layout.device
    owner = layout.owners()
    variables = int(owner[-1])
    generator = torch.Generator().manual_seed(0)
    mark = torch.randint(2**62, (variables + 1,), generator=generator, device="cpu").to(device)
    # The first column of each variable stands for it.
    head = torch.ones_like(owner, dtype=torch.bool)
    head[1:] = owner[1:] != owner[:-1]
    coupled = layout.ranks.any(torch.tensor(bool(couplings), device=device))
    columns = [coupling.columns for coupling in couplings] if bool(coupled) else [p.columns for p in layout.pieces]
    met, keys = [owner[:0]], [mark[:0]]
    for c in columns:
        counts = head[c] & (c < layout.size)
        key = torch.where(counts, mark[owner[c]], 0).sum(1)
        met.append(owner[c][counts])
        keys.append((key ^ (key >> 31))[:, None].expand_as(c)[counts] * 0x5851F42D4C957F2D)
    owners, kinds = layout.ranks.gather(torch.stack((torch.cat(met), torch.cat(keys)), 1)).unbind(1)
    # Each pair once: two sorts, as `torch.unique` of rows takes an order of magnitude longer.
    order = torch.argsort(kinds)
    order = order[torch.argsort(owners[order], stable=True)]
    owners, kinds = owners[order], kinds[order]
    new = torch.ones_like(owners, dtype=torch.bool)
    new[1:] = (owners[1:] != owners[:-1]) | (kinds[1:] != kinds[:-1])
    signature = torch.zeros_like(mark).index_add_(0, owners[new], kinds[new])
    alone = torch.ones_like(mark, dtype=torch.bool).index_fill_(0, owners, False)
    _, cluster = torch.unique(torch.where(alone, mark, signature)[:variables], return_inverse=True)
    return _lay_blocks(layout, couplings, cluster[owner[: layout.size]])


def _lay_blocks(layout: Layout, couplings: Sequence[RowCoupling], cluster: Tensor) -> Clusters:
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

    pieces = [places(piece.columns) for piece in layout.pieces]
    return Clusters(groups, pieces, [places(coupling.columns) for coupling in couplings], total, layout.ranks)


class _SchurJacobi:
    """The inverses of the diagonal blocks."""

    def __init__(self, clusters: Clusters, squares: RetainedBlocks, coupled: list[Tensor], weight: Tensor) -> None:
        flat = weight.new_zeros(clusters.total + 1)
        for place, values in zip(clusters.places, squares.values, strict=True):
            flat.index_add_(0, place, values[:, :-1, :-1].flatten())
        for place, values in zip(clusters.coupled, coupled, strict=True):
            flat.index_add_(0, place, values[:, :-1, :-1].flatten(), alpha=-1)
        flat = clusters.ranks.sum(flat)
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
    squares: RetainedBlocks,
    eliminated: Sequence[tuple[RowCoupling, Triangle, Tensor]],
    plan: Plan,
    weight: Tensor,
    rest: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, bool, bool]:
    """The step of the retained variables for a damping `weight`, whether there is one, and whether it is as exact as `FORCING`.

    Args:
        squares: U and the gradient.
        eliminated: W, the factors L of V, and `L^-1 h` of each eliminated family that meets retained variables.
        plan: How to precondition, and the ranks over which all of this is divided.
        weight: Added to the diagonal, (size).
        rest: Motions E (size, k) of which the step has no part, and F with `F'E = 1` that tells what part there is.
    """
    size = squares.size
    right = torch.nn.functional.pad(squares.gradient(), (0, 2))
    coupled = [coupling.squares(L, z) for coupling, L, z in eliminated]
    for (coupling, _, _), values in zip(eliminated, coupled, strict=True):
        right.index_add_(0, coupling.columns.flatten(), values[:, :-1, -1].flatten(), alpha=-1)
    right = plan.ranks.sum(right[:size])
    plain = plan.preconditioner(squares, coupled, weight)

    def precondition(r: Tensor) -> Tensor:
        if rest is None:
            return plain(r)
        # All that conjugate gradients build comes from here.
        E, F = rest
        z = plain(r - F @ (E.mT @ r))
        return z - E @ (F.mT @ z)

    def apply(x: Tensor) -> Tensor:
        out = squares.product(x)
        for coupling, L, _ in eliminated:
            inner = coupling.product(torch.nn.functional.pad(x, (0, 2)))
            out -= coupling.lift(backward(L, forward(L, inner)))[:size]
        return plan.ranks.sum(out) + weight * x

    return conjugate_gradients(apply, precondition, -right, FORCING)


def conjugate_gradients(apply: Apply, precondition: Apply, b: Tensor, forcing: float) -> tuple[Tensor, bool, bool]:
    """Solve `A x = b` from zero; return x, whether A was found to be positive, and whether x is as exact as wanted."""
    x, r = torch.zeros_like(b), b
    z = precondition(r)
    p, rz = z, float(r @ z)
    first, model = rz, 0.0
    for iteration in range(1, ITERATIONS + 1):
        if not rz > 1e-30 * first:
            return x, True, True
        product = apply(p)
        curvature = float(p @ product)
        if not curvature > 0:
            return x, False, False
        alpha = rz / curvature
        x, r = x + alpha * p, r - alpha * product
        before, model = model, float(x @ (b + r))
        z = precondition(r)
        last, rz = rz, float(r @ z)
        if rz <= forcing**2 * first and iteration * (model - before) <= forcing * model:
            return x, True, True
        p = z + rz / last * p
    return x, True, False
