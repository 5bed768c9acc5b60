"""Real roots of batched polynomials in fixed slots.

Coefficients stand lowest power first along the last dimension. Every function returns `(roots, real)`: as many slots as the
degree, and a mask that says which of them are real roots; the other slots hold finite numbers without meaning.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.decompositions import eigvals
from torchsfm.linalg.derivative import followed
from torchsfm.linalg.vectors import fma, fms

Roots = tuple[Float[Tensor, "*batch slots"], Bool[Tensor, "*batch slots"]]


def evaluate(c: Float[Tensor, "*#batch m"], x: Float[Tensor, "*#batch k"]) -> Float[Tensor, "*batch k"]:
    """The values of polynomials at k points each, by Horner's rule.

    Args:
        c: Coefficients, that of the constant first.
        x: Where to evaluate.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.evaluate(torch.tensor([1.0, 0.0, 2.0]), torch.tensor([0.0, 1.0, 3.0]))  # 1 + 2 x^2
        tensor([ 1.,  3., 19.])
    """
    value = c[..., -1:] + torch.zeros_like(x)
    for i in range(c.shape[-1] - 2, -1, -1):
        value = value * x + c[..., i : i + 1]
    return value


def quadratic_rows(c0: Tensor, c1: Tensor, c2: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The roots of c0 + c1 x + c2 x^2 with the coefficients as separate tensors: ((x0, x1), (real0, real1))."""
    discriminant = c1 * c1 - 4 * c0 * c2
    q = -0.5 * (c1 + torch.copysign(discriminant.clamp_min(0).sqrt(), c1))
    has = discriminant >= 0
    ok0, ok1 = has & (c2 != 0), has & (q != 0)
    x0 = torch.where(ok0, q / c2, 0)
    x1 = torch.where(ok1, c0 / q, 0)
    # With q = 0 the double root is 0 and stands in the first slot.
    fine0, fine1 = torch.isfinite(x0), torch.isfinite(x1)
    return (torch.where(fine0, x0, 0), torch.where(fine1, x1, 0)), (ok0 & fine0, ok1 & fine1)


def _cube_root(x: Tensor) -> Tensor:
    """The cube root of numbers >= 0 to two or three digits: a third of the exponent (Kahan), then a step of Newton's method.

    Not `pow`, whose last bit depends on the shape.
    """
    integer, offset = (torch.int64, 715094163 << 32) if x.dtype == torch.float64 else (torch.int32, 709958130)
    root = (torch.div(x.view(integer), 3, rounding_mode="floor") + offset).view(x.dtype)
    return torch.add(x / (root * root), root, alpha=2) * (1 / 3)


def cubic_rows(c0: Tensor, c1: Tensor, c2: Tensor, c3: Tensor) -> tuple[Tensor, Tensor]:
    """The roots of c0 + c1 x + c2 x^2 + c3 x^3 with the coefficients as separate tensors; (3, ...) roots and real.

    The root farthest from the inflection point is well separated from the other two. It is found by Newton's method from a
    closed-form start; deflation leaves a quadratic (after Kahan, 1986). No trigonometric function is needed.
    """
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    twice = 2 * a

    def value(x: Tensor) -> Tensor:
        return fma(fma(x + a, x, b), x, c)

    def newton(x: Tensor, value: Tensor) -> Tensor:
        return value / fma(torch.add(twice, x, alpha=3), x, b)

    shift = a / -3
    Q = fma(shift, shift, b / -3)
    R = 0.5 * value(shift)
    # Depressed: y^3 - 3 Q y + 2 R = 0 with x = y + shift; |y| is looked for.
    size = R.abs()
    root = Q.clamp_min(0).sqrt()
    inner = fms(Q * Q, Q, size * size)
    outer = _cube_root(size + inner.clamp_min(0).sqrt())
    ratio = (size / (root * root * root)).clamp_max(1)
    # 2 cos(acos(ratio) / 3) to three digits.
    y = torch.where(inner > 0, outer + Q / outer, root * (1.7320508 + ratio * (0.3208 - 0.0529 * ratio)))
    for _ in range(3):
        # Newton's method, without differences of what is nearly equal: y^2 is 4 Q at least where Q is positive.
        square = y * y
        y = fma(square, y, size) / (square - Q) * (2 / 3)
    x = shift - torch.copysign(y.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0), R)
    x = x - newton(x, value(x)).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    # Division by x - x0 from the end that is stable for a root of this size.
    q1 = a + x
    q0 = fma(q1, x, b)
    large = x * x > q0.abs()
    q0 = torch.where(large, -c / x, q0)
    q1 = torch.where(large, (q0 - b) / x, q1)
    # Not a number where the other two are complex.
    q = -0.5 * (q1 + torch.copysign(torch.sub(q1 * q1, q0, alpha=4).sqrt(), q1))
    x = torch.stack((x, q, (q0 / q).masked_fill(q == 0, 0)))
    # One step on the cubic itself, where it helps.
    error = value(x)
    new = x - newton(x, error)
    x = torch.where(value(new).abs() < error.abs(), new, x)
    # A sum is finite only if all numbers are; where c3 is zero, Q is none.
    real = (x + (Q + R + c3)).abs() < torch.inf
    return torch.where(real, x, 0), real


def attach_roots(c: Float[Tensor, "*batch m"], roots: Float[Tensor, "*batch k"], real: Bool[Tensor, "*batch k"]) -> Tensor:
    """Give roots their derivative by the coefficients, -(dp/dc) / p', and leave their value. None at double roots."""
    if not followed(c):
        return roots
    fixed = c.detach()
    slope = evaluate(fixed[..., 1:] * torch.arange(1, c.shape[-1], dtype=c.dtype, device=c.device), roots)
    good = real & (slope != 0)
    value = evaluate(torch.where(good.any(-1, keepdim=True), c, fixed), roots)
    return roots - torch.where(good, (value - value.detach()) / torch.where(good, slope, 1), 0)


def solve_quadratic(c: Float[Tensor, "*batch 3"]) -> Roots:
    """The real roots of quadratics, without cancellation. A linear polynomial (c[2] = 0) has one root.

    Args:
        c: Coefficients, lowest power first.

    Returns:
        Roots in two slots and the mask of real ones. A double root stands in both slots. Differentiable.

    Example:
        >>> import torch, torchsfm.linalg
        >>> roots, real = torchsfm.linalg.solve_quadratic(torch.tensor([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]))
        >>> roots[0].sort().values, real  # x^2 = 1 and x^2 = -1
        (tensor([-1.,  1.]), tensor([[ True,  True],
                [False, False]]))
    """
    pair, reals = quadratic_rows(*c.detach().unbind(-1))
    real = torch.stack(reals, -1)
    return attach_roots(c, torch.stack(pair, -1), real), real


def solve_cubic(c: Float[Tensor, "*batch 4"]) -> Roots:
    """The real roots of cubics, one or three. A cubic whose leading coefficient is zero has no valid slot.

    Args:
        c: Coefficients, lowest power first.

    Returns:
        Roots in three slots and the mask of real ones. Differentiable.

    Example:
        >>> import torch, torchsfm.linalg
        >>> roots, real = torchsfm.linalg.solve_cubic(torch.tensor([-8.0, 0.0, 0.0, 1.0], dtype=torch.float64))  # x^3 = 8
        >>> roots[real]
        tensor([2.0000], dtype=torch.float64)
    """
    kept = c.detach().float() if c.dtype.itemsize < 4 else c.detach()
    roots, real = (x.movedim(0, -1) for x in cubic_rows(*kept.unbind(-1)))
    return attach_roots(c, roots.to(c.dtype), real), real


def companion_roots(c: Float[Tensor, "*batch m"]) -> Roots:
    """The real roots by the eigenvalues of the companion matrix (LAPACK), polished by Newton's method.

    Args:
        c: m = degree + 1 coefficients, lowest power first.

    Returns:
        Roots in `degree` slots and the mask of real ones.

    Example:
        >>> import torch, torchsfm.linalg
        >>> c = torch.tensor([-6.0, 11.0, -6.0, 1.0], dtype=torch.float64)  # (x - 1) (x - 2) (x - 3)
        >>> roots, real = torchsfm.linalg.companion_roots(c)
        >>> roots[real].sort().values
        tensor([1.0000, 2.0000, 3.0000], dtype=torch.float64)
    """
    degree = c.shape[-1] - 1
    monic = -c[..., :-1] / c[..., -1:]
    good = torch.isfinite(monic).all(-1)
    companion = torch.zeros(*c.shape[:-1], degree, degree, dtype=c.dtype, device=c.device)
    companion[..., -1] = torch.where(good[..., None], monic, 0)
    companion[..., range(1, degree), range(degree - 1)] = 1
    values, ok = eigvals(companion)
    x = values.real.contiguous()
    real = (good & ok)[..., None] & (values.imag.abs() <= 1e-3 * (1 + x.abs()))
    slope = c[..., 1:] * torch.arange(1, degree + 1, dtype=c.dtype, device=c.device)
    p = evaluate(c, x)
    for _ in range(3):
        new = x - p / evaluate(slope, x)
        q = evaluate(c, new)
        better = q.abs() < p.abs()
        x, p = torch.where(better, new, x), torch.where(better, q, p)
    scale = evaluate(c.abs(), x.abs())
    real = real & (p.abs() <= 1e3 * torch.finfo(c.dtype).eps * scale)
    return x, real
