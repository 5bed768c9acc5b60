"""How far two views of conics are from an epipolar geometry: residuals of the lines from the epipoles that touch them.

The lines through an epipole are a pencil, and those of them that touch a conic a binary form; a 2x2 matrix carries the lines of
one image to those of the other, and its forms should be theirs up to scale. Points beside them have Sampson's error.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import qr
from torchsfm.linalg.constants import Constant
from torchsfm.motion.two_views.epipole_search import cofactors, frame
from torchsfm.optim import rotation_exponential


def _basis(size: int) -> Constant:
    """Symmetric matrices by their entries in and above the diagonal, row by row."""
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    basis = torch.zeros(len(pairs), size, size, dtype=torch.float64)
    for k, (i, j) in enumerate(pairs):
        basis[k, i, j] = basis[k, j, i] = 1
    return Constant(basis)


_SIX, _THREE = _basis(3), _basis(2)


@dataclass(frozen=True)
class EpipolarFrames:
    """Frames whose last columns are the epipoles, and the 2x2 matrix that carries lines through them, as four numbers."""

    R1: Float[Tensor, "*batch 3 3"]
    R2: Float[Tensor, "*batch 3 3"]
    N: Float[Tensor, "*batch 4"]

    def moved(self, delta: Float[Tensor, "*batch 7"]) -> "EpipolarFrames":
        """After a step: two numbers for each epipole, three for the lines."""
        zero = torch.zeros_like(delta[..., :1])
        R1 = self.R1 @ rotation_exponential(torch.cat((delta[..., :2], zero), -1))
        R2 = self.R2 @ rotation_exponential(torch.cat((delta[..., 2:4], zero), -1))
        N = self.N + (_tangents(self.N.detach()) @ delta[..., 4:, None])[..., 0]
        return EpipolarFrames(R1, R2, N / torch.linalg.vector_norm(N, dim=-1, keepdim=True))

    def F(self) -> Tensor:
        """The fundamental matrix."""
        F: Tensor = self.R2[..., :2] @ two_by_two(self.N) @ self.R1[..., :2].mT @ cross_matrix(self.R1[..., 2])
        return F


@dataclass(frozen=True)
class ConicPairs:
    """Dual conics of both images as six numbers, their covariances, points, and what counts."""

    c1: Float[Tensor, "*batch m 6"]
    c2: Float[Tensor, "*batch m 6"]
    S1: Float[Tensor, "*batch m 6 6"]
    S2: Float[Tensor, "*batch m 6 6"]
    x1: Float[Tensor, "*batch n 3"]
    x2: Float[Tensor, "*batch n 3"]
    sigma1: Float[Tensor, "*batch"]
    """Of a pixel, in the normalised images."""
    sigma2: Float[Tensor, "*batch"]


def two_by_two(v: Tensor) -> Tensor:
    """Four numbers as a matrix."""
    return v.reshape(*v.shape[:-1], 2, 2)


def _tangents(N: Tensor) -> Tensor:
    """An orthonormal basis of what is across unit 4-vectors."""
    return qr(N[..., None], complete=True)[0][..., 1:]


def _forms(state: EpipolarFrames, data: ConicPairs) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Binary forms of the tangents in the second image, predicted and measured, and their derivatives by the six numbers."""
    M = cofactors(two_by_two(state.N))
    first, second = _square(M) @ _restricted(state.R1[..., :2]), _restricted(state.R2[..., :2])
    return data.c1 @ first.mT, data.c2 @ second.mT, first, second


def _restricted(B: Tensor) -> Tensor:
    """What makes the numbers 00, 01, 11 of B'CB of the six numbers of C."""
    return _numbers(B.mT[..., None, :, :] @ _SIX.on(B.device, B.dtype) @ B[..., None, :, :])


def _square(M: Tensor) -> Tensor:
    """What makes the numbers 00, 01, 11 of MSM' of those of S."""
    return _numbers(M[..., None, :, :] @ _THREE.on(M.device, M.dtype) @ M.mT[..., None, :, :])


def _numbers(S: Tensor) -> Tensor:
    """Symmetric 2x2 matrices, one for each number that they are made of, as columns of three."""
    return S.flatten(-2)[..., [0, 1, 3]].mT


def residual(state: EpipolarFrames, data: ConicPairs) -> Tensor:
    """Two whitened numbers for each conic, Sampson's error for each point (and a zero)."""
    p, s, first, second = _forms(state, data)
    p_size, s_size = (torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-300) for v in (p, s))
    u = p / p_size
    t1 = frame(u)[..., :2]
    gap = (t1.mT @ (s / s_size - u)[..., None])[..., 0]
    V1 = first[..., None, :, :] @ data.S1 @ first[..., None, :, :].mT / p_size[..., None].square()
    V2 = second[..., None, :, :] @ data.S2 @ second[..., None, :, :].mT / s_size[..., None].square()
    V = t1.mT @ (V1 + V2) @ t1
    l11 = V[..., 0, 0].clamp_min(1e-300).sqrt()
    l21 = V[..., 0, 1] / l11
    l22 = (V[..., 1, 1] - l21.square()).clamp_min(1e-300).sqrt()
    r1 = gap[..., 0] / l11
    conics = torch.stack((r1, (gap[..., 1] - l21 * r1) / l22), -1)
    F = state.F()
    lines2, lines1 = data.x1 @ F.mT, data.x2 @ F
    error = (lines2 * data.x2).sum(-1)
    noise = (data.sigma2[..., None] * torch.linalg.vector_norm(lines2[..., :2], dim=-1)).square()
    noise = noise + (data.sigma1[..., None] * torch.linalg.vector_norm(lines1[..., :2], dim=-1)).square()
    points = error / noise.clamp_min(1e-300).sqrt()
    return torch.cat((conics, torch.nn.functional.pad(points[..., None], (0, 1))), -2)


def linearize(state: EpipolarFrames, data: ConicPairs) -> tuple[Tensor, Tensor]:
    """Residuals and Jacobian, all columns at once: one of seven copies of each problem for each."""
    with torch.enable_grad():
        several = tensor_map(lambda t: t.detach()[:, None].expand(-1, 7, *t.shape[1:]), (state, data))
        delta = data.c1.new_zeros((data.c1.shape[0], 7, 7)).requires_grad_()
        value = residual(several[0].moved(delta), several[1])
        seed = torch.zeros_like(value).requires_grad_()
        (pulled,) = torch.autograd.grad(value, delta, seed, create_graph=True)
        (columns,) = torch.autograd.grad(pulled.diagonal(dim1=-2, dim2=-1).sum(), seed)
    return value[:, 0].detach(), columns.movedim(1, -1)


def carry_lines(state: EpipolarFrames, data: ConicPairs, seen: Tensor) -> Tensor:
    """Whether lines that cross a conic go to lines that cross its fellow, not to lines that miss it."""
    p, s, _, _ = _forms(state, data)
    return (((p * s).sum(-1) > 0) | ~seen).all(-1)
