"""The edges of a view graph as least squares over rotations: their residuals, minima, scatter and covariance.

The residual of an edge is the rotation vector of `R_j R_i' R_ij'`, in units of its standard deviation.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import rotvec_from_rotation
from torchsfm.motion.many_views.components import components
from torchsfm.motion.many_views.rotation_residual import bend, linearize, residual
from torchsfm.motion.many_views.spanning_rotations import spanning_rotations
from torchsfm.motion.many_views.triplets import find_triplets, pairs_within
from torchsfm.optim import Block, Loss, Rotation, SparseResult, Term, marginal_covariance
from torchsfm.optim import sparse_levenberg_marquardt as minimise
from torchsfm.optim.ranks import Group

QUARTILE = 1.2125
"""Of a squared residual of three normal components."""
EXACT = 1e-4
"""Radians that all edges are taken to be off at least: sharper losses find no way, and gain nothing."""

DAMPING = 1e-6
"""At the start: cameras are about where they belong, and more would hold long rows of them back."""


@dataclass(frozen=True)
class RotationGraph:
    """The edges that count, in double precision.

    Attributes:
        R: Relative rotations.
        edges: The cameras of each.
        deviation: Covariance of each, if it is known.
        W: `W' W` is the inverse of that covariance.
        weights: How much each counts, if not all alike.
        views: How many cameras there are.
        group: Processes that all have the same graph and minimise together.
    """

    R: Float[Tensor, "e 3 3"]
    edges: Int[Tensor, "e 2"]
    deviation: Float[Tensor, "e 3 3"] | None
    W: Float[Tensor, "e 3 3"]
    weights: Float[Tensor, "e"] | None
    views: int
    group: Group | None = None

    @classmethod
    def of(
        cls,
        R: Float[Tensor, "e 3 3"],
        edges: Int[Tensor, "e 2"],
        deviation: Float[Tensor, "e 3 3"] | None,
        weights: Float[Tensor, "e"] | None,
        views: int,
        group: Group | None = None,
    ) -> "RotationGraph":
        """Whiten the edges."""
        W = torch.eye(3, dtype=R.dtype, device=R.device).expand(len(R), 3, 3)
        if deviation is not None:
            lower, _ = torch.linalg.cholesky_ex(deviation)
            W = torch.linalg.solve_triangular(lower, W, upper=False)
        return cls(R, edges, deviation, W, weights, views, group)

    def start(self) -> tuple[Tensor, Tensor]:
        """Rotations along the tree of the edges that most triangles speak for; among equals the more precise ones."""
        R = self.R.detach()
        quality = find_triplets(R, self.edges, self.views).votes(len(R))
        weight = R.new_ones(len(R)) if self.weights is None else self.weights.detach()
        if self.deviation is not None:
            weight = weight / self.deviation.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
        if len(R):
            quality = quality + weight / weight.amax()
        return spanning_rotations(R, self.edges, quality, self.views)

    def disagreement(self, model: Float[Tensor, "v 3 3"]) -> Float[Tensor, "e 3 3"]:
        """`R_j R_i' R_ij'` of each edge."""
        i, j = self.edges.unbind(-1)
        return model[j] @ model[i].mT @ self.R.mT

    def square(self, model: Float[Tensor, "v 3 3"]) -> Float[Tensor, "e"]:
        """The squared residual of each edge."""
        e = rotvec_from_rotation(self.disagreement(model))[..., None]
        return (self.W @ e)[..., 0].square().sum(-1)

    def reseat(self, model: Float[Tensor, "v 3 3"], reach: float) -> Float[Tensor, "v 3 3"]:
        """Put cameras with which most of their edges disagree where one of these wants them, if more then agree.

        A sum of lengths has minima in which a few edges hold a camera far from where more of them would put it.
        """
        W = self.W
        camera = self.edges.mT.flatten()
        agree = (self.square(model) <= reach**2).repeat(2)
        total, support = (torch.bincount(c, minlength=self.views) for c in (camera, camera[agree]))
        i, j = self.edges.unbind(-1)
        wish = torch.cat((self.R.mT @ model[j], self.R @ model[i]))
        doubtful = (2 * support < total)[camera].nonzero()[:, 0]
        doubtful = doubtful[torch.argsort(camera[doubtful], stable=True)]
        backers = torch.zeros_like(camera)
        for a, b in pairs_within(camera[doubtful]):
            a, b = doubtful[a], doubtful[b]
            e = rotvec_from_rotation(wish[a] @ wish[b].mT)[..., None]
            near = [((W[k % len(W)] @ e)[..., 0].square().sum(-1) <= 2 * reach**2).long() for k in (a, b)]
            backers.index_add_(0, a, near[0]).index_add_(0, b, near[1])
        most = torch.zeros_like(support).scatter_reduce_(0, camera, backers + 1, "amax")
        # The first of the edges that most agree with.
        chosen = (backers + 1 == most[camera]).nonzero()[:, 0]
        seat = torch.full_like(support, len(wish)).scatter_reduce_(0, camera[chosen], chosen, "amin")
        move = (most > support) & (most > 1)
        return model.index_copy(0, move.nonzero()[:, 0], wish[seat[move]])

    def reseated(self, model: Float[Tensor, "v 3 3"], agrees: float) -> tuple[Float[Tensor, "v 3 3"], float]:
        """The same with a reach of so many standard deviations of the right edges; and their standard deviation afterwards."""
        model = self.reseat(model, agrees * self.scale(model))
        return model, self.scale(model)

    def better(
        self, first: Float[Tensor, "v 3 3"], second: Float[Tensor, "v 3 3"], loss: Loss
    ) -> tuple[Float[Tensor, "v 3 3"], float]:
        """Of each connected part of the graph the rotations that cost less; of equals the first. And the scale of all."""
        part = components(self.edges, self.views)
        weights = torch.ones_like(self.R[:, 0, 0]) if self.weights is None else self.weights
        gain = weights * (loss(self.square(first)) - loss(self.square(second)))
        gained = gain.new_zeros(self.views).index_add_(0, part[self.edges[:, 0]], gain)
        model = torch.where((gained > 0)[part, None, None], second, first)
        return model, self.scale(model)

    def scale(self, model: Float[Tensor, "v 3 3"]) -> float:
        """The standard deviation of the right edges, if a quarter of those that do not merely fix the model are right."""
        if not len(self.R):
            return EXACT
        least = self.least()
        fixing = min(self.views - 1, len(self.R) - 1)
        rank = fixing + (len(self.R) - fixing - 1) // 4
        return max(float((self.square(model).kthvalue(rank + 1).values / QUARTILE).sqrt()), least)

    def least(self) -> float:
        """The standard deviation that there is at least."""
        return EXACT * float(torch.linalg.matrix_norm(self.W).median()) / 3**0.5

    def terms(self, loss: Loss) -> list[Term]:
        """All edges."""
        i, j = self.edges.unbind(-1)
        return [Term(residual, ("R", "R"), (i, j), (self.R, self.W), loss, self.weights, linearize, bend)]

    def minimise(self, start: Float[Tensor, "v 3 3"], loss: Loss, max_iterations: int, tolerance: float) -> SparseResult:
        """The minimum nearest to a start."""
        blocks = {"R": Block(start.mT.flatten(1), Rotation())}
        return minimise(
            blocks, self.terms(loss), max_iterations=max_iterations, function_tolerance=tolerance, initial_damping=DAMPING,
            group=self.group,
        )  # fmt: skip

    def covariance(self, model: Tensor, component: Tensor, status: Tensor, loss: Loss, scale: float) -> Float[Tensor, "v 3 3"]:
        """That of each rotation, with the first cameras of all components held."""
        first = component == torch.arange(self.views, device=component.device)
        known, unknown = status == int(Status.OK), torch.diag(model.new_full((3,), torch.inf))
        if scale == torch.inf:
            return torch.where((first & known)[:, None, None], 0, unknown)
        within = (component[self.edges[:, 0]] == component[self.edges[:, 1]]).nonzero()[:, 0]
        terms = [term.select(within) for term in self.terms(loss)]
        block = Block(model.mT.flatten(1), Rotation(), first | ~known)
        spread = scale**2 * marginal_covariance({"R": block}, terms, "R")
        return torch.where(known[:, None, None], model @ spread @ model.mT, unknown)


def rotations_of(found: SparseResult) -> Float[Tensor, "v 3 3"]:
    """The rotations from the world to the cameras that a minimum holds the other way round."""
    return found.x["R"].view(-1, 3, 3).mT
