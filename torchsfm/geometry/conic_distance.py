"""How far points are from conics: to first order, and exactly from ellipses."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.conics import Ellipse, check_ellipse, ellipse_of_shape, shape_of_ellipse
from torchsfm.geometry.homogeneous import finite_or_zero
from torchsfm.linalg import unit_scale
from torchsfm.linalg.rows import inner

_STEPS = 16
"""Newton steps to the foot point: monotone, they come to rounding, but for points next to a cusp of the evolute of a long
ellipse: these have distances good to 1e-8 of the long axis."""


def conic_distance(C: Float[Tensor, "*#batch 3 3"], x: Float[Tensor, "*#batch n 2"]) -> Float[Tensor, "*batch n"]:
    """The distances of points from conics of any kind, to first order: `|x'Cx| / (2 |(Cx)_12|)` (Sampson 1982).

    Args:
        C: Conics, up to scale.
        x: Points.

    Returns:
        Distances, in the unit of the points. A huge finite number at a centre of the conic, and for points with NaN or inf.

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
        >>> torchsfm.geometry.conic_distance(circle, torch.tensor([[1.0, 0.0], [0.0, 1.1]]))
        tensor([0.0000, 0.0955])
    """
    check_tensors(C=(C, "3 3"), x=(x, "n 2"))
    good = torch.isfinite(x).all(-1)
    C = C * unit_scale(C)
    safe = torch.where(good[..., None], x, 0.0)
    polar = safe @ C[..., :2].mT + C[..., None, :, 2]
    value = (polar[..., :2] * safe).sum(-1) + polar[..., 2]
    slope2 = polar[..., :2].square().sum(-1)
    good = good & (slope2.detach() > 0)
    distance = value.abs() / (2 * torch.where(good, slope2, 1.0).sqrt())
    return torch.where(good, distance, math.sqrt(torch.finfo(x.dtype).max) / 2)


def ellipse_distance(ellipse: Ellipse, x: Float[Tensor, "*#batch n 2"]) -> Float[Tensor, "*batch n"]:
    """The orthogonal distances of points from ellipses, positive outside and negative inside.

    The derivatives, first and second, are those of the distance; nothing is differentiated through the search for the foot
    points.

    Args:
        ellipse: Semi-axes greater than 0.
        x: Points.

    Returns:
        Signed distances, in the unit of the points. Computed in float64. A huge finite number for points with NaN or inf.

    Example:
        >>> import torch, torchsfm
        >>> ellipse = torchsfm.Ellipse(torch.zeros(2), torch.tensor([2.0, 1.0]), torch.tensor(0.0))
        >>> torchsfm.geometry.ellipse_distance(ellipse, torch.tensor([[5.0, 0.0], [0.0, 0.5]]))
        tensor([ 3.0000, -0.5000])
    """
    check_ellipse(ellipse, x=(x, "n 2"))
    good = torch.isfinite(x).all(-1)
    D = shape_of_ellipse(Ellipse(ellipse.centre.double(), ellipse.semi_axes.double(), ellipse.angle.double()))
    distance = signed_distance(ellipse.centre.double(), D, finite_or_zero(x).double())
    return torch.where(good, distance.to(x.dtype), math.sqrt(torch.finfo(x.dtype).max) / 2)


def signed_distance(
    centre: Float[Tensor, "*#batch 2"], D: Float[Tensor, "*#batch 2 2"], x: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*batch n"]:
    """`ellipse_distance` from the ellipse `(x - centre)' D^-1 (x - centre) = 1`.

    An ellipse is convex with the support function sqrt(n'Dn), so the distance is the largest value over unit normals n of
    `n.(x - centre) - sqrt(n'Dn)`. At the maximum, found without derivatives, one Newton step on the angle of n carries the
    derivatives that the maximum has: the first needs none of it, the second its first.
    """
    y = x - centre[..., None, :]
    with torch.no_grad():
        n = foot_normal(D.detach(), y.detach())
    m = torch.stack((-n[..., 1], n[..., 0]), -1)
    nDn, mDn, mDm = _form(D, n, n), _form(D, m, n), _form(D, m, m)
    s = nDn.sqrt()
    slope = inner(m, y) - mDn / s
    bend = -inner(n, y) - (mDm - nDn) / s + mDn.square() / (nDn * s)
    bend = bend.detach()
    # At the centre of curvature every normal near by is as good: no step.
    flat = bend.abs() <= 1e-12 * s.detach()
    turn = torch.where(flat, 0.0, -slope / torch.where(flat, 1.0, bend))
    turn = turn - turn.detach()
    # To second order in a turn that is zero.
    n = n * (1 - 0.5 * turn.square())[..., None] + m * turn[..., None]
    return inner(n, y) - _form(D, n, n).sqrt()


def foot_normal(D: Float[Tensor, "*#batch 2 2"], y: Float[Tensor, "*#batch n 2"]) -> Float[Tensor, "*batch n 2"]:
    """The outward unit normals at the points of `y'D^-1 y = 1` nearest to points y; not differentiable."""
    axes = ellipse_of_shape(torch.zeros_like(D[..., 0]), D)
    a, b = axes.semi_axes[..., None, :].unbind(-1)
    cos, sin = axes.angle.cos()[..., None], axes.angle.sin()[..., None]
    u = cos * y[..., 0] + sin * y[..., 1]
    v = cos * y[..., 1] - sin * y[..., 0]
    # The foot is b^2 (r u / (t + r - 1), v / t), r = (a / b)^2: q = (r u / a / (t + r - 1), v / b / t) is on the unit circle.
    # 1 / |q| - 1 is concave in t, and nearly straight: Newton's method climbs to the root from below.
    ratio = (a / b).square()
    p1, p2 = ratio * u.abs() / a, v.abs() / b
    tiny = torch.finfo(y.dtype).tiny ** 0.5
    t = torch.maximum(p2, p1 - (ratio - 1))
    for _ in range(_STEPS):
        d1, d2 = (t + (ratio - 1)).clamp_min(tiny), t.clamp_min(tiny)
        q1, q2 = p1 / d1, p2 / d2
        square = q1 * q1 + q2 * q2
        slope = q1 * q1 / d1 + q2 * q2 / d2
        step = square * (square.sqrt() - 1) / slope.clamp_min(tiny)
        t = torch.where(torch.isfinite(step), t + step, t).clamp_min(0)
    # Inside the evolute, on the long axis, q2 is 0 / 0: what is left to the unit circle.
    q1 = (p1 / (t + (ratio - 1)).clamp_min(tiny)).clamp_max(1.0)
    q2 = torch.where(t > tiny, p2 / t.clamp_min(tiny), (1 - q1 * q1).sqrt())
    n1, n2 = torch.copysign(q1 * b, u), torch.copysign(q2 * a, v)
    n = torch.stack((cos * n1 - sin * n2, sin * n1 + cos * n2), -1)
    length: Tensor = torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    return n / length.clamp_min(tiny)


def root_slopes(n: Float[Tensor, "*batch n 2"], q: Float[Tensor, "*batch n 2"]) -> Float[Tensor, "*batch n 5"]:
    """How far an ellipse moves along its normals n with its centre and the entries 11, 12 and 22 of the root S of D.

    The support function is |S n|, so that the edge moves by n'dc + n'dS q with q = S n / |S n|.
    """
    mixed = n[..., 0] * q[..., 1] + n[..., 1] * q[..., 0]
    return torch.stack((n[..., 0], n[..., 1], n[..., 0] * q[..., 0], mixed, n[..., 1] * q[..., 1]), -1)


def square_root(D: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """The symmetric square root of positive definite 2x2 matrices."""
    det = (D[..., 0, 0] * D[..., 1, 1] - D[..., 0, 1] * D[..., 1, 0]).clamp_min(0).sqrt()[..., None, None]
    trace = D.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    return (D + det * torch.eye(2, dtype=D.dtype, device=D.device)) / (trace + 2 * det).sqrt()


def _form(D: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """P'Dq for many vectors."""
    return inner(p @ D, q)
