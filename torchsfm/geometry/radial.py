"""Numbers behind lens distortion: radial polynomials, the radius where they fold back, and their inverses by Newton's method.

Everything here works on separate coordinates of shape (*batch, n), with coefficients that broadcast against them.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

ITERATIONS = 10
"""Newton steps on the radial function; from the start used here, six reach rounding error on all but wild parameters."""
SERIES = 1e-3
"""Squared angle or tangent below which power series replace quotients."""
LARGEST_ANGLE = torch.pi


def even_polynomial(s: Tensor, coefficients: Sequence[Tensor]) -> Tensor:
    """Evaluate 1 + k1 s + k2 s^2 + ..."""
    if not coefficients:
        return torch.ones_like(s)
    value = coefficients[-1]
    for k in reversed(coefficients[:-1]):
        value = k + s * value
    return 1 + s * value


def slope_coefficients(coefficients: Sequence[Tensor]) -> list[Tensor]:
    """Coefficients of the derivative of r (1 + k1 r^2 + k2 r^4 + ...), again as a polynomial in r^2."""
    return [(2 * i + 3) * k for i, k in enumerate(coefficients)]


def flatten_ray(X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Divide by Z, with |Z| held above the rounding error of X and Y; also return the squared radius, held finite."""
    value = Z.detach()
    floor = torch.finfo(Z.dtype).eps * torch.maximum(X.detach().abs(), Y.detach().abs())
    replacement = torch.where(floor > 0, floor, 1.0)
    replacement = torch.where(value < 0, -replacement, replacement)
    inverse = 1 / torch.where(value.abs() > floor, Z, replacement)
    x, y = X * inverse, Y * inverse
    # The bound keeps the eighth power of the radius finite in every dtype; no lens comes near it.
    return x, y, (x * x + y * y).clamp(max=torch.finfo(Z.dtype).max ** (1 / 12))


def first_fold(coefficients: Sequence[Tensor]) -> Tensor:
    """Find the smallest r > 0 where r (1 + k1 r^2 + k2 r^4 + ...) stops increasing; inf where it never does.

    With w = 1 / r^2 the condition is a monic polynomial in w, so no coefficient is divided by, and its largest positive root is
    wanted. Parameters that are not finite give 0: no point is inside. Not differentiated.
    """
    with torch.no_grad():
        slopes = torch.stack([k.detach() for k in slope_coefficients(coefficients)], -1)
        finite = torch.isfinite(slopes).all(-1)
        c = torch.where(finite[..., None], slopes, 0.0).double()
        count = c.shape[-1]
        if count == 1:
            w = -c[..., 0]
        elif count == 2:
            half = -0.5 * c[..., 0]
            square = half * half - c[..., 1]
            root = square.clamp(min=0).sqrt()
            # The quotient of Vieta is accurate where half + root cancels.
            sum_ = torch.where(half < 0, half - root, half + root)
            other = torch.where(sum_ == 0, 0.0, c[..., 1] / torch.where(sum_ == 0, 1.0, sum_))
            w = torch.where(square >= 0, torch.maximum(sum_, other), 0.0)
        else:
            companion = torch.diag_embed(c.new_ones(count - 1), offset=-1).expand(*c.shape, count).clone()
            companion[..., 0, :] = -c
            roots = torch.linalg.eigvals(companion)
            # A double root comes out as a pair with an imaginary part of half the digits: there the slope touches zero.
            real = roots.imag.abs() <= 1e-7 * roots.real.abs()
            w = torch.where(real, roots.real, 0.0).amax(-1)
        radius = torch.where(w > 0, w.clamp(min=1e-300).rsqrt(), torch.inf)
        return torch.where(finite, radius, 0.0).to(slopes.dtype)


def solve_radial(rho: Tensor, coefficients: Sequence[Tensor], limit: Tensor) -> Tensor:
    """Solve r (1 + k1 r^2 + ...) = rho for r in [0, limit], where the left side increases. Not differentiated.

    The start is exact to first order at both ends where `limit` is a fold (where r grows like a square root), and otherwise the
    least of the bounds that the single terms put on r.
    """
    slopes = slope_coefficients(coefficients)
    folds = torch.isfinite(limit)
    bounded = torch.where(folds, limit, 1.0)
    top = bounded * even_polynomial(bounded * bounded, coefficients)
    top = torch.where(folds & (top > 0), top, 1.0)
    t = (rho / top).clamp(max=1)
    bend = (1 - 2 * top / bounded.clamp(min=torch.finfo(rho.dtype).tiny)).clamp(min=-1)
    start = bounded * (1 - ((1 - t) * (1 + bend * t)).clamp(min=0).sqrt())
    logarithm = rho.clamp(min=torch.finfo(rho.dtype).tiny).log()
    bound = logarithm
    for i, k in enumerate(coefficients):
        power = torch.where(k > 0, 1 / (2 * i + 3), 0.0).to(rho.dtype)
        shift = torch.where(k > 0, -power * k.clamp(min=torch.finfo(rho.dtype).tiny).log(), torch.inf)
        bound = torch.minimum(bound, torch.addcmul(shift, logarithm, power))
    r = torch.where(folds, start, bound.exp())
    for _ in range(ITERATIONS):
        s = r * r
        slope = even_polynomial(s, slopes)
        step = (r * even_polynomial(s, coefficients) - rho) / torch.where(slope == 0, 1.0, slope)
        r = (r - step).clamp(min=0).minimum(limit)
    return r


def invert_radial(q: Tensor, coefficients: Sequence[Tensor], limit: Tensor) -> tuple[Tensor, Tensor]:
    """Solve s (1 + k1 s + ...)^2 = q for s = r^2, given q = rho^2; return s and where it is a solution within the limit.

    In s the equation is smooth at zero, so derivatives are too: the last Newton step is taken at the detached solution, which
    gives first derivatives by q and by the coefficients through the implicit function theorem.
    """
    with torch.no_grad():
        rho = q.detach()
        rho = torch.where(torch.isfinite(rho), rho, 0.0).sqrt()
        fixed = [torch.where(torch.isfinite(k), k, 0.0).detach() for k in coefficients]
        r = solve_radial(rho, fixed, limit)
        s = r * r
        h, slope = even_polynomial(s, fixed), even_polynomial(s, slope_coefficients(fixed))
        error = (r * h - rho).abs()
        tolerance = 64 * torch.finfo(q.dtype).eps
        valid = (error <= tolerance * rho) & (r <= limit) & (slope > 0) & torch.isfinite(q) & (limit > 0)
        inverse = 1 / torch.where(valid, h * slope, 1.0)
    step = inverse * (s * even_polynomial(s, coefficients).square() - q)
    return torch.where(valid, s - step, s), valid


def fisheye_from_tangent(X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor]:
    """Compute angle / radius and the squared angle of rays to the optical axis; smooth on the axis in front.

    Rays may point backwards (up to the angle pi). Exactly behind there is no answer: the quotient is then 1.
    """
    q = X * X + Y * Y
    front = (Z > 0) & (q < SERIES * Z * Z)
    depth = torch.where(front, Z, 1.0)
    t = torch.where(front, q, 0.0) / (depth * depth)
    series = (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t / 9)))) / depth
    rest = (~front) & (q > 0)
    r = torch.where(rest, q, 1.0).sqrt()
    quotient = torch.atan2(r, torch.where(rest, Z, 1.0)) / r
    ratio = torch.where(front, series, torch.where(rest, quotient, 1.0))
    return ratio, ratio * ratio * q


def tangent_from_fisheye(s: Tensor) -> tuple[Tensor, Tensor]:
    """From the squared angle, compute the factor of (x, y) by the angle and the z coordinate of a ray.

    The ray has z = 1 up to about 89.9 degrees off the axis, and unit length beyond.
    """
    small = s < SERIES
    angle = torch.where(small, 1.0, s).sqrt()
    cosine = torch.cos(angle)
    flat = small | (cosine > 2e-3)
    sinc = torch.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), torch.sin(angle) / angle)
    cosine = torch.where(small, 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56))), cosine)
    factor = torch.where(flat, sinc / torch.where(flat, cosine, 1.0), sinc)
    return factor, torch.where(flat, 1.0, cosine)


def brown(x: Tensor, y: Tensor, s: Tensor, radial: Sequence[Tensor], p1: Tensor, p2: Tensor) -> tuple[Tensor, Tensor]:
    """Distort flat coordinates by a radial polynomial and decentring terms."""
    h = even_polynomial(s, radial)
    xy = 2 * x * y
    return x * h + p1 * xy + p2 * (s + 2 * x * x), y * h + p2 * xy + p1 * (s + 2 * y * y)


def invert_brown(
    u: Tensor, v: Tensor, radial: Sequence[Tensor], p1: Tensor, p2: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the Brown-Conrady equations for the flat coordinates by Newton's method, from the radial solution.

    The Jacobian is symmetric. Returns x, y and where they are a solution within the limit.
    """
    with torch.no_grad():
        good = torch.isfinite(u) & torch.isfinite(v)
        good &= torch.isfinite(p1) & torch.isfinite(p2)
        u0, v0 = torch.where(good, u, 0.0).detach(), torch.where(good, v, 0.0).detach()
        fixed = [torch.where(torch.isfinite(k), k, 0.0).detach() for k in (*radial, p1, p2)]
        k, a, b = fixed[:-2], fixed[-2], fixed[-1]
        slopes = [(i + 1) * c for i, c in enumerate(k)]
        rho = (u0 * u0 + v0 * v0).sqrt()
        r = solve_radial(rho, k, limit)
        factor = r / torch.where(rho > 0, rho, 1.0)
        x, y = u0 * factor, v0 * factor
        for last in (False, False, False, False, True):
            s = x * x + y * y
            h = even_polynomial(s, k)
            # Half of dh/ds by x and y; the polynomial of slopes has constant term k1.
            bend = slopes[-1]
            for c in reversed(slopes[:-1]):
                bend = c + s * bend
            bend = 2 * bend
            xy = 2 * x * y
            ex, ey = brown(x, y, s, k, a, b)
            ex, ey = ex - u0, ey - v0
            jxx = h + bend * x * x + 2 * a * y + 6 * b * x
            jyy = h + bend * y * y + 2 * b * x + 6 * a * y
            jxy = 0.5 * bend * xy + 2 * a * x + 2 * b * y
            determinant = jxx * jyy - jxy * jxy
            regular = determinant > 0
            inverse = 1 / torch.where(regular, determinant, 1.0)
            if last:
                break
            dx, dy = inverse * (jyy * ex - jxy * ey), inverse * (jxx * ey - jxy * ex)
            x, y = x - dx, y - dy
            # Held inside the limit, so that no step runs over the fold.
            shrink = (limit / (x * x + y * y).sqrt().clamp(min=torch.finfo(x.dtype).tiny)).clamp(max=1)
            x, y = x * shrink, y * shrink
        tolerance = 64 * torch.finfo(u.dtype).eps
        valid = good & regular & (torch.maximum(ex.abs(), ey.abs()) <= tolerance * rho)
        valid &= (s <= limit * limit) & (limit > 0)
        inverse = torch.where(valid, inverse, 0.0)
        jxx, jxy, jyy = inverse * jxx, inverse * jxy, inverse * jyy
    ex, ey = brown(x, y, x * x + y * y, radial, p1, p2)
    ex, ey = torch.where(valid, ex - u, 0.0), torch.where(valid, ey - v, 0.0)
    return x - (jyy * ex - jxy * ey), y - (jxx * ey - jxy * ex), valid
