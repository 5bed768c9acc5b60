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

from torchsfm._types import check_index, check_one_problem, check_options
from torchsfm.optim.front_covariance import inverse_entries, retained_covariances
from torchsfm.optim.layout import Layout, lay_out
from torchsfm.optim.loss import loss_slope
from torchsfm.optim.schur import Elimination
from torchsfm.optim.solver_choice import Solver, plan_fronts
from torchsfm.optim.terms import Block, Term, check_eliminate, prepare, term_residual
from torchsfm.optim.undamped import information, invert


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
    joint: bool = True,
) -> SparseCovariance:
    """Compute covariances at a minimum.

    Args:
        blocks: Variables at the minimum.
        terms: Residuals in units of their standard deviation; those that are not finite are left out.
        eliminate: The blocks to eliminate, as in `sparse_levenberg_marquardt`.
        of_eliminated: Whether covariances of the eliminated variables are wanted too, which are most of the work. Without,
            theirs are infinite.
        joint: Whether the joint covariance is wanted. Without it and those of the eliminated variables, long chains take time
            and memory in proportion to their length; `joint` is then (0, 0).

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
        places = _places(double, layout)
        quick = None if joint or of_eliminated else _by_fronts(double, layout, x, places)
        eliminated: dict[str, tuple[Tensor, Tensor]] = {}
        if quick is not None:
            engine, retained, rank, good_points = quick
            whole = next(iter(double.values())).x.new_zeros((0, 0))
        else:
            engine = Elimination(double, layout, "dense", spread=of_eliminated)
            inverse = invert(engine.linearize(x))
            whole, rank, good_points = inverse.kept, inverse.rank, inverse.determined
            retained = {name: whole[own[:, :, None], own[:, None]] for name, own in places.items()}
            if of_eliminated:
                points = zip(layout.families, inverse.point_covariances(), good_points, strict=True)
                eliminated = {family.name: (of_points, good) for family, of_points, good in points}
            whole = whole if joint else whole[:0, :0]
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
            place[free] = places[name]
            kept = retained[name]
            known[free] = kept.isfinite().all(-1).all(-1)
            covariance[free] = torch.where(known[free][:, None, None], kept, covariance[free])
        found[name], determined[name], columns[name] = covariance, known, place
    families = zip(layout.families, good_points, strict=True)
    nullity = layout.size - rank
    unknowns = layout.size - nullity + sum(int(good.sum()) * family.point_size for family, good in families)
    return SparseCovariance(found, determined, whole, columns, nullity, rows - unknowns, squares)


def _places(blocks: Mapping[str, Block], layout: Layout) -> dict[str, Tensor]:
    """The columns of the free variables of each retained block, (free, tangent)."""
    return {
        name: start + torch.arange(layout.free[name].numel() * blocks[name].tangent, device=layout.device).view(
            -1, blocks[name].tangent
        )
        for name, start in layout.first.items()
    }  # fmt: skip


def _by_fronts(
    blocks: dict[str, Block], layout: Layout, x: dict[str, Tensor], places: dict[str, Tensor]
) -> tuple[Elimination, dict[str, Tensor], int, list[Tensor]] | None:
    """The covariances of retained variables, the rank, and what is determined of others, if a sparse factor tells."""
    fronts = None if _rests(blocks) else plan_fronts(layout, "auto", exact=True)
    if fronts is None:
        return None
    engine = Elimination(blocks, layout, "sparse", fronts=fronts)
    found = retained_covariances(engine.linearize(x), fronts, list(places.values()))
    if found is None:
        return None
    return engine, dict(zip(places, found[0], strict=True)), found[1], found[2]


def _rests(blocks: Mapping[str, Block]) -> bool:
    """Whether there are motions of which nothing has a part."""
    return any(block.rest is not None for block in blocks.values())


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
    check_options(blocks=(blocks, Mapping))
    check_options(name=(name, tuple(blocks)))
    nothing = torch.zeros((0, 2), dtype=torch.int64, device=blocks[name].x.device)
    return pair_covariance(blocks, terms, name, nothing, eliminate=eliminate)[0]


def pair_covariance(
    blocks: Mapping[str, Block],
    terms: Sequence[Term],
    name: str,
    pairs: Int[Tensor, "m 2"],
    *,
    eliminate: str | Sequence[str] | None = None,
) -> tuple[Float[Tensor, "n k k"], Float[Tensor, "m k k"]]:
    """The covariance of each variable of one block, and of pairs of them.

    As `marginal_covariance`, and little more for pairs that share a term or an eliminated variable. A difference has the
    covariance of the one and the other, less that of the pair and its transpose.

    Args:
        blocks: The variables by name, at the optimum.
        terms: The residuals of which it is the optimum.
        name: The block whose covariance is wanted.
        pairs: Two numbers of variables each.
        eliminate: Blocks that are eliminated first, as points are.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Term
        >>> pair = torch.arange(2)
        >>> one, other = Term(lambda x: x, ("x",), (pair[:1],)), Term(lambda x, y: y - x, ("x", "x"), (pair[:1], pair[1:]))
        >>> own, between = torchsfm.optim.pair_covariance({"x": Block(torch.zeros(2, 1))}, [one, other], "x", pair[None])
        >>> own[:, 0, 0], between[:, 0, 0]
        (tensor([1., 2.], dtype=torch.float64), tensor([1.], dtype=torch.float64))
    """
    _check(blocks, terms, eliminate)
    check_options(name=(name, tuple(blocks)))
    check_one_problem(pairs=(pairs, "m 2: int"))
    check_index(pairs=(pairs, blocks[name].x.shape[0]))
    with torch.no_grad():
        double, counted, _ = prepare(blocks, terms)
        layout = lay_out(double, counted, eliminate)
        count, width = double[name].x.shape[0], double[name].tangent
        out = double[name].x.new_zeros((count + len(pairs), width, width))
        free = layout.free[name]
        if free.numel() and width:
            places = _places(double, layout)[name]
            slot = torch.full((count,), -1, device=free.device).index_copy_(
                0, free, torch.arange(len(free), device=free.device)
            )
            both = (slot[pairs] >= 0).all(1).nonzero()[:, 0]
            a, b = slot[pairs[both]].unbind(1)
            rows, columns = torch.cat((places, places[a])), torch.cat((places, places[b]))
            out[torch.cat((free, count + both))] = _entries(double, layout, places, rows[:, :, None], columns[:, None])
    return out[:count], out[count:]


def _entries(
    blocks: dict[str, Block], layout: Layout, places: Int[Tensor, "f k"], row: Tensor, column: Tensor
) -> Float[Tensor, "n k k"]:
    """Entries of the covariance of the variables of some columns, by a sparse factor where that is less."""
    x, own = {key: b.x for key, b in blocks.items()}, places.flatten()
    whole, fronts = len(own) == layout.size, None
    if not _rests(blocks):
        fronts = plan_fronts(layout, "auto", last=None if whole else own, exact=True)
    if fronts is not None and whole and not bool(fronts.meet(row, column).all()):
        fronts = None
    solver: Solver = "dense" if fronts is None else "sparse"
    system = Elimination(blocks, layout, solver, fronts=fronts).linearize(x)
    if fronts is not None and whole:
        return inverse_entries(system, fronts, row, column)
    return _inverse(information(system, own))[row - own[0], column - own[0]]


def _inverse(known: Float[Tensor, "m m"]) -> Float[Tensor, "m m"]:
    """The covariance by the information: zero where there is none of a column, infinite where it is not definite."""
    held = known.diagonal() <= 0
    known.diagonal()[held] = 1.0
    factor, info = torch.linalg.cholesky_ex(known)
    # The inverse of half a factor raises.
    safe = torch.where(info == 0, factor, torch.eye(len(factor), dtype=factor.dtype, device=factor.device))
    joint = torch.where(info == 0, torch.cholesky_inverse(safe), torch.inf)
    joint.diagonal()[held] = 0.0
    return joint


def _check(blocks: Mapping[str, Block], terms: Sequence[Term], eliminate: str | Sequence[str] | None) -> None:
    check_options(blocks=(blocks, Mapping), terms=(terms, list | tuple))
    check_eliminate(blocks, eliminate)


def _square_sum(term: Term, x: dict[str, Tensor]) -> float:
    square = term_residual(term, x).square().sum(-1)
    if term.loss is not None:
        square = square * loss_slope(term.loss, square)
    return float(square.sum() if term.weights is None else square @ term.weights)
