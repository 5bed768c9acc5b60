"""The derivative of a sparse minimum with respect to everything it depends on, without differentiating the iterations.

At the minimum the gradient g(x, inputs) vanishes, so `dx = -H^-1 dg/dinputs` (implicit function theorem). Backward takes one
solution `u = H^-1 v` with the Schur complement, and then one derivative: of the slope of the cost along u with respect to all
inputs. With a free gauge, u is the solution without a part along the gauge, so the derivative of anything that does not
depend on the gauge is right, and nothing blows up. The same goes for directions in which a robust loss left no curvature.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchsfm.optim.layout import Layout, lay_out
from torchsfm.optim.schur import Elimination
from torchsfm.optim.terms import Block, Term, term_cost, term_residual
from torchsfm.optim.undamped import invert

Hessian = Literal["exact", "gauss-newton"]
"""Which second derivatives of the cost to use."""


@dataclass(frozen=True)
class _Problem:
    """A minimum: blocks and terms at it, in float64 and detached, with the tensors that are followed."""

    blocks: dict[str, Block]
    terms: list[Term]
    used: list[Tensor]
    eliminate: str | Sequence[str] | None
    hessian: Hessian

    def inputs(self, values: Sequence[Tensor]) -> tuple[dict[str, Tensor], list[Term]]:
        """Blocks' values and terms with `values` in the places that `followed` lists."""
        rest = iter(v.double() if v.is_floating_point() else v for v in values)
        x = {name: next(rest) for name in self.blocks}
        terms = []
        for term, used in zip(self.terms, self.used, strict=True):
            data = tuple(next(rest) for _ in term.data)
            weights = None if term.weights is None else next(rest)
            rows = used.nonzero()[:, 0]
            # A row that does not count must not hand back NaN.
            terms.append(
                replace(
                    term,
                    index=tuple(i[rows] for i in term.index),
                    data=tuple(d[rows] for d in data),
                    weights=None if weights is None else weights[rows],
                )
            )
        return x, terms


def followed(blocks: dict[str, Block], terms: Sequence[Term]) -> list[Tensor]:
    """Everything a minimum depends on, in the order of `_Problem.inputs`."""
    tensors = [b.x for b in blocks.values()]
    for term in terms:
        tensors += [*term.data, *([] if term.weights is None else [term.weights])]
    return tensors


def attach_sparse_optimum(
    blocks: dict[str, Block],
    terms: Sequence[Term],
    x: dict[str, Tensor],
    used: Sequence[Tensor],
    eliminate: str | Sequence[str] | None,
    hessian: Hessian,
) -> dict[str, Tensor]:
    """Give the minimum `x` its derivatives with respect to data, weights and the fixed variables among the blocks.

    Args:
        blocks: The variables as they came; where they are fixed the minimum depends on them.
        terms: The residuals.
        x: All variables at the minimum, float64.
        used: Which residuals of each term count.
        eliminate: The eliminated blocks.
        hessian: "exact", or "gauss-newton" which leaves out second derivatives of the residuals.

    Returns:
        `x`, unchanged in value, in the order and names of `blocks`.
    """
    still = {name: replace(b, x=x[name].detach()) for name, b in blocks.items()}
    problem = _Problem(still, list(terms), list(used), eliminate, hessian)
    found = _Optimum.apply(problem, *followed(blocks, terms))  # type: ignore[no-untyped-call]
    return dict(zip(blocks, found, strict=True))


class _Optimum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, problem: _Problem, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.problem = problem
        ctx.save_for_backward(*inputs)
        return tuple(b.x.clone() for b in problem.blocks.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        problem: _Problem = ctx.problem
        leaves = [v.detach().requires_grad_(need) for v, need in zip(ctx.saved_tensors, ctx.needs_input_grad[1:], strict=True)]
        at = {name: b.x for name, b in problem.blocks.items()}
        _, terms = problem.inputs([leaf.detach() for leaf in leaves])
        layout = lay_out(problem.blocks, terms, problem.eliminate)
        if not layout.pieces:
            return _through(problem, layout, leaves, gradients, {})
        engine = Elimination(problem.blocks, layout, "dense")
        system = engine.linearize(at)
        inverse = invert(system)
        if problem.hessian == "exact":
            inverse = invert(engine.curve(at, system, minimum=True), inverse)
        v = _pull(problem.blocks, layout, dict(zip(problem.blocks, gradients, strict=True)))
        u = system.split(*inverse.apply(*system.join(v)))
        return _through(problem, layout, leaves, gradients, u)


def _pull(blocks: dict[str, Block], layout: Layout, gradients: dict[str, Tensor]) -> dict[str, Tensor]:
    """Gradients by ambient numbers as gradients by tangent steps of the free variables."""
    found = {}
    for name in (*layout.first, *(family.name for family in layout.families)):
        free = layout.free[name]
        with torch.enable_grad():
            delta = blocks[name].x.new_zeros((free.numel(), blocks[name].tangent)).requires_grad_()
            moved = blocks[name].retract(blocks[name].x[free], delta)
        (found[name],) = torch.autograd.grad(moved, delta, gradients[name][free])
    return found


def _move(problem: _Problem, layout: Layout, x: dict[str, Tensor], steps: dict[str, Tensor]) -> dict[str, Tensor]:
    """All variables: `steps` taken from the minimum where free, `x` itself where not."""
    moved = {}
    for name, block in problem.blocks.items():
        moved[name] = x[name]
        if name in steps:
            free = layout.free[name]
            moved[name] = x[name].index_copy(0, free, block.retract(block.x[free], steps[name]))
    return moved


def _cost(terms: Sequence[Term], x: dict[str, Tensor]) -> Tensor:
    return torch.stack([term_cost(t, term_residual(t, x)) for t in terms]).sum()


def _through(
    problem: _Problem, layout: Layout, leaves: list[Tensor], gradients: Sequence[Tensor], u: dict[str, Tensor]
) -> tuple[Tensor | None, ...]:
    """`-d/dinputs` of the slope of the cost along u; and the gradients of variables that are not free, handed through."""
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    with torch.enable_grad():
        x, terms = problem.inputs(leaves)
        for name, block in problem.blocks.items():
            # The minimum does not depend on where free variables started.
            x[name] = x[name].index_copy(0, layout.free[name], block.x[layout.free[name]])
        along = torch.zeros((), dtype=torch.float64, device=gradients[0].device, requires_grad=True)
        cost = _cost(terms, _move(problem, layout, x, {name: along * step for name, step in u.items()}))
        through = sum(((x[name] * g).sum() for name, g in zip(problem.blocks, gradients, strict=True)), torch.zeros_like(cost))
        slope = torch.zeros_like(cost)
        if u and cost.requires_grad:
            (slope,) = torch.autograd.grad(cost, along, create_graph=True, materialize_grads=True)
        total = through - slope
        if total.requires_grad:
            found = iter(torch.autograd.grad(total, wanted, materialize_grads=True))
        else:
            found = iter([torch.zeros_like(leaf) for leaf in wanted])
    return (None, *(next(found) if leaf.requires_grad else None for leaf in leaves))
