"""Rotations of all cameras of a view graph from relative rotations of which many may be wrong.

Residuals are those of `rotation_graph`. The start is a spanning tree of edges that close best around triangles; from there a
minimum of the sum of lengths, which outliers bend little (Hartley, Aftab & Trumpf, "L1 rotation averaging using the Weiszfeld
algorithm", CVPR 2011), whose scatter then sets the scale of a loss under which they have no pull at all (Chatterjee & Govindu,
"Robust relative rotation averaging", PAMI 2018). Each is a sparse problem of three unknowns a camera, turns of the world seen
by it: equal ones of all cameras change nothing, which is what `optim.multigrid` makes use of.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_index, check_one_problem, check_options, tensor_map
from torchsfm.linalg import usable
from torchsfm.motion.many_views.components import components
from torchsfm.motion.many_views.rotation_graph import RotationGraph, rotations_of
from torchsfm.motion.many_views.rotation_loops import count_loops, vouched_parts
from torchsfm.motion.many_views.triplets import turn_angle
from torchsfm.optim import GemanMcClure, Huber, Loss
from torchsfm.optim.ranks import Group, Ranks

ROUNDS = 2
"""Sums of lengths minimised, each with the scale that the last has left."""
ROUGH = 1e-3
"""Part of the cost to which that is done."""
SEATS = 3
"""Rounds at most of the last loss, each with the scale that the last has left, from where most edges want cameras then."""
SETTLED = 0.75
"""Part of the last scale from which on another round would change little."""
REACH = 5.0
"""Scale of the last loss: where edges lose their pull, in standard deviations."""
AGREES = 4.0
"""Standard deviations within which an edge agrees: 0.1 % of right ones do not."""
NOT_A_ROTATION = 1e-2
"""By how much entries of `R R'` may differ from those of the identity."""


@dataclass(frozen=True)
class AveragedRotations:
    """Rotations of v cameras that agree best with e edges.

    Attributes:
        model: Rotations from the world to the cameras. The world is the smallest camera of each component.
        status: OK; TOO_FEW: no edge of this camera counts; NO_CONSENSUS: of several edges at most one
            agrees with the rest, or its loops close no better than those of unrelated rotations might; NOT_CONVERGED: the
            iteration limit came first, the rotations are the best seen.
        component: The smallest camera that each is connected with through edges that agree, and that loops of theirs confirm or
            nothing contradicts. Rotations of different components have nothing to do with each other.
        angle: By how much each edge disagrees with the model, in radians; pi for edges that do not count.
        inliers: Edges that agree to within four standard deviations.
        scale: Standard deviation of the right edges in each of three directions, as the loops that they close tell: in radians,
            or in units of what `deviation` says, 1 where there are no loops.
        covariance: If asked for, that of each rotation, for a turn `exp(w) R` in the frame of the camera, relative to the
            smallest camera of its component; infinite for cameras that are not OK, and for all but the first of each component
            where no loop, and no `deviation`, tells how large the errors are.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.random_poses(6, spread=3.0, generator=torch.Generator().manual_seed(0)).R
        >>> edges = torch.cat((torch.combinations(torch.arange(4)), torch.tensor([[4, 5]])))  # two groups of cameras
        >>> found = torchsfm.motion.average_rotations(R[edges[:, 1]] @ R[edges[:, 0]].mT, edges, views=6)
        >>> found.component, bool(found.angle.max() < 1e-6)  # radians, of each edge
        (tensor([0, 0, 0, 0, 4, 4]), True)
        >>> bool(found.model[3].allclose(R[3] @ R[0].mT))
        True
    """

    model: Float[Tensor, "v 3 3"]
    status: Int8[Tensor, "v"]
    component: Int[Tensor, "v"]
    angle: Float[Tensor, "e"]
    inliers: Bool[Tensor, "e"]
    scale: Float[Tensor, ""]
    covariance: Float[Tensor, "v 3 3"] | None = None


def average_rotations(
    R: Float[Tensor, "e 3 3"],
    edges: Int[Tensor, "e 2"],
    *,
    views: int,
    deviation: Float[Tensor, "e 3 3"] | None = None,
    weights: Float[Tensor, "e"] | None = None,
    covariance: bool = False,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
    group: Group | None = None,
) -> AveragedRotations:
    """Rotations of all cameras of a view graph, robustly.

    One sparse problem of any size and density: graphs that have no edge in common may be given as one, and each comes out as a
    component of its own. Edges between the same two cameras count each by itself.

    A camera that hangs on the rest by a single edge is where that edge puts it, right or wrong, and so are two parts of a
    graph: nothing tells. Where most edges of a camera are wrong in the same way (things that look alike) they win.

    Args:
        R: Relative rotations, `R_j = R R_i` for cameras i and j of an edge.
        edges: The first and second camera of each.
        views: Number of cameras.
        deviation: Covariance of each relative rotation, for a turn `exp(w) R` in radians, as two-view estimation gives it; that
            all are off by a common factor does no harm. All edges are alike if not given.
        weights: What each edge counts; 0 leaves it out.
        covariance: Compute the covariance of each rotation: dense, for up to some thousand cameras.
        max_iterations: Most steps of each of the minimisations.
        tolerance: Part of the cost that the last of them may leave; where rotations are adjusted later, 1e-3 will do.
        group: Processes of `torch.distributed`, started by `torchrun` for one, that call this with the same graph and share
            what the minimisations take: edges are divided, rotations are known to all. Each iteration of conjugate gradients
            sends three numbers of each camera three times. The first does the rest, the coarser graphs of `optim.multigrid`,
            triangles, start, loops and covariances, while the others wait. All return the same, which is what one process
            finds, to rounding; see `sparse_levenberg_marquardt`.

    Returns:
        Rotations, statuses, components, and what is thought of each edge. Edges that are not finite, whose R is no rotation,
        whose covariance is not positive or that join a camera with itself do not count. `model` carries its derivatives with
        respect to `R`, `deviation` and `weights` by the implicit function theorem, at the scale that was found.

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or a camera's number is out of range.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.random_poses(6, spread=3.0, generator=torch.Generator().manual_seed(0)).R
        >>> edges = torch.combinations(torch.arange(6))  # every pair of six cameras
        >>> relative = R[edges[:, 1]] @ R[edges[:, 0]].mT
        >>> relative[0] = torch.eye(3)  # one of them is wrong
        >>> found = torchsfm.motion.average_rotations(relative, edges, views=6)
        >>> bool(found.model.allclose(R @ R[0].mT)), found.inliers[:3]
        (True, tensor([False,  True,  True]))
    """
    check_one_problem(
        R=(R, "e 3 3"), edges=(edges, "e 2: int"), deviation=(deviation, "?e 3 3"), weights=(weights, "?e")
    )  # fmt: skip
    check_options(views=(views, "int >= 0"), covariance=(covariance, bool), max_iterations=(max_iterations, "int >= 0"))
    check_options(tolerance=(tolerance, "float >= 0"), group=(group, Group | None))
    check_index(edges=(edges, views))
    edges = edges.long()
    # What is not minimised the first of several processes does alone.
    ranks, device = Ranks(group), R.device
    with torch.no_grad():
        counts = ranks.once(device, _countable, R, edges, deviation, weights)
    kept = counts.nonzero()[:, 0]
    sigma = None if deviation is None else deviation[kept].double()
    weight = None if weights is None else weights[kept].double()
    graph = RotationGraph.of(R[kept].double(), edges[kept], sigma, weight, views, group)
    with torch.no_grad():
        tree, _ = ranks.once(device, graph.start)
        start, scale = tree, ranks.once(device, graph.scale, tree)
        of_tree = scale
        for _ in range(ROUNDS):
            start = rotations_of(graph.minimise(start, Huber(scale), max_iterations, ROUGH))
            start, scale = ranks.once(device, graph.reseated, start, AGREES)
        # A few wrong edges that claim to be very exact outweigh all right ones in a sum of lengths, but not in the tree.
        scale = min(scale, of_tree)
        loss = GemanMcClure(REACH * scale)
        start, tree = (rotations_of(graph.minimise(x, loss, max_iterations, ROUGH)) for x in (start, tree))
        start, left = ranks.once(device, graph.better, start, tree, loss)
        for _ in range(SEATS):
            if left > SETTLED * scale:
                break
            # It was that of rotations that wrong edges bend, and too large.
            scale, loss = left, GemanMcClure(REACH * left)
            moved = ranks.once(device, graph.reseat, start, AGREES * scale)
            moved = rotations_of(graph.minimise(moved, loss, max_iterations, ROUGH))
            start, left = ranks.once(device, graph.better, start, moved, loss)
    found = graph.minimise(start, loss, max_iterations, tolerance)
    model = rotations_of(found)
    with torch.no_grad():
        told = ranks.once(device, _judge, graph, model.detach(), found.status, edges, counts, loss, scale, covariance)
    told = tensor_map(lambda x: x.to(R.dtype) if x.is_floating_point() else x, told)
    return replace(told, model=(model @ model[told.component].mT).to(R.dtype))


def _judge(
    graph: RotationGraph, model: Tensor, course: Status, edges: Tensor, counts: Tensor, loss: Loss, scale: float, spread: bool
) -> AveragedRotations:
    """What a minimum under a loss of some scale says of cameras and edges."""
    kept, views = counts.nonzero()[:, 0], graph.views
    angle, inliers = model.new_full((len(edges),), torch.pi), torch.zeros_like(counts)
    angle[kept] = off = turn_angle(graph.disagreement(model))
    square = graph.square(model)
    inliers[kept] = square.sqrt() <= AGREES * scale
    status = _status(edges, counts, inliers, views, course)
    part = vouched_parts(off, graph.edges, views)
    vouched = part[edges[:, 0]] == part[edges[:, 1]]
    supported = torch.bincount(edges[counts & vouched].flatten(), minlength=views) > 0
    unlikely = ~supported & (status != int(Status.TOO_FEW))
    status = torch.where(unlikely, int(Status.NO_CONSENSUS), status).to(torch.int8)
    sure = inliers & vouched & (status != int(Status.NO_CONSENSUS))[edges].all(-1)
    component = components(edges[sure], views)
    loops = count_loops(edges[sure], component)
    if loops:
        scale = max(float((square[sure[kept]].sum() / (3 * loops)).sqrt()), graph.least())
    elif graph.deviation is not None:
        scale = 1.0
    known = scale if loops or graph.deviation is not None else torch.inf
    deviation = graph.covariance(model, component, status, loss, known) if spread else None
    return AveragedRotations(model, status, component, angle, inliers, model.new_tensor(scale), deviation)


def _countable(R: Tensor, edges: Tensor, deviation: Tensor | None, weights: Tensor | None) -> Bool[Tensor, "e"]:
    """Edges that say something."""
    good = usable(R).all(-1).all(-1) & (edges[:, 0] != edges[:, 1])
    safe = torch.where(good[:, None, None], R, 0)
    off = (safe @ safe.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-2, -1))
    good = good & (off < NOT_A_ROTATION) & (torch.linalg.det(safe) > 0)
    if weights is not None:
        good = good & usable(weights) & (weights > 0)
    if deviation is not None:
        good = good & usable(deviation).all(-1).all(-1)
        eye = torch.eye(3, dtype=torch.float64, device=R.device)
        _, info = torch.linalg.cholesky_ex(torch.where(good[:, None, None], deviation.double(), eye))
        good = good & (info == 0)
    counts: Tensor = good
    return counts


def _status(edges: Tensor, counts: Tensor, inliers: Tensor, views: int, course: Status) -> Int8[Tensor, "v"]:
    """What became of each camera."""
    of_camera = torch.zeros(2, views, dtype=torch.long, device=edges.device)
    for row, chosen in zip(of_camera, (counts, inliers), strict=True):
        row.index_add_(0, edges[chosen].flatten(), torch.ones_like(edges[chosen].flatten()))
    code = torch.full((views,), int(course), dtype=torch.int8, device=edges.device)
    # One edge of several supports nothing but itself.
    code = torch.where((of_camera[1] < 2) & (of_camera[1] < of_camera[0]), int(Status.NO_CONSENSUS), code)
    status: Tensor = torch.where(of_camera[0] == 0, int(Status.TOO_FEW), code).to(torch.int8)
    return status
