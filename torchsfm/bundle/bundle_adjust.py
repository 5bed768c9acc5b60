"""Bundle adjustment of points, poses and cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status, check_options
from torchsfm.bundle.blocks import (
    Bundle,
    BundleTerms,
    cheapest_elimination,
    moved_cameras,
    moved_poses,
    structure_blocks,
)
from torchsfm.bundle.gauge import Gauge, restore_gauge
from torchsfm.bundle.rig import Rig
from torchsfm.bundle.structure import Structure
from torchsfm.geometry import BundleProblem, Camera, Pose
from torchsfm.optim import sparse_levenberg_marquardt
from torchsfm.optim.ranks import Group
from torchsfm.optim.solver_choice import Solver
from torchsfm.optim.sparse_derivative import Hessian


@dataclass(frozen=True)
class BundleResult:
    """What bundle adjustment found.

    `residuals` are distances in the image, pixels, inf where `used` is False: weight 0, or not finite at the start (a NaN
    coordinate, a camera or point that is not finite). `cost` and `initial_cost` are `sum w rho(residual^2) / 2` (and priors).
    `status`: `OK` where a tolerance was met, `NOT_CONVERGED` where the iteration limit came first, `INTERRUPTED` where it was
    stopped, `TOO_FEW` where nothing was free and observed, `NOT_FINITE` where no observation could be used.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.0, generator=g).problem
        >>> found = torchsfm.bundle_adjust(problem, free=("focal", "k1", "k2"), max_iterations=1)
        >>> found.status.name, found.cost < found.initial_cost  # there is more to gain
        ('NOT_CONVERGED', True)
        >>> found = torchsfm.bundle_adjust(problem, free=("focal", "k1", "k2"))
        >>> found.status.name, found.residuals.shape, bool(found.used.all())
        ('OK', torch.Size([150]), True)
    """

    poses: Pose
    """Of the views, or where a rig was given, of its frames."""
    cameras: Camera
    """The distinct cameras, batch (g,)."""
    X: Float[Tensor, "n 3"]
    """The points, in the world."""
    cost: float
    initial_cost: float
    residuals: Float[Tensor, "m"]
    used: Bool[Tensor, "m"]
    iterations: int
    """Steps tried."""
    status: Status
    rig: Rig | None = None
    """The rig adjusted, where one was given."""
    structure: tuple[Structure, ...] = ()
    """What was seen besides points, adjusted, in the order given."""
    structure_residuals: tuple[Float[Tensor, "_ _"], ...] = ()
    """Of each observation of it the residuals, inf where it does not count: of a segment the signed distances of both ends,
    pixels; of an ellipse five numbers in units of their standard deviations; of an edge point the signed distance, pixels."""


def bundle_adjust(
    problem: BundleProblem,
    *,
    gauge: Gauge = "free",
    max_iterations: int = 50,
    tolerance: float = 1e-6,
    initial_damping: float = 1e-4,
    linear_solver: Solver = "auto",
    hessian: Hessian = "exact",
    progress: Callable[[int, float], bool | None] | None = None,
    group: Group | None = None,
    **terms: Unpack[BundleTerms],
) -> BundleResult:
    """Minimise the reprojection error over poses, cameras and structure together (Triggs et al. 2000; HZ 18.1).

    Points, and lines, conics and curves where `structure` has some, are eliminated by the Schur complement (poses, where there
    are many more poses than structure). Seven dimensions of gauge (place, orientation, size of the world) are free unless
    something holds them: fixed poses or points, priors, a rig of known size (which holds the size). A free gauge does no harm:
    the damping takes the shortest step, and the model stays about where it was; see `gauge` for other wishes. Samples
    of curves move across their curves alone and would carry the model along the gauge by their noise, so with curves steps
    leave the gauge out. Fixed and unobserved poses, cameras and points come back bit for bit. Observations behind a camera
    count by the formula (a pinhole shows them mirrored): leave them out, or use a loss. Computed in float64.

    Args:
        problem: Views of points, with estimates of everything.
        gauge: "free"; or "first", which moves the adjusted world so that the first pose is what it was and the pose farthest
            from it keeps its distance. Only where nothing else holds the world.
        max_iterations: Most steps tried.
        tolerance: End when a step lowers the cost by less than this fraction.
        initial_damping: Of the first step, relative to the diagonal of the normal equations. Less saves steps where cameras
            are about where they should be already: it is the last to let long rows of cameras bend.
        linear_solver: "dense", "sparse" (for films and streets), "pcg" (for thousands of cameras of one place), or "auto"; see
            `sparse_levenberg_marquardt`.
        hessian: Used for derivatives only: "exact", or "gauss-newton", cheaper and some percent off where residuals are large.
        progress: Called with the number of steps and the cost after each; False, or an interrupt, ends it with the best so far.
        group: Processes of `torch.distributed`, started by `torchrun` for one, that call this with the same problem and share
            the work and the memory: points and their observations are divided, poses and cameras are known to all. All
            return the same, which is what one process finds, to rounding; see `sparse_levenberg_marquardt`.
        **terms: What is adjusted, held and known; see `BundleTerms`.

    Returns:
        The adjusted poses, cameras and points, in the dtype given, with costs and residuals. Where observations, weights, or
        fixed poses, cameras or points require a gradient, the results carry their derivatives by the implicit function theorem
        (first derivatives; with a free gauge, those of the solution that moves least).

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.0, generator=g).problem
        >>> found = torchsfm.bundle_adjust(problem, free=("focal", "k1", "k2"), loss=torchsfm.Huber(2.0))
        >>> found.status.name, bool(problem.residuals().max() > 10), bool(found.residuals.max() < 0.1)  # pixels
        ('OK', True, True)
    """
    bundle = Bundle(problem, **terms)
    check_options(gauge=(gauge, ("free", "first")))
    blocks, residuals = bundle.problem()
    if gauge == "first" and (bundle.priors or not bundle.world_is_free(blocks)):
        raise ValueError("gauge: wanted 'free' where something is fixed or known beforehand, got 'first'")
    poses, rig, X = bundle.poses, bundle.rig, problem.X
    result = sparse_levenberg_marquardt(
        blocks,
        residuals,
        eliminate=cheapest_elimination(blocks, residuals, structure_blocks(bundle)),
        max_iterations=max_iterations,
        function_tolerance=tolerance,
        initial_damping=initial_damping,
        linear_solver=linear_solver,
        hessian=hessian,
        progress=progress,
        group=group,
    )
    used = result.used[0]
    distance = torch.linalg.vector_norm(result.residuals[0], dim=-1)
    new_poses = moved_poses(poses, blocks["pose"].x, result.x["pose"])
    points = result.x["point"][:, :3].to(X.dtype)
    if rig is not None:
        rig = Rig(moved_poses(rig.cam_from_rig, blocks["sensor"].x, result.x["sensor"]), rig.sensor, rig.frame)
    world = None
    if gauge == "first":
        moved = (points != X).any(-1)
        new_poses, points, rig, world = restore_gauge(poses, new_poses, points, moved, rig, bundle.size_is_known)
    structure = tuple(s.moved(blocks[s.block].x, result.x[s.block], world) for s in bundle.structure)
    seen = zip(result.residuals[1:], result.used[1:], bundle.structure, strict=False)
    apart = tuple(torch.where(counts[:, None], r, torch.inf).to(X.dtype) for r, counts, _ in seen)
    return BundleResult(
        new_poses,
        moved_cameras(problem.cameras, blocks["camera"].x, result.x["camera"]),
        points,
        result.cost,
        result.initial_cost,
        torch.where(used, distance, torch.inf).to(X.dtype),
        used,
        result.iterations,
        result.status,
        rig,
        structure,
        apart,
    )
