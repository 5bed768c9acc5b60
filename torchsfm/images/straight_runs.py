"""Straight runs of edge chains: neighbouring pieces grow together while one line is enough for both."""

from typing import NamedTuple

import torch
from torch import Tensor

_PIECE = 5
"""Edge points of the pieces that everything starts from."""


class Runs(NamedTuple):
    """Pieces of chains, one row each, linked in rings or rows; the sums are over their edge points."""

    number: Tensor
    """Which run each edge point is in (n)."""
    sums: Tensor
    """Number of points and sums of x, y, xx, xy, yy, (runs, 6)."""
    before: Tensor
    """The run before it in its chain, itself where there is none."""
    after: Tensor


def moments(x: Tensor, number: Tensor, runs: int, chosen: Tensor | None = None) -> Tensor:
    """The sums (runs, 6) over points x (n, 2), or over those that are chosen."""
    a, b = x.double().unbind(-1)
    rows = torch.stack((torch.ones_like(a), a, b, a * a, a * b, b * b), -1)
    if chosen is not None:
        rows = rows * chosen[:, None]
    return rows.new_zeros(runs, 6).index_add(0, number, rows)


def axis(sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Middle (runs, 2), unit direction (runs, 2) and sum of squared distances (runs) of the line of least squares."""
    n, a, b, aa, ab, bb = sums.unbind(-1)
    n = n.clamp_min(1)
    middle = torch.stack((a, b), -1) / n[:, None]
    xx, xy, yy = aa - a * a / n, ab - a * b / n, bb - b * b / n
    half, mean = 0.5 * (xx - yy), 0.5 * (xx + yy)
    root = (half * half + xy * xy).sqrt()
    # Of the two ways to write the direction the one that does not cancel.
    flat = half >= 0
    direction = torch.stack((torch.where(flat, root + half, xy), torch.where(flat, xy, root - half)), -1)
    length = direction.square().sum(-1, keepdim=True).sqrt()
    direction = torch.where(length > 0, direction / torch.where(length > 0, length, 1.0), direction.new_tensor([1.0, 0.0]))
    return middle, direction, (mean - root).clamp_min(0)


def straight_runs(x: Tensor, variance: Tensor, chain: Tensor, closed: Tensor, tolerance: float) -> Runs:
    """Runs of edge points x (n, 2) with variances (n) in chains that are numbered in order.

    Two neighbours become one where that adds to the squared distances no more, for each point of the smaller one, than the
    square of the tolerance and twice the noise; the best pairs first.
    """
    n = len(x)
    own = torch.arange(n, device=x.device)
    begins = torch.ones(n, dtype=torch.bool, device=x.device)
    begins[1:] = chain[1:] != chain[:-1]
    start = torch.where(begins, own, 0).cummax(0).values
    begins = begins | ((own - start) % _PIECE == 0)
    number = begins.long().cumsum(0) - 1
    runs = int(begins.sum())
    # The middle of the image would do as well: sums of squares should be small.
    centre = x.double()
    sums = moments(centre, number, runs)
    noise = x.new_zeros(runs, dtype=torch.float64).index_add(0, number, variance.double())
    first = own[begins]
    of, ring = chain[first], closed[first]
    own = own[:runs]
    joined = of[1:] == of[:-1]
    after, before = own.clone(), own.clone()
    after[:-1] = torch.where(joined, own[1:], own[:-1])
    before[1:] = torch.where(joined, own[:-1], own[1:])
    # The last run of a ring is before the first one.
    head, tail = (before == own) & ring, (after == own) & ring
    after, before = after.index_copy(0, own[tail], own[head]), before.index_copy(0, own[head], own[tail])
    parent = own
    while True:
        cost = _cost(sums, noise, after, tolerance**2)
        ahead, behind = cost[after], torch.where(before == own, torch.inf, cost[before])
        best = (cost < torch.inf) & ((cost < ahead) | ((cost == ahead) & (own < after)))
        best &= (cost < behind) | ((cost == behind) & (own < before))
        left = best.nonzero()[:, 0]
        if not len(left):
            break
        right = after[left]
        sums = sums.index_add(0, left, sums[right]).index_fill(0, right, 0)
        noise = noise.index_add(0, left, noise[right]).index_fill(0, right, 0)
        parent = parent.index_copy(0, right, left)
        then = after[right]
        # The two may have been all of a ring.
        then = torch.where(then == left, left, then)
        after = after.index_copy(0, left, then).index_copy(0, right, right)
        ends = then == right
        after = after.index_copy(0, left[ends], left[ends])
        before = before.index_copy(0, then[~ends], left[~ends]).index_copy(0, right, right)
    for _ in range(max(runs, 1).bit_length()):
        parent = parent[parent]
    return Runs(parent[number], sums, before, after)


def _cost(sums: Tensor, noise: Tensor, after: Tensor, square: float) -> Tensor:
    """What joining each run with the next adds, for each point; infinite where it is too much."""
    together = sums + sums[after]
    alone = axis(sums)[2]
    added = axis(together)[2] - alone - alone[after]
    fewer = torch.minimum(sums[:, 0], sums[after][:, 0])
    allowed = square + 2 * (noise + noise[after]) / together[:, 0].clamp_min(1)
    mean = axis(together)[2] / together[:, 0].clamp_min(1)
    own = torch.arange(len(after), device=after.device)
    good = (after != own) & (fewer > 0) & (added <= allowed * fewer) & (mean <= allowed)
    return torch.where(good, added.clamp_min(0) / fewer.clamp_min(1), torch.inf)
