"""Similarities of many local models from those between pairs of them, of which some may be wrong: loops of a film close.

An edge says where the second model has places of the first. Its residual is the distance between these and where the two
models' similarities bring them, in the second model and in units of its standard deviation: distances in a model cannot shrink
with it, so nothing collapses. Rotations come first (`average_rotations`), then the logarithms of scales and the translations,
each a linear problem under a loss that lets a drift spread along the chain instead of breaking the loop; then all together, at
last under a loss by which wrong edges have no pull (Strasdat, Montiel & Davison, "Scale drift-aware large scale monocular
SLAM", RSS 2010).
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_index, check_one_problem, check_options
from torchsfm.geometry import Similarity, rotvec_from_rotation
from torchsfm.linalg import usable
from torchsfm.motion.many_views.average_rotations import average_rotations
from torchsfm.motion.many_views.components import components
from torchsfm.motion.many_views.rotation_loops import vouched_parts
from torchsfm.optim import Block, GemanMcClure, Huber, Loss, Term, rotation_exponential
from torchsfm.optim import sparse_levenberg_marquardt as minimise

ROUNDS = 2
"""Sums of lengths minimised, each with the scale that the last has left."""
REACH = 5.0
"""Scale of the last loss: where edges lose their pull, in standard deviations."""
AGREES = 4.0
"""Standard deviations within which an edge agrees."""
EXACT = 1e-6
"""Of the extent of an edge's places, what it is taken to be off at least."""
MEDIAN = 0.727
"""Of the root mean square of twelve residuals that have seven degrees of freedom, each normal."""
SHARPEST = 1e-3
"""Standard deviations to which losses are fitted at least: sharper ones find no way, and gain nothing."""
ROUGH, FINE = 1e-3, 1e-6
"""Part of the cost to which sums are minimised that set the scale of the next, and the last."""


@dataclass(frozen=True)
class AveragedSimilarities:
    """Similarities of n models that agree best with e edges.

    Attributes:
        model: From the models to the world, which is the smallest model of each component.
        status: OK; TOO_FEW: no edge of this model counts; NO_CONSENSUS: none of its edges agrees, or one of several, or
            its loops are closed so badly, and so few, that unrelated models close theirs as well; NOT_CONVERGED: the iteration
            limit came first.
        component: The smallest model that each is connected with through edges that agree, and that loops of theirs confirm or
            nothing contradicts. Worlds of different components have nothing to do with each other.
        distance: By how much each edge disagrees: the root mean square distance of its places, in standard deviations of the
            edge; infinite for edges that do not count.
        inliers: Edges that agree to within four times the scatter of the right ones.
        scale: That scatter, in units of what `deviation` says.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> size = torch.tensor([1.0, 2.0, 0.5, 1.5, 1.0])  # of five models
        >>> world = torchsfm.Similarity(size, torchsfm.geometry.random_rotation(5, generator=g), torch.randn(5, 3, generator=g))
        >>> local = world.inverse().transform(torch.randn(20, 3, generator=g))  # the same points in each
        >>> edges = torch.combinations(torch.arange(5))
        >>> between = torchsfm.geometry.similarity_from_points(local[edges[:, 0]], local[edges[:, 1]])
        >>> between.t[4] += 5  # one of ten is wrong
        >>> found = torchsfm.motion.average_similarities(between, edges, models=5)
        >>> found.inliers.sum(), found.distance.argmax(), bool((found.component == 0).all())
        (tensor(9), tensor(4), True)
    """

    model: Similarity
    status: Int8[Tensor, "n"]
    component: Int[Tensor, "n"]
    distance: Float[Tensor, "e"]
    inliers: Bool[Tensor, "e"]
    scale: Float[Tensor, ""]


def average_similarities(
    between: Similarity,
    edges: Int[Tensor, "e 2"],
    *,
    models: int,
    places: Float[Tensor, "e p 3"] | None = None,
    deviation: Float[Tensor, "e"] | None = None,
    max_iterations: int = 100,
) -> AveragedSimilarities:
    """Similarities from local models to one world, robustly.

    Windows of a film give local models; those that follow each other share frames, and so do those where the camera comes back.
    What each window adds to the drift of scale, direction and place is spread over the loop.

    A model that hangs on the rest by a single edge is where that edge puts it. Where two parts of a graph are joined by fewer
    right edges than wrong ones that agree with each other, these win.

    Args:
        between: The similarity of each edge, from its first model to its second, as `similarity_from_points` finds it from what
            both share.
        edges: The first and second model of each.
        models: Number of models.
        places: Of what the two models of each edge share, in the first one: the edge is held there. Three that are not on a
            line, or more. The origin and the ends of the axes if not given.
        deviation: Standard deviation of a coordinate of these places in the second model; that all are off by a common factor
            does no harm. If not given it is in proportion to their extent there.
        max_iterations: Most steps of each of the minimisations.

    Returns:
        Similarities, statuses, components, and what is thought of each edge. Edges that are not finite, whose scale or
        deviation is not positive, or that join a model with itself do not count.

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or a model's number is out of range.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> size = torch.tensor([1.0, 2.0, 0.5, 1.5, 1.0])  # of five models
        >>> world = torchsfm.Similarity(size, torchsfm.geometry.random_rotation(5, generator=g), torch.randn(5, 3, generator=g))
        >>> local = world.inverse().transform(torch.randn(20, 3, generator=g))  # the same points in each
        >>> edges = torch.combinations(torch.arange(5))
        >>> between = torchsfm.geometry.similarity_from_points(local[edges[:, 0]], local[edges[:, 1]])
        >>> found = torchsfm.motion.average_similarities(between, edges, models=5)
        >>> bool(found.model.scale.allclose(size)), int(found.inliers.sum())
        (True, 10)
    """
    check_options(between=(between, Similarity))
    check_one_problem(
        scale=(between.scale, "e"), R=(between.R, "e 3 3"), t=(between.t, "e 3"), edges=(edges, "e 2: int"),
        places=(places, "?e p>=3 3"), deviation=(deviation, "?e"),
    )  # fmt: skip
    check_options(models=(models, "int >= 0"), max_iterations=(max_iterations, "int >= 0"))
    check_index(edges=(edges, models))
    edges, dtype = edges.long(), between.t.dtype
    if places is None:
        corners = torch.cat((between.t.new_zeros(1, 3), torch.eye(3, dtype=dtype, device=edges.device)))
        places = corners.expand(len(edges), 4, 3)
    with torch.no_grad():
        counts = _countable(between, edges, places, deviation)
    kept = counts.nonzero()[:, 0]
    graph = _Graph.of(between, edges, places, deviation, kept, models)
    with torch.no_grad():
        x = graph.start(max_iterations)
        for _ in range(ROUNDS):
            x, _ = graph.minimise(x, Huber(graph.scatter(x)), max_iterations, ROUGH)
        scatter, before = graph.scatter(x), torch.inf
        while scatter < 0.5 * before:
            # Freed from the pull of wrong edges the right ones come closer.
            x, _ = graph.minimise(x, GemanMcClure(REACH * scatter), max_iterations, ROUGH)
            before, scatter = scatter, graph.scatter(x)
    x, course = graph.minimise(x, GemanMcClure(REACH * scatter), max_iterations, FINE)
    with torch.no_grad():
        distance = torch.full_like(between.scale, torch.inf)
        distance[kept] = graph.distance(x.detach()).to(dtype)
        inliers = counts & (distance <= AGREES * scatter)
        part = vouched_parts(graph.angle(x), graph.edges, models)
        vouched = part[edges[:, 0]] == part[edges[:, 1]]
        component = components(edges[inliers & vouched], models)
        counted, agreeing = (torch.bincount(edges[e].flatten(), minlength=models) for e in (counts, inliers))
        # One edge of several supports nothing but itself, and unrelated models may be as near to closing as few loops.
        alone = (agreeing < 2) & (agreeing < counted)
        unrelated = torch.bincount(edges[counts & vouched].flatten(), minlength=models) == 0
        code = torch.where(alone | unrelated, int(Status.NO_CONSENSUS), int(course))
        status = torch.where(counted == 0, int(Status.TOO_FEW), code).to(torch.int8)
    scale, R, t = _parts(x)
    # The world is the first model of each component.
    first = component
    R0 = R[first].mT
    t = (R0 @ (t - t[first])[..., None])[..., 0] / scale[first, None]
    found = Similarity((scale / scale[first]).to(dtype), (R0 @ R).to(dtype), t.to(dtype))
    # A chain of scales may end beyond all numbers.
    lost = ~(found.scale.isfinite() & (found.scale > 0) & found.t.isfinite().all(-1))
    status = torch.where(lost & (status == Status.OK), int(Status.NOT_FINITE), status)
    return AveragedSimilarities(found, status, component, distance, inliers, between.t.new_tensor(scatter))


@dataclass(frozen=True)
class _Similar:
    """Similarities `(R, log s, t)` moved in the world: equal steps of all are a change of the world, and of nothing else."""

    ambient: ClassVar[int] = 13
    tangent: ClassVar[int] = 7

    def retract(self, x: Float[Tensor, "*#b 13"], delta: Float[Tensor, "*#b 7"]) -> Float[Tensor, "*b 13"]:
        turn, grow = rotation_exponential(delta[..., :3]), delta[..., 3:4]
        R = turn @ x[..., :9].reshape(*x.shape[:-1], 3, 3)
        t = grow.exp() * (turn @ x[..., 10:, None])[..., 0] + delta[..., 4:]
        return torch.cat((R.flatten(-2), (x[..., 9:10] + grow).expand(*t.shape[:-1], 1), t), -1)


@dataclass(frozen=True)
class _Graph:
    """The edges that count, in double precision."""

    edges: Int[Tensor, "e 2"]
    S: Similarity
    place: Float[Tensor, "e 4 3"]
    """Four places that stand for all of an edge, in its first model: their mean, and along each axis as far off as they are."""
    there: Float[Tensor, "e 4 3"]
    """Where they are in the second."""
    deviation: Float[Tensor, "e"]
    models: int

    @classmethod
    def of(
        cls, between: Similarity, edges: Tensor, places: Tensor, deviation: Tensor | None, kept: Tensor, models: int
    ) -> "_Graph":
        S = Similarity(between.scale[kept].double(), between.R[kept].double(), between.t[kept].double())
        places = places[kept].double()
        mean = places.mean(1, keepdim=True)
        extent = (places - mean).square().sum((1, 2), keepdim=True).div(places.shape[1]).sqrt()
        axes = torch.eye(4, 3, dtype=places.dtype, device=places.device).roll(1, 0)
        place = mean + extent * axes
        there = S.transform(place)
        size = S.scale * extent[:, 0, 0]
        told = size if deviation is None else torch.maximum(deviation[kept].double(), EXACT * size)
        return cls(edges[kept], S, place, there, told, models)

    def start(self, max_iterations: int) -> Float[Tensor, "n 13"]:
        """Rotations, then scales, then translations."""
        i, j = self.edges.unbind(-1)
        # R_i = R_j R: rotations from the world to the models.
        R = average_rotations(self.S.R, self.edges, views=self.models, max_iterations=max_iterations).model.mT
        log = self._differences(self.S.scale.log()[:, None], torch.ones_like(self.deviation), max_iterations)
        # At the middle of what both share, where it is known best.
        middle = self.place[:, 0]
        at = log[i].exp() * (R[i] @ middle[..., None])[..., 0]
        there = log[j].exp() * (R[j] @ self.there[:, 0, :, None])[..., 0]
        t = self._differences(there - at, log[j, 0].exp() * self.deviation, max_iterations)
        return torch.cat((R.flatten(1), log, t), 1)

    def _differences(self, difference: Tensor, deviation: Tensor, max_iterations: int) -> Tensor:
        """Values x with `x_i - x_j` near what edges say, most of them."""
        x = difference.new_zeros(self.models, difference.shape[1])
        ends, scale = tuple(self.edges.unbind(-1)), 1.0
        for _ in range(1 + ROUNDS):
            term = Term(_difference, ("x", "x"), ends, (difference, deviation), Huber(scale))
            x = minimise({"x": Block(x)}, [term], max_iterations=max_iterations).x["x"]
            off = _difference(x[ends[0]], x[ends[1]], difference, deviation).norm(dim=-1)
            scale = max(float(off.median()), SHARPEST) if len(off) else scale
        return x

    @property
    def _data(self) -> tuple[Tensor, Tensor, Tensor]:
        """Places, and where they are in standard deviations: by these numbers rounding is told where edges fit exactly."""
        return self.place, self.there / self.deviation[:, None, None], self.deviation

    def distance(self, x: Float[Tensor, "n 13"]) -> Float[Tensor, "e"]:
        """The root mean square residual of each edge's places."""
        i, j = self.edges.unbind(-1)
        return _residual(x[i], x[j], *self._data).square().mean(-1).sqrt()

    def angle(self, x: Float[Tensor, "n 13"]) -> Float[Tensor, "e"]:
        """By how much each edge's rotation disagrees, in radians."""
        i, j = self.edges.unbind(-1)
        R = _parts(x)[1]
        off: Tensor = rotvec_from_rotation(R[j].mT @ R[i] @ self.S.R.mT).norm(dim=-1)
        return off

    def scatter(self, x: Float[Tensor, "n 13"]) -> float:
        """The standard deviation of the right edges, if half of those that do not merely fix the models are right."""
        if not len(self.edges):
            return SHARPEST
        fixing = min(self.models - 1, len(self.edges) - 1)
        rank = fixing + (len(self.edges) - fixing - 1) // 2
        return max(float(self.distance(x).kthvalue(rank + 1).values) / MEDIAN, SHARPEST)

    def minimise(
        self, x: Float[Tensor, "n 13"], loss: Loss, max_iterations: int, tolerance: float
    ) -> tuple[Float[Tensor, "n 13"], Status]:
        """The minimum nearest to a start."""
        term = Term(_residual, ("S", "S"), self.edges.unbind(-1), self._data, loss)
        found = minimise({"S": Block(x, _Similar())}, [term], max_iterations=max_iterations, function_tolerance=tolerance)
        return found.x["S"], found.status


def _parts(x: Float[Tensor, "*b 13"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """Scale, rotation and translation."""
    return x[..., 9].exp(), x[..., :9].reshape(*x.shape[:-1], 3, 3), x[..., 10:]


def _residual(a: Tensor, b: Tensor, place: Tensor, there: Tensor, deviation: Tensor) -> Tensor:
    """How far the places of a are in b from `there`, where they should be, both in standard deviations."""
    (s, R, t), (s2, R2, t2) = _parts(a), _parts(b)
    world = s[..., None, None] * place @ R.mT + t[..., None, :]
    back = (world - t2[..., None, :]) @ R2 / (s2 * deviation)[..., None, None]
    return (back - there).flatten(-2)


def _difference(a: Tensor, b: Tensor, difference: Tensor, deviation: Tensor) -> Tensor:
    return (a - b - difference) / deviation[..., None]


def _countable(between: Similarity, edges: Tensor, places: Tensor, deviation: Tensor | None) -> Bool[Tensor, "e"]:
    """Edges that say something."""
    good = usable(between.R).flatten(1).all(-1) & usable(between.t).all(-1) & usable(between.scale) & (between.scale > 0)
    good = good & usable(places).flatten(1).all(-1) & (edges[:, 0] != edges[:, 1])
    good = good & ((places - places.mean(1, keepdim=True)).abs().amax((1, 2)) > 0)
    if deviation is not None:
        good = good & usable(deviation) & (deviation > 0)
    counts: Tensor = good
    return counts
