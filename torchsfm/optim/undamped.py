"""What normal equations say without damping: their inverse, and the information on some of their variables."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.linalg.semidefinite import PseudoInverse, pseudo_inverse
from torchsfm.optim.batched_cholesky import FLAT, Triangle, backward, diagonal, factor, floor, forward, place
from torchsfm.optim.normal_equations import NULL, NormalEquations, extend
from torchsfm.optim.retained_blocks import DenseMatrix
from torchsfm.optim.schur_grouped import GroupCoupling


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


def invert(system: NormalEquations, like: Inverse | None = None) -> Inverse:
    """The inverse without damping; its pseudo-inverse where a gauge is free.

    Args:
        system: At one place.
        like: For a system with exact second derivatives, the inverse of the Gauss-Newton one at the same place. What that
            leaves out is left out, and so are directions in which next to nothing of the curvature is left: there the
            minimum is not a single one (robust losses far from their centre).
    """
    size = system.layout.size
    S, triangles, determined = formed(system)
    S = S[:size, :size]
    if like is None:
        scale = system.precision.rsqrt()
        scaled = pseudo_inverse(system.without_rest(scale[:, None] * S * scale), NULL)
        kept, rank, ok = scale[:, None] * scaled.inverse * scale, scaled.rank, scaled.ok
    else:
        scale, scaled = like.scale, like.scaled
        root = scale[:, None] * scaled.root()
        values, vectors, ok = eigh(root.mT @ (S.tril() + S.tril(-1).mT) @ root)
        seen = values > FLAT
        rank, root = int(seen.sum()), torch.where(ok, root @ vectors[:, seen] * values[seen].rsqrt(), torch.inf)
        kept = root @ root.mT
    return Inverse(system, triangles, kept, rank, [known & ok for known in determined], scale, scaled)


def formed(system: NormalEquations) -> tuple[Tensor, list[Triangle], list[Tensor]]:
    """The numbers of the reduced system without damping, the factors of each family's V, and what is determined of it."""
    S = system.squares.filled(system.fronts or DenseMatrix(system.layout.size))
    triangles: list[Triangle] = []
    determined: list[Tensor] = []
    for part in system.eliminated:
        pivots = diagonal(part.V, part.q)
        L, _ = factor(part.V, part.q)
        for a in range(part.q):
            # Directions that no residual sees are left out: a basic solution.
            L[a][a] = torch.where(L[a][a] * L[a][a] * pivots[a] < 1e13, L[a][a], 0.0)
        part.reduce(S, L, torch.zeros_like(pivots))
        triangles.append(L)
        determined.append(torch.stack([L[a][a] > 0 for a in range(part.q)]).all(0))
    return S, triangles, determined


def informed(system: NormalEquations) -> Tensor:
    """The numbers of the reduced system, with eliminated variables damped too weakly to count."""
    S = system.squares.filled(system.fronts or DenseMatrix(system.layout.size))
    for part in system.eliminated:
        V, pivots = part.V.clone(), diagonal(part.V, part.q)
        V[[place(a, a, part.q) for a in range(part.q)]] += NULL * floor(pivots)
        part.reduce(S, factor(V, part.q)[0], torch.zeros_like(pivots))
    return S


def information(system: NormalEquations, columns: Tensor) -> Tensor:
    """What the problem says of some retained variables: the system left when all other variables are eliminated.

    A free gauge among the others is held by a damping too weak to count. Formed by fronts, it is not finite if they cannot
    be eliminated; the last front must have these columns.
    """
    size = system.layout.size
    S = informed(system)
    if system.fronts is not None:
        weight = NULL * system.precision
        weight[columns] = 0.0
        own = system.fronts.last(S, weight)
        order = torch.argsort(system.fronts.fronts[-1].pivots)[torch.argsort(torch.argsort(columns))]
        return S.new_full((len(columns), len(columns)), torch.nan) if own is None else own[order[:, None], order]
    S = S[:size, :size]
    S = S.tril() + S.tril(-1).mT
    system.hold(S)
    others = torch.ones(size, dtype=torch.bool, device=S.device)
    others[columns] = False
    A = S[others][:, others]
    A.diagonal().add_(NULL * system.precision[others])
    half = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(A)[0], S[others][:, columns], upper=False)
    left: Tensor = S[columns][:, columns] - half.mT @ half
    return left
