"""The Schur complement: normal equations in which one family of variables is eliminated, each variable by itself.

With the eliminated variables (points) last, the normal equations of a problem of terms are

    [ U   W ] [ a ]     [ g ]
    [ W'  V ] [ b ] = - [ h ],    V block diagonal,

and `S = U - W V^-1 W'` is a system in the retained variables (cameras) alone (Brown 1958; Triggs et al. 2000, 6.1; HZ A6.3).
Work comes in three tiers: once per problem (`layout`: who meets whom), once per linearisation (`linearize`), once per
damping (`solve`), so that a rejected step costs only the last.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from torchsfm.optim.coupling_groups import GroupCoupling, plan_groups
from torchsfm.optim.coupling_pairs import PairCoupling, estimate_pairs
from torchsfm.optim.layout import CHUNK, Layout, Piece
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

    def __init__(self, blocks: dict[str, Block], layout: Layout) -> None:
        self.blocks = blocks
        self.layout = layout
        x = {name: b.x for name, b in blocks.items()}
        self.parts = [part for k, piece in enumerate(layout.pieces) for part in _parts(k, piece, layout.size, x)]
        some = next(iter(blocks.values())).x
        q, n, size = layout.point_size, layout.points, layout.size
        self.coupling: GroupCoupling | PairCoupling | None = None
        if any(piece.coupled for piece in layout.pieces):
            spans, seconds = plan_groups(layout)
            dense = seconds <= estimate_pairs(layout)
            self.coupling = GroupCoupling(layout, spans, some) if dense else PairCoupling(layout, some)
        self.U = some.new_empty((size + 2, size + 2))
        self.V = some.new_empty((q * (q + 3) // 2, n))
        self.work = Workspace(some)

    def cost(self, x: dict[str, Tensor]) -> Tensor:
        """The cost of all residuals that depend on something free."""
        costs = [term_cost(part.term, term_residual(part.term, x, self.work)) for part in self.parts]
        return torch.stack(costs).sum()

    def linearize(self, x: dict[str, Tensor]) -> "Linearized":
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
        return Linearized(self.layout, self.coupling, self.U, self.V)

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


@dataclass(frozen=True)
class Linearized:
    """The normal equations: `U` with the gradient as column `size`, `V`, and the coupling `W`.

    `V` holds the distinct entries of the blocks row by row, each row followed by its entry of the gradient.
    """

    layout: Layout
    coupling: GroupCoupling | PairCoupling | None
    U: Tensor
    V: Tensor

    def solve(self, damping: float) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """The step for `damping` times the diagonal, the decrease the model promises, and whether the system was solved."""
        layout = self.layout
        size, q = layout.size, layout.point_size
        weight = damping * _floor(self.U.diagonal()[:size])
        S, right = self.U.clone(), self.U[:size, size].clone()
        S.diagonal()[:size] += weight
        h = self.V[[_place(a, q, q) for a in range(q)]]
        point_weight, z = h, h
        L: list[list[Tensor]] = []
        if q:
            point_weight = damping * _floor(self.V[[_place(a, a, q) for a in range(q)]])
            L = _factor(self.V, point_weight, q)
            z = _forward(L, h)
            if self.coupling is not None:
                right -= self.coupling.reduce(S, L, z)[:size]
        factor, info = torch.linalg.cholesky_ex(S[:size, :size])
        camera = -torch.cholesky_solve(right[:, None], factor)[:, 0] if size else right
        solved = (info == 0) & camera.isfinite().all()
        promise = camera @ (weight * camera - self.U[:size, size])
        step = self._split(camera)
        if layout.eliminated is not None:
            if self.coupling is not None:
                z = z + _forward(L, self.coupling.product(torch.cat((camera, camera.new_zeros(2)))))
            point = _backward(L, z)
            promise = promise + (point * (point_weight * point - h)).sum()
            step[layout.eliminated] = point.mT
        return step, promise / 2, solved

    def gradient(self) -> Tensor:
        """Largest absolute derivative of the cost."""
        size, q = self.layout.size, self.layout.point_size
        return torch.cat((self.U[:size, size], *(self.V[_place(a, q, q)] for a in range(q)))).abs().amax()

    def _split(self, camera: Tensor) -> dict[str, Tensor]:
        """The columns of each block."""
        ends = [*list(self.layout.first.values())[1:], self.layout.size]
        return {
            name: camera[start:end].view(self.layout.free[name].numel(), -1)
            for (name, start), end in zip(self.layout.first.items(), ends, strict=True)
        }


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


def _place(a: int, b: int, q: int) -> int:
    """Row of V that holds entry (a, b >= a) of the blocks; b = q is the gradient."""
    return a * (q + 1) - a * (a - 1) // 2 + b - a


def _floor(diagonal: Tensor) -> Tensor:
    """A variable that nothing depends on in some direction gets a damping of its own, and does not move."""
    if diagonal.numel() == 0:
        return diagonal
    least = 1e-12 * diagonal.amax(0, keepdim=True)
    return torch.where(least > 0, torch.maximum(diagonal, least), torch.ones_like(diagonal))


def _factor(V: Tensor, damping: Tensor, q: int) -> list[list[Tensor]]:
    """Cholesky factors of all point blocks, elementwise, with the reciprocals of the diagonal in its place."""
    L: list[list[Tensor]] = []
    for a in range(q):
        row: list[Tensor] = []
        for b in range(a + 1):
            value = V[_place(b, a, q)]
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


def _forward(L: list[list[Tensor]], z: Tensor) -> Tensor:
    """`L^-1 z`."""
    rows: list[Tensor] = []
    for a, value in enumerate(z.unbind(0)):
        for b in range(a):
            value = value - L[a][b] * rows[b]
        rows.append(value * L[a][a])
    return torch.stack(rows)


def _backward(L: list[list[Tensor]], z: Tensor) -> Tensor:
    """`-L'^-1 z`."""
    q = len(L)
    rows: list[Tensor] = [z[0]] * q
    for a in reversed(range(q)):
        value = -z[a]
        for b in range(a + 1, q):
            value = value - L[b][a] * rows[b]
        rows[a] = value * L[a][a]
    return torch.stack(rows)


def move(blocks: dict[str, Block], layout: Layout, x: dict[str, Tensor], step: dict[str, Tensor]) -> dict[str, Tensor]:
    """All variables after a step; those not free keep every bit."""
    moved = dict(x)
    for name, delta in step.items():
        index = layout.free[name]
        columns = blocks[name].retract(gather(x[name], index), delta).mT
        moved[name] = x[name].mT.contiguous().index_copy(1, index, columns).mT
    return moved
