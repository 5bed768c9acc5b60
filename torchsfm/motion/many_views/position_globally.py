"""Centres of all cameras, and all points, from rotations and rays: every camera and point at once.

Two sums over the rays are minimised one after the other (`ray_sums`): one that needs no start, one that says what was measured.
The second is minimised again and again while its scale falls, under a loss that leaves wrong rays no pull, and between these
rounds cameras and points go where more of their rays want them (`reseat_rays`): constant pulls of wrong rays move whole
groups of cameras, the farther the nearer these stand together.
What the rays leave open is told afterwards (`open_positions`).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_index, check_one_problem, check_options, tensor_map
from torchsfm.linalg import usable
from torchsfm.motion.many_views.open_positions import deviations, tell
from torchsfm.motion.many_views.ray_sums import AGREES, HUBER, REACH, ROUGH, Rays
from torchsfm.motion.many_views.reseat_rays import reseat
from torchsfm.optim import GemanMcClure, Huber
from torchsfm.optim.ranks import Group, Ranks

MOST_LOST = 0.9
"""Where fewer residuals than a tenth are free, scatter tells no more than that."""
SEATS = 4
"""How often cameras and points are at most put where more rays want them, each time under a loss of the scale then left."""
SETTLED = 0.9
"""Part of the last scale from which on another round would change little."""
BETWEEN = 1e-2
"""Part of the cost that a round leaves to the next, which has another scale."""
OPEN = 0.3
"""Standard deviation of a centre over the extent of its component from which on nothing is known of it."""


@dataclass(frozen=True)
class GlobalPositions:
    """Where v cameras and p points are, by m rays.

    Attributes:
        centres: Of the cameras, in the world of their rotations. Each component has the smallest of its cameras at the origin,
            and the root mean square distance of all from their mean is 1. 0 where a camera is not OK.
        X: The points; 0 where not `valid`.
        valid: Points with two agreeing rays or more from cameras that are OK.
        status: OK; TOO_FEW: no point that another camera sees, too; DEGENERATE: the rays leave the centre open (cameras that
            only turned, hang on too few points, see points in one place alone, or belong to a part whose size is free, as it
            has one camera or one point in common with the others, or as two cameras each see its points); NOT_CONVERGED: the
            iteration limit came first, the centres are the best seen.
        component: The smallest camera that each is connected with through points. Components have nothing to do with each
            other.
        deviation: Standard deviation of each centre in its component, by the scatter of the rays but of no less than 1e-4;
            infinite where it is not known. Zero for the smallest camera, and in components of so many cameras that it
            is not computed (3,000).
        angle: Between each ray and the direction to its point, in radians; pi for rays that do not count.
        inliers: Rays that agree to within four standard deviations.
        scale: Standard deviation of the right rays in each of two directions, in radians.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(6, spread=3.0, generator=g)
        >>> view, point = torch.arange(6).repeat_interleave(30), torch.arange(30).repeat(6)  # all see all
        >>> d = poses[view].transform(X[point][:, None])[:, 0]
        >>> d[7] = torch.randn(3, generator=g)  # one ray is wrong
        >>> found = torchsfm.motion.position_globally(d, view, point, poses.R, points=30)
        >>> found.inliers.sum(), found.angle.argmax(), bool(found.valid.all())
        (tensor(179), tensor(7), True)
    """

    centres: Float[Tensor, "v 3"]
    X: Float[Tensor, "p 3"]
    valid: Bool[Tensor, "p"]
    status: Int8[Tensor, "v"]
    component: Int[Tensor, "v"]
    deviation: Float[Tensor, "v"]
    angle: Float[Tensor, "m"]
    inliers: Bool[Tensor, "m"]
    scale: Float[Tensor, ""]


def position_globally(
    d: Float[Tensor, "m 3"],
    view: Int[Tensor, "m"],
    point: Int[Tensor, "m"],
    R: Float[Tensor, "v 3 3"],
    *,
    points: int,
    weights: Float[Tensor, "m"] | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-4,
    group: Group | None = None,
) -> GlobalPositions:
    """Centres of cameras of known rotation, and points, robustly and without a start.

    Args:
        d: Rays in the frames of their cameras, of any length, pointing to the points.
        view: Camera of each ray.
        point: Point of each ray.
        R: Rotations from the world to the cameras, as `average_rotations` gives them: cameras of different components of that
            should share no points.
        points: Number of points.
        weights: What each ray counts; 0 leaves it out.
        max_iterations: Most steps of each of the two minimisations.
        tolerance: Part of the cost that the last of them may leave; where all is adjusted later, 1e-3 will do.
        group: Processes of `torch.distributed`, started by `torchrun` for one, that call this with the same rays and share
            what the minimisations take: points and their rays are divided, centres are known to all. The first factors the
            system of centres, and finds components, scales and deviations, while the others wait. All return the same, which
            is what one process finds, to rounding; see `sparse_levenberg_marquardt`.

    Returns:
        Centres, points, statuses, and what is thought of each ray. Rays that are not finite or 0, those of cameras whose
        rotation is not finite, and those of points that no other camera sees do not count. Centres and points carry their
        derivatives with respect to `d`, `R` and `weights` by the implicit function theorem, at the scale that was found.

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or a number of a camera or point is out of range.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(6, spread=3.0, generator=g)
        >>> view, point = torch.arange(6).repeat_interleave(30), torch.arange(30).repeat(6)  # all see all
        >>> d = poses[view].transform(X[point][:, None])[:, 0]
        >>> found = torchsfm.motion.position_globally(d, view, point, poses.R, points=30)
        >>> fit = torchsfm.geometry.similarity_from_points(found.centres, poses.centre)  # up to place and size
        >>> bool(fit.transform(found.centres).allclose(poses.centre, atol=1e-3)), int(found.inliers.sum())
        (True, 180)
    """
    check_one_problem(d=(d, "m 3"), view=(view, "m: int"), point=(point, "m: int"), R=(R, "v 3 3"), weights=(weights, "?m"))
    check_options(points=(points, "int >= 0"), max_iterations=(max_iterations, "int >= 0"))
    check_options(tolerance=(tolerance, "float >= 0"), group=(group, Group | None))
    v, view, point = len(R), view.long(), point.long()
    check_index(view=(view, v), point=(point, points))
    with torch.no_grad():
        good = usable(d).all(-1) & (d != 0).any(-1) & usable(R).all(-1).all(-1)[view]
        if weights is not None:
            good = good & usable(weights) & (weights > 0)
        several = _views_of(point[good], view[good], points, v) >= 2
        good = good & several[point]
        kept = good.nonzero()[:, 0]
    ray = torch.nn.functional.normalize(d[kept].double(), dim=-1)
    ray = (R[view[kept]].double().mT @ ray[..., None])[..., 0]
    weight = None if weights is None else weights[kept].double()
    rays = Rays(ray, view[kept], point[kept], weight, v, points, group)
    # What is not minimised the first of several processes does alone.
    ranks, device = Ranks(group), d.device
    with torch.no_grad():
        component = ranks.once(device, rays.component)
        start = rays.convex(max_iterations)
        unknowns = 3 * (len(torch.unique(rays.view)) + len(torch.unique(rays.point)))
        lost = min(unknowns / max(2 * len(ray), 1), MOST_LOST)
        start = rays.angular(start, Huber(HUBER * ranks.once(device, rays.scale, start, 0.0)), max_iterations, ROUGH).x
        scale = ranks.once(device, rays.scale, start, lost)
        for _ in range(SEATS):
            before = scale
            start, scale = ranks.once(device, _reseated, rays, start, scale, lost)
            start = rays.angular(start, GemanMcClure(REACH * scale), max_iterations, BETWEEN).x
            scale = ranks.once(device, rays.scale, start, lost)
            if scale > SETTLED * before:
                break
        scale = ranks.once(device, rays.spread, start, scale)
    found = rays.angular(start, GemanMcClure(REACH * scale), max_iterations, tolerance)
    c, X = rays.anchored(found, component)
    with torch.no_grad():
        told = ranks.once(device, _judge, rays, good, view, point, c.detach(), X.detach(), component, scale, found.status)
    told = tensor_map(lambda x: x.to(d.dtype) if x.is_floating_point() else x, told)
    ok = told.status == int(found.status)
    centres = torch.where(ok[:, None], c, 0.0).to(d.dtype)
    return replace(told, centres=centres, X=torch.where(told.valid[:, None], X, 0.0).to(d.dtype))


def _reseated(rays: Rays, x: dict[str, Tensor], scale: float, lost: float) -> tuple[dict[str, Tensor], float]:
    """Cameras and points where more of their rays want them, and the scale that is left."""
    x = reseat(rays, x, GemanMcClure(REACH * scale), AGREES * scale)
    return x, rays.scale(x, lost)


def _judge(
    rays: Rays, good: Tensor, view: Tensor, point: Tensor, c: Tensor, X: Tensor, component: Tensor, scale: float, course: Status
) -> GlobalPositions:
    """What a minimum says of cameras, points and rays; of the rays `good` count."""
    scale = rays.spread({"c": c, "X": X}, scale)
    angle = c.new_full((len(good),), torch.pi)
    u = torch.nn.functional.normalize(X[rays.point] - c[rays.view], dim=-1)
    angle[good] = off = torch.atan2(torch.linalg.cross(rays.v, u).norm(dim=-1), (rays.v * u).sum(-1))
    inliers = torch.zeros_like(good).index_put_((good,), off <= AGREES * scale)
    deviation = deviations(rays, c, X, component, scale)
    seen = torch.bincount(rays.view, minlength=rays.views)
    known = (deviation < OPEN) & tell(rays, off <= AGREES * scale, scale)
    code = torch.where(known, int(course), int(Status.DEGENERATE))
    status = torch.where(seen == 0, int(Status.TOO_FEW), code).to(torch.int8)
    ok = status == int(course)
    deviation = torch.where(ok, deviation, torch.inf)
    sure = inliers & ok[view]
    valid = _views_of(point[sure], view[sure], rays.points, rays.views) >= 2
    return GlobalPositions(c, X, valid, status, component, deviation, angle, inliers, c.new_tensor(scale))


def _views_of(point: Tensor, view: Tensor, points: int, views: int) -> Int[Tensor, "p"]:
    """How many different cameras see each point."""
    different = torch.unique(point * max(views, 1) + view)
    return torch.bincount(different // max(views, 1), minlength=points)
