"""How a reduced system is solved: densely, front by front, or by conjugate gradients, by what that seems to take.

Where cameras are a chain, a ring or a grid, little fills in, and a sparse factor takes next to nothing, but conjugate gradients
as many iterations as the chain has links. Where all have to do with all, it is the other way round.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from torchsfm.optim.elimination_order import Front, order_elimination
from torchsfm.optim.fronts import Fronts
from torchsfm.optim.layout import Layout
from torchsfm.optim.multigrid import PairGraph
from torchsfm.optim.schur_pairwise import estimate_pairs
from torchsfm.optim.sparsity import depth, find_met, partners

LARGEST = 9000
"""Columns of the largest reduced system formed without being asked: its square and factor take 1.3 GB."""
FLOP = 1.3e-11
"""Seconds per column cubed of a Cholesky factorisation, on a usual core."""
PASS = 4e-6
"""Seconds per residual of a solution by conjugate gradients, of some 100 iterations."""
HOPS = 10
"""Partners from one end of a scene to the other for which that many will do: each iteration tells the next partner."""
FORMED = 3.5
"""Seconds of forming a sparse system pair by pair that are not too many: the plan of so many pairs takes 1.3 GB."""
WORTH = 0.1
"""Seconds for which it is not worth asking what else would do."""
Solver = Literal["auto", "dense", "sparse", "pcg"]
"""How the reduced system is solved: by a dense or a sparse Cholesky factor, or by conjugate gradients without forming it."""


def too_large(layout: Layout) -> bool:
    """Whether a dense reduced system takes too much memory or time."""
    return layout.size > LARGEST or layout.size**3 * FLOP > _iterations(layout)


def _iterations(layout: Layout) -> float:
    """Seconds of a solution by conjugate gradients."""
    rows = torch.tensor(sum(piece.slots.numel() for piece in layout.pieces), device=layout.device)
    return int(layout.ranks.sum(rows)) * PASS


def plan_fronts(layout: Layout, solver: Solver, *, last: Tensor | None = None, exact: bool = False) -> Fronts | None:
    """How to factor the reduced system as a sparse one; None where something else will do as well.

    Args:
        layout: The problem.
        solver: What was asked for.
        last: Columns that are to be the pivots of the last front.
        exact: Whether conjugate gradients will not do.
    """
    if not layout.size or solver not in ("auto", "sparse"):
        return None
    dense, forming = layout.size**3 * FLOP, 0.0
    if solver == "auto":
        if dense < WORTH or (not exact and PairGraph.fits(layout)):
            return None
        pairs = torch.tensor(sum(map(estimate_pairs, layout.families)), dtype=torch.float64, device=layout.device)
        forming = float(layout.ranks.largest(pairs))
        if dense - forming < WORTH or forming > FORMED:
            return None
    limit = each = math.inf
    if solver == "auto":
        limit = (dense if exact or layout.size <= LARGEST else math.inf) - forming
        each = math.inf if exact else _iterations(layout)
    found = layout.ranks.once(layout.device, _order, layout, find_met(layout), last, limit, each, forming)
    if found is None:
        return None
    fronts, columns, widths = found
    return Fronts(fronts, torch.split(columns, widths))


def _order(
    layout: Layout, met: Tensor, last: Tensor | None, limit: float, each: float, forming: float
) -> tuple[tuple[Front, ...], Tensor, list[int]] | None:
    """The fronts, and the columns of their variables with how many these are.

    None if they take longer than a limit, or than conjugate gradients: those take so many seconds `each` way of ten partners
    from one end to the other, and nothing need be formed for them.
    """
    partner, columns, final = partners(layout, met, last)
    if each < math.inf:
        limit = min(limit, each * max(1.0, depth(partner) / HOPS) - forming)
    widths = [len(c) for c in columns]
    found = order_elimination(tuple(partner), tuple(widths), limit, final)
    if found is None or sum(front.seconds for front in found) > limit:
        return None
    return found, torch.cat(columns), widths
