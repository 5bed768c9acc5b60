"""Do the points that agree with several views lie on a line in one of the images, and so leave the views undetermined?

Points of a line in space leave F open in four dimensions, and points whose images alone are on lines in more: those of any two
epipolar lines agree with them, whichever belong together.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import least_number_off, line_and_plane_distances
from torchsfm.motion.two_views.plane_and_parallax import more_than_chance

_FREE = 4


def collinear_suspected(
    x: Sequence[Float[Tensor, "p n 2"]],
    inliers: Bool[Tensor, "p n"],
    threshold: Float[Tensor, "p"],
    chance: Float[Tensor, "p"],
) -> Bool[Tensor, "p"]:
    """Whether that may be so, at a glance: where it is so, this says yes."""
    off = least_number_off(torch.stack(list(x)), inliers, 2 * threshold[..., None]).amin(0)
    return ~more_than_chance(off, chance, _FREE)


def collinear(
    x: Sequence[Float[Tensor, "*#batch n 2"]],
    inliers: Bool[Tensor, "*#batch n"],
    threshold: Float[Tensor, "*#batch"],
    chance: Float[Tensor, "*#batch"],
) -> Bool[Tensor, "*batch"]:
    """Whether in one of the images half of the inliers are on a line, and all but so few as chance explains."""
    aside = [number_aside(view, inliers, threshold) for view in x]
    return torch.stack([~more_than_chance(a, chance, _FREE) & (2 * a <= inliers.sum(-1)) for a in aside]).any(0)


def number_aside(
    x: Float[Tensor, "*#batch n 2"], inliers: Bool[Tensor, "*#batch n"], threshold: Float[Tensor, "*#batch"]
) -> Int[Tensor, "*batch"]:
    """How many inliers are farther than twice the threshold from the line that most of them are near to."""
    return (inliers & (line_and_plane_distances(x, inliers)[0] > 2 * threshold[..., None])).sum(-1)
