"""Levenberg-Marquardt for one large sparse problem: terms over variable blocks, some of them eliminated (`schur`)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import torch
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.optim.descent import FLAT, MINIMUM, NEAR, SLOW, Options, descend
from torchsfm.optim.implicit import wants_derivative
from torchsfm.optim.layout import lay_out
from torchsfm.optim.normal_equations import NormalEquations
from torchsfm.optim.problem import Step
from torchsfm.optim.pytree import Places
from torchsfm.optim.ranks import Group, Ranks, share
from torchsfm.optim.schur import Elimination, move
from torchsfm.optim.solver_choice import Solver
from torchsfm.optim.sparse_derivative import Hessian, attach_sparse_optimum, followed
from torchsfm.optim.terms import Block, Term, check_eliminate, prepare, term_cost, term_residual

STRAIGHT = 0.75
"""Steps that lower the cost by less than this part of what they promise left the linear model's reach."""
SHORT = 0.9
"""Those that promise less than this part of what they gain were too short: a loss bends down, which Gauss-Newton leaves out."""
PART = 0.1
"""Eliminated variables go on settling after it if their first steps gain at least this part of what it promises."""
TELLING = 1e4
"""Comparing costs still checks a promise of this many of their rounding errors. Down to there, steps are shortened point by
point: a single one in a bent valley would hold all others back."""
ROUNDS = 20
"""Most steps that eliminated variables take by themselves after one with the exact Hessian, or one that was too short,"""
WORTH = 1e-2
"""and the part of what such a step promises, divided by their number, for which they take one."""
FARTHEST = 10.0
"""Most that steps are lengthened by."""
SMALL = 0.75
"""Most that an acceleration changes a step by, relative to it: beyond, the third derivatives matter."""
POOR = 0.25
"""Of a step that gains less than this fraction of its promise, each eliminated variable takes only what is good for it."""


@dataclass(frozen=True)
class SparseResult:
    """The minimum of a sparse least-squares problem.

    `x` holds every block, `residuals` every term's residuals (m, d) there, `used` (m) which of them count: a residual that is
    not finite at the start, or whose square is not, is left out. `cost` and `initial_cost` are `sum w rho / 2`, and
    `iterations` counts the steps tried. `status` is `Status.OK` where a tolerance was met or no step
    lowers the cost any more, `NOT_CONVERGED` where the iteration limit came first, `INTERRUPTED` where it was stopped from
    outside, `TOO_FEW` where nothing is free or observed, `NOT_FINITE` where no residual is finite, or where their sum or its
    derivatives are not: then `x` is the best seen.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Cauchy, Term, sparse_levenberg_marquardt
        >>> y = torch.tensor([[1.0], [1.1], [0.9], [100.0], [torch.nan]])  # one number measured five times, twice badly
        >>> term = Term(lambda x, y: x - y, ("x",), (torch.zeros(5, dtype=torch.int64),), (y,), loss=Cauchy(0.1))
        >>> found = sparse_levenberg_marquardt({"x": Block(torch.ones(1, 1))}, [term])
        >>> found.status.name, found.x["x"].round(decimals=2), found.used[0]
        ('OK', tensor([[1.]]), tensor([ True,  True,  True,  True, False]))
    """

    x: dict[str, Tensor]
    cost: float
    initial_cost: float
    residuals: tuple[Tensor, ...]
    used: tuple[Tensor, ...]
    iterations: int
    status: Status


def sparse_levenberg_marquardt(
    blocks: Mapping[str, Block],
    terms: Sequence[Term],
    *,
    eliminate: str | Sequence[str] | None = None,
    max_iterations: int = 50,
    function_tolerance: float = 1e-6,
    gradient_tolerance: float = 1e-10,
    step_tolerance: float = 1e-10,
    initial_damping: float = 1e-4,
    linear_solver: Solver = "auto",
    hessian: Hessian = "exact",
    progress: Callable[[int, float], bool | None] | None = None,
    group: Group | None = None,
) -> SparseResult:
    """Minimise a sum of terms over variable blocks.

    Gauss-Newton steps at first. Where these become slow, as with robust losses and large residuals, Newton steps with the
    exact Hessian in the same sparse form take over wherever it is positive (dense systems only), so that the last digits cost
    a few steps. Of a step that turns out bad each eliminated variable takes the part that is good for it; after two such steps
    the next ones bend with the valley of the cost (geodesic acceleration, Transtrum & Sethna 2012). Everything is computed in
    float64; variables come back in the dtype they had. A gauge freedom needs no care: the damping
    takes the shortest step. Fixed and unobserved variables come back bit for bit.

    Args:
        blocks: Variables by name.
        terms: Residuals over them.
        eliminate: The block with the most variables (points), or several (points and lines); no residual may depend on two
            of their variables.
        max_iterations: Most accepted or rejected steps.
        function_tolerance: End when no more than this fraction of the cost is left to gain, by the promise of a step or by how
            fast gains fall.
        gradient_tolerance: End when residuals make no larger cosine with what any variable moves them by.
        step_tolerance: End when the step of every variable is shorter than this fraction of that variable's norm.
        initial_damping: Damping relative to the diagonal of the normal equations, at the start (1 / Ceres' radius).
        linear_solver: "dense" forms the reduced system of the retained variables and factors it; so does "sparse", with what
            is not zero alone (long chains, where few fill in); "pcg" solves it by preconditioned conjugate gradients without
            forming it, to a tenth of the decrease the model allows (inexact steps: more of them, in memory that grows with
            the residuals alone; many where chains are long, and where 500 iterations are too few, the status is not OK); "auto"
            takes what size and sparsity suggest.
        hessian: Used for derivatives of the minimum only: "exact", or "gauss-newton", which leaves out second derivatives of
            the residuals and is some percent off where residuals are large.
        progress: Called with the number of iterations and the cost after each. Returning False ends the minimisation; so does
            an interrupt (Ctrl-C), there or anywhere else in the iterations. Either way the best so far is returned, with
            the status INTERRUPTED: who has more to do after it looks there.
        group: Processes (of `torch.distributed`) that call this with the same problem, on processors of one kind: each works
            on some of the eliminated variables and on the residuals that meet them, so that time and memory are divided, and
            all return the same. They add up what concerns retained variables: their numbers once for each step of conjugate
            gradients, or the system once for each step, which the first solves while the others wait. `progress` of any of
            them ends it for all; an interrupt is passed on as it is, since the others wait.

    Returns:
        The minimum. Where data, weights or fixed variables require a gradient, `x` and `residuals` carry their derivatives by
        the implicit function theorem (first derivatives, backwards); otherwise nothing is spent on it. They are those of a
        minimum, so it is then approached until hardly 1e-13 of the cost is left to gain, whatever `function_tolerance` says;
        where the status is not OK it was not reached, and they are not to be trusted.

    Raises:
        ValueError: A term names an unknown block, its tensors disagree in length, an index is out of range, or it depends on
            two eliminated variables.

    Example:
        >>> import torch
        >>> from torchsfm.optim import Block, Term, sparse_levenberg_marquardt
        >>> place = Block(torch.zeros(3, 2), fixed=torch.tensor([True, False, False]))  # three places on a map
        >>> start, end = torch.tensor([0, 1, 2]), torch.tensor([1, 2, 0])
        >>> way = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])  # measured from each to the next
        >>> term = Term(lambda a, b, way: b - a - way, ("place", "place"), (start, end), (way,))
        >>> found = sparse_levenberg_marquardt({"place": place}, [term])
        >>> found.x["place"], found.status.name
        (tensor([[0., 0.],
                [1., 0.],
                [1., 1.]]), 'OK')
    """
    _check(blocks, terms, eliminate)
    check_options(linear_solver=(linear_solver, get_args(Solver)), max_iterations=(max_iterations, "int >= 0"))
    check_options(group=(group, Group | None))
    check_options(
        function_tolerance=(function_tolerance, "float >= 0"), gradient_tolerance=(gradient_tolerance, "float >= 0"),
        step_tolerance=(step_tolerance, "float >= 0"), initial_damping=(initial_damping, "float >= 0"),
    )  # fmt: skip
    wanted = wants_derivative(*followed(dict(blocks), terms))
    if wanted:
        function_tolerance = min(function_tolerance, MINIMUM)
    ranks = Ranks(group)
    with torch.no_grad():
        mine = share(blocks, terms, eliminate, ranks)
        double, counted, used = prepare(mine.blocks, mine.terms)
        x = {name: b.x for name, b in double.items()}
        layout = lay_out(double, counted, eliminate, ranks)
        # A residual of fixed variables is a constant of the cost.
        still = sum((float(term_cost(t, term_residual(t, x))) for t in layout.still), 0.0)
        size = sum(_size(term) for term in counted)
        there, count, pieces = sum(u.numel() for u in used), sum(int(u.sum()) for u in used), len(layout.pieces)
        some = next(iter(double.values())).x if double else torch.empty(0, dtype=torch.float64)
        points = sum(family.points for family in layout.families)
        told = ranks.sum(some.new_tensor([still, size, there, count, pieces, points, progress is not None]))
        constant, size, there, count, pieces, points, listens = told.tolist()
        cost, initial, iterations, status = constant, constant, 0, Status.TOO_FEW
        if not math.isfinite(constant) or (there and not count):
            status = Status.NOT_FINITE
        elif pieces:
            problem = _SparseProblem(Elimination(double, layout, linear_solver), size, some.new_tensor(points))
            limits = (max_iterations, function_tolerance, step_tolerance, gradient_tolerance, initial_damping)
            tell = _shared(progress, constant, ranks) if listens else None
            found = descend(problem, x, Options(*limits, progress=tell, interruptible=ranks.size == 1))
            x, iterations, status = found.x, int(found.iterations), Status(int(found.status))
            cost, initial = float(found.cost) + constant, float(found.initial_cost) + constant
        own, x, used = x, mine.whole(x), mine.rows(used)
    if wanted:
        own = x = attach_sparse_optimum(dict(blocks), terms, x, used, eliminate, hessian)
        mine = share(blocks, terms, eliminate, Ranks())
    plain = [replace(term, data=tuple(_double(d) for d in term.data)) for term in mine.terms]
    residuals = mine.rows([term_residual(t, own) for t in plain])
    out = {name: x[name].to(b.x.dtype).contiguous() for name, b in blocks.items()}
    return SparseResult(out, cost, initial, residuals, used, iterations, status)


def _shared(
    progress: Callable[[int, float], bool | None] | None, constant: float, ranks: Ranks
) -> Callable[[int, Tensor], bool]:
    """The `progress` of a descent, given that of this rank: any of them ends it for all."""

    def tell(number: int, cost: Tensor) -> bool:
        ends = progress is not None and progress(number, float(cost) + constant) is False
        return not bool(ranks.any(torch.full_like(cost, ends, dtype=torch.bool)))

    return tell


class _Place:
    """Where the variables are, linearised when that is asked for: the engine has memory for one linearisation."""

    def __init__(self, engine: Elimination, x: dict[str, Tensor], cost: Tensor) -> None:
        self.engine, self.x, self.cost = engine, x, cost
        self.exact: NormalEquations | None = None
        self.strayed = False
        """Whether the step that led here left the linear model's reach."""
        self.promise = math.inf
        """Of the step that led here."""
        self.damping = 0.0
        """Of the last step asked for."""
        self._system: NormalEquations | None = None

    @property
    def system(self) -> NormalEquations:
        """The normal equations; those of whatever place was asked last are overwritten."""
        if self._system is None or self.engine.current is not self._system:
            self._system = self.engine.linearize(self.x)
        return self._system

    def steepest(self) -> Tensor:
        """The largest cosine between the residuals and what a variable moves them by, whatever the units of either."""
        slope = self.system.gradient()
        return torch.where(slope == 0, slope, slope / (2 * self.cost).sqrt())

    def along(self, delta: dict[str, Tensor]) -> Tensor:
        """The derivative of the cost along a step."""
        return self.system.along(delta)

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step for a damping, with the exact Hessian where that is wanted."""
        system = self.system
        if exact is not None and bool(exact):
            assert self.exact is not None, "curved before"
            system = self.exact
        self.damping = float(damping)
        return system.step(self.damping)


@dataclass(frozen=True)
class _SparseProblem:
    """A batch of none: one problem of terms over blocks."""

    engine: Elimination
    size: float
    """What the cost would be if residuals were as large as data are."""
    points: Tensor
    """How many eliminated variables there are."""
    epsilon: float = torch.finfo(torch.float64).eps
    patience: int = 5

    def pick(self, at: Places) -> "_SparseProblem":
        """There is but one."""
        return self

    def linearize(self, x: dict[str, Tensor]) -> _Place:
        """The system at x."""
        return _Place(self.engine, x, self.engine.cost(x))

    def advance(self, here: _Place, step: Step) -> _Place:
        """Where a step leads; where the model was good for a part of it only, eliminated variables take that part.

        After two such steps in a row the cost has a curved valley, and the step is bent to stay in it.
        """
        if not bool(step.solved):
            return here
        engine = self.engine
        x = move(engine.blocks, engine.layout, here.x, step.delta)
        cost = engine.cost(x)
        # So near the minimum costs do not tell what is good for a variable, but for those that are held nothing else does.
        held = here.exact is not None and here.exact.held
        if not held and bool(step.promise <= TELLING * self.epsilon * here.cost):
            return _Place(engine, x, cost)
        strays = not bool(here.cost - cost >= STRAIGHT * step.promise)
        # Far from the minimum the others are not where they will be, and the last digits are for Newton steps.
        close = bool(self.epsilon**0.5 * here.cost < step.promise <= NEAR * here.cost)
        crawls = close and bool(step.promise > SLOW * here.promise)
        if close and here.exact is None and bool(here.cost - cost > FLAT * step.promise):
            x, cost = self._farther(here, step, x, cost)
        short = crawls and bool(SHORT * (here.cost - cost) > step.promise)
        if not bool(here.cost - cost > POOR * step.promise):
            x = engine.settling.shorten(here.x, step.delta, x)
            cost = engine.cost(x)
        if here.exact is None and (short or (strays and bool(cost.isfinite()))):
            # The linear model reaches no farther than this, but with the eliminated variables settled it may.
            moved, x = cost, engine.settling.settle(x)
            cost = engine.cost(x)
            short = short and bool(moved - cost > PART * step.promise)
        if here.exact is not None or short:
            # A few that crawl to where they belong would make as many steps of all.
            x = engine.settling.settle(x, ROUNDS, WORTH * step.promise / self.points)
            cost = engine.cost(x)
        there = _Place(engine, x, cost)
        there.promise = float(step.promise)
        there.strayed = strays and not bool(here.cost - cost >= STRAIGHT * step.promise)
        return self._bent(here, there, step) if here.strayed and strays and here.exact is None else there

    def _farther(self, here: _Place, step: Step, x: dict[str, Tensor], cost: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Where a step would end that goes on to the minimum of the cost along it, if the cost is less there.

        Gauss-Newton leaves out how a loss bends down: where that is most of the curvature, steps fall as a geometric series.
        """
        engine, slope = self.engine, here.along(step.delta)
        length = (slope / (2 * (here.cost + slope - cost)).clamp_max(slope / FARTHEST)).clamp(1, FARTHEST)
        longer = move(engine.blocks, engine.layout, here.x, {name: length * delta for name, delta in step.delta.items()})
        after = engine.cost(longer)
        return (longer, after) if bool(after < cost) else (x, cost)

    def _bent(self, here: _Place, there: _Place, step: Step) -> _Place:
        """Where a step leads that follows a curved valley, if the cost is less there."""
        engine = self.engine
        change = engine.accelerate(here.x, step.delta, here.damping, here.system)
        (straight, _), (aside, _) = here.system.join(step.delta), here.system.join(change)
        measure = here.system.diagonal.sqrt()
        if not bool((measure * aside).norm() <= SMALL / 2 * (measure * straight).norm()):
            return there
        x = move(engine.blocks, engine.layout, here.x, {name: step.delta[name] + change[name] for name in change})
        bent = _Place(engine, x, engine.cost(x))
        bent.strayed = True
        return bent if bool(bent.cost < there.cost) else there

    def curve(self, here: _Place, where: Tensor) -> _Place:
        """The system with exact second derivatives."""
        here.exact = self.engine.curve(here.x, here.system)
        return here

    def rounding(self, here: _Place) -> Tensor:
        """What rounding of the data, and of what is computed from them, makes of the cost."""
        return torch.full_like(here.cost, (30 * self.epsilon) ** 2 * self.size)

    def is_short(self, here: _Place, delta: dict[str, Tensor], tolerance: float) -> Tensor:
        """Whether no variable moves by more than a fraction of its own norm: one far away says nothing of the others."""
        norm, free = torch.linalg.vector_norm, self.engine.layout.free
        short = [
            (norm(d, dim=1) <= tolerance * (norm(here.x[name][free[name]], dim=1) + tolerance)).all()
            for name, d in delta.items()
        ]
        none = torch.ones_like(here.cost, dtype=torch.bool)
        return self.engine.ranks.all(torch.stack([none, *short]).all())


def _size(term: Term) -> float:
    """What the cost would be if residuals were as large as data usually are; those of exact data are rounding errors of it."""
    squares = [d[:, None].flatten(1).square().sum(1).median() for d in term.data if d.is_floating_point() and d.numel()]
    count = len(term.index[0]) if term.weights is None else float(term.weights.sum())
    return count * float(sum(squares)) / 2


def _double(x: Tensor) -> Tensor:
    return x.double() if x.is_floating_point() else x


def _check(blocks: Mapping[str, Block], terms: Sequence[Term], eliminate: str | Sequence[str] | None) -> None:
    check_options(blocks=(blocks, Mapping), terms=(terms, list | tuple))
    check_eliminate(blocks, eliminate)
    for k, term in enumerate(terms):
        if len(term.blocks) != len(term.index):
            raise ValueError(f"terms[{k}]: wanted one index for each of {term.blocks}, got {len(term.index)}")
        for name in term.blocks:
            if name not in blocks:
                raise ValueError(f"terms[{k}]: wanted blocks among {sorted(blocks)}, got {name!r}")
        weights = () if term.weights is None else (term.weights,)
        lengths = {t.shape[0] for t in (*term.index, *term.data, *weights)}
        if len(lengths) != 1:
            raise ValueError(f"terms[{k}]: wanted index, data and weights of one length, got {sorted(lengths)}")
        for name, index in zip(term.blocks, term.index, strict=True):
            check_tensors(**{f"terms[{k}].index": (index, f"{index.shape[0]}: int")})
            count = blocks[name].x.shape[0]
            if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < count:
                got = f"{int(index.min())} to {int(index.max())}"
                raise ValueError(f"terms[{k}].index: wanted numbers from 0 to {count - 1} for {name!r}, got {got}")
