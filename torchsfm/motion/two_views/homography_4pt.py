"""Four points in a plane: the homography x2 ~ H x1, in closed form.

With the fourth point as the origin of each image, p_j = (u_j, v_j, 1), the cross products k0 = p1 x p2, ... of the other
three are the weights with which they make up the fourth (the projective basis of Hartley & Zisserman 2004, 2.3; Semple &
Kneebone). H takes p_j to a multiple of p'_j, the origin to the origin: up to a common factor H p_j = (k'_j / k_j) p'_j and
H (0, 0, 1) = (0, 0, k' / k) with k = k0 + k1 + k2. The points 0 and 1 give its first two columns, by the inverse of
(u0, u1; v0, v1), whose determinant is k2.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.vectors import fma, fms
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_DIGITS = 2**20
"""Areas of triangles are at least so many times larger than what rounding may make of them."""


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

    Example:
        >>> import torch, torchsfm
        >>> x1 = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> x2 = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.5, 1.0], [0.5, 1.0]])  # a square seen aslant
        >>> H = torchsfm.motion.homography_4pt(x1, x2)
        >>> H.valid, torchsfm.geometry.transform_points(H.model[0], torch.tensor([[0.5, 0.5]]))
        (tensor([True]), tensor([[1.0000, 0.6667]]))
    """
    batch = check_tensors(x1=(x1, "4 2"), x2=(x2, "4 2"))
    with torch.no_grad():
        points = [x.detach().double().expand(*batch, 4, 2).movedim((-2, -1), (0, 1)) for x in (x1, x2)]
        rows, good = _solve(torch.stack(points).reshape(16, -1))
        H = rows.permute(2, 0, 1).reshape(*batch, 1, 3, 3).to(x1.dtype)
        valid = good.reshape(*batch, 1)
    if wants_derivative(x1, x2):
        H = attach_implicit(equations, H, for_slots(x1, batch), for_slots(x2, batch), dims=2, valid=valid)
    return Solutions(H, valid)


@kernel(chunk=8192)
def _solve(x: Float[Tensor, "16 batch"]) -> tuple[Tensor, Tensor]:
    """H as (3, 3, batch) and valid as (batch), from the coordinates of the first and of the second image."""
    points = x.view(2, 4, 2, x.shape[-1])
    d = points[:, :3] - points[:, 3:]
    (u0, v0), (u1, v1), (u2, v2) = (p.unbind(1) for p in d.unbind(1))
    # The weights of three points in the fourth are 2x2 cross products, their sum belongs to the fourth.
    k0, k1, k2 = fms(u2, v1, u1 * v2), fms(u0, v2, u2 * v0), fms(u1, v0, u0 * v1)
    areas = torch.stack((k0, k1, k2, k0 + k1 + k2), 1)
    size = d.abs().amax((1, 2))
    # Rounding leaves areas six digits at least. False for NaN.
    valid = (areas.abs().amin(1) > _DIGITS * torch.finfo(x.dtype).eps * size * size).all(0)
    k, m = areas.unbind(0)
    w = m / k
    p0, p1, _ = d[0, :, :, None].unbind(0)
    q0, q1 = torch.cat((w[:2, None] * d[1, :2], (w[:2] - w[3:])[:, None]), 1).unbind(0)
    # The second column with the wrong sign, and the first one.
    columns = fms(q1, p0, q0 * p1)
    # In the coordinates of the second image, then in those of the first.
    (cu, cv), centre = points[:, 3].unbind(0)
    top, low, last = fma(centre, columns[:, 2:], columns[:, :2]), columns[:, 2:], w[3:] * k[2]
    second, first = torch.cat((top, low), 1).unbind(0)
    third = fma(second, cv, fms(first, cu, torch.cat((centre * last, last))))
    H = torch.stack((first, -second, third), 1)
    square = (H * H).sum(0).sum(0)
    valid = valid & (square > 0) & (square < torch.inf)
    # An empty slot holds the identity.
    identity = torch.eye(3, dtype=x.dtype, device=x.device)[..., None] * 3**-0.5
    return torch.where(valid, H * square.rsqrt(), identity), valid
