"""Distances between measured and predicted image points, in pixels and unsquared."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.cameras import project_points
from torchsfm.geometry.homogeneous import finite_or_zero, transform_points


def sampson_distance(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """Measure how far point pairs are from satisfying `x2' F x1 = 0`, to first order (Sampson 1982; HZ 11.4.3).

    It approximates the distance in 4-space from (x1, x2) to the nearest exact pair.

    Args:
        F: Fundamental matrix, up to scale.
        x1: Points in the first image.
        x2: Points in the second image.

    Returns:
        Distances, in the unit of the points. Where F gives no epipolar lines at the pair (both points are epipoles, or F is
        zero), and for pairs with NaN or inf, a huge finite number.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))  # moved sideways: lines y2 = y1
        >>> torchsfm.geometry.sampson_distance(F, torch.tensor([[0.0, 1.0]]), torch.tensor([[7.0, 3.0]]))  # each moves by 1
        tensor([1.4142])
    """
    error, a, b, good = _epipolar(F, x1, x2)
    return torch.where(good, error.abs() / torch.where(good, a + b, 1.0).sqrt(), _huge(error))


def epipolar_distance(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """Measure the distances of point pairs from each other's epipolar lines: the root mean square over the two images.

    Args:
        F: Fundamental matrix, up to scale.
        x1: Points in the first image.
        x2: Points in the second image.

    Returns:
        Distances, in the unit of the points. Where one is an epipole, and for pairs with NaN or inf, a huge finite number.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))  # moved sideways: lines y2 = y1
        >>> torchsfm.geometry.epipolar_distance(F, torch.tensor([[0.0, 1.0]]), torch.tensor([[7.0, 3.0]]))
        tensor([2.])
    """
    error, a, b, _ = _epipolar(F, x1, x2)
    good = (a > 0) & (b > 0)
    a, b = torch.where(good, a, 1.0), torch.where(good, b, 1.0)
    return torch.where(good, error.abs() * (0.5 / a + 0.5 / b).sqrt(), _huge(error))


def transfer_distance(
    H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """Measure the distances of points from each other's transfer by a homography: the root mean square over both images.

    Args:
        H: Homography from the first image to the second, up to scale.
        x1: Points in the first image.
        x2: Points in the second image.

    Returns:
        Distances, in the unit of the points; huge but finite where a point is sent to infinity, where H is singular, and for
        pairs with NaN or inf.

    Example:
        >>> import torch, torchsfm
        >>> shift = torch.tensor([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        >>> torchsfm.geometry.transfer_distance(shift, torch.tensor([[0.0, 0.0]]), torch.tensor([[8.0, 4.0]]))
        tensor([5.])
    """
    check_tensors(x1=(x1, "n 2"), x2=(x2, "n 2"), H=(H, "3 3"))
    good = (torch.isfinite(x1) & torch.isfinite(x2)).all(-1)
    x1, x2 = torch.where(good[..., None], x1, 0.0), torch.where(good[..., None], x2, 0.0)
    r1, r2, r3 = H.unbind(-2)
    cross = torch.linalg.cross
    inverse = torch.stack([cross(r2, r3, dim=-1), cross(r3, r1, dim=-1), cross(r1, r2, dim=-1)], -1)
    forward, backward = transform_points(H, x1) - x2, transform_points(inverse, x2) - x1
    distance = torch.linalg.vector_norm(torch.cat([forward, backward], -1), dim=-1) * math.sqrt(0.5)
    regular = (inverse.detach() != 0).any(-1).any(-1)[..., None]
    return torch.where(good & regular, distance, _huge(distance))


def reprojection_distance(
    P: Float[Tensor, "*#batch 3 4"], X: Float[Tensor, "*#batch n 3"], x: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """Measure the distances between measured points and projected ones.

    Args:
        P: Camera matrix, up to scale.
        X: Points in space.
        x: Their measured images.

    Returns:
        Distances, in the unit of x; huge but finite for points in the focal plane and for those with NaN or inf. Points behind
        the camera are projected like any other: see `point_depths`.

    Example:
        >>> import torch, torchsfm
        >>> X, x = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[3.0, 4.0]])
        >>> torchsfm.geometry.reprojection_distance(torch.eye(3, 4), X, x)
        tensor([5.])
    """
    check_tensors(X=(X, "n 3"), x=(x, "n 2"), P=(P, "3 4"))
    good = torch.isfinite(X).all(-1) & torch.isfinite(x).all(-1)
    distance = torch.linalg.vector_norm(project_points(P, X) - finite_or_zero(x), dim=-1)
    return torch.where(good, distance, _huge(distance))


def _epipolar(F: Tensor, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Evaluate x2' F x1, its squared gradients by x2 and by x1, and where all that means something."""
    check_tensors(x1=(x1, "n 2"), x2=(x2, "n 2"), F=(F, "3 3"))
    good = (torch.isfinite(x1) & torch.isfinite(x2)).all(-1)
    x1, x2 = torch.where(good[..., None], x1, 0.0), torch.where(good[..., None], x2, 0.0)
    l2 = x1 @ F[..., :2].mT + F[..., None, :, 2]
    l1 = x2 @ F[..., :2, :2] + F[..., None, 2, :2]
    error = (l2[..., :2] * x2).sum(-1) + l2[..., 2]
    a, b = l2[..., :2].square().sum(-1), l1.square().sum(-1)
    a, b = torch.where(good, a, 0.0), torch.where(good, b, 0.0)
    return error, a, b, a + b > 0


def _huge(like: Tensor) -> Tensor:
    """Return a number that may still be squared without overflow."""
    return torch.full_like(like, math.sqrt(torch.finfo(like.dtype).max) / 2)
