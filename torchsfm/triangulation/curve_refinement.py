"""Samples of space curves at the least squares of distances from image curves: they move across the curve, not along it."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import Curve, foot_points
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import inverse
from torchsfm.linalg.rows import inner
from torchsfm.triangulation.curve_views import CurveDistances, CurveViews, Sight, project_all

_STEPS = 8
"""Gauss-Newton steps of samples: they begin within the threshold."""
_BLUR = 0.05
"""Standard deviation of a sample for noise of one pixel, relative to its depth, beyond which it is not determined."""


def refine_samples(
    views: Sight, X: Float[Tensor, "p m 3"], found: Bool[Tensor, "p m"], around: Bool[Tensor, "p"]
) -> tuple[Tensor, Float[Tensor, "p m 3 2"], CurveDistances, Bool[Tensor, "p m"]]:
    """Samples at the least squares of distances, directions across the curve, distances, and which samples are determined."""
    far = _depth(views, X)
    for _ in range(_STEPS):
        basis = _across(X, found, around)
        near = views.distances(X)
        J = _slopes(views.P, near, basis)
        back, ok = inverse(_normal(J, near.weight))
        slope = ((near.weight * near.r)[..., None] * J).sum(1)
        step = -(basis @ (back @ slope[..., None]))[..., 0]
        # No farther than a tenth of the depth: a sample that little holds is not determined in the end.
        size = torch.linalg.vector_norm(step, dim=-1)
        step = step * (0.1 * far / size.clamp_min(1e-300)).clamp(max=1)[..., None]
        X = torch.where((found & ok & torch.isfinite(size))[..., None], X + step, X)
    basis = _across(X, found, around)
    near = views.distances(X)
    A = _normal(_slopes(views.P, near, basis), near.weight)
    half, product = (A[..., 0, 0] + A[..., 1, 1]) / 2, A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1].square()
    least = product / (half + (half.square() - product).clamp(min=0).sqrt()).clamp_min(1e-300)
    # What two views agree on they always agree on; a third one tells.
    several = (near.weight > 0.25).sum(1) >= views.used.sum(-1, keepdim=True).clamp(max=3)
    measured = found & several & (least > 0) & (least.clamp_min(1e-300).rsqrt() < _BLUR * _depth(views, X))
    return X, basis, near, measured


def _depth(views: Sight, X: Tensor) -> Float[Tensor, "p m"]:
    """Distance from the nearest camera that is used."""
    depth = project_all(views.P, X)[1].abs()
    return torch.where(views.used[..., None], depth, torch.inf).amin(1).clamp(max=1e300)


def _across(X: Tensor, found: Tensor, around: Tensor) -> Float[Tensor, "p m 3 2"]:
    """Two unit vectors across the curve through the samples found; any at others."""
    order = found.to(torch.int8).argsort(dim=-1, descending=True, stable=True)
    there = found.gather(-1, order)
    packed = torch.where(there[..., None], X.gather(-2, order[..., None].expand_as(X)), 0)
    place = (found.cumsum(-1) - 1).clamp(min=0)[..., None].expand_as(X)
    tangent = Curve(packed, there, around).tangents().gather(-2, place) * found[..., None]
    some = (tangent != 0).any(-1, keepdim=True)
    tangent = torch.where(some, tangent, tangent.new_tensor([1.0, 0.0, 0.0]))
    helper = torch.zeros_like(tangent).scatter_(-1, tangent.abs().argmin(-1, keepdim=True), 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(tangent, helper), dim=-1)
    return torch.stack((first, torch.linalg.cross(tangent, first)), -1)


def _slopes(P: Tensor, near: CurveDistances, basis: Tensor) -> Float[Tensor, "p v m 2"]:
    """The derivatives of distances by steps across the curve: n' (M - y m3') / depth."""
    M = P[..., :3]
    rows = near.normal @ M[..., :2, :] - inner(near.normal, near.image)[..., None] * M[..., 2:, :]
    return divide_safely((rows[..., None, :] @ basis[:, None])[..., 0, :], near.depth)


def _normal(J: Tensor, weight: Tensor) -> Float[Tensor, "p m 2 2"]:
    return (weight[..., None, None] * J[..., :, None] * J[..., None, :]).sum(1)


def covariance_across(views: Sight, X: Tensor, basis: Tensor, near: CurveDistances) -> Float[Tensor, "p m 3 3"]:
    """The inverse of the normal matrix, in the world: views that agree count alike."""
    counted = (near.weight > 0).to(X.dtype)
    back, _ = inverse(_normal(_slopes(views.P, near, basis), counted))
    return basis @ back @ basis.mT


def with_derivative(
    curve: Curve, P: Tensor, views: CurveViews, X: Tensor, basis: Tensor, near: CurveDistances, measured: Tensor
) -> Tensor:
    """Attach the derivatives of measured samples: a Gauss-Newton step from the optimum is next to nothing and has them."""
    J = _slopes(views.P, near, basis)
    back, _ = inverse(_normal(J, near.weight))
    scale = (views.P[..., 2, :3] * P.detach()[..., 2, :3]).sum(-1) / views.P[..., 2, :3].square().sum(-1)
    safe = torch.where(views.used, scale, 1)[..., None, None]
    cameras = torch.where(views.used[..., None, None], P / safe, views.P)
    image, _ = CurveViews(views.curve, cameras, views.used, views.threshold).project(X)
    r = ((image - foot_points(curve, near.image).x) * near.normal).sum(-1)
    slope = ((near.weight * (r - r.detach()))[..., None] * J).sum(1)
    step = -(basis @ (back @ slope[..., None]))[..., 0]
    return X + torch.where(measured[..., None], step, 0)
