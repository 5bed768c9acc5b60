"""Four views: the quadrifocal tensor, the cameras it comes from and the cameras it allows (HZ 17.3).

The layout is `Q[..., p, q, r, s] = Q^pqrs` of Hartley & Zisserman, the determinant of row p of the first camera, q of the
second, r of the third and s of the fourth. Lines l1, l2, l3, l4 through the images of one point have
`l1_p l2_q l3_r l4_s Q^pqrs = 0`. Another order of the views is another order of the indices, up to sign.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.linalg import null_vector, solve, svdvals
from torchsfm.tensors.canonical import canonical_frame
from torchsfm.tensors.minors import LAPLACE_SIGNS, dual_matrix, split_last, wedge
from torchsfm.tensors.trifocal import ProjectiveCameras, cameras_from_trifocal, unit_tensor

_STEPS = 20


def quadrifocal_from_cameras(
    P1: Float[Tensor, "*#batch 3 4"],
    P2: Float[Tensor, "*#batch 3 4"],
    P3: Float[Tensor, "*#batch 3 4"],
    P4: Float[Tensor, "*#batch 3 4"],
) -> Float[Tensor, "*batch 3 3 3 3"]:
    """The quadrifocal tensor of four cameras (HZ 17.21): any projective or affine cameras.

    Args:
        P1: First cameras, of any scale.
        P2: Second cameras.
        P3: Third cameras.
        P4: Fourth cameras.

    Returns:
        Q with `Q[p, q, r, s] = det(P1[p], P2[q], P3[r], P4[s])`, its scale the product of those of the cameras.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> x = torchsfm.project_points(P, torch.zeros(1, 3, dtype=P.dtype))
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> bool(torchsfm.tensors.quadrifocal_pppp(Q, *x).abs().max() < 1e-9)  # x are images of one point
        True
    """
    check_tensors(P1=(P1, "3 4"), P2=(P2, "3 4"), P3=(P3, "3 4"), P4=(P4, "3 4"))
    signs = torch.tensor(LAPLACE_SIGNS, dtype=P1.dtype, device=P1.device)
    first = wedge(P1[..., :, None, :], P2[..., None, :, :]).flatten(-3, -2) * signs
    second = wedge(P3[..., :, None, :], P4[..., None, :, :]).flatten(-3, -2).flip(-1)
    return split_last((first @ second.mT).flatten(-2), 3, 3, 3, 3)


def quadrifocal_tensors(P: Float[Tensor, "*batch v 3 4"], index: Int[Tensor, "m 4"]) -> Float[Tensor, "*batch m 3 3 3 3"]:
    """The quadrifocal tensors of listed quadruplets out of v cameras.

    Args:
        P: Cameras.
        index: Quadruplets (i, j, k, l) of camera numbers.

    Returns:
        For each quadruplet the tensor of `quadrifocal_from_cameras`.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(5, generator=torch.Generator().manual_seed(0)).matrix()
        >>> torchsfm.tensors.quadrifocal_tensors(P, torch.tensor([[0, 1, 2, 3], [1, 2, 3, 4]])).shape
        torch.Size([2, 3, 3, 3, 3])
    """
    check_tensors(P=(P, "v>=1 3 4"), index=(index, "m 4: int"))
    return quadrifocal_from_cameras(*(P[..., index[:, k], :, :] for k in range(4)))


def trifocal_from_quadrifocal(
    Q: Float[Tensor, "*batch 3 3 3 3"], views: tuple[int, int, int] = (0, 1, 2)
) -> Float[Tensor, "*batch 3 3 3"]:
    """The trifocal tensor of three of the four views, by linear least squares.

    Lines l2 and l3 in two views are images of one line in space, whose image in the first is l1_i = l2_j l3_k T_i^jk, and the
    plane of any line in the fourth view meets that line: l1_p l2_q l3_r Q^pqrs = 0. Quadratic in l2 and in l3, linear in T.

    Args:
        Q: Quadrifocal tensors of any scale.
        views: Which views, counted from 0, in the order the trifocal tensor has them.

    Returns:
        T with norm 1 and some sign; meaningless where Q does not determine it. Differentiable.

    Raises:
        ValueError: Wrong shape or dtype, or `views` are not three different numbers from 0 to 3.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> T = torchsfm.tensors.trifocal_from_quadrifocal(torchsfm.tensors.quadrifocal_from_cameras(*P), (0, 1, 3))
        >>> truth = torchsfm.tensors.trifocal_from_cameras(P[0], P[1], P[3])
        >>> round(float((T * truth).sum().abs() / truth.norm()), 6)  # 1: the same up to scale
        1.0
    """
    check_tensors(Q=(Q, "3 3 3 3"))
    if not isinstance(views, Sequence) or len(views) != 3 or len(set(views)) != 3 or not set(views) <= {0, 1, 2, 3}:
        raise ValueError(f"views: wanted three different numbers from 0 to 3, got {views}")
    t, _ = null_vector(_transfer_equations(unit_tensor(_reordered(Q, views), 4)[0]))
    return split_last(t, 3, 3, 3)


def _reordered(Q: Tensor, views: tuple[int, int, int]) -> Tensor:
    batch = Q.ndim - 4
    order = (*views, *({0, 1, 2, 3} - set(views)))
    return Q.permute(*range(batch), *(batch + k for k in order))


def _transfer_equations(Q: Tensor) -> Tensor:
    """The 243 equations (of which 108 are different) in the 27 entries of T."""
    eye = torch.eye(3, dtype=Q.dtype, device=Q.device)
    A = torch.einsum("...pdfs,ca,eb->...cdefspab", Q, eye, eye)
    A = A + A.transpose(-8, -7)
    A = A + A.transpose(-6, -5)
    return A.flatten(-3).flatten(-6, -2)


def cameras_from_quadrifocal(Q: Float[Tensor, "*batch 3 3 3 3"]) -> ProjectiveCameras:
    """Four projective cameras with quadrifocal tensor Q, in the frame of `canonical_cameras`.

    The trifocal tensor of the first three views is a linear function's null vector, it gives three cameras, and the fourth
    follows linearly. For a Q that is no quadrifocal tensor the cameras are then moved by Gauss-Newton steps to those of the
    tensor nearest to Q / |Q| in the Frobenius norm.

    Args:
        Q: Quadrifocal tensors of any scale, in coordinates of moderate size for those that have noise: the norm counts all
            entries alike.

    Returns:
        The cameras (*batch, 4 views, 3, 4) and the status: DEGENERATE where the first centre coincides with
        the second or third, or Q leaves the cameras open otherwise.
        Differentiable; the derivative is that of a Gauss-Newton step, exact where Q is a quadrifocal tensor.

    Raises:
        ValueError: Wrong shape or dtype.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> found = torchsfm.tensors.cameras_from_quadrifocal(Q)
        >>> bool(found.P.allclose(torchsfm.tensors.canonical_cameras(P)))
        True
    """
    check_tensors(Q=(Q, "3 3 3 3"))
    unit, finite = unit_tensor(Q.double(), 4)
    with torch.no_grad():
        base = unit.detach()
        equations = _transfer_equations(base)
        t, _ = null_vector(equations)
        values, _ = svdvals(equations)
        three = cameras_from_trifocal(split_last(t, 3, 3, 3))
        fourth, solved = _fourth_camera(base, three.P)
        P = canonical_frame(torch.cat((three.P[..., 1:, :, :], fourth[..., None, :, :]), -3))[..., 1:, :, :]
        cost, damping = _residual(base, P)[0].square().sum(-1), torch.full_like(base[..., 0, 0, 0, 0], 1e-3)
        for _ in range(_STEPS):
            new = canonical_frame(_step(base, P, damping))[..., 1:, :, :]
            after = _residual(base, new)[0].square().sum(-1)
            better = after < cost
            P, cost = torch.where(better[..., None, None, None], new, P), torch.where(better, after, cost)
            damping = torch.where(better, 0.1 * damping, 10 * damping).clamp_min(1e-12)
        # With two centres in one place there is a family of tensors T.
        clear = values[..., -2] > 256 * torch.finfo(Q.dtype).eps * values[..., 0]
        determined = clear & solved & (three.status == Status.OK)
        damping = torch.full_like(damping, 1e-12)
    # What is not determined has no derivative.
    unit = torch.where((determined & finite)[..., None, None, None, None], unit, base)
    P = canonical_frame(_step(unit, P, damping))
    status = torch.where(determined, Status.OK, Status.DEGENERATE)
    return ProjectiveCameras(P.to(Q.dtype), torch.where(finite, status, Status.NOT_FINITE).to(torch.int8))


def _fourth_camera(Q: Tensor, P: Tensor) -> tuple[Tensor, Tensor]:
    """The last camera by linear least squares, given the first three."""
    K = torch.einsum(
        "...pqij,...ri->...pqrj", dual_matrix(wedge(P[..., 0, :, None, :], P[..., 1, None, :, :])), P[..., 2, :, :]
    )
    K = K.flatten(-4, -2)
    X, good = solve(K.mT @ K, K.mT @ Q.flatten(-4, -2))
    return X.mT, good


def quadrifocal_jacobian(P: Float[Tensor, "*batch 4 3 4"]) -> Float[Tensor, "*batch 81 36"]:
    """The derivative of `quadrifocal_from_cameras` by the entries of the second, third and fourth camera."""
    P1, P2, P3, P4 = P.unbind(-3)
    eye = torch.eye(3, dtype=P.dtype, device=P.device)
    near = dual_matrix(wedge(P1[..., :, None, :], P2[..., None, :, :]))
    far = dual_matrix(wedge(P3[..., :, None, :], P4[..., None, :, :]))
    J2 = torch.einsum("...rsij,...pi,qx->...pqrsxj", far, P1, eye)
    J3 = torch.einsum("...pqij,...sj,rx->...pqrsxi", near, P4, eye)
    J4 = torch.einsum("...pqij,...ri,sx->...pqrsxj", near, P3, eye)
    return torch.stack((J2, J3, J4), -3).flatten(-3).flatten(-5, -2)


def _residual(Q: Tensor, P: Tensor) -> tuple[Tensor, Tensor]:
    """The part of the tensor Q across that of the cameras [I | 0] and P, and the factor that has in Q."""
    eye = torch.eye(3, 4, dtype=P.dtype, device=P.device).expand(*P.shape[:-3], 3, 4)
    model = quadrifocal_from_cameras(eye, *P.unbind(-3)).flatten(-4)
    square = (model * model).sum(-1, keepdim=True)
    factor = (model * Q.flatten(-4)).sum(-1, keepdim=True) / torch.where(square > 0, square, 1)
    return Q.flatten(-4) - factor * model, factor


def _step(Q: Tensor, P: Tensor, damping: Tensor) -> Tensor:
    """A damped Gauss-Newton step on the residual, along which the scale of the tensor may change."""
    r, factor = _residual(Q, P)
    eye = torch.eye(3, 4, dtype=P.dtype, device=P.device).expand(*P.shape[:-3], 1, 3, 4)
    J = (factor[..., None] * quadrifocal_jacobian(torch.cat((eye, P), -3))).detach()
    N = J.mT @ J
    # The frame and the scales of the cameras are free: damped, they stay.
    damping = damping * N.diagonal(dim1=-2, dim2=-1).mean(-1)
    step, _ = solve(N + damping[..., None, None] * torch.eye(36, dtype=P.dtype, device=P.device), J.mT @ r[..., None])
    return P + split_last(step[..., 0], 3, 3, 4)
