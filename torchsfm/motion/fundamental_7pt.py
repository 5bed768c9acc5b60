"""Seven points in two uncalibrated images: F with x2' F x1 = 0 and det F = 0 (Hartley & Zisserman 2004, 11.1.2)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import adjugate_3x3, determinant_3x3, orthonormal_nullspace
from torchsfm.linalg.polynomial import cubic_rows
from torchsfm.optim import attach_implicit, wants_derivative


def equations(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
) -> Float[Tensor, "*batch 9"]:
    """The nine equations of the nine entries of F: x2' F x1 = 0 for each point, det F = 0 and |F| = 1."""
    line = x1 @ F[..., :2].mT + F[..., None, :, 2]
    epipolar = (x2 * line[..., :2]).sum(-1) + line[..., 2]
    gauge = (F * F).sum((-2, -1)) - 1
    rest = torch.stack((determinant_3x3(F), gauge), -1)
    return torch.cat((epipolar, rest.expand(*epipolar.shape[:-1], 2)), -1)


def fundamental_7pt(
    x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
) -> Solutions[Float[Tensor, "*batch 3 3 3"]]:
    """The one or three F with x2' F x1 = 0 for seven points and det F = 0, with |F| = 1 (Frobenius).

    Args:
        x1: Seven points in the first image, in any unit.
        x2: The corresponding points in the second image.

    Returns:
        Three slots. None is valid where the seven equations are dependent (coinciding points, six or more points in a plane, a
        pure rotation) or a coordinate is not finite. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    check_tensors(x1=(x1, "7 2"), x2=(x2, "7 2"))
    F, valid = _solve(x1.detach(), x2.detach())
    if wants_derivative(x1, x2):
        F = attach_implicit(equations, F, x1[..., None, :, :], x2[..., None, :, :], dims=2, valid=valid)
    return Solutions(F, valid)


def _similarity(x: Tensor) -> tuple[Tensor, Tensor]:
    centre = x.mean(-2, keepdim=True)
    size = (x - centre).abs().amax((-2, -1), keepdim=True)
    scale = torch.where(size > 0, 1 / size, 1)
    T = torch.zeros(*x.shape[:-2], 3, 3, dtype=x.dtype, device=x.device)
    T[..., :1, :1], T[..., 1:2, 1:2], T[..., :2, 2:], T[..., 2, 2] = scale, scale, -(scale * centre).mT, 1
    return (x - centre) * scale, T


def _solve(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    dtype = x1.dtype
    x1, x2 = torch.broadcast_tensors(x1.double(), x2.double())
    finite = torch.isfinite(x1).all(-1).all(-1) & torch.isfinite(x2).all(-1).all(-1)
    y1, T1 = _similarity(torch.where(finite[..., None, None], x1, 0))
    y2, T2 = _similarity(torch.where(finite[..., None, None], x2, 0))
    h1 = torch.cat((y1, torch.ones_like(y1[..., :1])), -1)
    h2 = torch.cat((y2, torch.ones_like(y2[..., :1])), -1)
    A = (h2[..., :, None] * h1[..., None, :]).flatten(-2)
    basis = orthonormal_nullspace(A)
    G, K = basis[..., 0].unflatten(-1, (3, 3)), basis[..., 1].unflatten(-1, (3, 3))
    # det(a G + b K), with a^3 first.
    c0, c3 = determinant_3x3(K), determinant_3x3(G)
    c1, c2 = (adjugate_3x3(K).mT * G).sum((-2, -1)), (adjugate_3x3(G).mT * K).sum((-2, -1))
    turn = c0.abs() > c3.abs()
    roots, real = cubic_rows(
        torch.where(turn, c3, c0), torch.where(turn, c2, c1), torch.where(turn, c1, c2), torch.where(turn, c0, c3)
    )
    r = torch.stack(roots, -1)[..., None, None]
    t = turn[..., None, None, None]
    G, K = G[..., None, :, :], K[..., None, :, :]
    F = torch.where(t, G + r * K, r * G + K)
    F = T2.mT[..., None, :, :] @ F @ T1[..., None, :, :]
    norm = (F * F).sum((-2, -1), keepdim=True).sqrt()
    F = F / norm
    valid = torch.stack(real, -1) & finite[..., None] & torch.isfinite(F).all(-1).all(-1)
    # The rank of A: the product of its pivots is small where the equations are dependent.
    fallback = torch.eye(3, dtype=F.dtype, device=F.device)
    return torch.where(valid[..., None, None], F, fallback).to(dtype), valid
