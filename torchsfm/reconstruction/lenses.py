"""Which kind of lens took the images, where no one says: the polynomial in the radius that most follow, or a fisheye.

The polynomial stands for a small bend of the image of a pinhole, which ends at 90 degrees off the axis. A lens that sees far to
the side has no such image: the polynomial follows it in the middle alone, and what is left in the corners turns the cameras.
"""

import torch

from torchsfm.reconstruction.mapping.adjust import LOSS
from torchsfm.reconstruction.mapping.calibration import measure_noise
from torchsfm.reconstruction.mapping.mapping import Mapping

FISHEYE = "fisheye"
"""What is tried besides."""
POLYNOMIALS = "simple_radial", "radial", "opencv"
"""What is prescribed for most lenses, and wrongly for those."""
BENT = 0.9
"""A lens may be a fisheye that brings corners of images nearer to the middle than this part of where a pinhole has them."""
LIKELIER = 20.0
"""Twice the logarithm of how many times likelier the same image points must be by another lens: chance gains little by its two
numbers more."""


def may_be_fisheye(mapping: Mapping) -> bool:
    """Whether the lenses of most images bend the corners strongly, or cannot say where these come from."""
    size = mapping.graph.image_size[mapping.registered].to(mapping.X.dtype) - 0.5
    low = torch.full_like(size[:, 0], -0.5)
    corners = torch.stack([torch.stack((u, v), -1) for u in (low, size[:, 0]) for v in (low, size[:, 1])], -2)
    cameras = mapping.cameras[mapping.camera_index[mapping.registered]]
    K = cameras.K
    d, valid = cameras.unproject(corners)
    straight = (corners - K[:, None, :2, 2]) / K.diagonal(dim1=-2, dim2=-1)[:, None, :2]
    bent = straight.norm(dim=-1) < BENT * (d[..., :2] / d[..., 2:]).norm(dim=-1)
    return bool((bent | ~valid).any(-1).double().mean() > 0.5)


def explains_better(mapping: Mapping, other: Mapping) -> bool:
    """Whether the other model explains the image points that both do better than chance lets it."""
    node = ((mapping.point >= 0) & (other.point >= 0)).nonzero()[:, 0]
    fewer = min(int((model.point >= 0).sum()) for model in (mapping, other))
    if 2 * len(node) < fewer or not len(node):
        return False
    cost, less = (float(LOSS(model.errors(model.point[node], node).square()).sum()) for model in (mapping, other))
    return cost - less > LIKELIER * measure_noise(other, LOSS) ** 2
