"""Two views: the fundamental matrix, the cameras it comes from and the cameras it allows. Throughout `x2' F x1 = 0`."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import adjugate_3x3, nearest_rank
from torchsfm.tensors.minors import cyclic_pairs


def unit_epipole(F: Tensor) -> Tensor:
    """The unit e with F e = 0, for F of rank 2; e3 where the rank is lower."""
    # The rows of the cofactor matrix are multiples of e.
    C = adjugate_3x3(F)
    lengths = (C * C).sum(-2)
    longest, best = lengths.detach().max(-1)
    e = C.gather(-1, best[..., None, None].expand(*best.shape, 3, 1))[..., 0]
    norm = (F.detach() * F.detach()).sum((-2, -1))
    good = (longest > (256 * torch.finfo(F.dtype).eps * norm) ** 2)[..., None]
    e = torch.where(good, e, torch.tensor([0.0, 0.0, 1.0], dtype=F.dtype, device=F.device))
    return e / (e * e).sum(-1, keepdim=True).sqrt()


def unit_rank_2(F: Tensor) -> Tensor:
    """F with Frobenius norm 1 and rank 2; zero where it is not finite or zero."""
    finite = torch.isfinite(F).all(-1).all(-1)[..., None, None]
    F = torch.where(finite, F, 0)
    largest = F.detach().abs().amax((-2, -1), keepdim=True)
    F = nearest_rank(F / torch.where(largest > 0, largest, 1), 2)
    square = (F * F).sum((-2, -1), keepdim=True)
    return F / torch.where(square > 0, square, 1).sqrt()


def epipoles(F: Float[Tensor, "*batch 3 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """The epipoles (e1, e2) with F e1 = 0 and F' e2 = 0, as unit homogeneous points of either sign.

    Args:
        F: Fundamental matrices of any scale; one that is not of rank 2 is first replaced by the nearest that is.

    Returns:
        The image of the second centre in the first image, and of the first in the second. Where the rank of F is below 2, or F
        is not finite, (0, 0, 1). Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.tensors.essential_from_pose(torch.eye(3), torch.tensor([1.0, 0.0, 2.0]))
        >>> e1, e2 = torchsfm.tensors.epipoles(F)
        >>> e2 / e2[2]  # where the second camera sees the first
        tensor([0.5000, 0.0000, 1.0000])
    """
    check_tensors(F=(F, "3 3"))
    F = unit_rank_2(F)
    return unit_epipole(F), unit_epipole(F.mT)


def epipolar_lines(F: Float[Tensor, "*#batch 3 3"], x: Float[Tensor, "*#batch n 2"]) -> Float[Tensor, "*batch n 3"]:
    """The epipolar lines l2 = F x1 in the second image of points in the first; with F' for the other way.

    Args:
        F: Fundamental matrices of any scale.
        x: Points in the first image.

    Returns:
        Lines with unit normal, so that l2' x2 is the signed distance of x2 in pixels. The zero vector for the epipole itself.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))  # moved sideways
        >>> l = torchsfm.tensors.epipolar_lines(F, torch.tensor([[3.0, 7.0]]))[0]
        >>> l / l[1]  # the line y = 7
        tensor([ 0.,  1., -7.])
    """
    check_tensors(F=(F, "3 3"), x=(x, "n 2"))
    line = x @ F[..., :2].mT + F[..., None, :, 2]
    square = (line[..., :2] * line[..., :2]).sum(-1, keepdim=True)
    good = square > 0
    return torch.where(good, line / torch.where(good, square, 1).sqrt(), 0)


def cameras_from_fundamental(
    F: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3 4"], Float[Tensor, "*batch 3 4"]]:
    """A pair of projective cameras with fundamental matrix F: P1 = [I | 0], P2 = [[e2]x F | e2] (HZ 9.5.3).

    Args:
        F: Fundamental matrices of any scale; one that is not of rank 2 is first replaced by the nearest that is.

    Returns:
        P1 and P2, one representative of the cameras that differ by a projective map of space. Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))  # moved sideways
        >>> P1, P2 = torchsfm.tensors.cameras_from_fundamental(F)
        >>> again = torchsfm.tensors.fundamental_from_cameras(P1, P2)
        >>> bool((again / again[2, 1]).allclose(F / F[2, 1], atol=1e-6))
        True
    """
    check_tensors(F=(F, "3 3"))
    F = unit_rank_2(F)
    e2 = unit_epipole(F.mT)
    P2 = torch.cat((cross_matrix(e2) @ F, e2[..., None]), -1)
    P1 = torch.eye(3, 4, dtype=F.dtype, device=F.device).expand(P2.shape)
    return P1, P2


def fundamental_from_cameras(P1: Float[Tensor, "*#batch 3 4"], P2: Float[Tensor, "*#batch 3 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The fundamental matrix of two cameras, by 4x4 minors (HZ 17.3): no inverse, any projective or affine cameras.

    Args:
        P1: First cameras, of any scale.
        P2: Second cameras.

    Returns:
        F with x2' F x1 = 0, its scale the product of the squares of the cameras' scales. Zero where the centres coincide.

    Example:
        >>> import torch, torchsfm
        >>> P2 = torch.eye(3, 4)
        >>> P2[0, 3] = 1.0  # t = (1, 0, 0): x2' F x1 says that y2 = y1
        >>> torchsfm.tensors.fundamental_from_cameras(torch.eye(3, 4), P2).abs()
        tensor([[0., 0., 0.],
                [0., 0., 1.],
                [0., 1., 0.]])
    """
    check_tensors(P1=(P1, "3 4"), P2=(P2, "3 4"))
    dual = cyclic_pairs(P2)[..., [5, 4, 3, 2, 1, 0]]
    sign = torch.tensor([-1, 1, -1, -1, 1, -1], dtype=P1.dtype, device=P1.device)
    return (dual * sign) @ cyclic_pairs(P1).mT


def bifocal_tensors(P: Float[Tensor, "*batch v 3 4"], index: Int[Tensor, "m 2"]) -> Float[Tensor, "*batch m 3 3"]:
    """The fundamental matrices of listed pairs out of v cameras.

    Args:
        P: Cameras.
        index: Pairs (i, j) of camera numbers.

    Returns:
        For each pair, F with xj' F xi = 0.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> F = torchsfm.tensors.bifocal_tensors(P, torch.tensor([[0, 1], [0, 3], [2, 3]]))
        >>> F.shape, bool(F[1].allclose(torchsfm.tensors.fundamental_from_cameras(P[0], P[3])))
        (torch.Size([3, 3, 3]), True)
    """
    check_tensors(P=(P, "v>=1 3 4"), index=(index, "m 2: int"))
    return fundamental_from_cameras(P[..., index[:, 0], :, :], P[..., index[:, 1], :, :])
