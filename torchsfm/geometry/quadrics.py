"""Quadrics, and conics in space as flat ones: `X'QX = 0`, planes that touch satisfy `p'Q* p = 0` (HZ 3.2.4, 8.3).

A dual quadric projects to the dual conic of its outline, `C* ~ P Q* P'`. A conic in space is a dual quadric of rank three,
whose null vector is the conic's plane; it projects by the same formula.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry.similarity import Similarity
from torchsfm.linalg import adjugate_3x3, adjugate_4x4, cross, eigh, eigvalsh, null_vector, unit_scale, usable

_ROUNDING = 1e-12
"""Of the square of the longest axis: what is no axis any more, and what may be left of one that is not there."""


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoids `centre + w @ axes`, |w| = 1; ellipses in space, w = (cos t, sin t, 0), where the last axis has no length.

    Example:
        >>> import torch, torchsfm
        >>> ball = torchsfm.Ellipsoid(torch.tensor([0.0, 0.0, 5.0]), torch.eye(3))
        >>> disc = torchsfm.Ellipsoid(ball.centre, torch.diag(torch.tensor([2.0, 1.0, 0.0])))  # an ellipse in space
        >>> disc.plane.abs()
        tensor([0., 0., 1., 5.])
    """

    centre: Float[Tensor, "*batch 3"]
    axes: Float[Tensor, "*batch 3 3"]
    """The semi-axes as rows, perpendicular to each other, the longest first."""

    @property
    def plane(self) -> Float[Tensor, "*batch 4"]:
        """The plane `n'X + d = 0`, |n| = 1, through the centre and the two longer axes."""
        normal = cross(self.axes[..., 0, :], self.axes[..., 1, :])
        normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
        return torch.cat((normal, -(normal * self.centre).sum(-1, keepdim=True)), -1)

    def transform(self, similarity: Similarity) -> "Ellipsoid":
        """The same in another world."""
        axes = similarity.scale[..., None, None] * (self.axes @ similarity.R.mT)
        return Ellipsoid(similarity.transform(self.centre[..., None, :])[..., 0, :], axes)


@dataclass(frozen=True)
class PlaneConic:
    """Conics in space as a plane with a conic in it.

    Example:
        >>> import torch, torchsfm
        >>> disc = torchsfm.Ellipsoid(torch.tensor([0.0, 0.0, 3.0]), torch.diag(torch.tensor([2.0, 1.0, 0.0])))
        >>> Q_dual = torchsfm.geometry.dual_quadric_from_ellipsoid(disc)
        >>> found, known = torchsfm.geometry.plane_conic_from_dual_quadric(Q_dual)
        >>> flat, is_ellipse = torchsfm.geometry.ellipse_from_conic(found.C)  # in the coordinates of the plane
        >>> bool(is_ellipse), flat.semi_axes
        (True, tensor([2., 1.]))
        >>> on = found.frame @ torch.tensor([0.3, 0.2, 1.0])  # a point of the plane, in space
        >>> bool((found.plane @ on).abs() < 1e-5)
        True
    """

    plane: Float[Tensor, "*batch 4"]
    """`n'X + d = 0`, |n| = 1."""
    frame: Float[Tensor, "*batch 4 3"]
    """Coordinates y in the plane, metric and homogeneous: points in space are `frame y`."""
    C: Float[Tensor, "*batch 3 3"]
    """The conic `y'Cy = 0`."""


def dual_quadric(Q: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The quadric of the tangent planes from that of the points, and the other way round: the adjugate.

    Args:
        Q: Quadrics. Of a cone the dual is its vertex, twice; of a conic in space (dual, rank three) its plane, twice.

    Returns:
        The dual, of Q brought to unit size.

    Example:
        >>> import torch, torchsfm
        >>> sphere = torch.diag(torch.tensor([1.0, 1.0, 1.0, -4.0]))  # of radius 2
        >>> plane = torch.tensor([0.0, 0.0, 1.0, -2.0])  # z = 2
        >>> bool((plane @ torchsfm.geometry.dual_quadric(sphere) @ plane).abs() < 1e-6)
        True
    """
    check_tensors(Q=(Q, "4 4"))
    return adjugate_4x4(Q * unit_scale(Q))


def transform_quadric(H: Float[Tensor, "*#batch 4 4"], Q: Float[Tensor, "*#batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Move quadrics as a homography of space moves their points, `Q' ~ H^-T Q H^-1`; a dual quadric moves by `H Q* H'`.

    Args:
        H: Homography of points, up to scale.
        Q: Quadrics.

    Returns:
        The images, up to a positive factor; finite for a singular H too.

    Example:
        >>> import torch, torchsfm
        >>> sphere, wider = torch.diag(torch.tensor([1.0, 1.0, 1.0, -1.0])), torch.diag(torch.tensor([3.0, 1.0, 1.0, 1.0]))
        >>> Q = torchsfm.geometry.transform_quadric(wider, sphere)
        >>> X = torch.tensor([3.0, 0.0, 0.0, 1.0])  # once (1, 0, 0)
        >>> bool((X @ Q @ X).abs() < 1e-5)
        True
    """
    check_tensors(H=(H, "4 4"), Q=(Q, "4 4"))
    inverse = adjugate_4x4(H * unit_scale(H))
    return inverse.mT @ (Q * unit_scale(Q)) @ inverse


def project_quadric(P: Float[Tensor, "*#batch 3 4"], Q_dual: Float[Tensor, "*#batch 4 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The dual conics of the outlines of quadrics, and of the images of conics in space: `P Q* P'`.

    Args:
        P: Cameras.
        Q_dual: Dual quadrics; of rank three for conics in space.

    Returns:
        Dual conics of the images. That of a conic whose plane passes through the camera centre has rank two.

    Example:
        >>> import torch, torchsfm
        >>> ball = torchsfm.Ellipsoid(torch.tensor([0.0, 0.0, 5.0]), 3 * torch.eye(3))
        >>> C_dual = torchsfm.geometry.project_quadric(torch.eye(3, 4), torchsfm.geometry.dual_quadric_from_ellipsoid(ball))
        >>> torchsfm.geometry.ellipse_from_conic(torchsfm.geometry.dual_conic(C_dual))[0].semi_axes  # 3 / sqrt(25 - 9)
        tensor([0.7500, 0.7500])
    """
    check_tensors(P=(P, "3 4"), Q_dual=(Q_dual, "4 4"))
    return P @ Q_dual @ P.mT


def viewing_cone(P: Float[Tensor, "*#batch 3 4"], C: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "*batch 4 4"]:
    """The cones of all points whose images lie on conics, `P'CP`, with the camera centre as their vertex.

    Args:
        P: Cameras.
        C: Conics in the image.

    Returns:
        Quadrics of rank three.

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
        >>> torchsfm.geometry.viewing_cone(torch.eye(3, 4), circle).diagonal()  # x^2 + y^2 = z^2
        tensor([ 1.,  1., -1.,  0.])
    """
    check_tensors(P=(P, "3 4"), C=(C, "3 3"))
    return P.mT @ C @ P


def dual_quadric_from_ellipsoid(ellipsoid: Ellipsoid) -> Float[Tensor, "*batch 4 4"]:
    """The dual quadric of an ellipsoid, or of an ellipse in space: `sum of axes uu' - cc'` (u at infinity, c homogeneous).

    Args:
        ellipsoid: Centres and semi-axes.

    Returns:
        The dual quadric, with -1 in its last corner.

    Example:
        >>> import torch, torchsfm
        >>> ball = torchsfm.Ellipsoid(torch.zeros(3), 2 * torch.eye(3))
        >>> torchsfm.geometry.dual_quadric_from_ellipsoid(ball).diagonal()
        tensor([ 4.,  4.,  4., -1.])
    """
    check_options(ellipsoid=(ellipsoid, Ellipsoid))
    check_tensors(**{"ellipsoid.centre": (ellipsoid.centre, "3"), "ellipsoid.axes": (ellipsoid.axes, "3 3")})
    return dual_of_shape(ellipsoid.centre, ellipsoid.axes.mT @ ellipsoid.axes)


def dual_of_shape(centre: Float[Tensor, "*batch d"], D: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch d+1 d+1"]:
    """`[[D - cc', -c], [-c', -1]]`, the dual of `(X - c)' D^-1 (X - c) = 1`."""
    c = torch.nn.functional.pad(centre, (0, 1), value=1.0)
    return torch.nn.functional.pad(D, (0, 1, 0, 1)) - c[..., :, None] * c[..., None, :]


def ellipsoid_from_dual_quadric(Q_dual: Float[Tensor, "*batch 4 4"]) -> tuple[Ellipsoid, Bool[Tensor, "*batch"]]:
    """Centre and axes of ellipsoids, and of ellipses in space.

    Args:
        Q_dual: Dual quadrics, of any scale and sign.

    Returns:
        The ellipsoids, and which are some: real, with at least two axes; the others get the unit sphere. An axis whose square
        is negative by rounding is zero. Computed in float64. Axes of equal length have no direction of their own, and no
        derivative of it.

    Example:
        >>> import torch, torchsfm
        >>> ellipsoid, real = torchsfm.geometry.ellipsoid_from_dual_quadric(torch.diag(torch.tensor([9.0, 4.0, 1.0, -1.0])))
        >>> bool(real), ellipsoid.axes.norm(dim=-1)
        (True, tensor([3., 2., 1.]))
    """
    check_tensors(Q_dual=(Q_dual, "4 4"))
    good = usable(Q_dual).all(-1).all(-1)
    Q = torch.where(good[..., None, None], Q_dual, torch.eye(4, dtype=Q_dual.dtype, device=Q_dual.device)).double()
    centre, D, finite = shape_of_dual_quadric(Q * unit_scale(Q))
    squares, directions = principal_axes(D)
    largest = squares[..., 0]
    # Far from the origin rounding counts by the distance.
    floor = _ROUNDING * largest + 64 * torch.finfo(Q.dtype).eps * centre.square().sum(-1)
    if Q_dual.dtype == torch.float32:
        floor = floor + 8 * torch.finfo(torch.float32).eps * (largest + centre.square().sum(-1))
    floor = floor.detach()
    good = good & finite & (squares.detach()[..., 1] > floor) & (squares.detach()[..., 2] > -floor) & torch.isfinite(floor)
    there = squares.detach() > floor[..., None]
    lengths = torch.where(there, torch.where(there, squares, 1.0).sqrt(), 0.0)
    axes = torch.where(good[..., None, None], lengths[..., None] * directions, torch.eye(3, dtype=Q.dtype, device=Q.device))
    return Ellipsoid(torch.where(good[..., None], centre, 0.0).to(Q_dual.dtype), axes.to(Q_dual.dtype)), good


def shape_of_dual_quadric(
    Q_dual: Float[Tensor, "*batch 4 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """Centre and D of `[[D - cc', -c], [-c', -1]]` of any scale and sign, and where there is a finite centre."""
    corner = Q_dual[..., 3, 3]
    largest = Q_dual.detach().abs().amax((-2, -1))
    good = (corner.detach().abs() > 1e-40 * largest) & torch.isfinite(largest)
    scaled = -Q_dual / torch.where(good, corner, 1.0)[..., None, None]
    c = -scaled[..., :3, 3]
    D = scaled[..., :3, :3] + c[..., :, None] * c[..., None, :]
    return torch.where(good[..., None], c, 0.0), torch.where(good[..., None, None], D, 0.0), good


def principal_axes(D: Float[Tensor, "*batch d d"]) -> tuple[Float[Tensor, "*batch d"], Float[Tensor, "*batch d d"]]:
    """Eigenvalues, descending, and unit eigenvectors as rows, with derivatives where they exist."""
    values, vectors, _ = eigh(D.detach())
    values, V = values.flip(-1), vectors.flip(-1)
    M = V.mT @ D @ V
    gap = values[..., None, :] - values[..., :, None]
    distinct = gap.abs() > 1e-12 * values.abs().amax(-1)[..., None, None]
    # dV = V K with K_ij = dM_ij / (value_j - value_i).
    K = torch.where(distinct, (M - M.detach()) / torch.where(distinct, gap, 1.0), 0.0)
    return M.diagonal(dim1=-2, dim2=-1), (V + V @ K).mT


def plane_conic_from_dual_quadric(Q_dual: Float[Tensor, "*batch 4 4"]) -> tuple[PlaneConic, Bool[Tensor, "*batch"]]:
    """The plane of a conic in space, and the conic in it: of ellipses, hyperbolas and parabolas.

    Args:
        Q_dual: Dual quadrics of rank three, to rounding or noise: what is across the plane is dropped.

    Returns:
        Planes with conics, and where they mean something: not for the plane at infinity, nor for a rank of less than three.
        The frame's origin is the point of the plane nearest to the world's.

    Example:
        >>> import torch, torchsfm
        >>> disc = torchsfm.Ellipsoid(torch.tensor([0.0, 0.0, 3.0]), torch.diag(torch.tensor([2.0, 1.0, 0.0])))
        >>> Q_dual = torchsfm.geometry.dual_quadric_from_ellipsoid(disc)
        >>> found, known = torchsfm.geometry.plane_conic_from_dual_quadric(Q_dual)
        >>> bool(known), found.plane / found.plane[2]  # the plane z = 3
        (True, tensor([ 0.,  0.,  1., -3.]))
    """
    check_tensors(Q_dual=(Q_dual, "4 4"))
    good = usable(Q_dual).all(-1).all(-1)
    Q = torch.where(good[..., None, None], Q_dual, torch.eye(4, dtype=Q_dual.dtype, device=Q_dual.device)).double()
    Q = Q * unit_scale(Q)
    Q = 0.5 * (Q + Q.mT)
    plane, ok = null_vector(Q)
    sizes = eigvalsh(Q.detach())[0].abs().sort(-1).values
    length = torch.linalg.vector_norm(plane[..., :3], dim=-1, keepdim=True)
    good = good & ok & (sizes[..., 1] > 1e-12 * sizes[..., 3]) & (length[..., 0] > 1e-12)
    plane = torch.where(good[..., None], plane / torch.where(good[..., None], length, 1.0), _plane_of_axes(plane))
    normal = plane[..., :3]
    least = normal.detach().abs().argmin(-1, keepdim=True)
    u = cross(normal, torch.zeros_like(normal).scatter(-1, least, 1.0))
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    w = cross(normal, u)
    origin = -plane[..., 3:] * normal
    directions = [torch.nn.functional.pad(v, (0, 1)) for v in (u, w)]
    frame = torch.stack((*directions, torch.nn.functional.pad(origin, (0, 1), value=1.0)), -1)
    # The left inverse of the frame: orthonormal directions, the origin across them.
    inverse = torch.stack((*directions, _last_axis(plane)), -2)
    C = adjugate_3x3(inverse @ Q @ inverse.mT)
    C = torch.where(good[..., None, None], C, torch.eye(3, dtype=C.dtype, device=C.device))
    C = C * unit_scale(C)
    return PlaneConic(plane.to(Q_dual.dtype), frame.to(Q_dual.dtype), C.to(Q_dual.dtype)), good


def _plane_of_axes(like: Tensor) -> Tensor:
    """The plane z = 0."""
    plane = torch.zeros_like(like)
    plane[..., 2] = 1
    return plane


def _last_axis(like: Tensor) -> Tensor:
    last = torch.zeros_like(like)
    last[..., -1] = 1
    return last
