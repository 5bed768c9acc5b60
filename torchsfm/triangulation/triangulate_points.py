"""Optimal triangulation: the point with the smallest sum of squared reprojection errors."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options
from torchsfm.geometry.projection import quotient_slope
from torchsfm.optim import wants_derivative
from torchsfm.triangulation.observations import Observations, in_pieces, row_dot
from torchsfm.triangulation.optimal_correction import fundamental_rows, lindstrom
from torchsfm.triangulation.symmetric import inverse, symmetric, tangent_step
from torchsfm.triangulation.triangulate_points_dlt import euclidean, linear_points


@dataclass(frozen=True)
class Triangulation:
    """Points and what is known about them.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.tensor([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]).double()  # two cameras side by side
        >>> pose = torchsfm.Pose(torch.eye(3).double().expand(2, 3, 3), t)
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])).double()
        >>> P = K @ pose.matrix()
        >>> X = torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 50.0], [0.0, 0.0, -5.0]]).double()
        >>> found = torchsfm.triangulate_points(torchsfm.project_points(P, X), P)
        >>> found.in_front, found.parallax.rad2deg().round()
        (tensor([ True,  True, False]), tensor([11.,  1., 11.], dtype=torch.float64))
        >>> found.covariance[:2, 2, 2].sqrt()  # ten times as far, a hundred times less sure in depth
        tensor([0.0442, 4.4194], dtype=torch.float64)
    """

    model: Float[Tensor, "*batch n 3"]
    """The points, finite always; where `status` is not OK they may mean little."""
    status: Int8[Tensor, "*batch n"]
    """OK; NOT_FINITE: a wanted observation is not finite; TOO_FEW: fewer than two observations; DEGENERATE: the rays
    coincide or are parallel (no baseline, a point at infinity); BEHIND: not in front of all views that see it;
    NOT_CONVERGED."""
    in_front: Bool[Tensor, "*batch n"]
    """In front of every camera that sees it."""
    parallax: Float[Tensor, "*batch n"]
    """The largest angle between two of its viewing rays, in radians."""
    covariance: Float[Tensor, "*batch n 3 3"]
    """Of the point, for independent noise of variance 1 / weight in every image coordinate (1 pixel where no weights
    are given); zero where the data do not determine it."""
    error: Float[Tensor, "*batch n"]
    """Root-mean-square distance (weighted) between the observations and the point's images, in pixels."""


def triangulate_points(
    x: Float[Tensor, "*#batch v n 2"],
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    weights: Float[Tensor, "*#batch v n"] | None = None,
    max_iterations: int = 30,
) -> Triangulation:
    """Points from their images in known views, by least squares on reprojection errors.

    From the linear start, every point is refined by Levenberg-Marquardt over the sphere of homogeneous points, in a
    world moved and scaled to the cameras, so that far points are as well-behaved as near ones. With two views the start
    is the optimal correction of Lindstrom ("Triangulation made easy", CVPR 2010, two iterations), which leads to the
    global optimum of Hartley & Sturm. With more views the optimum is the local one next to the linear solution.

    Computed in float64 whatever comes in. The derivative of `model` with respect to observations, cameras and weights
    is that of the optimum (implicit function theorem with the exact Hessian); `parallax`, `covariance` and `error`
    follow from it.

    Cameras per point (ragged tracks): let the points be the batch, `x (p, v, 1, 2)` and `P (p, v, 3, 4)`.

    Args:
        x: Image points, in the pixels of the cameras.
        P: Cameras `K [R | t]` or projective ones, of any scale and sign.
        visible: Which views see which point; all by default.
        weights: Factors of the squared distances (inverse variances), 0 for absent.
        max_iterations: Of Levenberg-Marquardt, for each point.

    Returns:
        The points with status, cheirality, parallax, covariance and error.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(100, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> found = torchsfm.triangulate_points(torchsfm.project_points(P, X), P)
        >>> bool(found.model.allclose(X)), bool((found.status == torchsfm.Status.OK).all())
        (True, True)
    """
    check_options(max_iterations=(max_iterations, "int >= 0"))

    def solve(data: Observations) -> tuple[Tensor, ...]:
        return _solve(data, max_iterations)

    model, status, in_front, parallax, covariance, error = in_pieces(solve, x, P, visible, weights)
    return Triangulation(
        model.movedim(0, -1).to(x.dtype),
        status,
        in_front,
        parallax.to(x.dtype),
        covariance.movedim((0, 1), (-2, -1)).to(x.dtype),
        error.to(x.dtype),
    )


def _solve(data: Observations, max_iterations: int) -> tuple[Tensor, ...]:
    """Model, status, in_front, parallax, covariance and error of one piece."""
    fixed = _detached(data)
    with torch.no_grad():
        X = linear_points(_corrected(fixed))
        X = X * fixed.facing(X)
        X, found = _minimise(fixed, X, max_iterations)
        X = X * fixed.facing(X)
        system = _System(fixed, X)
        trace = system.trace()
        _, decrease, _ = tangent_step(X, system.hessian(), system.g)
        converged = found & (decrease <= 1e-18 * trace)
        _, _, smallest = tangent_step(X, system.N, system.g)
        determined = fixed.apart & (smallest > 1e-14) & (X[3].abs() > 1e-9)
    if wants_derivative(*data.x, *(e for row in data.P for e in row), data.w):
        hessian, system = system.hessian(), _System(data, X)
        # A Newton step from the optimum leaves it where it is and carries the derivative.
        eye = torch.eye(4, dtype=X.dtype, device=X.device)[..., None, None]
        moved, _, _ = tangent_step(X, torch.where(determined, hessian, eye), torch.where(determined, system.g, 0.0))
        X = X + (moved - moved.detach())
        system = _System(data, X)
    model = euclidean(data, X)

    depth = data.depths(X.detach()) * data.handed * torch.where(X.detach()[3] < 0, -1.0, 1.0)
    seen = data.w.detach() > 0
    in_front = ((depth > 0) | ~seen).all(0) & seen.any(0)
    weight = data.w.sum(0)
    some = weight > 0
    mean = torch.where(some, system.cost, 1.0) / torch.where(some, weight, 1.0)
    positive = some & (mean > 0)
    error = torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)

    status = torch.full(in_front.shape, int(Status.OK), dtype=torch.int8, device=X.device)
    for condition, code in (
        (~converged, Status.NOT_CONVERGED),
        (~in_front, Status.BEHIND),
        (~determined, Status.DEGENERATE),
        (seen.sum(0) < 2, Status.TOO_FEW),
        (data.broken, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    return model, status, in_front, _parallax(data, X), _covariance(data, X, system.N, determined), error


def _detached(data: Observations) -> Observations:
    rows = tuple(tuple(e.detach() for e in row) for row in data.P)
    return Observations(
        (data.x[0].detach(), data.x[1].detach()),
        rows,
        data.w.detach(),
        tuple(c.detach() for c in data.centre),
        data.handed,
        data.shift.detach(),
        data.scale.detach(),
        data.apart,
        data.broken,
    )


def _corrected(data: Observations) -> Observations:
    """Two views: the image points moved as little as makes their rays meet."""
    if data.w.shape[0] != 2:
        return data
    (u1, u2), (v1, v2) = data.x[0].unbind(0), data.x[1].unbind(0)
    first = tuple(tuple(e[0] for e in row) for row in data.P)
    second = tuple(tuple(e[1] for e in row) for row in data.P)
    # The correction weighs both images alike; other weights start from the linear solution.
    alike = data.w[0] == data.w[1]
    a1, b1, a2, b2 = lindstrom(fundamental_rows(first, second), u1, v1, u2, v2)
    use = alike & torch.isfinite(a1 + b1 + a2 + b2)
    u = torch.stack((torch.where(use, a1, u1), torch.where(use, a2, u2)))
    v = torch.stack((torch.where(use, b1, v1), torch.where(use, b2, v2)))
    return Observations((u, v), data.P, data.w, data.centre, data.handed, data.shift, data.scale, data.apart, data.broken)


class _System:
    """Residuals and their derivatives at homogeneous points: J'WJ as `N`, J'Wr as `g`, r'Wr as `cost`."""

    def __init__(self, data: Observations, X: Tensor) -> None:
        p1, p2, p3 = data.P
        z = row_dot(p3, X)
        tiny = z.detach().abs() < 1e-14
        inverse_z = 1 / torch.where(tiny, torch.where(z.detach() < 0, -1e-14, 1e-14), z)
        u, v = row_dot(p1, X) * inverse_z, row_dot(p2, X) * inverse_z
        e, f = u - data.x[0], v - data.x[1]
        we, wf = data.w * e, data.w * f
        ju = tuple(quotient_slope(p, r, u, inverse_z) for p, r in zip(p1, p3, strict=True))
        jv = tuple(quotient_slope(p, r, v, inverse_z) for p, r in zip(p2, p3, strict=True))
        wju, wjv = tuple(data.w * j for j in ju), tuple(data.w * j for j in jv)
        pulled = tuple(torch.addcmul(we * j, wf, k) for j, k in zip(ju, jv, strict=True))
        self._pulled, self._inverse_z, self._p3 = pulled, inverse_z, p3
        self.g = torch.stack([p.sum(0) for p in pulled])
        self.N = symmetric({(i, j): torch.addcmul(wju[i] * ju[j], wjv[i], jv[j]).sum(0) for i in range(4) for j in range(i, 4)})
        self.cost = (we * e + wf * f).sum(0)
        self.size = (data.w * (u * u + v * v)).sum(0)

    def trace(self) -> Tensor:
        """The trace of N."""
        return self.N[0, 0] + self.N[1, 1] + self.N[2, 2] + self.N[3, 3]

    def hessian(self) -> Tensor:
        """Half the exact Hessian of the cost."""
        b, p = tuple(pulled * self._inverse_z for pulled in self._pulled), self._p3
        return self.N - symmetric(
            {(i, j): torch.addcmul(b[i] * p[j], p[i], b[j]).sum(0) for i in range(4) for j in range(i, 4)}
        )


def _minimise(data: Observations, X: Tensor, max_iterations: int) -> tuple[Tensor, Tensor]:
    """Levenberg-Marquardt on the sphere, every point with its own damping and its own stop; then Newton's method."""
    damping = torch.full_like(X[0], 1e-6)
    found = torch.zeros_like(X[0], dtype=torch.bool)
    system = _System(data, X)
    N, g, cost = system.N, system.g, system.cost
    for _ in range(max_iterations):
        new, decrease, _ = tangent_step(X, N, g, damping)
        # Near enough for Newton's method when the step moves the images by no more than 1e-6 of what a unit of angle does.
        trace = N[0, 0] + N[1, 1] + N[2, 2] + N[3, 3]
        found = found | ((decrease <= 1e-12 * trace) & (damping < 1))
        if bool(found.all()):
            break
        system = _System(data, new)
        # What the cost cannot tell from rounding is no reason to refuse a step.
        rounding = 1e-15 * (cost * system.size).sqrt() + 1e-30 * system.size
        better = (system.cost <= cost + rounding) & ~found
        X = torch.where(better, new, X)
        N, g = torch.where(better, system.N, N), torch.where(better, system.g, g)
        cost = torch.where(better, system.cost, cost)
        damping = torch.where(better, damping * 0.1, damping * 10).clamp(1e-12, 1e12)
    for _ in range(2):
        system = _System(data, X)
        new, decrease, smallest = tangent_step(X, system.hessian(), system.g)
        near = found & (smallest > 1e-12) & (decrease <= 1e-9 * system.trace())
        X = torch.where(near, new, X)
    return X, found


def _parallax(data: Observations, X: Tensor) -> Tensor:
    """The largest angle between two viewing rays, from the longest chord between their directions."""
    c = data.centre
    rays = torch.stack([X[i] * c[3] - X[3] * c[i] for i in range(3)])
    # A ray from a finite centre points to the point; X[3] < 0 turns all of them.
    length2 = (rays * rays).sum(0)
    seen = (data.w > 0) & (length2.detach() > 0)
    rays = rays * torch.where(length2.detach() > 0, length2, 1.0).rsqrt()
    longest = torch.zeros_like(X[0])
    for i in range(1, rays.shape[1]):
        chord = rays[:, i : i + 1] - rays[:, :i]
        chord2 = torch.where(seen[i] & seen[:i], (chord * chord).sum(0), 0.0)
        longest = torch.maximum(longest, chord2.amax(0))
    positive = longest.detach() > 0
    half = 0.5 * torch.where(positive, longest, 1.0).sqrt()
    return torch.where(positive, 2 * torch.asin(half.clamp_max(1 - 1e-16)), 0.0)


def _covariance(data: Observations, X: Tensor, N: Tensor, determined: Tensor) -> Tensor:
    """The covariance (3, 3, problem, point) of the Euclidean point, zero where not determined."""
    trace = torch.where(determined, N[0, 0] + N[1, 1] + N[2, 2] + N[3, 3], 1.0)
    # N X = 0; a unit in that direction makes N regular and drops out again.
    outer = X[:, None] * X[None]
    eye = torch.eye(4, dtype=X.dtype, device=X.device)[..., None, None]
    M = (inverse(torch.where(determined, N / trace + outer, eye)) - outer) / trace
    # Through the derivative of X[:3] / X[3] with respect to the homogeneous point.
    w = torch.where(determined, X[3], 1.0)
    Y = X[:3] / w
    C = M[:3, :3] - Y[:, None] * M[3, :3] - M[:3, 3][:, None] * Y[None] + Y[:, None] * Y[None] * M[3, 3]
    factor = data.scale / w
    return torch.where(determined, C * (factor * factor), 0.0)
