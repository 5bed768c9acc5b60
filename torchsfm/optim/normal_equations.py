"""Damped normal equations with eliminated variables: steps, and solutions for any right-hand side.

See `schur` for the notation. Eliminated blocks are factored elementwise, all at once: each entry of a factor is one long row.
"""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.optim.batched_cholesky import Triangle, backward, diagonal, factor, floor, forward, measure, place, product
from torchsfm.optim.fronts import Fronts
from torchsfm.optim.layout import Family, Layout
from torchsfm.optim.problem import Step
from torchsfm.optim.retained_blocks import RetainedBlocks
from torchsfm.optim.schur_grouped import GroupCoupling
from torchsfm.optim.schur_matrix_free import Plan, RowCoupling, solve_reduced
from torchsfm.optim.schur_pairwise import PairCoupling

NULL = 1e-11
"""Eigenvalues of the reduced system, scaled to unit diagonal of U, that count as zero: directions of gauge."""

HELD = 1e6
"""Stiffness, scaled likewise, along motions of which no step has a part."""

LARGEST_BENT = 500
"""Columns of the largest reduced system whose eigenvalues are found where it is not positive."""


@dataclass(frozen=True)
class Eliminated:
    """What belongs to one family of eliminated variables: `V` with the gradient, and the coupling `W`.

    `V` holds the distinct entries of the blocks row by row, each row followed by its entry of the gradient.
    """

    family: Family
    coupling: GroupCoupling | PairCoupling | RowCoupling | None
    V: Tensor
    metric: Tensor
    """The Gauss-Newton V."""

    @property
    def q(self) -> int:
        """Tangent coordinates of a variable."""
        return self.family.point_size

    def gradient(self) -> Tensor:
        """`h`, (q, points)."""
        return self.V[[place(a, self.q, self.q) for a in range(self.q)]]

    def reduce(self, S: Tensor, L: Triangle, z: Tensor) -> None:
        """Take what the family says of retained variables off the reduced system."""
        if self.coupling is not None:
            assert not isinstance(self.coupling, RowCoupling), "asked for without conjugate gradients"
            self.coupling.reduce(S, L, z)


@dataclass(frozen=True)
class Factors:
    """Of a damped system: those of each family's V, and that of the reduced system, dense."""

    triangles: list[Triangle]
    lower: Tensor


@dataclass(frozen=True)
class NormalEquations:
    """`U` with the gradient, and the families of eliminated variables.

    Damping is measured by the Gauss-Newton matrix, that of retained variables by its diagonal (Marquardt 1963), that of
    eliminated ones by their whole blocks: each has a system of its own, so a direction in which it is hardly determined is
    damped by how little, in whatever coordinates it comes.
    """

    layout: Layout
    eliminated: list[Eliminated]
    squares: RetainedBlocks
    plan: Plan | None
    """How to precondition where the reduced system is not formed."""
    fronts: Fronts | None
    """Where it is formed, and is not dense."""
    diagonal: Tensor
    """Of the Gauss-Newton U."""
    slope: Tensor
    """The gradient by retained variables."""
    curved: bool = False
    """Whether second derivatives are exact, so that it need not be positive."""
    held: bool = False
    """Whether eliminated variables are held that have something left to gain."""
    rest: Tensor | None = None
    """Motions of the retained variables, (size, k), of which no step has a part."""
    last: list[Factors] = field(default_factory=list)
    """Those of the last step, if one process factored a dense system for it."""

    def step(self, damping: float) -> Step:
        """The step for `damping` times the diagonal.

        The promise holds for steps of conjugate gradients too: their residual is orthogonal to the step.
        """
        self.last.clear()
        weight = damping * self.precision
        metrics = [damping * measure(part.metric, part.q) for part in self.eliminated]
        factors = [factor(part.V + metric, part.q) for part, metric in zip(self.eliminated, metrics, strict=True)]
        triangles = [L for L, _ in factors]
        right = [forward(L, part.gradient()) for part, L in zip(self.eliminated, triangles, strict=True)]
        kept, solved, bent, partial = self._reduced(weight, triangles, right)
        promise = kept @ (weight * kept - self.slope)
        own, failed = torch.zeros_like(promise), torch.zeros_like(promise)
        points = []
        for part, metric, (L, positive), z in zip(self.eliminated, metrics, factors, right, strict=True):
            point = -backward(L, z if part.coupling is None else z + forward(L, part.coupling.product(extend(kept))))
            own = own + (point * (product(metric, point) - part.gradient())).sum()
            failed = failed + (~positive).any() * self.curved
            points.append(point)
        if self.layout.eliminates:
            own, failed = self.layout.ranks.sum(torch.stack((own, failed)))
        promise, solved = promise + own, solved & (failed == 0)
        return Step(
            self.split(kept, points),
            torch.where(solved, promise / 2, torch.inf),
            solved,
            torch.full_like(solved, bent or self.held),
            torch.full_like(solved, partial),
        )

    def _reduced(self, weight: Tensor, triangles: list[Triangle], right: list[Tensor]) -> tuple[Tensor, Tensor, bool, bool]:
        """The step of the retained variables, if there is one; whether the cost bends down; whether the step is partial."""
        size = self.layout.size
        if self.plan is not None:
            rows = [
                (part.coupling, L, z)
                for part, L, z in zip(self.eliminated, triangles, right, strict=True)
                if isinstance(part.coupling, RowCoupling)
            ]
            kept, positive, exact = solve_reduced(self.squares, rows, self.plan, weight, self._resting)
            return kept, kept.isfinite().all() & (positive or not self.curved), False, not exact
        if not size:
            return weight, torch.ones_like(weight, dtype=torch.bool).all(), False, False
        if self.fronts is not None:
            return *self._by_fronts(self.fronts, weight, triangles, right), False, False
        S = self.squares.dense()
        for part, L, z in zip(self.eliminated, triangles, right, strict=True):
            part.reduce(S, L, z)
        ranks = self.layout.ranks
        S = ranks.sum_first(S)
        if ranks.size == 1:
            kept, solved, bent, lower = self._by_square(S, weight)
            if lower is not None:
                self.last.append(Factors(triangles, lower))
            return kept, solved, bent, False
        found = torch.nn.functional.pad(weight, (0, 2))
        if not ranks.rank:
            kept, solved, bent, _ = self._by_square(S, weight)
            found = torch.cat((kept, torch.stack((solved, torch.full_like(solved, bent)))))
        found = ranks.spread(found)
        return found[:size], found[size] > 0, bool(found[size + 1]), False

    def _by_square(self, S: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, bool, Tensor | None]:
        """The step of the retained variables, if there is one, whether the cost bends down, and the dense system's factor."""
        size = len(weight)
        S.diagonal()[:size] += weight
        self.hold(S[:size, :size])
        lower, info = torch.linalg.cholesky_ex(S[:size, :size])
        if self.curved and size <= LARGEST_BENT and bool(info):
            return *self._downhill(S[:size, :size], S[:size, size]), True, None
        half = torch.linalg.solve_triangular(lower, S[:size, size:][:, :1], upper=False)
        kept = -torch.linalg.solve_triangular(lower.mT, half, upper=True)[:, 0]
        return kept, (info == 0) & kept.isfinite().all(), False, lower

    def again(self, other: "NormalEquations") -> dict[str, Tensor] | None:
        """The last step as it were with the gradient of another system, by its factors; None where there are none."""
        if not self.last:
            return None
        (factors,) = self.last
        kept, halves = other.slope, []
        for part, given, L in zip(self.eliminated, other.eliminated, factors.triangles, strict=True):
            halves.append(forward(L, given.gradient()))
            if part.coupling is not None:
                kept = kept - part.coupling.lift(backward(L, halves[-1]))[: len(kept)]
        kept = -torch.cholesky_solve(kept[:, None], factors.lower)[:, 0]
        points = []
        for part, L, z in zip(self.eliminated, factors.triangles, halves, strict=True):
            points.append(-backward(L, z if part.coupling is None else z + forward(L, part.coupling.product(extend(kept)))))
        return self.split(kept, points)

    def _by_fronts(
        self, fronts: Fronts, weight: Tensor, triangles: list[Triangle], right: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """The step of the retained variables, and whether there is one, where the system is formed front by front."""
        S = self.squares.filled(fronts)
        for part, L, z in zip(self.eliminated, triangles, right, strict=True):
            part.reduce(S, L, z)
        ranks = self.layout.ranks
        S = ranks.sum_first(S)
        found = None if ranks.rank else fronts.solve(S, weight, -fronts.gradient(S), self._resting)
        kept = ranks.spread(torch.full_like(weight, torch.nan) if found is None else found)
        solved = kept.isfinite().all()
        return torch.where(solved, kept, weight), solved

    def hold(self, S: Tensor) -> None:
        """Make the reduced system stiff, in place, along motions of which no step has a part."""
        if (rest := self._resting) is not None:
            S += HELD * rest[1] @ rest[1].mT

    def without_rest(self, S: Tensor) -> Tensor:
        """The reduced system, variables in units of their own precision, as if nothing were known of motions at rest."""
        if self._resting is None:
            return S
        basis = self._resting[1] * self.precision.rsqrt()[:, None]
        S = S.tril() + S.tril(-1).mT
        S = S - basis @ (basis.mT @ S)
        return S - (S @ basis) @ basis.mT

    @cached_property
    def precision(self) -> Tensor:
        """Of each retained variable, the others held: what its damping is measured by."""
        return floor(self.diagonal, self.layout.kinds)

    @cached_property
    def _resting(self) -> tuple[Tensor, Tensor] | None:
        """A basis E of motions at rest, and F with `F'E = 1`; orthonormal with variables in units of their own precision."""
        if self.rest is None:
            return None
        root = self.precision.sqrt()[:, None]
        moves = root * self.rest
        moves = moves / torch.linalg.vector_norm(moves, dim=0).clamp_min(torch.finfo(moves.dtype).tiny)
        values, vectors, _ = eigh(moves.mT @ moves)
        seen = values > NULL
        basis = moves @ (vectors[:, seen] * values[seen].rsqrt())
        return basis / root, basis * root

    def _downhill(self, S: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """The step of the retained variables where the cost bends down in some directions: as far as were it up.

        Away from a minimum it does so along every gauge freedom, too, since no orbit but that of a shift or a scale is
        straight (saddle-free Newton steps, Dauphin et al. 2014).
        """
        scale = self.precision.rsqrt()
        values, vectors, ok = eigh(scale[:, None] * S * scale)
        kept = -scale * (vectors @ ((vectors.mT @ (scale * slope)) / values.abs().clamp_min(NULL)))
        return kept, ok & kept.isfinite().all()

    def gradient(self) -> Tensor:
        """The largest absolute derivative of the cost, each in units of its variable's own precision."""
        kept = self.slope
        if (rest := self._resting) is not None:
            kept = kept - rest[1] @ (rest[0].mT @ kept)
        scaled = [kept * self.precision.rsqrt()]
        for part in self.eliminated:
            scaled.append((part.gradient() * floor(diagonal(part.metric, part.q)).rsqrt()).flatten())
        steepest = torch.cat(scaled).abs().amax()
        return self.layout.ranks.largest(steepest) if self.layout.eliminates else steepest

    def along(self, step: dict[str, Tensor]) -> Tensor:
        """The derivative of the cost along a step."""
        kept, points = self.join(step)
        slope = self.slope @ kept
        own = torch.zeros_like(slope)
        for part, point in zip(self.eliminated, points, strict=True):
            own = own + (part.gradient() * point).sum()
        return slope + self.layout.ranks.sum(own)

    def split(self, kept: Tensor, points: list[Tensor]) -> dict[str, Tensor]:
        """A vector of the size of the system by blocks, (free variables, tangent)."""
        layout = self.layout
        ends = [*layout.first.values(), layout.size][1:]
        found = {
            name: kept[start:end].view(layout.free[name].numel(), -1)
            for (name, start), end in zip(layout.first.items(), ends, strict=True)
        }
        return found | {part.family.name: point.mT for part, point in zip(self.eliminated, points, strict=True)}

    def join(self, parts: dict[str, Tensor]) -> tuple[Tensor, list[Tensor]]:
        """The inverse of `split`."""
        kept = [parts[name].reshape(-1) for name in self.layout.first]
        return torch.cat((self.slope[:0], *kept)), [parts[part.family.name].mT for part in self.eliminated]


def extend(kept: Tensor) -> Tensor:
    """Zeros for the columns of the gradient and of fixed variables."""
    return torch.cat((kept, kept.new_zeros(2)))
