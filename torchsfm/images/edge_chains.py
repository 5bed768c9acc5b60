"""Edge points linked into chains: who follows whom, which chain is it, and how does it bend?"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_REACH = 2.2
"""Longest distance between neighbours, in pixels."""
_ROUNDS = 3
"""Matings: those that found nobody choose again among those that are left."""
_HALF = 4
"""Edge points to each side that tell the curvature."""


class Chains(NamedTuple):
    """A flat list of edge points, chain by chain, each in order."""

    order: Int[Tensor, " n"]
    """Where each edge point stood in the list that was linked."""
    chain: Int[Tensor, " n"]
    """Number of its chain, in the order of the list."""
    start: Int[Tensor, " n"]
    """Where its chain starts in the list."""
    length: Int[Tensor, " n"]
    """How many edge points its chain has."""
    closed: Bool[Tensor, " n"]
    """Whether the last one of its chain is next to the first."""

    def neighbour(self, steps: int | Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Who comes so many steps later in the same chain; in an open one nobody comes after its ends."""
        rank = torch.arange(len(self.start), device=self.start.device) - self.start + steps
        last = (self.length - 1).clamp_min(0)
        inside = torch.minimum(rank.clamp_min(0), last)
        return self.start + torch.where(self.closed, rank % self.length.clamp_min(1), inside)


def link_edgels(
    x: Float[Tensor, "n 2"], gradient: Float[Tensor, "n 2"], place: Int[Tensor, " n"], shape: tuple[int, int, int]
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Next and previous edge point of each, itself at an end; `next[previous[i]] == i` wherever there is one.

    A neighbour in front lies within two pixels on the side to which a walk with the bright side to the left leads, as seen on
    the screen, for both of them; the nearest one is chosen, and kept where the choice is mutual (Devernay 1995).

    Args:
        x: Positions.
        gradient: Of the image there.
        place: The pixel of each, image by image and row by row.
        shape: Number of images, height and width.
    """
    b, h, w = shape
    n = len(x)
    own = torch.arange(n, device=x.device)
    at = torch.full((b * h * w,), -1, dtype=torch.long, device=x.device)
    at[place] = own
    steps = [(dx, dy) for dy in range(-2, 3) for dx in range(-2, 3) if dx or dy]
    dx, dy = torch.tensor(steps, device=x.device).unbind(-1)
    column, row = place % w, place // w % h
    inside = (column[:, None] + dx >= 0) & (column[:, None] + dx < w) & (row[:, None] + dy >= 0) & (row[:, None] + dy < h)
    who = at[torch.where(inside, place[:, None] + dy * w + dx, 0)]
    who = torch.where(inside, who, -1)
    other = who.clamp_min(0)
    d = x[other] - x[:, None]
    distance = d.square().sum(-1)
    its = gradient[other]
    side = gradient[:, None, 0] * d[..., 1] - gradient[:, None, 1] * d[..., 0]
    its_side = its[..., 0] * d[..., 1] - its[..., 1] * d[..., 0]
    alike = (who >= 0) & ((its * gradient[:, None]).sum(-1) > 0) & (distance <= _REACH**2)
    front, back = alike & (side > 0) & (its_side > 0), alike & (side < 0) & (its_side < 0)
    following, preceding = own.clone(), own.clone()
    for _ in range(_ROUNDS):
        ends, starts = following == own, preceding == own
        ahead = _nearest(distance, front & ends[:, None] & starts[other], other)
        behind = _nearest(distance, back & starts[:, None] & ends[other], other)
        mutual = (ahead >= 0) & (behind[ahead.clamp_min(0)] == own)
        following = torch.where(mutual, ahead, following)
        mutual = (behind >= 0) & (ahead[behind.clamp_min(0)] == own)
        preceding = torch.where(mutual, behind, preceding)
    return following, preceding


def _nearest(distance: Tensor, candidate: Tensor, who: Tensor) -> Tensor:
    """The nearest candidate, -1 where there is none."""
    least, column = torch.where(candidate, distance, torch.inf).min(-1)
    return torch.where(least < torch.inf, who.gather(-1, column[:, None])[:, 0], -1)


def order_chains(preceding: Int[Tensor, " n"], image: Int[Tensor, " n"]) -> Chains:
    """Chains of linked edge points, image by image, the longest first."""
    n = len(preceding)
    own = torch.arange(n, device=preceding.device)
    rounds = max(1, n).bit_length()
    # A ring starts at its smallest number.
    least, jump = own, preceding
    for _ in range(rounds):
        least = torch.minimum(least, least[jump])
        jump = jump[jump]
    ring = preceding[jump] != jump
    preceding = torch.where(ring & (least == own), own, preceding)
    rank, jump = (preceding != own).long(), preceding
    for _ in range(rounds):
        rank = rank + rank[jump]
        jump = jump[jump]
    length = torch.zeros_like(own).index_add(0, jump, torch.ones_like(own))[jump]
    # By image, then by falling length, then by where the chain starts, then along it.
    order = own
    for key in (rank, jump, -length, image):
        order = order[key[order].argsort(stable=True)]
    length, rank = length[order], rank[order]
    start = own - rank
    return Chains(order, (rank == 0).cumsum(0) - 1, start, length, ring[order])


def chain_curvature(x: Float[Tensor, "n 2"], chains: Chains) -> Float[Tensor, " n"]:
    """Signed curvature in 1/pixel, positive where a chain turns from the x axis to the y axis.

    That of the circle through an edge point and the fourth to each side, averaged over five neighbours; near the ends that of
    the first place with so many to each side, and zero in chains that are too short.
    """
    before, after = x[chains.neighbour(-_HALF)], x[chains.neighbour(_HALF)]
    a, b = x - before, after - x
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    sides = a.square().sum(-1) * b.square().sum(-1) * (a + b).square().sum(-1)
    circle = 2 * area / sides.clamp_min(1e-12).sqrt()
    circle = torch.where(chains.length > 2 * _HALF, circle, 0.0)
    rank = torch.arange(len(x), device=x.device) - chains.start
    inner = torch.minimum(rank.clamp_min(_HALF), (chains.length - 1 - _HALF).clamp_min(0))
    reach = torch.where(chains.closed, rank, inner)
    total = circle[_at(chains, reach)]
    for k in (1, 2):
        total = total + (circle[_at(chains, reach - k)] + circle[_at(chains, reach + k)])
    return total / 5


def _at(chains: Chains, rank: Tensor) -> Tensor:
    """Where in the list the edge point of this rank in each one's chain is; inside an open chain with its curvature known."""
    last = (chains.length - 1 - _HALF).clamp_min(0)
    inside = torch.minimum(torch.maximum(rank, last.clamp_max(_HALF)), last)
    return chains.start + torch.where(chains.closed, rank % chains.length.clamp_min(1), inside)
