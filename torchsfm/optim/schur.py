"""The Schur complement: normal equations in which one family of variables is eliminated, each variable by itself.

With the eliminated variables (points) last, the normal equations of a problem of terms are

    [ U   W ] [ a ]     [ g ]
    [ W'  V ] [ b ] = - [ h ],    V block diagonal,

and `S = U - W V^-1 W'` is a system in the retained variables (cameras) alone (Brown 1958; Triggs et al. 2000, 6.1; HZ A6.3).
Work comes in three tiers: once per problem (`Elimination`: who meets whom), once per linearisation (`linearize`), once per
damping (`solve`), so that a rejected step costs only the last.

Residuals are sorted by slot. A slot is a combination of retained variables that occurs (pose 3 with camera 0), so camera-side
sums are products of contiguous matrices, and variables shared between slots are tied by adding up columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.optim.terms import Block, Term, gather, lift_of, linearize


@dataclass(frozen=True)
class Piece:
    """Residuals of one term that have the same kinds of free variables, sorted by slot."""

    term: Term
    rows: Tensor
    """Which residuals of the original term."""
    wanted: tuple[bool, ...]
    slots: Tensor
    """Slot of each residual (m)."""
    ends: list[int]
    """Where each slot's residuals end."""
    columns: Tensor
    """Column of each tangent coordinate of each slot, then that of the residual: (slots, c + 1)."""
    point: Tensor | None
    """Number of each residual's eliminated variable among the free ones, (m)."""


@dataclass(frozen=True)
class Layout:
    """Which variables are free and where they stand in the systems."""

    free: dict[str, Tensor]
    """Free and observed variables of each block."""
    first: dict[str, int]
    """First column of each retained block."""
    size: int
    """Number of columns of the reduced system."""
    eliminated: str | None
    points: int
    point_size: int
    pieces: list[Piece]


def lay_out(blocks: dict[str, Block], terms: Sequence[Term], eliminate: str | None) -> Layout:
    """Decide which variables move, drop residuals without any, and sort the others.

    Args:
        blocks: The variables.
        terms: The residuals; those with weight 0 are dropped.
        eliminate: The block to eliminate, if any; no residual may depend on two of its variables.
    """
    observed = {name: torch.zeros(b.x.shape[0], dtype=torch.bool, device=b.x.device) for name, b in blocks.items()}
    for term in terms:
        for name, index in zip(term.blocks, term.index, strict=True):
            observed[name][index if term.weights is None else index[term.weights > 0]] = True
    free: dict[str, Tensor] = {}
    number: dict[str, Tensor] = {}
    first: dict[str, int] = {}
    size = 0
    for name, block in blocks.items():
        moves = observed[name] if block.fixed is None else observed[name] & ~block.fixed
        if block.tangent == 0:
            moves = torch.zeros_like(moves)
        free[name] = moves.nonzero()[:, 0]
        number[name] = torch.full(moves.shape, -1, device=moves.device)
        number[name][free[name]] = torch.arange(free[name].numel(), device=moves.device)
        if name != eliminate:
            first[name] = size
            size += free[name].numel() * block.tangent
    points = 0 if eliminate is None else free[eliminate].numel()
    pieces: list[Piece] = []
    for term in terms:
        pieces += _cut(term, blocks, number, first, size, eliminate)
    point_size = 0 if eliminate is None else blocks[eliminate].tangent
    return Layout(free, first, size, eliminate, points, point_size, pieces)


def _cut(
    term: Term, blocks: dict[str, Block], number: dict[str, Tensor], first: dict[str, int], size: int, eliminate: str | None
) -> list[Piece]:
    """The pieces of a term: residuals with a free point, without one, and with nothing free but the point."""
    if term.blocks.count(eliminate or "") > 1:
        raise ValueError(f"eliminate: a residual depends on two variables of {eliminate!r}; they cannot be eliminated singly")
    places = [number[name][index] for name, index in zip(term.blocks, term.index, strict=True)]
    has_point = torch.zeros_like(places[0], dtype=torch.bool)
    has_camera = torch.zeros_like(has_point)
    for name, place in zip(term.blocks, places, strict=True):
        if name == eliminate:
            has_point = has_point | (place >= 0)
        else:
            has_camera = has_camera | (place >= 0)
    counts = torch.ones_like(has_point) if term.weights is None else term.weights > 0
    pieces = []
    for camera, point in ((True, True), (True, False), (False, True)):
        rows = (counts & (has_camera == camera) & (has_point == point)).nonzero()[:, 0]
        if rows.numel() > 0:
            pieces.append(_sort(term, rows, places, (camera, point), blocks, first, size, eliminate))
    return pieces


def _sort(
    term: Term,
    rows: Tensor,
    places: list[Tensor],
    kind: tuple[bool, bool],
    blocks: dict[str, Block],
    first: dict[str, int],
    size: int,
    eliminate: str | None,
) -> Piece:
    camera, with_point = kind
    places = [place[rows] for place in places]
    wanted = tuple(
        (with_point if name == eliminate else camera and bool((place >= 0).any()))
        for name, place in zip(term.blocks, places, strict=True)
    )
    retained = [(n, p) for n, p, w in zip(term.blocks, places, wanted, strict=True) if w and n != eliminate]
    point = next((p for n, p in zip(term.blocks, places, strict=True) if n == eliminate), None) if with_point else None
    # Slots in the order of the first retained block, then the second, ...; -1 (fixed) is a value like any other.
    key = torch.zeros_like(rows)
    for _, place in retained:
        key = key * (int(place.max()) + 2) + place + 1
    values, slots = torch.unique(key, return_inverse=True)
    order = slots if point is None else slots * (int(point.max()) + 1) + point
    order = torch.argsort(order, stable=True)
    rows, slots = rows[order], slots[order]
    columns = torch.full((values.numel(), 1), size, device=rows.device)
    for name, place in reversed(retained):
        mine = torch.empty_like(values).index_copy_(0, slots, place[order])[:, None]
        width = blocks[name].tangent
        step = torch.arange(width, device=rows.device)
        # Column size is the residual's, size + 1 collects what belongs to fixed variables.
        columns = torch.cat((torch.where(mine >= 0, first[name] + mine * width + step, size + 1), columns), 1)
    ends = torch.bincount(slots, minlength=values.numel()).cumsum(0).tolist()
    return Piece(term.select(rows), rows, wanted, slots, ends, columns, None if point is None else point[order])


class Elimination:
    """Normal equations of a laid-out problem, linearised at one place at a time."""

    def __init__(self, blocks: dict[str, Block], layout: Layout) -> None:
        self.blocks = blocks
        self.layout = layout
        q, n = layout.point_size, layout.points
        self._targets: list[Tensor | None] = []
        for piece in layout.pieces:
            if piece.point is None or piece.columns.shape[1] == 1:
                self._targets.append(None)
            else:
                # Where the residual's camera-point block goes in W (size + 2, q, n); c + 1 rows of m.
                self._targets.append((piece.columns * (q * n))[piece.slots].mT + piece.point)

    def linearize(self, x: dict[str, Tensor]) -> "Linearized":
        """The blocks of the normal equations at `x`."""
        layout = self.layout
        size, q, n = layout.size, layout.point_size, layout.points
        some = next(iter(x.values()))
        lifts = {name: lift_of(b, x[name]) for name, b in self.blocks.items()}
        U = some.new_zeros((size + 2, size + 2))
        W = some.new_zeros((size + 2, q, n))
        V = some.new_zeros((q * (q + 1) // 2, n))
        for piece, target in zip(layout.pieces, self._targets, strict=True):
            r, jacobians = linearize(piece.term, x, lifts, piece.wanted)
            cameras = [
                j for name, j in zip(piece.term.blocks, jacobians, strict=True) if j is not None and name != layout.eliminated
            ]
            points = [
                j for name, j in zip(piece.term.blocks, jacobians, strict=True) if j is not None and name == layout.eliminated
            ]
            J = torch.cat((*cameras, r[:, None]), 1)
            if cameras:
                _add_squares(U, J, piece)
            if points:
                assert piece.point is not None
                P = points[0]
                for k, (a, b) in enumerate(_pairs(q)):
                    V[k].index_add_(0, piece.point, (P[:, a] * P[:, b]).sum(0))
                if target is None:
                    target = ((size * q * n) + piece.point)[None]
                for a in range(q):
                    W.view(-1).scatter_add_(0, (target + a * n).flatten(), (J * P[:, a, None]).sum(0).flatten())
        return Linearized(layout, U, V, W)


@dataclass(frozen=True)
class Linearized:
    """`U` and `W` with the gradient as their column (row) `size`, and `V` as its distinct entries."""

    layout: Layout
    U: Tensor
    V: Tensor
    W: Tensor

    def solve(self, damping: float) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """The step for `damping` times the diagonal, the decrease the model promises, and whether the system was solved."""
        layout = self.layout
        size, q, n = layout.size, layout.point_size, layout.points
        pairs = _pairs(q)
        diagonal = torch.stack([self.V[pairs.index((a, a))] for a in range(q)]) if q else self.V
        diagonal = _floor(diagonal, 0)
        L = _factor(self.V, damping * diagonal, q)
        rows: list[Tensor] = []
        Y = torch.empty_like(self.W[: size + 1])
        for a in range(q):
            row = self.W[: size + 1, a]
            for b in range(a):
                row = row - L[a][b] * rows[b]
            rows.append(torch.mul(row, L[a][a], out=Y[:, a]))
        flat = Y.view(size + 1, q * n)
        S = self.U[: size + 1, : size + 1] - flat @ flat.mT
        weight = _floor(self.U.diagonal()[:size], 0)
        matrix = S[:size, :size] + torch.diag(damping * weight)
        factor, info = torch.linalg.cholesky_ex(matrix)
        camera = -torch.cholesky_solve(S[:size, size:], factor)[:, 0] if size else matrix.new_zeros(0)
        solved = (info == 0) & camera.isfinite().all()
        gradient = self.U[:size, size]
        promise = camera @ (damping * weight * camera - gradient)
        step = self._split(camera)
        if layout.eliminated is not None:
            z = flat[size] + camera @ flat[:size]
            point = _back_substitute(L, z.view(q, n))
            promise = promise + (point * (damping * diagonal * point - self.W[size])).sum()
            step[layout.eliminated] = point.mT
        return step, promise / 2, solved

    def gradient(self) -> Tensor:
        """Largest absolute derivative of the cost."""
        size = self.layout.size
        both = torch.cat((self.U[:size, size], self.W[size].flatten(), self.U.new_zeros(1)))
        return both.abs().max()

    def _split(self, camera: Tensor) -> dict[str, Tensor]:
        layout = self.layout
        return {
            name: camera[start : start + layout.free[name].numel() * self.tangent(name)].view(layout.free[name].numel(), -1)
            for name, start in layout.first.items()
            if layout.free[name].numel()
        }

    def tangent(self, name: str) -> int:
        """Degrees of freedom of one variable of a retained block."""
        starts = sorted({*self.layout.first.values(), self.layout.size})
        start = self.layout.first[name]
        end = min(s for s in starts if s > start)
        return (end - start) // self.layout.free[name].numel()


def _add_squares(U: Tensor, J: Tensor, piece: Piece) -> None:
    """Add J'J of every slot at its columns."""
    start = 0
    squares = []
    for end in piece.ends:
        part = J[:, :, start:end]
        squares.append(torch.bmm(part, part.mT).sum(0))
        start = end
    place = piece.columns[:, :, None] * U.shape[1] + piece.columns[:, None]
    U.view(-1).index_add_(0, place.flatten(), torch.stack(squares).flatten())


def _pairs(q: int) -> list[tuple[int, int]]:
    return [(a, b) for a in range(q) for b in range(a + 1)]


def _floor(diagonal: Tensor, dim: int) -> Tensor:
    """A variable that nothing depends on in some direction gets a damping of its own, and does not move."""
    if diagonal.numel() == 0:
        return diagonal
    least = 1e-12 * diagonal.amax(dim, keepdim=True)
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


def _back_substitute(L: list[list[Tensor]], z: Tensor) -> Tensor:
    """`-L'^-1 z`."""
    q = len(L)
    solution: list[Tensor] = [z[0]] * q
    for a in reversed(range(q)):
        value = -z[a]
        for b in range(a + 1, q):
            value = value - L[b][a] * solution[b]
        solution[a] = value * L[a][a]
    return torch.stack(solution)


def move(blocks: dict[str, Block], layout: Layout, x: dict[str, Tensor], step: dict[str, Tensor]) -> dict[str, Tensor]:
    """All variables after a step; those not free keep every bit."""
    moved = dict(x)
    for name, delta in step.items():
        index = layout.free[name]
        if index.numel() == x[name].shape[0]:
            moved[name] = blocks[name].retract(x[name], delta).mT.contiguous().mT
        else:
            columns = x[name].mT.clone()
            columns[:, index] = blocks[name].retract(gather(x[name], index), delta).mT
            moved[name] = columns.mT
    return moved
