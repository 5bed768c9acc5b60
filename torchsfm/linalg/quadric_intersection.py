"""Common points of two quadrics and a third surface, of degree two or three, in projective 3-space.

For a fixed ratio z : w the two quadrics are conics in (x, y), and polynomials modulo both are combinations of 1, x, y and xy.
Multiplication by the third form is a 4x4 matrix over this basis, whose determinant is a binary form in z and w, of degree eight
or twelve: it is taken at as many points of the circle as it has coefficients. At its real roots the null vector of the matrix
is (1, x, y, xy). Newton's method on the three forms themselves ends it. All arithmetic has the batch in the last dimension.
"""

import math
from functools import cache
from itertools import combinations_with_replacement
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg.constants import Constant
from torchsfm.linalg.real_roots import real_root_list
from torchsfm.linalg.rows import combine_rows, take_columns

QUADRATIC = list(combinations_with_replacement(range(4), 2))
"""Monomials of a quadric, as pairs of 0 (x), 1 (y), 2 (z), 3 (w): xx, xy, xz, xw, yy, yz, yw, zz, zw, ww."""
CUBIC = list(combinations_with_replacement(range(4), 3))
"""Monomials of a cubic: xxx, xxy, xxz, xxw, xyy, xyz, xyw, xzz, xzw, xww, yyy, yyz, yyw, yzz, yzw, yww, zzz, zzw, zww, www."""
_CHUNK = 512
"""Problems at a time where the work is at all points of the circle at once: what is in use stays in the cache."""
_MORE = 6
"""Newton steps for those that two steps do not bring to their end."""
_LONGEST = 0.5
"""Longest step of these."""
_ATTEMPTS = 2
"""Further systems of coordinates for problems of which not every root is a common point."""
_CONVERGED = 1e-7
"""Length of the last Newton step of what is a common point: the error left is about its square."""
_APART = 1e-9
"""Points of one problem that are nearer than this are one point."""
_NEAR = 1e-4
"""Length of the first Newton step from an accurate root."""


Row = tuple[Tensor, ...]


class CommonPoints(NamedTuple):
    """Common points one after the other, sorted by the problem they belong to."""

    item: Int[Tensor, " points"]
    point: Float[Tensor, "4 points"]
    """Unit vectors."""

    def slot(self) -> Int[Tensor, " points"]:
        """The number of each point among those of its problem."""
        return torch.arange(len(self.item), device=self.item.device) - torch.searchsorted(self.item, self.item)


def product_of_forms(a: Float[Tensor, "4 *batch"], b: Float[Tensor, "4 *batch"]) -> Float[Tensor, "10 *batch"]:
    """The quadric a(v) b(v) of two linear forms, in the order of `QUADRATIC`."""
    rows = [a[i] * b[j] if i == j else torch.addcmul(a[i] * b[j], a[j], b[i]) for i, j in QUADRATIC]
    return torch.stack(rows)


def cubic_of_forms(q: Float[Tensor, "10 *batch"], a: Float[Tensor, "4 *batch"]) -> Float[Tensor, "20 *batch"]:
    """The cubic q(v) a(v) of a quadric and a linear form, in the order of `CUBIC`."""
    place = {m: i for i, m in enumerate(CUBIC)}
    rows = torch.zeros(20, *q.shape[1:], dtype=q.dtype, device=q.device)
    for k in range(4):
        index = [place[tuple(sorted((i, j, k)))] for i, j in QUADRATIC]  # type: ignore[index]
        rows[index] += q * a[k]
    return rows


def intersect_quadrics(A: Float[Tensor, "10 batch"], B: Float[Tensor, "10 batch"], C: Float[Tensor, "m batch"]) -> CommonPoints:
    """The real common points of quadrics A and B and a quadric (m = 10) or cubic (m = 20) C, at most eight or twelve.

    The coordinates must be in general position: the line z = w = 0 must not meet the curve A = B = 0, and no two common points
    may have the same z : w. Coefficients that are not finite give no points. The list is as long as there are points: its
    shape depends on the data; what is found for one problem does not depend on the others in the batch.
    """
    item, v, unsure = _attempt(A, B, C)
    index = unsure.nonzero()[:, 0]
    if len(index):
        # Other coordinates for the few with a root that led nowhere.
        forms = [take_columns(q, index) for q in (A, B, C)]
        others, points = [item], [v]
        for k in range(_ATTEMPTS):
            turn, matrices = _rotation(k)
            turned = [combine_rows(matrices[len(q)].on(q.device, q.dtype)[..., None], q) for q in forms]
            again, u, _ = _attempt(*turned)
            others.append(index.index_select(0, again))
            points.append(combine_rows(turn.on(u.device, u.dtype).T[..., None], u))
        item, order = torch.cat(others).sort(stable=True)
        v = take_columns(torch.cat(points, 1), order)
        keep = (~_repeated(item, v, torch.ones_like(item, dtype=torch.bool), len(CUBIC) * 2)).nonzero()[:, 0]
        item, v = item.index_select(0, keep), take_columns(v, keep)
    return CommonPoints(item, v)


def _attempt(A: Tensor, B: Tensor, C: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Problems and unit vectors of common points, and which problems may have more of them."""
    degree = 8 if C.shape[0] == 10 else 12
    nodes, to_coefficients = (t.on(A.device, A.dtype) for t in _circle(degree))
    forms = []
    for i in range(0, max(A.shape[1], 1), _CHUNK):
        a, b, c = (q[:, i : i + _CHUNK] for q in (A, B, C))
        values = _determinant(_Pencil.of(a, b).multiply(c, nodes[0][:, None], nodes[1][:, None]))
        forms.append(combine_rows(values, to_coefficients.mT[..., None]))
    form = torch.cat(forms, 1)
    roots = real_root_list(torch.where(torch.isfinite(form).all(0), form, torch.nan), steps=2)
    A, B, C = (take_columns(q, roots.item) for q in (A, B, C))
    # A root s : t is z : w.
    v = _Pencil.of(A, B).common_point(C, roots.s, roots.t)
    v, found, sure = _polished(v, A, B, C)
    found = found & ~_repeated(roots.item, v, found, degree)
    # The number of roots is even; a root far from its point comes from an inaccurate form, which may have lost others.
    number = torch.zeros(form.shape[1], dtype=torch.int32, device=form.device)
    number.index_add_(0, roots.item, torch.where(found & sure, 1, 1001).to(number.dtype))
    unsure = (number > 1000) | (number % 2 == 1)
    keep = found.nonzero()[:, 0]
    return roots.item.index_select(0, keep), take_columns(v, keep), unsure


class _Pencil(NamedTuple):
    """x^2 = e x y + ..., y^2 = f x y + ... with coefficients of x, y (linear in z, w) and 1 (quadratic)."""

    turned: Bool[Tensor, " batch"]
    """Whether (x, y) was turned by 45 degrees."""
    first: Row
    """Coefficients of xy, xz, xw, yz, yw, zz, zw, ww in x^2."""
    second: Row

    @classmethod
    def of(cls, A: Tensor, B: Tensor) -> "_Pencil":
        # Of the two directions that the axes may have take the one in which x^2 and y^2 are better determined.
        plain = (A[0] * B[4] - A[4] * B[0]).abs()
        oblique = 0.5 * ((A[0] + A[4]) * B[1] - A[1] * (B[0] + B[4])).abs()
        turned = oblique > plain
        A, B = _turn(A, turned), _turn(B, turned)
        inverse = 1 / (A[0] * B[4] - A[4] * B[0])
        others = (1, 2, 3, 5, 6, 7, 8, 9)
        first = tuple((A[4] * B[i] - B[4] * A[i]) * inverse for i in others)
        second = tuple((B[0] * A[i] - A[0] * B[i]) * inverse for i in others)
        return cls(turned, first, second)

    def multiply(self, C: Tensor, z: Tensor, w: Tensor, rows: int = 4) -> list[Row]:
        """The first rows of the matrix of multiplication by C over 1, x, y, xy, for given z and w."""
        C = _turn(C, self.turned)
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

    def common_point(self, C: Tensor, z: Tensor, w: Tensor) -> Tensor:
        """Unit vectors (x, y, z, w) of the null vectors (1, x, y, xy)."""
        size = (z * z + w * w).rsqrt()
        z, w = z * size, w * size
        # Orthogonal to the first three rows; of the last one the first three cofactors make the vector (1, x, y).
        p, q, r = self.multiply(C, z, w, rows=3)
        m = _minors(q, r)
        one = p[1] * m[5] - p[2] * m[4] + p[3] * m[3]
        x = p[2] * m[2] - p[0] * m[5] - p[3] * m[1]
        y = p[0] * m[4] - p[1] * m[2] + p[3] * m[0]
        half = 0.5**0.5
        x, y = torch.where(self.turned, (x - y) * half, x), torch.where(self.turned, (x + y) * half, y)
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


@cache
def _circle(degree: int) -> tuple[Constant, Constant]:
    """Points (z, w) on the half circle, and the matrix from values of a binary form there to coefficients of z^k w^(n-k)."""
    angle = math.pi * torch.arange(degree + 1, dtype=torch.float64) / (degree + 1)
    z, w = angle.sin(), angle.cos()
    k = torch.arange(degree + 1)
    monomials = z[:, None] ** k * w[:, None] ** (degree - k)
    return Constant(torch.stack((z, w))), Constant(torch.linalg.inv(monomials))


@cache
def _rotation(number: int) -> tuple[Constant, dict[int, Constant]]:
    """One of a few fixed rotations of 4-space, and what it does to the coefficients of quadrics and cubics, as [from, to]."""
    generator = torch.Generator().manual_seed(number)
    turn = torch.linalg.qr(torch.randn(4, 4, generator=generator, dtype=torch.float64)).Q
    quadratic = torch.stack([product_of_forms(turn[i], turn[j]) for i, j in QUADRATIC])
    cubic = torch.stack([cubic_of_forms(product_of_forms(turn[i], turn[j]), turn[k]) for i, j, k in CUBIC])
    return Constant(turn), {10: Constant(quadratic), 20: Constant(cubic)}


def _determinant(m: list[Row]) -> Tensor:
    def minor(i: int, j: int, a: int, b: int) -> Tensor:
        return torch.addcmul(m[a][i] * m[b][j], m[a][j], m[b][i], value=-1)

    total = minor(0, 1, 0, 1) * minor(2, 3, 2, 3)
    for sign, p, q in (
        (-1, (0, 2), (1, 3)), (1, (0, 3), (1, 2)), (1, (1, 2), (0, 3)), (-1, (1, 3), (0, 2)), (1, (2, 3), (0, 1)),
    ):  # fmt: skip
        total = torch.addcmul(total, minor(*p, 0, 1), minor(*q, 2, 3), value=sign)
    return total


def _polished(v: Tensor, *forms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method on the unit sphere, longer for those that need it; where it came to an end, and where it began near."""
    gradients = [_Gradient(form) for form in forms]
    v, first = _newton(v, gradients)
    size = first
    rest = (first > _CONVERGED).nonzero()[:, 0]
    u, few = take_columns(v, rest), [g.take(rest) for g in gradients]
    for _ in range(_MORE):
        if len(rest) == 0:
            break
        u, last = _newton(u, few)
        v, size = v.index_copy(1, rest, u), size.index_copy(0, rest, last)
        going = (last > _CONVERGED).nonzero()[:, 0]
        rest, u, few = rest.index_select(0, going), take_columns(u, going), [g.take(going) for g in few]
    return v, size <= _CONVERGED, first <= _NEAR


class _Gradient:
    """The gradient of a form of degree two or three."""

    def __init__(self, q: Tensor) -> None:
        self.degree = 2 if len(q) == 10 else 3
        monomials, lower = (QUADRATIC, [(i,) for i in range(4)]) if self.degree == 2 else (CUBIC, QUADRATIC)
        place = {m: i for i, m in enumerate(monomials)}
        # The coefficient of each lower monomial in each of the four derivatives.
        index = [place[tuple(sorted((*m, k)))] for m in lower for k in range(4)]
        factor = [float((*m, k).count(k)) for m in lower for k in range(4)]
        self.coefficients = (q[index] * q.new_tensor(factor)[:, None]).view(len(lower), 4, -1)

    def take(self, columns: Tensor) -> "_Gradient":
        other = object.__new__(_Gradient)
        other.degree, other.coefficients = self.degree, take_columns(self.coefficients, columns)
        return other

    def __call__(self, v: Tensor, squares: Tensor) -> Tensor:
        return combine_rows(self.coefficients, v if self.degree == 2 else squares)


_FIRST, _SECOND = [i for i, _ in QUADRATIC], [j for _, j in QUADRATIC]


def _newton(v: Tensor, gradients: list[_Gradient]) -> tuple[Tensor, Tensor]:
    """One step orthogonal to v, and its length: Cramer's rule on the rows p, q, r, v."""
    squares = v[_FIRST] * v[_SECOND] if any(g.degree == 3 for g in gradients) else v
    p, q, r = (g(v, squares) for g in gradients)
    a, b, c = (combine_rows(g, v) / form.degree for g, form in zip((p, q, r), gradients, strict=True))
    rv, pq = _minors(r, v), _minors(p, q)
    first, second, third = _triple(q, rv), _triple(p, rv), _triple(v, pq)
    step = (a * first - b * second + c * third) / combine_rows(p, first)
    size = combine_rows(step, step).sqrt()
    v = v - step * (_LONGEST / size).clamp_max(1)
    return v * combine_rows(v, v).rsqrt(), size


def _minors(a: Tensor | Row, b: Tensor | Row) -> Row:
    """a_i b_j - a_j b_i for (i, j) = 01, 02, 03, 12, 13, 23."""
    return tuple(torch.addcmul(a[i] * b[j], a[j], b[i], value=-1) for i in range(4) for j in range(i + 1, 4))


def _triple(a: Tensor, m: Row) -> Tensor:
    """The vector d with d . x = det(x, a, b, c) in four dimensions, from the minors of b and c."""
    m01, m02, m03, m12, m13, m23 = m
    return torch.stack(
        (
            a[1] * m23 - a[2] * m13 + a[3] * m12,
            a[2] * m03 - a[0] * m23 - a[3] * m02,
            a[0] * m13 - a[1] * m03 + a[3] * m01,
            a[1] * m02 - a[0] * m12 - a[2] * m01,
        )
    )


def _repeated(item: Tensor, v: Tensor, found: Tensor, degree: int) -> Tensor:
    """Whether a point is one of those before it of the same problem: different points have different z : w."""
    ratio = v[2] / v[3]
    close = _APART * (1 + ratio * ratio)
    repeated = torch.zeros_like(found)
    for lag in range(1, min(degree, len(item))):
        same = (item[lag:] == item[:-lag]) & ((ratio[lag:] - ratio[:-lag]).abs() < close[lag:])
        repeated[lag:] |= same & found[:-lag]
    return repeated
