"""What the bench must know of a solver."""

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchsfm import Solutions

Sample = tuple[Tensor, ...]
"""Measurements, each `(batch, ...)`."""

TOLERANCES: dict[torch.dtype, float] = {torch.float64: 1e-6, torch.float32: 1e-2}
DEGENERATE = ("repeated points", "collinear", "coplanar", "all at infinity", "pure rotation", "zero baseline")
"""Families that a scene function also knows, whose samples do not determine the model, or do so for some solvers only."""


@dataclass(frozen=True)
class Peer:
    """The same solver in another package."""

    package: str
    """Where to look whether it is installed."""
    make: Callable[[], Callable[..., Any]]
    """Imports the package and gives the function: of numpy arrays of one sample to a list of models, or of a batch of tensors
    to a tensor with a dimension of slots (not finite where empty)."""
    batched: bool = False

    def installed(self) -> bool:
        """Whether the package is there."""
        return importlib.util.find_spec(self.package) is not None


@dataclass(frozen=True)
class Case:
    """A solver, where it is put to the test, and how its answers are judged.

    A linear or iterative door that returns one model is wrapped by `one_slot`.
    """

    name: str
    size: int
    """Data in a sample."""
    slots: int
    """The most solutions there are."""
    solve: Callable[..., Solutions[Tensor]]
    """Of `*sample`."""
    scene: Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]
    """`(family, batch, generator, dtype)` to exact samples and the float64 model `(batch, ...)` behind them.

    Knows "random", all of `families` and all of `degenerate`. Made in float64 and then rounded."""
    error: Callable[[Tensor, Tensor], Tensor]
    """Distance of models `(batch, slots, ...)` from the truth `(batch, ...)`: `(batch, slots)`, without unit.

    Blind to scale and sign where they mean nothing."""
    families: tuple[str, ...]
    """The hard families that are not degenerate."""
    equations: Callable[..., Tensor] | None = None
    """Of `(model, *sample)`, as in the solver's file; broadcasts slots."""
    degenerate: tuple[str, ...] = DEGENERATE
    peers: Mapping[str, Peer] = field(default_factory=dict)
    masked: bool = True
    """Whether the solver says which of its models are solutions; one made by `one_slot` does not."""
    wanted: float = 0.9999
    """Recall on random scenes in float64."""
    published: float | None = None
    """Solves per second of PoseLib's C++ in a C++ loop (PoseLib 2.0.5, one core of an AVX-512 machine)."""
    tolerances: Mapping[torch.dtype, float] = field(default_factory=TOLERANCES.copy)
    """The error below which a model is found."""


def one_slot(door: Callable[..., Tensor]) -> Callable[..., Solutions[Tensor]]:
    """A door that always returns one model, as a solver with one slot."""

    def solve(*sample: Tensor) -> Solutions[Tensor]:
        model = door(*sample).unsqueeze(sample[0].ndim - 2)
        return Solutions(model, torch.ones(model.shape[: sample[0].ndim - 1], dtype=torch.bool))

    return solve


def nearest(case: Case, solutions: Solutions[Tensor], truth: Tensor) -> Tensor:
    """The error of the best valid slot, infinite where there is none; `(batch)`."""
    error = case.error(solutions.model.double(), truth)
    return torch.where(solutions.valid, error.nan_to_num(torch.inf), torch.inf).amin(-1)


def up_to_scale(dims: int = 2) -> Callable[[Tensor, Tensor], Tensor]:
    """An error: the distance of unit arrays of the last `dims` dimensions, the sign left open."""

    def error(models: Tensor, truth: Tensor) -> Tensor:
        a, b = models.flatten(-dims), truth.flatten(-dims)[:, None]
        a, b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
        return torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))

    return error


def pose_error(models: Tensor, truth: Tensor) -> Tensor:
    """Of `[R | t]`: the larger of the difference of the rotations and that of the translations relative to the true one."""
    difference = models - truth[:, None]
    R, t = difference[..., :3].flatten(-2).norm(dim=-1), difference[..., 3].norm(dim=-1)
    return torch.maximum(R, t / truth[:, None, :, 3].norm(dim=-1).clamp_min(1e-3))
