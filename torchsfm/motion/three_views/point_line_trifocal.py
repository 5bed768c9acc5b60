"""Three projective cameras as points and lines together determine them: what `ransac` needs to know."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, Status, broadcast_shapes
from torchsfm.geometry import line_from_points
from torchsfm.linalg import damped_solve
from torchsfm.motion.three_views.line_reprojection import line_equations, squared_line_distance
from torchsfm.motion.three_views.multilinear_fit import frame_directions, free_directions
from torchsfm.motion.three_views.trifocal_4p3l import trifocal_4p3l
from torchsfm.motion.three_views.trifocal_6pt import trifocal_6pt
from torchsfm.motion.three_views.trifocal_7pt import trifocal_7pt
from torchsfm.motion.three_views.trifocal_reprojection import linear_depths, normal_equations, squared_distance
from torchsfm.motion.three_views.unseen_change import change_unseen
from torchsfm.robust import Degeneracy, Weigh, constant_weights
from torchsfm.tensors.canonical import canonical_frame

_FIT_STEPS = 4
"""Steps from the linear tensor of lines to the nearest that three cameras have."""


@dataclass(frozen=True)
class PointLineTrifocalEstimator:
    """Three projective cameras, the first [I | 0], from points and lines in one table; models as of `TrifocalEstimator`.

    A row is a point or a line: `kind` 0 or 1. In each image a line has the two ends of a segment, which need not be ends of the
    same piece of it; a point has its place twice. The distance of a line is the root of the sum of squared distances of all six
    ends from the images of one line in space, the best to first order: two independent errors, where a point has three. Points
    behind the second or third camera are at infinite distance; of lines nobody knows.

    Attributes:
        sample_size: 7, six points and one to choose among their solutions, or four points and three lines; or 13 where there
            are fewer than four points: then any sample will do, by linear equations.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(40, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> rows = torch.cat((x[:, :10].repeat(1, 1, 2), x[:, 10:].reshape(3, 15, 4)), 1)  # ten points, each twice; 15 segments
        >>> kind = torch.cat((torch.zeros(10), torch.ones(15)))[:, None].double()
        >>> estimator = torchsfm.motion.PointLineTrifocalEstimator()
        >>> found = torchsfm.ransac(estimator, *rows, kind, threshold=1e-3, generator=g)
        >>> estimator.mixtures, found.inliers.sum()  # samples of seven points, or of four points and three lines
        (((7, 0), (4, 3)), tensor(25))
    """

    sample_size: int = 7

    model_name: ClassVar[str] = "point_line_trifocal"
    data_names: ClassVar[tuple[str, ...]] = ("x1", "x2", "x3", "kind")
    max_solutions: ClassVar[int] = 3
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 18
    never_zero: ClassVar[bool] = True

    @property
    def mixtures(self) -> tuple[tuple[int, ...], ...]:
        """Seven points, or four points and three lines."""
        return ((7, 0), (4, 3)) if self.sample_size == 7 else ()

    def kinds(
        self,
        x1: Float[Tensor, "*#batch n 4"],
        x2: Float[Tensor, "*#batch n 4"],
        x3: Float[Tensor, "*#batch n 4"],
        kind: Float[Tensor, "*#batch n 1"],
    ) -> Int[Tensor, "*batch n"]:
        """0 for points, 1 for lines."""
        return (kind[..., 0] > 0.5).long()

    def minimal(
        self,
        x1: Float[Tensor, "*#batch m 4"],
        x2: Float[Tensor, "*#batch m 4"],
        x3: Float[Tensor, "*#batch m 4"],
        kind: Float[Tensor, "*#batch m 1"],
    ) -> Solutions[Float[Tensor, "*batch 3 2 3 4"]]:
        """The cameras of samples, in front of which their points can be.

        None is valid for mixtures that leave the cameras open, such as five points and two lines.
        """
        x = torch.stack(torch.broadcast_tensors(x1, x2, x3), -3)  # type: ignore[no-untyped-call]
        m, batch = self.sample_size, broadcast_shapes(x.shape[:-3], kind.shape[:-2])
        x, kind = x.expand(*batch, 3, m, 4).reshape(-1, 3, m, 4), kind.expand(*batch, m, 1).reshape(-1, m, 1)
        order = (kind[..., 0] > 0.5).long().argsort(dim=1, stable=True)
        x = x.gather(2, order[:, None, :, None].expand_as(x))
        points = (kind <= 0.5).sum((1, 2))
        few = points < 4
        model = torch.eye(3, 4, dtype=x.dtype, device=x.device).expand(len(x), 3, 2, 3, 4)
        valid = torch.zeros(len(x), 3, dtype=torch.bool, device=x.device)
        ways = (
            (points >= 6, _of_points),
            (~few & (points < 6) & (points <= m - 3), _of_points_and_lines),
            (few if m >= 13 else few & ~few, _of_lines),
        )
        for which, solve in ways:
            row = which.nonzero()[:, 0]
            if len(row) or not len(x):
                P, good = solve(x[row], points[row])
                model, valid = model.index_copy(0, row, P), valid.index_copy(0, row, good)
        with torch.no_grad():
            depths = linear_depths(model.detach(), [_first_ends(v[:, None]) for v in x.detach().unbind(1)])
            point = (torch.arange(m, device=x.device) < points[:, None])[:, None, None]
            plus = torch.where(point, depths, torch.inf).amin(-1) > 0
            minus = torch.where(point, depths, -torch.inf).amax(-1) < 0
            valid = valid & (plus | minus).all(-1) & kind.isfinite().all(1)
        model = torch.where((minus & ~plus)[..., None, None], -model, model)
        valid = valid & model.isfinite().flatten(2).all(-1)
        model = torch.where(valid[..., None, None, None], model, torch.eye(3, 4, dtype=x.dtype, device=x.device))
        return Solutions(model.reshape(*batch, 3, 2, 3, 4), valid.reshape(*batch, 3))

    def squared_residual(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 4"],
        x2: Float[Tensor, "*#batch n 4"],
        x3: Float[Tensor, "*#batch n 4"],
        kind: Float[Tensor, "*#batch n 1"],
    ) -> Float[Tensor, "*batch n"]:
        """Squared distance; infinite for points behind a camera."""
        views, line = (x1, x2, x3), kind[..., 0] > 0.5
        squared, front = squared_distance(model, _points(views, line))
        return torch.where(line, squared_line_distance(model, _ends(views)), squared.masked_fill(~front, torch.inf))

    def degenerate(
        self,
        x1: Float[Tensor, "*#batch m 4"],
        x2: Float[Tensor, "*#batch m 4"],
        x3: Float[Tensor, "*#batch m 4"],
        kind: Float[Tensor, "*#batch m 1"],
    ) -> Bool[Tensor, "*batch"]:
        """Whether two of the points, or of the segments, coincide in an image."""
        i, j = torch.triu_indices(self.sample_size, self.sample_size, 1, device=x1.device)
        same = [(x[..., i, :] == x[..., j, :]).all(-1).any(-1) for x in (x1, x2, x3)]
        return same[0] | same[1] | same[2]

    def step(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 4"],
        x2: Float[Tensor, "*#batch n 4"],
        x3: Float[Tensor, "*#batch n 4"],
        kind: Float[Tensor, "*#batch n 1"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 2 3 4"]:
        """A Gauss-Newton step on the reprojection error over cameras, points and lines; the frame and scales are held."""
        A, b = _normal_equations(model, (x1, x2, x3), kind[..., 0] > 0.5, weigh)
        P = model.double()
        G = frame_directions(P)
        G = G / (G * G).sum(-2, keepdim=True).clamp(min=1e-200).sqrt()
        A = A + A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * (G @ G.mT)
        step = damped_solve(A, b[..., None])[..., 0]
        moved = canonical_frame(P - step.reshape(*step.shape[:-1], 2, 3, 4), signed=False)
        return moved[..., 1:, :, :].to(x1.dtype)

    def retract(
        self, model: Float[Tensor, "*#batch 2 3 4"], step: Float[Tensor, "*#batch 18"]
    ) -> Float[Tensor, "*batch 2 3 4"]:
        """The cameras moved along a basis of the directions that change more than the frame and scales."""
        delta = (free_directions(model) @ step[..., None])[..., 0]
        moved: Tensor = model + delta.reshape(*delta.shape[:-1], 2, 3, 4)
        return moved

    def may_be_degenerate(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 4"],
        x2: Float[Tensor, "*#batch n 4"],
        x3: Float[Tensor, "*#batch n 4"],
        kind: Float[Tensor, "*#batch n 1"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Bool[Tensor, "*batch"]:
        """Whether the inliers may leave a large change of the cameras unseen."""
        return _unseen(model, (x1, x2, x3), kind[..., 0] > 0.5, inliers, threshold, 2 + chance)

    def degeneracy(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 4"],
        x2: Float[Tensor, "*#batch n 4"],
        x3: Float[Tensor, "*#batch n 4"],
        kind: Float[Tensor, "*#batch n 1"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """UNDETERMINED: a large change of the cameras is not seen by more inliers than chance explains.

        So it is where points and lines are in a plane, centres coincide, or lines meet one line.
        """
        unseen = _unseen(model, (x1, x2, x3), kind[..., 0] > 0.5, inliers, threshold, 2 + chance)
        return torch.where(unseen, int(Degeneracy.UNDETERMINED), int(Degeneracy.NONE)).to(torch.int8)


def _first_ends(x: Tensor) -> list[Tensor]:
    return [x[..., 0], x[..., 1]]


def _points(views: Sequence[Tensor], line: Tensor) -> list[list[Tensor]]:
    """The points in rows, and the origin where there are lines."""
    return [[torch.where(line, 0.0, row) for row in _first_ends(x)] for x in views]


def _ends(views: Sequence[Tensor]) -> list[list[Tensor]]:
    return [list(x.unbind(-1)) for x in views]


def _of_points(x: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """From six points; where there is a seventh, the solution next to it."""
    found = trifocal_6pt(x[:, :, :6, :2])
    P = found.model[:, :, 1:]
    with torch.no_grad():
        seventh = [_first_ends(v[:, None, 6:7]) for v in x.detach().unbind(1)]
        squared, _ = squared_distance(P.detach(), seventh)
        loss = torch.where(found.valid, squared[..., 0].nan_to_num(torch.inf), torch.inf)
        nearest = torch.nn.functional.one_hot(loss.argmin(-1), 3).bool()
    return P, found.valid & (nearest | (points < 7)[:, None])


def _of_points_and_lines(x: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """From the first four points and the last three lines."""
    found = trifocal_4p3l(x[:, :, :4, :2], line_from_points(x[:, :, -3:, :2], x[:, :, -3:, 2:]))
    return found.model[:, :, 1:], found.valid


def _of_lines(x: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """From linear equations of all."""
    point = (torch.arange(x.shape[2], device=x.device) < points[:, None]).to(x.dtype)
    l = line_from_points(x[..., :2], x[..., 2:])  # noqa: E741
    fit = trifocal_7pt(
        x[..., :2], l, ends=x[:, 0].reshape(*point.shape, 2, 2), weights=point, line_weights=1 - point,
        max_iterations=_FIT_STEPS,
    )  # fmt: skip
    good = (fit.status == Status.OK) | (fit.status == Status.NOT_CONVERGED)
    return fit.P[:, None, 1:].expand(-1, 3, -1, -1, -1), torch.nn.functional.pad(good[:, None], (0, 2))


def _normal_equations(
    model: Tensor, views: Sequence[Tensor], line: Tensor, weigh: Weigh
) -> tuple[Float[Tensor, "*batch 24 24"], Float[Tensor, "*batch 24"]]:
    """J' C J and J' W r over the entries of both cameras, points and lines eliminated, in float64."""
    squared, r, J = line_equations(model, _ends(views))
    weights = curvature = squared

    def of_points(distance: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal weights, curvature
        weights, curvature = weigh(torch.where(line, squared, distance))
        return torch.where(line, 0.0, weights), torch.where(line, 0.0, curvature)

    A, b = normal_equations(model, _points(views, line), of_points)
    weights, curvature = (torch.where(line, w, 0.0)[..., None, None, :] for w in (weights, curvature))
    J, r = J.double(), r.double()
    return A + (J * curvature).flatten(-2) @ J.flatten(-2).mT, b + (J * weights * r[..., None, :, :]).sum((-2, -1))


def _unseen(model: Tensor, views: Sequence[Tensor], line: Tensor, inliers: Tensor, threshold: Tensor, spare: Tensor) -> Tensor:
    """Whether no more inliers than can be spared see the change of the cameras that they see least."""
    one = constant_weights(torch.ones_like(inliers, dtype=model.dtype)[..., None])
    alone, _ = _normal_equations(model[..., None, :, :, :], [x[..., None, :] for x in views], line[..., None], one)
    return change_unseen(model, alone, inliers, threshold, spare)
