"""What two models saw at the same places of the images that both have: observations that are one."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

SAME = 0.5
"""Pixels within which two observations in one image are one."""
BLOCK = 1024
"""Observations compared at once with all others of their image."""


def same_observations(
    first: Float[Tensor, "m d"],
    first_view: Int[Tensor, "m"],
    second: Float[Tensor, "n d"],
    second_view: Int[Tensor, "n"],
    both: list[tuple[int, int]],
) -> Int[Tensor, "k 2"]:
    """Pairs of observations that are at the same place in a shared image, each the other's nearest.

    Where several are at the very same place (features of two orientations), the first of the one model is that of the other,
    and so on.

    Args:
        first: Places of the observations of one model, pixels; for what is no point see `segment_places`, `ellipse_places`.
        first_view: Its images that show them.
        second: Those of the other model.
        second_view: Its images.
        both: Images that both have, by their numbers in the one and in the other.
    """
    found = [torch.zeros(0, 2, dtype=torch.long)]
    for i, j in both:
        mine, theirs = (first_view == i).nonzero()[:, 0], (second_view == j).nonzero()[:, 0]
        if not len(mine) or not len(theirs):
            continue
        a, b = _numbered(first[mine]), _numbered(second[theirs])
        distance, nearest = [], []
        back = torch.full((len(theirs),), torch.inf, dtype=a.dtype)
        owner = torch.zeros(len(theirs), dtype=torch.long)
        for start in range(0, len(mine), BLOCK):
            gap = torch.cdist(a[start : start + BLOCK], b, compute_mode="donot_use_mm_for_euclid_dist")
            least = gap.min(dim=1)
            distance.append(least.values)
            nearest.append(least.indices)
            column = gap.min(dim=0)
            owner = torch.where(column.values < back, start + column.indices, owner)
            back = torch.minimum(back, column.values)
        to, near = torch.cat(nearest), torch.cat(distance)
        good = (near <= SAME) & (owner[to] == torch.arange(len(mine)))
        found.append(torch.stack((mine[good], theirs[to[good]]), 1))
    return torch.cat(found)


def _numbered(x: Float[Tensor, "m d"]) -> Float[Tensor, "m d1"]:
    """Places with one more coordinate: how many at the very same place came before."""
    _, place, count = torch.unique(x, dim=0, return_inverse=True, return_counts=True)
    order = torch.argsort(place, stable=True)
    before = torch.empty_like(place)
    before[order] = torch.arange(len(x)) - (count.cumsum(0) - count)[place[order]]
    return torch.cat((x, before[:, None].to(x)), 1)


def segment_places(x: Float[Tensor, "k 2 2"]) -> Float[Tensor, "k 4"]:
    """Where segments are, whichever end comes first: their middles, and half of them at twice their angles."""
    half = (x[:, 1] - x[:, 0]) / 2
    u, v = half.unbind(-1)
    length = torch.linalg.vector_norm(half, dim=-1).clamp_min(torch.finfo(x.dtype).tiny)
    return torch.cat((x.mean(1), torch.stack(((u * u - v * v) / length, 2 * u * v / length), -1)), -1)


def ellipse_places(x: Float[Tensor, "k 5"]) -> Float[Tensor, "k 5"]:
    """Where ellipses are, by centre, semi-axes and angle, as numbers in pixels that hold for circles, too."""
    (a, b), angle = x[:, 2:4].unbind(-1), x[:, 4]
    mean, difference = (a + b) / 2, (a - b) / 2
    return torch.cat((x[:, :2], torch.stack((mean, difference * (2 * angle).cos(), difference * (2 * angle).sin()), -1)), -1)


def joined_numbers(first: Int[Tensor, "k"], second: Int[Tensor, "k"], count: int, others: int) -> Int[Tensor, "n"]:
    """Of each thing of the second model its number in the whole.

    It is the thing of the first model that most of its observations show, too; where none does, a new one after those.

    Args:
        first: What of the first model each shared observation shows.
        second: What of the second one.
        count: How many things the first model has.
        others: How many the second one has.
    """
    votes, number = torch.unique(torch.stack((second, first), 1), dim=0, return_counts=True)
    target = torch.full((others,), -1, dtype=torch.long)
    order = torch.argsort(number, stable=True)
    target[votes[order, 0]] = votes[order, 1]
    alone = target < 0
    target[alone] = count + torch.arange(int(alone.sum()))
    return target
