"""Numbers behind lens distortion: radial polynomials, the radius where they fold back, and their inverses by Newton's method.

Everything here works on separate coordinates of shape (*batch, n), with coefficients that broadcast against them. The loops
are written in few passes over memory, since that is all they cost.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.linalg import eigvals, solve_cubic

GUARDED = 3
"""Newton steps that narrow a bracket around the root; then the rest converges by itself on all but contrived functions."""
PLAIN = 7
"""Newton steps that only stay inside that bracket."""
CHORD = 0.3
"""Part of the height of a fold above the diagonal below which a chord tells less than single terms."""
BLOCK = 32768
"""Points worked on at once on a CPU, so that the many passes over them stay in its cache."""
NEAREST = 1e20
"""Largest reciprocal of a depth in optimisers, which keeps values and slopes finite for points in the focal plane (float64)."""


def in_blocks(function: Callable[..., tuple[Tensor, ...]], *arrays: Tensor) -> tuple[Tensor, ...]:
    """Call an elementwise function of broadcasting arrays block by block and join what it returns."""
    shape = broadcast_shapes(*(a.shape for a in arrays))
    count = shape.numel()
    if count <= BLOCK or any(a.is_cuda for a in arrays):
        return function(*arrays)
    arrays = tuple(a[(None,) * (len(shape) - a.ndim)] for a in arrays)
    axis = next(i for i, size in enumerate(shape) if size > 1)
    step = max(1, shape[axis] * BLOCK // count)
    pieces = []
    for start in range(0, shape[axis], step):
        length = min(step, shape[axis] - start)
        pieces.append(in_blocks(function, *(a.narrow(axis, start, length) if a.shape[axis] > 1 else a for a in arrays)))
    return tuple(torch.cat(parts, axis) for parts in zip(*pieces, strict=True))


def even_polynomial(s: Tensor, coefficients: Sequence[Tensor]) -> Tensor:
    """Evaluate 1 + k1 s + k2 s^2 + ..."""
    return torch.addcmul(torch.ones((), dtype=s.dtype, device=s.device), s, polynomial(s, coefficients))


def polynomial(s: Tensor, coefficients: Sequence[Tensor]) -> Tensor:
    """Evaluate k1 + k2 s + k3 s^2 + ..."""
    value = coefficients[-1]
    for k in reversed(coefficients[:-1]):
        value = torch.addcmul(k, s, value)
    return value


def slope_coefficients(coefficients: Sequence[Tensor]) -> list[Tensor]:
    """Coefficients of the derivative of r (1 + k1 r^2 + k2 r^4 + ...), again as a polynomial in r^2."""
    return [(2 * i + 3) * k for i, k in enumerate(coefficients)]


def flatten_ray(X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Divide by Z, with |Z| held above the rounding error of X and Y; also return the squared radius, held finite."""
    eps = torch.finfo(Z.dtype).eps
    floor = torch.maximum(X.detach().abs(), Y.detach().abs()) * eps + eps * eps
    inverse = 1 / torch.copysign(torch.maximum(Z.abs(), floor), Z)
    x, y = X * inverse, Y * inverse
    # The bound keeps the eighth power of the radius finite in every dtype; no lens comes near it.
    return x, y, torch.addcmul(x * x, y, y).clamp(max=torch.finfo(Z.dtype).max ** (1 / 12))


def flatten(ray: Tensor) -> tuple[Tensor, Tensor]:
    """Divide by the depth as optimisers do, in few passes: rays (3, ...) to flat coordinates (2, ...) and 1 / Z."""
    inverse = ray[2].reciprocal().clamp(-NEAREST, NEAREST)
    return ray[:2] * inverse, inverse


def radial_slopes(uv: Tensor, inverse: Tensor, k: Tensor, out: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Multiply flat coordinates by the radial polynomial h; also return the derivatives (2, ...) by each coefficient.

    `out` (2, 3, ...) gets those by the ray: `h (x, y)` grows by h in every direction, and by 2 s h' more outwards, where depth
    acts.
    """
    x, y = uv
    (xx, xy, _), (yx, yy, _), by_depth = *out, out[:, 2]
    s = torch.addcmul(x * x, y, y)
    h = even_polynomial(s, k.unbind(0))
    slope = polynomial(s, [2 * (i + 1) * c for i, c in enumerate(k.unbind(0))]) * inverse
    along = h * inverse
    bent_x, bent_y = uv * slope
    torch.addcmul(along, x, bent_x, out=xx)
    torch.addcmul(along, y, bent_y, out=yy)
    yx.copy_(torch.mul(x, bent_y, out=xy))
    torch.mul(uv, torch.addcmul(along, s, slope).neg_(), out=by_depth)
    return uv * h, powers(uv, s, len(k))


def powers(uv: Tensor, s: Tensor, count: int) -> list[Tensor]:
    """Return `uv s`, `uv s^2`, ...: the derivatives by radial coefficients."""
    found = [uv * s]
    while len(found) < count:
        found.append(found[-1] * s)
    return found


def first_fold(coefficients: Sequence[Tensor]) -> Tensor:
    """Find the smallest r > 0 where r (1 + k1 r^2 + k2 r^4 + ...) stops increasing; inf where it does not before a million.

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
        elif count == 3:
            c1, c2, c3 = c.unbind(-1)
            roots, exist = solve_cubic(torch.stack([c3, c2, c1, torch.ones_like(c1)], -1))
            # Coefficients near the smallest numbers underflow there, so what comes is checked.
            terms = torch.stack([roots**3, c1[..., None] * roots**2, c2[..., None] * roots, c3[..., None].expand_as(roots)])
            good = exist & (terms.sum(0).abs() <= 1e-9 * terms.abs().sum(0))
            w = torch.where(good, roots, 0.0).amax(-1)
        else:
            # Coefficients next to nothing change no root that counts, and keep others from being found.
            c = torch.where(c.abs() < 1e-100, 0.0, c)
            companion = torch.diag_embed(c.new_ones(count - 1), offset=-1).expand(*c.shape, count).clone()
            companion[..., 0, :] = -c
            values, ok = eigvals(companion)
            finite = finite & ok
            # A double root comes out as a pair with an imaginary part of half the digits: there the slope touches zero.
            real = values.imag.abs() <= 1e-7 * values.real.abs()
            w = torch.where(real, values.real, 0.0).amax(-1)
        # Smaller roots are rounding errors of zero, which zero coefficients make.
        radius = torch.where(w > 1e-12, w.clamp(min=1e-12).rsqrt(), torch.inf)
        return torch.where(finite, radius, 0.0).to(slopes.dtype)


def solve_radial(rho: Tensor, coefficients: Sequence[Tensor], limit: Tensor, folds: Tensor, plain: int = PLAIN) -> Tensor:
    """Solve r (1 + k1 r^2 + ...) = rho for r in [0, limit], where the left side increases. Not differentiated.

    The start is exact to first order at both ends where `limit` is a fold (there r grows like a square root); without one, and
    far below a high one, it is the least of the bounds that the single terms put on r.
    """
    tiny, largest = torch.finfo(rho.dtype).tiny, torch.finfo(rho.dtype).max
    slopes = slope_coefficients(coefficients)
    bounded = torch.where(folds, limit, 1.0).clamp(min=tiny)
    top = bounded * even_polynomial(bounded * bounded, coefficients)
    top = torch.where(folds & (top > 0), top, 1.0)
    t = (rho / top).clamp(max=1)
    bend = (1 - 2 * top / bounded).clamp(min=-1)
    square = (1 - t) * (1 + bend * t)
    start = bounded - bounded * square.clamp(min=0).sqrt()
    logarithm = rho.clamp(min=tiny).log()
    bound = logarithm
    for i, k in enumerate(coefficients):
        power = torch.where(k > 0, 1 / (2 * i + 3), 0.0).to(rho.dtype)
        shift = torch.where(k > 0, -power * k.clamp(min=tiny).log(), torch.inf)
        bound = torch.minimum(bound, torch.addcmul(shift, logarithm, power))
    # Where the function rises above the diagonal before it folds, the start is on the chord: far too low in its lower part.
    known = folds & ((top <= bounded) | (t > CHORD))
    r = torch.minimum(torch.where(known, start, bound.exp()), limit)
    low, high = torch.zeros_like(r), limit
    for i in range(GUARDED + plain):
        s = r * r
        missing = torch.addcmul(rho, r, even_polynomial(s, coefficients), value=-1)
        newton = torch.addcdiv(r, missing, even_polynomial(s, slopes).clamp(min=tiny))
        if i < GUARDED:
            # 1 where r is below the root, else 0; arithmetic, because `where` on a random mask costs ten times as much.
            below = missing.sign().clamp(min=0)
            low = torch.maximum(low, below * r)
            high = torch.minimum(high, torch.add(r, below, alpha=largest))
            # No step passes the middle of what is left, so that none can jump back and forth between the ends.
            r = newton.clamp(torch.lerp(low, r, 0.5), 0.5 * (r + high))
        else:
            r = newton.clamp(low, high)
    return r


def invert_radial(q: Tensor, coefficients: Sequence[Tensor], limit: Tensor, folds: Tensor) -> tuple[Tensor, Tensor]:
    """Solve s (1 + k1 s + ...)^2 = q for s = r^2, given q = rho^2; return s and where it is a solution within the limit.

    In s the equation is smooth at zero, so derivatives are too: the last Newton step is taken at the detached solution, which
    gives first derivatives by q and by the coefficients through the implicit function theorem.
    """

    def solve(q: Tensor, limit: Tensor, folds: Tensor, *fixed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rho = q.sqrt()
        r = solve_radial(rho, fixed, limit, folds)
        s = r * r
        h, slope = even_polynomial(s, fixed), even_polynomial(s, slope_coefficients(fixed))
        error = torch.addcmul(rho, r, h, value=-1).abs()
        valid = (error <= 64 * torch.finfo(q.dtype).eps * rho) & (slope > 0) & (limit > 0)
        return s, 1 / torch.where(valid, h * slope, torch.inf), valid

    with torch.no_grad():
        s, inverse, valid = in_blocks(solve, q.detach(), limit, folds, *finite_constants(coefficients))
    h = even_polynomial(s, coefficients)
    return s - inverse * torch.addcmul(-q, s, h * h), valid


def finite_constants(coefficients: Sequence[Tensor]) -> list[Tensor]:
    """Detach coefficients; those that are not finite become zero (their limit is zero too, so no point is valid)."""
    return [torch.where(torch.isfinite(k), k, 0.0).detach() for k in coefficients]
