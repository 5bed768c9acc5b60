"""The Schur complement: normal equations in which families of variables are eliminated, each variable by itself.

With the eliminated variables (points, for short) last, the normal equations of a problem of terms are

    [ U   W ] [ a ]     [ g ]
    [ W'  V ] [ b ] = - [ h ],    V block diagonal,

and `S = U - W V^-1 W'` is a system in the retained variables alone (Brown 1958; Triggs et al. 2000, 6.1; HZ A6.3). Points and
lines are families with blocks V of 3 and of 4 columns: what each takes off U is a sum over its own variables.
Work comes in three tiers: once per problem (`layout`: who meets whom), once per linearisation (`Elimination.linearize`), once
per damping (`NormalEquations.step`), so that a rejected step costs only the last.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from torchsfm.optim.batched_cholesky import FLAT, hold, place
from torchsfm.optim.curvature import curvature
from torchsfm.optim.fronts import Fronts
from torchsfm.optim.layout import CHUNK, Layout, Piece
from torchsfm.optim.multigrid import PairGraph
from torchsfm.optim.normal_equations import Eliminated, NormalEquations
from torchsfm.optim.retained_blocks import RetainedBlocks, Runs, find_runs
from torchsfm.optim.schur_grouped import GroupCoupling, plan_groups
from torchsfm.optim.schur_matrix_free import Plan, RowCoupling, find_clusters
from torchsfm.optim.schur_pairwise import PairCoupling, estimate_pairs
from torchsfm.optim.settling import Seen, Settling, add_squares
from torchsfm.optim.solver_choice import Solver, plan_fronts, too_large
from torchsfm.optim.terms import (
    Block,
    Term,
    Workspace,
    gather,
    lift_of,
    linearize,
    term_cost,
    term_residual,
)

ALONG = 0.1
"""Part of a step by which residuals are moved both ways for their second derivative along it."""
BENT = 1e-3
"""Eliminated variables are held along directions in which they have no more than this part of the Gauss-Newton curvature."""


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
    runs: Runs
    family: int | None
    """The place of its eliminated variables' family in the layout."""
    point: Tensor | None


class Elimination:
    """Normal equations of a laid-out problem, linearised at one place at a time."""

    def __init__(
        self,
        blocks: dict[str, Block],
        layout: Layout,
        solver: Solver = "auto",
        *,
        spread: bool = False,
        fronts: Fronts | None = None,
        like: "Elimination | None" = None,
    ) -> None:
        """Plan what is done once per problem.

        Args:
            blocks: The variables.
            layout: Who meets whom.
            solver: How the reduced system is solved.
            spread: Whether covariances of eliminated variables will be asked for.
            fronts: A plan for the solver "sparse", if there is one already.
            like: Another one of the same problem and solver, whose plans will do.
        """
        self.blocks = blocks
        self.layout = layout
        x = {name: b.x for name, b in blocks.items()}
        numbers = {family.name: k for k, family in enumerate(layout.families)}
        self.parts = [part for k, piece in enumerate(layout.pieces) for part in _parts(k, piece, x, numbers)]
        some = next(iter(blocks.values())).x
        self.squares = RetainedBlocks(layout, some)
        self.work = Workspace(some)
        seen = [
            [Seen(p.term, p.components, p.point) for p in self.parts if p.family == k and p.point is not None]
            for k in range(len(layout.families))
        ]
        self.settling = Settling(blocks, layout, seen, self.work)
        self.plan: Plan | None = None
        self.eliminated: list[Eliminated] = []
        self.current: NormalEquations | None = None
        """What the memory holds."""
        self._second: Elimination | None = None
        self.ranks = layout.ranks
        self.fronts: Fronts | None = like.fronts if like is not None else fronts or plan_fronts(layout, solver)
        iterative = solver == "pcg" or (solver == "auto" and self.fronts is None and too_large(layout))
        for k, family in enumerate(layout.families):
            V = some.new_empty((family.point_size * (family.point_size + 3) // 2, family.points))
            coupling: GroupCoupling | PairCoupling | RowCoupling | None = None
            if not any(piece.coupled for piece in family.pieces):
                pass
            elif iterative:
                coupling = RowCoupling(family, some)
            elif self.fronts is not None:
                coupling = PairCoupling(family, some, self.fronts, _pairs_of(like, k))
            else:
                spans, seconds = plan_groups(family)
                grouped = spread or seconds <= estimate_pairs(family)
                if grouped:
                    coupling = GroupCoupling(family, spans, some)
                else:
                    coupling = PairCoupling(family, some, None, _pairs_of(like, k))
            self.eliminated.append(Eliminated(family, coupling, V, V))
        if iterative:
            rows = [part.coupling for part in self.eliminated if isinstance(part.coupling, RowCoupling)]
            self.plan = PairGraph.of(layout) or find_clusters(layout, rows)

    def curve(self, x: dict[str, Tensor], system: NormalEquations, *, minimum: bool = False) -> NormalEquations:
        """The system at `x` with exact second derivatives, in memory of its own; damped and sloped as the one given.

        An eliminated variable between two minima of its own is held along the way from one to the other, and may settle by
        itself afterwards: its step would be long, and take the others along. At a `minimum` it is held where the cost is
        flat. The system holds until the next call.
        """
        exact = self._other()
        exact._clear()
        for part in exact.parts:
            exact._add_curvature(part, x)
        for mine, other in zip(exact.squares.values, system.squares.values, strict=True):
            mine[:, -1], mine[:, :, -1] = other[:, -1], other[:, :, -1]
        eliminated, bent = [], [torch.zeros_like(system.slope.sum(), dtype=torch.bool)]
        for own, given in zip(exact.eliminated, system.eliminated, strict=True):
            q = own.q
            for a in range(q):
                own.V[place(a, q, q)] = given.V[place(a, q, q)]
            bent.append(hold(own.V, given.V, q, FLAT if minimum else BENT).any())
            eliminated.append(replace(own, metric=given.V))
        held = bool(self.ranks.any(torch.stack(bent).any()))
        return replace(system, eliminated=eliminated, squares=exact.squares, curved=True, held=held, last=[])

    def accelerate(
        self, x: dict[str, Tensor], step: dict[str, Tensor], damping: float, system: NormalEquations
    ) -> dict[str, Tensor]:
        """What the last step of the system at `x` lacks to follow a valley of the cost that is curved.

        Half the step that the residuals' second derivatives along the given one ask for in the same damped system (geodesic
        acceleration, Transtrum & Sethna 2012). What `curve` gave is overwritten.
        """
        ends = [
            move(self.blocks, self.layout, x, {name: part * delta for name, delta in step.items()}) for part in (ALONG, -ALONG)
        ]
        other = self._other().linearize(x, ends)
        # The matrices are the same, and need not be factored twice.
        bent: dict[str, Tensor] = system.again(other) or other.step(damping).delta
        return {name: delta / 2 for name, delta in bent.items()}

    def _other(self) -> "Elimination":
        """Memory for a second system."""
        if self._second is None:
            self._second = Elimination(self.blocks, self.layout, "dense" if self.plan is None else "pcg", like=self)
        return self._second

    def _clear(self) -> None:
        """Start a linearisation."""
        self.squares.clear()
        for part in self.eliminated:
            part.V.zero_()
            if part.coupling is not None:
                part.coupling.clear()

    def _add_curvature(self, part: _Part, x: dict[str, Tensor]) -> None:
        """Add a part's exact second derivatives to the system."""
        starts = part.runs.starts
        run = torch.arange(len(starts), device=starts.device).repeat_interleave(part.runs.lengths)
        family = None if part.family is None else self.eliminated[part.family]
        name = None if family is None else family.family.name
        U, W, V = curvature(part.term, x, self.blocks, part.wanted, name, (run, starts))
        if part.width:
            self.squares.values[part.piece][:, :-1, :-1].index_add_(0, part.runs.slots, U.permute(2, 0, 1))
        if family is None or part.point is None:
            return
        q = len(V)
        for a in range(q):
            family.V[place(a, a, q) : place(a, q, q)].index_add_(1, part.point, V[a, a:])
        if part.width and family.coupling is not None:
            eye = torch.eye(q, dtype=V.dtype, device=V.device)[:, :, None].expand(-1, -1, V.shape[2])
            family.coupling.add(part.piece, part.start, W.transpose(0, 1), eye)

    def cost(self, x: dict[str, Tensor]) -> Tensor:
        """The cost of all residuals that depend on something free."""
        costs = [term_cost(part.term, term_residual(part.term, x, self.work)) for part in self.parts]
        return self.ranks.sum(torch.stack(costs).sum() if costs else next(iter(x.values())).new_zeros(()))

    def linearize(self, x: dict[str, Tensor], ends: Sequence[dict[str, Tensor]] | None = None) -> "NormalEquations":
        """The blocks of the normal equations at `x`; they are overwritten by the next call.

        With two `ends` on either side of `x`, second derivatives of the residuals towards these stand for the residuals.
        """
        self.current = None
        lifts = self._lifts(x)
        self._clear()
        for part in self.parts:
            self._add(part, x, lifts, ends)
        diagonal, slope = self.ranks.sum(torch.stack((self.squares.diagonal(), self.squares.gradient())))
        self.current = NormalEquations(
            self.layout, self.eliminated, self.squares, self.plan, self.fronts, diagonal, slope, rest=self._rest(x)
        )
        return self.current

    def _rest(self, x: dict[str, Tensor]) -> Tensor | None:
        """The motions of retained variables of which steps have no part, (size, k)."""
        found = []
        for name, start in self.layout.first.items():
            rest = self.blocks[name].rest
            if rest is not None:
                moves = rest(x[name])[self.layout.free[name]].flatten(0, 1)
                end = self.layout.size - start - len(moves)
                found.append(torch.nn.functional.pad(moves, (0, 0, start, end)))
        return torch.cat(found, 1) if found else None

    def _lifts(self, x: dict[str, Tensor]) -> dict[str, Tensor | None]:
        """Derivatives of the retractions that derivatives of terms are multiplied by."""
        needed = {
            name
            for part in self.parts
            if part.term.linearize is None
            for name, w in zip(part.term.blocks, part.wanted, strict=True)
            if w
        }
        return {name: lift_of(b, x[name]) if name in needed else None for name, b in self.blocks.items()}

    def _add(
        self,
        part: _Part,
        x: dict[str, Tensor],
        lifts: dict[str, Tensor | None],
        ends: Sequence[dict[str, Tensor]] | None,
    ) -> None:
        """Add squares and products of a part's Jacobians to the system."""
        family = None if part.family is None else self.eliminated[part.family]
        q, c, d, m = 0 if family is None else family.q, part.width, part.components, part.term.index[0].shape[0]
        # Both with the residual as one more column, which gives the gradients.
        J, P = self.work.get("J", d, c + 1, m), self.work.get("P", d, q + 1, m)
        out: list[Tensor | None] = []
        start = 0
        for name, wanted in zip(part.term.blocks, part.wanted, strict=True):
            if not wanted:
                out.append(None)
            elif family is not None and name == family.family.name:
                out.append(P[:, :q].permute(2, 0, 1))
            else:
                end = start + self.blocks[name].tangent
                out.append(J[:, start:end].permute(2, 0, 1))
                start = end
        r, scale = linearize(part.term, x, lifts, out, self.work)
        if ends is not None:
            r = _bending(part.term, x, ends)
        J[:, c] = r.mT
        if scale is not None:
            J *= scale
        if c:
            self.squares.values[part.piece].index_add_(0, part.runs.slots, part.runs.squares(J))
        if family is None or part.point is None:
            return
        if scale is not None:
            P[:, :q] *= scale
        P[:, q] = J[:, c]
        add_squares(family.V, P, part.point, self.work)
        if c and family.coupling is not None:
            family.coupling.add(part.piece, part.start, J[:, :c], P[:, :q])


def _pairs_of(like: Elimination | None, family: int) -> PairCoupling | None:
    """What is planned already for a family."""
    coupling = None if like is None else like.eliminated[family].coupling
    return coupling if isinstance(coupling, PairCoupling) else None


def _bending(term: Term, x: dict[str, Tensor], ends: Sequence[dict[str, Tensor]]) -> Tensor:
    """Second derivatives of the residuals towards the ends; 0 where one of these is out of reach."""
    after, before = (term_residual(term, end) for end in ends)
    return ((after - 2 * term_residual(term, x) + before) / ALONG**2).nan_to_num(0.0, 0.0, 0.0)


def _parts(number: int, piece: Piece, x: dict[str, Tensor], families: dict[str, int]) -> list[_Part]:
    """Cut a piece where the residuals linearised at once become too many."""
    m, width = piece.slots.numel(), piece.columns.shape[1]
    parts = []
    components = term_residual(piece.term.select(piece.slots[:1] * 0), x).shape[1]
    for first, last in pairwise([*range(0, m, CHUNK), m]):
        rows = slice(first, last)
        term = replace(
            piece.term,
            index=tuple(i[rows] for i in piece.term.index),
            data=tuple(d[rows] for d in piece.term.data),
            weights=None if piece.term.weights is None else piece.term.weights[rows],
        )
        point = None if piece.point is None else piece.point[rows]
        runs = find_runs(piece.slots[rows])
        family = None if piece.family is None else families[piece.family]
        parts.append(_Part(number, first, term, piece.wanted, width, components, runs, family, point))
    return parts


def move(blocks: dict[str, Block], layout: Layout, x: dict[str, Tensor], step: dict[str, Tensor]) -> dict[str, Tensor]:
    """All variables after a step; those not free keep every bit."""
    moved = dict(x)
    for name, delta in step.items():
        index = layout.free[name]
        columns = blocks[name].retract(gather(x[name], index), delta).mT
        moved[name] = x[name].mT.contiguous().index_copy(1, index, columns).mT
    return moved
