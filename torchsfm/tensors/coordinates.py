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
    """
    check_tensors(Q=(Q, "3 3 3 3"), x=(x, "4 4 2"))
    return unit_tensor(transform_quadrifocal(Q, *basis_homography(x).unbind(-3)), 4)[0]


def _inverse(H: Tensor) -> Tensor:
    """The inverse, or the adjugate where there is none."""
    det = determinant_3x3(H)
    good = det != 0
    return adjugate_3x3(H) / torch.where(good, det, 1)[..., None, None]
