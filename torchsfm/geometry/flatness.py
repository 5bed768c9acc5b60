"""Do points lie on a line, or in a plane?"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.linalg import eigh


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

    Example:
        >>> import torch, torchsfm
        >>> X = torch.tensor([[-2.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
        >>> line, plane = torchsfm.geometry.line_and_plane_distances(X, torch.ones(5, dtype=torch.bool), steps=20)
        >>> bool(line[:4].max() < 0.1), bool(line[4] > 2.9), bool(plane.max() < 1e-4)
        (True, True, True)
    """
    check_tensors(X=(X, "n d>=2"), present=(present, "n: bool"))
    check_options(steps=(steps, "int >= 1"))
    X = torch.where(present[..., None], X, 0).double()
    found = []
    for axes in (1, 2) if X.shape[-1] > 2 else (1,):
        weights = present.to(X.dtype)
        distance = torch.zeros_like(weights)
        for _ in range(steps):
            total = weights.sum(-1).clamp(min=1e-300)[..., None, None]
            centre = (weights[..., None, :] @ X) / total
            Y = X - centre
            _, vectors, _ = eigh((Y * weights[..., None]).mT @ Y / total)
            # The axes across: eigenvalues ascend.
            across = Y @ vectors[..., : X.shape[-1] - axes]
            distance = (across * across).sum(-1).sqrt()
            number = present.sum(-1, keepdim=True).clamp(min=1)
            spread = (torch.where(present, distance, 0).sum(-1, keepdim=True) / number).clamp(min=1e-300)
            weights = torch.where(present, spread / (distance + 1e-2 * spread), 0)
        found.append(distance)
    return found[0], found[-1]


def least_number_off(
    X: Float[Tensor, "*#batch n d"], present: Bool[Tensor, "*#batch n"], tolerance: Float[Tensor, "*#batch #n"]
) -> Int[Tensor, "*batch"]:
    """How many points are farther than a tolerance from any hyperplane whatsoever (in two dimensions, line), at least.

    The number of disjoint simplices, of points that follow one another, that fit between no two hyperplanes twice the tolerance
    apart: of each, one corner or more is off. With the edges D from one corner, the width of a simplex in the direction of a
    unit vector u is at least max |D u| >= 1 / (|D^-1| sqrt(d)).

    Args:
        X: Points.
        present: Which points count.
        tolerance: Of each point, in the unit of the points.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 0.0], [6.0, 0.0], [5.0, 1.0]])
        >>> torchsfm.geometry.least_number_off(x, torch.ones(6, dtype=torch.bool), torch.full((6,), 0.1))  # two triangles
        tensor(2)
    """
    batch = check_tensors(X=(X, "n d>=1"), present=(present, "n: bool"), tolerance=(tolerance, "k"))
    n, d = X.shape[-2:]
    if tolerance.shape[-1] not in (1, n):
        raise ValueError(f"tolerance: wanted 1 or {n} in the last dimension, got shape {tuple(tolerance.shape)}")
    X, present = X.expand(*batch, n, d), present.expand(*batch, n)
    number = n // (d + 1)
    place = present.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[..., : number * (d + 1)]
    corners = X.gather(-2, place[..., None].expand(*place.shape, d)).reshape(*place.shape[:-1], number, d + 1, d)
    wide = tolerance
    if tolerance.shape[-1] > 1:
        wide = tolerance.expand(present.shape).gather(-1, place).reshape(corners.shape[:-1]).amax(-1)
    inverse, info = torch.linalg.inv_ex(corners[..., 1:, :] - corners[..., :1, :])
    thick = (inverse * inverse).sum((-2, -1)) * (wide * wide) * (4 * d) < 1
    full = torch.arange(1, number + 1, device=X.device) * (d + 1) <= present.sum(-1, keepdim=True)
    least: Tensor = (thick & full & (info == 0)).sum(-1)
    return least
