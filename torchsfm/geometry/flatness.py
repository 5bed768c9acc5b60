"""Do points lie on a line, or in a plane?"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def line_and_plane_distances(
    X: Float[Tensor, "*batch n d"], present: Bool[Tensor, "*batch n"], steps: int = 4
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]:
    """The distances of points from the line and from the plane that most of them are near to.

    Principal axes of reweighted moments (weights 1 / (distance + rms distance)), so that a few points aside do not matter.

    Args:
        X: Points in two or more dimensions.
        present: Which points count.
        steps: How often to weigh anew.

    Returns:
        Distances from the line and from the plane (in two dimensions, both from the line), in the unit of the points.
    """
    X = torch.where(present[..., None], X, 0).double()
    found = []
    for axes in (1, 2) if X.shape[-1] > 2 else (1,):
        weights = present.to(X.dtype)
        distance = torch.zeros_like(weights)
        for _ in range(steps):
            total = weights.sum(-1).clamp(min=1e-300)[..., None, None]
            centre = (weights[..., None, :] @ X) / total
            Y = X - centre
            _, vectors = torch.linalg.eigh((Y * weights[..., None]).mT @ Y / total)
            # The axes across: eigenvalues ascend.
            across = Y @ vectors[..., : X.shape[-1] - axes]
            distance = (across * across).sum(-1).sqrt()
            number = present.sum(-1, keepdim=True).clamp(min=1)
            spread = (torch.where(present, distance, 0).sum(-1, keepdim=True) / number).clamp(min=1e-300)
            weights = torch.where(present, spread / (distance + 1e-2 * spread), 0)
        found.append(distance)
    return found[0], found[-1]
