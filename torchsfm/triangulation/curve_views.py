"""Image curves in known views, and how far from them the images of points are."""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Curve, foot_points
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import inverse


class CurveDistances(NamedTuple):
    """Of the images of points from the image curves."""

    r: Float[Tensor, "p v m"]
    """Signed, along `normal`."""
    image: Float[Tensor, "p v m 2"]
    depth: Float[Tensor, "p v m"]
    normal: Float[Tensor, "p v m 2"]
    weight: Float[Tensor, "p v m"]
    """The biweight; 0 beyond the threshold, behind a camera and beyond an open end."""


@runtime_checkable
class Sight(Protocol):
    """What views say of points on curves."""

    @property
    def P(self) -> Float[Tensor, "p v 3 4"]:
        """Cameras, scaled so that depths are those in the world, positive in front."""

    @property
    def used(self) -> Bool[Tensor, "p v"]:
        """Which views count."""

    def distances(self, X: Float[Tensor, "p m 3"]) -> CurveDistances:
        """How far the images of points are from image curves."""


class CurveViews(NamedTuple):
    """Image curves and their cameras."""

    curve: Curve
    """(p, v)."""
    P: Float[Tensor, "p v 3 4"]
    """Scaled so that depths are those in the world, positive in front."""
    used: Bool[Tensor, "p v"]
    threshold: float
    """Distance in pixels beyond which nothing counts."""

    def project(self, X: Float[Tensor, "p m 3"]) -> tuple[Float[Tensor, "p v m 2"], Float[Tensor, "p v m"]]:
        """Image points and depths."""
        return project_all(self.P, X)

    def others(self, reference: Int[Tensor, "p"]) -> Bool[Tensor, "p v"]:
        """The views in use but one."""
        return self.used & (torch.arange(self.used.shape[-1], device=reference.device) != reference[:, None])

    def distances(self, X: Float[Tensor, "p m 3"]) -> CurveDistances:
        """How far the images of points are from the curves."""
        y, depth = self.project(X)
        foot = foot_points(self.curve, y)
        normal = torch.stack((-foot.tangent[..., 1], foot.tangent[..., 0]), -1)
        r = ((y - foot.x) * normal).sum(-1)
        counted = foot.within & (depth > 0) & self.used[..., None]
        return CurveDistances(r, y, depth, normal, torch.where(counted, biweight(r, self.threshold), 0))


def curve_views(curve: Curve, P: Tensor, seen: Tensor, threshold: float) -> CurveViews:
    """The views that can be used, their cameras scaled; `seen` says which may."""
    axes = torch.eye(3, 4, dtype=P.dtype, device=P.device)
    sound = torch.isfinite(P).flatten(2).all(-1)
    P = torch.where(sound[..., None, None], P, axes)
    last = torch.linalg.vector_norm(P[..., 2, :3], dim=-1)
    P = P / torch.where(last > 0, last, 1)[..., None, None]
    a, b, c = P[..., :3].unbind(-2)
    sign = (a * torch.linalg.cross(b, c)).sum(-1).sign()
    length = curve.length
    used = seen & sound & (last > 0) & (sign != 0) & (length > 0) & (length < torch.inf)
    return CurveViews(curve, torch.where(used[..., None, None], sign[..., None, None] * P, axes), used, threshold)


def viewing_rays(
    P: Float[Tensor, "*b 3 4"], x: Float[Tensor, "*b m 2"]
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b m 3"]]:
    """The centres, and the unit directions of the rays of image points."""
    back, _ = inverse(P[..., :3])
    rays = torch.cat((x, torch.ones_like(x[..., :1])), -1) @ back.mT
    return -(back @ P[..., 3:])[..., 0], torch.nn.functional.normalize(rays, dim=-1)


def project_all(
    P: Float[Tensor, "p v 3 4"], X: Float[Tensor, "p m 3"]
) -> tuple[Float[Tensor, "p v m 2"], Float[Tensor, "p v m"]]:
    """Image points in all views, and depths."""
    y = X[:, None] @ P[..., :3].mT + P[:, :, None, :, 3]
    return divide_safely(y[..., :2], y[..., 2]), y[..., 2]


def biweight(r: Float[Tensor, "*batch"], threshold: float) -> Float[Tensor, "*batch"]:
    """(1 - (r / threshold)^2)^2, 0 beyond the threshold (Tukey)."""
    return (1 - (r / threshold).square()).clamp(min=0).square()
