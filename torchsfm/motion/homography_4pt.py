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
        rows1, rows2 = (x.detach().expand(*batch, 4, 2).reshape(-1, 4, 2).permute(1, 2, 0).contiguous() for x in (x1, x2))
        starts = range(0, max(rows1.shape[-1], 1), _CHUNK)
        chunks = [_solve(rows1[..., i : i + _CHUNK], rows2[..., i : i + _CHUNK]) for i in starts]
        rows, good = (torch.cat(parts, -1) for parts in zip(*chunks, strict=True))
        H = rows.mT.reshape(*batch, 1, 3, 3)
        valid = good.reshape(*batch, 1)
    if wants_derivative(x1, x2):
        H = attach_implicit(equations, H, x1[..., None, :, :], x2[..., None, :, :], dims=2, valid=valid)
    return Solutions(H, valid)


def _centred(x: Float[Tensor, "4 2 batch"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Three points (3, 2, batch) with the fourth at the origin and the largest coordinate 1; what undoes it; what is fine."""
    origin = x[3]
    offset = x[:3] - origin
    size = offset.abs().amax((0, 1))
    fine = torch.isfinite(size) & torch.isfinite(origin.abs().amax(0)) & (size > 0)
    scale = 1 / torch.where(fine, size, 1)
    return torch.where(fine, offset * scale, 0), torch.where(fine, origin, 0), scale, fine


def _weights(y: Tensor) -> Tensor:
    """The weights of three points in the fourth, which is the origin: 2x2 cross products."""
    u, v = y.unbind(1)
    return torch.stack((u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]))


def _solve(x1: Float[Tensor, "4 2 batch"], x2: Float[Tensor, "4 2 batch"]) -> tuple[Tensor, Tensor]:
    """H as (9, batch) and valid as (batch)."""
    y1, c1, s1, fine1 = _centred(x1)
    y2, c2, s2, fine2 = _centred(x2)
    l1, l2 = _weights(y1), _weights(y2)
    w = l2 * torch.stack((l1[1] * l1[2], l1[2] * l1[0], l1[0] * l1[1]))
    # Rows of adj [p1 p2 p3] times w, and with x1 in its own coordinates again: (a, b, c) -> (a, b, c / s - a c_u - b c_v).
    u, v = y1.unbind(1)
    first = torch.stack((v[1] - v[2], v[2] - v[0], v[0] - v[1])) * w
    second = torch.stack((u[2] - u[1], u[0] - u[2], u[1] - u[0])) * w
    third = l1 * w / s1 - first * c1[0] - second * c1[1]
    q = torch.stack((first, second, third))
    # Columns [p'1 p'2 p'3] in coordinates of the second image: (y / s + c, 1).
    bottom = add_rows(q.unbind(1))
    a, b = y2.unbind(1)
    inverse = 1 / s2
    top = combine_rows(q.unbind(1), a) * inverse + c2[0] * bottom
    middle = combine_rows(q.unbind(1), b) * inverse + c2[1] * bottom
    H = torch.cat((top, middle, bottom))
    # The squares of small numbers must not vanish.
    H = H / H.abs().amax(0)
    H = H * combine_rows(H, H).rsqrt()
    areas = torch.cat((l1, l2, add_rows(l1)[None], add_rows(l2)[None])).abs().amin(0)
    valid = fine1 & fine2 & (areas > 64 * torch.finfo(H.dtype).eps) & torch.isfinite(H).all(0)
    identity = torch.eye(3, dtype=H.dtype, device=H.device).reshape(9, 1) / 3**0.5
    return torch.where(valid, H, identity), valid
