"""Pose of a calibrated camera from three rays to three known points.

The depths along the unit rays satisfy three quadrics, `|l_i u_i - l_j u_j|^2 = |X_i - X_j|^2`. Eliminating the scale
leaves two conics in the direction of `(l_0, l_1, l_2)`, whose at most four common points are found as Ding, Yang,
Larsson, Olsson & Åström, "Revisiting the P3P problem" (CVPR 2023) do: one real root of a cubic gives a pencil member
that is a pair of lines, and each line meets another member in at most two points. Here no direction of the pencil is
special: the cubic is homogeneous, the pencil is turned until its leading coefficient is large, and lines are met with
conics in homogeneous coordinates, so that right angles, isosceles triangles and a centre in the plane of the points
lose no solution.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.optim import wants_derivative

SQRT2 = 2.0**0.5


def camera_p3p(d: Float[Tensor, "*#batch 3 3"], X: Float[Tensor, "*#batch 3 3"]) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
    """The up to four poses `[R | t]` that see three points along three rays, `d_i ~ R X_i + t` with positive depths.

    Computed in float64 whatever comes in. Derivatives are those of the solutions (implicit function theorem on the
    depths), to second order; empty slots have none.

    No slot is valid where the points are collinear or coincide, or where anything is not finite. Where two solutions
    merge (the centre on the danger cylinder through the points) both slots stay valid, and are as inaccurate as a
    double root is.

    Args:
        d: Rays in the camera frame, one per row, of any length, pointing from the camera towards the points.
        X: The points in the world frame, one per row.

    Returns:
        Four slots of `cam_from_world`, rotations orthonormal to rounding, and which of them are solutions.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.
    """
    batch = check_tensors(d=(d, "3 3"), X=(X, "3 3"))
    dtype = d.dtype
    # Structure of arrays: (point, coordinate, problem).
    rays = d.double().expand(*batch, 3, 3).reshape(-1, 3, 3).permute(1, 2, 0).contiguous()
    points = X.double().expand(*batch, 3, 3).reshape(-1, 3, 3).permute(1, 2, 0).contiguous()
    sound = _sound(rays.detach(), points.detach(), torch.finfo(dtype).eps)
    safe = rays.new_tensor(_SAFE)[..., None]
    rays, points = torch.where(sound, rays, safe), torch.where(sound, points, safe)

    u = rays * (rays * rays).sum(1, keepdim=True).rsqrt()
    with torch.no_grad():
        triangle = _Triangle(u.detach(), points.detach())
        depths, valid = triangle.depths()
        depths, valid = triangle.polish(depths, valid & sound)
    differentiable = wants_derivative(d, X)
    if differentiable:
        # Two Newton steps from the solution: no change of value, and derivatives exact to second order.
        triangle = _Triangle(u, points)
        rows = depths.unbind(0)
        for _ in range(2):
            rows, _ = triangle.newton(rows, valid)
        moved = torch.stack(rows)
        depths = depths + (moved - moved.detach())

    # (slot, point, coordinate, problem)
    Y = depths.transpose(0, 1)[:, :, None] * u
    if differentiable:
        Y = torch.where(valid[:, None, None], Y, Y.detach())
    X0, X1, X2 = points.unbind(0)
    Y0, Y1, Y2 = Y.unbind(1)
    a1, a2, a3 = _triad(X1 - X0, X2 - X0, 0)
    b1, b2, b3 = _triad(Y1 - Y0, Y2 - Y0, 1)
    R = torch.addcmul(torch.addcmul(b1[:, :, None] * a1, b2[:, :, None], a2), b3[:, :, None], a3)
    m = X0 + X1 + X2
    moved = torch.addcmul(torch.addcmul(b1 * (a1 * m).sum(0), b2, (a2 * m).sum(0)), b3, (a3 * m).sum(0))
    t = (Y0 + Y1 + Y2 - moved) / 3
    model = torch.cat((R, t[:, :, None]), 2).reshape(48, -1).t()
    return Solutions(model.to(dtype).reshape(*batch, 4, 3, 4), valid.t().reshape(*batch, 4))


def equations(
    model: Float[Tensor, "*#batch 3 4"], d: Float[Tensor, "*#batch 3 3"], X: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 12"]:
    """What a pose from three rays satisfies: twelve equations in the twelve entries of `[R | t]`, zero at a solution.

    Six say `R'R = I`; two for each point say that `R X + t` has no component across its ray, relative to the point's
    size there.
    """
    R, t = model[..., :3], model[..., 3]
    gram = R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)
    rows, columns = torch.triu_indices(3, 3, device=R.device)
    Y = X @ R.mT + t[..., None, :]
    u = d / torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    across = [(Y * e).sum(-1) / torch.linalg.vector_norm(Y.detach(), dim=-1) for e in _across(u.unbind(-1), -1)]
    shape = torch.broadcast_shapes(gram.shape[:-2], across[0].shape[:-1])  # type: ignore[no-untyped-call]
    return torch.cat([g.expand(*shape, -1) for g in (gram[..., rows, columns], *across)], -1)


_SAFE = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (-1.0, 0.0, 1.0))
"""A harmless triangle, put where the data are not usable."""


def _sound(rays: Tensor, points: Tensor, eps: float) -> Tensor:
    """Finite data, rays with a direction, points not in a line; (problem)."""
    # What is not finite is not equal to itself when subtracted from itself.
    zero = (rays - rays).sum((0, 1)) + (points - points).sum((0, 1))
    X0, X1, X2 = points.unbind(0)
    e1, e2, e3 = X1 - X0, X2 - X0, X2 - X1
    normal = _cross(e1, e2, 0)
    longest = torch.maximum(torch.maximum((e1 * e1).sum(0), (e2 * e2).sum(0)), (e3 * e3).sum(0))
    # Twice the area against the longest side squared; rounding of far coordinates also counts.
    rounding = eps * points.abs().amax((0, 1)) * longest.sqrt()
    area = (normal * normal).sum(0).sqrt()
    pointed = (rays * rays).sum(1).amin(0) > 1e-200
    return (zero == 0) & (area > 16 * eps * longest) & (area > 4 * rounding) & pointed


def _cross(a: Tensor, b: Tensor, dim: int) -> Tensor:
    """The cross product along a dimension."""
    a0, a1, a2 = a.unbind(dim)
    b0, b1, b2 = b.unbind(dim)
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), dim)


def _triad(a: Tensor, b: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """The orthonormal frame of `a` and the normal of `a` and `b`, vectors along a dimension."""
    normal = _cross(a, b, dim)
    first = a * (a * a).sum(dim, keepdim=True).clamp_min(1e-300).rsqrt()
    third = normal * (normal * normal).sum(dim, keepdim=True).clamp_min(1e-300).rsqrt()
    return first, _cross(third, first, dim), third


def _across(u: tuple[Tensor, ...], dim: int) -> tuple[Tensor, Tensor]:
    """Two unit vectors orthogonal to a unit vector given by components, and to each other (Duff et al. 2017)."""
    x, y, z = u
    s = torch.copysign(torch.ones_like(z), z)
    a = -1 / (s + z)
    b = x * y * a
    return torch.stack((1 + s * x * x * a, s * b, -s * x), dim), torch.stack((b, s + y * y * a, -y), dim)


def _fma(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """`a b + c` in one pass over memory, which is what this solver's time goes to."""
    return torch.addcmul(c, a, b)


def _fms(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """`c - a b`."""
    return torch.addcmul(c, a, b, value=-1)


class _Triangle:
    """The three quadrics in the depths, for rays `u` and points `X` as (point, coordinate, problem).

    Pairs of points come in the order 01, 02, 12. Every form is written with `1 - u_i'u_j` taken from the difference of
    the rays: for narrow fields of view the scalar product itself has lost the angle.
    """

    def __init__(self, u: Tensor, X: Tensor) -> None:
        edge = torch.stack((X[0] - X[1], X[0] - X[2], X[1] - X[2]))
        chord = torch.stack((u[0] - u[1], u[0] - u[2], u[1] - u[2]))
        self.u = u
        self.a = (edge * edge).sum(1)
        self.n2 = (chord * chord).sum(1)

    def depths(self) -> tuple[Tensor, Tensor]:
        """Candidates (point, slot, problem) for the depths and which of them are real and positive."""
        a, n = self.a, 0.5 * self.n2
        total = a.sum(0)
        a0, a1, a2 = (a / total).unbind(0)
        # Orthonormal directions of the pencil: weights of the three forms that cancel the right-hand sides.
        root = _fma(a0, a0, a1 * a1).rsqrt()
        p0, p1 = a1 * root, -a0 * root
        q0, q1, q2 = -a2 * p1, a2 * p0, _fms(a1, p0, a0 * p1)
        root = _fma(q0, q0, _fma(q1, q1, q2 * q2)).rsqrt()
        p = torch.stack((p0, p1, torch.zeros_like(p0)))
        q = torch.stack((q0, q1, q2)) * root
        turned = torch.stack((p, (p + q) * (1 / SQRT2), q, (q - p) * (1 / SQRT2)), 1)

        # The determinant of a member of the pencil, and its cubic along the pencil from four values.
        s = n * (2 - n)
        u0, u1, u2 = self.u.unbind(0)
        volume = (u0 * _cross(u1, u2, 0)).sum(0)
        w0, w1, w2 = turned.unbind(0)
        b0, b1, b2 = (turned * turned * s[:, None]).unbind(0)
        f = _fma(w0 + w1, b2, _fma(w0 + w2, b1, (w1 + w2) * b0))
        f = _fma(w0 * w1 * w2, _fms(volume, volume, s.sum(0)), f)
        pick = f.abs().max(0, keepdim=True).indices
        g0, g1, g2, g3 = torch.cat((f, -f[:3])).gather(0, pick + torch.arange(4, device=f.device)[:, None]).unbind(0)
        both = torch.cat((turned, -turned[:, :2]), 1)
        at = pick.expand(3, -1)[:, None]
        p, q = both.gather(1, at)[:, 0], both.gather(1, at + 2)[:, 0]
        inverse = 1 / g0
        c1 = torch.sub(SQRT2 * (g1 - g3), g0)
        c2 = torch.sub(SQRT2 * (g1 + g3), g2)
        root = _separate_root(c2 * inverse, c1 * inverse, g2 * inverse)
        size = _fma(root, root, torch.ones_like(root)).rsqrt()
        w, other = _fma(root, p, q) * size, _fms(root, q, p) * size

        lines = self._lines(w, n)
        e1, e2 = _across(lines.unbind(0), 0)
        # The other member on the line: q11 x^2 + 2 q12 x y + q22 y^2.
        q12 = self._form(other, n, e1, e2)
        q11, q22 = self._square(other, torch.stack((e1, e2), 1)).unbind(0)
        product = q11 * q22
        discriminant = _fma(q12, q12, -product)
        slack = _fma(q12, q12, product.abs())
        z = -(q12 + torch.copysign(discriminant.clamp_min(0).sqrt(), q12))
        depths = torch.cat((_fma(z, e1, q11 * e2), _fma(q22, e1, z * e2)), 1)
        real = discriminant >= -1e-9 * slack
        # All of one sign, and of the size that the sides of the triangle ask for.
        size = torch.copysign((total / self._square(None, depths)).sqrt(), depths.sum(0))
        depths = depths * size
        # False for NaN too.
        valid = torch.cat((real, real)) & (depths.amin(0) > 0) & (depths.amax(0) < torch.inf)
        return torch.where(valid, depths, 1.0), valid

    def _lines(self, w: Tensor, n: Tensor) -> Tensor:
        """The two lines (coordinate, line, problem) of the member of the pencil with weights w, which must be degenerate."""
        w0, w1, w2 = w.unbind(0)
        k0, k1, k2 = ((n - 1) * w).unbind(0)
        d0, d1, d2 = w0 + w1, w0 + w2, w1 + w2
        # Minus the adjugate is v v' with v the common point of the lines; its diagonal without cancellation.
        mixed = _fma(w0, d2, w1 * w2)
        diagonal = -(mixed + (n * (2 - n) * w * w).flip(0))
        b01, b02, b12 = _fms(k1, k2, k0 * d2), _fms(k0, k2, k1 * d1), _fms(k0, k1, k2 * d0)
        columns = torch.stack((diagonal[0], b01, b02, b01, diagonal[1], b12, b02, b12, diagonal[2])).view(3, 3, -1)
        largest, pick = diagonal.max(0)
        best = columns.gather(0, pick.expand(1, 3, -1))[0]
        v0, v1, v2 = best * largest.clamp_min(1e-300).rsqrt()
        rank1 = torch.stack((d0, k0 - v2, k1 + v1, k0 + v2, d1, k2 - v0, k1 - v1, k2 + v0, d2)).view(3, 3, -1)
        pick = (rank1 * rank1).sum(1).max(0).indices
        row = rank1.gather(0, pick.expand(1, 3, -1))[0]
        lines = torch.stack((row, (rank1 * row).sum(1)), 1)
        return lines * (lines * lines).sum(0).clamp_min(1e-300).rsqrt()

    @staticmethod
    def _form(w: Tensor, n: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """The bilinear form with weights w of the three pairs, for x and y as (point, ..., problem)."""
        x0, x1, x2 = x.unbind(0)
        y0, y1, y2 = y.unbind(0)
        f = w[0] * _fma(x0 - x1, y0 - y1, n[0] * _fma(x0, y1, x1 * y0))
        f = _fma(w[1], _fma(x0 - x2, y0 - y2, n[1] * _fma(x0, y2, x2 * y0)), f)
        return _fma(w[2], _fma(x1 - x2, y1 - y2, n[2] * _fma(x1, y2, x2 * y1)), f)

    def _square(self, w: Tensor | None, x: Tensor) -> Tensor:
        """The quadratic form with weights w, all 1 if not given, for x as (point, ..., problem)."""
        x0, x1, x2 = x.unbind(0)
        m0, m1, m2 = self.n2.unbind(0)
        e0, e1, e2 = x0 - x1, x0 - x2, x1 - x2
        f0, f1, f2 = _fma(e0, e0, m0 * x0 * x1), _fma(e1, e1, m1 * x0 * x2), _fma(e2, e2, m2 * x1 * x2)
        return f0 + f1 + f2 if w is None else _fma(w[0], f0, _fma(w[1], f1, w[2] * f2))

    def newton(self, depths: tuple[Tensor, ...], valid: Tensor | None = None) -> tuple[tuple[Tensor, ...], Tensor]:
        """One Newton step on the three quadrics from depths given as rows, and how well they were met before it.

        That is the largest error of a quadric relative to its side of the triangle. Slots that are not `valid`, if given,
        stay as they are and have no derivative; otherwise what divides by zero comes out as it does.
        """
        l0, l1, l2 = depths
        m0, m1, m2 = self.n2.unbind(0)
        e0, e1, e2 = l0 - l1, l0 - l2, l1 - l2
        m00, m01, m10, m12, m21, m22 = m0 * l0, m0 * l1, m1 * l0, m1 * l2, m2 * l1, m2 * l2
        minus = -self.a
        r0 = _fma(m00, l1, _fma(e0, e0, minus[0]))
        r1 = _fma(m10, l2, _fma(e1, e1, minus[1]))
        r2 = _fma(m21, l2, _fma(e2, e2, minus[2]))
        a0, a1 = torch.add(m01, e0, alpha=2), torch.sub(m00, e0, alpha=2)
        b0, b2 = torch.add(m12, e1, alpha=2), torch.sub(m10, e1, alpha=2)
        c1, c2 = torch.add(m22, e2, alpha=2), torch.sub(m21, e2, alpha=2)
        p, q, m = b2 * c1, b0 * c2, _fms(b2, r2, r1 * c2)
        det = _fma(a0, p, a1 * q)
        if valid is not None:
            # At a double root there is no derivative to speak of.
            valid = valid & (det.detach().abs() > 1e-13 * (_fma(a0, p, -a1 * q)).detach().abs())
            det = torch.where(valid, det, 1.0)
        inverse = 1 / det if valid is None else torch.where(valid, 1 / det, 0.0)
        s0, s1 = _fma(r0, p, a1 * m), _fms(a0, m, r0 * q)
        s2 = _fms(_fms(a0, r1, r0 * b0), c1, a1 * b0 * r2)
        new = _fms(s0, inverse, l0), _fms(s1, inverse, l1), _fms(s2, inverse, l2)
        return new, self._worst(r0, r1, r2)

    def _worst(self, r0: Tensor, r1: Tensor, r2: Tensor) -> Tensor:
        b0, b1, b2 = (1 / self.a).unbind(0)
        return torch.maximum(torch.maximum((r0 * b0).abs(), (r1 * b1).abs()), (r2 * b2).abs())

    def polish(self, depths: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Newton steps, unless they lead astray as at a double root; and which slots meet the quadrics in the end.

        Where two of the points are close to each other the start has a small error in the quadrics and a large one in the
        depths. The first step then trades one for the other, so that what counts is the error after three.
        """
        rows, before = self.newton(depths.unbind(0))
        rows, _ = self.newton(rows)
        rows, _ = self.newton(rows)
        _, after = self.newton(rows)
        polished = torch.stack(rows)
        # False for NaN too.
        better = after <= before
        depths = torch.where(better, polished, depths)
        size = 1e-10 + 1e-14 * (depths * depths).amax(0) / self.a.amin(0)
        valid = valid & (torch.where(better, after, before) <= size) & (depths.amin(0) > 0)
        return torch.where(valid, depths, 1.0), valid


def _separate_root(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """The real root of x^3 + a x^2 + b x + c that is farthest from the inflection point, so never one of a close pair.

    For four real intersections every real root of the pencil's cubic gives real lines, for two there is only one real root.
    """
    shift = a / -3
    Q = shift * shift - b / 3
    R = 0.5 * (((shift + a) * shift + b) * shift + c)
    # Depressed: y^3 - 3 Q y + 2 R = 0 with x = y + shift; the sign is taken out.
    size = R.abs()
    root_q = Q.clamp_min(0).sqrt()
    inner = size * size - Q * Q * Q
    outer = (size + inner.clamp_min(0).sqrt()).clamp_min(1e-300) ** (1 / 3)
    ratio = (size / (root_q * root_q * root_q).clamp_min(1e-300)).clamp_max(1)
    y = torch.where(inner > 0, outer + Q / outer, root_q * (1.7320508 + ratio * (0.3208 - 0.0529 * ratio)))
    x = torch.copysign(y, -R) + shift
    for _ in range(2):
        slope = (3 * x + 2 * a) * x + b
        step = (((x + a) * x + b) * x + c) / slope
        x = x - torch.where(torch.isfinite(step), step, 0.0)
    return x
