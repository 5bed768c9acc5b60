"""The least squares of lines, from where they start.

In a chart a step takes next to nothing. But a chart has an end, at lines across its third axis and at infinity, past which
noise may lead; lines that come far in theirs are fitted over the whole manifold of lines instead.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchsfm.geometry import Line3D, to_homogeneous
from torchsfm.linalg.rows import combine_rows
from torchsfm.linalg.vectors import cross
from torchsfm.optim import LeastSquaresResult, Loss, levenberg_marquardt
from torchsfm.optim.descent import Options, descend
from torchsfm.triangulation.line_chart import Chart, Parameters, chart_about, place_of
from torchsfm.triangulation.line_problem import LineProblem
from torchsfm.triangulation.line_residuals import image_rows, in_world, line_forms, linearize, residuals
from torchsfm.triangulation.line_views import LineViews

_FAR = 0.5
"""Length of the parameters from which on a line is far in its chart."""


class Fit(NamedTuple):
    """Lines at their minima."""

    problem: LineProblem
    chart: Chart
    x: Parameters
    status: Tensor


def fit(views: LineViews, chart: Chart, used: Tensor, loss: Loss | None, max_iterations: int) -> Fit:
    """Minimise from the third axes of charts; `used` (v, n) is 1 for views that count and 0 for others.

    Lines of two views are said to have too few, as those of fewer are.
    """
    zero = torch.zeros_like(chart.unit)
    problem = LineProblem(chart.cameras(views), views.ends, views.w, used, loss)
    # The start is so near that damping is for the few where it is not.
    # What is left of the cost then is 1e-5 of a standard deviation of the lines at most.
    options = Options(max_iterations, function_tolerance=1e-8, step_tolerance=1e-10, initial_damping=1e-6)
    # Two planes meet in one line, which is where it starts: nothing is left to minimise.
    found = descend(problem, (zero, zero, zero, zero), options, enough=views.used.sum(0) >= 3)
    x, status = found.x, found.status
    (at,) = (combine_rows(x, x) > _FAR**2).nonzero(as_tuple=True)
    if not len(at):
        return Fit(problem, chart, x, status)
    some, own = views.some(at), chart.some(at)
    line, _, again = fit_from(some, own, own.origin, own.axes[2], loss, max_iterations)
    d, moment = line.mT[:3], line.mT[3:]
    # The point of the line nearest to where it was: that nearest to the world's origin may be far from everything.
    point = own.origin + cross(d, moment - cross(own.origin, d))
    place = place_of(some, point, d, used.index_select(-1, at))
    there = chart_about(point + place.middle * d, d, place.unit)
    chart = Chart(*(old.index_copy(-1, at, new) for old, new in zip(chart, there, strict=True)))
    x = tuple(row.index_fill(0, at, 0.0) for row in x)
    problem = LineProblem(chart.cameras(views), views.ends, views.w, used, loss)
    return Fit(problem, chart, x, status.index_copy(0, at, again.status))


def fit_from(
    views: LineViews, chart: Chart, point: Tensor, d: Tensor, loss: Loss | None, max_iterations: int
) -> tuple[Tensor, Tensor, LeastSquaresResult[Tensor]]:
    """Minimise over all lines, from those through points (3, n) in directions d (3, n) of unit length.

    Returns:
        The lines (n, 6) in the world and their residuals (n, v, 2), both with the derivatives of the minimum with respect to
        `views`; what Levenberg-Marquardt says.
    """
    with torch.no_grad():
        # The direction and the moment of the line are of one length, which is where its manifold is best.
        origin = chart.origin + chart.unit * chart.axes[0]
        line = torch.cat((d, cross((point - origin) / chart.unit, d))).mT
        line = line / torch.linalg.vector_norm(line, dim=-1, keepdim=True)
    forms = line_forms(views.moved(origin, chart.unit).permute(3, 2, 0, 1))
    rows = image_rows(forms, to_homogeneous(views.by_line().ends))
    found = levenberg_marquardt(
        residuals, line, rows, retract=Line3D().retract, size=4, weights=views.w.mT, loss=loss, linearize=linearize,
        max_iterations=max_iterations,
    )  # fmt: skip
    return in_world(found.x, origin.mT, chart.unit), residuals(found.x, rows), found
