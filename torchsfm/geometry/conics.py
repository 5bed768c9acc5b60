"""Conics in the plane: `x'Cx = 0` with C symmetric, up to scale; the lines that touch it satisfy `l'C* l = 0` (HZ 2.2.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry.homogeneous import to_homogeneous
from torchsfm.linalg import adjugate_3x3, unit_scale, usable

_FLAT = 1e-13
"""The square of the ratio of the axes of what is no ellipse any more."""


@dataclass(frozen=True)
class Ellipse:
    """Ellipses `centre + R(angle) (a cos t, b sin t)`.

    Example:
        >>> import torch, torchsfm
        >>> ellipse = torchsfm.Ellipse(torch.tensor([5.0, 1.0]), torch.tensor([3.0, 2.0]), torch.tensor(0.0))
        >>> ellipse.points(torch.tensor([0.0]))
        tensor([[8., 1.]])
    """

    centre: Float[Tensor, "*batch 2"]
    semi_axes: Float[Tensor, "*batch 2"]
    """Half the lengths of the axes, the longer first."""
    angle: Float[Tensor, "*batch"]
    """From the first coordinate axis to the longer axis, in radians, between -pi / 2 and pi / 2; 0 for a circle."""

    def points(self, t: Float[Tensor, "*#batch k"]) -> Float[Tensor, "*batch k 2"]:
        """The points at parameters t, in radians."""
        a, b = self.semi_axes[..., None, :].unbind(-1)
        cos, sin = self.angle.cos()[..., None], self.angle.sin()[..., None]
        x, y = a * t.cos(), b * t.sin()
        return self.centre[..., None, :] + torch.stack((cos * x - sin * y, sin * x + cos * y), -1)


def check_ellipse(ellipse: Ellipse, **arguments: tuple[Tensor, str]) -> torch.Size:
    """Check an ellipse, and tensors with it, as `check_tensors` does."""
    check_options(ellipse=(ellipse, Ellipse))
    parts = {"centre": "2", "semi_axes": "2", "angle": ""}
    return check_tensors(**{f"ellipse.{name}": (getattr(ellipse, name), spec) for name, spec in parts.items()}, **arguments)


def shape_of_ellipse(ellipse: Ellipse) -> Float[Tensor, "*batch 2 2"]:
    """The matrix D of the ellipse `(x - centre)' D^-1 (x - centre) = 1`."""
    a2, b2 = ellipse.semi_axes.square().unbind(-1)
    cos, sin = ellipse.angle.cos(), ellipse.angle.sin()
    mixed = (a2 - b2) * cos * sin
    first, last = a2 * cos * cos + b2 * sin * sin, a2 * sin * sin + b2 * cos * cos
    return torch.stack((torch.stack((first, mixed), -1), torch.stack((mixed, last), -1)), -2)


def ellipse_of_shape(centre: Float[Tensor, "*batch 2"], D: Float[Tensor, "*batch 2 2"]) -> Ellipse:
    """The ellipse `(x - centre)' D^-1 (x - centre) = 1` of a positive definite D."""
    mean, half, mixed = 0.5 * (D[..., 0, 0] + D[..., 1, 1]), 0.5 * (D[..., 0, 0] - D[..., 1, 1]), D[..., 0, 1]
    # The axes of a circle have no direction, and no derivative.
    round_ = torch.maximum(half.detach().abs(), mixed.detach().abs()) <= 8 * torch.finfo(D.dtype).eps * mean.detach().abs()
    half, mixed = torch.where(round_, 1.0, half), torch.where(round_, 0.0, mixed)
    spread = torch.where(round_, 0.0, (half.square() + mixed.square()).sqrt())
    angle = torch.where(round_, 0.0, 0.5 * torch.atan2(mixed, half))
    first = mean + spread
    second = (D[..., 0, 0] * D[..., 1, 1] - D[..., 0, 1] * D[..., 1, 0]) / first
    return Ellipse(centre, torch.stack((first, second), -1).sqrt(), angle)


def conic_from_ellipse(ellipse: Ellipse) -> Float[Tensor, "*batch 3 3"]:
    """The conic of an ellipse, negative inside.

    Args:
        ellipse: Semi-axes greater than 0.

    Returns:
        C with `x'Cx = (distance from the centre in semi-axes)^2 - 1`.

    Example:
        >>> import torch, torchsfm
        >>> ellipse = torchsfm.Ellipse(torch.zeros(2), torch.tensor([2.0, 1.0]), torch.tensor(0.0))
        >>> torchsfm.geometry.conic_from_ellipse(ellipse).diagonal()
        tensor([ 0.2500,  1.0000, -1.0000])
    """
    check_ellipse(ellipse)
    a, b = ellipse.semi_axes.unbind(-1)
    inverse = Ellipse(ellipse.centre, torch.stack((1 / a, 1 / b), -1), ellipse.angle)
    A = shape_of_ellipse(inverse)
    c = ellipse.centre
    edge = -(A @ c[..., None])[..., 0]
    corner = -(edge * c).sum(-1) - 1
    return torch.cat((torch.cat((A, edge[..., None]), -1), torch.cat((edge, corner[..., None]), -1)[..., None, :]), -2)


def ellipse_from_conic(C: Float[Tensor, "*batch 3 3"]) -> tuple[Ellipse, Bool[Tensor, "*batch"]]:
    """Centre and axes of ellipses.

    Args:
        C: Conics, of any scale and sign.

    Returns:
        The ellipses, and which conics are real ellipses at all; the others get the unit circle. Computed in float64.

    Example:
        >>> import torch, torchsfm
        >>> ellipse, real = torchsfm.geometry.ellipse_from_conic(torch.diag(torch.tensor([1.0, 4.0, -4.0])))
        >>> bool(real), ellipse.semi_axes
        (True, tensor([2., 1.]))
    """
    check_tensors(C=(C, "3 3"))
    good = usable(C).all(-1).all(-1)
    D = torch.where(good[..., None, None], C, torch.eye(3, dtype=C.dtype, device=C.device)).double()
    return ellipse_from_dual_conic_matrix(adjugate_3x3(D * unit_scale(D)), good, C.dtype)


def ellipse_from_dual_conic_matrix(
    C_dual: Float[Tensor, "*batch 3 3"], good: Bool[Tensor, "*batch"], dtype: torch.dtype
) -> tuple[Ellipse, Bool[Tensor, "*batch"]]:
    """As `ellipse_from_conic`, of finite dual conics in float64, where `good`."""
    centre, D, some = shape_of_dual_conic(C_dual)
    good = good & some
    ellipse = ellipse_of_shape(centre, torch.where(good[..., None, None], D, torch.eye(2, dtype=D.dtype, device=D.device)))
    axes = ellipse.semi_axes.to(dtype)
    good = good & torch.isfinite(ellipse.centre.to(dtype)).all(-1) & torch.isfinite(axes).all(-1) & (axes > 0).all(-1)
    return Ellipse(
        torch.where(good[..., None], ellipse.centre, 0.0).to(dtype),
        torch.where(good[..., None], ellipse.semi_axes, 1.0).to(dtype),
        torch.where(good, ellipse.angle, 0.0).to(dtype),
    ), good


def shape_of_dual_conic(
    C_dual: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 2"], Bool[Tensor, "*batch"]]:
    """Centre and matrix D of `(x - centre)' D^-1 (x - centre) = 1` from `[[D - cc', -c], [-c', -1]]` of any scale and sign.

    The mask says where D is positive definite; elsewhere it is the identity, and the centre is 0.
    """
    corner = C_dual[..., 2, 2]
    largest = C_dual.detach().abs().amax((-2, -1))
    good = (corner.detach().abs() > 1e-200 * largest) & (largest > 0) & torch.isfinite(largest)
    scaled = -C_dual / torch.where(good, corner, 1.0)[..., None, None]
    c = -scaled[..., :2, 2]
    D = scaled[..., :2, :2] + c[..., :, None] * c[..., None, :]
    found, trace = D.detach(), D.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
    det = found[..., 0, 0] * found[..., 1, 1] - found[..., 0, 1] * found[..., 1, 0]
    # What is left of an ellipse far from the origin must be more than rounding.
    far = 64 * torch.finfo(D.dtype).eps * (c.detach().square().sum(-1) + trace.abs())
    good = good & (trace > far) & (det > _FLAT * trace.square()) & torch.isfinite(trace)
    return (
        torch.where(good[..., None], c, 0.0),
        torch.where(good[..., None, None], D, torch.eye(2, dtype=D.dtype, device=D.device)),
        good,
    )


def dual_conic(C: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The conic of the tangent lines from that of the points, and the other way round: the adjugate.

    Args:
        C: Conics. Of a pair of lines the dual is their common point, twice (rank one).

    Returns:
        The dual, of C brought to unit size.

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -4.0]))  # of radius 2
        >>> tangent = torch.tensor([1.0, 0.0, -2.0])  # the line x = 2
        >>> bool((tangent @ torchsfm.geometry.dual_conic(circle) @ tangent).abs() < 1e-6)
        True
    """
    check_tensors(C=(C, "3 3"))
    return adjugate_3x3(C * unit_scale(C))


def transform_conic(H: Float[Tensor, "*#batch 3 3"], C: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Move conics as a homography moves their points, `C' ~ H^-T C H^-1`; a dual conic moves by `H C* H'`.

    Args:
        H: Homography of points, up to scale.
        C: Conics.

    Returns:
        The images, up to a positive factor; finite for a singular H too.

    Example:
        >>> import torch, torchsfm
        >>> circle, wider = torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.diag(torch.tensor([3.0, 1.0, 1.0]))
        >>> torchsfm.geometry.ellipse_from_conic(torchsfm.geometry.transform_conic(wider, circle))[0].semi_axes
        tensor([3., 1.])
    """
    check_tensors(H=(H, "3 3"), C=(C, "3 3"))
    inverse = adjugate_3x3(H * unit_scale(H))
    return inverse.mT @ (C * unit_scale(C)) @ inverse


def polar_lines(C: Float[Tensor, "*#batch 3 3"], x: Float[Tensor, "*#batch n 2"]) -> Float[Tensor, "*batch n 3"]:
    """The polars of points: the tangents at points of the conic, the lines through both points of contact elsewhere.

    Args:
        C: Conics.
        x: Points. The pole of a line l is `C* l`.

    Returns:
        Homogeneous lines.

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
        >>> torchsfm.geometry.polar_lines(circle, torch.tensor([[2.0, 0.0]]))  # the line x = 1 / 2
        tensor([[ 2.,  0., -1.]])
    """
    check_tensors(C=(C, "3 3"), x=(x, "n 2"))
    return to_homogeneous(x) @ C.mT
