"""The Schur complement: normal equations in which one family of variables is eliminated, each variable by itself.

With the eliminated variables (points, for short) last, the normal equations of a problem of terms are

    [ U   W ] [ a ]     [ g ]
    [ W'  V ] [ b ] = - [ h ],    V block diagonal,

and `S = U - W V^-1 W'` is a system in the retained variables alone (Brown 1958; Triggs et al. 2000, 6.1; HZ A6.3).
Work comes in three tiers: once per problem (`layout`: who meets whom), once per linearisation (`Elimination.linearize`), once
per damping (`NormalEquations.step`), so that a rejected step costs only the last.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from torchsfm.optim.coupling_groups import GroupCoupling, plan_groups
from torchsfm.optim.coupling_pairs import PairCoupling, estimate_pairs
from torchsfm.optim.layout import CHUNK, Layout, Piece
from torchsfm.optim.normal_equations import NormalEquations
from torchsfm.optim.terms import Block, Term, Workspace, gather, lift_of, linearize, term_cost, term_residual


@dataclass(frozen=True)
class _Part:
    """Residuals linearised at once."""

    piece: int
    start: int
    """The first one's place in its piece."""
    term: Term
    wanted: tuple[bool, ...]
    width: int
    """Tangent coordinates of a slot."""
    components: int
    """Numbers in a residual."""
    segments: list[tuple[int, int]]
    """Where runs of one slot begin and end."""
    places: Tensor
    """Where the entries of each run's square go in U."""
    point: Tensor | None


class Elimination:
    """Normal equations of a laid-out problem, linearised at one place at a time."""

    def __init__(self, blocks: dict[str, Block], layout: Layout, *, dense: bool = False) -> None:
        self.blocks = blocks
        self.layout = layout
        x = {name: b.x for name, b in blocks.items()}
        self.parts = [part for k, piece in enumerate(layout.pieces) for part in _parts(k, piece, layout.size, x)]
        some = next(iter(blocks.values())).x
        q, n, size = layout.point_size, layout.points, layout.size
        self.coupling: GroupCoupling | PairCoupling | None = None
        if any(piece.coupled for piece in layout.pieces):
            spans, seconds = plan_groups(layout)
            dense = dense or seconds <= estimate_pairs(layout)
            self.coupling = GroupCoupling(layout, spans, some) if dense else PairCoupling(layout, some)
        self.U = some.new_empty((size + 2, size + 2))
        self.V = some.new_empty((q * (q + 3) // 2, n))
        self.work = Workspace(some)

    def cost(self, x: dict[str, Tensor]) -> Tensor:
        """The cost of all residuals that depend on something free."""
        costs = [term_cost(part.term, term_residual(part.term, x, self.work)) for part in self.parts]
        return torch.stack(costs).sum()

    def linearize(self, x: dict[str, Tensor]) -> "NormalEquations":
        """The blocks of the normal equations at `x`; they are overwritten by the next call."""
        needed = {
            name
            for part in self.parts
            if part.term.linearize is None
            for name, w in zip(part.term.blocks, part.wanted, strict=True)
            if w
        }
        lifts = {name: lift_of(b, x[name]) if name in needed else None for name, b in self.blocks.items()}
        self.U.zero_()
        self.V.zero_()
        if self.coupling is not None:
            self.coupling.clear()
        for part in self.parts:
            self._add(part, x, lifts)
        return NormalEquations(self.layout, self.coupling, self.U, self.V)

    def _add(self, part: _Part, x: dict[str, Tensor], lifts: dict[str, Tensor | None]) -> None:
        """Add squares and products of a part's Jacobians to the system."""
        q, c, d, m = self.layout.point_size, part.width, part.components, part.term.index[0].shape[0]
        # Both with the residual as one more column, which gives the gradients.
        J, P = self.work.get("J", d, c + 1, m), self.work.get("P", d, q + 1, m)
        out: list[Tensor | None] = []
        start = 0
        for name, wanted in zip(part.term.blocks, part.wanted, strict=True):
            if not wanted:
                out.append(None)
            elif name == self.layout.eliminated:
                out.append(P[:, :q].permute(2, 0, 1))
            else:
                end = start + self.blocks[name].tangent
                out.append(J[:, start:end].permute(2, 0, 1))
                start = end
        r, scale = linearize(part.term, x, lifts, out, self.work)
        J[:, c] = r.mT
        if scale is not None:
            J *= scale
        if c:
            squares = torch.stack([torch.bmm(J[:, :, a:b], J[:, :, a:b].mT) for a, b in part.segments]).sum(1)
            self.U.view(-1).index_add_(0, part.places, squares.flatten())
        if part.point is None:
            return
        if scale is not None:
            P[:, :q] *= scale
        P[:, q] = J[:, c]
        squares = self.work.get("V", self.V.shape[0], m)
        row = 0
        for a in range(q):
            rows = squares[row : row + q + 1 - a]
            torch.mul(P[0, a], P[0, a:], out=rows)
            for k in range(1, d):
                rows.addcmul_(P[k, a], P[k, a:])
            row += q + 1 - a
        self.V.index_add_(1, part.point, squares)
        if c and self.coupling is not None:
            self.coupling.add(part.piece, part.start, J[:, :c], P[:, :q])


def _parts(number: int, piece: Piece, size: int, x: dict[str, Tensor]) -> list[_Part]:
    """Cut a piece where the residuals linearised at once become too many."""
    m, width = piece.slots.numel(), piece.columns.shape[1]
    ends = torch.bincount(piece.slots, minlength=piece.columns.shape[0]).cumsum(0).tolist()
    # The residual is one more column, the gradient's.
    extended = torch.cat((piece.columns, torch.full_like(piece.columns[:, :1], size).expand(-1, 1)), 1) if width else None
    parts = []
    components = term_residual(piece.term.select(piece.slots[:1] * 0), x).shape[1]
    slot = 0
    for first, last in pairwise([*range(0, m, CHUNK), m]):
        segments, slots = [], []
        at = first
        while at < last:
            while ends[slot] <= at:
                slot += 1
            stop = min(ends[slot], last)
            segments.append((at - first, stop - first))
            slots.append(slot)
            at = stop
        places = piece.slots[:0]
        if extended is not None:
            columns = extended[slots]
            places = (columns[:, :, None] * (size + 2) + columns[:, None]).flatten()
        rows = slice(first, last)
        term = replace(
            piece.term,
            index=tuple(i[rows] for i in piece.term.index),
            data=tuple(d[rows] for d in piece.term.data),
            weights=None if piece.term.weights is None else piece.term.weights[rows],
        )
        point = None if piece.point is None else piece.point[rows]
        parts.append(_Part(number, first, term, piece.wanted, width, components, segments, places, point))
    return parts


def move(blocks: dict[str, Block], layout: Layout, x: dict[str, Tensor], step: dict[str, Tensor]) -> dict[str, Tensor]:
    """All variables after a step; those not free keep every bit."""
    moved = dict(x)
    for name, delta in step.items():
        index = layout.free[name]
        columns = blocks[name].retract(gather(x[name], index), delta).mT
        moved[name] = x[name].mT.contiguous().index_copy(1, index, columns).mT
    return moved
