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

from torchsfm.optim.layout import CHUNK, Layout, Piece
from torchsfm.optim.terms import Block, Term, gather, lift_of, linearize


@dataclass(frozen=True)
class _Part:
    """Residuals linearised at once."""

    term: Term
    wanted: tuple[bool, ...]
    width: int
    """Tangent coordinates of a slot."""
    segments: list[tuple[int, int]]
    """Where runs of one slot begin and end."""
    places: Tensor
    """Where the entries of each run's square go in U."""
    target: Tensor | None
    point: Tensor | None


class Elimination:
    """Normal equations of a laid-out problem, linearised at one place at a time."""

    def __init__(self, blocks: dict[str, Block], layout: Layout) -> None:
        self.blocks = blocks
        self.layout = layout
        self.parts = [
            part
            for piece, target in zip(layout.pieces, layout.targets, strict=True)
            for part in _parts(piece, target, layout.size)
        ]
        some = next(iter(blocks.values())).x
        q, n, size = layout.point_size, layout.points, layout.size
        total = sum((g.end - g.start) * g.columns.numel() for g in layout.groups)
        # These live as long as the problem: memory that is new costs more than the arithmetic on it.
        self.U = some.new_empty((size + 2, size + 2))
        self.V = some.new_empty((q * (q + 1) // 2, n))
        self.W = some.new_empty((q, total))
        self._scratch = some.new_empty((max((g.end - g.start) * g.columns.numel() for g in layout.groups), q) if q else (0,))
        self._work: dict[tuple[str, int, int], Tensor] = {}

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
        for buffer in (self.U, self.V, self.W):
            buffer.zero_()
        for part in self.parts:
            self._add(part, *linearize(part.term, x, lifts, part.wanted))
        return Linearized(self.layout, self.U, self.V, self.W, self._scratch.view(-1))

    def _add(self, part: _Part, r: Tensor, jacobians: list[Tensor | None]) -> None:
        """Add squares and products of a part's Jacobians to the system."""
        q, eliminated = self.layout.point_size, self.layout.eliminated
        d, m = r.shape
        J = self._buffer("J", d * (part.width + 1), m).view(d, part.width + 1, m)
        start, P = 0, None
        for name, j in zip(part.term.blocks, jacobians, strict=True):
            if j is None:
                continue
            if name == eliminated:
                P = j
            else:
                J[:, start : start + j.shape[1]] = j
                start += j.shape[1]
        J[:, start] = r
        if start:
            squares = torch.stack([torch.bmm(J[:, :, a:b], J[:, :, a:b].mT) for a, b in part.segments]).sum(1)
            self.U.view(-1).index_add_(0, part.places, squares.flatten())
        if P is None or part.point is None or part.target is None:
            return
        squares = self._buffer("V", self.V.shape[0], m)
        for row, (a, b) in zip(squares, _pairs(q), strict=True):
            torch.mul(P[0, a], P[0, b], out=row)
            for k in range(1, d):
                row.addcmul_(P[k, a], P[k, b])
        self.V.index_add_(1, part.point, squares)
        product = self._buffer("W", part.width + 1, m)
        for a in range(q):
            torch.mul(J[0], P[0, a], out=product)
            for k in range(1, d):
                product.addcmul_(J[k], P[k, a])
            self.W[a].scatter_add_(0, part.target, product.view(-1))

    def _buffer(self, name: str, rows: int, columns: int) -> Tensor:
        key = (name, rows, columns)
        if key not in self._work:
            self._work[key] = self.U.new_empty((rows, columns))
        return self._work[key]


@dataclass(frozen=True)
class Linearized:
    """The normal equations: `U` with the gradient as column `size`, `V` as its distinct entries, `W` group by group."""

    layout: Layout
    U: Tensor
    V: Tensor
    W: Tensor
    scratch: Tensor

    def solve(self, damping: float) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """The step for `damping` times the diagonal, the decrease the model promises, and whether the system was solved."""
        layout = self.layout
        size, q = layout.size, layout.point_size
        pairs = _pairs(q)
        diagonal = _floor(torch.stack([self.V[pairs.index((a, a))] for a in range(q)])) if q else self.V
        L = _factor(self.V, damping * diagonal, q)
        S = self.U.clone()
        for group in layout.groups:
            W, span = self._coupling(group.offset, group.start, group.end, group.columns.numel()), slice(group.start, group.end)
            Y = self.scratch[: W.numel()].view(W.shape)
            for a in range(q):
                row = W[a]
                for b in range(a):
                    torch.addcmul(row, L[a][b][span], Y[b], value=-1, out=Y[a])
                    row = Y[a]
                torch.mul(row, L[a][a][span], out=Y[a])
            square = Y[0] @ Y[0].mT
            for a in range(1, q):
                square.addmm_(Y[a], Y[a].mT)
            if len(layout.groups) == 1 and group.columns.numel() == size + 1 and int(group.columns[-1]) == size:
                S[: size + 1, : size + 1] -= square
            else:
                S[group.columns[:, None], group.columns] -= square
        weight = _floor(self.U.diagonal()[:size]) * damping
        factor, info = torch.linalg.cholesky_ex(S[:size, :size] + torch.diag(weight))
        camera = -torch.cholesky_solve(S[:size, size, None], factor)[:, 0] if size else S.new_zeros(0)
        solved = (info == 0) & camera.isfinite().all()
        promise = camera @ (weight * camera - self.U[:size, size])
        step = self._split(camera)
        if layout.eliminated is not None:
            h, z = self._gradient_and_product(camera)
            point = _substitute(L, z)
            promise = promise + (point * (damping * diagonal * point - h)).sum()
            step[layout.eliminated] = point.mT
        return step, promise / 2, solved

    def gradient(self) -> Tensor:
        """Largest absolute derivative of the cost."""
        size = self.layout.size
        largest = [self.U[:size, size].abs().amax()] if size else []
        for group in self.layout.groups:
            W = self._coupling(group.offset, group.start, group.end, group.columns.numel())
            largest.append(W[:, self._gradient_row(group.columns)].abs().amax())
        return torch.stack(largest).amax()

    def _gradient_row(self, columns: Tensor) -> int:
        # Columns are sorted; only that of fixed variables comes after the gradient's.
        return columns.numel() - 1 - int(columns[-1] > self.layout.size)

    def _coupling(self, offset: int, start: int, end: int, columns: int) -> Tensor:
        return self.W[:, offset : offset + columns * (end - start)].view(-1, columns, end - start)

    def _gradient_and_product(self, camera: Tensor) -> tuple[Tensor, Tensor]:
        """The points' gradient h and `h + W'a`."""
        q, n = self.layout.point_size, self.layout.points
        h, z = camera.new_empty((q, n)), camera.new_empty((q, n))
        extended = torch.cat((camera, camera.new_tensor([1.0, 0.0])))
        for group in self.layout.groups:
            W, span = self._coupling(group.offset, group.start, group.end, group.columns.numel()), slice(group.start, group.end)
            h[:, span] = W[:, self._gradient_row(group.columns)]
            z[:, span] = extended[group.columns] @ W
        return h, z

    def _split(self, camera: Tensor) -> dict[str, Tensor]:
        """The columns of each block."""
        ends = [*list(self.layout.first.values())[1:], self.layout.size]
        return {
            name: camera[start:end].view(self.layout.free[name].numel(), -1)
            for (name, start), end in zip(self.layout.first.items(), ends, strict=True)
        }


def _parts(piece: Piece, target: Tensor | None, size: int) -> list[_Part]:
    """Cut a piece where the residuals linearised at once become too many."""
    m, width = piece.slots.numel(), piece.columns.shape[1] - 1
    ends = torch.bincount(piece.slots, minlength=piece.columns.shape[0]).cumsum(0).tolist()
    parts = []
    count = -(-m // CHUNK)
    bounds = [m * k // count for k in range(count + 1)]
    slot = 0
    for first, last in pairwise(bounds):
        segments, slots = [], []
        at = first
        while at < last:
            while ends[slot] <= at:
                slot += 1
            stop = min(ends[slot], last)
            segments.append((at - first, stop - first))
            slots.append(slot)
            at = stop
        columns = piece.columns[slots]
        places = (columns[:, :, None] * (size + 2) + columns[:, None]).flatten()
        rows = slice(first, last)
        term = replace(
            piece.term,
            index=tuple(i[rows] for i in piece.term.index),
            data=tuple(d[rows] for d in piece.term.data),
            weights=None if piece.term.weights is None else piece.term.weights[rows],
        )
        point = None if piece.point is None else piece.point[rows]
        goal = None if target is None else target[:, rows].flatten()
        parts.append(_Part(term, piece.wanted, width, segments, places, goal, point))
    return parts


def _pairs(q: int) -> list[tuple[int, int]]:
    return [(a, b) for a in range(q) for b in range(a + 1)]


def _floor(diagonal: Tensor) -> Tensor:
    """A variable that nothing depends on in some direction gets a damping of its own, and does not move."""
    if diagonal.numel() == 0:
        return diagonal
    least = 1e-12 * diagonal.amax(0, keepdim=True)
    return torch.where(least > 0, torch.maximum(diagonal, least), torch.ones_like(diagonal))


def _factor(V: Tensor, damping: Tensor, q: int) -> list[list[Tensor]]:
    """Cholesky factors of all point blocks, elementwise, with the reciprocals of the diagonal in its place."""
    pairs = _pairs(q)
    L: list[list[Tensor]] = []
    for a in range(q):
        row: list[Tensor] = []
        for b in range(a + 1):
            value = V[pairs.index((a, b))]
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


def _substitute(L: list[list[Tensor]], z: Tensor) -> Tensor:
    """`-L'^-1 L^-1 z`."""
    q = len(L)
    forward: list[Tensor] = []
    for a in range(q):
        value = z[a]
        for b in range(a):
            value = value - L[a][b] * forward[b]
        forward.append(value * L[a][a])
    solution: list[Tensor] = [z[0]] * q
    for a in reversed(range(q)):
        value = -forward[a]
        for b in range(a + 1, q):
            value = value - L[b][a] * solution[b]
        solution[a] = value * L[a][a]
    return torch.stack(solution)


def move(blocks: dict[str, Block], layout: Layout, x: dict[str, Tensor], step: dict[str, Tensor]) -> dict[str, Tensor]:
    """All variables after a step; those not free keep every bit."""
    moved = dict(x)
    for name, delta in step.items():
        index = layout.free[name]
        columns = blocks[name].retract(gather(x[name], index), delta).mT
        moved[name] = x[name].mT.contiguous().index_copy(1, index, columns).mT
    return moved
