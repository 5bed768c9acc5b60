"""Four points or more in a plane: the homography by normalised linear least squares (Hartley & Zisserman 2004, 4.1, 4.4)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg import null_vector
from torchsfm.motion.two_views.fundamental_8pt import _normalised


def homography_dlt(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    weights: Float[Tensor, "*#batch n"] | None = None,
) -> Float[Tensor, "*batch 3 3"]:
    """The homography x2 ~ H x1 of least algebraic error in normalised coordinates, with |H| = 1 (Frobenius).

    Args:
        x1: At least four points in the first image.
        x2: The corresponding points in the second image.
        weights: Weight of each squared error, >= 0; 0 means absent, and what stands there is not looked at. None: all 1.

    Returns:
        H, always finite, without status. Where the weighted points do not determine it (fewer than four, all but one collinear)
        it is one of the least-squares solutions; where a coordinate or weight that counts is not finite, I / sqrt(3).

    Raises:
        ValueError: Wrong shape, dtype or device, or n < 4.

    Example:
        >>> import torch, torchsfm
        >>> x1 = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> x2 = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.5, 1.0], [0.5, 1.0]])  # a square seen aslant
        >>> H = torchsfm.motion.homography_dlt(x1, x2)
        >>> torchsfm.geometry.transform_points(H, torch.tensor([[0.5, 0.5]]))
        tensor([[1.0000, 0.6667]])
    """
    check_tensors(x1=(x1, "n>=4 2"), x2=(x2, "n 2"), weights=(weights, "?n"))
    y1, y2, w, T1, T2_inverse, finite = _normalised(x1, x2, weights)
    # (1, 0, -u2) and (0, 1, -v2) times the point in the first image.
    covectors = torch.cat((torch.diag_embed(w[..., None].expand_as(y2)), (-w[..., None] * y2)[..., None]), -1)
    points = torch.cat((y1, torch.ones_like(y1[..., :1])), -1)
    h, _ = null_vector((covectors[..., None] * points[..., None, None, :]).flatten(-2).flatten(-3, -2))
    H = T2_inverse @ h.reshape(*h.shape[:-1], 3, 3) @ T1
    H = H / (H * H).sum((-2, -1), keepdim=True).sqrt()
    fallback = torch.eye(3, dtype=H.dtype, device=H.device) / 3**0.5
    return torch.where(finite[..., None, None], H, fallback).to(x1.dtype)
