"""How does what is seen of an ellipse end: where its edge stops or has a corner, or where the edge goes smoothly on, off it?"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm.images.edge_chains import Chains
from torchsfm.images.ellipse_support import EdgeMap, Support

_GONE = 6
"""Edge points of a chain, one after the other, that are off the ellipse where it has left it."""
_BEHIND = 5
"""Edge points before an end whose chord is the arc's direction there."""
_BEYOND = 2, 8
"""Edge points after an end whose chord is the direction in which the chain leaves: the very next may be of the joint."""
_SMOOTH = 0.5
"""Largest turn from the one to the other, in radians, of a chain that has no corner."""


class ArcEnds(NamedTuple):
    """Of each ellipse, numbers of the ends of its arcs."""

    all: Int[Tensor, " ellipses"]
    smooth: Int[Tensor, " ellipses"]
    """Of those, where the chain goes on without a corner."""


def arc_ends(support: Support, edges: EdgeMap, chains: Chains) -> ArcEnds:
    """Count the ends of arcs, both ends of every stretch of a chain that is on an ellipse.

    What hides a part of an ellipse has an edge of its own, which makes a corner with the ellipse's; a smooth curve that an
    ellipse only touches goes on without one.

    Args:
        support: Edge points that are on ellipses; rows that are not aligned do not count.
        edges: All edge points.
        chains: Their chains.
    """
    ellipse, edgel = support.ellipse[support.aligned], support.edgel[support.aligned]
    number = max(len(edges.x), 1)
    taken = ellipse * number + edgel

    def on(at: Tensor) -> Bool[Tensor, " rows"]:
        """Whether edge points are on the ellipses of the rows."""
        key = ellipse * number + at
        return taken[torch.searchsorted(taken, key).clamp_max(len(taken) - 1)] == key

    n = len(support.coverage)
    everything = smooth = torch.zeros(n, dtype=torch.long, device=ellipse.device)
    for side in (1, -1):
        end = torch.ones_like(ellipse, dtype=torch.bool)
        for k in range(1, _GONE + 1):
            at = chains.neighbour(side * k)[edgel]
            end &= ~(_exists(chains, side * k)[edgel] & on(at))
        end &= _exists(chains, -side * _BEHIND)[edgel]
        here = edgel[end]
        behind, first, last = (chains.neighbour(side * k)[here] for k in (-_BEHIND, *_BEYOND))
        before, after = edges.x[here] - edges.x[behind], edges.x[last] - edges.x[first]
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        turn = torch.atan2(cross, (before * after).sum(-1)).abs()
        # An edge that crosses the ellipse goes on, too, but has not been on it.
        stays = on(chains.neighbour(-side * _BEHIND)[edgel])[end]
        goes_on = stays & _exists(chains, side * _BEYOND[1])[here] & (turn < _SMOOTH)
        everything = everything + ellipse[end].bincount(minlength=n)
        smooth = smooth + ellipse[end][goes_on].bincount(minlength=n)
    return ArcEnds(everything, smooth)


def _exists(chains: Chains, steps: int) -> Bool[Tensor, " n"]:
    """Whether somebody comes so many steps later."""
    nearer = steps - 1 if steps > 0 else steps + 1
    return chains.neighbour(steps) != chains.neighbour(nearer)
