"""Bundle adjustment of points, poses and cameras."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options
from torchsfm.bundle.blocks import Bundle, cheapest_elimination, moved_cameras, moved_poses
from torchsfm.bundle.gauge import Gauge, restore_gauge
from torchsfm.bundle.intrinsics import intrinsics_prior
from torchsfm.bundle.priors import Prior
from torchsfm.bundle.rig import Rig
from torchsfm.geometry import Camera, Pose
from torchsfm.optim import Loss, sparse_levenberg_marquardt
from torchsfm.optim.schur import Solver
from torchsfm.optim.sparse_derivative import Hessian


@dataclass(frozen=True)
class BundleResult:
    """What bundle adjustment found.

    `residuals` are distances in the image, pixels, inf where `used` is False: weight 0, or not finite at the start (a NaN
    coordinate, a camera or point that is not finite). `cost` and `initial_cost` are `sum w rho(residual^2) / 2` (and priors).
    `status`: `OK` where a tolerance was met, `NOT_CONVERGED` where the iteration limit came first, `INTERRUPTED` where it was
    stopped, `TOO_FEW` where nothing was free and observed, `NOT_FINITE` where no observation could be used.
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
    rig: Rig | None = None
    """The rig adjusted, where one was given."""


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
    fixed_poses: Bool[Tensor, "f"] | None = None,
    fixed_points: Bool[Tensor, "n"] | None = None,
    fixed_cameras: Bool[Tensor, "g"] | None = None,
    fixed_intrinsics: Mapping[str, Bool[Tensor, "g"]] | None = None,
    rig: Rig | None = None,
    fixed_sensors: Bool[Tensor, "k"] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    loss: Loss | None = None,
    intrinsics_sigma: Mapping[str, float | Tensor] | None = None,
    intrinsics_mean: Camera | None = None,
    priors: Sequence[Prior] = (),
    gauge: Gauge = "free",
    max_iterations: int = 50,
    tolerance: float = 1e-6,
    linear_solver: Solver = "auto",
    hessian: Hessian = "exact",
    progress: Callable[[int, float], bool | None] | None = None,
) -> BundleResult:
    """Minimise the reprojection error over poses, cameras and points together (Triggs et al. 2000; HZ 18.1).

    Points are eliminated by the Schur complement (poses, where there are many more poses than points). Seven dimensions of
    gauge (place, orientation, size of the world) are free unless something holds them: fixed poses or points, priors, a rig of
    known size (which holds the size). A free gauge does no harm: the damping takes the shortest step, and the model stays about
    where it was; see `gauge` for other wishes. Fixed and unobserved poses, cameras and points come back bit for bit.
    Observations behind a camera count by the formula (a pinhole shows them mirrored): leave them out, or use a loss. Computed
    in float64.

    Args:
        poses: Camera from world, batch (v,); with a rig, rig from world, batch (f,).
        cameras: Intrinsics and distortion, batch (g,).
        X: Points in the world.
        x: Observations, pixels.
        view: Which view made each observation.
        point: Which point it shows.
        camera_index: Which camera took each view. If not given: one camera for all views, or one for each.
        free: What is optimised in the cameras: any of "focal" (one scale of fx and fy), "aspect", "principal_point", "skew",
            and names of distortion parameters; empty for known intrinsics.
        fixed_poses: Poses that do not move.
        fixed_points: Points that do not move.
        fixed_cameras: Cameras that do not change.
        fixed_intrinsics: By names as in `free`, cameras in which these do not change, where they are free in others.
        rig: Which views were taken together: `cam_from_world = cam_from_rig rig_from_world`. `view` and `camera_index` go by
            views all the same.
        fixed_sensors: Sensors whose place on the rig does not change: all of a calibrated rig, or one of each rig, whose frame
            is then the rig's own (else damping decides that, too).
        weights: Weight of each observation's squared distance; 0 leaves it out.
        loss: Robust loss of the squared distance (see `torchsfm.optim`), squares if not given.
        intrinsics_sigma: Standard deviations of Gaussian priors on free intrinsics, by the names in `free`, as a fraction of
            the mean for "focal" and absolute otherwise, for all cameras or (g,) for each. An observation's distance counts in
            units of 1 pixel.
        intrinsics_mean: Where the priors are centred; the cameras given if not given.
        priors: What is known of poses and points: `CentrePrior`, `PosePrior`, `PointPrior`.
        gauge: "free"; or "first", which moves the adjusted world so that the first pose is what it was and the pose farthest
            from it keeps its distance. Only where nothing else holds the world.
        max_iterations: Most steps tried.
        tolerance: End when a step lowers the cost by less than this fraction.
        linear_solver: "dense", "pcg" (for thousands of cameras), or "auto"; see `sparse_levenberg_marquardt`.
        hessian: Used for derivatives only: "exact", or "gauss-newton", cheaper and some percent off where residuals are large.
        progress: Called with the number of steps and the cost after each; False, or an interrupt, ends it with the best so far.

    Returns:
        The adjusted poses, cameras and points, in the dtype given, with costs and residuals. Where observations, weights, or
        fixed poses, cameras or points require a gradient, the results carry their derivatives by the implicit function theorem
        (first derivatives; with a free gauge, those of the solution that moves least).

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.
    """
    bundle = Bundle(
        poses, cameras, X, x, view, point, camera_index, free, rig, fixed_poses, fixed_points, fixed_cameras,
        fixed_intrinsics, fixed_sensors, weights, loss, priors,
    )  # fmt: skip
    check_options(gauge=(gauge, ("free", "first")), intrinsics_sigma=(intrinsics_sigma, Mapping | None))
    held = priors or any(isinstance(mask, Tensor) and bool(mask.any()) for mask in (fixed_poses, fixed_points))
    if gauge == "first" and held:
        raise ValueError("gauge: wanted 'free' where something is fixed or known beforehand, got 'first'")
    blocks, terms = bundle.problem()
    if intrinsics_sigma:
        terms.append(intrinsics_prior(intrinsics_sigma, cameras if intrinsics_mean is None else intrinsics_mean))
    result = sparse_levenberg_marquardt(
        blocks,
        terms,
        eliminate=cheapest_elimination(blocks),
        max_iterations=max_iterations,
        function_tolerance=tolerance,
        linear_solver=linear_solver,
        hessian=hessian,
        progress=progress,
    )
    used = result.used[0]
    distance = torch.linalg.vector_norm(result.residuals[0], dim=-1)
    new_poses = moved_poses(poses, blocks["pose"].x, result.x["pose"])
    points = result.x["point"][:, :3].to(X.dtype)
    if rig is not None:
        rig = Rig(moved_poses(rig.cam_from_rig, blocks["sensor"].x, result.x["sensor"]), rig.sensor, rig.frame)
    if gauge == "first":
        keep_size = (
            rig is not None
            and fixed_sensors is not None
            and bool(fixed_sensors.any())
            and bool((rig.cam_from_rig.t[fixed_sensors] != 0).any())
        )
        moved = (points != X).any(-1)
        new_poses, points, rig = restore_gauge(poses, new_poses, points, moved, rig, keep_size)
    return BundleResult(
        new_poses,
        moved_cameras(cameras, blocks["camera"].x, result.x["camera"]),
        points,
        result.cost,
        result.initial_cost,
        torch.where(used, distance, torch.inf).to(X.dtype),
        used,
        result.iterations,
        result.status,
        rig,
    )
