"""Tensors in other image coordinates, and reduced tensors: those in which four points are the basis of every image."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.homogeneous import normalize_sphere, to_homogeneous
from torchsfm.linalg import adjugate_3x3, determinant_3x3
from torchsfm.tensors.minors import split_last
from torchsfm.tensors.trifocal import unit_tensor


def transform_fundamental(
    F: Float[Tensor, "*#batch 3 3"], H1: Float[Tensor, "*#batch 3 3"], H2: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """The fundamental matrix of the points H1 x1 and H2 x2: H2^-T F H1^-1.

    Args:
        F: Fundamental matrices of any scale.
        H1: Change of coordinates of the first image. One that is not regular gives a meaningless finite result.
        H2: Change of coordinates of the second image.

    Returns:
        F in the new coordinates, the scale as it comes.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))
        >>> half = torch.diag(torch.tensor([0.5, 0.5, 1.0]))  # images of half the size
        >>> F_half = torchsfm.tensors.transform_fundamental(F, half, half)
        >>> torchsfm.geometry.epipolar_distance(F_half, torch.tensor([[50.0, 25.0]]), torch.tensor([[40.0, 28.0]]))
        tensor([3.])
    """
    check_tensors(F=(F, "3 3"), H1=(H1, "3 3"), H2=(H2, "3 3"))
    return _inverse(H2).mT @ F @ _inverse(H1)


def transform_trifocal(
    T: Float[Tensor, "*#batch 3 3 3"],
    H1: Float[Tensor, "*#batch 3 3"],
    H2: Float[Tensor, "*#batch 3 3"],
    H3: Float[Tensor, "*#batch 3 3"],
) -> Float[Tensor, "*batch 3 3 3"]:
    """The trifocal tensor of the points H1 x1, H2 x2 and H3 x3.

    Args:
        T: Trifocal tensors of any scale.
        H1: Change of coordinates of the first image. One that is not regular gives a meaningless finite result.
        H2: Change of coordinates of the second image.
        H3: Change of coordinates of the third image.

    Returns:
        T in the new coordinates, the scale as it comes.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> half = torch.diag(torch.tensor([0.5, 0.5, 1.0], dtype=P.dtype))  # images of half the size
        >>> T = torchsfm.tensors.transform_trifocal(torchsfm.tensors.trifocal_from_cameras(*P), half, half, half)
        >>> truth = torchsfm.tensors.trifocal_from_cameras(*(half @ P))
        >>> round(float((T * truth).sum().abs() / T.norm() / truth.norm()), 6)  # 1: the same up to scale
        1.0
    """
    check_tensors(T=(T, "3 3 3"), H1=(H1, "3 3"), H2=(H2, "3 3"), H3=(H3, "3 3"))
    return torch.einsum("...abc,...ai,...jb,...kc->...ijk", T, _inverse(H1), H2, H3)


def transform_quadrifocal(
    Q: Float[Tensor, "*#batch 3 3 3 3"],
    H1: Float[Tensor, "*#batch 3 3"],
    H2: Float[Tensor, "*#batch 3 3"],
    H3: Float[Tensor, "*#batch 3 3"],
    H4: Float[Tensor, "*#batch 3 3"],
) -> Float[Tensor, "*batch 3 3 3 3"]:
    """The quadrifocal tensor of the points H1 x1 to H4 x4.

    Args:
        Q: Quadrifocal tensors of any scale.
        H1: Change of coordinates of the first image.
        H2: Change of coordinates of the second image.
        H3: Change of coordinates of the third image.
        H4: Change of coordinates of the fourth image.

    Returns:
        Q in the new coordinates, the scale as it comes.

    Example:
        >>> import torch, torchsfm
        >>> P = torchsfm.random_poses(4, generator=torch.Generator().manual_seed(0)).matrix()
        >>> half = torch.diag(torch.tensor([0.5, 0.5, 1.0], dtype=P.dtype))  # images of half the size
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> Q = torchsfm.tensors.transform_quadrifocal(Q, half, half, half, half)
        >>> truth = torchsfm.tensors.quadrifocal_from_cameras(*(half @ P))
        >>> round(float((Q * truth).sum().abs() / Q.norm() / truth.norm()), 6)  # 1: the same up to scale
        1.0
    """
    check_tensors(Q=(Q, "3 3 3 3"), H1=(H1, "3 3"), H2=(H2, "3 3"), H3=(H3, "3 3"), H4=(H4, "3 3"))
    return torch.einsum("...abcd,...pa,...qb,...rc,...sd->...pqrs", Q, H1, H2, H3, H4)


def basis_homography(x: Float[Tensor, "*batch 4 2"]) -> Float[Tensor, "*batch 3 3"]:
    """The homography that takes four points to the projective basis (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1).

    Args:
        x: Four points, no three of them on a line.

    Returns:
        H with norm 1; finite without meaning, and singular, where three points are on a line or one is not finite.
        Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [5.0, 5.0]])
        >>> H = torchsfm.tensors.basis_homography(x)
        >>> y = H @ torchsfm.geometry.to_homogeneous(x)[3]
        >>> y / y[2]  # the fourth becomes (1, 1, 1)
        tensor([1.0000, 1.0000, 1.0000])
    """
    check_tensors(x=(x, "4 2"))
    finite = torch.isfinite(x).all(-1).all(-1)[..., None, None]
    h = to_homogeneous(torch.where(finite, x, 0))
    A = adjugate_3x3(h[..., :3, :].mT)
    c = (A @ h[..., 3, :, None])[..., 0]
    weights = c[..., [1, 2, 0]] * c[..., [2, 0, 1]]
    return split_last(normalize_sphere((weights[..., None] * A).flatten(-2)), 3, 3)


def reduced_fundamental(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]
) -> Float[Tensor, "*batch 3 3"]:
    """The fundamental matrix in the bases that four corresponding points make in both images (Heyden 1995).

    Its diagonal is 0 and the sum of its entries is 0 if the four points satisfy x2' F x1 = 0; five numbers remain, up to scale
    and det F = 0.

    Args:
        F: Fundamental matrices of any scale.
        x1: Four points in the first image, no three on a line.
        x2: The corresponding points in the second image.

    Returns:
        The reduced matrix with norm 1.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, X = torchsfm.random_poses(2, generator=g).matrix(), torchsfm.random_points(4, generator=g)
        >>> F = torchsfm.tensors.fundamental_from_cameras(*P)
        >>> F = torchsfm.tensors.reduced_fundamental(F, *torchsfm.project_points(P, X))
        >>> bool(F.diagonal().abs().max() < 1e-9), bool(F.sum().abs() < 1e-9)
        (True, True)
    """
    check_tensors(F=(F, "3 3"), x1=(x1, "4 2"), x2=(x2, "4 2"))
    return unit_tensor(transform_fundamental(F, basis_homography(x1), basis_homography(x2)), 2)[0]


def reduced_trifocal(T: Float[Tensor, "*#batch 3 3 3"], x: Float[Tensor, "*#batch 3 4 2"]) -> Float[Tensor, "*batch 3 3 3"]:
    """The trifocal tensor in the bases that four corresponding points make in the three images.

    Slice i has entries in row i and column i alone if the points correspond, 15 numbers in all; the fourth point relates them.

    Args:
        T: Trifocal tensors of any scale.
        x: Four points in three views, no three of them on a line in any.

    Returns:
        The reduced tensor with norm 1.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, X = torchsfm.random_poses(3, generator=g).matrix(), torchsfm.random_points(4, generator=g)
        >>> T = torchsfm.tensors.trifocal_from_cameras(*P)
        >>> T = torchsfm.tensors.reduced_trifocal(T, torchsfm.project_points(P, X))
        >>> int((T.abs() > 1e-9).sum())
        15
    """
    check_tensors(T=(T, "3 3 3"), x=(x, "3 4 2"))
    return unit_tensor(transform_trifocal(T, *basis_homography(x).unbind(-3)), 3)[0]


def reduced_quadrifocal(
    Q: Float[Tensor, "*#batch 3 3 3 3"], x: Float[Tensor, "*#batch 4 4 2"]
) -> Float[Tensor, "*batch 3 3 3 3"]:
    """The quadrifocal tensor in the bases that four corresponding points make in the four images.

    Q^pqrs is 0 where p, q, r, s do not name all three coordinates, if the points correspond: 36 numbers remain.

    Args:
        Q: Quadrifocal tensors of any scale.
        x: Four points in four views, no three of them on a line in any.

    Returns:
        The reduced tensor with norm 1.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P, X = torchsfm.random_poses(4, generator=g).matrix(), torchsfm.random_points(4, generator=g)
        >>> Q = torchsfm.tensors.quadrifocal_from_cameras(*P)
        >>> Q = torchsfm.tensors.reduced_quadrifocal(Q, torchsfm.project_points(P, X))
        >>> int((Q.abs() > 1e-9).sum())
        36
    """
    check_tensors(Q=(Q, "3 3 3 3"), x=(x, "4 4 2"))
    return unit_tensor(transform_quadrifocal(Q, *basis_homography(x).unbind(-3)), 4)[0]


def _inverse(H: Tensor) -> Tensor:
    """The inverse, or the adjugate where there is none."""
    det = determinant_3x3(H)
    good = det != 0
    return adjugate_3x3(H) / torch.where(good, det, 1)[..., None, None]
