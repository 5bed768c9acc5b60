"""Four points in a plane: the homography x2 ~ H x1, in closed form.

The four points of each image are written in the basis of the first three, p4 = l1 p1 + l2 p2 + l3 p3 (homogeneous). Then
H = sum_j (l'_j / l_j) p'_j q_j' where the q_j are the rows of [p1 p2 p3]^-1: the two maps from the canonical projective basis
composed (Hartley & Zisserman 2004, 2.3; Semple & Kneebone). Multiplied out it needs no division.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.optim import attach_implicit, wants_derivative

_CHUNK = 4096
"""Problems at a time: their numbers fit the cache."""


def equations(
    H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]
) -> Float[Tensor, "*batch 9"]:
    """The nine equations of the nine entries of H: two of x2 x (H x1) = 0 for each point, and |H| = 1."""
    y = x1 @ H[..., :2].mT + H[..., None, :, 2]
    first = y[..., 0] - x2[..., 0] * y[..., 2]
    second = y[..., 1] - x2[..., 1] * y[..., 2]
    gauge = (H * H).sum((-2, -1)) - 1
    return torch.cat((first, second, gauge[..., None].expand(*first.shape[:-1], 1)), -1)


def homography_4pt(
    x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]
) -> Solutions[Float[Tensor, "*batch 1 3 3"]]:
    """The homography that takes four points to four points, x2 ~ H x1, with |H| = 1 (Frobenius).

    Args:
        x1: Four points in the first image, in any unit.
        x2: The corresponding points in the second image.

    Returns:
        One slot. Not valid where three of the four points are collinear in either image (then no invertible H exists or it is
        not unique), where points coincide, or where a coordinate is not finite. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    batch = check_tensors(x1=(x1, "4 2"), x2=(x2, "4 2"))
    with torch.no_grad():
        rows1, rows2 = (x.detach().expand(*batch, 4, 2).reshape(-1, 4, 2).permute(1, 2, 0) for x in (x1, x2))
        starts = range(0, max(rows1.shape[-1], 1), _CHUNK)
        chunks = [_solve(rows1[..., i : i + _CHUNK], rows2[..., i : i + _CHUNK]) for i in starts]
        rows, good = (torch.cat(parts, -1) for parts in zip(*chunks, strict=True))
        H = rows.mT.reshape(*batch, 1, 3, 3)
        valid = good.reshape(*batch, 1)
    if wants_derivative(x1, x2):
        H = attach_implicit(equations, H, x1[..., None, :, :], x2[..., None, :, :], dims=2, valid=valid)
    return Solutions(H, valid)


def _solve(x1: Float[Tensor, "4 2 batch"], x2: Float[Tensor, "4 2 batch"]) -> tuple[Tensor, Tensor]:
    """H as (9, batch) and valid as (batch)."""
    # Both images together, the fourth point at the origin and the largest coordinate 1. NaN and inf show in the size.
    x = torch.stack((x1, x2), 2)
    y = x[:3] - x[3]
    size = y.abs().amax((0, 1))
    fine = ((size > 0) & (size < torch.inf)).all(0)
    u, v = (y * (1 / size)).unbind(1)
    # The weights of three points in the fourth are 2x2 cross products.
    (u0, u1, u2), (v0, v1, v2) = u.unbind(0), v.unbind(0)
    weights = torch.stack((u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0))
    areas = torch.cat((weights, add_rows(weights)[None])).abs().amin((0, 1))
    # First image: u, v, weights k; second: a, b, weights m.
    (k0, m0), (k1, m1), (k2, m2) = (row.unbind(0) for row in weights.unbind(0))
    (u0, a0), (u1, a1), (u2, a2) = u0.unbind(0), u1.unbind(0), u2.unbind(0)
    (v0, b0), (v1, b1), (v2, b2) = v0.unbind(0), v1.unbind(0), v2.unbind(0)
    (cu, ca), (cv, cb) = x[3, 0].unbind(0), x[3, 1].unbind(0)
    d1, d2 = size.unbind(0)
    w0, w1, w2 = m0 * k1 * k2, m1 * k2 * k0, m2 * k0 * k1

    def column(p: Tensor, q: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The points of the second image with these weights, in its own coordinates."""
        low = p + q + r
        top, middle = combine_rows((a0, a1, a2), (p, q, r)), combine_rows((b0, b1, b2), (p, q, r))
        return torch.addcmul(top * d2, ca, low), torch.addcmul(middle * d2, cb, low), low

    # Columns of adj [p1 p2 p3]'; then (a, b, c) -> (a, b, c d - a cu - b cv) for the first image's own coordinates.
    first = column((v1 - v2) * w0, (v2 - v0) * w1, (v0 - v1) * w2)
    second = column((u2 - u1) * w0, (u0 - u2) * w1, (u1 - u0) * w2)
    third = column(k0 * w0, k1 * w1, k2 * w2)
    last = [c * d1 - a * cu - b * cv for a, b, c in zip(first, second, third, strict=True)]
    H = torch.stack([entry for row in zip(first, second, last, strict=True) for entry in row])
    # The squares of small numbers must not vanish.
    H = H / H.abs().amax(0)
    square = combine_rows(H, H)
    valid = fine & (areas > 64 * torch.finfo(H.dtype).eps) & torch.isfinite(square)
    identity = torch.eye(3, dtype=H.dtype, device=H.device).reshape(9, 1) / 3**0.5
    return torch.where(valid, H * square.rsqrt(), identity), valid
