"""The nearest matrix with a property: a rotation, a rank, no negative eigenvalue. All in the Frobenius norm.

Values come from LAPACK without derivatives; the derivative is then attached as a term that is zero in value and whose
differential is the analytic one. It stays finite where singular values coincide and the answer is still smooth.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def _finite_or_zero(A: Tensor) -> tuple[Tensor, Tensor]:
    finite = torch.isfinite(A).all(-1).all(-1)[..., None, None]
    return torch.where(finite, A, 0), finite


def nearest_rotation(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """The rotation (determinant +1) nearest to A, also nearest to any positive multiple of A.

    Args:
        A: Square matrices. The answer is not unique where the smallest singular value is 0 twice, or where det A < 0 and the
            two smallest singular values coincide; one of the answers is returned. Matrices that are not finite give I.

    Returns:
        Rotations.
    """
    safe, finite = _finite_or_zero(A)
    with torch.no_grad():
        U, s, Vh = torch.linalg.svd(safe)
        sign = torch.ones_like(s)
        sign[..., -1] = torch.where(torch.linalg.det(U @ Vh) < 0, -1, 1)
        U = U * sign[..., None, :]
        s = s * sign
        R = U @ Vh
        total = s[..., :, None] + s[..., None, :]
        weight = torch.where(total > 1e-12 * s[..., :1, None], 1 / total, 0)
    if safe.requires_grad:
        change = U.mT @ (safe - safe.detach()) @ Vh.mT
        R = R + U @ (weight * (change - change.mT)) @ Vh
    return torch.where(finite, R, torch.eye(A.shape[-1], dtype=A.dtype, device=A.device))


def nearest_rank(A: Float[Tensor, "*batch m n"], rank: int) -> Float[Tensor, "*batch m n"]:
    """The matrix of rank at most `rank` nearest to A (Eckart-Young): the small singular values are set to zero.

    Args:
        A: Matrices. Those that are not finite give zero.
        rank: The rank wanted, at least 1.

    Returns:
        Matrices of the same shape. Not unique, and without derivative across the gap, where singular values number `rank`
        and `rank` + 1 coincide.
    """
    safe, _ = _finite_or_zero(A)
    with torch.no_grad():
        U, s, Vh = torch.linalg.svd(safe, full_matrices=False)
        V1, V2 = Vh[..., :rank, :].mT, Vh[..., rank:, :].mT
        U1, U2 = U[..., :rank], U[..., rank:]
        B = (U1 * s[..., None, :rank]) @ V1.mT
        s1, s2 = s[..., :rank, None], s[..., None, rank:]
        gap = s1 * s1 - s2 * s2
        weight = torch.where(gap > 1e-14 * s[..., :1, None] ** 2, 1 / gap, 0)
    if safe.requires_grad:
        change = safe - safe.detach()
        # dB = dA P + A dP with P = V1 V1', dP from the perturbation of the right singular subspace.
        c12 = U1.mT @ change @ V2
        c21 = V1.mT @ change.mT @ U2
        turn = weight * (s1 * c12 + c21 * s2)
        right = V1 @ turn @ V2.mT
        B = B + change @ V1 @ V1.mT + safe.detach() @ (right + right.mT)
    return B


def nearest_psd(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """The symmetric positive semidefinite matrix nearest to A: negative eigenvalues of its symmetric part are set to zero.

    Args:
        A: Square matrices. Those that are not finite give zero.

    Returns:
        Symmetric matrices without negative eigenvalues.
    """
    safe, _ = _finite_or_zero(A)
    with torch.no_grad():
        values, V = torch.linalg.eigh(0.5 * (safe + safe.mT))
        kept = values.clamp_min(0)
        B = (V * kept[..., None, :]) @ V.mT
        gap = values[..., :, None] - values[..., None, :]
        positive = (values > 0).to(A.dtype)
        same = gap.abs() <= 1e-12 * values.abs().amax(-1)[..., None, None]
        slope = torch.where(same, positive[..., :, None].expand_as(gap), (kept[..., :, None] - kept[..., None, :]) / gap)
    if safe.requires_grad:
        change = safe - safe.detach()
        B = B + V @ (slope * (V.mT @ (0.5 * (change + change.mT)) @ V)) @ V.mT
    return 0.5 * (B + B.mT)
