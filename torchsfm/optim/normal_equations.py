"""Damped normal equations with eliminated variables: steps, solutions for any right-hand side, inverses.

See `schur` for the notation. Eliminated blocks are factored elementwise, all at once: each entry of a factor is one long row.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.optim.coupling_groups import GroupCoupling
from torchsfm.optim.coupling_pairs import PairCoupling
from torchsfm.optim.layout import Layout

Triangle = list[list[Tensor]]
"""Lower triangular factors of all eliminated blocks, entry by entry, with the reciprocals of the diagonal in its place."""
NULL = 1e-11
"""Eigenvalues of the reduced system, scaled to unit diagonal of U, that count as zero: directions of gauge."""


@dataclass(frozen=True)
class NormalEquations:
    """`U` with the gradient as column `size`, `V`, and the coupling `W`.

    `V` holds the distinct entries of the blocks row by row, each row followed by its entry of the gradient.
    """

    layout: Layout
    coupling: GroupCoupling | PairCoupling | None
    U: Tensor
    V: Tensor

    def step(self, damping: float) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """The step for `damping` times the diagonal, the decrease the model promises, and whether the system was solved."""
        size, q = self.layout.size, self.layout.point_size
        weight = damping * _floor(self.U.diagonal()[:size])
        S, right = self.U.clone(), self.U[:size, size].clone()
        S.diagonal()[:size] += weight
        h = self.point_gradient()
        point_weight, z = h, h
        L: Triangle = []
        if q:
            point_weight = damping * _floor(self.V[[_place(a, a, q) for a in range(q)]])
            L = factor(self.V, point_weight, q)
            z = forward(L, h)
            if self.coupling is not None:
                right -= self.coupling.reduce(S, L, z)[:size]
        lower, info = torch.linalg.cholesky_ex(S[:size, :size])
        kept = -torch.cholesky_solve(right[:, None], lower)[:, 0] if size else right
        solved = (info == 0) & kept.isfinite().all()
        promise = kept @ (weight * kept - self.U[:size, size])
        point = h
        if q:
            if self.coupling is not None:
                z = z + forward(L, self.coupling.product(extend(kept)))
            point = -backward(L, z)
            promise = promise + (point * (point_weight * point - h)).sum()
        return self.split(kept, point), promise / 2, solved

    def invert(self) -> "Inverse":
        """The inverse without damping; its pseudo-inverse where a gauge is free."""
        size, q = self.layout.size, self.layout.point_size
        S = self.U.clone()
        L: Triangle = []
        determined = torch.ones(self.V.shape[-1], dtype=torch.bool, device=S.device)
        if q:
            diagonal = self.V[[_place(a, a, q) for a in range(q)]]
            L = factor(self.V, torch.zeros_like(diagonal), q)
            for a in range(q):
                # Directions that no residual sees are left out: a basic solution.
                L[a][a] = torch.where(L[a][a] * L[a][a] * diagonal[a] < 1e13, L[a][a], 0.0)
                determined &= L[a][a] > 0
            if self.coupling is not None:
                self.coupling.reduce(S, L, torch.zeros_like(diagonal))
        scale = _floor(self.U.diagonal()[:size]).rsqrt()
        values, vectors = torch.linalg.eigh(scale[:, None] * S[:size, :size] * scale)
        null = values <= NULL * values.amax(-1, keepdim=True) if size else values > 0
        inverse = torch.where(null, 0.0, 1 / torch.where(null, 1.0, values))
        vectors = scale[:, None] * vectors
        return Inverse(self, L, (vectors * inverse) @ vectors.mT, int(null.sum()), determined)

    def point_gradient(self) -> Tensor:
        """`h`, (q, points)."""
        q = self.layout.point_size
        return self.V[[_place(a, q, q) for a in range(q)]]

    def gradient(self) -> Tensor:
        """Largest absolute derivative of the cost."""
        size = self.layout.size
        return torch.cat((self.U[:size, size], self.point_gradient().flatten())).abs().amax()

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
        empty = self.U.new_zeros(0)
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


def _place(a: int, b: int, q: int) -> int:
    """Row of V that holds entry (a, b >= a) of the blocks; b = q is the gradient."""
    return a * (q + 1) - a * (a - 1) // 2 + b - a


def _floor(diagonal: Tensor) -> Tensor:
    """A variable that nothing depends on in some direction gets a damping of its own, and does not move."""
    if diagonal.numel() == 0:
        return diagonal
    least = 1e-12 * diagonal.amax(0, keepdim=True)
    return torch.where(least > 0, torch.maximum(diagonal, least), torch.ones_like(diagonal))


def factor(V: Tensor, damping: Tensor, q: int) -> Triangle:
    """Cholesky factors of all point blocks, elementwise, with the reciprocals of the diagonal in its place."""
    L: Triangle = []
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


def forward(L: Triangle, z: Tensor) -> Tensor:
    """`L^-1 z`."""
    rows: list[Tensor] = []
    for a, value in enumerate(z.unbind(0)):
        for b in range(a):
            value = value - L[a][b] * rows[b]
        rows.append(value * L[a][a])
    return torch.stack(rows)


def backward(L: Triangle, z: Tensor) -> Tensor:
    """`L'^-1 z`."""
    q = len(L)
    rows: list[Tensor] = [z[0]] * q
    for a in reversed(range(q)):
        value = z[a]
        for b in range(a + 1, q):
            value = value - L[b][a] * rows[b]
        rows[a] = value * L[a][a]
    return torch.stack(rows)
