"""From tensors of fewer views to tensors of more, and back: F, T and Q by way of the cameras they allow."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.linalg import null_vector, solve, svdvals
from torchsfm.tensors.bifocal import bifocal_tensors, cameras_from_fundamental, unit_rank_2
from torchsfm.tensors.minors import cyclic_pairs, dual_matrix, split_last
from torchsfm.tensors.quadrifocal import cameras_from_quadrifocal, quadrifocal_from_cameras
from torchsfm.tensors.trifocal import ProjectiveCameras, cameras_from_trifocal, trifocal_from_cameras, unit_tensor


def cameras_from_fundamentals(
    F12: Float[Tensor, "*#batch 3 3"], F13: Float[Tensor, "*#batch 3 3"], F23: Float[Tensor, "*#batch 3 3"]
) -> ProjectiveCameras:
    """Three projective cameras from the fundamental matrices of their pairs (HZ 15.4).

    P1 = [I | 0] and P2 belong to F12; P3 makes P3' F13 P1 and P3' F23 P2 antisymmetric, which are linear equations. They are
    solved in units in which the matrices are balanced: pixels or radians make no difference. Where the three matrices are not
    compatible, P3 is their least-squares solution.

    Args:
        F12: x2' F12 x1 = 0.
        F13: x3' F13 x1 = 0.
        F23: x3' F23 x2 = 0.

    Returns:
        The cameras (*batch, 3 views, 3, 4) and the status: DEGENERATE where the centres are on one line, so that the three
        matrices leave a family of cameras, or where a matrix has rank below 2. Differentiable.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> F = torchsfm.tensors.bifocal_tensors(P, torch.tensor([[0, 1], [0, 2], [1, 2]]))
        >>> found = torchsfm.tensors.cameras_from_fundamentals(*F)
        >>> canonical = torchsfm.tensors.canonical_cameras  # the frame in which cameras can be compared
        >>> bool(found.status == torchsfm.Status.OK), bool(canonical(found.P).allclose(canonical(P)))
        (True, True)
    """
    batch = check_tensors(F12=(F12, "3 3"), F13=(F13, "3 3"), F23=(F23, "3 3"))
    F12, F13, F23 = (F.expand(*batch, 3, 3) for F in (F12, F13, F23))
    finite = torch.stack([torch.isfinite(F).all(-1).all(-1) for F in (F12, F13, F23)]).all(0)
    # A rank-2 stand-in where there is no F.
    stand_in = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=F12.dtype, device=F12.device))
    F = torch.stack([torch.where(finite[..., None, None], F, stand_in) for F in (F12, F13, F23)], -3)
    unit = _image_units(F.detach())
    F12, F13, F23 = _in_units(F, unit).unbind(-3)
    P1, P2 = cameras_from_fundamental(F12)
    eye = torch.eye(4, dtype=F12.dtype, device=F12.device)
    blocks = []
    for F, P in ((F13, P1), (F23, P2)):
        M = unit_rank_2(F) @ P
        # (P3' M)_ij + (P3' M)_ji for i <= j, by the entries P3[r, c].
        B = torch.einsum("...rj,ic->...ijrc", M, eye)
        i, j = torch.triu_indices(4, 4, device=M.device)
        blocks.append((B + B.transpose(-4, -3))[..., i, j, :, :].flatten(-2))
    A = torch.cat(blocks, -2)
    p, _ = null_vector(A)
    with torch.no_grad():
        values, _ = svdvals(A.detach())
        rank2 = torch.stack([svdvals(unit_rank_2(F.detach()))[0][..., 1] for F in (F12, F13, F23)]).amin(0)
        floor = 256 * torch.finfo(F12.dtype).eps
        determined = (values[..., -2] > floor * values[..., 0]) & (rank2 > floor)
    P = torch.stack((P1, P2, split_last(p, 3, 4)), -3) * unit[..., None]
    # The first camera at [I | 0] again.
    P = torch.cat((P[..., :3] / unit[..., :1, None, :], P[..., 3:]), -1)
    status = torch.where(determined, Status.OK, Status.DEGENERATE)
    return ProjectiveCameras(P, torch.where(finite, status, Status.NOT_FINITE).to(torch.int8))


def _image_units(F: Float[Tensor, "*batch 3 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """What (x, y, 1) of each view are multiplied by to give coordinates of size 1: (s, s, 1), for F12, F13, F23.

    In them the last column and the last row of an F weigh as much as each of the other two.
    """
    s = F.new_ones(*F.shape[:-3], 3)
    for _ in range(4):
        square = _in_units(F, torch.stack((s, s, torch.ones_like(s)), -1)).square()
        column, row = (2 * q[..., 2] / q[..., :2].sum(-1) for q in (square.sum(-2), square.sum(-1)))
        ratio = torch.stack((column[..., 0] * column[..., 1], row[..., 0] * column[..., 2], row[..., 1] * row[..., 2]), -1)
        # A quarter: of squares, and of two matrices.
        s = s * torch.where(torch.isfinite(ratio) & (ratio > 0), ratio, 1.0) ** 0.25
    return torch.stack((s, s, torch.ones_like(s)), -1)


def _in_units(F: Float[Tensor, "*batch 3 3 3"], unit: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3 3"]:
    """F12, F13, F23 of coordinates divided by the units of their views."""
    first, second = unit[..., [0, 0, 1], :], unit[..., [1, 2, 2], :]
    return second[..., :, None] * F * first[..., None, :]


def trifocal_from_fundamentals(
    F12: Float[Tensor, "*#batch 3 3"], F13: Float[Tensor, "*#batch 3 3"], F23: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 3 3 3"]:
    """The trifocal tensor of three views from the fundamental matrices of their pairs.

    Args:
        F12: x2' F12 x1 = 0.
        F13: x3' F13 x1 = 0.
        F23: x3' F23 x2 = 0.

    Returns:
        T with norm 1, of `cameras_from_fundamentals`, which also says where the result means nothing: three centres on one
        line have tensors that their fundamental matrices do not determine.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> F = torchsfm.tensors.bifocal_tensors(P, torch.tensor([[0, 1], [0, 2], [1, 2]]))
        >>> T, truth = torchsfm.tensors.trifocal_from_fundamentals(*F), torchsfm.tensors.trifocal_from_cameras(*P)
        >>> round(float((T * truth).sum().abs() / truth.norm()), 6)  # 1: the same up to scale
        1.0
    """
    T = trifocal_from_cameras(*cameras_from_fundamentals(F12, F13, F23).P.unbind(-3))
    return unit_tensor(T, 3)[0]


def reordered_trifocal(T: Float[Tensor, "*batch 3 3 3"], views: tuple[int, int, int]) -> Float[Tensor, "*batch 3 3 3"]:
    """The trifocal tensor of the same cameras in another order.

    The first view plays another part than the other two, so this is no permutation of the entries: it goes by way of
    `cameras_from_trifocal`.

    Args:
        T: Trifocal tensors of any scale.
        views: The new order, a permutation of (0, 1, 2): view `views[0]` becomes the first.

    Returns:
        T with norm 1. Differentiable.

    Raises:
        ValueError: Wrong shape or dtype, or `views` is no permutation.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> T = torchsfm.tensors.reordered_trifocal(torchsfm.tensors.trifocal_from_cameras(*P), (2, 0, 1))
        >>> truth = torchsfm.tensors.trifocal_from_cameras(P[2], P[0], P[1])
        >>> round(float((T * truth).sum().abs() / truth.norm()), 6)  # 1: the same up to scale
        1.0
    """
    if not isinstance(views, Sequence) or len(views) != 3 or set(views) != {0, 1, 2}:
        raise ValueError(f"views: wanted a permutation of (0, 1, 2), got {views}")
    P = cameras_from_trifocal(T).P
    return unit_tensor(trifocal_from_cameras(*(P[..., k, :, :] for k in views)), 3)[0]


def quadrifocal_from_trifocals(
    T123: Float[Tensor, "*#batch 3 3 3"], T124: Float[Tensor, "*#batch 3 3 3"]
) -> Float[Tensor, "*batch 3 3 3 3"]:
    """The quadrifocal tensor from two trifocal tensors with the first two views in common.

    The first gives three cameras, and in their frame the second is linear in the fourth camera.

    Args:
        T123: Trifocal tensors of views 1, 2, 3, of any scale.
        T124: Trifocal tensors of views 1, 2, 4.

    Returns:
        Q with norm 1; zero where a tensor is not finite, without meaning where the first two centres coincide. Differentiable.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> T123, T124 = torchsfm.tensors.trifocal_tensors(P, torch.tensor([[0, 1, 2], [0, 1, 3]]))
        >>> Q = torchsfm.tensors.quadrifocal_from_trifocals(T123, T124)
        >>> truth = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> round(float((Q * truth).sum().abs() / truth.norm()), 6)  # 1: the same up to scale
        1.0
    """
    batch = check_tensors(T123=(T123, "3 3 3"), T124=(T124, "3 3 3"))
    three, second = cameras_from_trifocal(T123), unit_tensor(T124, 3)[0].expand(*batch, 3, 3, 3)
    P1, P2, P3 = (three.P[..., k, :, :].expand(*batch, 3, 4) for k in range(3))
    K = torch.einsum("...iab,...ja->...ijb", dual_matrix(cyclic_pairs(P1)).mT, P2).flatten(-3, -2)
    N, right = K.mT @ K, second.flatten(-3, -2)
    P4, _ = solve(N, K.mT @ right)
    # The normal equations square the condition number; their correction does not.
    P4 = P4 + solve(N, K.mT @ (right - K @ P4))[0]
    good = (three.status != Status.NOT_FINITE)[..., None, None, None, None]
    Q = quadrifocal_from_cameras(P1, P2, P3, P4.mT)
    return unit_tensor(torch.where(good, Q, 0), 4)[0]


def fundamentals_from_quadrifocal(Q: Float[Tensor, "*batch 3 3 3 3"]) -> Float[Tensor, "*batch 6 3 3"]:
    """The fundamental matrices of the pairs (1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4) of four views.

    Args:
        Q: Quadrifocal tensors of any scale.

    Returns:
        F (*batch, pair, 3, 3) with norm 1, x_j' F x_i = 0 for the pair (i, j), of `cameras_from_quadrifocal`.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> F = torchsfm.tensors.fundamentals_from_quadrifocal(torchsfm.tensors.quadrifocal_from_cameras(*P))
        >>> F34, truth = F[5], torchsfm.tensors.fundamental_from_cameras(P[2], P[3])
        >>> F.shape, round(float((F34 * truth).sum().abs() / truth.norm()), 6)  # 1: the same up to scale
        (torch.Size([6, 3, 3]), 1.0)
    """
    check_tensors(Q=(Q, "3 3 3 3"))
    pairs = torch.tensor([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], device=Q.device)
    return unit_tensor(bifocal_tensors(cameras_from_quadrifocal(Q).P, pairs), 2)[0]
