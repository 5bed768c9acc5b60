"""Which way curves run, by the edges that show them, so that what moves along a curve changes nothing.

Where on its curve a sample is means nothing, and in a bundle it moves across the curve alone. But other cameras, other focal
lengths above all, see all curves shifted along themselves. Measured across edges as each is found, distances change by that:
directions of edges are noisy, those of polygons through samples in space much more so, and where edges fit worse they point to
where they fit better. That holds cameras where they are, and lets them creep to where samples fit by chance.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from torchsfm.bundle import BundleCurves
from torchsfm.bundle.curves import edge_distances
from torchsfm.geometry import Camera, Pose
from torchsfm.linalg import eigh

_GUESSED = 0.01
"""Weight of the directions that samples have, against that of edges: it tells where all edges are in one plane of sight."""
_TINY = 1e-300


def own_directions(curves: BundleCurves, poses: Pose, cameras: Camera, trust: Float[Tensor, "k"]) -> Float[Tensor, "n 3"]:
    """Of each sample, the unit vector along which its distances from edges change least; as it was where it has none.

    Args:
        curves: Samples and the edges that show them.
        poses: Of the views,
        cameras: and their cameras.
        trust: What each edge counts.
    """
    y, J = _images(curves, poses, cameras)
    plane = (_normals(curves, y)[:, None] @ J)[:, 0]
    guess = normalize(curves.tangent.double(), dim=-1)
    A = plane.new_zeros(len(guess), 3, 3).index_add(0, curves.sample, trust[:, None, None] * plane[:, :, None] * plane[:, None])
    held = torch.eye(3, dtype=A.dtype, device=A.device) - guess[:, :, None] * guess[:, None]
    size = A.diagonal(dim1=1, dim2=2).sum(-1).clamp_min(_TINY)
    _, vectors, _ = eigh(A / size[:, None, None] + _GUESSED * held)
    found = vectors[..., 0]
    return torch.where((found * guess).sum(-1, keepdim=True) < 0, -found, found)


def across_own_curves(curves: BundleCurves, poses: Pose, cameras: Camera, trust: Float[Tensor, "k"]) -> BundleCurves:
    """The same distances, each across the image of one direction in space that all edges of the sample agree on best.

    Arguments are those of `own_directions`.
    """
    y, J = _images(curves, poses, cameras)
    r = edge_distances(poses, cameras, curves)
    tangent = own_directions(curves, poses, cameras, trust)
    along = (J @ tangent[curves.sample, :, None])[..., 0]
    own = normalize(torch.stack((-along[:, 1], along[:, 0]), -1), dim=-1)
    own = torch.where(((own * _normals(curves, y)).sum(-1) < 0)[:, None], -own, own)
    return replace(curves, tangent=tangent, x=y - r[:, None] * own, normal=own)


def _normals(curves: BundleCurves, y: Float[Tensor, "k 2"]) -> Float[Tensor, "k 2"]:
    """Unit normals of edges next to where samples are seen."""
    normal = normalize(curves.normal.double(), dim=-1)
    if curves.curvature is None:
        return normal
    return normalize(normal - curves.curvature[:, None] * (y - curves.x), dim=-1)


def _images(curves: BundleCurves, poses: Pose, cameras: Camera) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2 3"]]:
    """Where views show samples, and how that changes with their places in the world."""
    own, camera = poses[curves.view], cameras[curves.view]
    X = curves.X.double()[curves.sample].requires_grad_()
    with torch.enable_grad():
        y = camera.project(own.transform(X[:, None]))[:, 0]
        J = torch.stack([torch.autograd.grad(part.sum(), X, retain_graph=True)[0] for part in y.unbind(-1)], 1)
    return y.detach(), J
