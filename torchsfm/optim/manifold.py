"""Retractions: how a step in a tangent space moves a parameter block.

A `Manifold` says how many numbers a block holds (`ambient`), how many it is free in (`tangent`), and how a tangent step
moves it. `retract(x, 0) == x`; to first order a step is the derivative of the curve. Optimisers take their steps through it,
so that a rotation stays a rotation and a direction keeps its length. All functions broadcast over leading dimensions.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes


@runtime_checkable
class Manifold(Protocol):
    """What an optimiser needs to know of a parameter block.

    Example:
        >>> import torchsfm
        >>> sphere = torchsfm.optim.UnitSphere(3)
        >>> isinstance(sphere, torchsfm.optim.Manifold), sphere.ambient, sphere.tangent
        (True, 3, 2)
    """

    @property
    def ambient(self) -> int:
        """Numbers stored."""

    @property
    def tangent(self) -> int:
        """Degrees of freedom."""

    def retract(self, x: Tensor, delta: Tensor) -> Tensor:
        """The block `x (*b, ambient)` moved by the step `delta (*b, tangent)`."""


@dataclass(frozen=True)
class Euclidean:
    """Plain numbers: `x + delta`.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.optim.Euclidean(2).retract(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.0]))
        tensor([1.5000, 2.0000])
    """

    size: int
    """How many numbers a block holds."""

    @property
    def ambient(self) -> int:
        """Numbers stored."""
        return self.size

    @property
    def tangent(self) -> int:
        """Degrees of freedom."""
        return self.size

    def retract(self, x: Float[Tensor, "*#b n"], delta: Float[Tensor, "*#b n"]) -> Float[Tensor, "*b n"]:
        """Addition."""
        return x + delta


@dataclass(frozen=True)
class Subset:
    """Some coordinates of a block free, the others held: `x[free] + delta`.

    Example:
        >>> import torch, torchsfm
        >>> held = torchsfm.optim.Subset(3, (0, 2))  # the second of three numbers does not move
        >>> held.retract(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.5, 0.5]))
        tensor([1.5000, 2.0000, 3.5000])
    """

    size: int
    """How many numbers a block holds."""
    free: tuple[int, ...]
    """The places of those that move, in the order of the step."""

    @property
    def ambient(self) -> int:
        """Numbers stored."""
        return self.size

    @property
    def tangent(self) -> int:
        """Degrees of freedom."""
        return len(self.free)

    def retract(self, x: Float[Tensor, "*#b n"], delta: Float[Tensor, "*#b d"]) -> Float[Tensor, "*b n"]:
        """Addition in the free coordinates."""
        index = torch.tensor(self.free, dtype=torch.long, device=x.device)
        shape = broadcast_shapes(x.shape[:-1], delta.shape[:-1])
        step = torch.zeros((*shape, self.size), dtype=x.dtype, device=x.device)
        return x + step.index_add(-1, index, delta.expand(*shape, len(self.free)))


@dataclass(frozen=True)
class RigidMotion:
    """`(R row by row, t)` in 12 numbers, moved from the left: `R <- exp(w) R`, `t <- exp(w) t + v`, `delta = (w, v)`.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.cat((torch.eye(3).flatten(), torch.zeros(3)))
        >>> torchsfm.optim.RigidMotion().retract(x, torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]))[9:]  # no turn, a shift
        tensor([1., 2., 3.])
    """

    ambient: int = 12
    """Numbers stored."""
    tangent: int = 6
    """Degrees of freedom."""

    def retract(self, x: Float[Tensor, "*#b 12"], delta: Float[Tensor, "*#b 6"]) -> Float[Tensor, "*b 12"]:
        """The motion after the step."""
        step = rotation_exponential(delta[..., :3])
        rotation = step @ _square(x[..., :9])
        translation = (step @ x[..., 9:, None])[..., 0] + delta[..., 3:]
        return torch.cat((rotation.flatten(-2), translation), -1)


@dataclass(frozen=True)
class Rotation:
    """A rotation matrix row by row in 9 numbers, moved from the left: `R <- exp(w) R`.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.optim.Rotation().retract(torch.eye(3).flatten(), torch.tensor([0.0, 0.0, torch.pi / 2]))
        >>> (R.reshape(3, 3) @ torch.tensor([1.0, 0.0, 0.0])).round(decimals=3).abs()
        tensor([0., 1., 0.])
    """

    ambient: int = 9
    """Numbers stored."""
    tangent: int = 3
    """Degrees of freedom."""

    def retract(self, x: Float[Tensor, "*#b 9"], delta: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 9"]:
        """The rotation after the step."""
        return (rotation_exponential(delta) @ _square(x)).flatten(-2)


@dataclass(frozen=True)
class UnitSphere:
    """Vectors of a fixed length (directions, homogeneous points): the length of `x` is kept whatever it is.

    Example:
        >>> import torch, torchsfm
        >>> x = torchsfm.optim.UnitSphere(3).retract(torch.tensor([0.0, 0.0, 2.0]), torch.tensor([torch.pi / 2, 0.0]))
        >>> x.norm(), bool(x[2].abs() < 1e-6)  # a quarter of the way round, on the sphere of radius 2
        (tensor(2.), True)
    """

    size: int
    """How many numbers a block holds."""

    @property
    def ambient(self) -> int:
        """Numbers stored."""
        return self.size

    @property
    def tangent(self) -> int:
        """Degrees of freedom."""
        return self.size - 1

    def retract(self, x: Float[Tensor, "*#b n"], delta: Float[Tensor, "*#b d"]) -> Float[Tensor, "*b n"]:
        """The point of the sphere along the great circle of the step, in units of radians."""
        length = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
        unit = x / length.clamp_min(torch.finfo(x.dtype).tiny)
        # Householder reflection taking the last axis to -+unit; its other columns span the tangent space.
        sign = torch.where(unit[..., -1:] < 0, -1.0, 1.0).to(x.dtype)
        head, tail = unit[..., :-1], unit[..., -1:] + sign
        inner = (head * delta).sum(-1, keepdim=True)
        denominator = 1 + sign * unit[..., -1:]
        tangent = torch.cat((delta - head * (inner / denominator), -sign * inner * torch.ones_like(tail)), -1)
        square = (delta * delta).sum(-1, keepdim=True)
        moved: Tensor = length * (_cos_sqrt(square) * unit + _sinc_sqrt(square) * tangent)
        return moved


@dataclass(frozen=True)
class Positive:
    """Positive numbers (focal lengths, scales, depths), moved by their logarithm: `x exp(delta)`. Signs are kept.

    Example:
        >>> import math, torch, torchsfm
        >>> torchsfm.optim.Positive().retract(torch.tensor([800.0]), torch.tensor([math.log(2.0)]))  # a focal length
        tensor([1600.])
    """

    size: int = 1
    """How many numbers a block holds."""

    @property
    def ambient(self) -> int:
        """Numbers stored."""
        return self.size

    @property
    def tangent(self) -> int:
        """Degrees of freedom."""
        return self.size

    def retract(self, x: Float[Tensor, "*#b n"], delta: Float[Tensor, "*#b n"]) -> Float[Tensor, "*b n"]:
        """The numbers scaled."""
        return x * delta.exp()


@dataclass(frozen=True)
class Product:
    """Several parameters side by side in one block, each on its own manifold.

    Example:
        >>> import torchsfm
        >>> pose, focal = torchsfm.optim.RigidMotion(), torchsfm.optim.Positive()
        >>> manifold = torchsfm.optim.Product((pose, focal))
        >>> manifold.ambient, manifold.tangent
        (13, 7)
    """

    parts: tuple[Manifold, ...]
    """In the order in which their numbers stand in the block."""

    @property
    def ambient(self) -> int:
        """Numbers stored."""
        return sum(part.ambient for part in self.parts)

    @property
    def tangent(self) -> int:
        """Degrees of freedom."""
        return sum(part.tangent for part in self.parts)

    def retract(self, x: Float[Tensor, "*#b n"], delta: Float[Tensor, "*#b d"]) -> Float[Tensor, "*b n"]:
        """Each part moved by its share of the step."""
        values = torch.split(x, [part.ambient for part in self.parts], -1)
        steps = torch.split(delta, [part.tangent for part in self.parts], -1)
        return torch.cat([part.retract(v, d) for part, v, d in zip(self.parts, values, steps, strict=True)], -1)


def rotation_exponential(w: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The rotation `exp([w]x)`, smooth at zero (Rodrigues).

    Args:
        w: Axes times angles, in radians.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.optim.rotation_exponential(torch.tensor([0.0, 0.0, torch.pi])).diagonal()  # half a turn about z
        tensor([-1., -1.,  1.])
    """
    square = (w * w).sum(-1)[..., None, None]
    a, b = _sinc_sqrt(square), _cosc_sqrt(square)
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    cross = _square(torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1))
    eye = torch.eye(3, dtype=w.dtype, device=w.device)
    outer = w[..., :, None] * w[..., None, :]
    rotation: Tensor = eye + a * cross + b * (outer - square * eye)
    return rotation


def _square(x: Tensor) -> Tensor:
    return x.reshape(*x.shape[:-1], 3, 3)


def _sinc_sqrt(s: Tensor) -> Tensor:
    """`sin(sqrt s) / sqrt s`."""
    small = s < 1e-6
    root = torch.where(small, torch.ones_like(s), s).sqrt()
    return torch.where(small, 1 - s / 6 * (1 - s / 20), root.sin() / root)


def _cosc_sqrt(s: Tensor) -> Tensor:
    """`(1 - cos(sqrt s)) / s`."""
    small = s < 1e-6
    root = torch.where(small, torch.ones_like(s), s).sqrt()
    half = (root / 2).sin() / root
    return torch.where(small, 0.5 - s / 24 * (1 - s / 30), 2 * half * half)


def _cos_sqrt(s: Tensor) -> Tensor:
    """`cos(sqrt s)`."""
    small = s < 1e-6
    root = torch.where(small, torch.ones_like(s), s).sqrt()
    return torch.where(small, 1 - s / 2 * (1 - s / 12), root.cos())
