"""Covariances of retained variables from a sparse factor: blocks of the inverse, without the rest of it.

Where a gauge is free, one front is held along it. With the motions K that cost nothing, in units in which they are orthonormal,
the pseudo-inverse is `(1 - K K') Z (1 - K K')` for the inverse Z of the system so held, whichever front that is.
"""

import torch
from torch import Tensor

from torchsfm.linalg import eigh
from torchsfm.linalg.semidefinite import SHIFT, largest_value, small_null_space
from torchsfm.optim.fronts import Fronts
from torchsfm.optim.normal_equations import NULL, NormalEquations
from torchsfm.optim.undamped import formed, informed

FIRM = 1e-9
"""The least part of each motion's square that the front must have which is held."""


def retained_covariances(
    system: NormalEquations, fronts: Fronts, columns: list[Tensor]
) -> tuple[list[Tensor], int, list[Tensor]] | None:
    """The covariances of variables, the rank of the system, and which eliminated variables of each family are determined.

    They are those of `invert`; None if that must tell.

    Args:
        system: Formed by fronts, of Gauss-Newton.
        fronts: Where its entries are.
        columns: Those of the variables of each block, (variables, k).
    """
    S, _, determined = formed(system)
    root = system.precision.sqrt()[:, None]
    if not bool(S.isfinite().all()):
        return None

    def apply(x: Tensor) -> Tensor:
        return fronts.product(S, x / root) / root

    top = largest_value(apply, root[:, 0])
    factor = fronts.factor(S, SHIFT * top * system.precision)
    if factor is None:
        return None
    almost = factor
    K = small_null_space(apply, lambda x: root * almost.solve(root * x), root[:, 0], NULL * top)
    if K is None:
        return None
    hold = None
    if K.shape[1]:
        widest = fronts.widest()
        mine = fronts.fronts[widest].pivots
        if not bool(eigh(K[mine].mT @ K[mine])[0][0] > FIRM):
            return None
        hold = widest, top.sqrt() * root[mine] * K[mine]
    factor = fronts.factor(S, torch.zeros_like(system.precision), hold)
    if factor is None:
        return None
    Z, Y = factor.inverse(), root * factor.solve(root * K)
    G = K.mT @ Y
    found = []
    for own in columns:
        Ki, Yi, scale = K[own], Y[own], root[own]
        moved = Yi @ Ki.mT
        taken = (moved + moved.mT - Ki @ G @ Ki.mT) / (scale * scale.mT)
        found.append(Z[fronts.places(own[:, :, None], own[:, None])] - taken)
    return found, fronts.size - K.shape[1], determined


def inverse_entries(system: NormalEquations, fronts: Fronts, row: Tensor, column: Tensor) -> Tensor:
    """Entries of the inverse where the matrix has some, 0 where nothing tells of a column; infinite if it is not positive."""
    S = informed(system)
    own = torch.arange(fronts.size, device=S.device)
    held = S[fronts.places(own, own)] <= 0
    factor, none = fronts.factor(S, held.to(S.dtype)), held[row] | held[column]
    if factor is None:
        return torch.full(none.shape, torch.inf, dtype=S.dtype, device=S.device)
    return torch.where(none, 0.0, factor.inverse()[fronts.places(row, column)])
