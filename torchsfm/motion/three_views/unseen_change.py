"""Whether the data of three cameras see every large change of these: else they leave the cameras open, whatever the reason.

So it is of points on two lines or in a plane, of centres that coincide, and of lines that meet one line.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.motion.three_views.multilinear_fit import free_directions

_MOTION = 0.3
"""A change of the cameras, of norm 1 each, that should be seen."""


def change_unseen(
    model: Float[Tensor, "*batch 2 3 4"],
    alone: Float[Tensor, "*batch n 24 24"],
    inliers: Bool[Tensor, "*batch n"],
    threshold: Float[Tensor, "*batch"],
    spare: Float[Tensor, "*batch"],
) -> Bool[Tensor, "*batch"]:
    """Whether no more inliers than can be spared see the change of the cameras that they see least.

    Args:
        model: The second and the third camera.
        alone: Normal matrix of each datum by itself, over the entries of both cameras.
        inliers: Which data agree.
        threshold: The largest distance of an inlier.
        spare: How many may see it by chance.
    """
    D = free_directions(model)[..., None, :, :]
    A = torch.where(inliers[..., None, None], D.mT @ alone @ D, 0.0).nan_to_num(0, 0, 0)
    weights = inliers.to(A.dtype)
    seen = torch.zeros_like(weights)
    for _ in range(4):
        _, vectors, _ = eigh((A * weights.square()[..., None, None]).sum(-3))
        v = vectors[..., None, :, :1]
        seen = _MOTION * (v.mT @ A @ v)[..., 0, 0].clamp(min=0).sqrt()
        weights = torch.where(inliers, threshold[..., None] / (seen + threshold[..., None]), 0.0)
    unseen: Tensor = (inliers & (seen > threshold[..., None])).sum(-1) <= spare
    return unseen
