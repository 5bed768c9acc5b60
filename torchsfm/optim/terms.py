"""Least-squares problems as sums of terms over variable blocks, and their linearisation.

A `Block` is a family of variables of one kind (all poses, all points); a `Term` says which variables each of its residuals
depends on. The sum to be minimised is `sum_i w_i rho(|r_i|^2) / 2` over all residuals of all terms.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.optim.loss import Loss, loss_slope
from torchsfm.optim.manifold import Manifold

Linearization = Callable[..., tuple[Tensor, Sequence[Tensor | None]]]


@dataclass(frozen=True)
class Block:
    """Variables of one kind: `x (N, k)`, how they move, and which of them do not."""

    x: Float[Tensor, "n k"]
    manifold: Manifold | None = None
    """Plain addition in all k coordinates if not given."""
    fixed: Bool[Tensor, "n"] | None = None

    @property
    def tangent(self) -> int:
        """Degrees of freedom of one variable."""
        return self.x.shape[1] if self.manifold is None else self.manifold.tangent

    def retract(self, x: Tensor, delta: Tensor) -> Tensor:
        """Move variables by tangent steps."""
        return x + delta if self.manifold is None else self.manifold.retract(x, delta)


@dataclass(frozen=True)
class Term:
    """Residuals of one kind.

    `residual(*variables, *data) -> (m, d)` gets one row per residual: of each named block the variables `(m, k)` that `index`
    picks, then the rows of each tensor in `data`. Row i must depend on rows i alone. Rows are stored one coordinate after the
    other, so code that works on `x[:, 0], x[:, 1], ...` (or `unbind(-1)`) runs on contiguous memory.

    Derivatives come from `d` reverse sweeps. Where a hand-written one pays, `linearize(*variables, *data, wanted=...)` returns
    the residuals `(m, d)` and one Jacobian `(m, d, tangent)` per block with respect to its tangent step, or None where
    `wanted` says that it is not needed; views of storage with m last are fastest.
    """

    residual: Callable[..., Tensor]
    blocks: tuple[str, ...]
    index: tuple[Int[Tensor, "m"], ...]
    data: tuple[Tensor, ...] = ()
    loss: Loss | None = None
    weights: Float[Tensor, "m"] | None = None
    """Weight of each residual's squared norm; 0 leaves it out, whatever number it has."""
    linearize: Linearization | None = None

    def select(self, rows: Tensor) -> "Term":
        """The term with some of its residuals."""
        return replace(
            self,
            index=tuple(i.index_select(0, rows) for i in self.index),
            data=tuple(_columns(d).index_select(-1, rows).movedim(-1, 0) for d in self.data),
            weights=None if self.weights is None else self.weights.index_select(0, rows),
        )


def _columns(x: Tensor) -> Tensor:
    """Rows last and contiguous."""
    return x.movedim(0, -1).contiguous()


def gather(x: Float[Tensor, "n k"], index: Int[Tensor, "m"]) -> Float[Tensor, "m k"]:
    """Pick rows of a tensor stored column by column, and store the result so."""
    columns = x.mT
    return columns.gather(1, index.expand(columns.shape[0], -1)).mT


def term_residual(term: Term, x: dict[str, Tensor]) -> Float[Tensor, "m d"]:
    """The residuals at `x`."""
    return term.residual(*(gather(x[name], i) for name, i in zip(term.blocks, term.index, strict=True)), *term.data)


def term_cost(term: Term, residual: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
    """`sum w rho(|r|^2) / 2`."""
    if term.loss is None and term.weights is None:
        flat = residual.mT.flatten()
        return flat @ flat / 2
    square = residual.square().sum(-1)
    rho = square if term.loss is None else term.loss(square)
    return (rho.sum() if term.weights is None else rho @ term.weights) / 2


def linearize(
    term: Term, x: dict[str, Tensor], lifts: dict[str, Tensor | None], wanted: tuple[bool, ...]
) -> tuple[Tensor, list[Tensor | None]]:
    """Weighted residuals `(d, m)` and Jacobians `(d, tangent, m)` whose squares add up to the robust Gauss-Newton model.

    Rows are scaled by `sqrt(w rho')` (the first-order variant of Triggs et al. 2000, 4.3, which stays positive definite).
    """
    arguments = [gather(x[name], i) for name, i in zip(term.blocks, term.index, strict=True)]
    if term.linearize is not None:
        r, found = term.linearize(*arguments, *term.data, wanted=wanted)
        residual = r.mT
        jacobians = [None if j is None or not w else j.permute(1, 2, 0) for j, w in zip(found, wanted, strict=True)]
    else:
        residual, jacobians = _differentiate(term, arguments, lifts, wanted)
    if term.loss is not None or term.weights is not None:
        scale = None
        if term.loss is not None:
            scale = loss_slope(term.loss, residual.square().sum(0))
        if term.weights is not None:
            scale = term.weights if scale is None else scale * term.weights
        root = scale.sqrt()  # type: ignore[union-attr]
        residual = residual * root
        jacobians = [None if j is None else j * root for j in jacobians]
    return residual, jacobians


def _differentiate(
    term: Term, arguments: list[Tensor], lifts: dict[str, Tensor | None], wanted: tuple[bool, ...]
) -> tuple[Tensor, list[Tensor | None]]:
    """Each residual sees one row of each argument, so one reverse sweep gives one row of every Jacobian."""
    leaves = [a.mT.detach().requires_grad_(w) for a, w in zip(arguments, wanted, strict=True)]
    follow = [leaf for leaf, w in zip(leaves, wanted, strict=True) if w]
    with torch.enable_grad():
        value = term.residual(*(leaf.mT for leaf in leaves), *term.data)
        components = value.unbind(-1)
        ones = torch.ones_like(components[0])
        sweeps = [
            torch.autograd.grad(c, follow, ones, retain_graph=i + 1 < len(components), materialize_grads=True)
            if c.requires_grad
            else [torch.zeros_like(leaf) for leaf in follow]
            for i, c in enumerate(components)
        ]
    stacked = iter([torch.stack(rows) for rows in zip(*sweeps, strict=True)])
    jacobians: list[Tensor | None] = []
    for name, index, w in zip(term.blocks, term.index, wanted, strict=True):
        if not w:
            jacobians.append(None)
            continue
        ambient, lift = next(stacked), lifts[name]
        if lift is not None:
            columns = lift.index_select(-1, index)
            ambient = (ambient[:, :, None] * columns).sum(1)
        jacobians.append(ambient)
    return value.detach().mT, jacobians


def lift_of(block: Block, x: Float[Tensor, "n k"]) -> Tensor | None:
    """The derivative `(k, tangent, n)` of the retraction at zero; None where it is the identity."""
    if block.manifold is None:
        return None
    with torch.enable_grad():
        delta = x.new_zeros((x.shape[0], block.tangent)).requires_grad_()
        moved = block.retract(x.detach(), delta).unbind(-1)
        ones = torch.ones_like(moved[0])
        rows = [
            torch.autograd.grad(c, delta, ones, retain_graph=True, materialize_grads=True)[0]
            if c.requires_grad
            else torch.zeros_like(delta)
            for c in moved
        ]
    return torch.stack([row.mT for row in rows])
