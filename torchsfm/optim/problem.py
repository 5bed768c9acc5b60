"""What a descent is made of: a problem is linearised at a place, and the system found there gives a step for any damping.

Whoever brings an objective or a linear algebra of his own writes these; `descent` knows nothing else of them.
"""

from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from torchsfm.optim.pytree import Places


class Step(NamedTuple):
    """Steps, one for each element of the batch."""

    delta: Any
    """Tangent steps; of no account where there is none."""
    promise: Tensor
    """The decrease of the cost that the model promises; inf where there is no step, so that none is taken and nothing ends."""
    solved: Tensor
    """Where there is a step."""
    bent: Tensor
    """Where the cost bends down in some directions, in which the step goes as far as were it up, or not at all: that promises
    nothing."""
    partial: Tensor
    """Where it was not solved to the end, so that more may be left than it promises."""


@runtime_checkable
class System(Protocol):
    """A problem linearised at a place. In a batch, a dataclass of tensors with the batch in front."""

    @property
    def x(self) -> Any:
        """The place."""

    @property
    def cost(self) -> Tensor:
        """The cost there, (*batch)."""

    def steepest(self) -> Tensor:
        """The largest derivative, in units of the system's choice; not finite where anything in the system is not, (*batch)."""

    def along(self, delta: Any) -> Tensor:
        """The derivative of the cost along a step, (*batch)."""

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step for a damping (*batch), relative to the diagonal of the Gauss-Newton matrix.

        Where `exact` is True it is one with the exact Hessian, which `Problem.curve` has put in.
        """


S = TypeVar("S", bound=System)


@runtime_checkable
class Problem(Protocol[S]):
    """What is minimised; a problem that inherits from this has no Newton steps, and ends by costs alone."""

    @property
    def epsilon(self) -> float:
        """The relative rounding error of parameters and data."""
        return torch.finfo(torch.float64).eps

    @property
    def patience(self) -> int | None:
        """About how many Gauss-Newton steps a Newton step takes the time of; None where there are no Newton steps."""
        return None

    def linearize(self, x: Any) -> S:
        """The system at x."""

    def advance(self, here: S, step: Step) -> S:
        """The system where a step leads; a cost that is not finite where there is nowhere to go."""

    def curve(self, here: S, where: Tensor) -> S:
        """The system with the exact Hessian in the elements `where`."""
        return here

    def rounding(self, here: S) -> Tensor:
        """The decrease of the cost that is nothing, whatever the tolerance, (*batch)."""

    def is_short(self, here: S, delta: Any, tolerance: float) -> Tensor:
        """Where a step is shorter than a fraction of what it moves, (*batch)."""
        return torch.zeros_like(here.cost, dtype=torch.bool)

    def pick(self, at: Places) -> "Problem[S]":
        """The problems at some places, in a batch of one dimension; never asked of a batch of none."""
