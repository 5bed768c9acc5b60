"""Lines as short chords next to where the ends of their segments are seen: points, as any lens shows them.

The distance of an end from the image of the line is that from the straight line through the images of the chord's ends: exactly
without distortion, wherever on the line the chord is, and to second order with it, where it is next to the end.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import Camera, Pose
from torchsfm.linalg import cross

_SHORT = 1e-3
"""Half of a chord over its distance from the camera."""


def line_chords(
    pose: Pose,
    camera: Camera,
    l: Float[Tensor, "*batch k 2 2"],  # noqa: E741
    L: Float[Tensor, "*batch k 6"],
) -> Float[Tensor, "*batch k 2 2 3"]:
    """The ends in the world of a chord for each end of each segment, with derivatives by the line across itself."""
    size = torch.linalg.vector_norm(L[..., :3], dim=-1, keepdim=True)
    d = L[..., :3] / size
    foot = cross(d, L[..., 3:] / size)
    with torch.no_grad():
        h = camera.unproject(l.flatten(-3, -2))[0].reshape(*l.shape[:-1], 3)
        b = (foot @ pose.R.mT + pose.t[..., None, :])[..., None, :]
        c = (d @ pose.R.mT)[..., None, :]
        across = cross(c, h)
        along = -(cross(b, h) * across).sum(-1, keepdim=True) / across.square().sum(-1, keepdim=True)
        along = along.nan_to_num(0, 0, 0)
        half = _SHORT * torch.linalg.vector_norm(b + along * c, dim=-1, keepdim=True)
        ends = torch.stack((along - half, along + half), -2)
    chords: Tensor = foot[..., None, None, :] + ends * d[..., None, None, :]
    return chords


def chord_distances(
    chords: Float[Tensor, "*batch m 2"], ends: Float[Tensor, "*#batch r 2"]
) -> tuple[Float[Tensor, "*batch k 2"], Float[Tensor, "*batch k 2 2 2"]]:
    """Signed distances of the ends of segments, 2 k in a row, from chords, 4 k image points; and their derivatives by these."""
    k = chords.shape[-2] // 4
    chords, ends = chords.reshape(*chords.shape[:-2], k, 2, 2, 2), ends.reshape(*ends.shape[:-2], k, 2, 2)
    A, B = chords.unbind(-2)
    length = (B - A).square().sum(-1, keepdim=True).clamp_min(1e-200).sqrt()
    along = (B - A) / length
    normal = torch.stack((-along[..., 1], along[..., 0]), -1)
    share = (along * (ends - A)).sum(-1, keepdim=True) / length
    slopes = torch.stack((-(1 - share) * normal, -share * normal), -2)
    return (normal * (ends - A)).sum(-1), slopes
