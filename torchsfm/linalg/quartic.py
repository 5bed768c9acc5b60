"""Real roots of batched quartics in closed form, by elementwise arithmetic alone.

A depressed quartic is the product of two quadratics y^2 + u y + s and y^2 - u y + t, where u^2 is a root of a cubic
(Descartes; Ferrari). The largest root of that cubic is positive unless the quartic has no real root to speak of. Newton steps
on the quartic itself make up for what the closed form loses.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.polynomial import attach_roots, cubic_rows
from torchsfm.linalg.vectors import fma

_DOUBLE = 1e-6
"""Down to minus this, relative to its parts, a discriminant may be zero: rounding moves double roots off the real line."""
_ROUNDING = 16
"""Times the rounding error of the largest term: the value at a root."""
_STEPS = 3


def quartic_rows(c: Float[Tensor, "5 *batch"]) -> tuple[Float[Tensor, "4 *batch"], Bool[Tensor, "4 *batch"]]:
    """The roots of c[0] + c[1] x + ... + c[4] x^4 with the coefficients as rows; (4, ...) roots and real.

    Of a pair that rounding does not tell from a double root the first slot alone is real. Meant for float64, and for a leading
    coefficient that is not small against the others.
    """
    lead = c[4]
    a3, a2, a1, a0 = c[3] / lead, c[2] / lead, c[1] / lead, c[0] / lead
    shift = a3 * -0.25
    square = shift * shift
    p = a2 - 6 * square
    q = a1 + 2 * a2 * shift - 8 * square * shift
    r = a0 + a1 * shift + a2 * square - 3 * square * square
    roots, real = cubic_rows(-q * q, p * p - 4 * r, 2 * p, torch.ones_like(p))
    z = torch.where(real, roots, 0).amax(0).clamp_min(0)
    u = z.sqrt()
    # s + t = p + z, s t = r, t - s = q / u: the larger of the two without cancellation, the other by the product.
    total = p + z
    gap = torch.where(u > 0, q / torch.where(u > 0, u, 1), (total * total - 4 * r).clamp_min(0).sqrt())
    large = 0.5 * (total + torch.copysign(gap, total))
    small = torch.where(large != 0, r / torch.where(large != 0, large, 1), 0)
    same = (gap >= 0) == (total >= 0)
    s, t = torch.where(same, small, large), torch.where(same, large, small)
    y, sure, maybe = [], [], []
    for linear, constant in ((u, s), (-u, t)):
        own = linear * linear
        rest = own - 4 * constant
        some = rest >= 0
        twice = ~some & (rest >= -_DOUBLE * (own + 4 * constant.abs() + p.abs()))
        w = -0.5 * (linear + torch.copysign(rest.clamp_min(0).sqrt(), linear))
        safe = torch.where(w != 0, w, 1)
        y += [w, torch.where(w != 0, constant / safe, 0)]
        sure += [some, some & (rest > 0)]
        maybe += [twice, torch.zeros_like(twice)]
    x, value = _newton(torch.stack(y) + shift, a3, a2, a1, a0)
    size = x.abs()
    size = _value(size, a3.abs(), a2.abs(), a1.abs(), a0.abs())
    tiny = value.abs() <= _ROUNDING * torch.finfo(x.dtype).eps * size
    real = torch.stack(sure) | (torch.stack(maybe) & tiny)
    return x, real & torch.isfinite(size) & torch.isfinite(lead) & (lead != 0)


def _newton(x: Tensor, a3: Tensor, a2: Tensor, a1: Tensor, a0: Tensor) -> tuple[Tensor, Tensor]:
    """Roots after some steps, those that the steps lead astray as they were, and the values there."""
    b2, b1 = 3 * a3, 2 * a2
    start = value = _value(x, a3, a2, a1, a0)
    new = x
    for _ in range(_STEPS):
        slope = fma(fma(torch.add(b2, new, alpha=4), new, b1), new, a1)
        # No step where there is no slope: what is not finite is not better.
        new = new - value / slope
        value = _value(new, a3, a2, a1, a0)
    better = value.abs() < start.abs()
    return torch.where(better, new, x).nan_to_num_(0.0, 0.0, 0.0), torch.where(better, value, start)


def _value(x: Tensor, a3: Tensor, a2: Tensor, a1: Tensor, a0: Tensor) -> Tensor:
    return fma(fma(fma(x + a3, x, a2), x, a1), x, a0)


def solve_quartic(c: Float[Tensor, "*batch 5"]) -> tuple[Float[Tensor, "*batch 4"], Bool[Tensor, "*batch 4"]]:
    """The real roots of quartics: none, two or four. A quartic whose leading coefficient is zero has no valid slot.

    Args:
        c: Coefficients, lowest power first. Roots much larger than the others lose digits: where the leading coefficient may be
            small, reverse the coefficients or use `real_roots`.

    Returns:
        Roots in four slots and the mask of real ones; a double root, to rounding, stands in one slot. Computed in float64.
        Differentiable.

    Example:
        >>> import torch, torchsfm.linalg
        >>> c = torch.tensor([4.0, 0.0, -5.0, 0.0, 1.0], dtype=torch.float64)  # (x^2 - 1) (x^2 - 4)
        >>> roots, real = torchsfm.linalg.solve_quartic(c)
        >>> roots[real].sort().values
        tensor([-2.0000, -1.0000,  1.0000,  2.0000], dtype=torch.float64)
    """
    with torch.no_grad():
        roots, real = (rows.movedim(0, -1) for rows in quartic_rows(c.detach().double().movedim(-1, 0)))
        roots = roots.to(c.dtype)
        # Numbers of this kind may be too small for them.
        real = real & torch.isfinite(roots)
        roots = torch.where(torch.isfinite(roots), roots, 0)
    return attach_roots(c, roots, real), real
