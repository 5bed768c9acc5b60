"""Forms of degree two and three in four unknowns, with the batch in the last dimension."""

from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.rows import combine_rows, take_columns

QUADRATIC = list(combinations_with_replacement(range(4), 2))
"""Monomials of a quadric, as pairs of 0 (x), 1 (y), 2 (z), 3 (w): xx, xy, xz, xw, yy, yz, yw, zz, zw, ww."""
CUBIC = list(combinations_with_replacement(range(4), 3))
"""Monomials of a cubic: xxx, xxy, xxz, xxw, xyy, xyz, xyw, xzz, xzw, xww, yyy, yyz, yyw, yzz, yzw, yww, zzz, zzw, zww, www."""
Row = tuple[Tensor, ...]


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


class Gradient:
    """The gradient of a form of degree two or three."""

    def __init__(self, q: Tensor) -> None:
        self.degree = 2 if len(q) == 10 else 3
        monomials, lower = (QUADRATIC, [(i,) for i in range(4)]) if self.degree == 2 else (CUBIC, QUADRATIC)
        place = {m: i for i, m in enumerate(monomials)}
        # The coefficient of each lower monomial in each of the four derivatives.
        index = [place[tuple(sorted((*m, k)))] for m in lower for k in range(4)]
        factor = [float((*m, k).count(k)) for m in lower for k in range(4)]
        self.coefficients = (q[index] * q.new_tensor(factor)[:, None]).view(len(lower), 4, -1)

    def take(self, columns: Tensor) -> "Gradient":
        """That of some forms of the batch."""
        other = object.__new__(Gradient)
        other.degree, other.coefficients = self.degree, take_columns(self.coefficients, columns)
        return other

    def __call__(self, v: Tensor, squares: Tensor) -> Tensor:
        """At v, whose products of two coordinates in the order of `QUADRATIC` serve a cubic."""
        return combine_rows(self.coefficients, v if self.degree == 2 else squares)


def minors(a: Tensor | Row, b: Tensor | Row) -> Row:
    """a_i b_j - a_j b_i for (i, j) = 01, 02, 03, 12, 13, 23."""
    return tuple(torch.addcmul(a[i] * b[j], a[j], b[i], value=-1) for i in range(4) for j in range(i + 1, 4))


def triple(a: Tensor, m: Row) -> Tensor:
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
