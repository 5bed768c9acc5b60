"""What robust estimation needs to know of a problem, and nothing more."""

from typing import ClassVar, Protocol, TypeVar, runtime_checkable

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

    An implementation may also define `squared_residual(model, *data)`: the square of `residual`, where that is cheaper.
    """

    sample_size: ClassVar[int]
    """The number of data in a minimal sample."""
    max_solutions: ClassVar[int]
    """The number of solution slots that `minimal` returns."""

    def minimal(self, *sample: Float[Tensor, "*#batch m _"]) -> Solutions[M]:
        """The models through a minimal sample, `(*batch, m, d)` -> `(*batch, slots, ...)`."""
        ...

    def residual(self, model: M, *data: Float[Tensor, "*#batch n _"]) -> Float[Tensor, "*batch n"]:
        """The distance of every datum to the model: unsquared, in the unit of the threshold."""
        ...

    def degenerate(self, *sample: Float[Tensor, "*#batch m _"]) -> Bool[Tensor, "*batch"]:
        """Whether a sample is not worth solving: it determines no model, or none that could be right."""
        ...

    def refine(self, model: M, *data: Float[Tensor, "*#batch n _"], weights: Float[Tensor, "*#batch n"]) -> M:
        """One Gauss-Newton step, from a model, on the weighted sum of squared residuals, along the model's own manifold."""
        ...
