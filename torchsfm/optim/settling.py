"""Eliminated variables by themselves: with the retained ones held, none depends on another, and each goes where it is best.

What is then left is a function of the retained variables alone (variable projection, Golub & Pereyra 1973), in which a long
step along a curved valley of the cost (focal length against depth) stays inside (embedded point iterations, Jeong et al. 2012),
and a point that wrong data pull from one place to another does not hold back all others.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsfm.optim.batched_cholesky import backward, factor, forward, measure, place
from torchsfm.optim.layout import Layout
from torchsfm.optim.terms import Block, Term, Workspace, gather, lift_of, linearize, residual_costs, term_residual

DAMPING = 1e-10
"""Of the first step of a variable, relative to its block: so little that it may go as far as infinity;"""
RAISED, LOWERED = 1e3, 0.1
"""what it is multiplied by after one that leads up, and after one that does not."""
LONGER = 1.5
"""What steps of a variable are multiplied by, again and again, while each gains more than Gauss-Newton promises: the loss bends
down there, and plain steps would fall as a geometric series (over-relaxation)."""
PARTS = (0.25, 0.0625, 0.0)
"""Of a step that eliminated variables may take instead of a whole one that leads them up."""


@dataclass(frozen=True)
class Seen:
    """Residuals that depend on some eliminated variables."""

    term: Term
    components: int
    """Numbers in a residual."""
    point: Tensor
    """Which of these each depends on."""

    def of(self, some: Tensor, count: int) -> "Seen":
        """Those of some of the variables, which are numbered anew."""
        number = torch.full((count,), -1, device=some.device).index_copy(0, some, torch.arange(len(some), device=some.device))
        number = number[self.point]
        rows = (number >= 0).nonzero()[:, 0]
        return replace(self, term=self.term.select(rows), point=number[rows])


@dataclass(frozen=True)
class Settling:
    """The eliminated variables of a laid-out problem, with what depends on each."""

    blocks: dict[str, Block]
    layout: Layout
    seen: list[list[Seen]]
    """Of each family."""
    work: Workspace

    def settle(self, x: dict[str, Tensor], rounds: int = 1, least: Tensor | float = 0.0) -> dict[str, Tensor]:
        """`x` with every eliminated variable moved by Gauss-Newton steps of its own, or longer ones, that lower its cost.

        Args:
            x: All variables.
            rounds: Most steps of a variable.
            least: A variable rests when its last step promised no more than this.
        """
        found = dict(x)
        for family, seen in zip(self.layout.families, self.seen, strict=True):
            name, q, free = family.name, family.point_size, self.layout.free[family.name]
            columns, work, some = x[name].mT.contiguous(), self.work, torch.arange(family.points, device=free.device)
            damping, length = columns.new_full(some.shape, DAMPING), columns.new_ones(some.shape)
            cost = _costs(seen, found, len(some), work)
            for number in range(rounds):
                V = self._squares(seen, found, name, q, len(some), work)
                L, _ = factor(V + damping * measure(V, q), q)
                slope = V[[place(a, q, q) for a in range(q)]]
                step = -backward(L, forward(L, slope))
                start = gather(found[name], free[some])
                moved = self.blocks[name].retract(start, (length * step).mT)
                found[name] = columns.index_copy(1, free[some], moved.mT).mT
                after = _costs(seen, found, len(some), work)
                better = after < cost
                columns = columns.index_copy(1, free[some], torch.where(better, moved.mT, start.mT))
                found[name] = columns.mT
                promise = -(slope * step).sum(0) / 2
                going = (promise > least).nonzero()[:, 0]
                if number + 1 == rounds or not len(going):
                    break
                seen = [each.of(going, len(some)) for each in seen]
                # A plain step comes after one that was too long.
                raised = torch.where(length > 1, 1.0, RAISED)
                damping = (damping * torch.where(better, LOWERED, raised)).clamp_min(DAMPING)[going]
                length = torch.where(cost - after > promise, LONGER * length, 1.0)[going]
                cost, some = torch.where(better, after, cost)[going], some[going]
                # The problem's own keeps what it was asked for: few sizes, not ever others.
                work = Workspace(columns)
        return found

    def shorten(self, x: dict[str, Tensor], step: dict[str, Tensor], trial: dict[str, Tensor]) -> dict[str, Tensor]:
        """The `trial` that `step` leads to from `x`, where each eliminated variable takes the part of its step that is best.

        They do not depend on each other once the retained ones have moved; a few that go astray need not hold back all.
        """
        found = dict(trial)
        for family, seen in zip(self.layout.families, self.seen, strict=True):
            name, free = family.name, self.layout.free[family.name]
            start, columns = gather(x[name], free), trial[name].mT.contiguous()
            best, least = gather(trial[name], free), _costs(seen, trial, family.points, self.work)
            for share in PARTS:
                other = self.blocks[name].retract(start, share * step[name])
                cost = _costs(seen, trial | {name: columns.index_copy(1, free, other.mT).mT}, family.points, self.work)
                best = torch.where(cost < least, other.mT, best.mT).mT
                least = torch.minimum(cost, least)
            found[name] = columns.index_copy(1, free, best.mT).mT
        return found

    def _squares(self, seen: list[Seen], x: dict[str, Tensor], name: str, q: int, count: int, work: Workspace) -> Tensor:
        """The Gauss-Newton blocks of the variables, with their gradients."""
        V = work.get("settled", q * (q + 3) // 2, count).zero_()
        for each in seen:
            written = each.term.linearize is not None
            lifts = {name: None if written else lift_of(self.blocks[name], x[name])}
            P = work.get("P", each.components, q + 1, len(each.point))
            out: list[Tensor | None] = [P[:, :q].permute(2, 0, 1) if block == name else None for block in each.term.blocks]
            r, scale = linearize(each.term, x, lifts, out, work)
            P[:, q] = r.mT
            if scale is not None:
                P *= scale
            add_squares(V, P, each.point, work)
        return V


def _costs(seen: list[Seen], x: dict[str, Tensor], count: int, work: Workspace) -> Tensor:
    """The cost of the residuals of each variable, inf where it is not a number."""
    total = next(iter(x.values())).new_zeros(count)
    for each in seen:
        total.index_add_(0, each.point, residual_costs(each.term, term_residual(each.term, x, work)))
    return total.nan_to_num(nan=torch.inf)


def add_squares(V: Tensor, P: Tensor, point: Tensor, work: Workspace) -> None:
    """Add to the blocks of variables the squares of Jacobians by them, which have the residual as one more column."""
    d, columns, m = P.shape
    squares = work.get("V", V.shape[0], m)
    row = 0
    for a in range(columns - 1):
        rows = squares[row : row + columns - a]
        torch.mul(P[0, a], P[0, a:], out=rows)
        for k in range(1, d):
            rows.addcmul_(P[k, a], P[k, a:])
        row += columns - a
    V.index_add_(1, point, squares)
