"""What a lens distortion model is; the models are in `distortion`."""

from abc import ABC, abstractmethod
from typing import ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry.homogeneous import finite_or_zero

D = TypeVar("D", bound="Distortion")


class Distortion(ABC):
    """What every distortion model offers. Models are frozen dataclasses with one tensor per parameter.

    Example:
        >>> import torch, torchsfm
        >>> lens = torchsfm.Radial.from_parameters(torch.tensor([-0.25, 0.0]))  # one of the models
        >>> lens.parameter_names
        ('k1', 'k2')
        >>> u = lens.project(torch.tensor([[0.0, 1.0, 2.0]]))
        >>> u, lens.unproject(u)
        (tensor([[0.0000, 0.4688]]), (tensor([[0.0000, 0.5000, 1.0000]]), tensor([True])))
    """

    num_parameters: ClassVar[int]
    parameter_names: ClassVar[tuple[str, ...]]
    generalises: ClassVar["type[Distortion] | None"] = None
    """The model that is this one with some of its parameters zero."""
    colmap: ClassVar[tuple[str, ...]] = ()
    """COLMAP's models with this formula, and parameters of the same names; written as the first that holds the numbers."""
    straight_k1: ClassVar[float] = 0.0
    """What k1 is, to first order, where straight lines stay straight."""

    @classmethod
    def includes(cls, other: "type[Distortion]") -> bool:
        """Tell whether each camera of another model is one of this model, with parameters of other names zero."""
        return other is cls or (cls.generalises is not None and cls.generalises.includes(other))

    @staticmethod
    @abstractmethod
    def project_rows(X: Tensor, Y: Tensor, Z: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Project rays given as separate coordinates; everything broadcasts.

        Args:
            X: To the right, in the camera's frame.
            Y: Downwards.
            Z: Along the optical axis.
            *parameters: Those of the model, in the order of `parameter_names`.
        """

    @classmethod
    def image(cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "p *#n"]) -> Float[Tensor, "2 *n"]:
        """Project rays with the coordinates first, as optimisers do (float64); finite for all finite rays.

        Args:
            ray: Rays or points in camera coordinates, of any length.
            k: The parameters, in the order of `parameter_names`.
        """
        return torch.stack(cls.project_rows(*ray.unbind(0), *k.unbind(0)))

    @classmethod
    def linearize(
        cls, ray: Float[Tensor, "3 *n"], k: Float[Tensor, "p *#n"], out: Float[Tensor, "2 3 *n"]
    ) -> tuple[Float[Tensor, "2 *n"], list[Float[Tensor, "2 *n"]]]:
        """Compute `image` and its derivatives by each parameter. Here by two reverse sweeps.

        Args:
            ray: Rays or points in camera coordinates, of any length.
            k: The parameters, in the order of `parameter_names`.
            out: What the derivatives by the ray are written to.
        """
        leaves = [row.detach().expand(ray.shape[1:]).clone().requires_grad_() for row in (*ray, *k)]
        with torch.enable_grad():
            both = cls.project_rows(*leaves)
            ones = torch.ones_like(leaves[0])
            du, dv = (torch.autograd.grad(c, leaves, ones, retain_graph=True, materialize_grads=True) for c in both)
        for row, slope in zip((*out[0], *out[1]), (*du[:3], *dv[:3]), strict=True):
            row.copy_(slope)
        return torch.stack(both).detach(), [torch.stack(pair) for pair in zip(du[3:], dv[3:], strict=True)]

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
        """Tell which rays point forwards and lie within the valid radius, so that `unproject` finds them again.

        Args:
            d: Rays or points in camera coordinates, of any length.
        """
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
        """Make the model from its parameters.

        Args:
            p: The parameters, in the order of `parameter_names`.

        Raises:
            ValueError: There are more or fewer.
        """
        if p.shape[-1] != cls.num_parameters:
            raise ValueError(f"p: wanted shape (*batch, {cls.num_parameters}) for {cls.__name__}, got {tuple(p.shape)}")
        return cls(*p.unbind(-1))

    def _columns(self) -> list[Tensor]:
        return [getattr(self, name)[..., None] for name in self.parameter_names]
