"""Lens distortion: from rays in camera coordinates to distorted normalised coordinates and back.

Each model is a frozen dataclass with one tensor per parameter, all of the camera's batch shape. `project` is a formula; its
inverse is found by Newton's method on the interval where the radial function still increases. Beyond that radius the formula
folds back and two rays would have one image: such points are finite and masked.

Every model also has `project_rows(X, Y, Z, *parameters)`, the same formula on separate coordinates, for optimisers that keep
each coordinate as one long row.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeAlias, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.decentring import brown, brown_jacobian, invert_brown
from torchsfm.geometry.fisheye import fisheye_from_tangent, tangent_from_fisheye
from torchsfm.geometry.homogeneous import finite_or_zero
from torchsfm.geometry.radial import even_polynomial, first_fold, flatten_ray, invert_radial

D = TypeVar("D", bound="DistortionModel")


class DistortionModel(ABC):
    """What every distortion model offers; the models below are its only kinds."""

    num_parameters: ClassVar[int]
    parameter_names: ClassVar[tuple[str, ...]]

    @staticmethod
    @abstractmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Project rays given as separate coordinates; everything broadcasts."""

    @abstractmethod
    def _unproject_rows(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Invert `project_rows`: X, Y, Z and validity of each point."""

    @abstractmethod
    def valid_radius(self) -> Float[Tensor, "*batch"]:
        """Find how far from the axis the model can be trusted; inf where everywhere. Not differentiated.

        It is the smallest radius where the radial function stops increasing: in undistorted normalised coordinates (the tangent
        of the angle to the axis), or for fisheye models the angle itself in radians, at most pi.
        """

    def in_domain(self, d: Float[Tensor, "*#batch n 3"]) -> Bool[Tensor, "*#batch n"]:
        """Tell which rays point forwards and lie within the valid radius, so that `unproject` finds them again."""
        check_tensors(d=(d, "n 3"))
        X, Y, Z = d.detach().unbind(-1)
        return (Z > 0) & ((X * X + Y * Y).sqrt() < self.valid_radius()[..., None] * Z)

    def project(self, d: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*#batch n 2"]:
        """Project rays to distorted normalised coordinates.

        Args:
            d: Rays or points in camera coordinates, of any length.

        Returns:
            What multiplies K, finite always: a ray with no depth is sent very far away in its own direction, one with NaN or
            inf to the centre. Rays behind the camera follow the formula (a pinhole shows them mirrored): see `in_domain`.
        """
        check_tensors(d=(d, "n 3"))
        return torch.stack(self.project_rows(*finite_or_zero(d).unbind(-1), *self._columns()), -1)

    def unproject(self, u: Float[Tensor, "*#batch n 2"]) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Find the ray of each distorted point, by Newton's method.

        First derivatives, by the points and by the parameters, come from the implicit function theorem.

        Args:
            u: Distorted normalised coordinates.

        Returns:
            Rays with third coordinate 1 (fisheye: unit length beyond 89.9 degrees off the axis), and the mask of those that
            were found within the valid radius. Others are finite numbers, with zero or finite gradients.
        """
        check_tensors(u=(u, "n 2"))
        x, y, z, valid = self._unproject_rows(*u.unbind(-1))
        return torch.stack([x, y, z.expand_as(x)], -1), valid

    def parameters(self) -> Float[Tensor, "*batch p"]:
        """Stack the parameters in the order of `parameter_names`."""
        return torch.stack([getattr(self, name) for name in self.parameter_names], -1)

    @classmethod
    def from_parameters(cls: type[D], p: Float[Tensor, "*batch p"]) -> D:
        """Make the model from its parameters in the order of `parameter_names`."""
        if p.shape[-1] != cls.num_parameters:
            raise ValueError(f"p: wanted shape (*batch, {cls.num_parameters}) for {cls.__name__}, got {tuple(p.shape)}")
        return cls(*p.unbind(-1))

    def _columns(self) -> list[Tensor]:
        return [getattr(self, name)[..., None] for name in self.parameter_names]


@dataclass(frozen=True)
class NoDistortion(DistortionModel):
    """A pinhole: straight lines stay straight."""

    num_parameters: ClassVar[int] = 0
    parameter_names: ClassVar[tuple[str, ...]] = ()

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Divide by the depth."""
        x, y, _ = flatten_ray(X, Y, Z)
        return x, y

    def _unproject_rows(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        u, v, valid = _finite_pairs(u, v)
        return u, v, torch.ones_like(u), valid

    def valid_radius(self) -> Float[Tensor, ""]:
        """Return inf: a pinhole has no limit."""
        return torch.tensor(torch.inf)

    def in_domain(self, d: Float[Tensor, "*#batch n 3"]) -> Bool[Tensor, "*#batch n"]:
        """Tell which rays point forwards."""
        return d[..., 2] > 0

    def parameters(self) -> Float[Tensor, "0"]:
        """Return no parameters."""
        return torch.zeros(0)


class _Polynomial(DistortionModel):
    """What the radial polynomials in the tangent share."""

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Scale the flat coordinates by the radial polynomial."""
        x, y, s = flatten_ray(X, Y, Z)
        h = even_polynomial(s, parameters)
        return x * h, y * h

    def _unproject_rows(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        k = self._columns()
        u, v, good = _finite_pairs(u, v)
        limit = self.valid_radius()[..., None]
        s, valid = invert_radial(torch.addcmul(u * u, v, v), k, limit, torch.isfinite(limit))
        valid = valid & good
        inverse = 1 / torch.where(valid, even_polynomial(s, k), torch.inf)
        return u * inverse, v * inverse, torch.ones_like(s), valid

    def valid_radius(self) -> Float[Tensor, "*batch"]:
        """Find the tangent of the angle where the radial function stops increasing."""
        return first_fold([getattr(self, name) for name in self.parameter_names])


@dataclass(frozen=True)
class SimpleRadial(_Polynomial):
    """One radial coefficient: (x, y) (1 + k1 r^2). COLMAP's SIMPLE_RADIAL."""

    k1: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 1
    parameter_names: ClassVar[tuple[str, ...]] = ("k1",)


@dataclass(frozen=True)
class Radial(_Polynomial):
    """Two radial coefficients: (x, y) (1 + k1 r^2 + k2 r^4). COLMAP's RADIAL, Bundler, BAL."""

    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 2
    parameter_names: ClassVar[tuple[str, ...]] = ("k1", "k2")


@dataclass(frozen=True)
class BrownConrady(DistortionModel):
    """Radial and decentring distortion with the five coefficients of OpenCV, in its order k1, k2, p1, p2, k3 (Brown 1966)."""

    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]
    p1: Float[Tensor, "*batch"]
    p2: Float[Tensor, "*batch"]
    k3: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 5
    parameter_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3")

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Scale the flat coordinates by the radial polynomial and add the decentring terms."""
        k1, k2, p1, p2, k3 = parameters
        x, y, s = flatten_ray(X, Y, Z)
        return brown(x, y, s, (k1, k2, k3), p1, p2)

    def _unproject_rows(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        k1, k2, p1, p2, k3 = self._columns()
        u, v, good = _finite_pairs(u, v)
        x, y, valid = invert_brown(u, v, (k1, k2, k3), p1, p2, self.valid_radius()[..., None])
        return x, y, torch.ones_like(x), valid & good

    def valid_radius(self) -> Float[Tensor, "*batch"]:
        """Find the tangent of the angle where the radial part stops increasing; decentring may fold a little earlier."""
        return first_fold([self.k1, self.k2, self.k3])

    def in_domain(self, d: Float[Tensor, "*#batch n 3"]) -> Bool[Tensor, "*#batch n"]:
        """Tell which rays point forwards, lie within the valid radius and where decentring does not fold either."""
        inside = super().in_domain(d)
        with torch.no_grad():
            k1, k2, p1, p2, k3 = self._columns()
            return inside & (brown_jacobian(*flatten_ray(*d.unbind(-1)), (k1, k2, k3), p1, p2)[-1] > 0)


@dataclass(frozen=True)
class KannalaBrandt(DistortionModel):
    """Fisheye: the radius is theta (1 + k1 theta^2 + ... + k4 theta^8), theta the angle to the axis.

    OpenCV's fisheye model and COLMAP's OPENCV_FISHEYE (Kannala & Brandt 2006). Here rays may point backwards too, up to the
    valid radius.
    """

    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]
    k3: Float[Tensor, "*batch"]
    k4: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 4
    parameter_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Replace the radius by the polynomial in the angle."""
        ratio, s = fisheye_from_tangent(X, Y, Z)
        factor = ratio * even_polynomial(s, parameters)
        return X * factor, Y * factor

    def _unproject_rows(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        k = self._columns()
        u, v, good = _finite_pairs(u, v)
        limit = self.valid_radius()[..., None]
        s, valid = invert_radial(torch.addcmul(u * u, v, v), k, limit, limit < torch.pi)
        valid = valid & good
        factor, z = tangent_from_fisheye(torch.where(valid, s, 0.0))
        factor = factor / torch.where(valid, even_polynomial(s, k), torch.inf)
        return u * factor, v * factor, z, valid

    def valid_radius(self) -> Float[Tensor, "*batch"]:
        """Find the angle in radians where the radial function stops increasing, at most pi."""
        return first_fold([self.k1, self.k2, self.k3, self.k4]).clamp(max=torch.pi)

    def in_domain(self, d: Float[Tensor, "*#batch n 3"]) -> Bool[Tensor, "*#batch n"]:
        """Tell which rays, forwards or backwards, lie within the valid radius."""
        check_tensors(d=(d, "n 3"))
        X, Y, Z = d.detach().unbind(-1)
        return torch.atan2((X * X + Y * Y).sqrt(), Z) < self.valid_radius()[..., None]


Distortion: TypeAlias = NoDistortion | SimpleRadial | Radial | BrownConrady | KannalaBrandt
DISTORTION_MODELS: dict[str, type[Distortion]] = {
    "pinhole": NoDistortion,
    "simple_radial": SimpleRadial,
    "radial": Radial,
    "opencv": BrownConrady,
    "fisheye": KannalaBrandt,
}
"""The models by the names used in files and on the command line."""


def _finite_pairs(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Replace points by zero that are not finite, or whose squared distance from the origin is not."""
    good = torch.isfinite(torch.addcmul(u * u, v, v).detach())
    return torch.where(good, u, 0.0), torch.where(good, v, 0.0), good
