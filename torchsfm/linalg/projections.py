"""The nearest matrix with a property: a rotation, a rank, no negative eigenvalue. All in the Frobenius norm.

Values come without derivatives, most from LAPACK; the derivative is then attached as a term that is zero in value and whose
differential is the analytic one. It stays finite where singular values coincide and the answer is still smooth, and is zero in
the directions in which the answer is not.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg.decompositions import eigh, svd
from torchsfm.linalg.derivative import followed
from torchsfm.linalg.elimination import adjugate_3x3
from torchsfm.linalg.magnitude import all_below, unit_scale

_SQUARINGS = 4
_ALONE = 1e-6
"""What may be left of a second eigenvector, for a step whose error is about its cube."""
_TWO = 1e-20
"""Square of the second singular value, about 1 being the first, at which a matrix has rank 1."""


def nearest_rotation(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """The rotation (determinant +1) nearest to A, which is also the nearest to any positive multiple of A.

    Args:
        A: Square matrices. The answer is not unique where the smallest singular value is 0 twice, or where det A < 0 and the
            two smallest singular values coincide; one of the answers is returned. Matrices that are not finite give I.

    Returns:
        Rotations.

    Example:
        >>> import torch, torchsfm.linalg
        >>> R = torchsfm.linalg.nearest_rotation(torch.tensor([[0.0, -2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 3.0]]))
        >>> R @ torch.tensor([1.0, 0.0, 0.0])  # a quarter of a turn about z
        tensor([0., 1., 0.])
    """
    check_tensors(A=(A, "n n"))
    with torch.no_grad():
        U, s, Vh, ok = svd(A.detach())
        flip = torch.linalg.det(U @ Vh) < 0
        sign = torch.ones_like(s)
        sign[..., -1] = torch.where(flip, -1, 1)
        U, s = U * sign[..., None, :], s * sign
        R: Tensor = U @ Vh
        total = s[..., :, None] + s[..., None, :]
        weight = torch.where(total > 64 * torch.finfo(A.dtype).eps * s[..., :1, None], 1 / total, 0)
    if followed(A):
        # In the bases of the singular vectors dR is skew.
        change = U.mT @ _change(A, ok) @ Vh.mT
        R = R + U @ (weight * (change - change.mT)) @ Vh
    return R


def nearest_rank(A: Float[Tensor, "*batch m n"], rank: int) -> Float[Tensor, "*batch m n"]:
    """The matrix of rank at most `rank` nearest to A (Eckart & Young 1936): the small singular values are set to zero.

    Args:
        A: Matrices. Those that are not finite give zero.
        rank: The rank wanted, from 1 to min(m, n).

    Returns:
        Matrices of the same shape. Not unique, and without derivative across the gap, where singular values number `rank`
        and `rank` + 1 coincide.

    Raises:
        ValueError: `rank` is out of range.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.nearest_rank(torch.diag(torch.tensor([3.0, 2.0, 0.1])), 2).diagonal()
        tensor([3., 2., 0.])
    """
    check_tensors(A=(A, "m n"))
    if not 1 <= rank <= min(A.shape[-2:]):
        raise ValueError(f"rank: wanted 1 to {min(A.shape[-2:])} for shape {tuple(A.shape)}, got {rank}")
    B = _nearest_singular(A.detach()) if A.shape[-2:] == (3, 3) and rank == 2 else None
    if B is not None and not followed(A):
        return B
    with torch.no_grad():
        U, s, Vh, ok = svd(A.detach())
        U1, U2 = U[..., :rank], U[..., rank:]
        V1, V2 = Vh[..., :rank, :].mT, Vh[..., rank:, :].mT
        s1 = s[..., :rank]
        if B is None:
            B = (U1 * s1[..., None, :]) @ V1.mT
        # Singular values of U2 and V2, padded with zeros where the matrix is not square.
        s2 = s[..., rank:]
        tall = torch.nn.functional.pad(s2, (0, U2.shape[-1] - s2.shape[-1]))
        wide = torch.nn.functional.pad(s2, (0, V2.shape[-1] - s2.shape[-1]))
        floor = 64 * torch.finfo(A.dtype).eps * s[..., :1, None] ** 2
    if not followed(A):
        return B
    change = _change(A, ok)
    c11, c12, c21 = U1.mT @ change @ V1, U1.mT @ change @ V2, U2.mT @ change @ V1
    # First-order change of the truncation in the bases of the singular vectors; c22 drops out.
    upper = _coupled(s1[..., :, None], wide[..., None, :], c12, _fit(c21.mT, c12.shape), floor)
    lower = _coupled(s1[..., None, :], tall[..., :, None], c21, _fit(c12.mT, c21.shape), floor)
    moved: Tensor = B + U1 @ c11 @ V1.mT + U1 @ upper @ V2.mT + U2 @ lower @ V1.mT
    return moved


def _nearest_singular(A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """That of rank 2."""
    flat = A.reshape(-1, 3, 3)
    nearest, clear = _without_least(flat)
    rest = (~clear).nonzero()[:, 0]
    if len(rest):
        U, s, Vh, _ = svd(flat.index_select(0, rest))
        nearest = nearest.index_copy(0, rest, (U[..., :2] * s[..., None, :2]) @ Vh[..., :2, :])
    return nearest.reshape(A.shape)


def _without_least(A: Float[Tensor, "batch 3 3"]) -> tuple[Float[Tensor, "batch 3 3"], Bool[Tensor, " batch"]]:
    """The same by powers of the adjugate and one Newton step, and where the least singular value stands clear."""
    scale = unit_scale(A)
    B = (A * scale).double()
    K = adjugate_3x3(B)
    power = K @ K.mT
    two = power.diagonal(dim1=-2, dim2=-1).sum(-1) > _TWO
    for _ in range(_SQUARINGS):
        power = power * power.diagonal(dim1=-2, dim2=-1).sum(-1).reciprocal()[:, None, None]
        power = power @ power
    # The trace was 1: that of the square is 1 where one eigenvector alone is left.
    diagonal = power.diagonal(dim1=-2, dim2=-1)
    clear = two & (diagonal.sum(-1) > 1 - _ALONE)
    longest = diagonal.argmax(-1)
    v = power.gather(-2, longest[:, None, None].expand(-1, 1, 3)).mT
    v = v * torch.linalg.vector_norm(v, dim=-2, keepdim=True).reciprocal()
    image = B @ v
    value = image.mT @ image
    residual = (B.mT @ image).addcmul_(value, v, value=-1)
    # Regular by what is added along v, where there is no residual.
    G = B.mT @ B
    G.addcmul_(v * G.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None], v.mT).diagonal(dim1=-2, dim2=-1).sub_(value[..., 0])
    v = v - torch.linalg.solve_ex(G, residual)[0]
    v = v * torch.linalg.vector_norm(v, dim=-2, keepdim=True).reciprocal()
    nearest = ((B - (B @ v) @ v.mT) / scale).to(A.dtype)
    return nearest, clear & all_below(nearest, torch.inf, 2)


def _fit(A: Tensor, shape: torch.Size) -> Tensor:
    """Cut or pad with zeros to the shape's last two dimensions."""
    A = A[..., : shape[-2], : shape[-1]]
    return torch.nn.functional.pad(A, (0, shape[-1] - A.shape[-1], 0, shape[-2] - A.shape[-2]))


def _coupled(large: Tensor, small: Tensor, own: Tensor, other: Tensor, floor: Tensor) -> Tensor:
    gap = large * large - small * small
    inverse = torch.where(gap > floor, 1 / gap, 0)
    return inverse * (large * large * own + large * small * other)


def nearest_psd(A: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """The symmetric positive semidefinite matrix nearest to A: negative eigenvalues of its symmetric part are set to zero.

    Args:
        A: Square matrices. Those that are not finite give zero.

    Returns:
        Symmetric matrices without negative eigenvalues (Higham 1988).

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.nearest_psd(torch.diag(torch.tensor([2.0, -1.0]))).diagonal()
        tensor([2., 0.])
    """
    check_tensors(A=(A, "n n"))
    with torch.no_grad():
        base = A.detach()
        values, V, ok = eigh(0.5 * (base + base.mT))
        kept = values.clamp_min(0)
        B: Tensor = (V * kept[..., None, :]) @ V.mT
        gap = values[..., :, None] - values[..., None, :]
        positive = (values > 0).to(A.dtype)[..., :, None].expand_as(gap)
        same = gap.abs() <= 64 * torch.finfo(A.dtype).eps * values.abs().amax(-1)[..., None, None]
        slope = torch.where(same, positive, (kept[..., :, None] - kept[..., None, :]) / gap)
    if followed(A):
        change = _change(A, ok)
        B = B + V @ (slope * (V.mT @ (0.5 * (change + change.mT)) @ V)) @ V.mT
    symmetric: Tensor = 0.5 * (B + B.mT)
    return symmetric


def _change(A: Tensor, ok: Tensor) -> Tensor:
    """Zero, with the derivative of A where it could be decomposed."""
    safe = torch.where(ok[..., None, None], A, 0)
    return safe - safe.detach()
