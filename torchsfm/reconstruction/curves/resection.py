"""The camera of an image from curves in space that it shows, by its edges: none of their points is in correspondence."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import Pose
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.images.edge_field import EdgeField
from torchsfm.linalg import damped_solve

_RADII = (16.0, 10.0, 6.0, 4.0, 2.5)
"""Distances of edges, in pixels, that samples still feel, one after the other."""
_STEPS = 4
"""Gauss-Newton steps at each."""
_SCREEN = 200
"""Samples by which starts are compared,"""
_BEST = 10
"""and starts that are followed."""
_NEAR = 1.5
"""Distance, in pixels, of an edge that shows a sample."""


class Resection(NamedTuple):
    """Poses from the best starts, and how many samples their images show."""

    pose: Pose
    near: Float[Tensor, "h"]
    """Samples whose images are on edges that run as they must."""
    inside: Float[Tensor, "h"]
    """Samples whose images are in the image at all."""


def pose_from_edges(
    X: Float[Tensor, "n 3"],
    tangent: Float[Tensor, "n 3"],
    field: EdgeField,
    size: tuple[int, int],
    K: Float[Tensor, "3 3"],
    start: Pose,
    *,
    reach: float = _RADII[0],
) -> Resection:
    """Poses at the robust least squares of distances from the nearest edges of like direction, from several starts.

    Args:
        X: Samples of curves in space.
        tangent: Unit tangents there, in the direction in which images have the brighter side to the left.
        field: The edges of the image, without distortion.
        size: Height and width of the image.
        K: The camera.
        start: Where to start, batch (h).
        reach: Distance of edges, in pixels, that samples feel at first.
    """
    some = slice(None, None, -(-len(X) // _SCREEN))
    first = _look(X[some], tangent[some], field, size, K, start)
    gap = torch.where(first.inside, first.far.clamp(max=_RADII[0]), _RADII[0]).mean(-1)
    pose = start[gap.argsort()[:_BEST]]
    for radius in (r for r in _RADII if r <= reach):
        for _ in range(_STEPS):
            pose = pose.retract(_step(_look(X, tangent, field, size, K, pose), K, radius))
    found = _look(X, tangent, field, size, K, pose)
    near = found.inside & (found.r.abs() < _NEAR) & (found.far < 2 * _NEAR)
    return Resection(pose, near.sum(-1).to(X), found.inside.sum(-1).to(X))


class _Look(NamedTuple):
    camera: Float[Tensor, "h n 3"]
    normal: Float[Tensor, "h n 2"]
    r: Float[Tensor, "h n"]
    far: Float[Tensor, "h n"]
    inside: Bool[Tensor, "h n"]


def _look(X: Tensor, tangent: Tensor, field: EdgeField, size: tuple[int, int], K: Tensor, pose: Pose) -> _Look:
    Y = pose.transform(X)
    image = Y @ K.mT
    front = Y[..., 2] > 0
    y = divide_safely(image[..., :2], torch.where(front, image[..., 2], 1))
    way = (tangent @ pose.R.mT) @ K.mT
    along = torch.nn.functional.normalize(way[..., :2] - y * way[..., 2:], dim=-1)
    bright = torch.stack((along[..., 1], -along[..., 0]), -1)
    index, far = field.look_up(y, bright)
    extent = torch.tensor([size[1], size[0]], dtype=y.dtype, device=y.device)
    inside = front & (y > 0).all(-1) & (y < extent - 1).all(-1)
    if not len(field.x):
        return _Look(Y, torch.zeros_like(y), torch.zeros_like(far), far, inside)
    normal = field.normal[index]
    return _Look(Y, normal, ((y - field.x[index]) * normal).sum(-1), far, inside)


def _step(at: _Look, K: Tensor, radius: float) -> Float[Tensor, "h 6"]:
    """A Gauss-Newton step, with the biweight of the distances."""
    w = torch.where(at.inside & (at.far < radius), (1 - (at.r / radius).square()).clamp(min=0).square(), 0)
    z = torch.where(at.inside, at.camera[..., 2], 1)
    g = at.normal @ K[:2, :2] / z[..., None]
    g = torch.cat((g, -(g * at.camera[..., :2]).sum(-1, keepdim=True) / z[..., None]), -1)
    J = torch.cat((torch.linalg.cross(at.camera, g), g), -1)
    A = J.mT @ (w[..., None] * J)
    return damped_solve(A * (1 + 1e-6 * torch.eye(6).to(A)), -J.mT @ (w * at.r)[..., None])[..., 0]
