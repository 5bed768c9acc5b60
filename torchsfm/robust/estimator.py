"""What robust estimation needs to know of a problem, and nothing more.

`Estimator` is all that a problem must bring. `NeverZero`, `SolvedInSingle`, `Mixed`, `Located`, `Differentiable`,
`Diagnosed` and `WithAlternatives` say what it may bring besides, each by a few members; an estimator that has them is asked.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable
from weakref import WeakKeyDictionary

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions

M = TypeVar("M")

Weigh = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From squared distances `(*batch, n)` to the weights of the data and to the curvature of their losses.

For a loss rho(r^2) the weight is rho' and the curvature the mean over the directions of r of rho' + 2 rho'' r r', at least 0:
the gradient takes the one, the Hessian the other. A step that takes the weights for both goes the same way, more slowly.
"""


def constant_weights(weights: Float[Tensor, "*#batch n"]) -> Weigh:
    """The weights of a step of least squares: they do not depend on the distances; 0 for data to leave out.

    Args:
        weights: Of each datum.

    Example:
        >>> import torch, torchsfm
        >>> weigh = torchsfm.robust.constant_weights(torch.tensor([1.0, 0.0, 2.0]))
        >>> weigh(torch.tensor([0.1, 0.2, 0.3]))[0]  # whatever the distances
        tensor([1., 0., 2.])
    """
    return lambda _: (weights, weights)


@runtime_checkable
class Estimator(Protocol[M]):
    """A model that can be estimated from samples of data.

    Implementations are frozen dataclasses. What the problem needs beyond its data (camera matrices, gravity) are fields; tensor
    fields carry the batch dimensions of the problems in front, and the engine hands the methods the part that belongs to the
    problems at hand. A model is one tensor or a frozen dataclass of tensors.

    All methods work on any leading batch dimensions, which broadcast between models, data and fields, and treat each element on
    its own. Nothing here may raise on bad values. Data and models come in float64, and in the type of scoring.

    The signatures below are as wide as they are so that implementations can name their data.

    Example:
        >>> import torchsfm
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> isinstance(estimator, torchsfm.Estimator), estimator.sample_size, estimator.max_solutions
        (True, 4, 1)
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

    def degenerate(self, *sample: Any, **options: Any) -> Bool[Tensor, "*batch"]:
        """Whether a sample is not worth solving: it determines no model, or none that could be right."""
        ...

    def squared_residual(self, model: M, *data: Any, **options: Any) -> Float[Tensor, "*batch n"]:
        """The squared distance of every datum to the model, in the squared unit of the threshold."""
        ...

    def step(self, model: M, *data: Any, **options: Any) -> M:
        """One Gauss-Newton step from a model on the sum of robust losses, along the model's own manifold.

        Called as `step(model, *data, weigh=weigh)`: `weigh(squared_residual)` says what the data count (see `Weigh`). Distances
        and step have most of their arithmetic in common, so the step asks for the weights when it has the distances.
        """
        ...


@runtime_checkable
class NeverZero(Protocol):
    """An estimator of which a model of zeros alone is none, as of what is homogeneous or holds a rotation.

    Such models, as those that are not finite, agree with no data, whatever the residual makes of them.

    Example:
        >>> import torchsfm
        >>> torchsfm.motion.FundamentalEstimator().never_zero
        True
    """

    never_zero: ClassVar[bool]
    """True."""


@runtime_checkable
class SolvedInSingle(Protocol):
    """An estimator whose `minimal`, of samples in single precision, loses no model that noisy data determine well.

    Its samples are solved in the type of scoring, others in float64: polynomials of high degree lose digits, and rounded data
    are no longer exactly degenerate.

    Example:
        >>> import torchsfm
        >>> torchsfm.motion.FundamentalEstimator().solved_in_single
        True
    """

    solved_in_single: ClassVar[bool]
    """True."""


@runtime_checkable
class Located(Protocol):
    """An estimator that says where its data are, in the unit of the threshold: so data that hardly differ are evidence once.

    Two data count as two where they are farther than twice the threshold from each other; of other estimators where they
    differ at all.

    Example:
        >>> import torchsfm
        >>> isinstance(torchsfm.motion.FundamentalEstimator(), torchsfm.robust.Located)
        True
    """

    def places(self, model: Any, *data: Any) -> Float[Tensor, "*batch n _"]:
        """For each datum some numbers, of which the first is that of the data; a datum moved by so much is as much farther off.

        Data that do not agree with the model may be anywhere.
        """
        ...


def is_kind(estimator: object, protocol: type) -> bool:
    """Whether an estimator has what a protocol says: its class decides, and is asked once."""
    known = _KINDS.setdefault(type(estimator), {})
    if protocol not in known:
        known[protocol] = isinstance(estimator, protocol)
    return known[protocol]


_KINDS: WeakKeyDictionary[type, dict[type, bool]] = WeakKeyDictionary()


@runtime_checkable
class Mixed(Protocol):
    """An estimator whose data are of several kinds, of which a sample must hold so many each.

    Samplers that know nothing better then draw such samples, one mixture after the other.

    Example:
        >>> import torchsfm
        >>> torchsfm.motion.PointLineTrifocalEstimator().mixtures  # seven points, or four points and three lines
        ((7, 0), (4, 3))
    """

    @property
    def mixtures(self) -> tuple[tuple[int, ...], ...]:
        """How many data of each kind, `sample_size` together; none where any sample will do."""
        ...

    def kinds(self, *data: Any) -> Int[Tensor, "*batch n"]:
        """The kind of each datum, from 0 on."""
        ...


@runtime_checkable
class Differentiable(Protocol):
    """An estimator that says how its models move: refined models then carry derivatives, and a covariance if asked for.

    The squared residual must be differentiable with respect to the model and the data.

    Example:
        >>> import torchsfm
        >>> isinstance(torchsfm.motion.FundamentalEstimator(), torchsfm.robust.Differentiable)
        True
    """

    dimension: ClassVar[int]
    """Of the manifold of the models."""

    def retract(self, model: Any, step: Any, /) -> Any:
        """The model moved by a step `(*batch, dimension)` along its manifold, smooth in the step; by 0 it stays."""
        ...


@runtime_checkable
class Diagnosed(Protocol):
    """An estimator that can tell when data agree on a model and yet leave it open.

    Example:
        >>> import torchsfm
        >>> isinstance(torchsfm.motion.FundamentalEstimator(), torchsfm.robust.Diagnosed)
        True
    """

    def may_be_degenerate(self, model: Any, *data: Any, **options: Any) -> Bool[Tensor, "*batch"]:
        """Whether a closer look could find anything, judging by a part of the data that is spread over all.

        Called as `degeneracy` is, for models that samples determined. Most problems should be clear at a glance: those it calls
        clear are not looked at again, neither for degeneracy nor for alternatives.
        """
        ...

    def degeneracy(self, model: Any, *data: Any, **options: Any) -> Int[Tensor, "*batch"]:
        """A `Degeneracy` as int8 for each model.

        Called as `degeneracy(model, *data, inliers=, threshold=, chance=)` with models `(*batch, ...)`, their inliers
        `(*batch, n)`, thresholds `(*batch)`, and how many inliers `chance (*batch)` explains. Where no sample determined a
        model, the inliers are all data and the model is zero.
        """
        ...


@runtime_checkable
class WithAlternatives(Diagnosed, Protocol):
    """An estimator that knows better models where samples are unlikely to lead, as those of data mostly in a plane.

    Example:
        >>> import torchsfm
        >>> isinstance(torchsfm.motion.FundamentalEstimator(), torchsfm.robust.WithAlternatives)
        True
    """

    def alternative_models(self, model: Any, *data: Any, **options: Any) -> Solutions[Any]:
        """Such models, `(*batch, k)`, given the best one so far, `(*batch, ...)`.

        Called as `alternative_models(model, *data, inside=, threshold=, seed=)`; data that exist are `inside (*batch, n)`.
        """
        ...


def check_estimator(estimator: object) -> None:
    """Refuse what lacks a member that every estimator must have.

    Raises:
        ValueError: It names all that is missing.
    """
    if isinstance(estimator, Estimator) and not isinstance(estimator, type):
        return
    wanted = ("sample_size", "max_solutions", "codimension", "minimal", "degenerate", "squared_residual", "step")
    missing = [name for name in wanted if name not in dir(estimator)]
    if isinstance(estimator, type):
        raise ValueError(f"estimator: wanted an object, got the class {estimator.__name__}")
    raise ValueError(f"estimator: {type(estimator).__name__} lacks {', '.join(missing)} (see `Estimator`)")
