"""The images of ellipses in space and of ellipsoids: how far edge points are from them, and what moves them.

A shape is `centre + frame root w`, |w| = 1, with an orthonormal frame of two or three columns and a symmetric root: a circle or
a sphere is no special case. An ellipse has eight degrees of freedom (the frame does not turn about its normal), an ellipsoid
nine (the frame stays). Its image has the support function `h(n)`: the line with normal n that touches it is (n, -h).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.conic_distance import foot_normal, signed_distance
from torchsfm.geometry.conics import shape_of_dual_conic
from torchsfm.geometry.quadrics import principal_axes
from torchsfm.linalg import cross
from torchsfm.linalg.rows import inner
from torchsfm.optim import rotation_exponential


@dataclass(frozen=True)
class Shape:
    """Ellipses in space (m = 2) or ellipsoids (m = 3)."""

    centre: Float[Tensor, "*batch 3"]
    frame: Float[Tensor, "*batch 3 m"]
    root: Float[Tensor, "*batch m m"]

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return 8 if self.root.shape[-1] == 2 else 9

    def moved(self, delta: Float[Tensor, "*batch k"]) -> "Shape":
        """Moved by tangent steps: of the centre, turns about the two directions of the plane, entries of the root."""
        frame, m = self.frame, self.root.shape[-1]
        if m == 2:
            frame = rotation_exponential((frame @ delta[..., 3:5, None])[..., 0]) @ frame
        step = delta[..., self.size - m * (m + 1) // 2 :]
        entry = [[0, 1], [1, 2]] if m == 2 else [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
        rows = [torch.stack([step[..., k] for k in row], -1) for row in entry]
        return Shape(self.centre + delta[..., :3], frame, self.root + torch.stack(rows, -2))

    def axes(self) -> Float[Tensor, "*batch 3 m"]:
        """The columns by which w makes points."""
        return self.frame @ self.root

    def principal(self) -> tuple[Tensor, Tensor]:
        """The semi-axes' lengths, descending, and their directions as rows; with derivatives where they exist."""
        columns, m = self.axes(), self.root.shape[-1]
        squares, directions = principal_axes(columns @ columns.mT)
        some = squares.detach()[..., :m] > 0
        return torch.where(some, torch.where(some, squares[..., :m], 1.0).sqrt(), 0.0), directions[..., :m, :]


def project(P: Float[Tensor, "*#batch 3 4"], shape: Shape) -> tuple[Tensor, Tensor, Tensor]:
    """Centre and shape matrix of the image ellipses, and where there are some: wholly in front or behind."""
    U = P[..., :3] @ shape.axes()
    p = (P[..., :3] @ shape.centre[..., None])[..., 0] + P[..., 3]
    return shape_of_dual_conic(U @ U.mT - p[..., :, None] * p[..., None, :])


@dataclass(frozen=True)
class Sights:
    """What views see of shapes: edge points, or lines of given normals that touch; views and data after the batch."""

    P: Float[Tensor, "*batch v 3 4"]
    y: Float[Tensor, "*batch v k 2"]
    """Edge points; or where there is a `white`, unit normals."""
    unit: Float[Tensor, "*batch v"]
    """Pixels to a unit of y."""
    white: Float[Tensor, "*batch v k k"] | None = None
    """Rows that make residuals of unit variance."""
    support: Float[Tensor, "*batch v k"] | None = None
    """What h is measured to be for these normals."""

    def residual(self, shape: Shape) -> Float[Tensor, "*batch vk 1"]:
        """Signed distances in pixels, or whitened differences; with first and second derivatives; NaN behind a camera."""
        centre, D, good = project(self.P, _beside_views(shape))
        if self.white is None or self.support is None:
            distance = signed_distance(centre, D, self.y) * self.unit[..., None]
        else:
            h = inner(self.y, centre[..., None, :]) + inner(self.y @ D, self.y).sqrt()
            distance = (self.white @ (self.support - h)[..., None])[..., 0]
        return torch.where(good[..., None], distance, torch.nan).flatten(-2)[..., None]

    def linearize(self, shape: Shape) -> tuple[Tensor, Tensor]:
        """The residuals and their derivatives: of a distance, those of the image of the point where the line touches."""
        beside = _beside_views(shape)
        centre, D, good = project(self.P, beside)
        n = self.y if self.white is not None else foot_normal(D, self.y - centre[..., None, :])
        h = inner(n, centre[..., None, :]) + inner(n @ D, n).sqrt()
        touching = torch.cat((n, -h[..., None]), -1)
        U = self.P[..., :3] @ beside.axes()
        p = (self.P[..., :3] @ beside.centre[..., None])[..., 0] + self.P[..., 3]
        w = -(touching @ U) / inner(touching, p[..., None, :])[..., None]
        depth = p[..., 2, None] + inner(w, U[..., 2:, :])
        g = -(touching @ self.P[..., :3]) / depth[..., None]
        along = g @ beside.frame
        columns = [g]
        m = shape.root.shape[-1]
        if m == 2:
            s = w @ beside.root
            across = inner(g, cross(beside.frame[..., 0], beside.frame[..., 1])[..., None, :])
            columns.append(torch.stack((s[..., 1] * across, -s[..., 0] * across), -1))
        pairs = [(i, j) for i in range(m) for j in range(i, m)]
        entries = [along[..., i] * w[..., j] + (along[..., j] * w[..., i] if i != j else 0) for i, j in pairs]
        J = torch.cat((*columns, torch.stack(entries, -1)), -1)
        if self.white is None or self.support is None:
            r = (inner(n, self.y) - h) * self.unit[..., None]
            J = J * self.unit[..., None, None]
        else:
            r, J = (self.white @ (self.support - h)[..., None])[..., 0], self.white @ J
        r = torch.where(good[..., None], r, torch.nan)
        return r.flatten(-2)[..., None], J.flatten(-3, -2)[..., None, :]


def _beside_views(shape: Shape) -> Shape:
    return Shape(shape.centre[..., None, :], shape.frame[..., None, :, :], shape.root[..., None, :, :])
