"""What images of conics say by themselves: how well each shows its ellipse, and how far its edge points are from it."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry.conic_distance import foot_normal, square_root
from torchsfm.geometry.conics import shape_of_dual_conic
from torchsfm.linalg import eigvalsh, inverse
from torchsfm.triangulation.conic_images import ConicImages

_UNKNOWN = 0.4
"""The standard deviation of centre and semi-axes together, over the longest, from which an arc does not show its ellipse."""
_UNKNOWN_AS_GIVEN = 0.2
"""The same of covariances, which say what they do near the ellipse alone."""
_WORSE = 1.3
"""Times what its edge points are off each image's own ellipse, which they may be off those of the model,"""
_SIGNIFICANT = 20.0
"""where the variance of what they are more exceeds that of noise by so much,"""
_FALSE = 100.0
"""and by this much where covariances say what noise is."""


class Evidence(NamedTuple):
    """What each image says without the others."""

    known: Bool[Tensor, "*batch v"]
    """Whether the ellipse is determined."""
    square: Float[Tensor, "*batch"]
    """The sum of squared distances (weighted) of all edge points from the ellipses of their own images,"""
    free: Float[Tensor, "*batch"]
    """and how many of these are more than the ellipses take."""
    whitened: bool
    """Whether there are covariances instead of edge points."""


def evidence(images: ConicImages) -> Evidence:
    """The evidence of ellipses that were measured."""
    sights, seen = images.sights, images.seen
    w = images.weights.reshape(*images.weights.shape[:-1], *sights.y.shape[-3:-1])
    centre, D, _ = shape_of_dual_conic(images.dual)
    root = square_root(D)
    away = sights.y - centre[..., None, :]
    n = sights.y if sights.white is not None else foot_normal(D, away)
    h = ((n @ D) * n).sum(-1).clamp_min(1e-300).sqrt()
    q = n @ root / h[..., None]
    # Of the centre, and of the root as a matrix, whose norm does not depend on the axes of the image.
    mixed = (q[..., 0] * n[..., 1] + q[..., 1] * n[..., 0]) * 0.5**0.5
    J = torch.stack((n[..., 0], n[..., 1], q[..., 0] * n[..., 0], mixed, q[..., 1] * n[..., 1]), -1)
    if sights.white is not None:
        J, number, square = sights.white @ J, w[..., 0] * 0.0, w[..., 0] * 0.0
        noise = torch.ones_like(square)
    else:
        J = J * sights.unit[..., None, None]
        r = ((n * away).sum(-1) - h) * sights.unit[..., None]
        square, number = (w * r.square()).sum(-1), (w > 0).to(w.dtype).sum(-1) - 5
        noise = square / number.clamp_min(1)
    J = torch.where((w > 0)[..., None], J, 0.0)
    information = (w[..., None] * J).mT @ J
    eye = torch.eye(5, dtype=w.dtype, device=w.device)
    size = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp_min(1e-300)
    found, solved = inverse(information / size + 1e-14 * eye)
    spread = (found / size).diagonal(dim1=-2, dim2=-1).sum(-1) * noise
    longest = eigvalsh(D)[0][..., 1]
    limit = _UNKNOWN if sights.white is None else _UNKNOWN_AS_GIVEN
    known = solved & (spread <= limit**2 * longest)
    some = seen & (number >= 0) & images.measured
    square, number = (torch.where(some, t, 0.0).sum(-1) for t in (square, number))
    return Evidence(known, square, number, sights.white is not None)


def contradicted(found: Evidence, squares: Tensor, taken: Tensor, rounding: Tensor) -> Bool[Tensor, "*batch"]:
    """Whether edge points are clearly farther from the images of a model than from the ellipses of their own images.

    Args:
        found: What the images say.
        squares: Of the distances from the model, weighted.
        taken: How many more parameters the ellipses have than the model.
        rounding: Squares that mean nothing.
    """
    if found.whitened:
        return squares > _FALSE * taken.clamp_min(1) + rounding
    square = found.square + rounding
    excess = (squares - square) * found.free / (square * taken.clamp_min(1))
    return (found.free > 0) & (squares > _WORSE**2 * square) & (excess > _SIGNIFICANT)
