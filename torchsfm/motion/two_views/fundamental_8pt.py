"""Eight points or more in two uncalibrated images: F by the normalised eight-point algorithm (Hartley 1997; HZ 11.2)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_tensors
from torchsfm.linalg import nearest_rank, null_vector


def fundamental_8pt(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    weights: Float[Tensor, "*#batch n"] | None = None,
) -> Float[Tensor, "*batch 3 3"]:
    """The F of rank 2 with least algebraic error x2' F x1 in normalised coordinates, with |F| = 1 (Frobenius).

    Args:
        x1: At least eight points in the first image.
        x2: The corresponding points in the second image.
        weights: Weight of each squared error, >= 0; 0 means absent, and what stands there is not looked at. None: all 1.

    Returns:
        F, always finite, without status. Where the weighted points do not determine it (fewer than eight, points in a plane or
        on a quadric through both centres, a pure rotation) it is one of the least-squares solutions; where a coordinate or
        weight that counts is not finite, diag(1, 1, 0) / sqrt(2). Differentiable in all arguments, with zero derivative along
        what the data do not determine.

    Raises:
        ValueError: Wrong shape, dtype or device, or n < 8.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(20, generator=g), torchsfm.random_poses(2, generator=g).matrix()
        >>> x1, x2 = torchsfm.project_points(P, X)
        >>> F = torchsfm.motion.fundamental_8pt(x1, x2)
        >>> bool(torchsfm.geometry.sampson_distance(F, x1, x2).max() < 1e-6)
        True
    """
    check_tensors(x1=(x1, "n>=8 2"), x2=(x2, "n 2"), weights=(weights, "?n"))
    y1, y2, w, T1, T2_inverse, finite = _normalised(x1, x2, weights)
    one = torch.ones_like(y1[..., :1])
    h1, h2 = torch.cat((y1, one), -1), torch.cat((y2, one), -1)
    A = (w[..., None, None] * h2[..., :, None] * h1[..., None, :]).flatten(-2)
    f, _ = null_vector(A)
    F = nearest_rank(f.reshape(*f.shape[:-1], 3, 3), 2)
    # T2 from its inverse: a similarity [s I, c] has the inverse [I / s, -c / s].
    T2 = _inverse_similarity(T2_inverse)
    F = T2.mT @ F @ T1
    F = F / (F * F).sum((-2, -1), keepdim=True).sqrt()
    fallback = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=F.dtype, device=F.device)) / 2**0.5
    return torch.where(finite[..., None, None], F, fallback).to(x1.dtype)


def _inverse_similarity(T: Tensor) -> Tensor:
    scale, centre = T[..., :1, :1], T[..., :2, 2:]
    top = torch.cat((torch.eye(2, dtype=T.dtype, device=T.device) / scale, -centre / scale), -1)
    return torch.cat((top, T[..., 2:, :]), -2)


def _normalised(x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Both images in float64 with weighted centroid 0 and mean distance sqrt 2; root weights, T1, T2^-1, finite elements."""
    w = torch.ones_like(x1[..., 0]) if weights is None else weights
    w = w.double()
    shape = broadcast_shapes(x1.shape[:-1], x2.shape[:-1], w.shape)
    w = w.expand(shape)
    y1, y2 = x1.double().expand(*shape, 2), x2.double().expand(*shape, 2)
    absent = w == 0
    finite = (torch.isfinite(y1).all(-1) & torch.isfinite(y2).all(-1) & torch.isfinite(w) & (w >= 0) | absent).all(-1)
    keep = finite[..., None] & ~absent
    w = torch.where(keep, w, 0)
    total = w.sum(-1, keepdim=True)
    share = w / torch.where(total > 0, total, 1)
    out = []
    for y in (y1, y2):
        y = torch.where(keep[..., None], y, 0)
        centre = (share[..., None] * y).sum(-2, keepdim=True)
        offset = torch.where(keep[..., None], y - centre, 0)
        squared = (offset * offset).sum(-1)
        # sqrt has no derivative at 0; a point in the centroid adds nothing.
        away = squared > 0
        distance = torch.where(away, torch.where(away, squared, 1).sqrt(), 0)
        size = (share * distance).sum(-1) / 2**0.5
        size = torch.where(size > 0, size, 1)[..., None, None]
        out.append((offset / size, centre, size))
    (n1, c1, s1), (n2, c2, s2) = out
    eye = torch.eye(2, dtype=w.dtype, device=w.device)
    last = torch.zeros(*shape[:-1], 1, 3, dtype=w.dtype, device=w.device)
    last[..., 2] = 1
    T1 = torch.cat((torch.cat((eye / s1, -c1.mT / s1), -1), last), -2)
    T2_inverse = torch.cat((torch.cat((eye * s2, c2.mT), -1), last), -2)
    root = torch.where(keep, torch.where(keep, w, 1).sqrt(), 0)
    return n1, n2, root, T1, T2_inverse, finite
