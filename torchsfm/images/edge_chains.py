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
    start, end, distance = _steps(x.detach(), gradient.detach(), place, b, h, w)
    following, preceding = own.clone(), own.clone()
    for _ in range(_ROUNDS):
        ahead = _nearest(distance, start, end, n)
        behind = _nearest(distance, end, start, n)
        mutual = (ahead.index_select(0, start) == end) & (behind.index_select(0, end) == start)
        one, other = _chosen(mutual, start, end)
        following[one], preceding[other] = other, one
        left = (following.index_select(0, start) == start) & (preceding.index_select(0, end) == end)
        start, end, distance = _chosen(left, start, end, distance)
    return following, preceding


def _steps(x: Tensor, gradient: Tensor, place: Tensor, b: int, h: int, w: int) -> tuple[Tensor, Tensor, Tensor]:
    """All steps forwards from one edge point to another, and their squared lengths."""
    # With two pixels around each image nothing within reach is beyond the map; numbers of 32 bits keep it small.
    wide = w + 4
    at = torch.full((b * (h + 4) * wide,), -1, dtype=torch.int32, device=x.device)
    column, row, image = place % w, place // w % h, place // (h * w)
    here = (image * (h + 4) + row + 2) * wide + column + 2
    at[here] = torch.arange(len(x), dtype=torch.int32, device=x.device)
    firsts, seconds = [], []
    # Each pair once: the second comes later in the list.
    for down, right in [(0, 1), (0, 2), *((j, i) for j in (1, 2) for i in range(-2, 3))]:
        other = at.index_select(0, here + (down * wide + right))
        first = (other >= 0).nonzero()[:, 0]
        firsts.append(first)
        seconds.append(other.index_select(0, first))
    first, second = torch.cat(firsts), torch.cat(seconds).long()
    values = (*x.unbind(-1), *gradient.unbind(-1))
    px, py, gx, gy = (v.index_select(0, first) for v in values)
    qx, qy, kx, ky = (v.index_select(0, second) for v in values)
    dx, dy = qx - px, qy - py
    distance = dx.square() + dy.square()
    side, its_side = gx * dy - gy * dx, kx * dy - ky * dx
    ahead, behind = (side > 0) & (its_side > 0), (side < 0) & (its_side < 0)
    alike = (gx * kx + gy * ky > 0) & (distance <= _REACH**2) & (ahead | behind)
    first, second, forwards, distance = _chosen(alike, first, second, ahead, distance)
    return torch.where(forwards, first, second), torch.where(forwards, second, first), distance


def _chosen(which: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """Those of each list; several at once, as looking for them takes longest."""
    rows = which.nonzero()[:, 0]
    return tuple(v.index_select(0, rows) for v in values)


def _nearest(distance: Tensor, one: Tensor, other: Tensor, n: int) -> Tensor:
    """The nearest other of each one of n, the first in the list where several are; n where there is none."""
    least = distance.new_full((n,), torch.inf).scatter_reduce(0, one, distance, "amin")
    one, other = _chosen(distance == least.index_select(0, one), one, other)
    return torch.full((n,), n, device=one.device).scatter_reduce(0, one, other, "amin")


def order_chains(preceding: Int[Tensor, " n"], image: Int[Tensor, " n"]) -> Chains:
    """Chains of linked edge points, image by image, the longest first."""
    n = len(preceding)
    own = torch.arange(n, device=preceding.device)
    rank, first, least = (preceding != own).long(), preceding.clone(), own.clone()
    ring = _walk_back(preceding, rank, first, least, rank.nonzero()[:, 0])
    # A ring starts at its smallest number.
    head = ring[least[ring] == ring]
    preceding = preceding.index_copy(0, head, head)
    rank[ring], first[ring] = (preceding[ring] != ring).long(), preceding[ring]
    _walk_back(preceding, rank, first, least, ring)
    closed = torch.zeros(n, dtype=torch.bool, device=own.device).index_fill(0, head, True)
    length = torch.zeros_like(own).index_add(0, first, torch.ones_like(own))
    # By image, then by falling length, then by where the chain starts, then along it.
    chains = (first == own).nonzero()[:, 0]
    for key in (-length, image):
        chains = chains[key[chains].argsort(stable=True)]
    length, closed = length[chains], closed[chains]
    start = length.cumsum(0) - length
    begins = torch.empty_like(own).index_copy(0, chains, start)
    order = torch.empty_like(own).index_copy(0, begins[first] + rank, own)
    start, each, closed = (v.repeat_interleave(length) for v in (start, length, closed))
    number = torch.arange(len(chains), device=own.device).repeat_interleave(length)
    return Chains(order, number, start, each, closed)


def chains_of(chain: Int[Tensor, " n"], closed: Bool[Tensor, " n"]) -> Chains:
    """The chains of a list that is in their order already.

    Args:
        chain: Number of each edge point's chain, the same for no two chains next to each other.
        closed: Whether the last one of its chain is next to the first.
    """
    own = torch.arange(len(chain), device=chain.device)
    number, length = torch.unique_consecutive(chain, return_inverse=True, return_counts=True)[1:]
    start = (length.cumsum(0) - length)[number]
    return Chains(own, number, start, length[number], closed)


def _walk_back(preceding: Tensor, rank: Tensor, first: Tensor, least: Tensor, active: Tensor) -> Tensor:
    """Let `first`, which is `rank` steps back, become the start of each one's chain; those in rings, who have none.

    Steps double in each round. `least` becomes the smallest number of a ring. All but `preceding` are changed in place.
    """
    for _ in range(max(1, len(preceding)).bit_length()):
        before = first.index_select(0, active)
        rank[active] += rank.index_select(0, before)
        least[active] = torch.minimum(least.index_select(0, active), least.index_select(0, before))
        before = first.index_select(0, before)
        first[active] = before
        active = active[preceding.index_select(0, before) != before]
    return active


def chain_curvature(x: Float[Tensor, "n 2"], chains: Chains) -> Float[Tensor, " n"]:
    """Signed curvature in 1/pixel, positive where a chain turns from the x axis to the y axis.

    That of the circle through an edge point and the fourth to each side, averaged over five neighbours; near the ends that of
    the first place with so many to each side, and zero in chains that are too short.
    """
    before, after = (x.index_select(0, chains.neighbour(steps)) for steps in (-_HALF, _HALF))
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
