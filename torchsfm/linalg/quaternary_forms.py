"""Forms of degree two and three in four unknowns, with the batch in the last dimension."""

from collections.abc import Sequence
from functools import cache
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.constants import Constant
from torchsfm.linalg.rows import combine_rows, take_columns
from torchsfm.linalg.vectors import fma, fms

QUADRATIC = list(combinations_with_replacement(range(4), 2))
"""Monomials of a quadric, as pairs of 0 (x), 1 (y), 2 (z), 3 (w): xx, xy, xz, xw, yy, yz, yw, zz, zw, ww."""
CUBIC = list(combinations_with_replacement(range(4), 3))
"""Monomials of a cubic: xxx, xxy, xxz, xxw, xyy, xyz, xyw, xzz, xzw, xww, yyy, yyz, yyw, yzz, yzw, yww, zzz, zzw, zww, www."""
Row = tuple[Tensor, ...]
_FIRST, _SECOND = [i for i, _ in QUADRATIC], [j for _, j in QUADRATIC]
_SQUARES = [k for k, (i, j) in enumerate(QUADRATIC) if i == j]


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


@cache
def _cubic_derivatives() -> tuple[list[int], Constant]:
    """The coefficient of each quadratic monomial in each of the four derivatives, and its factor."""
    place = {m: i for i, m in enumerate(CUBIC)}
    pairs = [(tuple(sorted((*m, k))), k) for m in QUADRATIC for k in range(4)]
    factor = torch.tensor([float(m.count(k)) for m, k in pairs], dtype=torch.float64, device="cpu")
    return [place[m] for m, _ in pairs], Constant(factor)  # type: ignore[index]


class Gradients:
    """The gradients of k quadrics and a surface of degree three, or of none."""

    def __init__(self, quadrics: Sequence[Float[Tensor, "10 batch"]], cubic: Float[Tensor, "20 batch"] | None) -> None:
        self.quadrics = torch.stack([*quadrics], 1)
        for i in _SQUARES:
            self.quadrics[i].mul_(2)
        self.cubic = cubic
        if cubic is not None:
            index, factor = _cubic_derivatives()
            coefficients = cubic[index].mul_(factor.on(cubic.device, cubic.dtype)[:, None])
            self.cubic = coefficients.view(len(QUADRATIC), 4, -1)

    def take(self, columns: Tensor) -> "Gradients":
        """Those of some forms of the batch."""
        other = object.__new__(Gradients)
        other.quadrics = take_columns(self.quadrics, columns)
        other.cubic = None if self.cubic is None else take_columns(self.cubic, columns)
        return other

    def __call__(self, v: Float[Tensor, "4 batch"]) -> tuple[list[Tensor], list[Tensor]]:
        """The gradients at v, each (4, batch), and the values."""
        x, y, z, w = v
        q = self.quadrics
        # The symmetric matrices, column by column.
        g = q[:4] * x
        g[0].addcmul_(q[1], y)
        g[1:].addcmul_(q[4:7], y)
        g[:2].addcmul_(q[2:6:3], z)
        g[2:].addcmul_(q[7:9], z)
        g[:2].addcmul_(q[3:7:3], w)
        g[2:].addcmul_(q[8:], w)
        gradients, values = [*g.unbind(1)], [*combine_rows(g.unbind(0), v.unbind(0)).mul_(0.5)]
        if self.cubic is not None:
            g = combine_rows(self.cubic, v[_FIRST] * v[_SECOND])
            gradients.append(g)
            values.append(combine_rows(g, v) / 3)
        return gradients, values


def minors(a: Tensor | Row, b: Tensor | Row) -> Row:
    """a_i b_j - a_j b_i for (i, j) = 01, 02, 03, 12, 13, 23."""
    return tuple(torch.addcmul(a[i] * b[j], a[j], b[i], value=-1) for i in range(4) for j in range(i + 1, 4))


def triple(a: Tensor, m: Row) -> Tensor:
    """The vector d with d . x = det(x, a, b, c) in four dimensions, from the minors of b and c."""
    m01, m02, m03, m12, m13, m23 = m
    a0, a1, a2, a3 = a
    return torch.stack(
        (
            fma(a3, m12, fms(a2, m13, a1 * m23)),
            fms(a3, m02, fms(a0, m23, a2 * m03)),
            fma(a3, m01, fms(a1, m03, a0 * m13)),
            fms(a2, m01, fms(a0, m12, a1 * m02)),
        )
    )
