"""The coupling of eliminated and retained variables as dense matrices, one for each group of variables that see the same.

Dense products are so much faster than sparse ones that a few zeros are welcome. Best where retained variables are few or where
neighbours in the order of the layout see about the same of them.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.optim.batched_cholesky import Triangle
from torchsfm.optim.layout import CHUNK, Family, Piece
from torchsfm.optim.terms import Workspace

CACHE = 100_000
"""Numbers worked on at once, to stay in the cache."""
ATOM = 64
"""Points that stay together when groups are formed."""
PRODUCT = 6.0 / 25e9
"""Seconds per column squared and point (of three coordinates) of a dense product, on a usual core."""
VISIT = 6e-5
"""Seconds that a group costs, whatever its size."""
ENTRY = 5e-9
"""Seconds to add one entry of a group's product into the system."""

Span = tuple[int, int, int]
"""First point, end, and the slots seen as bits."""


@dataclass(frozen=True)
class _Group:
    start: int
    end: int
    offset: int
    columns: Tensor
    everything: bool
    """Whether the columns are all there are, in order."""


class GroupCoupling:
    """`W` as one dense matrix (q, columns, points) for each group."""

    def __init__(self, family: Family, spans: list[Span], some: Tensor) -> None:
        self.size, self.q, self.points = family.size, family.point_size, family.points
        self.groups, targets = _lay_groups(family, spans)
        # Contiguous for each call of `add`.
        self._targets = [
            {start: t[:, start : start + CHUNK].flatten() for start in range(0, t.shape[1], CHUNK)} for t in targets
        ]
        total = sum(g.columns.numel() * (g.end - g.start) for g in self.groups)
        # These live as long as the problem: memory that is new costs more than the arithmetic on it.
        self._W = some.new_empty((self.q, total))
        self._work = Workspace(some)

    def clear(self) -> None:
        """Start a linearisation."""
        self._W.zero_()

    def add(self, piece: int, start: int, J: Tensor, P: Tensor) -> None:
        """Add the products of Jacobians J (d, c, m) and P (d, q, m), those of a piece's residuals from `start` on."""
        d, c, m = J.shape
        target = self._targets[piece][start]
        product = self._work.get("product", c, m)
        for a in range(self.q):
            torch.mul(J[0], P[0, a], out=product)
            for k in range(1, d):
                product.addcmul_(J[k], P[k, a])
            self._W[a].scatter_add_(0, target, product.view(-1))

    def reduce(self, S: Tensor, L: Triangle, z: Tensor) -> None:
        """Subtract `W V^-1 W'` from S, with `V = L L'`, and `W L'^-1 z` from its column `size`."""
        for group in self.groups:
            columns = group.columns.numel()
            square, part = S.new_zeros((columns, columns)), S.new_zeros(columns)
            step = max(ATOM, CACHE // (columns * self.q + 1))
            for first in range(group.start, group.end, step):
                last = min(first + step, group.end)
                Y = self._whiten(group, first, last, L)
                for a in range(self.q):
                    square.addmm_(Y[a], Y[a].mT)
                    part.addmv_(Y[a], z[a, first:last])
            if group.everything:
                S[: self.size, : self.size] -= square
                S[: self.size, self.size] -= part
            else:
                S[group.columns[:, None], group.columns] -= square
                S[group.columns, self.size] -= part

    def product(self, kept: Tensor) -> Tensor:
        """`W' kept`."""
        out = kept.new_empty((self.q, self.points))
        for group in self.groups:
            out[:, group.start : group.end] = kept[group.columns] @ self._matrix(group)
        return out

    def lift(self, point: Tensor) -> Tensor:
        """`W point`."""
        out = point.new_zeros(self.size + 2)
        for group in self.groups:
            W = self._matrix(group)
            out[group.columns] += torch.bmm(W, point[:, group.start : group.end, None])[:, :, 0].sum(0)
        return out

    def add_spread(self, out: Tensor, L: Triangle, kept: Tensor) -> None:
        """Add `Y' C Y` of each point to `out` (q, q, points), with `Y = W L'^-1` and C (size, size) of the retained."""
        full = torch.nn.functional.pad(kept, (0, 2, 0, 2))
        for group in self.groups:
            C = full[group.columns[:, None], group.columns]
            step = max(ATOM, CACHE // (group.columns.numel() * self.q + 1))
            for first in range(group.start, group.end, step):
                last = min(first + step, group.end)
                Y = self._whiten(group, first, last, L)
                for a in range(self.q):
                    CY = C @ Y[a]
                    for b in range(self.q):
                        out[a, b, first:last] += (CY * Y[b]).sum(0)

    def _whiten(self, group: _Group, first: int, last: int, L: Triangle) -> Tensor:
        """`W L'^-1` of some points of a group, (q, columns, points)."""
        W, span = self._matrix(group)[:, :, first - group.start : last - group.start], slice(first, last)
        Y = self._work.get("Y", *W.shape)
        for a in range(self.q):
            row = W[a]
            for b in range(a):
                torch.addcmul(row, L[a][b][span], Y[b], value=-1, out=Y[a])
                row = Y[a]
            torch.mul(row, L[a][a][span], out=Y[a])
        return Y

    def _matrix(self, group: _Group) -> Tensor:
        columns, points = group.columns.numel(), group.end - group.start
        return self._W[:, group.offset : group.offset + columns * points].view(-1, columns, points)


def plan_groups(family: Family) -> tuple[list[Span], float]:
    """Cut the points into groups, joining neighbours while that saves time; return them and the estimated seconds."""
    count = family.points
    sets = [0] * -(-count // ATOM)
    first, widest = 0, 1
    for piece in family.pieces:
        if piece.coupled and piece.point is not None:
            slots = piece.columns.shape[0]
            pairs = torch.unique(torch.div(piece.point, ATOM, rounding_mode="floor") * slots + piece.slots)
            for pair in pairs.tolist():
                sets[pair // slots] |= 1 << (first + pair % slots)
            first += slots
            widest = max(widest, piece.columns.shape[1])

    def seconds(slots: int, points: int) -> float:
        columns = min(slots.bit_count() * widest, family.size)
        return columns * columns * (points * PRODUCT + ENTRY) + VISIT

    spans: list[Span] = []
    for atom, slots in enumerate(sets):
        start, end = atom * ATOM, min((atom + 1) * ATOM, count)
        while spans:
            before_start, before_end, before = spans[-1]
            apart = seconds(before, before_end - before_start) + seconds(slots, end - start)
            if seconds(before | slots, end - before_start) > apart:
                break
            spans.pop()
            start, slots = before_start, before | slots
        spans.append((start, end, slots))
    return spans, sum(seconds(slots, end - start) for start, end, slots in spans)


def _lay_groups(family: Family, spans: list[Span]) -> tuple[list[_Group], list[Tensor]]:
    """The columns of each group, and where in the groups' matrices each piece's residuals go: (c, m)."""
    device = family.pieces[0].slots.device
    number = torch.empty(family.points, dtype=torch.int64, device=device)
    for g, (start, end, _) in enumerate(spans):
        number[start:end] = g
    wide = family.size + 2
    seen = [_seen(piece, number, wide) for piece in family.pieces if piece.coupled]
    keys = torch.unique(torch.cat(seen))
    table = torch.full((len(spans) * wide,), -1, device=device)
    sizes = torch.bincount(torch.div(keys, wide, rounding_mode="floor"), minlength=len(spans))
    table[keys] = torch.arange(keys.numel(), device=device) - (sizes.cumsum(0) - sizes).repeat_interleave(sizes)
    groups: list[_Group] = []
    offset = 0
    for (start, end, _), columns in zip(spans, (keys % wide).split(sizes.tolist()), strict=True):
        everything = columns.numel() == family.size and (family.size == 0 or int(columns[-1]) < family.size)
        groups.append(_Group(start, end, offset, columns, everything))
        offset += columns.numel() * (end - start)
    starts, widths, offsets = (
        torch.tensor(values, device=device)
        for values in ([g.start for g in groups], [g.end - g.start for g in groups], [g.offset for g in groups])
    )
    targets: list[Tensor] = []
    for piece in family.pieces:
        if not piece.coupled or piece.point is None:
            targets.append(number.new_empty((0, 0)))
            continue
        group = number[piece.point]
        base, width, key = offsets[group] + piece.point - starts[group], widths[group], group * wide
        target = base.new_empty((piece.columns.shape[1], base.numel()))
        for row, column in zip(target, piece.columns.unbind(1), strict=True):
            torch.addcmul(base, table[key + column[piece.slots]], width, out=row)
        targets.append(target)
    return groups, targets


def _seen(piece: Piece, number: Tensor, wide: int) -> Tensor:
    """Groups and columns that meet in a piece, as one number each."""
    assert piece.point is not None
    slots = piece.columns.shape[0]
    pairs = torch.unique(number[piece.point] * slots + piece.slots)
    group = torch.div(pairs, slots, rounding_mode="floor")
    return ((group * wide)[:, None] + piece.columns[pairs % slots]).flatten()
