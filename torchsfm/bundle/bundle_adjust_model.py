"""Bundle adjustment of a whole model: a `Reconstruction`, a `BundleProblem`, or whatever else has the same members."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar, Unpack, runtime_checkable

from torch import Tensor

from torchsfm.bundle.blocks import BundleTerms
from torchsfm.bundle.bundle_adjust import BundleResult, bundle_adjust
from torchsfm.bundle.gauge import Gauge
from torchsfm.geometry import BundleProblem, Camera, Pose
from torchsfm.optim.schur import Solver
from torchsfm.optim.sparse_derivative import Hessian


@runtime_checkable
class BundleModel(Protocol):
    """What a model must have: a frozen dataclass with these members, and any others."""

    @property
    def poses(self) -> Pose:
        """Camera from world of each view, batch (v,)."""

    @property
    def cameras(self) -> Camera:
        """The distinct cameras, batch (g,)."""

    @property
    def camera_index(self) -> Tensor:
        """Which camera took each view, (v)."""

    @property
    def X(self) -> Tensor:
        """Points, (n, 3)."""

    @property
    def x(self) -> Tensor:
        """Observations in pixels, (m, 2)."""

    @property
    def view(self) -> Tensor:
        """The view of each observation, (m)."""

    @property
    def point(self) -> Tensor:
        """The point of each observation, (m)."""


M = TypeVar("M", bound=BundleModel)


class BundleOptions(BundleTerms, total=False):
    """The options of `bundle_adjust`, where they are described."""

    gauge: Gauge
    max_iterations: int
    tolerance: float
    linear_solver: Solver
    hessian: Hessian
    progress: Callable[[int, float], bool | None] | None


@dataclass(frozen=True)
class AdjustedModel(Generic[M]):
    """A model with adjusted poses, cameras and points, and how the adjustment went."""

    model: M
    result: BundleResult


def bundle_adjust_model(model: M, **options: Unpack[BundleOptions]) -> AdjustedModel[M]:
    """Minimise the reprojection error over all poses, cameras and points of a model; `bundle_adjust` for what holds a bundle.

    Everything else in the model (names, colours, observations) stays. Views without observations keep their poses.

    Args:
        model: A `Reconstruction`, a `BundleProblem`, or a frozen dataclass with their members.
        **options: Those of `bundle_adjust`.

    Returns:
        The new model, of the same kind, and the result with costs, residuals and status.

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.
    """
    problem = BundleProblem(model.poses, model.cameras, model.camera_index, model.X, model.x, model.view, model.point)
    result = bundle_adjust(problem, **options)
    poses = result.poses if result.rig is None else result.rig.view_poses(result.poses)
    whole: Any = model
    return AdjustedModel(replace(whole, poses=poses, cameras=result.cameras, X=result.X), result)
