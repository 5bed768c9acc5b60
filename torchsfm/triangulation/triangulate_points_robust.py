"""Points from many views of which some are wrong."""

from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, Status, broadcast_shapes
from torchsfm.geometry.image_distance import positive_depth, squared_in_front
from torchsfm.geometry.projection import quotient_slope
from torchsfm.geometry.residuals import reprojection_distance
from torchsfm.linalg import damped_solve
from torchsfm.robust import SearchOptions, Weigh, check_door, ransac
from torchsfm.triangulation.agreed_views import solve_agreed
from torchsfm.triangulation.triangulate_points import Triangulation, triangulate_points


@dataclass(frozen=True)
class PointEstimator:
    """A point X seen in several views; a datum is an image point and the twelve entries of its camera.

    Cameras are scaled so that the third coordinate of P X is the depth. Distances are reprojection errors in pixels, and
    infinite behind the camera.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(1, generator=g), torchsfm.random_poses(6, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)[:, 0]  # one point in six views
        >>> x[5] += 0.5  # wrong in the last
        >>> estimator = torchsfm.triangulation.PointEstimator()
        >>> found = torchsfm.ransac(estimator, x, P.flatten(-2), threshold=0.01, generator=g)  # a row a view
        >>> found.inliers, bool(found.model.allclose(X[0]))
        (tensor([ True,  True,  True,  True,  True, False]), True)
    """

    model_name: ClassVar[str] = "point"
    data_names: ClassVar[tuple[str, ...]] = ("x", "P")
    sample_size: ClassVar[int] = 2
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 2

    def minimal(
        self, x: Float[Tensor, "*#batch 2 2"], P: Float[Tensor, "*#batch 2 12"]
    ) -> Solutions[Float[Tensor, "*batch 1 3"]]:
        """The point nearest to two viewing rays, in the sense of linear least squares with rows of norm 1."""
        p = P.unbind(-1)
        # The coefficients of X and the constant, each for both equations of both views.
        row = [torch.cat((x[..., 0] * p[8 + j] - p[j], x[..., 1] * p[8 + j] - p[4 + j]), -1) for j in range(4)]
        inverse = 1 / (row[0] * row[0] + row[1] * row[1] + row[2] * row[2]).sqrt().clamp(min=1e-30)
        ax, ay, az, right = row[0] * inverse, row[1] * inverse, row[2] * inverse, -row[3] * inverse
        N = [(u * v).sum(-1) for u, v in ((ax, ax), (ax, ay), (ax, az), (ay, ay), (ay, az), (az, az))]
        g = [(u * right).sum(-1) for u in (ax, ay, az)]
        adjugate = (
            N[3] * N[5] - N[4] * N[4], N[2] * N[4] - N[1] * N[5], N[1] * N[4] - N[2] * N[3],
            N[0] * N[5] - N[2] * N[2], N[1] * N[2] - N[0] * N[4], N[0] * N[3] - N[1] * N[1],
        )  # fmt: skip
        det = N[0] * adjugate[0] + N[1] * adjugate[1] + N[2] * adjugate[2]
        # The trace is 4; the smallest eigenvalue is about the squared angle between the rays.
        valid = (det > 1e-12) & torch.isfinite(det)
        inverse = torch.where(valid, 1 / torch.where(valid, det, 1), 0)
        q = adjugate
        X = torch.stack(
            (
                (q[0] * g[0] + q[1] * g[1] + q[2] * g[2]) * inverse,
                (q[1] * g[0] + q[3] * g[1] + q[4] * g[2]) * inverse,
                (q[2] * g[0] + q[4] * g[1] + q[5] * g[2]) * inverse,
            ),
            -1,
        )
        valid = valid & torch.isfinite(X).all(-1)
        return Solutions(torch.where(valid[..., None], X, 0)[..., None, :], valid[..., None])

    def squared_residual(
        self, X: Float[Tensor, "*#batch 3"], x: Float[Tensor, "*#batch n 2"], P: Float[Tensor, "*#batch n 12"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared reprojection error; infinite behind the camera."""
        views = _Views(X, x, P)
        u, v = torch.addcmul(views.x, views.image, views.inverse, value=-1).unbind(-3)
        return squared_in_front(u, v, views.depth, views.z).view(*views.batch, x.shape[-2])

    def degenerate(self, x: Float[Tensor, "*#batch 2 2"], P: Float[Tensor, "*#batch 2 12"]) -> Bool[Tensor, "*batch"]:
        """Whether both data are of one camera."""
        return (P[..., 0, :] == P[..., 1, :]).all(-1) & torch.isfinite(x).all(-1).all(-1)

    def step(
        self,
        X: Float[Tensor, "*#batch 3"],
        x: Float[Tensor, "*#batch n 2"],
        P: Float[Tensor, "*#batch n 12"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 3"]:
        """A Gauss-Newton step on the reprojection error."""
        views, n = _Views(X, x, P), x.shape[-2]
        uv = views.image * views.inverse
        r = views.x - uv
        weights, curvature = weigh(squared_in_front(r[:, 0], r[:, 1], views.depth, views.z).view(*views.batch, n))
        shape = views.depth.shape
        weights, curvature = (w.expand(*views.batch, n).reshape(shape) for w in (weights, curvature))
        # (problem, image coordinate, coordinate of X, point, n)
        first, last = views.rows[:, :2, :3, None], views.rows[:, 2:, :3, None]
        J = quotient_slope(first, last, uv[:, :, None], views.inverse[:, None])
        J = J.permute(0, 3, 2, 1, 4)
        flat, weighted = J.reshape(-1, 3, 2 * n), (J * curvature[:, :, None, None]).reshape(-1, 3, 2 * n)
        pull = (r * weights[:, None]).transpose(1, 2).reshape(-1, 2 * n, 1)
        A, g = torch.bmm(weighted, flat.mT).double(), torch.bmm(flat, pull).double()
        return (X + damped_solve(A, g).view(*views.batch, 3)).to(x.dtype)


class _Views:
    """Images of points as rows (problem, image coordinate, point, n); several points of the same data share the cameras.

    Attributes:
        batch: The batch dimensions of the answer.
        x: Measurements, (problem, 2, 1, n).
        rows: The cameras, (problem, 3, 4, n).
        image: The first two homogeneous coordinates of the images.
        depth: The third.
        z: The third made positive.
        inverse: 1 over it.
    """

    def __init__(self, X: Tensor, x: Tensor, P: Tensor) -> None:
        n = x.shape[-2]
        data = broadcast_shapes(x.shape[:-2], P.shape[:-2])
        self.batch = broadcast_shapes(X.shape[:-1], data)
        shared = bool(self.batch) and (not data or data[-1] == 1)
        lead, k = (self.batch[:-1], self.batch[-1]) if shared else (self.batch, 1)
        if shared:
            x, P = (d[..., 0, :, :] if d.ndim > 2 else d for d in (x, P))
        size = prod(lead)
        self.x = x.mT.expand(*lead, 2, n).reshape(size, 2, 1, n)
        self.rows = P.mT.expand(*lead, 12, n).reshape(size, 3, 4, n)
        X = X.expand(*self.batch, 3).reshape(size, 1, k, 3, 1)
        column = self.rows.unsqueeze(3).unbind(2)
        y = column[3]
        for j in range(3):
            y = torch.addcmul(y, column[j], X[:, :, :, j])
        self.image, self.depth = y[:, :2], y[:, 2]
        self.z, inverse = positive_depth(self.depth)
        self.inverse = inverse[:, None]


@dataclass(frozen=True)
class RobustTriangulation:
    """Points and which of their observations they agree with.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_intrinsics(6, generator=g) @ torchsfm.random_poses(6, generator=g).matrix()
        >>> X = torchsfm.random_points(100, generator=g)
        >>> x = torchsfm.project_points(P, X) + 0.5 * torch.randn(6, 100, 2, generator=g)  # pixels
        >>> x[5] += 50  # wrong in the last view
        >>> found = torchsfm.triangulate_points_robust(x, P, threshold=3.0, generator=g)
        >>> bool((found.status == torchsfm.Status.OK).all()), found.inliers[5].any()
        (True, tensor(False))
        >>> sigma = 0.5 * found.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()  # the covariance is for noise of a pixel
        >>> bool(0.8 < ((found.model - X).norm(dim=-1) / sigma).square().mean().sqrt() < 1.2)
        True
    """

    model: Float[Tensor, "*batch n 3"]
    """The points, finite always; where `status` is not OK they may mean little."""
    inliers: Bool[Tensor, "*batch v n"]
    """Of which observations the point is the least squares: those of the search that are nearer than the threshold to its
    image, too."""
    support: Float[Tensor, "*batch n"]
    """Sum over the views of max(0, 1 - squared distance / squared threshold)."""
    threshold: Float[Tensor, "*batch n"]
    """The largest distance of an inlier, given or estimated."""
    iterations: Int[Tensor, "*batch n"]
    """Number of pairs of views tried."""
    status: Int[Tensor, "*batch n"]
    """OK; TOO_FEW: fewer than two observations; NOT_FINITE: fewer than two finite ones; DEGENERATE: no two rays meet at an
    angle; NO_CONSENSUS: no two views, or of three and more no three, agree on a point; else what `triangulate_points` says of
    the inliers."""
    parallax: Float[Tensor, "*batch n"]
    """The largest angle between two rays of inliers, in radians; zero where `status` is not OK."""
    covariance: Float[Tensor, "*batch n 3 3"]
    """Of the point, for independent noise of variance 1 / weight in every image coordinate of the inliers (1 pixel where no
    weights are given): two views say little about the noise, so it is up to the caller to multiply by its variance, of
    which the mean of `error` squared over many points tells. Zero where `status` is not OK."""
    error: Float[Tensor, "*batch n"]
    """Root-mean-square distance (weighted) between the inliers and the point's images, in pixels; zero where not OK."""


def triangulate_points_robust(
    x: Float[Tensor, "*#batch v n 2"],
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    threshold: float | Float[Tensor, "*#batch n"] | None,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    **options: Unpack[SearchOptions],
) -> RobustTriangulation:
    """Points from their images in known views, of which some may be wrong.

    LO-RANSAC over pairs of views, for all points at once, each with its own views; then the least squares of
    `triangulate_points` over the views that agree. With two views nothing can be called wrong but a distance beyond the
    threshold.

    Cameras per point (ragged tracks): let the points be the batch, `x (p, v, 1, 2)` and `P (p, v, 3, 4)`.

    Args:
        x: Image points, in the pixels of the cameras.
        P: Cameras `K [R | t]`, of any scale and sign.
        threshold: Largest reprojection error of an inlier, in pixels. None where it is not known: more than half of the
            observations of each point must then be right (`LeastMedian`), and there should be many.
        visible: Which views see which point; all by default. Observations that are not finite are left out too.
        **options: See `SearchOptions`; a datum is an observation, and there are at most 256 pairs for a point.

    Returns:
        The points with their inliers, support, iterations, status, parallax, covariance and error. The points carry their
        derivatives with respect to the inliers, their weights and the cameras: those of the least squares over the inliers.
        They are zero where the status is not OK.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(100, generator=g), torchsfm.random_poses(6, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> x[5] += 0.5  # all wrong in the last view
        >>> found = torchsfm.triangulate_points_robust(x, P, threshold=0.01, generator=g)
        >>> bool(found.model.allclose(X)), found.inliers.sum(1)
        (True, tensor([100, 100, 100, 100, 100,   0]))
    """
    own = {"x": (x, "v n 2"), "P": (P, "v 3 4"), "visible": (visible, "?v n: bool")}
    batch = check_door(own, threshold, options, SearchOptions, of_problem="n", of_datum="v n")
    dtype, (v, n) = x.dtype, x.shape[-3:-1]
    x, P = x.double(), P.double()
    sign = torch.where(torch.linalg.det(P[..., :3]) < 0, -1.0, 1.0).to(P.dtype)
    scale = sign / P[..., 2, :3].norm(dim=-1)
    data = (P * scale[..., None, None]).flatten(-2).detach()

    def by_point(t: Tensor | None) -> Tensor | None:
        return None if t is None else t.detach().expand(*batch, v, n).mT

    weights = options.get("weights")
    weights = None if weights is None else weights.double()
    quality = options.get("quality")
    of_data = {"mask": visible, "weights": weights, "quality": None if quality is None else quality.double()}
    every: Any = {"max_iterations": 256} | options | {name: by_point(t) for name, t in of_data.items()}
    limit = threshold.double().expand(*batch, n) if isinstance(threshold, Tensor) else threshold
    found = ransac(
        PointEstimator(), x.detach().expand(*batch, v, n, 2).transpose(-3, -2), data[..., None, :, :].expand(*batch, n, v, 12),
        threshold=limit, min_iterations=16, **every,
    )  # fmt: skip
    final, inliers = solve_agreed(
        lambda x, P, used, w: triangulate_points(x, P, visible=used, weights=w), _distances, x, 1, P, found.inliers.mT,
        weights, found.threshold,
    )  # fmt: skip
    number = inliers.sum(-2)
    seen = torch.isfinite(x).all(-1) & torch.isfinite(data).all(-1)[..., None]
    seen = seen if visible is None else seen & visible
    seen = seen if weights is None else seen & (weights > 0)
    # Two views agree by chance where their rays happen to meet, so out of more than two a third must confirm them.
    agreed = (number >= 2) & ((number >= 3) | (seen.sum(-2) == 2))
    status = torch.where((found.status == Status.NO_CONSENSUS) & agreed, int(Status.OK), found.status)
    status = torch.where((status == Status.OK) & ~agreed, int(Status.NO_CONSENSUS), status)
    status = torch.where(status == Status.OK, final.status, status)
    settled = status == Status.OK

    return RobustTriangulation(
        model=torch.where(settled[..., None], final.model, found.model).to(dtype),
        inliers=inliers,
        support=found.support.clamp(max=torch.finfo(dtype).max).to(dtype),
        threshold=found.threshold.to(dtype),
        iterations=found.iterations,
        status=status,
        parallax=torch.where(settled, final.parallax, 0).to(dtype),
        covariance=torch.where(settled[..., None, None], final.covariance, 0).to(dtype),
        error=torch.where(settled, final.error, 0).to(dtype),
    )


def _distances(found: Triangulation, x: Tensor, P: Tensor) -> Tensor:
    """Reprojection errors."""
    return reprojection_distance(P.detach(), found.model.detach()[..., None, :, :], x.detach())
