"""The depths of three points along three rays: three quadrics, by the pencil of conics through their solutions.

Eliminating the scale leaves two conics in the direction of `(l_0, l_1, l_2)`, whose at most four common points are found as
Ding, Yang, Larsson, Olsson & Åström, "Revisiting the P3P problem" (CVPR 2023) do: one real root of a cubic gives a pencil
member that is a pair of lines, and each line meets another member in at most two points. Here no direction of the pencil is
special: the cubic is homogeneous, the pencil is turned until its leading coefficient is large, and lines are met with conics in
homogeneous coordinates, so that right angles, isosceles triangles and a centre in the plane of the points lose no solution.
"""

import torch
from torch import Tensor

from torchsfm.linalg.vectors import across, ahead, cross, dot, fma, fms, largest, matrix

NEAREST = 1e-9
"""Least ratio of the depths of two points: in what direction a point still nearer is seen is up to rounding."""
ASIDE = 1e-6
"""Largest angle between a ray and its point, in radians, in what is called a solution."""

SQRT2 = 2.0**0.5


class Triangle:
    """The three quadrics in the depths, from unit rays and points (point, coordinate, problem).

    What belongs to a pair of points stands where the third point is: 12, 20, 01. Every form is written with `1 - u_i'u_j`
    taken from the difference of the rays: for narrow fields of view the scalar product itself has lost the angle.
    """

    def __init__(self, u: Tensor, X: Tensor) -> None:
        self.a, self.m = _squared_sides(X), _squared_sides(u)
        self.volume = dot(u[0], cross(u[1], u[2]))
        # For the depths of all slots.
        self.side, self.m_slots = self.a.unsqueeze(-2), self.m.unsqueeze(-2)
        self.side_inverse, self.side_minus = self.side.reciprocal(), -self.side

    def candidates(self) -> tuple[Tensor, Tensor]:
        """The depths in four slots, (point, slot, problem), and which of them are real and positive."""
        p, q = self._pencil()
        n = 0.5 * self.m
        s = n * (2 - n)
        # The cubic along the pencil from four directions, the one with the largest value turned to infinity.
        u, v = (p + q) * (1 / SQRT2), (q - p) * (1 / SQRT2)
        w = torch.stack((p, u, q, v), 1)
        determinants = fma(w.prod(0), fms(self.volume, self.volume, s.sum(0)), ((w.sum(0) - w) * (w * w * s[:, None])).sum(0))
        f0, f1, f2, f3 = determinants.unbind(0)
        diagonal = torch.maximum(f1.abs(), f3.abs()) > torch.maximum(f0.abs(), f2.abs())
        p, q = torch.where(diagonal, u, p), torch.where(diagonal, v, q)
        g: list[Tensor] = [torch.where(diagonal, x, y) for x, y in ((f1, f0), (f2, f1), (f3, f2), (-f0, f3))]
        swap = g[2].abs() > g[0].abs()
        p, q = torch.where(swap, q, p), torch.where(swap, -p, q)
        g = [torch.where(swap, x, y) for x, y in ((g[2], g[0]), (g[3], g[1]), (-g[0], g[2]), (-g[1], g[3]))]
        inverse = 1 / g[0]
        c2, c1 = SQRT2 * (g[1] + g[3]) - g[2], SQRT2 * (g[1] - g[3]) - g[0]
        root = separate_root(c2 * inverse, c1 * inverse, g[2] * inverse)
        size = torch.rsqrt(root * root + 1)
        return self._meet(self._lines(fma(root, p, q) * size, n, s), fms(root, q, p) * size)

    def _pencil(self) -> tuple[Tensor, Tensor]:
        """Orthonormal weights of the three forms that cancel the right-hand sides."""
        a0, a1, a2 = self.a
        root = fma(a1, a1, a2 * a2).rsqrt()
        p2, p1 = a1 * root, -a2 * root
        q = torch.stack((fms(a2, p1, a1 * p2), -a0 * p2, a0 * p1))
        return torch.stack((torch.zeros_like(p1), p1, p2)), q * dot(q, q).rsqrt()

    def _lines(self, w: Tensor, n: Tensor, s: Tensor) -> Tensor:
        """The two lines (3, line, problem) of the member of the pencil with weights w, which must be degenerate."""
        w1, w2 = ahead(w)
        k, d = fma(n, w, -w), w1 + w2
        k1, k2 = ahead(k)
        # Minus the adjugate is v v' with v the common point of the lines; its diagonal without cancellation.
        c = -fma(s * w, w, fma(w[0], d[0], w[1] * w[2]))
        (c0, c1, c2), (b0, b1, b2) = c, fms(k1, k2, k * d)
        size, column = largest(c, matrix([[c0, b2, b1], [b2, c1, b0], [b1, b0, c2]]))
        point = column * size.clamp_min(1e-300).rsqrt()
        (x0, x1, x2), (y0, y1, y2), (d0, d1, d2) = k + point, k - point, d
        rows = matrix([[d0, y2, x1], [x2, d1, y0], [y1, x0, d2]])
        size, row = largest((rows * rows).sum(1), rows)
        first = row * size.clamp_min(1e-300).rsqrt()
        second = (rows * first).sum(1)
        return torch.stack((first, second * dot(second, second).clamp_min(1e-300).rsqrt()), 1)

    def _meet(self, lines: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """The points where lines meet the member of the pencil with weights w, scaled to the triangle, and if real.

        First one of each line, then the other.
        """
        e1, e2 = across(lines)
        m, w = self.m_slots, w.unsqueeze(1)
        # q11 x^2 + 2 q12 x y + q22 y^2 along the line.
        (x1, x2), (y1, y2) = ahead(e1), ahead(e2)
        d, e = x1 - x2, y1 - y2
        q11, q22 = dot(w, _forms(m, x1, x2, d)), dot(w, _forms(m, y1, y2, e))
        q12 = dot(w, fma(d, e, 0.5 * m * fma(x1, y2, x2 * y1)))
        product = q11 * q22
        discriminant = fma(q12, q12, -product)
        real = discriminant >= -1e-9 * fma(q12, q12, product.abs())
        z = -(q12 + torch.copysign(discriminant.clamp_min(0).sqrt(), q12))
        depths = torch.cat((fma(z, e1, q11 * e2), fma(q22, e1, z * e2)), 1)
        # All of one sign, and of the size that the sides of the triangle ask for.
        second, third = ahead(depths)
        square = _forms(m, second, third, second - third).sum(0)
        rows = depths * torch.copysign((self.a.sum(0) / square).sqrt(), depths.sum(0))
        # False for NaN too.
        front = (rows.amin(0) > 0) & (rows.amax(0) < torch.inf)
        return rows, torch.cat((real, real)) & front

    def _quadrics(self, depths: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """The values of the quadrics, and of the depths that each is in the first, the second, and their difference."""
        first, second = ahead(depths)
        e = first - second
        r = fma(self.m_slots * first, second, fma(e, e, self.side_minus))
        return r, (first, second, e)

    def _inverse(self, pairs: tuple[Tensor, Tensor, Tensor], valid: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """The inverse of the derivative of the quadrics: in each row what belongs to a depth's own quadric and the next two."""
        first, second, e = pairs
        # The derivatives of a quadric by its first depth, and by its second.
        A = torch.add(self.m_slots * second, e, alpha=2)
        B = torch.sub(self.m_slots * first, e, alpha=2)
        (A1, _), (_, B2) = ahead(A), ahead(B)
        cofactors = A1 * B2, B * B2, A * A1
        # The rows are (0, A0, B0), (B1, 0, A1), (A2, B2, 0).
        x, y = A[2] * cofactors[2][0], B[1] * cofactors[1][0]
        det = x + y
        if valid is not None:
            # At a double root there is no derivative to speak of.
            valid = valid & (det.detach().abs() > 1e-13 * (x - y).detach().abs())
            inverse = torch.where(valid, 1 / torch.where(valid, det, 1.0), 0.0)
        else:
            inverse = 1 / det
        own, next_one, last = (c * inverse for c in cofactors)
        return own, next_one, last

    def newton(self, depths: Tensor, valid: Tensor | None = None) -> Tensor:
        """One Newton step on the three quadrics.

        Slots that are not `valid`, if given, stay as they are and have no derivative; otherwise what divides by zero comes
        out as it does.
        """
        r, pairs = self._quadrics(depths)
        own, next_one, last = self._inverse(pairs, valid)
        r1, r2 = ahead(r)
        return fma(own, r, fms(next_one, r1, fms(last, r2, depths)))

    def _worst(self, r: Tensor) -> Tensor:
        """The largest error of a quadric relative to its side of the triangle."""
        return (r * self.side_inverse).abs().amax(0)

    def polish(self, depths: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Newton steps, unless they lead astray as at a double root; and which slots meet the quadrics in the end.

        Where two of the points are close to each other the start has a small error in the quadrics and a large one in the
        depths. The first step then trades one for the other, so that what counts is the error after three.
        """
        start = self._quadrics(depths)[0]
        rows = self.newton(self.newton(self.newton(depths)))
        end = self._quadrics(rows)[0]
        # False for NaN too.
        better = self._worst(end) <= self._worst(start)
        rows, left = torch.where(better, rows, depths), torch.where(better, end, start)
        # Rounding of far points against a short side; but not so far that any depth would do.
        k, (x, y) = self.side_inverse, ahead(rows)
        over = (left * k).abs() - (1e-14 * k * torch.maximum(x, y).square()).clamp_max(1e-5)
        close = over.amax(0) <= 1e-10
        # Lengths that are wrong by so much, be it by rounding, turn the triangle, and take the nearest point off its ray.
        longest, shortest = self.side.amax(0).sqrt(), self.side.amin(0).sqrt()
        wrong = (left.abs() * k.sqrt()).amax(0) + 1e-15 * longest
        nearest = rows.amin(0)
        steady = (nearest > NEAREST * rows.amax(0)) & (wrong * longest <= ASIDE * shortest * nearest)
        valid = valid & close & steady
        return torch.where(valid, rows, 1.0), valid

    def follow(self, depths: Tensor, valid: Tensor) -> Tensor:
        """The same depths with their derivatives: those of two Newton steps from the solution, exact to second order."""
        rows = self.newton(self.newton(depths, valid), valid)
        return depths + (rows - rows.detach())


def _squared_sides(points: Tensor) -> Tensor:
    """The squared lengths of 12, 20, 01."""
    side = torch.roll(points, -1, 0) - torch.roll(points, 1, 0)
    return (side * side).sum(1)


def _forms(m: Tensor, x: Tensor, y: Tensor, d: Tensor) -> Tensor:
    """`|x u - y v|^2` with `m = |u - v|^2` and `d = x - y`, u and v of length 1."""
    return fma(m * x, y, d * d)


def separate_root(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
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
