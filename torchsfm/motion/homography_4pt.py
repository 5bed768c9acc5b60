"""Four points in a plane: the homography x2 ~ H x1, in closed form.

The four points of each image are written in the basis of the first three, p4 = l1 p1 + l2 p2 + l3 p3 (homogeneous). Then
H = sum_j (l'_j / l_j) p'_j q_j' where the q_j are the rows of [p1 p2 p3]^-1: the two maps from the canonical projective basis
composed (Hartley & Zisserman 2004, 2.3; Semple & Kneebone). Multiplied out it needs no division.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
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
    check_tensors(x1=(x1, "4 2"), x2=(x2, "4 2"))
    H, valid = _solve(x1.detach(), x2.detach())
    if wants_derivative(x1, x2):
        H = attach_implicit(equations, H, x1[..., None, :, :], x2[..., None, :, :], dims=2, valid=valid)
    return Solutions(H, valid)


def _centred(x: Tensor) -> tuple[list[Tensor], list[Tensor], tuple[Tensor, Tensor, Tensor]]:
    """Rows of u and v with the fourth point at the origin and the largest coordinate 1, and what undoes it."""
    x = torch.where(torch.isfinite(x).all(-1).all(-1)[..., None, None], x, 0)
    u = [row.contiguous() for row in x[..., 0].unbind(-1)]
    v = [row.contiguous() for row in x[..., 1].unbind(-1)]
    cu, cv = u[3], v[3]
    u, v = [a - cu for a in u[:3]], [a - cv for a in v[:3]]
    size = u[0].abs()
    for a in (*u[1:], *v):
        size = torch.maximum(size, a.abs())
    inverse = torch.where(size > 0, 1 / size, 0)
    return [a * inverse for a in u], [a * inverse for a in v], (cu, cv, inverse)


def _solve(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    x1, x2 = torch.broadcast_tensors(x1, x2)
    (u, v, (cu, cv, inv1)), (a, b, (ca, cb, inv2)) = _centred(x1), _centred(x2)
    # With the fourth point at the origin, the weights are the 2x2 cross products of the other three.
    l0, l1, l2 = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    m0, m1, m2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    det1, det2 = l0 + l1 + l2, m0 + m1 + m2
    w0, w1, w2 = m0 * l1 * l2, m1 * l2 * l0, m2 * l0 * l1
    # Rows of adj [p1 p2 p3]: (v_j - v_k, u_k - u_j, l_i).
    rows = ((v[1] - v[2], u[2] - u[1], l0), (v[2] - v[0], u[0] - u[2], l1), (v[0] - v[1], u[1] - u[0], l2))
    g = []
    for q in range(3):
        s0, s1, s2 = w0 * rows[0][q], w1 * rows[1][q], w2 * rows[2][q]
        g.append((a[0] * s0 + a[1] * s1 + a[2] * s2, b[0] * s0 + b[1] * s1 + b[2] * s2, s0 + s1 + s2))
    # Undo: x1 -> (x1 - c1) * inv1 on the right, x2 = y / inv2 + c2 on the left.
    left = []
    for top, middle, bottom in g:
        left.append((top + ca * inv2 * bottom, middle + cb * inv2 * bottom, bottom * inv2))
    columns = [[e * inv1 for e in left[0]], [e * inv1 for e in left[1]]]
    columns.append([e - cu * f - cv * h for e, f, h in zip(left[2], *columns, strict=True)])
    entries = [columns[j][i] for i in range(3) for j in range(3)]
    scale = entries[0].abs()
    for e in entries[1:]:
        scale = torch.maximum(scale, e.abs())
    inverse = 1 / scale
    entries = [e * inverse for e in entries]
    norm = entries[0] * entries[0]
    for e in entries[1:]:
        norm = norm + e * e
    inverse = norm.rsqrt()
    eps = 64 * torch.finfo(x1.dtype).eps
    smallest = l0.abs()
    for e in (l1, l2, det1, m0, m1, m2, det2):
        smallest = torch.minimum(smallest, e.abs())
    valid = (smallest > eps) & torch.isfinite(norm) & torch.isfinite(x1).all(-1).all(-1) & torch.isfinite(x2).all(-1).all(-1)
    H = torch.stack([e * inverse for e in entries], -1).unflatten(-1, (3, 3))
    return torch.where(valid[..., None, None], H, torch.eye(3, dtype=H.dtype, device=H.device))[..., None, :, :], valid[
        ..., None
    ]
