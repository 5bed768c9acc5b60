"""Who meets whom in a problem of terms: which variables are free, and in which order residuals and variables are worked off.

Residuals are sorted by slot. A slot is a combination of retained variables that occurs (pose 3 with camera 0), so sums over a
slot are products of contiguous matrices, and variables shared between slots are tied by adding up columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsfm.optim.ranks import Ranks
from torchsfm.optim.terms import Block, Term, block_names, eliminated_block

CHUNK = 10000
"""Residuals linearised at once: few enough for temporaries to stay in the cache. Rows of a power of two would collide."""


@dataclass(frozen=True)
class Piece:
    """Residuals of one term that have the same kinds of free variables, sorted by slot."""

    term: Term
    wanted: tuple[bool, ...]
    """The blocks of the term by which derivatives are needed."""
    slots: Tensor
    """Slot of each residual (m)."""
    columns: Tensor
    """Column of each tangent coordinate of each slot: (slots, c)."""
    family: str | None
    """The block of the residuals' eliminated variables."""
    point: Tensor | None
    """Number of each residual's eliminated variable, (m)."""

    @property
    def coupled(self) -> bool:
        """Whether retained and eliminated variables meet here."""
        return self.point is not None and self.columns.shape[1] > 0


@dataclass(frozen=True)
class Family:
    """The eliminated variables of one block, and the residuals by which they meet retained ones."""

    name: str
    size: int
    """Number of columns of the reduced system."""
    point_size: int
    """Tangent coordinates of a variable."""
    points: int
    """Number of free variables."""
    pieces: list[Piece]
    """The pieces of the layout in its order; those of other families are not coupled here."""


@dataclass(frozen=True)
class Layout:
    """Which variables are free and where they stand in the systems."""

    free: dict[str, Tensor]
    """Free and observed variables of each block; the eliminated ones in an order that brings like together."""
    first: dict[str, int]
    """First column of each retained block with free variables."""
    size: int
    """Number of columns of the reduced system; the gradient is column `size`, column `size + 1` belongs to fixed variables."""
    kinds: Tensor
    """A number for the block and the coordinate of each column: those of a kind have one unit."""
    families: list[Family]
    """The eliminated blocks that have free variables."""
    pieces: list[Piece]
    still: list[Term]
    """Residuals that depend on nothing free."""
    ranks: Ranks
    """The processes that share the problem; families and pieces are those of this one."""
    eliminates: bool
    """Whether there may be families on any of them."""

    @property
    def device(self) -> torch.device:
        """Where everything is."""
        return next(iter(self.free.values())).device

    def owners(self) -> Tensor:
        """The number of the retained variable that each column belongs to; one more for the columns at the end."""
        ends = [*list(self.first.values())[1:], self.size]
        owner = torch.empty(self.size + 2, dtype=torch.int64, device=self.device)
        count = 0
        for (name, start), end in zip(self.first.items(), ends, strict=True):
            number = self.free[name].numel()
            owner[start:end] = count + torch.arange(number, device=self.device).repeat_interleave((end - start) // number)
            count += number
        owner[self.size :] = count
        return owner


def lay_out(
    blocks: dict[str, Block], terms: Sequence[Term], eliminate: str | Sequence[str] | None, ranks: Ranks | None = None
) -> Layout:
    """Decide which variables move, drop residuals without any, and sort the others.

    Args:
        blocks: The variables.
        terms: The residuals; those with weight 0 are dropped.
        eliminate: The blocks to eliminate, if any; no residual may depend on two of their variables.
        ranks: The processes that share the problem; a retained variable is observed if it is on any of them.
    """
    ranks = ranks or Ranks()
    gone = block_names(eliminate)
    free: dict[str, Tensor] = {}
    number: dict[str, Tensor] = {}
    first: dict[str, int] = {}
    size = 0
    for name, block in blocks.items():
        moves = torch.zeros(block.x.shape[0], dtype=torch.bool, device=block.x.device)
        for term in terms:
            for other, index in zip(term.blocks, term.index, strict=True):
                if other == name and block.tangent > 0:
                    moves[index if term.weights is None else index[term.weights > 0]] = True
        if name not in gone:
            moves = ranks.any(moves)
        if block.fixed is not None:
            moves &= ~block.fixed
        free[name] = moves.nonzero()[:, 0]
        number[name] = torch.full(moves.shape, -1, device=moves.device)
        number[name][free[name]] = torch.arange(free[name].numel(), device=moves.device)
        if name not in gone and free[name].numel():
            first[name] = size
            size += free[name].numel() * block.tangent
    drafts: list[Piece] = []
    still: list[Term] = []
    for term in terms:
        rows = _cut(term, number, gone)
        places = [number[name][index] for name, index in zip(term.blocks, term.index, strict=True)]
        for kind in ((True, True), (True, False), (False, True)):
            if rows[kind].numel():
                drafts.append(_find_slots(term, rows[kind], places, kind, blocks, first, size, gone))
        if rows[False, False].numel():
            still.append(term.select(rows[False, False]))
    numbers: dict[str, Tensor] = {}
    for name in gone:
        if free[name].numel():
            order = _order_points([piece for piece in drafts if piece.family == name], free[name].numel())
            free[name] = free[name][order]
            numbers[name] = torch.empty_like(order).index_copy_(0, order, torch.arange(order.numel(), device=order.device))
    pieces = [_sort(piece, numbers.get(piece.family or "")) for piece in drafts]
    families = []
    for name in numbers:
        own = [piece if piece.family == name else replace(piece, family=None, point=None) for piece in pieces]
        families.append(Family(name, size, blocks[name].tangent, free[name].numel(), own))
    return Layout(free, first, size, _kinds(blocks, free, first), families, pieces, still, ranks, bool(gone))


def _kinds(blocks: dict[str, Block], free: dict[str, Tensor], first: dict[str, int]) -> Tensor:
    """The kind of each column."""
    device = next(iter(free.values())).device
    found = [torch.zeros(0, dtype=torch.int64, device=device)]
    known = 0
    for name in first:
        width = blocks[name].tangent
        found.append((known + torch.arange(width, device=device)).repeat(free[name].numel()))
        known += width
    return torch.cat(found)


def _cut(term: Term, number: dict[str, Tensor], gone: tuple[str, ...]) -> dict[tuple[bool, bool], Tensor]:
    """The residuals of a term by whether they have a free retained and a free eliminated variable."""
    eliminated_block(term, gone)
    has_point = torch.zeros_like(term.index[0], dtype=torch.bool)
    has_kept = torch.zeros_like(has_point)
    for name, index in zip(term.blocks, term.index, strict=True):
        if name in gone:
            has_point |= number[name][index] >= 0
        else:
            has_kept |= number[name][index] >= 0
    counts = torch.ones_like(has_point) if term.weights is None else term.weights > 0
    return {
        (kept, point): (counts & (has_kept == kept) & (has_point == point)).nonzero()[:, 0]
        for kept in (True, False)
        for point in (True, False)
    }


def _find_slots(
    term: Term,
    rows: Tensor,
    places: list[Tensor],
    kind: tuple[bool, bool],
    blocks: dict[str, Block],
    first: dict[str, int],
    size: int,
    gone: tuple[str, ...],
) -> Piece:
    """A piece, not sorted yet."""
    kept, with_point = kind
    places = [place[rows] for place in places]
    wanted = tuple(
        with_point if name in gone else kept and bool((place >= 0).any())
        for name, place in zip(term.blocks, places, strict=True)
    )
    retained = [(n, p) for n, p, w in zip(term.blocks, places, wanted, strict=True) if w and n not in gone]
    family, point = next(((n, p) for n, p in zip(term.blocks, places, strict=True) if with_point and n in gone), (None, None))
    # Slots in the order of the first retained block, then the second, ...; -1 (fixed) is a value like any other.
    key = torch.zeros_like(rows)
    for _, place in retained:
        key = key * (int(place.max()) + 2) + place + 1
    values, slots = torch.unique(key, return_inverse=True)
    columns = rows.new_empty((values.numel(), 0))
    for name, place in reversed(retained):
        mine = torch.empty_like(values).index_copy_(0, slots, place)[:, None]
        width = blocks[name].tangent
        step = torch.arange(width, device=rows.device)
        columns = torch.cat((torch.where(mine >= 0, first[name] + mine * width + step, size + 1), columns), 1)
    return Piece(term.select(rows), wanted, slots, columns, family, point)


def _sort(piece: Piece, rank: Tensor | None) -> Piece:
    """Sort by slot, then by the new number of the eliminated variable."""
    if piece.point is None or rank is None:
        order = torch.argsort(piece.slots, stable=True)
        return replace(piece, term=piece.term.select(order), slots=piece.slots[order])
    point = rank[piece.point]
    order = torch.argsort(piece.slots * rank.numel() + point)
    return replace(piece, term=piece.term.select(order), slots=piece.slots[order], point=point[order])


def _order_points(pieces: list[Piece], count: int) -> Tensor:
    """Points with the same slots next to each other, in lexicographic order of their slots as far as 60 bits reach."""
    device = pieces[0].slots.device
    key = torch.zeros(count, dtype=torch.int64, device=device)
    total = sum(piece.columns.shape[0] for piece in pieces if piece.coupled)
    start = 0
    if total <= 60:
        for piece in pieces:
            if piece.coupled and piece.point is not None:
                # A point twice in a slot spoils the order a little, never the result.
                key.index_add_(0, piece.point, torch.ones_like(piece.slots) << (59 - start - piece.slots))
                start += piece.columns.shape[0]
        return torch.argsort(key, descending=True, stable=True)
    low = torch.full((count,), total, dtype=torch.int64, device=device)
    high = torch.full((count,), -1, dtype=torch.int64, device=device)
    for piece in pieces:
        if piece.coupled and piece.point is not None:
            low.scatter_reduce_(0, piece.point, piece.slots + start, "amin")
            high.scatter_reduce_(0, piece.point, piece.slots + start, "amax")
            start += piece.columns.shape[0]
    return torch.argsort(low * (total + 1) + high, stable=True)
