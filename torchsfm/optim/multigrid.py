"""A preconditioner for variables of one kind that meet in pairs, such as the cameras of a view graph.

Steps that vary slowly over a graph are what conjugate gradients find last: along a chain they need as many iterations as it has
links. On a coarser graph they are found at once. Variables join to stars of partners that hold each other strongly; the stars
are the variables of the next graph, all of whose members move alike, and so on until few are left, which are solved for
(aggregation: Notay, "An aggregation-based algebraic multigrid method", ETNA 2010). As members do not quite move alike the
coarse steps are too short, and are taken longer (Braess, "Towards algebraic multigrid for elliptic problems of second order",
Computing 1995).

It is good where what hardly costs anything are motions of all variables by the same tangent vector, so a problem with a gauge
freedom should have coordinates of the world; in others it is a preconditioner like any other.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.linalg import adjugate_3x3
from torchsfm.optim.layout import Layout
from torchsfm.optim.ranks import Ranks
from torchsfm.optim.retained_blocks import RetainedBlocks

FEW = 600
"""Columns of a system that is solved by a dense inverse."""
SMOOTH = 2 / 3
"""Of a Jacobi step: what meets in pairs has no eigenvalue beyond 2 in its units."""
LONGER = 1.5
"""By how much coarse steps are taken longer than they come out."""
VISITS = 2
"""Cycles on each coarser graph."""
STRONG = 0.25
"""Of the strongest edge of a variable, what is strong."""
RIDGE = 1e-13
"""Of the diagonal, added where sums of blocks cancel down to rounding."""
SURE = 1e-6
"""Of the product of its diagonal, the least determinant of a matrix that is inverted by its cofactors."""


@dataclass(frozen=True)
class PairGraph:
    """Which variables meet, in a problem whose retained variables are of one block and meet in pairs and nothing else."""

    columns: int
    """Tangent coordinates of a variable."""
    count: int
    """Number of variables."""
    ends: list[tuple[Tensor, ...]]
    """For each piece the one or two variables of its slots, `count` for one that is fixed."""
    edges: "_Edges"
    """Those between two free variables, piece by piece: all pairs of slots that meet."""
    rows: list[Tensor]
    """For each piece the slots of these,"""
    loops: list[Tensor]
    """and those in which a variable meets itself."""
    ranks: Ranks

    @staticmethod
    def fits(layout: Layout) -> bool:
        """Whether a problem is such a graph."""
        if len(layout.first) != 1:
            return False
        (name,) = layout.first
        width = layout.size // layout.free[name].numel()
        fits = not layout.families and all(piece.columns.shape[1] <= 2 * width for piece in layout.pieces)
        return bool(layout.ranks.all(torch.tensor(fits, device=layout.device)))

    @classmethod
    def of(cls, layout: Layout) -> "PairGraph | None":
        """The graph of a problem; None if it is none."""
        if not cls.fits(layout):
            return None
        (name,) = layout.first
        count = layout.free[name].numel()
        width = layout.size // count
        none = torch.zeros(0, dtype=torch.long, device=layout.device)
        ends, rows, loops, pairs = [], [], [], [none[:, None].expand(0, 2)]
        for piece in layout.pieces:
            own = (piece.columns[:, ::width] // width).clamp(max=count)
            two = own.shape[1] == 2
            ends.append(tuple(own.unbind(1)))
            rows.append(((own < count).all(1) & (own[:, 0] != own[:, -1])).nonzero()[:, 0] if two else none)
            loops.append((own[:, 0] == own[:, 1]).nonzero()[:, 0] if two else none)
            pairs.append(own[rows[-1]] if two else pairs[0])
        i, j = torch.cat(pairs).unbind(1)
        edges = _Edges.of(i, j, count)
        return cls(width, count, ends, edges, rows, loops, layout.ranks)

    def preconditioner(self, squares: RetainedBlocks, coupled: list[Tensor], weight: Tensor) -> "_Cycle":
        """An approximate inverse of the system; nothing is coupled."""
        w, n = self.columns, self.count
        D = weight.new_zeros((n + 1, w, w))
        found = [D[:0]]
        for ends, rows, loops, values in zip(self.ends, self.rows, self.loops, squares.values, strict=True):
            for k, end in enumerate(ends):
                D.index_add_(0, end, values[:, w * k : w * k + w, w * k : w * k + w])
            if len(rows):
                found.append(values[:, :w, w : 2 * w].index_select(0, rows))
            if len(loops):
                own = values[loops, :w, w : 2 * w]
                D.index_add_(0, ends[0][loops], own + own.mT)
        D = self.ranks.sum(D[:n]) + torch.diag_embed(weight.view(n, w))
        i, j, B = self.edges.i, self.edges.j, self.edges.sum(torch.cat(found))
        # Where there are coarser graphs, each rank keeps its own edges of the finest.
        ranks = self.ranks
        if n * w <= FEW:
            (i, j, B), ranks = _gathered(i, j, B, n, ranks), Ranks()
        return _Cycle(_level(i, j, B, D, D.diagonal(dim1=1, dim2=2), ranks))


@dataclass(frozen=True)
class _Edges:
    """Edges once each and upwards, of such as may come several times and in any direction."""

    i: Tensor
    j: Tensor
    place: Tensor
    """The edge that each given one is,"""
    down: Tensor
    """and whether it was given downwards."""

    @classmethod
    def of(cls, i: Tensor, j: Tensor, n: int) -> "_Edges":
        """Those between n variables."""
        key, place = torch.unique(torch.minimum(i, j) * n + torch.maximum(i, j), return_inverse=True)
        return cls(torch.div(key, max(n, 1), rounding_mode="floor"), key % max(n, 1), place, i > j)

    def sum(self, B: Tensor) -> Tensor:
        """The blocks of the edges, given those with the rows of i of the given ones."""
        B = torch.where(self.down[:, None, None], B.mT, B)
        return B.new_zeros((len(self.i), *B.shape[1:])).index_add_(0, self.place, B)


@dataclass(frozen=True)
class _Level:
    """A symmetric matrix of blocks over the variables of a graph."""

    i: Tensor
    j: Tensor
    """The ends of each edge, i < j, each pair once."""
    B: Tensor
    """The block of each edge, with the rows of i."""
    D: Tensor
    """The diagonal blocks."""
    scale: Tensor
    """What the diagonal would be if nothing cancelled."""
    ranks: Ranks
    """The processes whose edges these are a part of; all have the diagonal."""

    @property
    def joined(self) -> bool:
        """Whether there is an edge on any rank."""
        return bool(self.ranks.any(torch.tensor(len(self.i) > 0, device=self.i.device)))

    def product(self, x: Tensor) -> Tensor:
        """The matrix times a vector (variables, coordinates)."""
        out = torch.zeros_like(x) if self.ranks.rank else (self.D @ x[:, :, None])[:, :, 0]
        out.index_add_(0, self.i, (self.B @ x[self.j][:, :, None])[:, :, 0])
        out.index_add_(0, self.j, (self.B.mT @ x[self.i][:, :, None])[:, :, 0])
        return self.ranks.sum(out)

    def stars(self) -> Tensor:
        """The number of the star of each variable: centres drawn at random, and those that are held strongly to one.

        No two centres are partners (Luby, "A simple parallel algorithm for the maximal independent set problem", 1986), so
        stars are small whatever the strengths are.
        """
        # The first rank does it alone: rounds in which all take part are many messages.
        i, j, strength = _on_first(self.i, self.j, torch.linalg.matrix_norm(self.B), self.ranks)
        none = torch.zeros(len(self.D), dtype=torch.long, device=self.B.device)
        return self.ranks.spread(none if self.ranks.rank else _stars(i, j, strength, len(none)))

    def coarser(self, star: Tensor) -> "_Level":
        """The matrix over stars whose members move alike; the first rank has it, the others know how large it is."""
        n = int(star.max()) + 1
        D = self.D.new_zeros((n, *self.D.shape[1:]))
        if not self.ranks.rank:
            D.index_add_(0, star, self.D)
        scale = self.scale.new_zeros((n, self.scale.shape[1])).index_add_(0, star, self.scale)
        i, j = star[self.i], star[self.j]
        inside = i == j
        D = self.ranks.sum_first(D.index_add_(0, i[inside], self.B[inside] + self.B[inside].mT))
        i, j, B = _merged(i[~inside], j[~inside], self.B[~inside], n)
        if self.ranks.size > 1:
            i, j, B = _merged(*_on_first(i, j, B, self.ranks), n)
        return _level(i, j, B, D, scale, Ranks())


def _stars(i: Tensor, j: Tensor, strength: Tensor, n: int) -> Tensor:
    """The number of the star of each of n variables, given all edges once."""
    best = strength.new_zeros(n)
    best.scatter_reduce_(0, i, strength, "amax").scatter_reduce_(0, j, strength, "amax")
    strong = strength >= STRONG * torch.minimum(best[i], best[j])
    i, j = i[strong], j[strong]
    own = torch.arange(n, device=i.device)
    rank = torch.randperm(n, generator=torch.Generator().manual_seed(0), device="cpu").to(i.device)
    member = torch.empty_like(rank).index_copy_(0, rank, own)
    centre = torch.full_like(own, -1)
    while True:
        left = centre < 0
        both = left[i] & left[j]
        i, j = i[both], j[both]
        above = torch.where(left, rank, n)
        above.scatter_reduce_(0, i, rank[j], "amax").scatter_reduce_(0, j, rank[i], "amax")
        chosen = left & (above == rank)
        centre = torch.where(chosen, own, centre)
        # Without an edge between those that were left all are chosen.
        if torch.equal(chosen, left):
            star: Tensor = torch.unique(centre, return_inverse=True)[1]
            return star
        # The others go to the neighbouring centre that was drawn highest.
        found = torch.full_like(own, -1)
        for a, b in ((i, j), (j, i)):
            found.scatter_reduce_(0, a, torch.where(chosen[b], rank[b], -1), "amax")
        centre = torch.where((centre < 0) & (found >= 0), member[found.clamp(min=0)], centre)


def _level(i: Tensor, j: Tensor, B: Tensor, D: Tensor, scale: Tensor, ranks: Ranks) -> _Level:
    """A level, its diagonal safe from rounding."""
    return _Level(i, j, B, D + torch.diag_embed(RIDGE * scale), scale, ranks)


def _on_first(i: Tensor, j: Tensor, values: Tensor, ranks: Ranks) -> tuple[Tensor, Tensor, Tensor]:
    """The edges of all ranks with what belongs to each, on the first rank; none on the others."""
    if ranks.size == 1:
        return i, j, values
    # One message instead of three: integers of this size are exact.
    rows = ranks.gather_first(torch.cat((torch.stack((i, j), 1), values.view(len(i), -1)), 1))
    return rows[:, 0].long(), rows[:, 1].long(), rows[:, 2:].reshape(-1, *values.shape[1:])


def _gathered(i: Tensor, j: Tensor, B: Tensor, n: int, ranks: Ranks) -> tuple[Tensor, Tensor, Tensor]:
    """The edges of all ranks."""
    return (i, j, B) if ranks.size == 1 else _merged(ranks.gather(i), ranks.gather(j), ranks.gather(B), n)


def _merged(i: Tensor, j: Tensor, B: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Each edge once and upwards."""
    edges = _Edges.of(i, j, n)
    return edges.i, edges.j, edges.sum(B)


class _Cycle:
    """The approximate inverse that one cycle over all graphs is."""

    def __init__(self, finest: _Level) -> None:
        self._levels, self._stars = [finest], list[Tensor]()
        self._ranks = finest.ranks
        while self._levels[-1].scale.numel() > FEW and self._levels[-1].joined:
            self._stars.append(self._levels[-1].stars())
            self._levels.append(self._levels[-1].coarser(self._stars[-1]))
            if self._ranks.rank:
                break
        # Coarser graphs take less time than sending their vectors round would: the first rank works on them alone.
        mine = self._levels[:1] if self._ranks.rank else self._levels
        self._inverse = [_inverse(level.D) for level in mine]
        last = self._levels[-1]
        self._last: Tensor | None = None
        if len(last.i) and not self._ranks.rank:
            n, w = last.scale.shape
            own = torch.arange(n, device=last.i.device)
            A = last.D.new_zeros((n, n, w, w))
            A[own, own], A[last.i, last.j], A[last.j, last.i] = last.D, last.B, last.B.mT
            (self._last,) = _inverse(A.transpose(1, 2).reshape(1, n * w, n * w))

    def __call__(self, r: Tensor) -> Tensor:
        return self._solve(0, r.view(len(self._levels[0].D), -1)).flatten()

    def _solve(self, k: int, r: Tensor) -> Tensor:
        level, inverse = self._levels[k], self._inverse[k]
        if k == len(self._levels) - 1:
            rows = r[:, :, None]
            return (inverse @ rows)[:, :, 0] if self._last is None else (self._last @ r.flatten()).view_as(r)
        x = SMOOTH * (inverse @ r[:, :, None])[:, :, 0]
        star, coarse = self._stars[k], self._levels[k + 1]
        right = r.new_zeros(coarse.scale.shape).index_add_(0, star, r - level.product(x))
        step = self._coarse(k + 1, right) if k or not self._ranks.rank else right
        x = x + LONGER * (step if k else self._ranks.spread(step))[star]
        return x + SMOOTH * (inverse @ (r - level.product(x))[:, :, None])[:, :, 0]

    def _coarse(self, k: int, right: Tensor) -> Tensor:
        """The steps on a coarser graph."""
        step = self._solve(k, right)
        for _ in range(VISITS - 1 if k + 1 < len(self._levels) else 0):
            step = step + self._solve(k, right - self._levels[k].product(step))
        return step


def _inverse(A: Tensor) -> Tensor:
    """The inverses of positive matrices; of their diagonals where rounding spoils one."""
    if A.shape[-1] == 3:
        # A call of LAPACK for each takes ten times as long.
        adjugate = adjugate_3x3(A)
        det = (A[:, 0] * adjugate[:, :, 0]).sum(-1)
        if bool((det > SURE * A.diagonal(dim1=1, dim2=2).prod(-1)).all()):
            return adjugate / det[:, None, None]
    lower, info = torch.linalg.cholesky_ex(A)
    plain = torch.diag_embed(A.diagonal(dim1=1, dim2=2).abs().clamp_min(1e-300).sqrt())
    return torch.cholesky_inverse(torch.where((info == 0)[:, None, None], lower, plain))
