"""The depths of three points along three rays: three quadrics, by the pencil of conics through their solutions.

Eliminating the scale leaves two conics in the direction of `(l_0, l_1, l_2)`, whose at most four common points are found as
Ding, Yang, Larsson, Olsson & Åström, "Revisiting the P3P problem" (CVPR 2023) do: one real root of a cubic gives a pencil
member that is a pair of lines, and each line meets another member in at most two points. Here no direction of the pencil is
special: the cubic is homogeneous, the pencil is turned until its leading coefficient is large, and lines are met with conics in
homogeneous coordinates, so that right angles, isosceles triangles and a centre in the plane of the points lose no solution.
"""

import torch
from torch import Tensor

from torchsfm.linalg.vectors import (
    Vector,
    across,
    ahead,
    chosen,
    combined,
    cross,
    dot,
    dots,
    each,
    fma,
    fms,
    greatest,
    largest,
    least,
    matrix,
    minus,
    scaled,
    together,
    total,
    vector,
)

NEAREST = 1e-9
"""Least ratio of the depths of two points: in what direction a point still nearer is seen is up to rounding."""
ASIDE = 1e-6
"""Largest angle between a ray and its point, in radians, in what is called a solution."""

SQRT2 = 2.0**0.5


Points = Tensor | list[Vector]
"""Three vectors, as a tensor (point, coordinate, problem) or as a list."""


class Triangle:
    """The three quadrics in the depths.

    What belongs to a pair of points stands where the third point is: 12, 20, 01. Every form is written with `1 - u_i'u_j`
    taken from the difference of the rays: for narrow fields of view the scalar product itself has lost the angle.
    """

    def __init__(self, u: Points, X: Points) -> None:
        self.a, self.m = _squared_sides(X), _squared_sides(u)
        self.volume = dot(u[0], cross(u[1], u[2]))
        # For the depths of all slots.
        self.side, self.m_slots = (each(lambda x: x.unsqueeze(-2), v) for v in (self.a, self.m))
        self.side_inverse, self.side_minus = each(torch.reciprocal, self.side), each(torch.neg, self.side)

    def candidates(self) -> tuple[Vector, Tensor]:
        """The depths in four slots, (slot, problem), and which of them are real and positive."""
        p, q = self._pencil()
        n = each(lambda m: 0.5 * m, self.m)
        s = each(lambda k: k * (2 - k), n)
        mixed = fms(self.volume, self.volume, total(s))

        def determinant(w: Vector) -> Tensor:
            w0, w1, w2 = w
            sum_w = total(w)
            wide = s.unsqueeze(1) if isinstance(s, Tensor) and w0.ndim > 1 else s
            return fma(w0 * w1 * w2, mixed, total(each(lambda x, k: (sum_w - x) * (x * x * k), w, wide)))

        # The cubic along the pencil from four directions, the one with the largest value turned to infinity.
        u, v = each(lambda x, y: (x + y) * (1 / SQRT2), p, q), each(lambda x, y: (y - x) * (1 / SQRT2), p, q)
        values = [determinant(w) for w in together([p, u, q, v])]
        f0, f1, f2, f3 = values if len(values) == 4 else values[0].unbind(0)
        diagonal = torch.maximum(f1.abs(), f3.abs()) > torch.maximum(f0.abs(), f2.abs())
        p, q = chosen(diagonal, u, p), chosen(diagonal, v, q)
        g: list[Tensor] = [torch.where(diagonal, x, y) for x, y in ((f1, f0), (f2, f1), (f3, f2), (-f0, f3))]
        swap = g[2].abs() > g[0].abs()
        p, q = chosen(swap, q, p), chosen(swap, each(lambda x: -x, p), q)
        g = [torch.where(swap, x, y) for x, y in ((g[2], g[0]), (g[3], g[1]), (-g[0], g[2]), (-g[1], g[3]))]
        inverse = 1 / g[0]
        c2, c1 = SQRT2 * (g[1] + g[3]) - g[2], SQRT2 * (g[1] - g[3]) - g[0]
        root = separate_root(c2 * inverse, c1 * inverse, g[2] * inverse)
        size = torch.rsqrt(root * root + 1)
        w = each(lambda x, y: fma(root, x, y) * size, p, q)
        other = each(lambda x, y: fms(root, y, x) * size, p, q)
        slots = [slot for line in together(list(self._lines(w, n, s))) for slot in self._meet(line, other)]
        if len(slots) == 1:
            return slots[0]
        # In the order that stacked lines have.
        order = [slots[i] for i in (0, 2, 1, 3)]
        return each(lambda *x: torch.stack(x), *(v for v, _ in order)), torch.stack([real for _, real in order])

    def _pencil(self) -> tuple[Vector, Vector]:
        """Orthonormal weights of the three forms that cancel the right-hand sides."""
        a0, a1, a2 = self.a
        root = fma(a1, a1, a2 * a2).rsqrt()
        p2, p1 = a1 * root, -a2 * root
        q = vector(fms(a2, p1, a1 * p2), -a0 * p2, a0 * p1)
        return vector(torch.zeros_like(p1), p1, p2), scaled(q, dot(q, q).rsqrt())

    def _lines(self, w: Vector, n: Vector, s: Vector) -> tuple[Vector, Vector]:
        """The two lines of the member of the pencil with weights w, which must be degenerate."""
        w1, w2 = ahead(w)
        k, d = each(lambda m, x: fma(m, x, -x), n, w), each(torch.add, w1, w2)
        k1, k2 = ahead(k)
        # Minus the adjugate is v v' with v the common point of the lines; its diagonal without cancellation.
        mixed = fma(w[0], d[0], w[1] * w[2])
        c = each(lambda m, x: -fma(m * x, x, mixed), s, w)
        (c0, c1, c2), (b0, b1, b2) = c, each(lambda x, y, z, e: fms(y, z, x * e), k, k1, k2, d)
        size, column = largest(c, matrix([[c0, b2, b1], [b2, c1, b0], [b1, b0, c2]]))
        point = scaled(column, size.clamp_min(1e-300).rsqrt())
        (x0, x1, x2), (y0, y1, y2), (d0, d1, d2) = each(torch.add, k, point), minus(k, point), d
        rows = matrix([[d0, y2, x1], [x2, d1, y0], [y1, x0, d2]])
        size, row = largest(dots(rows), rows)
        first = scaled(row, size.clamp_min(1e-300).rsqrt())
        second = dots(rows, first)
        return first, scaled(second, dot(second, second).clamp_min(1e-300).rsqrt())

    def _meet(self, line: Vector, w: Vector) -> list[tuple[Vector, Tensor]]:
        """The two points where a line meets the member of the pencil with weights w, scaled to the triangle, and if real."""
        e1, e2 = across(line)
        m = self.m_slots if isinstance(line, Tensor) else self.m
        if isinstance(w, Tensor):
            w = w.unsqueeze(1)
        # q11 x^2 + 2 q12 x y + q22 y^2 along the line.
        (x1, x2), (y1, y2) = ahead(e1), ahead(e2)
        d, e = minus(x1, x2), minus(y1, y2)
        q11, q22 = dot(w, _forms(m, x1, x2, d)), dot(w, _forms(m, y1, y2, e))
        q12 = dot(w, each(lambda r, s, x, y, z, t, k: fma(r, s, 0.5 * k * fma(x, t, y * z)), d, e, x1, x2, y1, y2, m))
        product = q11 * q22
        discriminant = fma(q12, q12, -product)
        real = discriminant >= -1e-9 * fma(q12, q12, product.abs())
        z = -(q12 + torch.copysign(discriminant.clamp_min(0).sqrt(), q12))
        slots: list[tuple[Vector, Tensor]] = []
        for depths in together([combined(z, e1, q11, e2), combined(q22, e1, z, e2)]):
            # All of one sign, and of the size that the sides of the triangle ask for.
            second, third = ahead(depths)
            square = total(_forms(m, second, third, minus(second, third)))
            rows = scaled(depths, torch.copysign((total(self.a) / square).sqrt(), total(depths)))
            # False for NaN too.
            front = (least(rows) > 0) & (greatest(rows) < torch.inf)
            slots.append((rows, (real if front.shape == real.shape else torch.cat((real, real))) & front))
        return slots

    def _quadrics(self, depths: Vector) -> tuple[Vector, tuple[Vector, Vector, Vector]]:
        """The values of the quadrics, and of the depths that each is in the first, the second, and their difference."""
        first, second = ahead(depths)
        e = minus(first, second)
        r = each(lambda m, x, y, d, a: fma(m * x, y, fma(d, d, a)), self.m_slots, first, second, e, self.side_minus)
        return r, (first, second, e)

    def _inverse(self, pairs: tuple[Vector, Vector, Vector], valid: Tensor | None) -> tuple[Vector, Vector, Vector]:
        """The inverse of the derivative of the quadrics: in each row what belongs to a depth's own quadric and the next two."""
        first, second, e = pairs
        # The derivatives of a quadric by its first depth, and by its second.
        A = each(lambda y, d, m: torch.add(m * y, d, alpha=2), second, e, self.m_slots)
        B = each(lambda x, d, m: torch.sub(m * x, d, alpha=2), first, e, self.m_slots)
        (A1, _), (_, B2) = ahead(A), ahead(B)
        cofactors = each(torch.mul, A1, B2), each(torch.mul, B, B2), each(torch.mul, A, A1)
        # The rows are (0, A0, B0), (B1, 0, A1), (A2, B2, 0).
        x, y = A[2] * cofactors[2][0], B[1] * cofactors[1][0]
        det = x + y
        if valid is not None:
            # At a double root there is no derivative to speak of.
            valid = valid & (det.detach().abs() > 1e-13 * (x - y).detach().abs())
            inverse = torch.where(valid, 1 / torch.where(valid, det, 1.0), 0.0)
        else:
            inverse = 1 / det
        own, next_one, last = (scaled(c, inverse) for c in cofactors)
        return own, next_one, last

    @staticmethod
    def _moved(depths: Vector, inverse: tuple[Vector, Vector, Vector], r: Vector) -> Vector:
        return each(lambda x, a, b, c, r0, r1, r2: fma(a, r0, fms(b, r1, fms(c, r2, x))), depths, *inverse, r, *ahead(r))

    def newton(self, depths: Vector, valid: Tensor | None = None) -> Vector:
        """One Newton step on the three quadrics.

        Slots that are not `valid`, if given, stay as they are and have no derivative; otherwise what divides by zero comes
        out as it does.
        """
        r, pairs = self._quadrics(depths)
        return self._moved(depths, self._inverse(pairs, valid), r)

    def _worst(self, r: Vector) -> Tensor:
        """The largest error of a quadric relative to its side of the triangle."""
        return greatest(each(lambda x, k: (x * k).abs(), r, self.side_inverse))

    def polish(self, depths: Vector, valid: Tensor) -> tuple[Vector, Tensor]:
        """Newton steps, unless they lead astray as at a double root; and which slots meet the quadrics in the end.

        Where two of the points are close to each other the start has a small error in the quadrics and a large one in the
        depths. The first step then trades one for the other, so that what counts is the error after three.
        """
        start = self._quadrics(depths)[0]
        rows = self.newton(self.newton(self.newton(depths)))
        end = self._quadrics(rows)[0]
        # False for NaN too.
        better = self._worst(end) <= self._worst(start)
        rows, left = chosen(better, rows, depths), chosen(better, end, start)
        # Rounding of far points against a short side; but not so far that any depth would do.
        over = each(
            lambda r, k, x, y: (r * k).abs() - (1e-14 * k * torch.maximum(x, y).square()).clamp_max(1e-5),
            left, self.side_inverse, *ahead(rows),
        )  # fmt: skip
        close = greatest(over) <= 1e-10
        # Lengths that are wrong by so much, be it by rounding, turn the triangle, and take the nearest point off its ray.
        longest, shortest = greatest(self.side).sqrt(), least(self.side).sqrt()
        wrong = greatest(each(lambda r, k: r.abs() * k.sqrt(), left, self.side_inverse)) + 1e-15 * longest
        nearest = least(rows)
        steady = (nearest > NEAREST * greatest(rows)) & (wrong * longest <= ASIDE * shortest * nearest)
        valid = valid & close & steady
        return each(lambda x: torch.where(valid, x, 1.0), rows), valid

    def follow(self, depths: Vector, valid: Tensor) -> Vector:
        """The same depths with their derivatives: those of two Newton steps from the solution, exact to second order."""
        rows = self.newton(self.newton(depths, valid), valid)
        return each(lambda depth, row: depth + (row - row.detach()), depths, rows)


def _squared_sides(points: Points) -> Vector:
    """The squared lengths of 12, 20, 01."""
    if isinstance(points, Tensor):
        side = torch.roll(points, -1, 0) - torch.roll(points, 1, 0)
        return (side * side).sum(1)
    return tuple(dot(e, e) for e in (minus(points[(i + 1) % 3], points[(i + 2) % 3]) for i in range(3)))


def _forms(m: Vector, x: Vector, y: Vector, d: Vector) -> Vector:
    """`|x u - y v|^2` with `m = |u - v|^2` and `d = x - y`, u and v of length 1."""
    return each(lambda k, a, b, e: fma(k * a, b, e * e), m, x, y, d)


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
