"""Epipoles from conics alone: where the tangents to all conics have the same invariants in both images."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg import adjugate_3x3, cross, null_vector
from torchsfm.optim import levenberg_marquardt


@dataclass(frozen=True)
class _Epipoles:
    """Unit vectors."""

    e1: Float[Tensor, "*batch 3"]
    e2: Float[Tensor, "*batch 3"]

    def moved(self, delta: Float[Tensor, "*batch 4"]) -> "_Epipoles":
        moved = []
        for e, d in ((self.e1, delta[..., :2]), (self.e2, delta[..., 2:])):
            R = frame(e.detach())
            new = e + (R[..., :2] @ d[..., None])[..., 0]
            moved.append(new / torch.linalg.vector_norm(new, dim=-1, keepdim=True))
        return _Epipoles(*moved)


@dataclass(frozen=True)
class _Forms:
    """Quadratic forms in the epipole: determinants of the binary forms of tangents, and the mixed ones of pairs."""

    own: Float[Tensor, "*batch m 3 3"]
    mixed: Float[Tensor, "*batch p 3 3"]

    @classmethod
    def of(cls, dual: Tensor) -> "_Forms":
        i, j = torch.triu_indices(dual.shape[-3], dual.shape[-3], 1, device=dual.device)
        own = adjugate_3x3(dual)
        mixed = adjugate_3x3(dual[..., i, :, :] + dual[..., j, :, :]) - own[..., i, :, :] - own[..., j, :, :]
        return cls(own, mixed)

    def invariants(self, e: Tensor) -> tuple[Tensor, Tensor]:
        """Asinh of those of pairs (*batch, p), and their derivatives by e (*batch, p, 3)."""
        own, mixed = ((form @ e[..., None, :, None])[..., 0] for form in (self.own, self.mixed))
        i, j = torch.triu_indices(own.shape[-2], own.shape[-2], 1, device=own.device)
        det = (own * e[..., None, :]).sum(-1)
        det = torch.where(det.abs() < 1e-30, 1e-30, det)
        size = det.abs().sqrt()
        over = 1 / (size[..., i] * size[..., j])
        value = 0.5 * (mixed * e[..., None, :]).sum(-1) * over
        # A form and its size are of the second degree.
        own = own / det[..., None]
        slope = mixed * over[..., None] - value[..., None] * (own[..., i, :] + own[..., j, :])
        return torch.asinh(value), slope * (1 + value.square()).rsqrt()[..., None]


def frame(e: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations whose last columns are unit vectors."""
    least = e.detach().abs().argmin(-1, keepdim=True)
    u = cross(e, torch.zeros_like(e).scatter(-1, least, 1.0))
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    return torch.stack((u, cross(e, u), e), -1)


def search_epipoles(
    dual1: Float[Tensor, "*batch m 3 3"],
    dual2: Float[Tensor, "*batch m 3 3"],
    seen: Tensor,
    starts: int,
    max_iterations: int,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Local minima of the differences of the invariants, one from each start: unit vectors (*batch, starts, 3)."""
    batch, m = seen.shape[:-1], seen.shape[-1]
    i, j = torch.triu_indices(m, m, 1, device=dual1.device)
    weights = (seen[..., i] & seen[..., j]).to(dual1.dtype)
    # The same starts for all problems, so that an answer does not depend on the batch.
    e = torch.randn(
        2, starts, 3, generator=generator, dtype=dual1.dtype, device=None if generator is None else generator.device
    )
    e = (e / torch.linalg.vector_norm(e, dim=-1, keepdim=True)).to(dual1.device)
    start = _Epipoles(*(half.expand(*batch, starts, 3) for half in e))
    if not i.numel():
        return start.e1, start.e2
    forms = tensor_map(lambda t: t.unsqueeze(len(batch)), (_Forms.of(dual1), _Forms.of(dual2)))

    def linearize(x: _Epipoles, one: _Forms, two: _Forms) -> tuple[Tensor, Tensor]:
        (r1, J1), (r2, J2) = one.invariants(x.e1), two.invariants(x.e2)
        J = torch.cat((J1 @ frame(x.e1)[..., :2], -J2 @ frame(x.e2)[..., :2]), -1)
        return (r1 - r2)[..., None], J[..., None, :]

    def residual(x: _Epipoles, one: _Forms, two: _Forms) -> Tensor:
        return linearize(x, one, two)[0]

    # Most starts lead nowhere, and those that do are refined.
    found = levenberg_marquardt(
        residual, start, *forms, retract=_Epipoles.moved, size=4, weights=weights[..., None, :], linearize=linearize,
        max_iterations=max_iterations, function_tolerance=1e-3, initial_damping=1e-2,
    ).x  # fmt: skip
    return found.e1, found.e2


def relate_tangents(
    S1: Float[Tensor, "*batch m 2 2"], S2: Float[Tensor, "*batch m 2 2"], seen: Tensor
) -> Float[Tensor, "*batch 2 4"]:
    """M with `M S1 M' ~ S2` for all conics, by linear least squares: for either sign of its determinant, as four numbers."""
    S1, S2 = _unit_determinant(S1), _unit_determinant(S2)
    size = torch.linalg.matrix_norm(S1) * torch.linalg.matrix_norm(S2)
    weight = (seen / (1 + size).sqrt())[..., None, None]
    found = []
    for sign in (1.0, -1.0):
        columns = []
        for k in range(4):
            E = torch.zeros(2, 2, dtype=S1.dtype, device=S1.device)
            E[k // 2, k % 2] = 1
            columns.append((weight * (E @ S1 - sign * S2 @ cofactors(E))).flatten(-2))
        rows = torch.stack(columns, -1).flatten(-3, -2)
        found.append(null_vector(rows)[0])
    return torch.stack(found, -2)


def _unit_determinant(S: Tensor) -> Tensor:
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1].square()
    return S / det.abs().clamp_min(1e-30).sqrt()[..., None, None]


def cofactors(M: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """`det(M) M^-T`."""
    a, b, c, d = M.flatten(-2).unbind(-1)
    return torch.stack((torch.stack((d, -c), -1), torch.stack((-b, a), -1)), -2)
