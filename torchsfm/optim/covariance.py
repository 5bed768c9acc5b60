"""The covariance of a minimum: how far variables would move if the measurements were made again.

To first order it is the inverse of the Gauss-Newton matrix, in tangent coordinates, for residuals in units of their standard
deviation (HZ 5.2). Where a gauge is free it is the covariance in the gauge in which the retained variables move least (Triggs
et al. 2000, 9): differences and shapes are meaningful, absolute positions only with that convention.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.optim.layout import lay_out
from torchsfm.optim.loss import loss_slope
from torchsfm.optim.schur import Elimination
from torchsfm.optim.terms import Block, Term, check_eliminate, prepare, term_residual


@dataclass(frozen=True)
class SparseCovariance:
    """Covariances of all variables of a problem of terms.

    `blocks` holds the covariance of each variable by itself, `(N, tangent, tangent)`: zero where it is fixed, infinite on the
    diagonal where `determined` is False (nothing depends on it, or too little). `joint` is the covariance of all free retained
    variables together, and `columns` says where each of them stands there, -1 where it does not. `nullity` counts the
    dimensions of the gauge (7 for a bundle without anything fixed; more means that something is not determined).
    `redundancy` is the number of residual components minus the number of unknowns determined: at a good fit `square_sum`, the
    weighted sum of squared residuals, is about that.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Term
        >>> x = Block(torch.zeros(2, 2))
        >>> first = torch.zeros(4, dtype=torch.int64)
        >>> measured = Term(lambda x: x, ("x",), (first,))  # the first variable four times, the second never
        >>> found = torchsfm.optim.sparse_covariance({"x": x}, [measured])
        >>> found.blocks["x"][0], found.determined["x"]
        (tensor([[0.2500, 0.0000],
                [0.0000, 0.2500]], dtype=torch.float64), tensor([ True, False]))
        >>> found.redundancy, found.square_sum
        (6, 0.0)
    """

    blocks: dict[str, Tensor]
    determined: dict[str, Tensor]
    joint: Float[Tensor, "size size"]
    columns: dict[str, Tensor]
    nullity: int
    redundancy: int
    square_sum: float


def sparse_covariance(
    blocks: Mapping[str, Block],
    terms: Sequence[Term],
    *,
    eliminate: str | Sequence[str] | None = None,
    of_eliminated: bool = True,
) -> SparseCovariance:
    """Compute covariances at a minimum.

    Args:
        blocks: Variables at the minimum.
        terms: Residuals in units of their standard deviation; those that are not finite are left out.
        eliminate: The blocks to eliminate, as in `sparse_levenberg_marquardt`.
        of_eliminated: Whether covariances of the eliminated variables are wanted too, which are most of the work. Without,
            theirs are infinite.

    Returns:
        The covariances, float64.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Term
        >>> x = Block(torch.zeros(1, 2))
        >>> measured = Term(lambda x: x, ("x",), (torch.zeros(4, dtype=torch.int64),))  # four times, sigma 1
        >>> found = torchsfm.optim.sparse_covariance({"x": x}, [measured])
        >>> found.blocks["x"][0].diagonal(), found.nullity, found.redundancy
        (tensor([0.2500, 0.2500], dtype=torch.float64), 0, 6)
    """
    _check(blocks, terms, eliminate)
    with torch.no_grad():
        double, counted, _ = prepare(blocks, terms)
        x = {name: b.x for name, b in double.items()}
        layout = lay_out(double, counted, eliminate)
        engine = Elimination(double, layout, "dense", spread=of_eliminated)
        inverse = engine.linearize(x).invert()
        eliminated = {}
        if of_eliminated:
            points = zip(layout.families, inverse.point_covariances(), inverse.determined, strict=True)
            eliminated = {family.name: (of_points, good) for family, of_points, good in points}
        squares = sum((_square_sum(part.term, x) for part in engine.parts), 0.0)
        rows = sum(part.components * part.term.index[0].shape[0] for part in engine.parts)
    found: dict[str, Tensor] = {}
    determined: dict[str, Tensor] = {}
    columns: dict[str, Tensor] = {}
    for name, block in double.items():
        count, width = block.x.shape[0], block.tangent
        free = layout.free[name]
        known = torch.zeros(count, dtype=torch.bool, device=free.device) if block.fixed is None else block.fixed.clone()
        covariance = block.x.new_zeros((count, width, width))
        covariance[~known] = torch.diag(block.x.new_full((width,), torch.inf))
        place = torch.full((count, width), -1, device=free.device)
        if name in eliminated:
            of_points, good = eliminated[name]
            known[free[good]] = True
            covariance[free[good]] = of_points[good]
        elif name in layout.first:
            place[free] = layout.first[name] + torch.arange(free.numel() * width, device=free.device).view(-1, width)
            kept = inverse.kept[place[free][:, :, None], place[free][:, None]]
            known[free] = kept.isfinite().all(-1).all(-1)
            covariance[free] = torch.where(known[free][:, None, None], kept, covariance[free])
        found[name], determined[name], columns[name] = covariance, known, place
    families = zip(layout.families, inverse.determined, strict=True)
    nullity = layout.size - inverse.rank
    unknowns = layout.size - nullity + sum(int(good.sum()) * family.point_size for family, good in families)
    return SparseCovariance(found, determined, inverse.kept, columns, nullity, rows - unknowns, squares)


def marginal_covariance(
    blocks: Mapping[str, Block], terms: Sequence[Term], name: str, *, eliminate: str | Sequence[str] | None = None
) -> Float[Tensor, "n k k"]:
    """The covariance of each variable of one block alone, which costs no more than a step.

    The block must not be the one eliminated, and nothing in it may be part of the gauge. Zero where a variable is fixed, or
    held in a coordinate; infinite where the terms do not determine the block; residuals in units of their standard deviation,
    as in `sparse_covariance`.

    Args:
        blocks: The variables by name, at the optimum.
        terms: The residuals of which it is the optimum.
        name: The block whose covariance is wanted.
        eliminate: Blocks that are eliminated first, as points are.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Term
        >>> x = Block(torch.zeros(1, 2))
        >>> measured = Term(lambda x: x, ("x",), (torch.zeros(4, dtype=torch.int64),))  # four times, sigma 1
        >>> torchsfm.optim.marginal_covariance({"x": x}, [measured], "x")[0].diagonal()
        tensor([0.2500, 0.2500], dtype=torch.float64)
    """
    joint, free = _of_free(blocks, terms, name, eliminate)
    count, width = blocks[name].x.shape[0], joint.shape[1]
    own = torch.arange(len(free), device=free.device)
    return joint.new_zeros((count, width, width)).index_copy_(0, free, joint[own, :, own])


def joint_covariance(
    blocks: Mapping[str, Block], terms: Sequence[Term], name: str, *, eliminate: str | Sequence[str] | None = None
) -> Float[Tensor, "n k n k"]:
    """The covariance of all variables of one block together, those of the others as they follow.

    As `marginal_covariance` in all else; the covariance of a difference of two variables is that of the one and the other less
    twice what they have in common.

    Args:
        blocks: The variables by name, at the optimum.
        terms: The residuals of which it is the optimum.
        name: The block whose covariance is wanted.
        eliminate: Blocks that are eliminated first, as points are.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Term
        >>> pair = torch.arange(2)
        >>> one, other = Term(lambda x: x, ("x",), (pair[:1],)), Term(lambda x, y: y - x, ("x", "x"), (pair[:1], pair[1:]))
        >>> torchsfm.optim.joint_covariance({"x": Block(torch.zeros(2, 1))}, [one, other], "x")[:, 0, :, 0]
        tensor([[1., 1.],
                [1., 2.]], dtype=torch.float64)
    """
    joint, free = _of_free(blocks, terms, name, eliminate)
    count, width = blocks[name].x.shape[0], joint.shape[1]
    out = joint.new_zeros((count, width, count, width))
    out[free[:, None], :, free[None]] = joint.movedim(1, 2)
    return out


def _of_free(
    blocks: Mapping[str, Block], terms: Sequence[Term], name: str, eliminate: str | Sequence[str] | None
) -> tuple[Float[Tensor, "m k m k"], Int[Tensor, "m"]]:
    """The covariance of the variables of a block that are free, and which those are."""
    _check(blocks, terms, eliminate)
    check_options(name=(name, tuple(blocks)))
    with torch.no_grad():
        double, counted, _ = prepare(blocks, terms)
        x = {key: b.x for key, b in double.items()}
        layout = lay_out(double, counted, eliminate)
        width, free = double[name].tangent, layout.free[name]
        if not free.numel() or not width:
            return double[name].x.new_zeros((free.numel(), width, free.numel(), width)), free
        columns = layout.first[name] + torch.arange(free.numel() * width, device=free.device)
        information = Elimination(double, layout, "dense").linearize(x).information(columns)
        held = information.diagonal() <= 0
        information.diagonal()[held] = 1.0
        factor, info = torch.linalg.cholesky_ex(information)
        # The inverse of half a factor raises.
        whole = torch.where(info == 0, factor, torch.eye(len(factor), dtype=factor.dtype, device=factor.device))
        joint = torch.where(info == 0, torch.cholesky_inverse(whole), torch.inf)
        joint.diagonal()[held] = 0.0
    return joint.view(free.numel(), width, free.numel(), width), free


def _check(blocks: Mapping[str, Block], terms: Sequence[Term], eliminate: str | Sequence[str] | None) -> None:
    check_options(blocks=(blocks, Mapping), terms=(terms, list | tuple))
    check_eliminate(blocks, eliminate)


def _square_sum(term: Term, x: dict[str, Tensor]) -> float:
    square = term_residual(term, x).square().sum(-1)
    if term.loss is not None:
        square = square * loss_slope(term.loss, square)
    return float(square.sum() if term.weights is None else square @ term.weights)
