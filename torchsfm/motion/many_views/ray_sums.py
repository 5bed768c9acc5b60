"""Sums over rays whose minima are where cameras and points are.

With the direction v of a ray in the world and D from the centre to the point, two sums are minimised one after the other, both
with three unknowns a camera and a point, points eliminated:

    |D - max(v'D, 1) v|          distances from the half ray that begins one unit ahead of the camera: convex, so the minimum
                                 does not depend on the start, and there is no collapse into one point
    |v - max(v'D, 0) D / |D|^2|  the sine of the angle between the two, which does not depend on distances

The first is least unsquared deviations (Ozyesil & Singer, "Robust camera location estimation by convex programming", CVPR
2015), of rays to points in place of directions between cameras; the second is what global positioning minimises (Pan et al.,
"Global structure-from-motion revisited", ECCV 2024) with the scale of each ray eliminated.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.motion.many_views.components import components
from torchsfm.optim import Block, Huber, Loss, SparseResult, Term
from torchsfm.optim import sparse_levenberg_marquardt as minimise
from torchsfm.optim.ranks import Group

CORNER = 0.1
"""Distance from its ray, at one unit ahead of the camera, from which a point pulls with constant force."""
ROUGH = 1e-3
"""Part of the cost to which sums are minimised that set the scale of the next."""
QUARTILE = 0.5754
"""Of a squared residual of two normal components."""
EXACT = 1e-5
"""The least standard deviation of rays, in radians."""
ROUNDS, LEFT = 3, 0.2
"""How often a scale is found by the rays that agree to the last, and the freedom that each has at least, of 2."""
HUBER = 1.5
"""Standard deviations from which a ray pulls with constant force in the second sum at first."""
AGREES = 4.0
"""Standard deviations within which a ray agrees."""
FROM_NOWHERE, DAMPING = 1e-4, 1e-6
"""Of the first step: of the first sum, and of the second, which begins where cameras about belong. More would hold back long
rows of them, and hide how little is left to gain."""
REACH = 5.0
"""Scale of its last loss: where rays lose their pull, in standard deviations."""


@dataclass(frozen=True)
class Rays:
    """The rays that count, turned into the world, in double precision; the processes of a group all have them."""

    v: Float[Tensor, "m 3"]
    view: Int[Tensor, "m"]
    point: Int[Tensor, "m"]
    weights: Float[Tensor, "m"] | None
    views: int
    points: int
    group: Group | None = None

    def component(self) -> Int[Tensor, "v"]:
        """The smallest camera that each is connected with."""
        pairs = torch.stack((self.view, self.views + self.point), 1)
        return components(pairs, self.views + self.points)[: self.views]

    def convex(self, max_iterations: int) -> dict[str, Tensor]:
        """The minimum of distances from half rays."""
        zero = {"c": self.v.new_zeros(self.views, 3), "X": self.v.new_zeros(self.points, 3)}
        derivatives = _linearize_ahead, _bend_ahead
        term = Term(_ahead, ("c", "X"), (self.view, self.point), (self.v,), Huber(CORNER), self.weights, *derivatives)
        return self._minimise(zero, term, max_iterations, ROUGH, FROM_NOWHERE).x

    def angular(self, start: dict[str, Tensor], loss: Loss, max_iterations: int, tolerance: float) -> SparseResult:
        """The minimum of the sines of angles."""
        return self._minimise(start, self.sines(loss), max_iterations, tolerance, DAMPING)

    def scale(self, x: dict[str, Tensor], lost: float) -> float:
        """The standard deviation of the right rays, if a quarter of all are right.

        Args:
            x: Centres and points.
            lost: The part of the residuals' freedom that centres and points have taken.
        """
        if not len(self.v):
            return EXACT
        square = sine(x["c"][self.view], x["X"][self.point], self.v).square().sum(-1)
        quartile = float(square.kthvalue(1 + (len(square) - 1) // 4).values)
        return max(math.sqrt(quartile / QUARTILE / (1 - lost)), EXACT)

    def spread(self, x: dict[str, Tensor], scale: float) -> float:
        """The standard deviation of the rays that agree, by the freedom that their cameras and points leave them.

        Args:
            x: Centres and points.
            scale: One that is about right; by overfitting, a quartile may be half of it.
        """
        off = sine(x["c"][self.view], x["X"][self.point], self.v).norm(dim=-1)
        for _ in range(ROUNDS):
            agree = off <= AGREES * scale
            held = torch.bincount(self.point[agree], minlength=self.points) >= 2
            agree = agree & held[self.point]
            number = int(agree.sum())
            left = 2 * number - 3 * int(held.sum()) - 3 * len(torch.unique(self.view[agree]))
            scale = max(math.sqrt(float(off[agree].square().sum()) / max(left, LEFT * number, 1)), EXACT)
        return scale

    def anchored(self, found: SparseResult, component: Int[Tensor, "v"]) -> tuple[Tensor, Tensor]:
        """Centres and points with the gauge of each component fixed."""
        c, X = found.x["c"], found.x["X"]
        number = torch.bincount(component, minlength=self.views).clamp(min=1)[:, None]
        mean = torch.zeros_like(c).index_add(0, component, c) / number
        square = (c - mean[component]).square().sum(-1, keepdim=True)
        extent = (torch.zeros_like(square).index_add(0, component, square) / number).clamp(min=1e-60).sqrt()
        at = torch.zeros(self.points, dtype=torch.long, device=X.device).index_put_((self.point,), component[self.view])
        return (c - c[component]) / extent[component], (X - c[at]) / extent[at]

    def sines(self, loss: Loss, unit: float = 1.0) -> Term:
        """Sines of angles, in a unit."""
        data = unit * self.v, self.v
        return Term(_sine_scaled, ("c", "X"), (self.view, self.point), data, loss, self.weights, _linearize_sine, _bend_sine)

    def _minimise(
        self, start: dict[str, Tensor], term: Term, max_iterations: int, tolerance: float, damping: float
    ) -> SparseResult:
        blocks = {name: Block(x) for name, x in start.items()}
        return minimise(
            blocks, [term], eliminate="X", max_iterations=max_iterations, function_tolerance=tolerance,
            initial_damping=damping, group=self.group,
        )  # fmt: skip


def _ahead(c: Tensor, X: Tensor, v: Tensor) -> Tensor:
    """From the nearest point of the half ray to X."""
    D = X - c
    return D - (v * D).sum(-1, keepdim=True).clamp(min=1) * v


def _linearize_ahead(c: Tensor, X: Tensor, v: Tensor, *, out: list[Tensor | None]) -> Tensor:
    """The same, and its derivatives: those of X, and for c their negatives."""
    rows = v.mT
    beyond = ((X - c).mT * rows).sum(0) > 1
    J = torch.eye(3, dtype=v.dtype, device=v.device)[:, :, None] - torch.where(beyond, rows, 0.0) * rows[:, None]
    return _store(J, out, _ahead(c, X, v))


def _bend_ahead(c: Tensor, X: Tensor, v: Tensor, *, by: Float[Tensor, "3 m"], wanted: Sequence[bool]) -> Float[Tensor, "n n m"]:
    """Straight on both sides of where the half ray begins."""
    n = 3 * sum(wanted)
    return by.new_zeros((n, n, len(v)))


def _unit(D: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Directions of D, and lengths, no less than 1e-12; `vector_norm` takes many times as long where columns are stored so."""
    length = D.square().sum(dim, keepdim=True).clamp(min=1e-24).sqrt()
    return D / length, length


def sine(c: Tensor, X: Tensor, v: Tensor) -> Tensor:
    """From the nearest point of the line through c and X, or from c where that lies behind, to the end of v."""
    u, _ = _unit(X - c, -1)
    return v - (v * u).sum(-1, keepdim=True).clamp(min=0) * u


def _sine_scaled(c: Tensor, X: Tensor, scaled: Tensor, v: Tensor) -> Tensor:
    """The same in the unit of `scaled`, a multiple of v."""
    u, _ = _unit(X - c, -1)
    return scaled - (scaled * u).sum(-1, keepdim=True) * torch.where((v * u).sum(-1, keepdim=True) > 0, u, 0.0)


def _linearize_sine(c: Tensor, X: Tensor, scaled: Tensor, v: Tensor, *, out: list[Tensor | None]) -> Tensor:
    """The same, and its derivatives."""
    (u, length), unit = _unit((X - c).mT, 0), scaled.mT
    s = (unit * u).sum(0)
    ahead = (v.mT * u).sum(0) > 0
    across = unit - s * u
    J = u[:, None] * (across - s * u)
    J.diagonal().add_(s[:, None])
    J = torch.where(ahead, -J / length, 0.0)
    return _store(J, out, (unit - torch.where(ahead, s, 0.0) * u).mT)


def _bend_sine(
    c: Tensor, X: Tensor, scaled: Tensor, v: Tensor, *, by: Float[Tensor, "3 m"], wanted: Sequence[bool]
) -> Float[Tensor, "n n m"]:
    """The second derivatives of `by . _sine_scaled`, which is `-(scaled'u)(by'u)` and a constant, by c and X."""
    (u, length), s = _unit((X - c).mT, 0), scaled.mT
    along, across = (s * u).sum(0), (by * u).sum(0)
    outer = u[:, None] * (across * s + along * by)
    product = s[:, None] * by
    eye = torch.eye(3, dtype=u.dtype, device=u.device)[:, :, None]
    H = 2 * (outer + outer.transpose(0, 1)) - product - product.transpose(0, 1)
    H = H + 2 * along * across * (eye - 4 * u[:, None] * u)
    H = torch.where((v.mT * u).sum(0) > 0, H / length.square(), 0.0)
    if all(wanted):
        return torch.cat((torch.cat((H, -H), 1), torch.cat((-H, H), 1)), 0)
    return H


def _store(J: Float[Tensor, "3 3 m"], out: list[Tensor | None], residual: Tensor) -> Tensor:
    """Derivatives by X, their negatives by c."""
    J = J.permute(2, 0, 1)
    if out[0] is not None:
        torch.neg(J, out=out[0])
    if out[1] is not None:
        out[1].copy_(J)
    return residual
