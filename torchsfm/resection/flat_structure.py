"""Are the points that a camera sees on a line, or in a plane, as far as it can tell?"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import least_number_off, line_and_plane_distances
from torchsfm.robust import Degeneracy


def flatness(
    model: Float[Tensor, "*batch 3 4"],
    X: Float[Tensor, "*batch n 3"],
    focal: Float[Tensor, "*batch"],
    inliers: Bool[Tensor, "*batch n"],
    threshold: Float[Tensor, "*batch"],
    spare: Float[Tensor, "*batch"],
) -> Int[Tensor, "*batch"]:
    """COLLINEAR or PLANAR where no more inliers than can be spared are off a line or a plane, else NONE.

    Args:
        model: The camera.
        X: The points.
        focal: How far, in the unit of the threshold, a point at depth 1 moves in the image with a step of 1 across.
        inliers: Which points agree with the camera.
        threshold: Largest distance of an inlier.
        spare: How many inliers aside prove nothing.
    """
    visible = _visible(model, X, focal, threshold)
    off_line, off_plane = (
        (inliers & (distance > visible)).sum(-1) > spare for distance in line_and_plane_distances(X, inliers)
    )
    code = torch.where(off_plane, int(Degeneracy.NONE), int(Degeneracy.PLANAR))
    return torch.where(off_line, code, int(Degeneracy.COLLINEAR)).to(torch.int8)


def flatness_suspected(
    model: Float[Tensor, "*batch 3 4"],
    X: Float[Tensor, "*batch n 3"],
    focal: Float[Tensor, "*batch"],
    inliers: Bool[Tensor, "*batch n"],
    threshold: Float[Tensor, "*batch"],
    spare: Float[Tensor, "*batch"],
) -> Bool[Tensor, "*batch"]:
    """Whether some of the points leave open that all are flat; arguments as for `flatness`. Flat ones are always suspected."""
    return least_number_off(X, inliers, _visible(model, X, focal, threshold)) <= spare


def seen_places(
    model: Float[Tensor, "*batch 3 4"],
    x: Float[Tensor, "*batch n 2"],
    X: Float[Tensor, "*batch n 3"],
    focal: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch n 3"]:
    """Image points, and the depth of what they show as a distance in the image: that of a step as large across.

    Args:
        model: The camera.
        x: The image points.
        X: The points.
        focal: How far a point at depth 1 moves in the image with a step of 1 across.
    """
    depth = (X @ model[..., 2, :3, None] + model[..., 2:, 3:])[..., 0]
    return torch.cat((x, (focal[..., None] * depth.log())[..., None]), -1)


def _visible(model: Tensor, X: Tensor, focal: Tensor, threshold: Tensor) -> Tensor:
    """How far from a line or plane each point must be to be seen to be."""
    depth = (model[..., 2:, :3] @ X.mT)[..., 0, :] + model[..., 2, 3:]
    # Rounding counts too: where no sample determined a camera, there is no depth to judge by.
    visible: Tensor = depth.abs() * (2 * threshold / focal)[..., None] + 1e-9 * X.abs().amax(-1)
    return visible
