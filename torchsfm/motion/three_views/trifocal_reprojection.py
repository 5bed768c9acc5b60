"""The reprojection error of points in three views and its Gauss-Newton equations over the cameras, without LAPACK.

The first camera is [I | 0], so a point is X = (u, v, 1, r) with its first image (u, v). The other two images give r by linear
least squares at the measured (u, v); one Gauss-Newton step then moves all three numbers towards the least sum of squared
distances in the three images, and what is measured is the distance of the images of this very point. Everything is written in
rows: one tensor for each coordinate of all points.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.geometry.projection import quotient_slope
from torchsfm.motion.two_views.epipolar_fit import forms
from torchsfm.robust import Weigh

Rows = Sequence[Tensor]
_TINY = 1e-30
# Products of two of four coordinates in the order 00 01 02 03 11 12 13 22 23 33, and of two of six.
_FOUR = [(i, j) for i in range(4) for j in range(i, 4)]
_SIX = [(i, j) for i in range(6) for j in range(i, 6)]


def _entry(pairs: list[tuple[int, int]], i: int, j: int) -> int:
    return pairs.index((min(i, j), max(i, j)))


# Where entry ((a, i), (b, j)) of the sum of Kronecker products is among the 21 x 10 products.
_KRONECKER = [
    10 * _entry(_SIX, a, b) + _entry(_FOUR, i, j) for a in range(6) for i in range(4) for b in range(6) for j in range(4)
]


class Projection(NamedTuple):
    """The image of points in one camera, and the derivative of it by the point's three numbers.

    Attributes:
        r: Image less measurement, two rows.
        J: Derivatives of the two by u, v and r, 2 x 3 rows.
        image: The two coordinates.
        inverse_depth: One over the third homogeneous coordinate.
    """

    r: Rows
    J: list[Rows]
    image: Rows
    inverse_depth: Tensor


def squared_distance(model: Float[Tensor, "*#batch 2 3 4"], x: Sequence[Rows]) -> tuple[Tensor, Tensor]:
    """The squared distance in the six image coordinates, and whether the point is in front of the second and third camera.

    Args:
        model: The second and third camera.
        x: Two rows for each of three views.
    """
    X = _step(model, x, _start(model, x))
    squared = (X[0] - x[0][0]).square() + (X[1] - x[0][1]).square()
    front = None
    for k in range(2):
        p, q, z = _homogeneous(model[..., k, :, :], X)
        inverse = 1 / torch.where(z.abs() > _TINY, z, _TINY)
        squared = squared + (p * inverse - x[k + 1][0]).square() + (q * inverse - x[k + 1][1]).square()
        front = z > 0 if front is None else front & (z > 0)
    assert front is not None
    return squared, front


def linear_depths(model: Float[Tensor, "*#batch 2 3 4"], x: Sequence[Rows]) -> Float[Tensor, "*batch 2 n"]:
    """The third homogeneous coordinates of the images of linearly triangulated points, in the second and third camera."""
    X = _start(model, x)
    return torch.stack([_homogeneous(model[..., k, :, :], X)[2] for k in range(2)], -2)


def normal_equations(
    model: Float[Tensor, "*#batch 2 3 4"], x: Sequence[Rows], weigh: Weigh
) -> tuple[Float[Tensor, "*batch 24 24"], Float[Tensor, "*batch 24"]]:
    """J' C J and J' W r over the entries of both cameras, the points eliminated, in float64.

    The weights W and C are those of `weigh` for the distances of `squared_distance`.
    """
    X = _step(model, x, _start(model, x))
    views = _projections(model, x, X)
    squared = (X[0] - x[0][0]).square() + (X[1] - x[0][1]).square()
    for e in (e for view in views for e in view.r):
        squared = torch.addcmul(squared, e, e)
    front = torch.minimum(views[0].inverse_depth, views[1].inverse_depth) > 0
    weights, curvature = weigh(squared.masked_fill(~front, torch.inf))
    X = _moved(x, X, views)
    views = _projections(model, x, X)
    L, g = _point_equations(X, x, views)
    # Residuals and derivatives by the rows of the cameras: D = [1 0 -u; 0 1 -v] / z for each view, times X.
    J = [row for view in views for row in view.J]
    y = _backward(L, _forward(L, g))
    r = [e - (j[0] * y[0] + j[1] * y[1] + j[2] * y[2]) for e, j in zip([e for v in views for e in v.r], J, strict=True)]
    D = []
    for view in views:
        s, (u, v) = view.inverse_depth, view.image
        zero = torch.zeros_like(s)
        D.append(((s, zero), (zero, s), (-u * s, -v * s)))
    S: dict[tuple[int, int], Tensor] = {}
    for k, block in enumerate(D):
        for a in range(3):
            for b in range(a, 3):
                S[3 * k + a, 3 * k + b] = block[a][0] * block[b][0] + block[a][1] * block[b][1]
    # Less what the points absorb: V'V with V = L^-1 J'D.
    V = []
    for k, block in enumerate(D):
        for a in range(3):
            V.append(_forward(L, [J[2 * k][c] * block[a][0] + J[2 * k + 1][c] * block[a][1] for c in range(3)]))
    shape = broadcast_shapes(weights.shape, X[3].shape, X[0].shape)
    X = [e.expand(shape) for e in X]
    left = []
    for a, b in _SIX:
        absorbed = V[a][0] * V[b][0] + V[a][1] * V[b][1] + V[a][2] * V[b][2]
        left.append(((S[a, b] - absorbed) if (a, b) in S else -absorbed) * curvature)
    right = [X[i] * X[j] for i, j in _FOUR]
    moments = torch.stack(left, -2) @ torch.stack(right, -2).mT
    index = torch.tensor(_KRONECKER, device=moments.device)
    A = moments.double().flatten(-2).index_select(-1, index)
    pulled = [(block[a][0] * r[2 * k] + block[a][1] * r[2 * k + 1]) * weights for k, block in enumerate(D) for a in range(3)]
    slope = torch.stack([p.expand(shape) for p in pulled], -2) @ torch.stack(X, -2).mT
    return A.reshape(*A.shape[:-1], 24, 24), slope.double().flatten(-2)


def _start(model: Tensor, x: Sequence[Rows]) -> list[Tensor]:
    """The points (u, v, 1, r), r from the second and third view, each equation weighed as it would count in the image."""
    one = torch.ones_like(x[0][0])
    above, below = torch.zeros_like(one), torch.zeros_like(one)
    for k in range(2):
        q = forms(model[..., k, :, :3], [x[0][0], x[0][1], one])
        e = [model[..., k, i, 3, None] for i in range(3)]
        slope = [x[k + 1][i] * e[2] - e[i] for i in range(2)]
        offset = [x[k + 1][i] * q[2] - q[i] for i in range(2)]
        # The ray's image is a line: at its point next to the measurement the depth is q_z + r e_z.
        square = slope[0] * slope[0] + slope[1] * slope[1]
        mixed = slope[0] * offset[0] + slope[1] * offset[1]
        depth = (q[2] * square - e[2] * mixed) / square.clamp(min=_TINY)
        weight = 1 / (depth * depth).clamp(min=_TINY)
        above, below = above + weight * mixed, below + weight * square
    r = -above / below.clamp(min=_TINY)
    return [x[0][0], x[0][1], one, r]


def _homogeneous(P: Tensor, X: Rows) -> list[Tensor]:
    rows = []
    for i in range(3):
        a, b, c, d = (P[..., i, j, None] for j in range(4))
        rows.append(a * X[0] + b * X[1] + c + d * X[3])
    return rows


def _project(P: Tensor, X: Rows, x: Rows) -> Projection:
    p, q, z = _homogeneous(P, X)
    s = 1 / torch.where(z.abs() > _TINY, z, _TINY)
    u, v = p * s, q * s
    J: list[Rows] = []
    for i, w in ((0, u), (1, v)):
        J.append([quotient_slope(P[..., i, j, None], P[..., 2, j, None], w, s) for j in (0, 1, 3)])
    return Projection((u - x[0], v - x[1]), J, (u, v), s)


def _point_equations(X: Rows, x: Sequence[Rows], views: Sequence[Projection]) -> tuple[list[Tensor], list[Tensor]]:
    """The Cholesky factor of the 3 x 3 normal matrix of a point, rows 00 10 11 20 21 22, and its gradient."""
    g = [X[0] - x[0][0], X[1] - x[0][1], torch.zeros_like(X[3])]
    h = [torch.ones_like(X[3]), torch.zeros_like(X[3]), torch.ones_like(X[3]), *(torch.zeros_like(X[3]) for _ in range(3))]
    for view in views:
        for j, e in zip(view.J, view.r, strict=True):
            h = [
                h[0] + j[0] * j[0], h[1] + j[0] * j[1], h[2] + j[1] * j[1],
                h[3] + j[0] * j[2], h[4] + j[1] * j[2], h[5] + j[2] * j[2],
            ]  # fmt: skip
            g = [g[i] + j[i] * e for i in range(3)]
    l00 = h[0].sqrt()
    l10, l20 = h[1] / l00, h[3] / l00
    l11 = (h[2] - l10 * l10).clamp(min=0.5).sqrt()
    l21 = (h[4] - l20 * l10) / l11
    l22 = (h[5] - l20 * l20 - l21 * l21).clamp(min=_TINY).sqrt()
    return [l00, l10, l11, l20, l21, l22], g


def _forward(L: Rows, b: Rows) -> list[Tensor]:
    y0 = b[0] / L[0]
    y1 = (b[1] - L[1] * y0) / L[2]
    return [y0, y1, (b[2] - L[3] * y0 - L[4] * y1) / L[5]]


def _backward(L: Rows, y: Rows) -> list[Tensor]:
    x2 = y[2] / L[5]
    x1 = (y[1] - L[4] * x2) / L[2]
    return [(y[0] - L[1] * x1 - L[3] * x2) / L[0], x1, x2]


def _projections(model: Tensor, x: Sequence[Rows], X: Rows) -> list[Projection]:
    return [_project(model[..., k, :, :], X, x[k + 1]) for k in range(2)]


def _step(model: Tensor, x: Sequence[Rows], X: list[Tensor]) -> list[Tensor]:
    """A Gauss-Newton step of the points."""
    return _moved(x, X, _projections(model, x, X))


def _moved(x: Sequence[Rows], X: list[Tensor], views: Sequence[Projection]) -> list[Tensor]:
    L, g = _point_equations(X, x, views)
    d = _backward(L, _forward(L, g))
    return [X[0] - d[0], X[1] - d[1], X[2], X[3] - d[2]]
