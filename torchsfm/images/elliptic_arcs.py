"""Bent arcs of edge chains: smooth, turning to one side, as long as they can be."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.images.edge_chains import chains_of, order_chains
from torchsfm.images.straight_runs import Runs, axis, straight_runs

_SHARPEST = 0.6 * math.pi
"""Largest turn between neighbouring straight runs of an arc."""
_BENT = 0.7
"""Largest deviation from straightness, in pixels, that a joint's curvature may make of the longer one of its runs, which has at
most the tolerance of straight runs."""
_SPREAD = 1 / 27
"""Root-mean-square deviation from its line of an arc of length and curvature 1."""
_SLACK = 1.5
"""How far outside a tangent edge points may be, in pixels."""


class Arcs(NamedTuple):
    """Arcs in a flat list; each is made of straight runs."""

    number: Int[Tensor, " n"]
    """The arc that each edge point is on."""
    image: Int[Tensor, " arcs"]
    edgels: Int[Tensor, " arcs"]
    """Number of edge points."""
    turn: Float[Tensor, " arcs"]
    """By how much it turns from its first straight run to its last, in radians; positive from the x axis to the y axis."""
    place: Float[Tensor, "arcs 3 2"]
    """Points in the middle of the first, a middle and the last run."""
    direction: Float[Tensor, "arcs 3 2"]
    """Of the arc there."""


def find_arcs(
    x: Float[Tensor, "n 2"],
    variance: Float[Tensor, " n"],
    chain: Int[Tensor, " n"],
    closed: Bool[Tensor, " n"],
    image: Int[Tensor, " n"],
    tolerance: float,
) -> Arcs:
    """Cut chains where they turn back or have corners.

    Chains are cut into straight runs first (`straight_runs`), which are the longer, the larger the radius is. A joint of two
    of them belongs to an arc unless it turns more than the straightness of the longer one allows.
    """
    runs = straight_runs(x, variance, chain, closed, tolerance)
    n, own = len(runs.sums), torch.arange(len(runs.sums), device=x.device)
    chord = _chords(x.double(), chain, closed, runs)
    length = torch.linalg.vector_norm(chord, dim=-1)
    direction = chord / length.clamp_min(1e-12)[:, None]
    then = direction[runs.after]
    cross = direction[:, 0] * then[:, 1] - direction[:, 1] * then[:, 0]
    turn = torch.atan2(cross, (direction * then).sum(-1))
    longer, together = torch.maximum(length, length[runs.after]), length + length[runs.after]
    bent = 2 * turn.abs() / together.clamp_min(1e-12) * longer.square() * _SPREAD
    joined = (runs.after != own) & (length > 0) & (length[runs.after] > 0) & (turn.abs() <= _SHARPEST) & (bent <= _BENT)
    # Where a run bends to one side before and to the other after it, the sharper joint stays.
    behind = runs.before
    opposed = joined & joined[behind] & (behind != own) & (turn * turn[behind] < 0)
    weaker = turn.abs() <= turn[behind].abs()
    cut = (opposed & weaker) | torch.zeros_like(joined).index_put((behind[opposed & ~weaker],), opposed.new_ones(()))
    joined &= ~cut
    of_run = torch.zeros(n, dtype=torch.long, device=x.device).index_copy(0, runs.number, image)
    preceding = torch.where(joined[behind] & (behind != own), behind, own)
    chains = order_chains(preceding, of_run)
    order, start, arc = chains.order, chains.start, chains.chain
    arcs = int(arc[-1]) + 1 if n else 0
    middle, _, _ = axis(runs.sums)
    first = (torch.arange(n, device=x.device) == start).nonzero()[:, 0]
    size = chains.length[first]
    picked = order[first[:, None] + torch.stack((torch.zeros_like(size), (size - 1) // 2, size - 1), -1)]
    of = torch.zeros(n, dtype=torch.long, device=x.device).index_copy(0, order, arc)
    inner = torch.where(joined, turn, 0.0)
    total = turn.new_zeros(arcs).index_add(0, of, inner)
    count = torch.zeros(arcs, dtype=torch.long, device=x.device).index_add(0, of, runs.sums[:, 0].long())
    return Arcs(of[runs.number], of_run[order[first]], count, total, middle[picked], direction[picked])


def compatible_pairs(arcs: Arcs, least_turn: float, most: int) -> Int[Tensor, "pairs 2"]:
    """Pairs of arcs of one image that may be of one convex curve: each is on the inner side of the other's tangents.

    Args:
        arcs: The arcs.
        least_turn: Of both together.
        most: Arcs of an image that are looked at, the longest ones.
    """
    own = torch.arange(len(arcs.turn), device=arcs.turn.device)
    for key in (-arcs.edgels, arcs.image):
        own = own[key[own].argsort(stable=True)]
    image = arcs.image[own]
    number = image.bincount(minlength=1)
    slot = torch.arange(len(own), device=own.device) - (number.cumsum(0) - number)[image]
    kept = slot < most
    width = int(number.clamp_max(most).max())
    table = own.new_full((len(number), width), -1)
    table[image[kept], slot[kept]] = own[kept]
    i, j = torch.triu_indices(width, width, 1, device=own.device)
    pairs = torch.stack((table[:, i], table[:, j]), -1).reshape(-1, 2)
    pairs = pairs[(pairs >= 0).all(-1)]
    pairs = pairs[arcs.turn.abs()[pairs].sum(-1) >= least_turn]
    for a, b in ((0, 1), (1, 0)):
        first, second = pairs[:, a], pairs[:, b]
        away = arcs.place[second][:, None] - arcs.place[first][:, :, None]
        d = arcs.direction[first][:, :, None]
        inwards = (d[..., 0] * away[..., 1] - d[..., 1] * away[..., 0]) * arcs.turn[first].sign()[:, None, None]
        pairs = pairs[(inwards >= -_SLACK).all(-1).all(-1)]
    return pairs


def _chords(x: Tensor, chain: Tensor, closed: Tensor, runs: Runs) -> Tensor:
    """From the first edge point of each run to its last."""
    following = chains_of(chain, closed).neighbour(1)
    inside = runs.number[following] == runs.number
    step = torch.where(inside[:, None], x[following] - x, 0.0)
    return x.new_zeros(len(runs.sums), 2).index_add(0, runs.number, step)
