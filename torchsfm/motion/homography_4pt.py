"""Four points in a plane: the homography x2 ~ H x1, in closed form.

The four points of each image are written in the basis of the first three, p4 = l1 p1 + l2 p2 + l3 p3 (homogeneous). Then
H = sum_j (l'_j / l_j) p'_j q_j' where the q_j are the rows of [p1 p2 p3]^-1: the two maps from the canonical projective basis
composed (Hartley & Zisserman 2004, 2.3; Semple & Kneebone). Multiplied out it needs no division.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.compilation import kernel
from torchsfm.linalg.vectors import fma, fms
from torchsfm.optim import attach_implicit, wants_derivative


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
        rows1, rows2 = (x.detach().double().expand(*batch, 4, 2).reshape(-1, 8).t() for x in (x1, x2))
        rows, good = _solve(rows1, rows2)
        H = rows.t().reshape(*batch, 1, 3, 3).to(x1.dtype)
        valid = good.reshape(*batch, 1)
    if wants_derivative(x1, x2):
        H = attach_implicit(equations, H, x1[..., None, :, :], x2[..., None, :, :], dims=2, valid=valid)
    return Solutions(H, valid)


@kernel(chunk=8192)
def _solve(x1: Float[Tensor, "8 batch"], x2: Float[Tensor, "8 batch"]) -> tuple[Tensor, Tensor]:
    """H as (9, batch) and valid as (batch)."""
    (u0, u1, u2), (v0, v1, v2), (cu, cv), d1 = _around_the_fourth(x1)
    (a0, a1, a2), (b0, b1, b2), (ca, cb), d2 = _around_the_fourth(x2)
    # The weights of three points in the fourth are 2x2 cross products.
    k0, k1, k2 = fms(u2, v1, u1 * v2), fms(u0, v2, u2 * v0), fms(u1, v0, u0 * v1)
    m0, m1, m2 = fms(a2, b1, a1 * b2), fms(a0, b2, a2 * b0), fms(a1, b0, a0 * b1)
    areas = k0.abs()
    for area in (k1, k2, k0 + k1 + k2, m0, m1, m2, m0 + m1 + m2):
        areas = torch.minimum(areas, area.abs())
    w0, w1, w2 = m0 * (k1 * k2), m1 * (k2 * k0), m2 * (k0 * k1)

    def column(p: Tensor, q: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The points of the second image with these weights, in its own coordinates."""
        low = p + q + r
        top, middle = fma(a2, r, fma(a1, q, a0 * p)), fma(b2, r, fma(b1, q, b0 * p))
        return fma(ca, low, top * d2), fma(cb, low, middle * d2), low

    # Columns of adj [p1 p2 p3]'; then (a, b, c) -> (a, b, c d - a cu - b cv) for the first image's own coordinates.
    first = column((v1 - v2) * w0, (v2 - v0) * w1, (v0 - v1) * w2)
    second = column((u2 - u1) * w0, (u0 - u2) * w1, (u1 - u0) * w2)
    third = column(k0 * w0, k1 * w1, k2 * w2)
    last = [fms(b, cv, fms(a, cu, c * d1)) for a, b, c in zip(first, second, third, strict=True)]
    rows = [entry for row in zip(first, second, last, strict=True) for entry in row]
    square = rows[0] * rows[0]
    for row in rows[1:]:
        square = fma(row, row, square)
    # False for NaN; an empty slot holds the identity.
    valid = (areas > 64 * torch.finfo(x1.dtype).eps) & (square > 0) & (square < torch.inf)
    scale = torch.where(valid, square.rsqrt(), 0.0)
    empty = torch.where(valid, 0.0, 3**-0.5)
    rows = [(row * scale).nan_to_num(0.0, 0.0, 0.0) for row in rows]
    for i in (0, 4, 8):
        rows[i] = rows[i] + empty
    return torch.stack(rows), valid


def _around_the_fourth(x: Tensor) -> tuple[list[Tensor], list[Tensor], tuple[Tensor, Tensor], Tensor]:
    """First three points with the fourth at the origin and the largest coordinate 1; what they were moved and scaled by."""
    *points, cu, cv = x.unbind(0)
    us, vs = [u - cu for u in points[0::2]], [v - cv for v in points[1::2]]
    size = us[0].abs()
    for coordinate in (*us[1:], *vs):
        size = torch.maximum(size, coordinate.abs())
    scale = 1 / size
    return [u * scale for u in us], [v * scale for v in vs], (cu, cv), size
