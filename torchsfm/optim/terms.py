"""Least-squares problems as sums of terms over variable blocks, and their linearisation.

A `Block` is a family of variables of one kind (all poses, all points); a `Term` says which variables each of its residuals
depends on. The sum to be minimised is `sum_i w_i rho(|r_i|^2) / 2` over all residuals of all terms.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.optim.loss import Loss, loss_slope
from torchsfm.optim.manifold import Manifold

FEW = 4096
"""Rows that are differentiated together at most."""


@dataclass(frozen=True)
class Block:
    """Variables of one kind: `x (N, k)`, how they move, and which of them do not.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.optim import Block, Rotation, Term, sparse_levenberg_marquardt
        >>> g = torch.Generator().manual_seed(0)
        >>> R, d = torchsfm.geometry.random_rotation(generator=g).double(), torch.randn(5, 3, generator=g).double()
        >>> def residual(R, d, turned):
        ...     return (R.unflatten(-1, (3, 3)) @ d[..., None])[..., 0] - turned
        ...
        >>> term = Term(residual, ("R",), (torch.zeros(5, dtype=torch.int64),), (d, d @ R.mT))
        >>> block = Block(torch.eye(3).double().reshape(1, 9), Rotation())  # one rotation: nine numbers that three move
        >>> found = sparse_levenberg_marquardt({"R": block}, [term])
        >>> block.tangent, bool(found.x["R"].allclose(R.reshape(1, 9), atol=1e-6))
        (3, True)
    """

    x: Float[Tensor, "n k"]
    """Where the variables are, one in a row."""
    manifold: Manifold | None = None
    """Plain addition in all k coordinates if not given."""
    fixed: Bool[Tensor, "n"] | None = None
    """Which variables do not move; none if not given."""
    rest: Callable[[Tensor], Tensor] | None = None
    """Given where the variables are, motions (n, tangent, k) of all of them together of which steps have no part, if any.

    A gauge that residuals say a little of by their noise, say. Eliminated variables are free of it."""

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

    Derivatives come from `d` reverse sweeps. Where hand-written ones pay, `linearize(*variables, *data, out=...)` returns the
    residuals and fills `out`: for each block a tensor `(m, d, tangent)` for the derivatives with respect to its tangent step
    (stored with m last), or None where they are not needed.

    Example:
        >>> import torch
        >>> from torchsfm.optim import Block, Huber, Term, sparse_levenberg_marquardt
        >>> blocks = {"centre": Block(torch.zeros(1, 2)), "radius": Block(torch.ones(1, 1))}
        >>> angle = torch.arange(8).double()
        >>> x = 3 * torch.stack((angle.cos(), angle.sin()), -1) + torch.tensor([1.0, 2.0])
        >>> x[0] += 10  # wrong
        >>> def residual(centre, radius, x):  # one row a point
        ...     return (x - centre).norm(dim=-1, keepdim=True) - radius
        ...
        >>> one = torch.zeros(8, dtype=torch.int64)  # all depend on the same circle
        >>> term = Term(residual, ("centre", "radius"), (one, one), (x,), loss=Huber(0.1), weights=torch.ones(8))
        >>> found = sparse_levenberg_marquardt(blocks, [term]).x
        >>> found["centre"].round(decimals=1), found["radius"].round(decimals=1)
        (tensor([[1., 2.]]), tensor([[3.]]))
    """

    residual: Callable[..., Tensor]
    """The function of the variables and the data, `(m, d)`, in the unit in which the losses are meant."""
    blocks: tuple[str, ...]
    """The names of the blocks it depends on; one may stand twice."""
    index: tuple[Int[Tensor, "m"], ...]
    """For each of these, the variable of each residual."""
    data: tuple[Tensor, ...] = ()
    """What else it depends on, a row for each residual."""
    loss: Loss | None = None
    """Of the residuals' squared norms; `s` itself if not given."""
    weights: Float[Tensor, "m"] | None = None
    """Weight of each residual's squared norm; 0 leaves it out, whatever number it has."""
    linearize: Callable[..., Tensor] | None = None
    """Residuals and hand-written derivatives; automatic ones if not given."""
    bend: Callable[..., Tensor] | None = None
    """Hand-written second derivatives, where `linearize` is given; automatic ones if not.

    `(*variables, *data, by=, wanted=)` gives those of `by . residual`, `by (d, m)`, by the steps of the wanted variables,
    `(n, n, m)`; below the diagonal is nothing of account."""

    def select(self, rows: Tensor) -> "Term":
        """The term with some of its residuals."""
        return replace(
            self,
            index=tuple(i.index_select(0, rows) for i in self.index),
            data=tuple(_columns(d).index_select(-1, rows).movedim(-1, 0) for d in self.data),
            weights=None if self.weights is None else self.weights.index_select(0, rows),
        )


def block_names(eliminate: str | Sequence[str] | None) -> tuple[str, ...]:
    """The blocks to eliminate, one or several."""
    return () if eliminate is None else (eliminate,) if isinstance(eliminate, str) else tuple(eliminate)


def eliminated_block(term: Term, names: tuple[str, ...]) -> str | None:
    """Which eliminated block a term's residuals depend on.

    Raises:
        ValueError: They depend on two eliminated variables.
    """
    met = [name for name in term.blocks if name in names]
    if len(met) > 1:
        both = " and ".join(repr(name) for name in dict.fromkeys(met))
        raise ValueError(f"eliminate: a residual depends on two variables of {both}; they cannot be eliminated singly")
    return met[0] if met else None


def check_eliminate(blocks: Mapping[str, Block], eliminate: str | Sequence[str] | None) -> None:
    """See that what is to be eliminated is there.

    Raises:
        ValueError: A name is not that of a block.
    """
    check_options(eliminate=(eliminate, str | Sequence | None))
    for name in block_names(eliminate):
        if name not in blocks:
            raise ValueError(f"eliminate: wanted names among {sorted(blocks)}, got {name!r}")


def prepare(blocks: Mapping[str, Block], terms: Sequence[Term]) -> tuple[dict[str, Block], list[Term], tuple[Tensor, ...]]:
    """A problem ready to be worked on: in float64, detached, blocks stored column by column, without what cannot count.

    Returns:
        The blocks; the terms with the residuals that have weight and a finite share in the sum of squares; and which these are.
    """
    double = {name: replace(b, x=b.x.detach().double().mT.contiguous().mT) for name, b in blocks.items()}
    x = {name: b.x for name, b in double.items()}
    counted, used = [], []
    for term in terms:
        data = tuple(d.detach().double() if d.is_floating_point() else d.detach() for d in term.data)
        plain = replace(term, data=data, weights=None if term.weights is None else term.weights.detach().double())
        square = term_residual(plain, x).square().sum(-1)
        counts = square.isfinite() if plain.weights is None else (square * plain.weights).isfinite() & (plain.weights > 0)
        counted.append(plain if bool(counts.all()) else plain.select(counts.nonzero()[:, 0]))
        used.append(counts)
    return double, counted, tuple(used)


def _columns(x: Tensor) -> Tensor:
    """Rows last and contiguous."""
    return x.movedim(0, -1).contiguous()


class Workspace:
    """Memory that is used again and again: memory that is new costs more than the arithmetic on it."""

    def __init__(self, like: Tensor) -> None:
        self._like = like
        self._buffers: dict[tuple[str, tuple[int, ...]], Tensor] = {}

    def get(self, name: str, *shape: int) -> Tensor:
        """A buffer with whatever numbers it had last."""
        if (name, shape) not in self._buffers:
            self._buffers[name, shape] = self._like.new_empty(shape)
        return self._buffers[name, shape]


def gather(x: Float[Tensor, "n k"], index: Int[Tensor, "m"], out: Tensor | None = None) -> Float[Tensor, "m k"]:
    """Pick rows of a tensor stored column by column, and store the result so."""
    columns = x.mT
    return torch.gather(columns, 1, index.expand(columns.shape[0], -1), out=out).mT


def arguments_of(term: Term, x: dict[str, Tensor], work: Workspace | None) -> list[Tensor]:
    """The variables of each residual of a term."""
    found = []
    for k, (name, index) in enumerate(zip(term.blocks, term.index, strict=True)):
        out = None if work is None else work.get(f"{k} {name}", x[name].shape[1], index.shape[0])
        found.append(gather(x[name], index, out))
    return found


def term_residual(term: Term, x: dict[str, Tensor], work: Workspace | None = None) -> Float[Tensor, "m d"]:
    """The residuals at `x`."""
    return term.residual(*arguments_of(term, x, work), *term.data)


def term_cost(term: Term, residual: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
    """`sum w rho(|r|^2) / 2`."""
    if term.loss is None and term.weights is None:
        flat = residual.mT.flatten()
        return flat @ flat / 2
    return residual_costs(term, residual).sum()


def residual_costs(term: Term, residual: Float[Tensor, "m d"]) -> Float[Tensor, "m"]:
    """`w rho(|r|^2) / 2` of each residual."""
    square = residual.square().sum(-1)
    rho = square if term.loss is None else term.loss(square)
    return (rho if term.weights is None else rho * term.weights) / 2


def linearize(
    term: Term, x: dict[str, Tensor], lifts: dict[str, Tensor | None], out: list[Tensor | None], work: Workspace
) -> tuple[Tensor, Tensor | None]:
    """Fill `out` with the Jacobians `(m, d, tangent)`; return the residuals `(m, d)` and the factor `(m)` to scale both by.

    Scaled by `sqrt(w rho')`, their squares add up to the robust Gauss-Newton model (the first-order variant of Triggs et al.
    2000, 4.3, which stays positive definite). None is no scaling.
    """
    arguments = arguments_of(term, x, work)
    if term.linearize is not None:
        residual = term.linearize(*arguments, *term.data, out=out)
    else:
        residual = _differentiate(term, arguments, lifts, out)
    if term.loss is None:
        return residual, None if term.weights is None else term.weights.sqrt()
    scale = loss_slope(term.loss, residual.square().sum(-1))
    return residual, (scale if term.weights is None else scale * term.weights).sqrt()


def _differentiate(term: Term, arguments: list[Tensor], lifts: dict[str, Tensor | None], out: list[Tensor | None]) -> Tensor:
    """Each residual sees one row of each argument, so one reverse sweep gives one row of every Jacobian.

    Few residuals stand there once for each of these rows, so that one sweep gives them all: calls cost more than arithmetic.
    """
    wanted = [target for target in out if target is not None]
    m, d = len(term.index[0]), wanted[0].shape[1] if wanted else 1
    together = d if d * m <= FEW else 1
    columns = [a.mT.repeat(1, together) if together > 1 else a.mT.detach() for a in arguments]
    leaves = [column.requires_grad_(o is not None) for column, o in zip(columns, out, strict=True)]
    data = [_columns(t).repeat(*[1] * (t.ndim - 1), together).movedim(-1, 0) if together > 1 else t for t in term.data]
    follow = [leaf for leaf in leaves if leaf.requires_grad]
    with torch.enable_grad():
        value = term.residual(*(leaf.mT for leaf in leaves), *data)
        rows = value.reshape(together, m, value.shape[-1])
        for first in range(0, d if wanted else 0, together):
            # Sums, since the first call with factors of its own imports for half a second.
            row = rows[..., first : first + together].diagonal(dim1=0, dim2=2).sum()
            if row.requires_grad:
                slopes = torch.autograd.grad(row, follow, retain_graph=first + together < d, materialize_grads=True)
            else:
                slopes = tuple(torch.zeros_like(leaf) for leaf in follow)
            own = iter(slopes)
            for name, index, target in zip(term.blocks, term.index, out, strict=True):
                if target is None:
                    continue
                ambient, lift = next(own), lifts[name]
                ambient = ambient.view(len(ambient), together, m)
                if lift is not None:
                    ambient = (ambient[:, None] * lift.index_select(-1, index)[:, :, None]).sum(0)
                target[:, first : first + together] = ambient.permute(2, 1, 0)
    residual: Tensor = rows[0].detach()
    return residual


def lift_of(block: Block, x: Float[Tensor, "n k"]) -> Tensor | None:
    """The derivative `(k, tangent, n)` of the retraction at zero; None where it is the identity."""
    if block.manifold is None:
        return None
    n, k = x.shape
    together = k if k * n <= FEW else 1
    with torch.enable_grad():
        delta = x.new_zeros((together * n, block.tangent)).requires_grad_()
        moved = block.retract(x.detach().repeat(together, 1), delta).view(together, n, k)
        rows = []
        for first in range(0, k, together):
            row = moved[..., first : first + together].diagonal(dim1=0, dim2=2).sum()
            if row.requires_grad:
                rows.append(torch.autograd.grad(row, delta, retain_graph=True, materialize_grads=True)[0])
            else:
                rows.append(torch.zeros_like(delta))
    return torch.cat([row.view(together, n, block.tangent).mT for row in rows])
