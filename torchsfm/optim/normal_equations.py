"""Damped normal equations with eliminated variables: steps, solutions for any right-hand side, inverses.

See `schur` for the notation. Eliminated blocks are factored elementwise, all at once: each entry of a factor is one long row.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.linalg.semidefinite import PseudoInverse, pseudo_inverse
from torchsfm.optim.batched_cholesky import FLAT, Triangle, backward, diagonal, factor, floor, forward, measure, place, product
from torchsfm.optim.fronts import Fronts
from torchsfm.optim.layout import Family, Layout
from torchsfm.optim.problem import Step
from torchsfm.optim.retained_blocks import DenseMatrix, RetainedBlocks
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

    def step(self, damping: float) -> Step:
        """The step for `damping` times the diagonal.

        The promise holds for steps of conjugate gradients too: their residual is orthogonal to the step.
        """
        weight = damping * self.precision
        metrics = [damping * measure(part.metric, part.q) for part in self.eliminated]
        factors = [factor(part.V + metric, part.q) for part, metric in zip(self.eliminated, metrics, strict=True)]
        triangles = [L for L, _ in factors]
        right = [forward(L, part.gradient()) for part, L in zip(self.eliminated, triangles, strict=True)]
        kept, solved, bent = self._reduced(weight, triangles, right)
        promise = kept @ (weight * kept - self.slope)
        own, failed = torch.zeros_like(promise), torch.zeros_like(promise)
        points = []
        for part, metric, (L, positive), z in zip(self.eliminated, metrics, factors, right, strict=True):
            point = -backward(L, z if part.coupling is None else z + forward(L, part.coupling.product(extend(kept))))
            own = own + (point * (product(metric, point) - part.gradient())).sum()
            failed = failed + (~positive).any() * self.curved
            points.append(point)
        own, failed = self.layout.ranks.sum(torch.stack((own, failed)))
        promise, solved = promise + own, solved & (failed == 0)
        return Step(
            self.split(kept, points),
            torch.where(solved, promise / 2, torch.inf),
            solved,
            torch.full_like(solved, bent or self.held),
        )

    def _reduced(self, weight: Tensor, triangles: list[Triangle], right: list[Tensor]) -> tuple[Tensor, Tensor, bool]:
        """The step of the retained variables, whether there is one, and whether the cost bends down along some."""
        size = self.layout.size
        if self.plan is not None:
            rows = [
                (part.coupling, L, z)
                for part, L, z in zip(self.eliminated, triangles, right, strict=True)
                if isinstance(part.coupling, RowCoupling)
            ]
            kept, positive = solve_reduced(self.squares, rows, self.plan, weight, self._resting)
            return kept, kept.isfinite().all() & (positive or not self.curved), False
        if not size:
            return weight, torch.ones_like(weight, dtype=torch.bool).all(), False
        if self.fronts is not None:
            return self._by_fronts(self.fronts, weight, triangles, right)
        S = self.squares.dense()
        for part, L, z in zip(self.eliminated, triangles, right, strict=True):
            part.reduce(S, L, z)
        S = self.layout.ranks.sum(S)
        S.diagonal()[:size] += weight
        self._hold(S[:size, :size])
        lower, info = torch.linalg.cholesky_ex(S[:size, :size])
        if self.curved and size <= LARGEST_BENT and bool(info):
            return *self._downhill(S[:size, :size], S[:size, size]), True
        half = torch.linalg.solve_triangular(lower, S[:size, size:][:, :1], upper=False)
        kept = -torch.linalg.solve_triangular(lower.mT, half, upper=True)[:, 0]
        return kept, (info == 0) & kept.isfinite().all(), False

    def _by_fronts(
        self, fronts: Fronts, weight: Tensor, triangles: list[Triangle], right: list[Tensor]
    ) -> tuple[Tensor, Tensor, bool]:
        """The same where the system is formed front by front."""
        S = self.squares.filled(fronts)
        for part, L, z in zip(self.eliminated, triangles, right, strict=True):
            part.reduce(S, L, z)
        S = self.layout.ranks.sum(S)
        kept = fronts.solve(S, weight, -fronts.gradient(S), self._resting)
        if kept is None:
            return weight, torch.zeros_like(weight, dtype=torch.bool).any(), False
        return kept, kept.isfinite().all(), False

    def _hold(self, S: Tensor) -> None:
        """Make the reduced system stiff, in place, along motions of which no step has a part."""
        if (rest := self._resting) is not None:
            S += HELD * rest[1] @ rest[1].mT

    def _without_rest(self, S: Tensor) -> Tensor:
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

    def invert(self, like: "Inverse | None" = None) -> "Inverse":
        """The inverse without damping; its pseudo-inverse where a gauge is free.

        Args:
            like: For a system with exact second derivatives, the inverse of the Gauss-Newton one at the same place. What that
                leaves out is left out, and so are directions in which next to nothing of the curvature is left: there the
                minimum is not a single one (robust losses far from their centre).
        """
        size = self.layout.size
        S, triangles, determined = self.formed()
        S = S[:size, :size]
        if like is None:
            scale = self.precision.rsqrt()
            scaled = pseudo_inverse(self._without_rest(scale[:, None] * S * scale), NULL)
            kept, rank, ok = scale[:, None] * scaled.inverse * scale, scaled.rank, scaled.ok
        else:
            scale, scaled = like.scale, like.scaled
            root = scale[:, None] * scaled.root()
            values, vectors, ok = eigh(root.mT @ (S.tril() + S.tril(-1).mT) @ root)
            seen = values > FLAT
            rank, root = int(seen.sum()), torch.where(ok, root @ vectors[:, seen] * values[seen].rsqrt(), torch.inf)
            kept = root @ root.mT
        return Inverse(self, triangles, kept, rank, [known & ok for known in determined], scale, scaled)

    def formed(self) -> tuple[Tensor, list[Triangle], list[Tensor]]:
        """The numbers of the reduced system without damping, the factors of each family's V, and what is determined of it."""
        S = self.squares.filled(self.fronts or DenseMatrix(self.layout.size))
        triangles: list[Triangle] = []
        determined: list[Tensor] = []
        for part in self.eliminated:
            pivots = diagonal(part.V, part.q)
            L, _ = factor(part.V, part.q)
            for a in range(part.q):
                # Directions that no residual sees are left out: a basic solution.
                L[a][a] = torch.where(L[a][a] * L[a][a] * pivots[a] < 1e13, L[a][a], 0.0)
            part.reduce(S, L, torch.zeros_like(pivots))
            triangles.append(L)
            determined.append(torch.stack([L[a][a] > 0 for a in range(part.q)]).all(0))
        return S, triangles, determined

    def informed(self) -> Tensor:
        """The numbers of the reduced system, with eliminated variables damped too weakly to count."""
        S = self.squares.filled(self.fronts or DenseMatrix(self.layout.size))
        for part in self.eliminated:
            V, pivots = part.V.clone(), diagonal(part.V, part.q)
            V[[place(a, a, part.q) for a in range(part.q)]] += NULL * floor(pivots)
            part.reduce(S, factor(V, part.q)[0], torch.zeros_like(pivots))
        return S

    def information(self, columns: Tensor) -> Tensor:
        """What the problem says of some retained variables: the system left when all other variables are eliminated.

        A free gauge among the others is held by a damping too weak to count. Formed by fronts, it is not finite if they cannot
        be eliminated; the last front must have these columns.
        """
        size = self.layout.size
        S = self.informed()
        if self.fronts is not None:
            weight = NULL * self.precision
            weight[columns] = 0.0
            own = self.fronts.last(S, weight)
            order = torch.argsort(self.fronts.fronts[-1].pivots)[torch.argsort(torch.argsort(columns))]
            return S.new_full((len(columns), len(columns)), torch.nan) if own is None else own[order[:, None], order]
        S = S[:size, :size]
        S = S.tril() + S.tril(-1).mT
        self._hold(S)
        others = torch.ones(size, dtype=torch.bool, device=S.device)
        others[columns] = False
        A = S[others][:, others]
        A.diagonal().add_(NULL * self.precision[others])
        half = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(A)[0], S[others][:, columns], upper=False)
        left: Tensor = S[columns][:, columns] - half.mT @ half
        return left

    def gradient(self) -> Tensor:
        """The largest absolute derivative of the cost, each in units of its variable's own precision."""
        kept = self.slope
        if (rest := self._resting) is not None:
            kept = kept - rest[1] @ (rest[0].mT @ kept)
        scaled = [kept * self.precision.rsqrt()]
        for part in self.eliminated:
            scaled.append((part.gradient() * floor(diagonal(part.metric, part.q)).rsqrt()).flatten())
        return self.layout.ranks.largest(torch.cat(scaled).abs().amax())

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


@dataclass(frozen=True)
class Inverse:
    """The (pseudo-)inverse of normal equations.

    With a free gauge it is the one under which retained variables move least, in units of their own precision.
    """

    system: NormalEquations
    triangles: list[Triangle]
    """The factors of each family's V."""
    kept: Tensor
    """The inverse of the reduced system: the covariance of the retained variables, (size, size)."""
    rank: int
    determined: list[Tensor]
    """Which eliminated variables of each family the residuals determine, given the others."""
    scale: Tensor
    """Units of the retained variables,"""
    scaled: PseudoInverse
    """and the inverse in these of the Gauss-Newton system."""

    def apply(self, kept: Tensor, points: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """The product with a vector, given and returned in its retained and eliminated parts."""
        parts = list(zip(self.system.eliminated, self.triangles, strict=True))
        inner = [forward(L, point) for (_, L), point in zip(parts, points, strict=True)]
        for (part, L), z in zip(parts, inner, strict=True):
            if part.coupling is not None:
                kept = kept - part.coupling.lift(backward(L, z))[: kept.numel()]
        a = self.kept @ kept
        found = []
        for (part, L), z in zip(parts, inner, strict=True):
            found.append(backward(L, z if part.coupling is None else z - forward(L, part.coupling.product(extend(a)))))
        return a, found

    def point_covariances(self) -> list[Tensor]:
        """The covariance of each eliminated variable of each family, (points, q, q)."""
        found = []
        for part, L in zip(self.system.eliminated, self.triangles, strict=True):
            eye = torch.eye(part.q, dtype=self.kept.dtype, device=self.kept.device)
            inner = eye[:, :, None].expand(-1, -1, part.family.points).clone()
            if part.coupling is not None:
                assert isinstance(part.coupling, GroupCoupling), "asked for with spread=True"
                part.coupling.add_spread(inner, L, self.kept)
            half = torch.stack([backward(L, inner[:, b]) for b in range(part.q)], 1)
            found.append(torch.stack([backward(L, half[a]) for a in range(part.q)]).permute(2, 0, 1))
        return found


def extend(kept: Tensor) -> Tensor:
    """Zeros for the columns of the gradient and of fixed variables."""
    return torch.cat((kept, kept.new_zeros(2)))
