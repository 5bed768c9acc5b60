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
    Rows,
    Vector,
    across,
    chosen,
    combined,
    cross,
    dot,
    each,
    fma,
    fms,
    largest,
    minus,
    scaled,
    together,
    vector,
)

SQRT2 = 2.0**0.5


class Triangle:
    """The three quadrics in the depths.

    Pairs of points come in the order 01, 02, 12. Every form is written with `1 - u_i'u_j` taken from the difference of
    the rays: for narrow fields of view the scalar product itself has lost the angle.
    """

    def __init__(self, u: list[Vector], X: list[Vector]) -> None:
        edges = minus(X[0], X[1]), minus(X[0], X[2]), minus(X[1], X[2])
        chords = minus(u[0], u[1]), minus(u[0], u[2]), minus(u[1], u[2])
        self.a = tuple(dot(e, e) for e in edges)
        self.n2 = tuple(dot(c, c) for c in chords)
        self.volume = dot(u[0], cross(u[1], u[2]))

    def candidates(self) -> tuple[Rows, Tensor]:
        """The depths in four slots, rows (slot, problem), and which of them are real and positive."""
        p, q = self._pencil()
        n = each(lambda m: 0.5 * m, vector(*self.n2))
        s = each(lambda k: k * (2 - k), n)
        mixed = fms(self.volume, self.volume, s[0] + s[1] + s[2])

        def determinant(w: Vector) -> Tensor:
            w0, w1, w2 = w
            f = fma(w0 + w1, w2 * w2 * s[2], (w1 + w2) * (w0 * w0 * s[0]))
            return fma(w0 * w1 * w2, mixed, fma(w0 + w2, w1 * w1 * s[1], f))

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
        size = fma(root, root, torch.ones_like(root)).rsqrt()
        w = each(lambda x, y: fma(root, x, y) * size, p, q)
        other = each(lambda x, y: fms(root, y, x) * size, p, q)
        total = self.a[0] + self.a[1] + self.a[2]
        slots = [slot for line in together(list(self._lines(w, n))) for slot in self._meet(line, other, n, total)]
        if len(slots) == 4:
            # Slots in the order that stacked lines have.
            parts = zip(*((*depths, real) for depths, real in (slots[0], slots[2], slots[1], slots[3])), strict=True)
            l0, l1, l2, real = (torch.stack(part) for part in parts)
        else:
            parts = zip(*((*depths, real) for depths, real in slots), strict=True)
            l0, l1, l2, real = (torch.cat(part) for part in parts)
        return (l0, l1, l2), real

    def _pencil(self) -> tuple[Vector, Vector]:
        """Orthonormal weights of the three forms that cancel the right-hand sides."""
        a0, a1, a2 = self.a
        root = fma(a0, a0, a1 * a1).rsqrt()
        p0, p1 = a1 * root, -a0 * root
        q = vector(-a2 * p1, a2 * p0, fms(a1, p0, a0 * p1))
        return vector(p0, p1, torch.zeros_like(p0)), scaled(q, dot(q, q).rsqrt())

    def _lines(self, w: Vector, n: Vector) -> tuple[Vector, Vector]:
        """The two lines of the member of the pencil with weights w, which must be degenerate."""
        w0, w1, w2 = w
        k0, k1, k2 = each(lambda m, x: fma(m, x, -x), n, w)
        d0, d1, d2 = w0 + w1, w0 + w2, w1 + w2
        # Minus the adjugate is v v' with v the common point of the lines; its diagonal without cancellation.
        mixed = fma(w0, d2, w1 * w2)
        s0, s1, s2 = each(lambda m, x: -fma(m * (2 - m) * x, x, mixed), n, w)
        b01, b02, b12 = fms(k1, k2, k0 * d2), fms(k0, k2, k1 * d1), fms(k0, k1, k2 * d0)
        size, column = largest((s2, s1, s0), [vector(s2, b01, b02), vector(b01, s1, b12), vector(b02, b12, s0)])
        v0, v1, v2 = scaled(column, size.clamp_min(1e-300).rsqrt())
        rows = [vector(d0, k0 - v2, k1 + v1), vector(k0 + v2, d1, k2 - v0), vector(k1 - v1, k2 + v0, d2)]
        size, row = largest(tuple(dot(r, r) for r in rows), rows)
        first = scaled(row, size.clamp_min(1e-300).rsqrt())
        second = vector(*(dot(r, first) for r in rows))
        return first, scaled(second, dot(second, second).clamp_min(1e-300).rsqrt())

    def _meet(self, line: Vector, w: Vector, n: Vector, total: Tensor) -> list[tuple[Rows, Tensor]]:
        """The two points where a line meets the member of the pencil with weights w, scaled to the triangle, and if real."""
        e1, e2 = across(line)
        # q11 x^2 + 2 q12 x y + q22 y^2 along the line.
        q11, q12, q22 = self._square(w, e1), self._bilinear(w, n, e1, e2), self._square(w, e2)
        product = q11 * q22
        discriminant = fma(q12, q12, -product)
        real = discriminant >= -1e-9 * fma(q12, q12, product.abs())
        z = -(q12 + torch.copysign(discriminant.clamp_min(0).sqrt(), q12))
        slots: list[tuple[Rows, Tensor]] = []
        for depths in together([combined(z, e1, q11, e2), combined(q22, e1, z, e2)]):
            # All of one sign, and of the size that the sides of the triangle ask for.
            l0, l1, l2 = depths
            size = torch.copysign((total / self._square(None, depths)).sqrt(), l0 + l1 + l2)
            rows = l0 * size, l1 * size, l2 * size
            # False for NaN too.
            ahead = (rows[0] > 0) & (rows[1] > 0) & (rows[2] > 0) & (rows[0] + rows[1] + rows[2] < torch.inf)
            both = real if ahead.shape == real.shape else torch.cat((real, real))
            slots.append((rows, both & ahead))
        return slots

    @staticmethod
    def _bilinear(w: Vector, n: Vector, x: Vector, y: Vector) -> Tensor:
        """The bilinear form with weights w of the three pairs."""
        x0, x1, x2 = x
        y0, y1, y2 = y
        f = w[0] * fma(x0 - x1, y0 - y1, n[0] * fma(x0, y1, x1 * y0))
        f = fma(w[1], fma(x0 - x2, y0 - y2, n[1] * fma(x0, y2, x2 * y0)), f)
        return fma(w[2], fma(x1 - x2, y1 - y2, n[2] * fma(x1, y2, x2 * y1)), f)

    def _square(self, w: Vector | None, x: Vector) -> Tensor:
        """The quadratic form with weights w, all 1 if not given."""
        x0, x1, x2 = x
        m = self.n2
        e0, e1, e2 = x0 - x1, x0 - x2, x1 - x2
        f0, f1, f2 = fma(e0, e0, m[0] * x0 * x1), fma(e1, e1, m[1] * x0 * x2), fma(e2, e2, m[2] * x1 * x2)
        return f0 + f1 + f2 if w is None else fma(w[0], f0, fma(w[1], f1, w[2] * f2))

    def newton(self, depths: Rows, valid: Tensor | None = None) -> Rows:
        """One Newton step on the three quadrics.

        Slots that are not `valid`, if given, stay as they are and have no derivative; otherwise what divides by zero comes
        out as it does.
        """
        l0, l1, l2 = depths
        m0, m1, m2 = self.n2
        e0, e1, e2 = l0 - l1, l0 - l2, l1 - l2
        m00, m01, m10, m12, m21, m22 = m0 * l0, m0 * l1, m1 * l0, m1 * l2, m2 * l1, m2 * l2
        r0, r1, r2 = self._residuals(depths, (e0, e1, e2), (m00, m10, m21))
        a0, a1 = torch.add(m01, e0, alpha=2), torch.sub(m00, e0, alpha=2)
        b0, b2 = torch.add(m12, e1, alpha=2), torch.sub(m10, e1, alpha=2)
        c1, c2 = torch.add(m22, e2, alpha=2), torch.sub(m21, e2, alpha=2)
        p, q, m = b2 * c1, b0 * c2, fms(b2, r2, r1 * c2)
        det = fma(a0, p, a1 * q)
        if valid is not None:
            # At a double root there is no derivative to speak of.
            valid = valid & (det.detach().abs() > 1e-13 * (fma(a0, p, -a1 * q)).detach().abs())
            det = torch.where(valid, det, 1.0)
        inverse = 1 / det if valid is None else torch.where(valid, 1 / det, 0.0)
        s0, s1 = fma(r0, p, a1 * m), fms(a0, m, r0 * q)
        s2 = fms(fms(a0, r1, r0 * b0), c1, a1 * b0 * r2)
        return fms(s0, inverse, l0), fms(s1, inverse, l1), fms(s2, inverse, l2)

    def _residuals(self, depths: Rows, differences: Rows, products: Rows) -> Rows:
        _, l1, l2 = depths
        squares = [fma(e, e, -a) for e, a in zip(differences, self.a, strict=True)]
        return tuple(fma(m, x, square) for m, x, square in zip(products, (l1, l2, l2), squares, strict=True))

    def _worst(self, r0: Tensor, r1: Tensor, r2: Tensor) -> Tensor:
        a0, a1, a2 = self.a
        return torch.maximum(torch.maximum((r0 / a0).abs(), (r1 / a1).abs()), (r2 / a2).abs())

    def error(self, depths: Rows) -> Tensor:
        """The largest error of a quadric relative to its side of the triangle."""
        l0, l1, l2 = depths
        m0, m1, m2 = self.n2
        return self._worst(*self._residuals(depths, (l0 - l1, l0 - l2, l1 - l2), (m0 * l0, m1 * l0, m2 * l1)))

    def polish(self, depths: Rows, valid: Tensor) -> tuple[Rows, Tensor]:
        """Newton steps, unless they lead astray as at a double root; and which slots meet the quadrics in the end.

        Where two of the points are close to each other the start has a small error in the quadrics and a large one in the
        depths. The first step then trades one for the other, so that what counts is the error after three.
        """
        before = self.error(depths)
        rows = self.newton(self.newton(self.newton(depths)))
        after = self.error(rows)
        # False for NaN too.
        better = after <= before
        l0, l1, l2 = (torch.where(better, new, old) for new, old in zip(rows, depths, strict=True))
        reach = torch.maximum(torch.maximum(l0, l1), l2)
        shortest = torch.minimum(torch.minimum(self.a[0], self.a[1]), self.a[2])
        # Rounding of far points against a small triangle; but not so far that any depth would do.
        rounding = (1e-14 * reach * reach / shortest).clamp_max(1e-5)
        close = torch.where(better, after, before) <= 1e-10 + rounding
        valid = valid & close & (l0 > 0) & (l1 > 0) & (l2 > 0)
        return tuple(torch.where(valid, depth, 1.0) for depth in (l0, l1, l2)), valid

    def follow(self, depths: Rows, valid: Tensor) -> Rows:
        """The same depths with their derivatives: those of two Newton steps from the solution, exact to second order."""
        rows = self.newton(self.newton(depths, valid), valid)
        return tuple(depth + (row - row.detach()) for depth, row in zip(depths, rows, strict=True))


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
