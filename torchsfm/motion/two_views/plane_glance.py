"""A glance at some points of an epipolar geometry: can many of them be in one plane?

With x2 ~ A x1 + r e2, a plane is a v with r = v' x1 for its points (see `plane_and_parallax`). To first order, the transfer
error is |v' x1 - r| times how far the second point moves with r: linear in v, so that one product of matrices gives the errors
of all points for the planes of many triples.
"""

from functools import cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_TRIPLES = 48
"""Planes to try. If half of the inliers are in one plane, so is an eighth of the triples, and none of these with a probability
of (7/8)^48 = 0.2 %; if 60 %, of 1e-5."""
_SHARE = 0.3
"""Suspicious share of the inliers, each counted as 1 - squared error over squared limit: the plane of three noisy points
collects less than it holds. Where it holds half, 1 % stay below; where 60 %, 0.2 %; of scenes without planes, 90 %."""


def plane_suspected(
    A: Float[Tensor, "p 3 3"],
    e: Float[Tensor, "p 3"],
    h1: Float[Tensor, "p 3 n"],
    h2: Float[Tensor, "p 3 n"],
    inliers: Bool[Tensor, "p n"],
    limit: Float[Tensor, "p"],
    spare: Float[Tensor, "p"],
) -> Bool[Tensor, "p"]:
    """Whether one plane may hold half of the inliers, or all but a few. What is not suspected almost never is so.

    Args:
        A: A homography that agrees with the epipolar geometry.
        e: The epipole in the second image.
        h1: The first points, homogeneous, or rays: a part spread over all data.
        h2: The second points, or rays of unit length.
        inliers: Which points agree with the epipolar geometry.
        limit: Squared largest transfer error.
        spare: How many inliers aside of the plane do not clear it.
    """
    _, least = best_triple(plane_errors(A, e, h1, h2, limit), inliers)
    count = inliers.sum(-1)
    off: Tensor = least - (inliers.shape[-1] - count)
    return (off < (1 - _SHARE) * count.double()) | (off <= spare)


def plane_errors(
    A: Float[Tensor, "p 3 3"],
    e: Float[Tensor, "p 3"],
    h1: Float[Tensor, "p 3 n"],
    h2: Float[Tensor, "p 3 n"],
    limit: Float[Tensor, "p"],
) -> Float[Tensor, "p 4 n"]:
    """The rows a, a, a, b of which v' a - b is the transfer error of a plane v in units of the limit, to first order."""
    side = e[:, :, None]
    y = torch.bmm(A, h1)
    b = torch.linalg.cross(h2, side, dim=1)
    share, square = (torch.stack((torch.linalg.cross(y, h2, dim=1), b)) * b).sum(2, keepdim=True).unbind(0)
    depth = share / square
    y = torch.addcmul(y, side, depth)
    scale = (square / ((y * y).sum(1, keepdim=True) * limit[:, None, None])).sqrt()
    # A point at the epipole is on every plane.
    return torch.cat((h1, depth), 1).mul_(scale).nan_to_num_(nan=0.0)


def best_triple(rows: Float[Tensor, "p 4 n"], inliers: Bool[Tensor, "p n"]) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p"]]:
    """The plane through three of the inliers with the least sum of squared errors, none counted for more than 1.

    Where no triple determines a plane, nothing is known: zeros.
    """
    # An outlier is far from every plane.
    rows = torch.cat((rows[:, :3], torch.where(inliers, rows[:, 3], torch.inf)[:, None]), 1)
    # The inliers that a triple takes are at three places of their order.
    place = (inliers.sum(-1, keepdim=True) * _places(rows.dtype, rows.device)).long()
    place = inliers.to(torch.int8).argsort(dim=-1, descending=True, stable=True).gather(-1, place)
    corners = rows.gather(-1, place[:, None].expand(-1, 4, -1)).view(-1, 4, 3, _TRIPLES).permute(0, 3, 2, 1)
    v = torch.linalg.solve_ex(corners[..., :3], corners[..., 3])[0]
    error = torch.baddbmm(rows[:, 3:], v, rows[:, :3], beta=-1)
    # In place: with so many numbers new memory costs more than arithmetic.
    loss, best = error.mul_(error).clamp_(max=1).sum(-1).nan_to_num_(nan=torch.inf).min(-1)
    v = v.gather(1, best[:, None, None].expand(-1, -1, 3))[:, 0]
    return v.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0), loss.nan_to_num_(posinf=0.0)


@cache
def _places(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "m"]:
    """Where in an order from 0 to 1 the corners of the triples are: first all first corners, one in each third."""
    step = torch.arange(1, _TRIPLES + 1, dtype=dtype)
    # Multiples of irrational numbers, independent of each other.
    parts = [(step * factor) % 1 for factor in (0.7548776662466927, 0.5698402909980532, 0.4142135623730951)]
    return torch.cat([(i + part) / 3 for i, part in enumerate(parts)]).to(device)
