"""Bundle adjustment of points, poses and cameras."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.bundle.checks import check_index
from torchsfm.bundle.projection import Projection, camera_from_rows, camera_rows, free_columns
from torchsfm.geometry import Camera, Pose
from torchsfm.optim import Block, Loss, RigidMotion, Subset, Term, sparse_levenberg_marquardt
from torchsfm.optim.sparse_derivative import Hessian


@dataclass(frozen=True)
class BundleResult:
    """What bundle adjustment found.

    `residuals` are distances in the image, pixels, inf where `used` is False: weight 0, or not finite at the start (a NaN
    coordinate, a camera or point that is not finite). `cost` and `initial_cost` are `sum w rho(residual^2) / 2` (and priors).
    `status`: `OK` where a tolerance was met, `NOT_CONVERGED` where the iteration limit came first, `TOO_FEW` where nothing
    was free and observed, `NOT_FINITE` where no observation could be used.
    """

    poses: Pose
    cameras: Camera
    X: Float[Tensor, "n 3"]
    cost: float
    initial_cost: float
    residuals: Float[Tensor, "m"]
    used: Bool[Tensor, "m"]
    iterations: int
    status: Status


def bundle_adjust(
    poses: Pose,
    cameras: Camera,
    X: Float[Tensor, "n 3"],
    x: Float[Tensor, "m 2"],
    view: Int[Tensor, "m"],
    point: Int[Tensor, "m"],
    *,
    camera_index: Int[Tensor, "v"] | None = None,
    free: Sequence[str] = ("focal",),
    fixed_poses: Bool[Tensor, "v"] | None = None,
    fixed_points: Bool[Tensor, "n"] | None = None,
    fixed_cameras: Bool[Tensor, "g"] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    loss: Loss | None = None,
    intrinsics_sigma: Mapping[str, float] | None = None,
    intrinsics_mean: Camera | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
    hessian: Hessian = "exact",
    progress: Callable[[int, float], None] | None = None,
) -> BundleResult:
    """Minimise the reprojection error over poses, cameras and points together (Triggs et al. 2000; HZ 18.1).

    Points are eliminated by the Schur complement. Seven dimensions of gauge (place, orientation, size of the world) are free
    unless `fixed_poses` or `fixed_points` holds them; the damping then takes the shortest step, and the model stays about
    where it was. Fixed and unobserved poses, cameras and points come back bit for bit. Observations behind a camera count by
    the formula (a pinhole shows them mirrored): leave them out, or use a loss. Computed in float64.

    Args:
        poses: Camera from world, batch (v,).
        cameras: Intrinsics and distortion, batch (g,).
        X: Points in the world.
        x: Observations, pixels.
        view: Which view made each observation.
        point: Which point it shows.
        camera_index: Which camera took each view. If not given: one camera for all views, or one for each.
        free: What is optimised in the cameras: any of "focal" (one scale of fx and fy), "aspect", "principal_point", "skew",
            and names of distortion parameters; empty for known intrinsics.
        fixed_poses: Views that do not move.
        fixed_points: Points that do not move.
        fixed_cameras: Cameras that do not change.
        weights: Weight of each observation's squared distance; 0 leaves it out.
        loss: Robust loss of the squared distance (see `torchsfm.optim`), squares if not given.
        intrinsics_sigma: Standard deviations of Gaussian priors on free intrinsics, by the names in `free`, as a fraction of
            the mean for "focal" and absolute otherwise. An observation's distance counts in units of 1 pixel.
        intrinsics_mean: Where the priors are centred; the cameras given if not given.
        max_iterations: Most steps tried.
        tolerance: End when a step lowers the cost by less than this fraction.
        hessian: Used for derivatives only: "exact", or "gauss-newton", cheaper and some percent off where residuals are large.
        progress: Called with the number of steps and the cost after each.

    Returns:
        The adjusted poses, cameras and points, in the dtype given, with costs and residuals. Where observations, weights, or
        fixed poses, cameras or points require a gradient, the results carry their derivatives by the implicit function theorem
        (first derivatives; with a free gauge, those of the solution that moves least).

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.
    """
    fixed = (fixed_poses, fixed_points, fixed_cameras)
    index = check_bundle(poses, cameras, X, x, view, point, camera_index, *fixed, weights)
    blocks, term = bundle_problem(poses, cameras, X, x, view, point, index, free, *fixed, weights, loss)
    terms = [term]
    model, rows = type(cameras.distortion), blocks["camera"].x
    if intrinsics_sigma:
        terms.append(_prior(intrinsics_sigma, rows if intrinsics_mean is None else camera_rows(intrinsics_mean), model))
    result = sparse_levenberg_marquardt(
        blocks,
        terms,
        eliminate="point",
        max_iterations=max_iterations,
        function_tolerance=tolerance,
        hessian=hessian,
        progress=progress,
    )
    used = result.used[0]
    distance = torch.linalg.vector_norm(result.residuals[0], dim=-1)
    return BundleResult(
        _moved_poses(poses, blocks["pose"].x, result.x["pose"]),
        _moved_cameras(cameras, rows, result.x["camera"]),
        result.x["point"],
        result.cost,
        result.initial_cost,
        torch.where(used, distance, torch.inf).to(X.dtype),
        used,
        result.iterations,
        result.status,
    )


def bundle_problem(
    poses: Pose,
    cameras: Camera,
    X: Tensor,
    x: Tensor,
    view: Tensor,
    point: Tensor,
    camera_index: Tensor,
    free: Sequence[str],
    fixed_poses: Tensor | None,
    fixed_points: Tensor | None,
    fixed_cameras: Tensor | None,
    weights: Tensor | None,
    loss: Loss | None,
) -> tuple[dict[str, Block], Term]:
    """The variables of a bundle, "pose", "camera" and "point", and its reprojection term."""
    model = type(cameras.distortion)
    columns = free_columns(free, model)
    rows = camera_rows(cameras)
    blocks = {
        "pose": Block(torch.cat((_orthonormal(poses.R.double()).flatten(1), poses.t.double()), 1), RigidMotion(), fixed_poses),
        "camera": Block(rows, Subset(rows.shape[1], columns), fixed_cameras),
        "point": Block(X, None, fixed_points),
    }
    skew = 4 in columns or cameras.K.requires_grad or bool((rows[:, 4] != 0).any())
    projection = Projection(model, columns, skew)
    index = (view, camera_index[view], point)
    return blocks, Term(projection.residual, tuple(blocks), index, (x,), loss, weights, projection.linearize)


def _prior(sigma: Mapping[str, float], mean: Tensor, model: type) -> Term:
    columns, scales = [], []
    for name, value in sigma.items():
        for column in free_columns((name,), model):
            columns.append(column)
            scales.append(mean[:, column].abs() * value if name == "focal" else torch.full_like(mean[:, column], value))
    picked = torch.tensor(columns, device=mean.device)
    camera = torch.arange(mean.shape[0], device=mean.device)
    return Term(
        lambda camera, mean, scale: (camera[:, picked] - mean) / scale,
        ("camera",),
        (camera,),
        (mean[:, picked], torch.stack(scales, -1)),
    )


def _orthonormal(R: Tensor) -> Tensor:
    """The nearest rotations, by two Newton steps for the polar factor.

    Rotations that come rounded (float32, text files) would make scale a direction in which the cost still falls a little.
    """
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    near = (R.mT @ R - eye).abs().amax((-2, -1), keepdim=True) < 0.1
    turned = R
    for _ in range(2):
        turned = turned @ (1.5 * eye - 0.5 * (turned.mT @ turned))
    return torch.where(near, turned, R)


def _moved_poses(poses: Pose, start: Tensor, end: Tensor) -> Pose:
    """Poses that did not move keep every bit."""
    moved = (start != end).any(-1)
    new = end.to(poses.t.dtype)
    R = torch.where(moved[:, None, None], new[:, :9].reshape(-1, 3, 3), poses.R)
    return Pose(R, torch.where(moved[:, None], new[:, 9:], poses.t))


def _moved_cameras(cameras: Camera, start: Tensor, end: Tensor) -> Camera:
    """Cameras that did not change keep every bit of K."""
    changed = (start != end).any(-1)
    new = camera_from_rows(end, type(cameras.distortion))
    return Camera(torch.where(changed[:, None, None], new.K, cameras.K), new.distortion)


def check_bundle(
    poses: Pose,
    cameras: Camera,
    X: Tensor,
    x: Tensor,
    view: Tensor,
    point: Tensor,
    camera_index: Tensor | None,
    fixed_poses: Tensor | None,
    fixed_points: Tensor | None,
    fixed_cameras: Tensor | None,
    weights: Tensor | None,
) -> Tensor:
    """Check shapes and indices; return the camera of each view."""
    if len(poses.shape) != 1 or len(cameras.shape) != 1:
        raise ValueError(f"poses, cameras: wanted one batch dimension each, got {tuple(poses.shape)}, {tuple(cameras.shape)}")
    batch = check_tensors(
        poses=(poses.R, "v 3 3"),
        cameras=(cameras.K, "g 3 3"),
        X=(X, "n 3"),
        x=(x, "m 2"),
        view=(view, "m: int"),
        point=(point, "m: int"),
        camera_index=(camera_index, "v: int"),
        fixed_poses=(fixed_poses, "v: bool"),
        fixed_points=(fixed_points, "n: bool"),
        fixed_cameras=(fixed_cameras, "g: bool"),
        weights=(weights, "m"),
    )
    if batch:
        raise ValueError(f"wanted one problem without batch dimensions, got batch {tuple(batch)}")
    views, groups = poses.shape[0], cameras.shape[0]
    if camera_index is None:
        if groups not in (1, views):
            raise ValueError(
                f"camera_index: wanted the camera of each view, since there are {groups} cameras and {views} views"
            )
        camera_index = torch.arange(views, device=X.device) if groups == views else view.new_zeros(views)
    check_index(view=(view, views), point=(point, X.shape[0]), camera_index=(camera_index, groups))
    return camera_index
