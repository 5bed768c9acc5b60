"""Lines from many views of which some are wrong."""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Solutions, Status, broadcast_shapes
from torchsfm.geometry import point_line_distance, project_lines, to_homogeneous
from torchsfm.geometry.image_distance import positive_depth, squared_in_front
from torchsfm.linalg import cross, damped_solve, determinant_3x3
from torchsfm.robust import SearchOptions, Weigh, check_door, ransac
from torchsfm.triangulation.agreed_views import solve_agreed
from torchsfm.triangulation.line_layout import lay_out
from torchsfm.triangulation.line_residuals import image_rows, in_world, line_forms, slopes_along, through_centre
from torchsfm.triangulation.line_views import frame_of_centres, observe
from torchsfm.triangulation.triangulate_lines import LineTriangulation, triangulate_lines

_ROUNDED = 1.001
"""Thresholds that an inlier may be off the line that is returned, which may be in single precision."""
_PARALLEL = 1e-12
"""Squared sine of the angle of two planes that are one."""


@dataclass(frozen=True)
class LineEstimator:
    """A line seen in several views; a datum are the four numbers of a segment's ends and the twelve of its camera.

    Models are Pluecker vectors (d, m), |d| = 1, of either sign. The left parts of the cameras have positive determinants.
    Distances are the roots of the sums of the squared distances of both ends from the line's image, in pixels, and infinite
    where the middle of the segment is seen behind the camera. The line should be about as far from the origin as the cameras.

    Attributes:
        seen: Whether the ends say what is seen of the line: else they are points of image lines, and nothing is behind.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_poses(6, generator=g).matrix()
        >>> x = torchsfm.project_points(P, torchsfm.random_points(2, generator=g))  # the ends of a segment
        >>> x[5] += 0.5  # wrong in the last view
        >>> estimator = torchsfm.triangulation.LineEstimator()
        >>> found = torchsfm.ransac(estimator, x.flatten(-2), P.flatten(-2), threshold=0.01, generator=g)  # a row a view
        >>> found.inliers, found.model.shape
        (tensor([ True,  True,  True,  True,  True, False]), torch.Size([6]))
    """

    seen: bool = True

    model_name: ClassVar[str] = "line"
    data_names: ClassVar[tuple[str, ...]] = ("x", "P")
    sample_size: ClassVar[int] = 2
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 2
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x: Float[Tensor, "*#batch 2 4"], P: Float[Tensor, "*#batch 2 12"]
    ) -> Solutions[Float[Tensor, "*batch 1 6"]]:
        """The line in which two planes of sight meet."""
        l = cross(to_homogeneous(x[..., :2]), to_homogeneous(x[..., 2:]))  # noqa: E741
        planes = (l[..., None, :] @ P.reshape(*P.shape[:-1], 3, 4))[..., 0, :]
        length = torch.linalg.vector_norm(planes[..., :3], dim=-1, keepdim=True)
        planes = planes / torch.where(length > 0, length, 1.0)
        (n1, w1), (n2, w2) = ((plane[..., :3], plane[..., 3:]) for plane in planes.unbind(-2))
        d = cross(n1, n2)
        square = (d * d).sum(-1, keepdim=True)
        valid = (square > _PARALLEL) & torch.isfinite(square) & torch.isfinite(w1 + w2)
        line = torch.cat((d, w1 * n2 - w2 * n1), -1) * torch.where(valid, square, 1.0).rsqrt()
        line = torch.where(valid, line, line.new_tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        return Solutions(line[..., None, :], valid)

    def squared_residual(
        self, model: Float[Tensor, "*#batch 6"], x: Float[Tensor, "*#batch n 4"], P: Float[Tensor, "*#batch n 12"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared distance in the image; infinite behind the camera."""
        ends, forms, M = _view(x, P)
        l, c = (_applied(A, v) for A, v in ((forms, model), (M, model[..., :3])))  # noqa: E741
        scale = (l[..., :2] * l[..., :2]).sum(-1, keepdim=True).clamp_min(1e-200).rsqrt()
        r = (ends * l[..., None, :]).sum(-1) * scale
        depth = (l * cross(ends.mean(-2), c)).sum(-1) if self.seen else torch.ones_like(r[..., 0])
        depth = torch.where(through_centre(l, model, forms), -1.0, depth)
        return squared_in_front(r[..., 0], r[..., 1], depth, positive_depth(depth)[0])

    def degenerate(self, x: Float[Tensor, "*#batch 2 4"], P: Float[Tensor, "*#batch 2 12"]) -> Bool[Tensor, "*batch"]:
        """Whether both data are of one camera."""
        return (P[..., 0, :] == P[..., 1, :]).all(-1) & torch.isfinite(x).all(-1).all(-1)

    def step(
        self,
        model: Float[Tensor, "*#batch 6"],
        x: Float[Tensor, "*#batch n 4"],
        P: Float[Tensor, "*#batch n 12"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 6"]:
        """A Gauss-Newton step on the distances in the image: the line shifted across itself, and turned about its foot."""
        weights, curvature = (w[..., None, None] for w in weigh(self.squared_residual(model, x, P)))
        ends, forms, _ = _view(x, P)
        d = model[..., :3] / torch.linalg.vector_norm(model[..., :3], dim=-1, keepdim=True).clamp_min(1e-300)
        foot = cross(d, model[..., 3:] / torch.linalg.vector_norm(model[..., :3], dim=-1, keepdim=True).clamp_min(1e-300))
        axis = torch.nn.functional.one_hot(d.abs().argmin(-1), 3).to(d.dtype)
        u = cross(d, axis)
        u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True).clamp_min(1e-300)
        across = torch.stack((u, cross(d, u)), -2)
        # Moves of (d, m): shifts by the two vectors across change m, new directions both.
        shift = torch.cat((torch.zeros_like(across), cross(across, d[..., None, :])), -1)
        turn = torch.cat((across, cross(foot[..., None, :], across)), -1)
        r, J = slopes_along(torch.cat((d, cross(foot, d)), -1), torch.cat((shift, turn), -2).mT, image_rows(forms, ends))
        N = (J * curvature).flatten(-3, -2).mT @ J.flatten(-3, -2)
        g = (J * (weights * r[..., None])).sum((-3, -2))
        batch = broadcast_shapes(N.shape[:-2], g.shape[:-1])
        step = -damped_solve(N.double().expand(*batch, 4, 4), g.double().expand(*batch, 4)[..., None])[..., 0].to(d.dtype)
        moved = foot + (step[..., None, :2] @ across)[..., 0, :]
        d = d + (step[..., None, 2:] @ across)[..., 0, :]
        d = d / torch.linalg.vector_norm(d, dim=-1, keepdim=True).clamp_min(1e-300)
        return torch.cat((d, cross(moved, d)), -1)


def _view(x: Tensor, P: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Homogeneous ends (*batch, n, 2, 3), matrices from lines to image lines (*batch, n, 3, 6), left parts of the cameras."""
    P = P.reshape(*P.shape[:-1], 3, 4)
    return to_homogeneous(x.reshape(*x.shape[:-1], 2, 2)), line_forms(P), P[..., :3]


def _applied(A: Tensor, v: Tensor) -> Tensor:
    """A v (*batch, n, 3) for matrices of the data (*#batch, n, 3, k) and models (*#batch, k); models may share the data."""
    n = A.shape[-3]
    flat = A.flatten(-3, -2)
    if v.ndim > 1 and flat.ndim > 2 and flat.shape[-3] == 1 < v.shape[-2]:
        y = (flat[..., 0, :, :] @ v.mT).mT
    else:
        y = (flat @ v[..., None])[..., 0]
    return y.reshape(*y.shape[:-1], n, 3)


@dataclass(frozen=True)
class RobustLineTriangulation:
    """Lines and which of their observations they agree with.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_intrinsics(6, generator=g) @ torchsfm.random_poses(6, generator=g).matrix()
        >>> X = torchsfm.random_points(2, generator=g)  # the ends of a segment
        >>> x = torchsfm.project_points(P, X)[:, None].repeat(1, 2, 1, 1)  # twice
        >>> x[4:, 0] += 50  # the first is wrong in two views, the second in all but one
        >>> x[1:, 1] += 200 * torch.rand(5, 2, 2, generator=g)
        >>> found = torchsfm.triangulate_lines_robust(x, P, threshold=2.0, generator=g)
        >>> [torchsfm.Status(k).name for k in found.status.tolist()], found.inliers[:, 0]
        (['OK', 'NO_CONSENSUS'], tensor([ True,  True,  True,  True, False, False]))
        >>> bool(found.ends[0].allclose(X)), bool(found.end_covariance[0].any())
        (True, True)
    """

    model: Float[Tensor, "*batch n 6"]
    """Pluecker vectors (d, m) with |d| = 1, d from the first ends of the segments to the second; finite always. Where `status`
    is not OK they may mean little."""
    ends: Float[Tensor, "*batch n 2 3"]
    """The part of the line that the inliers show together; with four or more without the farthest of each quarter."""
    inliers: Bool[Tensor, "*batch v n"]
    """Of which segments the line is the least squares: those of the search that are nearer than the threshold to its image,
    too."""
    support: Float[Tensor, "*batch n"]
    """Sum over the views of max(0, 1 - squared distance / squared threshold)."""
    threshold: Float[Tensor, "*batch n"]
    """The largest distance of an inlier, given or estimated."""
    iterations: Int[Tensor, "*batch n"]
    """Number of pairs of views tried."""
    status: Int[Tensor, "*batch n"]
    """OK; TOO_FEW: fewer than two observations; NOT_FINITE: fewer than two finite ones; DEGENERATE: no two planes of sight meet
    at an angle; NO_CONSENSUS: of three views and more no three agree on a line, or not on it as it is rounded; else what
    `triangulate_lines` says of the inliers."""
    fault: Int8[Tensor, "*batch n"]
    """Why the inliers determine no line where the status is DEGENERATE for that reason, a `LineFault`."""
    angle: Float[Tensor, "*batch n"]
    """The angle at which the planes of sight of the inliers meet, in radians; zero where `status` is not OK."""
    covariance: Float[Tensor, "*batch n 4 4"]
    """Of the steps of `Line3D` from `model`, for independent noise of variance 1 / weight of the inliers' ends across their
    lines in the image (1 pixel where no weights are given); zero where `status` is not OK."""
    end_covariance: Float[Tensor, "*batch n 2 3 3"]
    """Of the place of the line at both `ends`, across it; zero where `status` is not OK."""
    error: Float[Tensor, "*batch n"]
    """Root-mean-square distance (weighted) of the inliers' ends from the line's images, in pixels; zero where not OK."""


def triangulate_lines_robust(
    l: Float[Tensor, "*#batch v n 3"] | Float[Tensor, "*#batch v n 2 2"],  # noqa: E741
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    threshold: float | Float[Tensor, "*#batch n"] | None,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    **options: Unpack[SearchOptions],
) -> RobustLineTriangulation:
    """Lines from known cameras, where some of the segments belong to other lines.

    LO-RANSAC over pairs of planes of sight, each line a problem of its own with its own number of views; then the least squares
    of `triangulate_lines` over the views that agree. Any two planes meet, so with two views nothing can be called wrong but
    what is behind a camera, and of more than two a third must confirm a line.

    Cameras per line (ragged tracks): let the lines be the batch, `l (p, v, 1, 2, 2)` and `P (p, v, 3, 4)`.

    Args:
        l: Segments, two image points each; or homogeneous image lines of any scale, whose errors then count a focal length
            to each side of the point nearest to the principal point.
        P: Cameras `K [R | t]`, of any scale and sign.
        threshold: Largest distance of an inlier in pixels: the root of the sum of the squared distances of both ends. None
            where it is not known: more than half of the observations of each line must then be right (`LeastMedian`), and
            there should be many.
        visible: Which views see which line; all by default. Observations that are not finite are left out too.
        **options: See `SearchOptions`; a datum is a segment, and there are at most 256 pairs for a line.

    Returns:
        The lines with their inliers, support, iterations, status, ends, covariance and error. `model` and `error` carry their
        derivatives with respect to the inliers, their weights and the cameras: those of the least squares over the inliers.
        They are zero where the status is not OK.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_intrinsics(6, generator=g) @ torchsfm.random_poses(6, generator=g).matrix()
        >>> x = torchsfm.project_points(P, torchsfm.random_points(2, generator=g))  # the ends of a segment
        >>> x[5] += 50  # wrong in the last view
        >>> found = torchsfm.triangulate_lines_robust(x[:, None], P, threshold=2.0, generator=g)
        >>> found.status == torchsfm.Status.OK, found.inliers[:, 0]
        (tensor([True]), tensor([ True,  True,  True,  True,  True, False]))
    """
    segments = isinstance(l, Tensor) and l.ndim > 3 and l.shape[-2:] == (2, 2)
    own = {"l": (l, "v n 2 2" if segments else "v n 3"), "P": (P, "v 3 4"), "visible": (visible, "?v n: bool")}
    batch = check_door(own, threshold, options, SearchOptions, of_problem="n", of_datum="v n")
    dtype, trailing = P.dtype, 2 if segments else 1
    v, n = l.shape[-trailing - 2 : -trailing]

    def by_line(t: Tensor | None, rest: int = 0) -> Tensor | None:
        """One line after the other: (lines, v, ...)."""
        if t is None:
            return None
        t = t.detach().expand(*batch, *t.shape[t.ndim - 2 - rest :]).movedim(-1 - rest, -2 - rest)
        return t.reshape(batch.numel() * n, v, *t.shape[t.ndim - rest :])

    weights = options.get("weights")
    laid = lay_out(batch, l.detach(), trailing, P.detach(), visible, None if weights is None else weights.detach())
    views = observe(*laid)
    origin, unit, _ = frame_of_centres(views)
    inner = views.moved(origin, unit).permute(3, 2, 0, 1)[:, :v]
    ends, used = views.ends.permute(3, 2, 1, 0)[:, :v], views.used.mT[:, :v]
    sign = torch.where(determinant_3x3(inner[..., :3]) < 0, -1.0, 1.0).to(inner.dtype)
    double = {name: t.double() for name in ("weights", "quality") if (t := by_line(options.get(name))) is not None}  # type: ignore[arg-type]
    limit = threshold.double().expand(*batch, n).reshape(-1) if isinstance(threshold, Tensor) else threshold
    every: Any = {"max_iterations": 256} | options | double
    found = ransac(
        LineEstimator(segments), ends.flatten(-2), (inner * sign[..., None, None]).flatten(-2),
        threshold=limit, mask=used, min_iterations=16, **every,
    )  # fmt: skip

    def by_problem(t: Tensor) -> Tensor:
        return t.reshape(*batch, n, *t.shape[1:])

    wanted = torch.ones_like(used) if visible is None else by_line(visible)
    assert wanted is not None
    limit = by_problem(found.threshold)
    final, inliers = solve_agreed(
        lambda own, P, used, w: triangulate_lines(own, P, visible=used, weights=w), partial(_distances, trailing), l,
        trailing, P, by_problem(found.inliers).mT, weights, _ROUNDED * limit,
    )  # fmt: skip
    number, seen = inliers.sum(-2), by_problem(used.sum(-1))
    status = by_problem(found.status)
    # What there is, is not finite.
    status = torch.where((status == Status.TOO_FEW) & (by_problem(wanted.sum(-1)) >= 2), int(Status.NOT_FINITE), status)
    # Two planes always meet, so out of more than two a third must confirm the line.
    agreed = (number >= 2) & ((number >= 3) | (seen == 2))
    status = torch.where((status == Status.NO_CONSENSUS) & agreed, int(Status.OK), status)
    status = torch.where((status == Status.OK) & ~agreed, int(Status.NO_CONSENSUS), status)
    status = torch.where(status == Status.OK, final.status, status)
    settled = status == Status.OK
    rough = by_problem(in_world(found.model, origin.mT, unit)).to(dtype)

    def kept(t: Tensor) -> Tensor:
        return torch.where(settled.reshape(settled.shape + (1,) * (t.ndim - settled.ndim)), t, 0)

    return RobustLineTriangulation(
        model=torch.where(settled[..., None], final.model, torch.where(rough.isfinite(), rough, 0.0)),
        ends=final.ends,
        inliers=inliers,
        support=by_problem(found.support).clamp(max=torch.finfo(dtype).max).to(dtype),
        threshold=limit.to(dtype),
        iterations=by_problem(found.iterations),
        status=status,
        fault=final.fault,
        angle=kept(final.angle),
        covariance=kept(final.covariance),
        end_covariance=kept(final.end_covariance),
        error=kept(final.error),
    )


def _distances(trailing: int, found: LineTriangulation, l: Tensor, P: Tensor) -> Tensor:  # noqa: E741
    """The roots of the sums of the squared distances of both ends from the images of the lines."""
    batch, (v, n) = found.model.shape[:-2], l.shape[-trailing - 2 : -trailing]
    ends = observe(*lay_out(batch, l.detach(), trailing, P.detach(), None, None)).ends[:, :, :v]
    ends = ends.permute(2, 3, 1, 0).reshape(v, *batch, n, 2, 2).movedim(0, -4)
    image = project_lines(P.detach().double(), found.model.detach().double()[..., None, :, :])
    distance: Tensor = point_line_distance(ends, image[..., None, :]).norm(dim=-1)
    return distance
