"""How well lines are known: the inverse of their normal equations, at points of the line and along the steps of `Line3D`."""

import torch
from torch import Tensor

from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.linalg.vectors import cross
from torchsfm.optim.batched_cholesky import factor
from torchsfm.triangulation.line_chart import Chart
from torchsfm.triangulation.line_problem import UPPER, Rows, blocks
from torchsfm.triangulation.line_views import LineViews

_SINGULAR = 1e13
"""Trace of the inverse of normal equations of unit diagonal from which on they are singular but for rounding."""
Square = list[list[Tensor]]
"""A symmetric 4x4 matrix of tensors (n), both triangles."""


def parameter_covariance(N: Rows) -> tuple[Square, Tensor]:
    """The inverses of normal matrices (`UPPER`), zero where there is none, and where there is one (n)."""
    diagonal = torch.stack([N[UPPER.index((i, i))] for i in range(4)])
    scale = torch.maximum(diagonal, 1e-60 * diagonal.amax(0)).clamp_min(1e-200).rsqrt().unbind(0)
    unit = tuple(entry * (scale[i] * scale[j]) for entry, (i, j) in zip(N, UPPER, strict=True))
    L, regular = factor(blocks(unit, (unit[0],) * 4), 4)
    # The inverse of the factor, whose diagonal comes inverted.
    K = [[L[i][i] if i == j else torch.zeros(()) for j in range(i + 1)] for i in range(4)]
    for i in range(4):
        for j in range(i):
            K[i][j] = -L[i][i] * combine_rows(L[i][j:i], [K[k][j] for k in range(j, i)])
    upper = {(i, j): combine_rows([K[k][i] for k in range(j, 4)], [K[k][j] for k in range(j, 4)]) for i, j in UPPER}
    regular = regular & (add_rows([upper[i, i] for i in range(4)]) < _SINGULAR)
    upper = {(i, j): entry * (scale[i] * scale[j]) for (i, j), entry in upper.items()}
    if not bool(regular.all()):
        upper = {key: torch.where(regular, entry, 0.0) for key, entry in upper.items()}
    return [[upper[min(i, j), max(i, j)] for j in range(4)] for i in range(4)], regular


def place_covariance(C: Square, chart: Chart, d: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """The covariance (n, 2, 3, 3) of a line's place at two of its points, across it, and its trace (2, n) in the chart's unit.

    Args:
        C: That of the parameters.
        chart: The frames.
        d: Directions (3, n), as the chart gives them.
        t: The points (2, n).
    """
    square = combine_rows(d, d)
    u, v = (axis - d * (combine_rows(axis, d) / square) for axis in chart.axes[:2].unbind(0))
    uu, uv, vv = (
        C[i][j] + t * (C[i][2 + j] + C[j][2 + i] + t * C[2 + i][2 + j]) for i, j in ((0, 0), (0, 1), (1, 1))
    )  # fmt: skip
    # Columns of [u v] times the covariance of both coordinates, (3, 2, n).
    left, right = (torch.addcmul(u[:, None] * a, v[:, None], b) for a, b in ((uu, uv), (uv, vv)))
    trace = combine_rows(left, u[:, None]) + combine_rows(right, v[:, None])
    unit = chart.unit.square()
    left, right = left * unit, right * unit
    found = torch.addcmul(left[:, None] * u[None, :, None], right[:, None], v[None, :, None])
    return found.permute(3, 2, 0, 1), trace


def turn_variance(C: Square, chart: Chart, point: Tensor, d: Tensor, views: LineViews) -> Tensor:
    """The variance (n) of directions as the views see them: in two coordinates, over that of what is across the rays to them.

    Lines seem to point at the cameras where noise is much, and then their angles vary little: what says that the direction is
    known is that its slope along the rays does.

    Args:
        C: That of the parameters.
        chart: The frames.
        point: Points of the lines (3, n).
        d: Directions (3, n), as the chart gives them.
        views: The views.
    """
    square = combine_rows(d, d)
    used = views.used.to(square.dtype)
    rays = torch.where(views.near, views.centre - point[:, None], views.centre)
    along = combine_rows(rays, d[:, None])
    share = used / (combine_rows(rays, rays) * add_rows(used).clamp_min(1)).clamp_min(1e-300)
    across = (1 - combine_rows(along * along, share) / square).clamp_min(1e-12)
    leaning = torch.stack([combine_rows(row, share * along) for row in rays.unbind(0)])
    u, v = (axis - d * (combine_rows(axis, d) / square) for axis in chart.axes[:2].unbind(0))
    gu, gv = combine_rows(leaning, u), combine_rows(leaning, v)
    C22, C23, C33 = C[2][2], C[2][3], C[3][3]
    plain = C22 * combine_rows(u, u) + 2 * C23 * combine_rows(u, v) + C33 * combine_rows(v, v)
    leant = C22 * gu * gu + 2 * C23 * gu * gv + C33 * gv * gv
    return (plain + leant / (square * across * across)) / (square * across)


def step_covariance(C: Square, chart: Chart, point: Tensor, d: Tensor, model: Tensor) -> Tensor:
    """The covariance (n, 4, 4) of steps of `Line3D`, zero for lines through the world's origin.

    Args:
        C: That of the parameters.
        chart: The frames.
        point: The points (a, b, 0) of the lines (3, n), in the world.
        d: Their directions (3, n), as the chart gives them.
        model: The Pluecker vectors (6, n) of the lines, of unit direction to either side.
    """
    direction, moment = model[:3], model[3:]
    square = combine_rows(moment, moment)
    determined = (square > 1e-20) & (square < 1e20)
    size = torch.where(determined, square, 1.0).sqrt()
    u1 = moment / size
    u3 = cross(u1, direction)
    length = combine_rows(d, direction)
    G: list[list[Tensor | None]] = [[None] * 4 for _ in range(4)]
    for k, axis in enumerate(chart.axes[:2].unbind(0)):
        shifted = cross(axis, direction) * chart.unit
        turned = (axis - direction * combine_rows(axis, direction)) / length
        moved = cross(point, turned)
        G[0][2 + k], G[2][2 + k] = combine_rows(u3, turned), -combine_rows(u1, turned)
        for change, column in ((shifted, k), (moved, 2 + k)):
            G[1][column] = -combine_rows(u3, change) / size
            G[3][column] = -combine_rows(u1, change) / (1 + square)
    rows = [torch.stack(row) for row in C]
    half = [_combined(row, rows) for row in G]
    columns = [torch.stack([row[k] if row[k] is not None else torch.zeros_like(size) for row in G]) for k in range(4)]  # type: ignore[misc]
    found = torch.stack([combine_rows(columns, row) for row in half])
    if not bool(determined.all()):
        found = torch.where(determined, found, 0.0)
    return found.permute(2, 0, 1)


def _combined(weights: list[Tensor | None], rows: list[Tensor]) -> Tensor:
    """The sum of rows (4, n) times the weights that there are."""
    some = [(row, weight) for row, weight in zip(rows, weights, strict=True) if weight is not None]
    return combine_rows([row for row, _ in some], [weight for _, weight in some])
