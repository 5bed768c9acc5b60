"""Polynomials modulo two quadrics, for fixed ratios z : w of the other two unknowns: combinations of 1, x, y and xy."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.quaternary_forms import Row, minors
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.linalg.vectors import fma, fms

_OTHERS = [1, 2, 3, 5, 6, 7, 8, 9]
"""Monomials of a quadric but x^2 and y^2."""


class Pencil(NamedTuple):
    """x^2 = e x y + ..., y^2 = f x y + ... with coefficients of x, y (linear in z, w) and 1 (quadratic), and a third form."""

    turned: Bool[Tensor, "1 batch"]
    """Whether (x, y) was turned by 45 degrees."""
    first: Float[Tensor, "8 batch"]
    """Coefficients of xy, xz, xw, yz, yw, zz, zw, ww in x^2."""
    second: Float[Tensor, "8 batch"]
    third: Float[Tensor, "m batch"]
    """The other form, turned likewise."""

    @classmethod
    def of(cls, A: Tensor, B: Tensor, C: Tensor) -> "Pencil":
        """That of two quadrics."""
        # Of the two directions that the axes may have take the one in which x^2 and y^2 are better determined.
        plain = (A[0] * B[4] - A[4] * B[0]).abs()
        oblique = 0.5 * ((A[0] + A[4]) * B[1] - A[1] * (B[0] + B[4])).abs()
        turned = oblique > plain
        A, B, C = (_turn(q, turned) for q in (A, B, C))
        inverse = 1 / fms(A[4], B[0], A[0] * B[4])
        a, b = A[_OTHERS], B[_OTHERS]
        first, second = fms(B[4], a, A[4] * b), fms(A[0], b, B[0] * a)
        return cls(turned[None], first.mul_(inverse), second.mul_(inverse), C)

    def some(self, part: slice) -> "Pencil":
        """Those of a part of the batch."""
        return Pencil(*(t[:, part] for t in self))

    def take(self, columns: Tensor) -> "Pencil":
        """Those of some columns of the batch."""
        return Pencil(*(take_columns(t, columns) for t in self))

    def multiply(self, z: Tensor, w: Tensor, rows: int = 4) -> list[Row]:
        """The first rows of the matrix of multiplication by the third form over 1, x, y, xy, for given z and w."""
        C = self.third
        e, xz, xw, yz, yw, zz, zw, ww = self.first
        square_z, mixed, square_w = z * z, z * w, w * w
        X = _sum((zz, square_z), (zw, mixed), (ww, square_w)), _sum((xz, z), (xw, w)), _sum((yz, z), (yw, w)), e
        f, xz, xw, yz, yw, zz, zw, ww = self.second
        Y = _sum((zz, square_z), (zw, mixed), (ww, square_w)), _sum((xz, z), (xw, w)), _sum((yz, z), (yw, w)), f
        # U = x^2 y and V = x y^2 from U - e V = u, V - f U = v.
        inverse = 1 / (1 - e * f)
        u = (X[2] * Y[0], X[2] * Y[1], _sum((X[2], Y[2]), (X[0], 1)), _sum((X[2], f), (X[1], 1)))
        v = (Y[1] * X[0], _sum((Y[1], X[1]), (Y[0], 1)), Y[1] * X[2], _sum((Y[1], e), (Y[2], 1)))
        U = tuple((a + e * b) * inverse for a, b in zip(u, v, strict=True))
        V = tuple((b + f * a) * inverse for a, b in zip(u, v, strict=True))

        def by_x(k: Row) -> Row:
            return (
                _sum((k[1], X[0]), (k[3], U[0])),
                k[0] + _sum((k[1], X[1]), (k[3], U[1])),
                _sum((k[1], X[2]), (k[3], U[2])),
                k[2] + _sum((k[1], X[3]), (k[3], U[3])),
            )

        def by_y(k: Row) -> Row:
            return (
                _sum((k[2], Y[0]), (k[3], V[0])),
                _sum((k[2], Y[1]), (k[3], V[1])),
                k[0] + _sum((k[2], Y[2]), (k[3], V[2])),
                k[1] + _sum((k[2], Y[3]), (k[3], V[3])),
            )

        if len(C) == 10:
            xx, xy, xz, xw, yy, yz, yw, zz, zw, ww = C
            k: Row = (
                _sum((zz, square_z), (zw, mixed), (ww, square_w), (xx, X[0]), (yy, Y[0])),
                _sum((xz, z), (xw, w), (xx, X[1]), (yy, Y[1])),
                _sum((yz, z), (yw, w), (xx, X[2]), (yy, Y[2])),
                _sum((xx, X[3]), (yy, Y[3])) + xy,
            )
        else:
            one = z * z + w * w
            xxx, xxy, xxz, xxw, xyy, xyz, xyw, xzz, xzw, xww, yyy, yyz, yyw, yzz, yzw, yww, zzz, zzw, zww, www = C
            XX, YY = _sum((xxz, z), (xxw, w)), _sum((yyz, z), (yyw, w))
            # x^3 and y^3 over the basis.
            cube_x = (e * U[0] + X[1] * X[0], e * U[1] + X[1] * X[1] + X[0], e * U[2] + X[1] * X[2], e * U[3] + X[1] * e + X[2])
            cube_y = (f * V[0] + Y[2] * Y[0], f * V[1] + Y[2] * Y[1], f * V[2] + Y[2] * Y[2] + Y[0], f * V[3] + Y[2] * f + Y[1])
            k = tuple(
                _sum((xxx, cube_x[i]), (yyy, cube_y[i]), (xxy, U[i]), (xyy, V[i]), (XX, X[i]), (YY, Y[i])) for i in range(4)
            )
            k = (
                k[0] + _sum((zzz, square_z * z), (zzw, square_z * w), (zww, z * square_w), (www, w * square_w)),
                k[1] + _sum((xzz, square_z), (xzw, mixed), (xww, square_w)),
                k[2] + _sum((yzz, square_z), (yzw, mixed), (yww, square_w)),
                k[3] + _sum((xyz, z), (xyw, w)) + 0 * one,
            )
        ky = by_y(k)
        return [k, by_x(k), ky, by_x(ky)] if rows == 4 else [k, by_x(k), ky]

    def common_point(self, z: Tensor, w: Tensor) -> Tensor:
        """Unit vectors (x, y, z, w) of the null vectors (1, x, y, xy)."""
        size = (z * z + w * w).rsqrt()
        z, w = z * size, w * size
        # Orthogonal to the first three rows; of the last one the first three cofactors make the vector (1, x, y).
        p, q, r = self.multiply(z, w, rows=3)
        m = minors(q, r)
        one = fma(p[3], m[3], fms(p[2], m[4], p[1] * m[5]))
        x = fms(p[3], m[1], fms(p[0], m[5], p[2] * m[2]))
        y = fma(p[3], m[0], fms(p[1], m[2], p[0] * m[4]))
        half = 0.5**0.5
        x, y = torch.where(self.turned[0], (x - y) * half, x), torch.where(self.turned[0], (x + y) * half, y)
        v = torch.stack((x, y, z * one, w * one))
        v = v / v.abs().amax(0)
        return v * combine_rows(v, v).rsqrt()


def _sum(*products: tuple[Tensor, Tensor | int]) -> Tensor:
    (a, b), *rest = products
    total = a * b
    for a, b in rest:
        total = total + a if isinstance(b, int) else torch.addcmul(total, a, b)
    return total


def _turn(q: Tensor, turned: Tensor) -> Tensor:
    """The form in (x', y') with x = (x' - y') / sqrt(2), y = (x' + y') / sqrt(2), where `turned`."""
    h = 0.5**0.5
    if len(q) == 10:
        xx, xy, xz, xw, yy, yz, yw, *rest = q
        new = (0.5 * (xx + xy + yy), yy - xx, h * (xz + yz), h * (xw + yw), 0.5 * (xx - xy + yy), h * (yz - xz), h * (yw - xw))
        return torch.where(turned, torch.stack((*new, *rest)), q)
    xxx, xxy, xxz, xxw, xyy, xyz, xyw, xzz, xzw, xww, yyy, yyz, yyw, yzz, yzw, yww, *rest = q
    h3 = 0.5 * h
    new20 = (
        h3 * (xxx + xxy + xyy + yyy),
        h3 * (-3 * xxx - xxy + xyy + 3 * yyy),
        0.5 * (xxz + xyz + yyz),
        0.5 * (xxw + xyw + yyw),
        h3 * (3 * xxx - xxy - xyy + 3 * yyy),
        yyz - xxz,
        yyw - xxw,
        h * (xzz + yzz),
        h * (xzw + yzw),
        h * (xww + yww),
        h3 * (yyy - xxx + xxy - xyy),
        0.5 * (xxz - xyz + yyz),
        0.5 * (xxw - xyw + yyw),
        h * (yzz - xzz),
        h * (yzw - xzw),
        h * (yww - xww),
    )
    return torch.where(turned, torch.stack((*new20, *rest)), q)


def determinant(m: list[Row]) -> Tensor:
    """Of a 4x4 matrix of rows of numbers, by the minors of its columns."""

    def minor(i: int, j: int, a: int, b: int) -> Tensor:
        return torch.addcmul(m[a][i] * m[b][j], m[a][j], m[b][i], value=-1)

    total = minor(0, 1, 0, 1) * minor(2, 3, 2, 3)
    for sign, p, q in (
        (-1, (0, 2), (1, 3)), (1, (0, 3), (1, 2)), (1, (1, 2), (0, 3)), (-1, (1, 3), (0, 2)), (1, (2, 3), (0, 1)),
    ):  # fmt: skip
        total = torch.addcmul(total, minor(*p, 0, 1), minor(*q, 2, 3), value=sign)
    return total
