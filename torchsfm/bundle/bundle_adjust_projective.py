"""Bundle adjustment of projective cameras and points: nothing is known of the calibration."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_index, check_one_problem, check_options
from torchsfm.geometry import normalize_sphere
from torchsfm.geometry.projection import camera_slopes, point_slopes
from torchsfm.geometry.radial import flatten
from torchsfm.linalg import eigh, inverse, svdvals
from torchsfm.optim import Block, Loss, Term, UnitSphere, sparse_levenberg_marquardt
from torchsfm.optim.sparse_derivative import Hessian


@dataclass(frozen=True)
class ProjectiveBundleResult:
    """What projective bundle adjustment found.

    `P` and `X` keep the norm each of them came with, and their signs follow from the start without a jump. `residuals` are
    distances in the image, pixels, inf where `used` is False: weight 0, or not finite at the start. `cost` and `initial_cost`
    are `sum w rho(residual^2) / 2`. `status` is as in `BundleResult`.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(20, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> P = torchsfm.random_intrinsics(3, generator=g) @ P
        >>> x, view, point = torchsfm.project_points(P, X).flatten(0, 1), torch.arange(3), torch.arange(20)
        >>> x[7] = torch.nan  # not seen
        >>> seen = (x, view.repeat_interleave(20), point.repeat(3))
        >>> found = torchsfm.bundle_adjust_projective(P, torchsfm.to_homogeneous(X), *seen)
        >>> found.P.shape, found.X.shape, int(found.used.sum()), found.cost < 1e-9
        (torch.Size([3, 3, 4]), torch.Size([20, 4]), 59, True)
    """

    P: Float[Tensor, "v 3 4"]
    X: Float[Tensor, "n 4"]
    cost: float
    initial_cost: float
    residuals: Float[Tensor, "m"]
    used: Bool[Tensor, "m"]
    iterations: int
    """Steps tried."""
    status: Status


def bundle_adjust_projective(
    P: Float[Tensor, "v 3 4"],
    X: Float[Tensor, "n 4"],
    x: Float[Tensor, "m 2"],
    view: Int[Tensor, "m"],
    point: Int[Tensor, "m"],
    *,
    fixed_cameras: Bool[Tensor, "v"] | None = None,
    fixed_points: Bool[Tensor, "n"] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
    hessian: Hessian = "exact",
    progress: Callable[[int, float], bool | None] | None = None,
) -> ProjectiveBundleResult:
    """Minimise the reprojection error over projective cameras and points (HZ 18.1; Triggs et al. 2000).

    Cameras and points are homogeneous and move on spheres, so points at infinity are like any others. The 15 dimensions of the
    projective frame are free unless enough is fixed; the damping then takes the shortest step. The answer does not depend on
    the frame given: inside, image points are centred and scaled view by view, and space is moved to the frame in which the
    points, as unit vectors, are spread evenly over all directions (Tyler 1987). Residuals and cost are those in the image all
    the same. Depths may have any sign; a step does not carry a point through the focal plane of a camera that sees it, since
    the cost is infinite there: start where the depths `P X` of each point, and of each camera, can be made positive by signs.
    Computed in float64.

    Args:
        P: Cameras, up to scale.
        X: Homogeneous points, up to scale.
        x: Observations, pixels.
        view: Which camera made each observation.
        point: Which point it shows.
        fixed_cameras: Cameras that do not change.
        fixed_points: Points that do not move.
        weights: Weight of each observation's squared distance; 0 leaves it out.
        loss: Robust loss of the squared distance (see `torchsfm.optim`), squares if not given.
        max_iterations: Most steps tried.
        tolerance: End when a step lowers the cost by less than this fraction.
        hessian: Used for derivatives only, as in `bundle_adjust`.
        progress: Called with the number of steps and the cost after each; False, or an interrupt, ends it with the best so far.

    Returns:
        Cameras and points in the frame and dtype given; those fixed or not observed bit for bit. Where observations, weights or
        fixed cameras or points require a gradient, the result carries its derivatives (implicit function theorem).

    Raises:
        ValueError: Shapes, dtypes or indices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(20, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> P = torchsfm.random_intrinsics(3, generator=g) @ P
        >>> x, view, point = torchsfm.project_points(P, X), torch.arange(3), torch.arange(20)
        >>> observations = (x.flatten(0, 1), view.repeat_interleave(20), point.repeat(3))
        >>> start = P + 1e-3 * P.abs() * torch.randn(3, 3, 4, generator=g)
        >>> X = torchsfm.geometry.to_homogeneous(X)
        >>> found = torchsfm.bundle_adjust_projective(start, X, *observations)
        >>> found.status.name, bool(found.residuals.max() < 0.1)  # pixels
        ('OK', True)
    """
    check_one_problem(
        P=(P, "v 3 4"),
        X=(X, "n 4"),
        x=(x, "m 2"),
        view=(view, "m: int"),
        point=(point, "m: int"),
        fixed_cameras=(fixed_cameras, "?v: bool"),
        fixed_points=(fixed_points, "?n: bool"),
        weights=(weights, "?m"),
    )
    check_options(loss=(loss, Callable | None), tolerance=(tolerance, "float >= 0"))
    check_index(view=(view, P.shape[0]), point=(point, X.shape[0]))
    with torch.no_grad():
        image, scale = _image_frames(x.double(), view, P.shape[0])
        observed = X.detach().double()[torch.unique(point)]
        space = _space_frame(observed)
        (image_back, _), (space_back, _) = inverse(image), inverse(space)
    cameras = normalize_sphere((image @ P.double() @ space_back).flatten(1))
    points = normalize_sphere(X.double() @ space.mT)
    # Vectors that are no cameras or points become NaN again, so that their observations are left out.
    cameras = torch.where(_is_vector(P.flatten(1)), cameras, torch.nan)
    points = torch.where(_is_vector(X), points, torch.nan)
    blocks = {
        "camera": Block(cameras, UnitSphere(12), fixed_cameras),
        "point": Block(points, UnitSphere(4), fixed_points),
    }
    own = image[view]
    moved = x.double() * own[:, 0, 0, None] + own[:, :2, 2]
    term = Term(_residual, ("camera", "point"), (view, point), (moved, scale[view]), loss, weights, _linearize)
    result = sparse_levenberg_marquardt(
        blocks,
        [term],
        eliminate="point",
        max_iterations=max_iterations,
        function_tolerance=tolerance,
        hessian=hessian,
        progress=progress,
    )
    used = result.used[0]
    distance = torch.linalg.vector_norm(result.residuals[0], dim=-1)
    back = image_back @ result.x["camera"].reshape(-1, 3, 4) @ space
    return ProjectiveBundleResult(
        _keep(P, back, (cameras != result.x["camera"]).any(-1), fixed_cameras),
        _keep(X, result.x["point"] @ space_back.mT, (points != result.x["point"]).any(-1), fixed_points),
        result.cost,
        result.initial_cost,
        torch.where(used, distance, torch.inf).to(X.dtype),
        used,
        result.iterations,
        result.status,
    )


def _residual(camera: Tensor, point: Tensor, x: Tensor, scale: Tensor) -> Tensor:
    """Predicted minus measured image points, pixels; finite for all finite cameras and points."""
    uv, _ = flatten(_seen(camera.mT.reshape(3, 4, -1), point.mT))
    return ((uv - x.mT) * scale).mT


def _linearize(camera: Tensor, point: Tensor, x: Tensor, scale: Tensor, out: list[Tensor | None]) -> Tensor:
    """Residuals; `out` gets their derivatives by steps on the spheres, in the tangent basis of `UnitSphere`."""
    P, X = camera.mT.reshape(3, 4, -1), point.mT
    uv, inverse = flatten(_seen(P, X))
    by_camera, by_point = (None if o is None else o.permute(1, 2, 0) for o in out)
    slope = inverse * scale
    if by_camera is not None:
        _on_sphere(camera.mT, camera_slopes(X, uv, slope).flatten(1, 2), by_camera)
    if by_point is not None:
        _on_sphere(X, point_slopes(P, uv, slope), by_point)
    return ((uv - x.mT) * scale).mT


def _seen(P: Tensor, X: Tensor) -> Tensor:
    """Homogeneous images (3, m) of points (4, m) in cameras (3, 4, m)."""
    p0, p1, p2, p3 = P.unbind(1)
    return torch.addcmul(torch.addcmul(torch.addcmul(p0 * X[0], p1, X[1]), p2, X[2]), p3, X[3])


def _on_sphere(unit: Tensor, slope: Tensor, out: Tensor) -> None:
    """Derivatives `slope` (2, k, m) by unit vectors (k, m) in the Householder basis of `UnitSphere` there, into (2, k - 1, m).

    For functions that do not change along the vector itself.
    """
    last = unit[-1]
    turn = torch.where(last < 0, -1.0, 1.0) / (1 + last.abs())
    torch.addcmul(slope[:, :-1], unit[:-1], (slope[:, -1] * turn)[:, None], value=-1, out=out)


def _is_vector(v: Tensor) -> Tensor:
    return (v.isfinite().all(-1) & (v != 0).any(-1))[:, None]


def _image_frames(x: Tensor, view: Tensor, views: int) -> tuple[Tensor, Tensor]:
    """For each view the similarity to centred points at a root mean square distance of sqrt(2), and its inverse's scale."""
    good = x.isfinite().all(-1)
    x, view = x[good], view[good]
    count = torch.bincount(view, minlength=views).clamp_min(1)[:, None]
    centre = x.new_zeros((views, 2)).index_add_(0, view, x) / count
    away = (x - centre[view]).square().sum(-1)
    spread = (x.new_zeros(views).index_add_(0, view, away) / (2 * count[:, 0])).sqrt()
    # A view with one observation has no spread of its own.
    spread = torch.where(spread > 1e-9 * (1 + centre.abs().amax(-1)), spread, (1 + centre.abs().amax(-1)))
    T = torch.diag_embed(torch.stack((1 / spread, 1 / spread, torch.ones_like(spread)), -1))
    T[:, :2, 2] = -centre / spread[:, None]
    return T, spread


def _space_frame(X: Tensor) -> Tensor:
    """The transformation after which points as unit vectors have second moments I / 4 (Tyler's fixed point).

    Points that span less than space leave it as far as they go.
    """
    X = normalize_sphere(X[X.isfinite().all(-1)])
    eye = torch.eye(4, dtype=X.dtype, device=X.device)
    H = eye
    for _ in range(20):
        moved = normalize_sphere(X @ H.mT)
        moment = 4 * (moved.mT @ moved) / max(len(X), 1)
        values, vectors, _ = eigh(moment)
        step = vectors @ torch.diag(values.clamp_min(1e-6).rsqrt()) @ vectors.mT
        H = step @ H
        H = H / torch.linalg.matrix_norm(H)
        if bool((moment - eye).abs().max() < 1e-2):
            break
    # Planes, lines and points of data would squeeze what they do not span without end.
    values, _ = svdvals(H)
    return H if bool(values[0] < 1e12 * values[-1]) else eye


def _keep(before: Tensor, after: Tensor, moved: Tensor, fixed: Tensor | None) -> Tensor:
    """New values with the old norms; what did not move keeps every bit."""
    rows = tuple(range(1, before.ndim))
    norm = torch.linalg.vector_norm(before.detach(), dim=rows, keepdim=True).double()
    scaled = after * (norm / torch.linalg.vector_norm(after, dim=rows, keepdim=True))
    if fixed is not None:
        moved = moved & ~fixed
    return torch.where(moved.reshape(-1, *(1,) * len(rows)), scaled.to(before.dtype), before)
