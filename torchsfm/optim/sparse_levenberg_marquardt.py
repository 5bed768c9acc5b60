"""Levenberg-Marquardt for one large sparse problem: terms over variable blocks, one block eliminated (`schur`)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.optim.layout import lay_out
from torchsfm.optim.schur import Elimination, move
from torchsfm.optim.terms import Block, Term, term_cost, term_residual


@dataclass(frozen=True)
class SparseResult:
    """The minimum of a sparse least-squares problem.

    `x` holds every block, `residuals` every term's residuals (m, d) there, `used` (m) which of them count: a residual that is
    not finite at the start is left out. `status` is `Status.OK` where a tolerance was met or no step lowers the cost any more,
    `NOT_CONVERGED` where the iteration limit came first, `TOO_FEW` where nothing is free or observed, `NOT_FINITE` where no
    residual is finite.
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
    eliminate: str | None = None,
    max_iterations: int = 50,
    function_tolerance: float = 1e-6,
    gradient_tolerance: float = 1e-10,
    step_tolerance: float = 1e-10,
    initial_damping: float = 1e-4,
    progress: Callable[[int, float], None] | None = None,
) -> SparseResult:
    """Minimise a sum of terms over variable blocks.

    Everything is computed in float64; variables come back in the dtype they had. A gauge freedom needs no care: the damping
    takes the shortest step. Fixed and unobserved variables come back bit for bit.

    Args:
        blocks: Variables by name.
        terms: Residuals over them.
        eliminate: The block with the most variables (points); no residual may depend on two of its variables.
        max_iterations: Most accepted or rejected steps.
        function_tolerance: End when an accepted step lowers the cost by less than this fraction.
        gradient_tolerance: End when no derivative of the cost is larger.
        step_tolerance: End when the step is shorter than this fraction of the variables' norm.
        initial_damping: Damping relative to the diagonal of the normal equations, at the start (1 / Ceres' radius).
        progress: Called with the number of iterations and the cost after each.

    Returns:
        The minimum.

    Raises:
        ValueError: A term names an unknown block, its tensors disagree in length, or it depends on two eliminated variables.
    """
    _check(blocks, terms, eliminate)
    with torch.no_grad():
        double = {name: replace(b, x=b.x.detach().double().mT.contiguous().mT) for name, b in blocks.items()}
        x = {name: b.x for name, b in double.items()}
        terms = [_to_double(term) for term in terms]
        used = tuple(_used(term, x) for term in terms)
        counted = [t if bool(u.all()) else t.select(u.nonzero()[:, 0]) for t, u in zip(terms, used, strict=True)]
        layout = lay_out(double, counted, eliminate)
        constant = _cost(layout.still, x)
        # A residual of fixed variables is a constant of the cost. The others come in parts small enough for the cache.
        engine = Elimination(double, layout)
        cost = float(engine.cost(x)) if layout.pieces else 0.0
        initial = cost
        status, iterations = Status.NOT_CONVERGED, 0
        if not any(bool(u.any()) for u in used):
            status = Status.NOT_FINITE if any(u.numel() for u in used) else Status.TOO_FEW
        elif not layout.pieces:
            status = Status.TOO_FEW
        else:
            system = engine.linearize(x)
            damping, growth = initial_damping, 2.0
            while iterations < max_iterations:
                if float(system.gradient()) <= gradient_tolerance:
                    status = Status.OK
                    break
                step, promise_, solved = system.solve(damping)
                promise = float(promise_)
                iterations += 1
                trial = move(double, layout, x, step)
                trial_cost = float(engine.cost(trial)) if bool(solved) else torch.inf
                ratio = (cost - trial_cost) / max(promise, 1e-300)
                accepted = trial_cost < cost and ratio > 1e-3
                small = bool(solved) and _length(step) <= step_tolerance * (_length(x) + step_tolerance)
                small = small or (bool(solved) and promise <= 1e-2 * function_tolerance * cost)
                if accepted:
                    small = small or cost - trial_cost <= function_tolerance * cost
                    x, cost = trial, trial_cost
                    damping = max(damping * max(1 / 3, 1 - (2 * min(ratio, 1.0) - 1) ** 3), 1e-16)
                    growth = 2.0
                else:
                    damping, growth = damping * growth, 2 * growth
                if progress is not None:
                    progress(iterations, cost + constant)
                if small or damping > 1e16:
                    status = Status.OK
                    break
                if accepted:
                    system = engine.linearize(x)
        residuals = tuple(term_residual(t, x) for t in terms)
    out = {name: x[name].to(b.x.dtype).contiguous() for name, b in blocks.items()}
    return SparseResult(out, cost + constant, initial + constant, residuals, used, iterations, status)


def _check(blocks: Mapping[str, Block], terms: Sequence[Term], eliminate: str | None) -> None:
    if eliminate is not None and eliminate not in blocks:
        raise ValueError(f"eliminate: wanted one of {sorted(blocks)}, got {eliminate!r}")
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


def _to_double(term: Term) -> Term:
    data = tuple(d.detach().double() if d.is_floating_point() else d.detach() for d in term.data)
    weights = None if term.weights is None else term.weights.detach().double()
    return replace(term, data=data, weights=weights)


def _used(term: Term, x: dict[str, Tensor]) -> Tensor:
    finite = term_residual(term, x).isfinite().all(-1)
    return finite if term.weights is None else finite & (term.weights > 0)


def _cost(terms: Sequence[Term], x: dict[str, Tensor]) -> float:
    return sum((float(term_cost(t, term_residual(t, x))) for t in terms), 0.0)


def _length(x: dict[str, Tensor]) -> float:
    return float(torch.stack([v.square().sum() for v in x.values()]).sum().sqrt()) if x else 0.0
