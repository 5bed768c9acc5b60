"""Exact second derivatives of sums of terms: automatic ones, or those that a term has written out.

Written out, those of points in photographs take two fifths of the time.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.optim.loss import Loss
from torchsfm.optim.terms import Block, Term, arguments_of, gather, term_cost

PIECE = 16384
"""Residuals whose second derivatives are written out at once: more take more memory and no less time."""


def curvature(
    term: Term,
    x: dict[str, Tensor],
    blocks: dict[str, Block],
    wanted: Sequence[bool],
    eliminated: str | None,
    slots: tuple[Int[Tensor, "m"], Int[Tensor, "s"]],
) -> tuple[Float[Tensor, "c c s"], Float[Tensor, "c q m"], Float[Tensor, "q q m"]]:
    """The exact second derivatives of the cost, in which the loss's and the residual's own are, so they need not be positive.

    Args:
        term: The residuals.
        x: All variables.
        blocks: The blocks they belong to.
        wanted: The blocks of the term by whose tangent steps to differentiate.
        eliminated: The block that is eliminated.
        slots: The slot of each residual, of s in which all wanted retained variables are the same, and a residual of each.

    Returns:
        Those by the retained variables summed over each slot, by retained and eliminated ones, and by eliminated ones.
    """
    if term.bend is not None:
        return _written_curvature(term, x, blocks, wanted, eliminated, slots)
    slot, some = slots
    kept, point, moved = [], [], []
    with torch.enable_grad():
        arguments = arguments_of(term, x, None)
        for name, a, index, w in zip(term.blocks, arguments, term.index, wanted, strict=True):
            if not w:
                moved.append(a)
            elif name == eliminated:
                point.append(a.new_zeros((blocks[name].tangent, len(a))).requires_grad_())
                moved.append(blocks[name].retract(a, point[-1].mT))
            else:
                kept.append(a.new_zeros((blocks[name].tangent, len(some))).requires_grad_())
                each = blocks[name].retract(gather(x[name], index[some]), kept[-1].mT)
                # Fixed variables, whichever they are, share a slot: they stay.
                same = index == index[some][slot]
                moved.append(torch.where(same, each.mT.index_select(1, slot), a.mT).mT)
        cost = term_cost(term, term.residual(*moved, *term.data))
        by_kept, by_point = second_rows(cost, kept, [*kept, *point]), second_rows(cost, point, point)
    size = sum(len(k) for k in kept)
    empty = x[term.blocks[0]].new_zeros
    U = torch.stack([torch.cat(row[: len(kept)]) for row in by_kept]) if kept else empty((0, 0, len(some)))
    if not point:
        return U, empty((size, 0, len(slot))), empty((0, 0, len(slot)))
    W = torch.stack([row[-1] for row in by_kept]) if kept else empty((0, len(point[0]), len(slot)))
    return U, W, torch.stack([row[0] for row in by_point])


def _written_curvature(
    term: Term,
    x: dict[str, Tensor],
    blocks: dict[str, Block],
    wanted: Sequence[bool],
    eliminated: str | None,
    slots: tuple[Int[Tensor, "m"], Int[Tensor, "s"]],
) -> tuple[Float[Tensor, "c c s"], Float[Tensor, "c q m"], Float[Tensor, "q q m"]]:
    """As `curvature`, from derivatives that are written out."""
    assert term.linearize is not None, "it comes with bend"
    assert term.bend is not None, "asked before"
    slot, some = slots
    widths = [blocks[name].tangent * w for name, w in zip(term.blocks, wanted, strict=True)]
    ends = torch.tensor(widths, device=slot.device).cumsum(0)
    last = torch.tensor([name == eliminated for name in term.blocks], device=slot.device)
    of_point = last.repeat_interleave(torch.tensor(widths, device=slot.device))
    kept, point = (~of_point).nonzero()[:, 0], of_point.nonzero()[:, 0]
    above = torch.triu_indices(len(kept), len(kept), device=slot.device)

    def entries(H: Tensor, a: Tensor, b: Tensor) -> Tensor:
        return H[torch.minimum(a, b), torch.maximum(a, b)]

    arguments, n, squares = arguments_of(term, x, None), sum(widths), x[term.blocks[0]].new_zeros((above.shape[1], len(some)))
    W, V = squares.new_empty((len(kept), len(point), len(slot))), squares.new_empty((len(point), len(point), len(slot)))
    for start in range(0, len(slot), PIECE):
        rows = slice(start, start + PIECE)
        data = [d[rows] for d in (*arguments, *term.data)]
        r = term.residual(*data)
        J = r.new_empty((r.shape[1], n, len(r)))
        blockwise = zip(ends.tolist(), widths, strict=True)
        term.linearize(*data, out=[J[:, end - w : end].permute(2, 0, 1) if w else None for end, w in blockwise])
        slope, M = r.mT, torch.eye(r.shape[1], dtype=r.dtype, device=r.device)[:, :, None]
        if term.loss is not None:
            first, second = _loss_slopes(term.loss, r.square().sum(-1))
            slope, M = first * slope, first * M + 2 * second * slope[:, None] * slope
        if term.weights is not None:
            slope, M = term.weights[rows] * slope, term.weights[rows] * M
        H = term.bend(*data, by=slope, wanted=wanted)
        MJ = product(M, J)
        for i in range(n):
            for a in range(len(J)):
                H[i, i:].addcmul_(J[a, i], MJ[a, i:])
        squares.scatter_add_(1, slot[rows].expand(above.shape[1], -1), entries(H, *kept[above]))
        W[..., rows], V[..., rows] = entries(H, kept[:, None], point), entries(H, point[:, None], point)
    U = squares.new_empty((len(kept), len(kept), len(some)))
    U[above[0], above[1]] = U[above[1], above[0]] = squares
    return U, W, V


def product(A: Float[Tensor, "a b #m"], B: Float[Tensor, "b c #m"]) -> Float[Tensor, "a c m"]:
    """Products of many matrices, each with its number last."""
    C = A[:, 0, None] * B[0]
    for b in range(1, A.shape[1]):
        C.addcmul_(A[:, b, None], B[b])
    return C


def _loss_slopes(loss: Loss, square: Float[Tensor, "m"]) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """First and second derivatives of a loss."""
    with torch.enable_grad():
        leaf = square.detach().requires_grad_()
        (first,) = torch.autograd.grad(loss(leaf).sum(), leaf, create_graph=True)
        if not first.requires_grad:
            return first, torch.zeros_like(first)
        (second,) = torch.autograd.grad(first.sum(), leaf, materialize_grads=True)
    return first.detach(), second


def second_rows(cost: Tensor, by: list[Tensor], then: list[Tensor]) -> list[tuple[Tensor, ...]]:
    """The derivatives of a cost by the rows of some leaves, and of each of these, summed, by all rows of others."""
    if not by or not cost.requires_grad:
        return [tuple(torch.zeros_like(leaf) for leaf in then) for leaf in by for _ in leaf]
    slopes = torch.autograd.grad(cost, by, create_graph=True, materialize_grads=True)
    rows = [row for slope in slopes for row in slope]
    return [
        torch.autograd.grad(row.sum(), then, retain_graph=True, materialize_grads=True)
        if row.requires_grad
        else tuple(torch.zeros_like(leaf) for leaf in then)
        for row in rows
    ]
