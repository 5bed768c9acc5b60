"""Lens distortion: from rays in camera coordinates to distorted normalised coordinates and back.

Each model is a frozen dataclass with one tensor per parameter, all of the camera's batch shape. `project` is a formula; its
inverse is found by Newton's method on the interval where the radial function still increases. Beyond that radius the formula
folds back and two rays would have one image: such points are finite and masked.

A model is one class here and one line in `DISTORTION_MODELS`; everything else asks it. It must say `project_rows`, its inverse
and its valid radius; `linearize` may be written out where automatic differentiation is too slow, and `image` where the formula
needs fewer passes without masks.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.decentring import brown, brown_jacobian, brown_slopes, invert_brown
from torchsfm.geometry.distortion_model import Distortion
from torchsfm.geometry.fisheye import fisheye_from_tangent, fisheye_slopes, tangent_from_fisheye
from torchsfm.geometry.radial import (
    even_polynomial,
    first_fold,
    flatten,
    flatten_ray,
    invert_radial,
    radial_slopes,
)


@dataclass(frozen=True)
class NoDistortion(Distortion):
    """A pinhole: straight lines stay straight.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.NoDistortion().project(torch.tensor([[1.0, 2.0, 4.0]]))
        tensor([[0.2500, 0.5000]])
    """

    num_parameters: ClassVar[int] = 0
    parameter_names: ClassVar[tuple[str, ...]] = ()
    colmap: ClassVar[tuple[str, ...]] = ("SIMPLE_PINHOLE", "PINHOLE")

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Divide by the depth."""
        x, y, _ = flatten_ray(X, Y, Z)
        return x, y

    @classmethod
    def image(cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "0 *#n"]) -> Float[Tensor, "2 *n"]:
        """Divide by the depth."""
        return flatten(ray)[0]

    @classmethod
    def linearize(
        cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "0 *#n"], out: Float[Tensor, "2 3 *n"]
    ) -> tuple[Float[Tensor, "2 *n"], list[Float[Tensor, "2 *n"]]]:
        """The derivative is (1, 0, -u; 0, 1, -v) / Z."""
        uv, inverse = flatten(ray)
        by_x, by_y, by_depth = out.unbind(1)
        (xx, yx), (xy, yy) = by_x, by_y
        xx.copy_(inverse)
        yy.copy_(inverse)
        xy.zero_()
        yx.zero_()
        torch.mul(uv, -inverse, out=by_depth)
        return uv, []

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


class _Polynomial(Distortion):
    """What the radial polynomials in the tangent share."""

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Scale the flat coordinates by the radial polynomial."""
        x, y, s = flatten_ray(X, Y, Z)
        h = even_polynomial(s, parameters)
        return x * h, y * h

    @classmethod
    def image(cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "p *#n"]) -> Float[Tensor, "2 *n"]:
        """Scale the flat coordinates by the radial polynomial."""
        uv, _ = flatten(ray)
        x, y = uv
        return uv * even_polynomial(torch.addcmul(x * x, y, y), k.unbind(0))

    @classmethod
    def linearize(
        cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "p *#n"], out: Float[Tensor, "2 3 *n"]
    ) -> tuple[Float[Tensor, "2 *n"], list[Float[Tensor, "2 *n"]]]:
        """See `radial_slopes`."""
        return radial_slopes(*flatten(ray), k, out)

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
    """One radial coefficient: (x, y) (1 + k1 r^2). COLMAP's SIMPLE_RADIAL.

    Example:
        >>> import torch, torchsfm
        >>> lens = torchsfm.SimpleRadial(torch.tensor(-0.1))
        >>> lens.project(torch.tensor([[1.0, 0.0, 1.0]]))
        tensor([[0.9000, 0.0000]])
    """

    k1: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 1
    parameter_names: ClassVar[tuple[str, ...]] = ("k1",)
    generalises: ClassVar[type[Distortion] | None] = NoDistortion
    colmap: ClassVar[tuple[str, ...]] = ("SIMPLE_RADIAL",)


@dataclass(frozen=True)
class Radial(_Polynomial):
    """Two radial coefficients: (x, y) (1 + k1 r^2 + k2 r^4). COLMAP's RADIAL, Bundler, BAL.

    Example:
        >>> import torch, torchsfm
        >>> lens = torchsfm.Radial(torch.tensor(0.1), torch.tensor(0.0))
        >>> lens.project(torch.tensor([[1.0, 0.0, 1.0]]))  # a cushion: away from the centre
        tensor([[1.1000, 0.0000]])
    """

    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 2
    parameter_names: ClassVar[tuple[str, ...]] = ("k1", "k2")
    generalises: ClassVar[type[Distortion] | None] = SimpleRadial
    colmap: ClassVar[tuple[str, ...]] = ("RADIAL",)


@dataclass(frozen=True)
class BrownConrady(Distortion):
    """Radial and decentring distortion with the five coefficients of OpenCV, in its order k1, k2, p1, p2, k3 (Brown 1966).

    Example:
        >>> import torch, torchsfm
        >>> lens = torchsfm.BrownConrady(*torch.tensor([-0.2, 0.05, 0.0, 0.0, 0.0]))
        >>> lens.project(torch.tensor([[0.5, 0.0, 1.0]]))  # a barrel: towards the centre
        tensor([[0.4766, 0.0000]])
    """

    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]
    p1: Float[Tensor, "*batch"]
    p2: Float[Tensor, "*batch"]
    k3: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 5
    parameter_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3")
    generalises: ClassVar[type[Distortion] | None] = Radial
    colmap: ClassVar[tuple[str, ...]] = ("OPENCV", "FULL_OPENCV")

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Scale the flat coordinates by the radial polynomial and add the decentring terms."""
        k1, k2, p1, p2, k3 = parameters
        x, y, s = flatten_ray(X, Y, Z)
        return brown(x, y, s, (k1, k2, k3), p1, p2)

    @classmethod
    def image(cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "5 *#n"]) -> Float[Tensor, "2 *n"]:
        """Scale the flat coordinates by the radial polynomial and add the decentring terms."""
        k1, k2, p1, p2, k3 = k
        x, y = flatten(ray)[0]
        return torch.stack(brown(x, y, torch.addcmul(x * x, y, y), (k1, k2, k3), p1, p2))

    @classmethod
    def linearize(
        cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "5 *#n"], out: Float[Tensor, "2 3 *n"]
    ) -> tuple[Float[Tensor, "2 *n"], list[Float[Tensor, "2 *n"]]]:
        """See `brown_slopes`."""
        k1, k2, p1, p2, k3 = k
        uv, (by_k1, by_k2, by_k3), by_p1, by_p2 = brown_slopes(*flatten(ray), (k1, k2, k3), p1, p2, out)
        return uv, [by_k1, by_k2, by_p1, by_p2, by_k3]

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
class KannalaBrandt(Distortion):
    """Fisheye: the radius is theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), theta the angle to the axis.

    OpenCV's fisheye model and COLMAP's OPENCV_FISHEYE (Kannala & Brandt 2006). Here rays may point backwards too, up to the
    valid radius.

    Example:
        >>> import torch, torchsfm
        >>> lens = torchsfm.KannalaBrandt(*torch.zeros(4))  # the radius is the angle to the axis
        >>> lens.project(torch.tensor([[1.0, 0.0, 0.0]]))  # 90 degrees aside
        tensor([[1.5708, 0.0000]])
    """

    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]
    k3: Float[Tensor, "*batch"]
    k4: Float[Tensor, "*batch"]

    num_parameters: ClassVar[int] = 4
    parameter_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")
    colmap: ClassVar[tuple[str, ...]] = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    straight_k1: ClassVar[float] = 1 / 3

    @staticmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Replace the radius by the polynomial in the angle."""
        ratio, s = fisheye_from_tangent(X, Y, Z)
        factor = ratio * even_polynomial(s, parameters)
        return X * factor, Y * factor

    @classmethod
    def linearize(
        cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "4 *#n"], out: Float[Tensor, "2 3 *n"]
    ) -> tuple[Float[Tensor, "2 *n"], list[Float[Tensor, "2 *n"]]]:
        """See `fisheye_slopes`."""
        return fisheye_slopes(ray, k, out)

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


DISTORTION_MODELS: dict[str, type[Distortion]] = {
    "pinhole": NoDistortion,
    "simple_radial": SimpleRadial,
    "radial": Radial,
    "opencv": BrownConrady,
    "fisheye": KannalaBrandt,
}
"""The models by the names used in files and on the command line; of those that could hold a camera the first is taken."""


def _finite_pairs(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Replace points by zero that are not finite, or whose squared distance from the origin is not."""
    good = torch.isfinite(torch.addcmul(u * u, v, v).detach())
    return torch.where(good, u, 0.0), torch.where(good, v, 0.0), good
