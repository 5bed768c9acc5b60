"""A sparse symmetric system and its Cholesky factor, front by front (multifrontal: Duff & Reid 1983; Liu, SIAM Review 1992).

An entry lies in the front in which the first of its two variables is eliminated. A front is the lower part of a dense matrix:
the columns of its pivots, with rows for these and for its border. Eliminating them leaves a square of the border, which goes
to the front that eliminates the first of it. Chains, rings and grids fill in so little that this takes time in proportion to
their length; and where everything has to do with everything, so that much fills in, conjugate gradients need few iterations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.optim.elimination_order import Front, members
from torchsfm.optim.schur_matrix_free import conjugate_gradients

SOLVED = 1e-9
"""To which part of itself a residual is brought where motions are at rest, in the norm of the inverse."""


@dataclass(frozen=True)
class _Place:
    """Where a front is."""

    start: int
    """Its first number among those of all, row by row."""
    pivots: Tensor
    """Columns of the system."""
    border: Tensor
    children: list[tuple[int, Tensor, int]]
    """Fronts that add to this one, the rows where their borders are here, and how many of these are pivots here."""

    def of(self, numbers: Tensor) -> Tensor:
        """The front, (pivots + border, pivots)."""
        p, b = len(self.pivots), len(self.border)
        return numbers[self.start : self.start + (p + b) * p].view(p + b, p)


class Fronts:
    """A symmetric matrix with those entries that may come to differ from zero, and the gradient, as one row of numbers."""

    def __init__(self, found: Sequence[Front], columns: Sequence[Tensor]) -> None:
        """Lay out the numbers.

        Args:
            found: Which variables are eliminated together, children first.
            columns: Those of each variable.
        """
        device = columns[0].device
        widths = [len(c) for c in columns]
        self.size = sum(widths)
        order = [i for front in found for i in front.pivots]
        rank = {i: k for k, i in enumerate(order)}
        # Of each column, and of the gradient's and that of fixed variables: its variable, its place there, when its turn is.
        self._variable = torch.full((self.size + 2,), len(columns), device=device)
        self._within, self._turn = torch.zeros_like(self._variable), torch.arange(self.size + 2, device=device)
        counts = torch.tensor([widths[i] for i in order], device=device)
        turns = torch.cat([columns[i] for i in order])
        self._turn[turns] = torch.arange(self.size, device=device)
        self._variable[turns] = torch.tensor(order, device=device).repeat_interleave(counts)
        self._within[turns] = self._turn[turns] - (counts.cumsum(0) - counts).repeat_interleave(counts)
        # In which row of each front a variable begins.
        first = torch.full((len(found), len(columns) + 1), -1, dtype=torch.int32, device="cpu")
        front_of = torch.zeros(len(columns) + 1, dtype=torch.int64, device="cpu")
        self.total, self.fronts = 0, list[_Place]()
        for f, front in enumerate(found):
            border = sorted(members(front.border), key=rank.__getitem__)
            own = torch.tensor(front.pivots + border)
            sizes = torch.tensor([widths[i] for i in own.tolist()])
            first[f, own] = (sizes.cumsum(0) - sizes).int()
            front_of[own[: len(front.pivots)]] = f
            mine = torch.cat([columns[i] for i in own.tolist()])
            p = sum(widths[i] for i in front.pivots)
            joined = []
            for child in front.children:
                # The rows of a border are in the order of their turns, as everywhere.
                beyond = self.fronts[child].border
                local = first[f].to(device)[self._variable[beyond]] + self._within[beyond]
                joined.append((child, local, int((local < p).sum())))
            self.fronts.append(_Place(self.total, mine[:p], mine[p:], joined))
            self.total += len(mine) * p
        self._first, self._front = first.to(device), front_of.to(device)
        self._start = torch.tensor([place.start for place in self.fronts], device=device)
        self._stride = torch.tensor([len(place.pivots) for place in self.fronts], device=device)

    def zeros(self, some: Tensor) -> Tensor:
        """The numbers: of all fronts, of the gradient, and one that collects what belongs nowhere."""
        return some.new_zeros(self.total + self.size + 1)

    def places(self, row: Tensor, column: Tensor) -> Tensor:
        """Where entries of either triangle are."""
        early, late = self._by_turn(row, column)
        front = self._front[self._variable[early]]
        down = self._first[front, self._variable[late]] + self._within[late]
        across = self._first[front, self._variable[early]] + self._within[early]
        inside = self._start[front] + down * self._stride[front] + across
        nowhere = torch.where(late == self.size, self.total + early, self.total + self.size)
        return torch.where(late < self.size, inside, torch.where(early < self.size, nowhere, self.total + self.size))

    def meet(self, row: Tensor, column: Tensor) -> Tensor:
        """Whether the matrix has entries there."""
        early, late = self._by_turn(row, column)
        return self._first[self._front[self._variable[early]], self._variable[late]] >= 0

    def _by_turn(self, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor]:
        first = self._turn[row] <= self._turn[column]
        return torch.where(first, row, column), torch.where(first, column, row)

    def squares(self, columns: Tensor) -> Tensor:
        """Where squares over columns (n, c) are, (n, c, c); what lies in the upper triangle is nowhere."""
        row, column = columns[:, :, None], columns[:, None]
        return torch.where(self._turn[row] >= self._turn[column], self.places(row, column), self.total + self.size)

    def gradient(self, numbers: Tensor) -> Tensor:
        """The gradient, (size)."""
        return numbers[self.total : self.total + self.size]

    def product(self, numbers: Tensor, x: Tensor) -> Tensor:
        """The matrix times a vector."""
        out = torch.zeros_like(x)
        for place in self.fronts:
            p, A = len(place.pivots), place.of(numbers)
            lower = A[:p].tril()
            mine, beyond = x[place.pivots], x[place.border]
            out[place.pivots] += lower @ mine + lower.tril(-1).mT @ mine + A[p:].mT @ beyond
            out[place.border] += A[p:] @ mine
        return out

    def solve(self, numbers: Tensor, weight: Tensor, right: Tensor, rest: tuple[Tensor, Tensor] | None) -> Tensor | None:
        """The solution for a right side (size), with a diagonal added to the matrix; None if it is not positive.

        Args:
            numbers: The matrix.
            weight: The diagonal.
            right: The right side.
            rest: Motions E (size, k) of which the solution has no part, and F with `F'E = 1` that tells what part there is.
        """
        if rest is None:
            factor = self.factor(numbers, weight)
            return None if factor is None else factor.solve(right[:, None])[:, 0]
        # Where one front is held the others are, too, and nothing fills in. The solution is that with these motions free but
        # for what the damping says of them, which a few iterations make up for.
        E, F = rest
        widest = self.widest()
        factor = self.factor(numbers, weight, (widest, F[self.fronts[widest].pivots]))
        if factor is None:
            return None

        def precondition(r: Tensor) -> Tensor:
            z = factor.solve((r - F @ (E.mT @ r))[:, None])[:, 0]
            return z - E @ (F.mT @ z)

        x, positive, _ = conjugate_gradients(lambda x: self.product(numbers, x) + weight * x, precondition, right, SOLVED)
        return x if positive else None

    def factor(self, numbers: Tensor, weight: Tensor, hold: tuple[int, Tensor] | None = None) -> "FrontFactor | None":
        """The factor of the matrix with a diagonal (size) added; None if it is not positive.

        Args:
            numbers: The matrix.
            weight: The diagonal.
            hold: A front and columns (pivots, k) whose square is added to it.
        """
        left, factors = dict[int, Tensor](), list[tuple[Tensor, Tensor]]()
        for f, place in enumerate(self.fronts):
            A, square = self._gathered(place, numbers, weight, left)
            if hold is not None and hold[0] == f:
                A[: len(place.pivots)] += hold[1] @ hold[1].mT
            found = _eliminated(A, square)
            if found is None:
                return None
            factors.append(found)
            left[f] = square
        return FrontFactor(self, factors)

    def last(self, numbers: Tensor, weight: Tensor) -> Tensor | None:
        """The last front with a diagonal (size) added to the matrix, when all others are eliminated; None if they cannot be."""
        left = dict[int, Tensor]()
        for f, place in enumerate(self.fronts[:-1]):
            A, left[f] = self._gathered(place, numbers, weight, left)
            if _eliminated(A, left[f]) is None:
                return None
        A, _ = self._gathered(self.fronts[-1], numbers, weight, left)
        return A.tril() + A.tril(-1).mT

    def _gathered(self, place: _Place, numbers: Tensor, weight: Tensor, left: dict[int, Tensor]) -> tuple[Tensor, Tensor]:
        """A front with what its children leave, which is taken, and what these leave to the square of its border."""
        p, b = len(place.pivots), len(place.border)
        A = place.of(numbers).clone()
        A.diagonal().add_(weight[place.pivots])
        square = A.new_zeros((b, b))
        for child, rows, ours in place.children:
            part = left.pop(child)
            A[rows[:, None], rows[:ours]] += part[:, :ours]
            beyond = rows[ours:] - p
            square[beyond[:, None], beyond] += part[ours:, ours:]
        return A, square

    def widest(self) -> int:
        """The front of the most pivots."""
        return max(range(len(self.fronts)), key=lambda f: len(self.fronts[f].pivots))


def _eliminated(A: Tensor, square: Tensor) -> tuple[Tensor, Tensor] | None:
    """The triangle of a front's pivots and the rows of its border, taken off the square; None if it is not positive."""
    p = A.shape[1]
    lower, info = torch.linalg.cholesky_ex(A[:p])
    if bool(info):
        return None
    below = torch.linalg.solve_triangular(lower.mT, A[p:], upper=True, left=False)
    square.addmm_(below, below.mT, alpha=-1)
    return lower, below


@dataclass(frozen=True)
class FrontFactor:
    """A Cholesky factor."""

    fronts: Fronts
    parts: list[tuple[Tensor, Tensor]]
    """For each front the triangle of its pivots, and the rows of its border."""

    def solve(self, right: Tensor) -> Tensor:
        """The solution for right sides (size, k)."""
        x = right.clone()
        for place, (lower, below) in zip(self.fronts.fronts, self.parts, strict=True):
            half = torch.linalg.solve_triangular(lower, x[place.pivots], upper=False)
            x[place.pivots] = half
            x[place.border] -= below @ half
        for place, (lower, below) in zip(reversed(self.fronts.fronts), reversed(self.parts), strict=True):
            rest = x[place.pivots] - below.mT @ x[place.border]
            x[place.pivots] = torch.linalg.solve_triangular(lower.mT, rest, upper=True)
        return x

    def inverse(self) -> Tensor:
        """The inverse where the matrix has entries, as its numbers are (Takahashi et al. 1973; Erisman & Tinney 1975)."""
        out = self.fronts.zeros(self.parts[0][0])
        borders = dict[int, Tensor]()
        for f in reversed(range(len(self.parts))):
            place, (lower, below) = self.fronts.fronts[f], self.parts[f]
            p = len(place.pivots)
            # From the last to the first: what a border has in the inverse is known by then.
            mine = torch.cholesky_inverse(lower)
            whole = mine
            if len(place.border):
                known = borders.pop(f)
                reach = torch.linalg.solve_triangular(lower, below, upper=False, left=False)
                cross = -known @ reach
                mine = mine - reach.mT @ cross
                whole = torch.cat((torch.cat((mine, cross.mT), 1), torch.cat((cross, known), 1)))
            place.of(out).copy_(whole[:, :p])
            for child, rows, _ in place.children:
                borders[child] = whole[rows[:, None], rows]
        return out
