"""Damped normal equations with eliminated variables: steps, solutions for any right-hand side, inverses.

See `schur` for the notation. Eliminated blocks are factored elementwise, all at once: each entry of a factor is one long row.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.optim.batched_cholesky import Triangle, backward, diagonal, factor, floor, forward, measure, place, product
from torchsfm.optim.descent import Step
from torchsfm.optim.layout import Layout
from torchsfm.optim.retained_blocks import RetainedBlocks
from torchsfm.optim.schur_grouped import GroupCoupling
from torchsfm.optim.schur_matrix_free import Clusters, RowCoupling, solve_reduced
from torchsfm.optim.schur_pairwise import PairCoupling

NULL = 1e-11
"""Eigenvalues of the reduced system, scaled to unit diagonal of U, that count as zero: directions of gauge."""

LARGEST_BENT = 2000
"""Columns of the largest reduced system whose eigenvalues are found where it is not positive."""


@dataclass(frozen=True)
class NormalEquations:
    """`U` with the gradient, `V`, and the coupling `W`.

    `V` holds the distinct entries of the blocks row by row, each row followed by its entry of the gradient.

    Damping is measured by the Gauss-Newton matrix, that of retained variables by its diagonal (Marquardt 1963), that of
    eliminated ones by their whole blocks: each has a system of its own, so a direction in which it is hardly determined is
    damped by how little, in whatever coordinates it comes.
    """

    layout: Layout
    coupling: GroupCoupling | PairCoupling | RowCoupling | None
    squares: RetainedBlocks
    V: Tensor
    clusters: Clusters | None
    """The preconditioner's blocks where the reduced system is not formed."""
    diagonal: Tensor
    """Of the Gauss-Newton U."""
    metric: Tensor
    """The Gauss-Newton V."""
    slope: Tensor
    """The gradient by retained variables."""

    def step(self, damping: float) -> Step:
        """The step for `damping` times the diagonal.

        The promise holds for steps of conjugate gradients too: their residual is orthogonal to the step.
        """
        q = self.layout.point_size
        weight = damping * floor(self.diagonal)
        z = h = self.point_gradient()
        L: Triangle = []
        positive = torch.ones_like(self.V[:1], dtype=torch.bool)
        metric = damping * measure(self.metric, q)
        if q:
            L, positive = factor(self.V + metric, q)
            z = forward(L, h)
        kept, solved, bent = self._reduced(weight, L, z)
        promise = kept @ (weight * kept - self.slope)
        point = h
        if q:
            if self.coupling is not None:
                z = z + forward(L, self.coupling.product(extend(kept)))
            point = -backward(L, z)
            promise = promise + (point * (product(metric, point) - h)).sum()
        solved = solved & (positive.all() | (self.V is self.metric))
        return Step(self.split(kept, point), torch.where(solved, promise / 2, torch.inf), solved, torch.full_like(solved, bent))

    def _reduced(self, weight: Tensor, L: Triangle, z: Tensor) -> tuple[Tensor, Tensor, bool]:
        """The step of the retained variables, whether there is one, and whether the cost bends down along some."""
        size = self.layout.size
        if self.clusters is not None:
            assert self.coupling is None or isinstance(self.coupling, RowCoupling), "made so by Elimination"
            kept, positive = solve_reduced(self.squares, self.coupling, self.clusters, L, z, weight)
            return kept, kept.isfinite().all() & (positive | (self.V is self.metric)), False
        if not size:
            return weight, torch.ones_like(weight, dtype=torch.bool).all(), False
        S = self.squares.dense()
        S.diagonal()[:size] += weight
        if self.coupling is not None:
            assert not isinstance(self.coupling, RowCoupling), "made so by Elimination"
            self.coupling.reduce(S, L, z)
        lower, info = torch.linalg.cholesky_ex(S[:size, :size])
        if self.V is not self.metric and size <= LARGEST_BENT and bool(info):
            return *self._downhill(S[:size, :size], S[:size, size]), True
        half = torch.linalg.solve_triangular(lower, S[:size, size:][:, :1], upper=False)
        kept = -torch.linalg.solve_triangular(lower.mT, half, upper=True)[:, 0]
        return kept, (info == 0) & kept.isfinite().all(), False

    def _downhill(self, S: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """The step of the retained variables where the cost bends down in some directions: as far as were it up.

        Away from a minimum it does so along every gauge freedom, too, since no orbit but that of a shift or a scale is
        straight (saddle-free Newton steps, Dauphin et al. 2014).
        """
        scale = floor(self.diagonal).rsqrt()
        values, vectors, ok = eigh(scale[:, None] * S * scale)
        kept = -scale * (vectors @ ((vectors.mT @ (scale * slope)) / values.abs().clamp_min(NULL)))
        return kept, ok & kept.isfinite().all()

    def invert(self) -> "Inverse":
        """The inverse without damping; its pseudo-inverse where a gauge is free."""
        size, q = self.layout.size, self.layout.point_size
        S = self.squares.dense()
        L: Triangle = []
        determined = torch.ones(self.V.shape[-1], dtype=torch.bool, device=S.device)
        if q:
            pivots = diagonal(self.V, q)
            L, _ = factor(self.V, q)
            for a in range(q):
                # Directions that no residual sees are left out: a basic solution.
                L[a][a] = torch.where(L[a][a] * L[a][a] * pivots[a] < 1e13, L[a][a], 0.0)
                determined &= L[a][a] > 0
            if self.coupling is not None:
                assert not isinstance(self.coupling, RowCoupling), "asked for without conjugate gradients"
                self.coupling.reduce(S, L, torch.zeros_like(pivots))
        scale = floor(self.diagonal).rsqrt()
        values, vectors, ok = eigh(scale[:, None] * S[:size, :size] * scale)
        null = values <= NULL * values.amax(-1, keepdim=True) if size else values > 0
        inverse = torch.where(null, 0.0, 1 / torch.where(null, 1.0, values))
        vectors = scale[:, None] * vectors
        kept = torch.where(ok, (vectors * inverse) @ vectors.mT, torch.inf)
        return Inverse(self, L, kept, int(null.sum()), determined & ok)

    def information(self, columns: Tensor) -> Tensor:
        """What the problem says of some retained variables: the system left when all other variables are eliminated.

        A free gauge among the others is held by a damping too weak to count.
        """
        size, q = self.layout.size, self.layout.point_size
        S = self.squares.dense()
        if q and self.coupling is not None:
            assert not isinstance(self.coupling, RowCoupling), "asked for without conjugate gradients"
            V, pivots = self.V.clone(), diagonal(self.V, q)
            V[[place(a, a, q) for a in range(q)]] += NULL * floor(pivots)
            self.coupling.reduce(S, factor(V, q)[0], torch.zeros_like(pivots))
        S = S[:size, :size]
        S = S.tril() + S.tril(-1).mT
        others = torch.ones(size, dtype=torch.bool, device=S.device)
        others[columns] = False
        A = S[others][:, others]
        A.diagonal().add_(NULL * floor(self.diagonal[others]))
        half = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(A)[0], S[others][:, columns], upper=False)
        left: Tensor = S[columns][:, columns] - half.mT @ half
        return left

    def point_gradient(self) -> Tensor:
        """`h`, (q, points)."""
        q = self.layout.point_size
        return self.V[[place(a, q, q) for a in range(q)]]

    def gradient(self) -> Tensor:
        """Largest absolute derivative of the cost."""
        return torch.cat((self.slope, self.point_gradient().flatten())).abs().amax()

    def along(self, step: dict[str, Tensor]) -> Tensor:
        """The derivative of the cost along a step."""
        kept, point = self.join(step)
        return self.slope @ kept + (self.point_gradient() * point).sum()

    def split(self, kept: Tensor, point: Tensor) -> dict[str, Tensor]:
        """A vector of the size of the system by blocks, (free variables, tangent)."""
        layout = self.layout
        ends = [*layout.first.values(), layout.size][1:]
        found = {
            name: kept[start:end].view(layout.free[name].numel(), -1)
            for (name, start), end in zip(layout.first.items(), ends, strict=True)
        }
        if layout.eliminated is not None:
            found[layout.eliminated] = point.mT
        return found

    def join(self, parts: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The inverse of `split`."""
        kept = [parts[name].reshape(-1) for name in self.layout.first]
        empty = self.V.new_zeros(0)
        point = parts[self.layout.eliminated].mT if self.layout.eliminated is not None else self.point_gradient()
        return torch.cat((empty, *kept)), point


@dataclass(frozen=True)
class Inverse:
    """The (pseudo-)inverse of normal equations.

    With a free gauge it is the one under which retained variables move least, in units of their own precision.
    """

    system: NormalEquations
    L: Triangle
    kept: Tensor
    """The inverse of the reduced system: the covariance of the retained variables, (size, size)."""
    nullity: int
    """Dimensions of the gauge."""
    determined: Tensor
    """Which eliminated variables the residuals determine, given the others."""

    def apply(self, kept: Tensor, point: Tensor) -> tuple[Tensor, Tensor]:
        """The product with a vector, given and returned in its retained and eliminated part."""
        coupling, L = self.system.coupling, self.L
        if not L:
            return self.kept @ kept, point
        z = forward(L, point)
        if coupling is not None:
            kept = kept - coupling.lift(backward(L, z))[: kept.numel()]
        a = self.kept @ kept
        if coupling is not None:
            z = z - forward(L, coupling.product(extend(a)))
        return a, backward(L, z)

    def point_covariance(self) -> Tensor:
        """The covariance of each eliminated variable, (points, q, q)."""
        coupling, q = self.system.coupling, len(self.L)
        eye = torch.eye(q, dtype=self.kept.dtype, device=self.kept.device)
        inner = eye[:, :, None].expand(-1, -1, self.system.V.shape[-1]).clone()
        if coupling is not None:
            assert isinstance(coupling, GroupCoupling), "asked for with dense=True"
            coupling.add_spread(inner, self.L, self.kept)
        half = torch.stack([backward(self.L, inner[:, b]) for b in range(q)], 1)
        return torch.stack([backward(self.L, half[a]) for a in range(q)]).permute(2, 0, 1)


def extend(kept: Tensor) -> Tensor:
    """Zeros for the columns of the gradient and of fixed variables."""
    return torch.cat((kept, kept.new_zeros(2)))
