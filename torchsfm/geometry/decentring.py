"""Brown-Conrady distortion, radial and decentring, and its inverse."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchsfm.geometry.radial import even_polynomial, finite_constants, in_blocks, polynomial, powers, solve_radial

RADIAL = 3
"""Newton steps on the radial function after the guarded ones; what they leave is far below the decentring terms."""
DECENTRING = 7
"""Newton steps in the plane from the radial solution; three do inside, near the fold they are slower."""


def brown(x: Tensor, y: Tensor, s: Tensor, radial: Sequence[Tensor], p1: Tensor, p2: Tensor) -> tuple[Tensor, Tensor]:
    """Distort flat coordinates: x L + p2 s and y L + p1 s, with L = h + 2 (p1 y + p2 x) and h the radial polynomial."""
    L = torch.addcmul(torch.addcmul(even_polynomial(s, radial), p1, y, value=2), p2, x, value=2)
    return torch.addcmul(x * L, p2, s), torch.addcmul(y * L, p1, s)


def invert_brown(
    u: Tensor, v: Tensor, radial: Sequence[Tensor], p1: Tensor, p2: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the Brown-Conrady equations for the flat coordinates by Newton's method, from the radial solution.

    The last step is taken at the detached solution, which gives first derivatives by the points and by the parameters through
    the implicit function theorem. Returns x, y and where they are a solution within the limit.
    """
    with torch.no_grad():
        x, y, jxx, jxy, jyy, valid = in_blocks(
            _solve, u.detach(), v.detach(), limit, *finite_constants((p1, p2)), *finite_constants(radial)
        )
        valid = valid & torch.isfinite(p1) & torch.isfinite(p2)
    ex, ey = brown(x, y, torch.addcmul(x * x, y, y), radial, p1, p2)
    ex, ey = torch.where(valid, ex - u, 0.0), torch.where(valid, ey - v, 0.0)
    return x - (jyy * ex - jxy * ey), y - (jxx * ey - jxy * ex), valid


def brown_jacobian(
    x: Tensor, y: Tensor, s: Tensor, radial: Sequence[Tensor], p1: Tensor, p2: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return L of `brown`, the entries xx, xy, yy of its symmetric Jacobian, and the determinant."""
    L = torch.addcmul(torch.addcmul(even_polynomial(s, radial), p1, y, value=2), p2, x, value=2)
    # `bend` x and `bend` y are the derivatives of the radial polynomial.
    bend = polynomial(s, [2 * (i + 1) * k for i, k in enumerate(radial)])
    bend_x = bend * x
    jxx = torch.addcmul(L, x, bend_x + 4 * p2)
    jyy = torch.addcmul(L, y, torch.addcmul(4 * p1, bend, y))
    jxy = torch.addcmul(y * (bend_x + 2 * p2), p1, x, value=2)
    return L, jxx, jxy, jyy, torch.addcmul(jxx * jyy, jxy, jxy, value=-1)


def brown_slopes(
    uv: Tensor, inverse: Tensor, radial: Sequence[Tensor], p1: Tensor, p2: Tensor, out: Tensor
) -> tuple[Tensor, list[Tensor], Tensor, Tensor]:
    """Distort flat coordinates (2, ...); also return the derivatives (2, ...) by each radial coefficient, by p1 and by p2.

    `out` (2, 3, ...) gets those by the ray.
    """
    x, y = uv
    s = torch.addcmul(x * x, y, y)
    L, jxx, jxy, jyy, _ = brown_jacobian(x, y, s, radial, p1, p2)
    (xx, xy, _), (yx, yy, _) = out
    torch.mul(jxx, inverse, out=xx)
    torch.mul(jyy, inverse, out=yy)
    yx.copy_(torch.mul(jxy, inverse, out=xy))
    by_x, by_y, by_depth = out.unbind(1)
    torch.mul(by_x, -x, out=by_depth).addcmul_(by_y, y, value=-1)
    both = 2 * x * y
    along = torch.stack((both, torch.addcmul(s, y, y, value=2)))
    across = torch.stack((torch.addcmul(s, x, x, value=2), both))
    distorted = torch.stack((torch.addcmul(x * L, p2, s), torch.addcmul(y * L, p1, s)))
    return distorted, powers(uv, s, len(radial)), along, across


def _solve(u: Tensor, v: Tensor, limit: Tensor, p1: Tensor, p2: Tensor, *radial: Tensor) -> tuple[Tensor, ...]:
    """Iterate; return x, y, the entries of the Jacobian divided by its determinant, and validity."""
    rho = torch.addcmul(u * u, v, v).sqrt()
    r = solve_radial(rho, radial, limit, torch.isfinite(limit), plain=RADIAL)
    factor = r / rho.clamp(min=torch.finfo(rho.dtype).tiny)
    x0, y0 = u * factor, v * factor
    x, y = x0, y0
    for i in range(DECENTRING + 1):
        s = torch.addcmul(x * x, y, y)
        L, jxx, jxy, jyy, determinant = brown_jacobian(x, y, s, radial, p1, p2)
        # What is missing from the equations at x, y.
        ex = torch.addcmul(torch.addcmul(u, x, L, value=-1), p2, s, value=-1)
        ey = torch.addcmul(torch.addcmul(v, y, L, value=-1), p1, s, value=-1)
        if i < DECENTRING:
            x = torch.addcdiv(x, torch.addcmul(jyy * ex, jxy, ey, value=-1), determinant)
            y = torch.addcdiv(y, torch.addcmul(jxx * ey, jxy, ex, value=-1), determinant)
    tolerance = 64 * torch.finfo(u.dtype).eps * rho
    valid = (torch.maximum(ex.abs(), ey.abs()) <= tolerance) & (determinant > 0) & (s <= limit * limit) & (limit > 0)
    inverse = 1 / torch.where(valid, determinant, torch.inf)
    jacobian = (torch.where(valid, inverse * entry, 0.0) for entry in (jxx, jxy, jyy))
    # A point that ran away is put back on the radial solution.
    return torch.where(valid, x, x0), torch.where(valid, y, y0), *jacobian, valid
