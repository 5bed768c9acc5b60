"""A few points of many that are as far from each other as may be."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def farthest_points(
    place: Float[Tensor, "p n k"], near: Bool[Tensor, "p n"], most: int
) -> tuple[Int[Tensor, "p most"], Float[Tensor, "p most"]]:
    """So many points, each the farthest from those before (Gonzalez 1985), and how far from them the next one is, squared.

    Args:
        place: Points.
        near: Which of them count, one of each row at least.
        most: How many to take. Those after the last that is apart are arbitrary.
    """
    n = near.shape[-1]
    slot = torch.where(near, torch.arange(n, device=near.device), n - 1).amin(-1)
    least = torch.full_like(place[..., 0], torch.inf)
    slots, squares = [], []
    for _ in range(most):
        slots.append(slot)
        chosen = place.gather(1, slot[:, None, None].expand(-1, 1, place.shape[-1]))
        least = torch.minimum(least, (place - chosen).square().sum(-1))
        farthest, slot = torch.where(near, least, -1).max(-1)
        squares.append(farthest)
    return torch.stack(slots, -1), torch.stack(squares, -1)
