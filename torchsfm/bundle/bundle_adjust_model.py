"""Bundle adjustment of a whole model: a `Reconstruction`, a `BundleProblem`, or whatever else has the same members."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar, Unpack, cast, runtime_checkable

from torch import Tensor

from torchsfm.bundle.blocks import BundleTerms
from torchsfm.bundle.bundle_adjust import BundleResult, bundle_adjust
from torchsfm.bundle.conics import BundleConics
from torchsfm.bundle.curves import BundleCurves
from torchsfm.bundle.gauge import Gauge
from torchsfm.bundle.lines import BundleLines
from torchsfm.bundle.structure import Structure
from torchsfm.geometry import BundleProblem, Camera, Pose
from torchsfm.optim import Loss
from torchsfm.optim.ranks import Group
from torchsfm.optim.solver_choice import Solver
from torchsfm.optim.sparse_derivative import Hessian


@runtime_checkable
class BundleModel(Protocol):
    """What a model must have: a frozen dataclass with these members, and any others.

    Example:
        >>> import torchsfm
        >>> isinstance(torchsfm.random_bundle_problem(4, 50, 150).problem, torchsfm.BundleModel)
        True
    """

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


@runtime_checkable
class ModelStructure(Protocol):
    """What a model has besides points, in its members `lines`, `conics` and `curves`."""

    def bundle(self, *, unit: float = 1.0, loss: Loss | None = None) -> Structure:
        """As a part of a bundle in which image points have the standard deviation `unit`, pixels."""

    def adjusted(self, structure: Any) -> "ModelStructure":
        """The same where that part was moved to."""


M = TypeVar("M", bound=BundleModel)
MOST_NOISE = 0.5
"""Standard deviation of image points, pixels, beyond which what they are off is not taken for noise."""
RAYLEIGH = 1.1774
"""Median distance of points whose coordinates have the standard deviation 1."""


class BundleOptions(BundleTerms, total=False):
    """The options of `bundle_adjust`, where they are described."""

    gauge: Gauge
    max_iterations: int
    tolerance: float
    linear_solver: Solver
    hessian: Hessian
    progress: Callable[[int, float], bool | None] | None
    group: Group | None


@dataclass(frozen=True)
class AdjustedModel(Generic[M]):
    """A model with adjusted poses, cameras and points, and how the adjustment went.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.0, generator=g).problem
        >>> better = torchsfm.bundle_adjust_model(problem, free=("focal", "k1", "k2"))
        >>> bool(better.model.residuals().max() < 0.1)  # pixels
        True
        >>> better.result.status.name, better.result.cost < 1e-3 * better.result.initial_cost
        ('OK', True)
    """

    model: M
    """Of the kind that was given."""
    result: BundleResult
    """Costs, residuals, status."""


def bundle_adjust_model(model: M, **options: Unpack[BundleOptions]) -> AdjustedModel[M]:
    """Minimise the reprojection error over all poses, cameras and points of a model; `bundle_adjust` for what holds a bundle.

    Lines, conics and curves, where the model has some in members of these names, are adjusted with the points, unless
    `structure` has others. Everything else in the model (names, colours, observations) stays. Views without observations keep
    their poses.

    Args:
        model: A `Reconstruction`, a `BundleProblem`, or a frozen dataclass with their members.
        **options: Those of `bundle_adjust`.

    Returns:
        The new model, of the same kind, and the result with costs, residuals and status.

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.0, generator=g).problem
        >>> better = torchsfm.bundle_adjust_model(problem, free=("focal", "k1", "k2"))
        >>> type(better.model).__name__, bool(better.model.residuals().max() < 0.1)  # pixels
        ('BundleProblem', True)
    """
    problem = BundleProblem(model.poses, model.cameras, model.camera_index, model.X, model.x, model.view, model.point)
    others = options.get("structure", ())
    members = {"lines": BundleLines.block, "conics": BundleConics.block, "curves": BundleCurves.block}
    own = {
        name: some
        for name, block in members.items()
        if isinstance(some := getattr(model, name, None), ModelStructure) and all(other.block != block for other in others)
    }
    if own:
        apart = problem.residuals().detach()
        known = apart[apart.isfinite()]
        noise = min(MOST_NOISE, float(known.median()) / RAYLEIGH) if len(known) else MOST_NOISE
        mine = [some.bundle(unit=noise, loss=options.get("loss")) for some in own.values()]
        options = {**options, "structure": (*others, *mine)}
    result = bundle_adjust(problem, **options)
    poses = result.poses if result.rig is None else result.rig.view_poses(result.poses)
    whole: Any = replace(cast(Any, model), poses=poses, cameras=result.cameras, X=result.X)
    moved = dict(zip(own, result.structure[len(others) :], strict=True))
    whole = replace(whole, **{name: some.adjusted(moved[name]) for name, some in own.items()})
    return AdjustedModel(whole, result)
