"""What robust estimation needs to know of a problem, and nothing more."""

from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions

M = TypeVar("M")


@runtime_checkable
class Estimator(Protocol[M]):
    """A model that can be estimated from samples of data.

    Implementations are frozen dataclasses. What the problem needs beyond its data (camera matrices, gravity) are fields; tensor
    fields carry the batch dimensions of the problems in front, and the engine hands the methods the part that belongs to the
    problems at hand. A model is one tensor or a frozen dataclass of tensors.

    All methods work on any leading batch dimensions, which broadcast between models, data and fields, and treat each element on
    its own. Nothing here may raise on bad values.

    The signatures below are as wide as they are so that implementations can name their data.

    An implementation may also define

    - `never_zero: ClassVar[bool]`: True if a model of zeros alone is none, as for what is homogeneous or holds a rotation. Such
      models, as those that are not finite, agree with no data, whatever the residual makes of them;
    - `squared_residual(model, *data)`: the square of `residual`, where that is cheaper;
    - `reweighted_step(model, *data, weigh)`: a step as `refine` does it, with weights that follow from the distances:
      `weigh(squared) -> (weights, curvature)`, all `(*batch, n)`. The weights belong in the gradient, the curvature stands in
      their place in the Hessian (see `local_optimisation.Weigh`). Distances and step have most of their arithmetic in common,
      and the curvature saves steps;
    - `traceable: ClassVar[bool]`: False if distances and steps cannot be traced with symbolic sizes, and so not be compiled
      (`compile_kernels`): if they look at the values of tensors, take Python integers of sizes, or call what is no operation of
      PyTorch. Constant tensors may be kept from one call to the next;
    - `dimension: ClassVar[int]` and `retract(model, step)`: the model moved by a step `(*batch, dimension)` along its manifold,
      smooth in the step, `retract(model, 0) == model`. They give refined models derivatives and covariance, for which
      `residual` (or its square) must be differentiable with respect to the model and the data;
    - `rivals(model, *data, inside, threshold, seed)`: `Solutions` `(*batch, k)` that samples are unlikely to lead to, given the
      best model `(*batch, ...)`, from the data where `inside (*batch, n)` (the others of a plane that won, ...);
    - `degeneracy(model, *data, inliers, threshold, chance)`: a `Degeneracy` `(*batch)` as int8 for models `(*batch, ...)` with
      their `inliers (*batch, n)`, `threshold (*batch)`, and how many inliers `chance (*batch)` explains. Where no sample
      determined a model, `inliers` are all data and the model is zero;
    - `suspect(model, *data, inliers, threshold, chance)`: `(*batch)`, from some of the data that are spread over all, whether
      `degeneracy` or `rivals` could find anything, for models that samples determined: they are asked about no others. Most
      problems should be clear at a glance.
    """

    sample_size: ClassVar[int]
    """The number of data in a minimal sample."""
    max_solutions: ClassVar[int]
    """The number of solution slots that `minimal` returns."""
    codimension: ClassVar[int]
    """How many independent equations a datum gives: its residual is the length of so many Gaussian numbers."""

    def minimal(self, *sample: Any, **options: Any) -> Solutions[M]:
        """The models through minimal samples: tensors `(*batch, m, d)` -> `(*batch, slots, ...)`."""
        ...

    def residual(self, model: M, *data: Any, **options: Any) -> Float[Tensor, "*batch n"]:
        """The distance of every datum to the model: unsquared, in the unit of the threshold."""
        ...

    def degenerate(self, *sample: Any, **options: Any) -> Bool[Tensor, "*batch"]:
        """Whether a sample is not worth solving: it determines no model, or none that could be right."""
        ...

    def refine(self, model: M, *data: Any, **weights: Any) -> M:
        """One Gauss-Newton step from a model on the sum of `weights` times squared residuals, along the model's own manifold.

        Called as `refine(model, *data, weights=weights)` with weights `(*batch, n)`, 0 for data to leave out.
        """
        ...
