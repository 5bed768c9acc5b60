"""The sixth of six points from their images in three views; four are the basis of space and of the images, the fifth its unit.

The cameras [diag(a) | d 1] and the points exchange roles (Carlsson & Weinshall 1998): the images y5 and y6 of one view satisfy
y6' G y5 = 0 with G = -[p]x diag(X_1, X_2, X_3) and p = X_4 - X_1..3 for all views. The batch is in the last dimension.
"""

from itertools import combinations

import torch
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.linalg.nullspace import nullspace_rows
from torchsfm.linalg.polynomial import cubic_rows
from torchsfm.linalg.rows import combine_rows


def sixth_point(y5: Tensor, y6: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
    """The coordinates of X, (slot, batch) each; which slots are real; the smallest pivot."""
    # Entries in the order 12 13 21 23 31 32, one equation for each view and one for the sum.
    pairs = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
    rows = torch.stack([y6[i] * y5[j] for i, j in pairs], 1)
    rows = rows * combine_rows(rows.unbind(1), rows.unbind(1)).clamp_min(1e-300).rsqrt()[:, None]
    rows = torch.cat((rows, torch.full_like(rows[:1], 6**-0.5)))
    basis, pivot = nullspace_rows(rows)
    # det = g12 g23 g31 + g13 g21 g32.
    c = [torch.zeros_like(pivot) for _ in range(4)]
    for i, j, k in ((0, 3, 4), (1, 2, 5)):
        (p0, p1), (q0, q1), (r0, r1) = basis[:, i], basis[:, j], basis[:, k]
        inner = (p0 * q0, p0 * q1 + p1 * q0, p1 * q1)
        c[0] = c[0] + inner[0] * r0
        c[1] = c[1] + inner[0] * r1 + inner[1] * r0
        c[2] = c[2] + inner[1] * r1 + inner[2] * r0
        c[3] = c[3] + inner[2] * r1
    # The larger of the outer coefficients leads.
    turn = c[0].abs() > c[3].abs()
    roots, real = cubic_rows(*(torch.where(turn, c[3 - i], c[i]) for i in range(4)))
    one = torch.ones_like(roots)
    g = torch.where(turn, roots, one) * basis[0, :, None] + torch.where(turn, one, roots) * basis[1, :, None]
    some = torch.stack(c).abs().amax(0)
    return _polished(_point_of_matrix(g), y5, y6), real, torch.minimum(pivot, some)


def _point_of_matrix(g: Tensor) -> list[Tensor]:
    """X with G = -[p]x diag(X_1, X_2, X_3) and p = X_4 - X_1..3, up to scale."""
    g12, g13, g21, g23, g31, g32 = g.unbind(0)
    # p is a left null vector: the longest of the cross products of the columns.
    p = longest(
        (
            torch.stack((g21 * g32, g31 * g12, -g21 * g12)),
            torch.stack((-g32 * g23, g32 * g13, g12 * g23)),
            torch.stack((g23 * g31, -g13 * g31, g13 * g21)),
        )
    )
    p1, p2, p3 = (p * combine_rows(p, p).clamp_min(1e-300).rsqrt()).unbind(0)
    s1, s2, s3 = p1 * p1, p2 * p2, p3 * p3
    X1 = (p2 * g31 - p3 * g21) / (s2 + s3)
    X2 = (p3 * g12 - p1 * g32) / (s1 + s3)
    X3 = (p1 * g23 - p2 * g13) / (s1 + s2)
    # X_1..3 = X_4 - k p: k from the differences.
    u, v, w = p2 - p1, p3 - p2, p1 - p3
    k = ((X1 - X2) * u + (X2 - X3) * v + (X3 - X1) * w) / (u * u + v * v + w * w)
    X4 = (X1 + X2 + X3 + k * (p1 + p2 + p3)) / 3
    return [X1, X2, X3, X4]


def _polished(X: list[Tensor], y5: Tensor, y6: Tensor) -> list[Tensor]:
    """A Newton step on the three equations det(y6, p, X_1..3 y5) = 0 along the unit sphere."""
    X = _sphere(X)
    rows = []
    values = []
    for view in range(3):
        a, b = y6[:, view], y5[:, view]
        # sum over i != j of +-(X_4 - X_k) X_j a_i b_j: bilinear in p and q = X b.
        q = [X[i] * b[i] for i in range(3)]
        p = [X[3] - X[i] for i in range(3)]
        # Gradients by q: a x p; by p: q x a.
        by_q = (a[1] * p[2] - a[2] * p[1], a[2] * p[0] - a[0] * p[2], a[0] * p[1] - a[1] * p[0])
        by_p = (q[1] * a[2] - q[2] * a[1], q[2] * a[0] - q[0] * a[2], q[0] * a[1] - q[1] * a[0])
        values.append(combine_rows(by_q, q))
        gradient = [by_q[i] * b[i] - by_p[i] for i in range(3)]
        rows.append((*gradient, by_p[0] + by_p[1] + by_p[2]))
    step = _solve_4x4([*rows, tuple(X)], [*values, torch.zeros_like(values[0])])
    size = combine_rows(step, step)
    near = size < 1e-4
    return _sphere([torch.where(near, x - dx, x) for x, dx in zip(X, step, strict=True)])


def _sphere(X: list[Tensor]) -> list[Tensor]:
    scale = combine_rows(X, X).rsqrt()
    return [x * scale for x in X]


def _solve_4x4(A: list[tuple[Tensor, ...]], b: list[Tensor]) -> list[Tensor]:
    """Cramer's rule by 2x2 minors of the upper and the lower pair of rows."""
    (a, c), (e, f) = A[:2], A[2:]
    upper = {(i, j): a[i] * c[j] - a[j] * c[i] for i, j in combinations(range(4), 2)}
    lower = {(i, j): e[i] * f[j] - e[j] * f[i] for i, j in combinations(range(4), 2)}

    def minor(table: dict[tuple[int, int], Tensor], i: int, j: int) -> Tensor:
        return table[i, j] if i < j else -table[j, i]

    det = (
        upper[0, 1] * lower[2, 3] - upper[0, 2] * lower[1, 3] + upper[0, 3] * lower[1, 2]
        + upper[1, 2] * lower[0, 3] - upper[1, 3] * lower[0, 2] + upper[2, 3] * lower[0, 1]
    )  # fmt: skip
    solution = []
    for i in range(4):
        j, k, m = ((i + 1) % 4, (i + 2) % 4, (i + 3) % 4)
        sign = 1 if i % 2 == 0 else -1
        total = torch.zeros_like(det)
        for row, other, table in ((0, 1, lower), (2, 3, upper)):
            # The cofactors of the two rows: their other row times the minors of the other pair.
            for r, o, turn in ((row, other, 1), (other, row, -1)):
                v = A[o]
                cofactor = v[j] * minor(table, k, m) - v[k] * minor(table, j, m) + v[m] * minor(table, j, k)
                total = total + turn * b[r] * cofactor
        solution.append(sign * total / det)
    return solution


def longest(candidates: tuple[Tensor, ...]) -> Tensor:
    """Of vectors (3, ...) the longest."""
    best, length = candidates[0], combine_rows(candidates[0], candidates[0])
    for other in candidates[1:]:
        square = combine_rows(other, other)
        longer = square > length
        best, length = torch.where(longer, other, best), torch.where(longer, square, length)
    return best


def null_3x3(rows: list[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    """The unit null vector of 3x3 matrices of rank 2 given by rows: (3, ...)."""
    shape = broadcast_shapes(*(e.shape for e in rows[0]))
    r = [torch.stack([e.expand(shape) for e in row]) for row in rows]
    n = longest((_cross(r[0], r[1]), _cross(r[1], r[2]), _cross(r[2], r[0])))
    return n * combine_rows(n, n).clamp_min(1e-300).rsqrt()


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
