"""Centres of all cameras, and all points, from rotations and rays: every camera and point at once.

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
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_index, check_one_problem, check_options
from torchsfm.linalg import usable
from torchsfm.motion.many_views.components import components
from torchsfm.motion.many_views.triplets import pairs_within
from torchsfm.optim import Block, Huber, SparseResult, Term, pair_covariance
from torchsfm.optim import sparse_levenberg_marquardt as minimise

CORNER = 0.1
"""Distance from its ray, at one unit ahead of the camera, from which a point pulls with constant force."""
ROUGH = 1e-3
"""Part of the cost to which sums are minimised that set the scale of the next."""
QUARTILE = 0.5754
"""Of a squared residual of two normal components."""
EXACT = 1e-5
"""The least standard deviation of rays, in radians."""
TOLD = 1e-4
"""That of which deviations are told: eliminating points holds each by about 1e-10 of what its rays say, and were rays more
exact, that would be more than what is expected of a part of free size."""
MOST_LOST = 0.9
"""Where fewer residuals than a tenth are free, scatter tells no more than that."""
AGREES = 4.0
"""Standard deviations within which a ray agrees."""
HUBER = 1.5
"""Standard deviations from which a ray pulls with constant force in the second sum."""
HELD = 1e3
"""By how much more exactly the extent is held than what the rays leave open, to say how well they determine the rest."""
PARALLAX, NEEDED = 8.0, 3
"""Standard deviations by which so many rays of a camera must differ from where points at infinity would be, and two from where
all points were one."""
CHANCE = 0.2
"""How many more for each wrong ray: those pull points nearer, where right rays still agree."""
FAR = 1e4
"""Points so far away, in extents of the component, or so near, say nothing of centres."""
OPEN = 0.3
"""Standard deviation of a centre over the extent of its component from which on nothing is known of it."""
FREE = 0.5
"""Standard deviation of the size of what a camera sees together with others, over that size, from which on it is free."""
LARGEST = 3000
"""Cameras of the largest component whose deviations are computed, which takes the inverse of a dense matrix."""


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
    check_options(tolerance=(tolerance, "float >= 0"))
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
    rays = _Rays(ray, view[kept], point[kept], weight, v, points)
    with torch.no_grad():
        component = rays.component()
        start = rays.convex(max_iterations)
        unknowns = 3 * (len(torch.unique(rays.view)) + len(torch.unique(rays.point)))
        lost = min(unknowns / max(2 * len(ray), 1), MOST_LOST)
        start = rays.angular(start, rays.scale(start, 0.0), max_iterations, ROUGH).x
        scale = rays.scale(start, lost)
    found = rays.angular(start, scale, max_iterations, tolerance)
    c, X = rays.anchored(found, component)
    with torch.no_grad():
        scale = rays.scale({"c": c, "X": X}, lost)
        angle = d.new_full((len(d),), torch.pi)
        u = torch.nn.functional.normalize(X[rays.point] - c[rays.view], dim=-1)
        off = torch.atan2(torch.linalg.cross(rays.v, u).norm(dim=-1), (rays.v * u).sum(-1))
        angle[kept] = off.to(d.dtype)
        inliers = torch.zeros_like(good).index_put_((kept,), off <= AGREES * scale)
        deviation = rays.deviations(c, X, component, scale)
        seen = torch.bincount(rays.view, minlength=v)
        known = (deviation < OPEN) & rays.tell(off <= AGREES * scale, scale)
        code = torch.where(known, int(found.status), int(Status.DEGENERATE))
        status = torch.where(seen == 0, int(Status.TOO_FEW), code).to(torch.int8)
        ok = status == int(found.status)
        deviation = torch.where(ok, deviation, torch.inf)
        sure = inliers & ok[view]
        valid = _views_of(point[sure], view[sure], points, v) >= 2
    centres = torch.where(ok[:, None], c, 0.0).to(d.dtype)
    return GlobalPositions(
        centres, torch.where(valid[:, None], X, 0.0).to(d.dtype), valid, status, component, deviation.to(d.dtype), angle,
        inliers, d.new_tensor(scale),
    )  # fmt: skip


@dataclass(frozen=True)
class _Rays:
    """The rays that count, turned into the world, in double precision."""

    v: Float[Tensor, "m 3"]
    view: Int[Tensor, "m"]
    point: Int[Tensor, "m"]
    weights: Float[Tensor, "m"] | None
    views: int
    points: int

    def component(self) -> Int[Tensor, "v"]:
        """The smallest camera that each is connected with."""
        pairs = torch.stack((self.view, self.views + self.point), 1)
        return components(pairs, self.views + self.points)[: self.views]

    def convex(self, max_iterations: int) -> dict[str, Tensor]:
        """The minimum of distances from half rays."""
        zero = {"c": self.v.new_zeros(self.views, 3), "X": self.v.new_zeros(self.points, 3)}
        term = Term(_ahead, ("c", "X"), (self.view, self.point), (self.v,), Huber(CORNER), self.weights, _linearize_ahead)
        return self._minimise(zero, term, max_iterations, ROUGH).x

    def angular(self, start: dict[str, Tensor], scale: float, max_iterations: int, tolerance: float) -> SparseResult:
        """The minimum of the sines of angles."""
        return self._minimise(start, self._sines(scale), max_iterations, tolerance)

    def scale(self, x: dict[str, Tensor], lost: float) -> float:
        """The standard deviation of the right rays, if a quarter of all are right.

        Args:
            x: Centres and points.
            lost: The part of the residuals' freedom that centres and points have taken.
        """
        if not len(self.v):
            return EXACT
        square = _sine(x["c"][self.view], x["X"][self.point], self.v).square().sum(-1)
        quartile = float(square.kthvalue(1 + (len(square) - 1) // 4).values)
        return max(math.sqrt(quartile / QUARTILE / (1 - lost)), EXACT)

    def anchored(self, found: SparseResult, component: Int[Tensor, "v"]) -> tuple[Tensor, Tensor]:
        """Centres and points with the gauge of each component fixed."""
        c, X = found.x["c"], found.x["X"]
        number = torch.bincount(component, minlength=self.views).clamp(min=1)[:, None]
        mean = torch.zeros_like(c).index_add(0, component, c) / number
        square = (c - mean[component]).square().sum(-1, keepdim=True)
        extent = (torch.zeros_like(square).index_add(0, component, square) / number).clamp(min=1e-60).sqrt()
        at = torch.zeros(self.points, dtype=torch.long, device=X.device).index_put_((self.point,), component[self.view])
        return (c - c[component]) / extent[component], (X - c[at]) / extent[at]

    def tell(self, inliers: Bool[Tensor, "m"], scale: float) -> Bool[Tensor, "v"]:
        """Whether some rays of each camera differ by more than noise from the mean direction of their point, and of the camera.

        Else all points are far, or in one place, of which noise makes several that seem to tell where the camera is.
        """
        known = torch.ones(self.views, dtype=torch.bool, device=self.v.device)
        wrong = torch.bincount(self.view[~inliers], minlength=self.views)
        for index, number in ((self.point, self.points), (self.view, self.views)):
            mean = torch.zeros(number, 3, dtype=self.v.dtype, device=self.v.device)
            mean = mean.index_add_(0, index[inliers], self.v[inliers])[index]
            apart = torch.atan2(torch.linalg.cross(self.v, mean).norm(dim=-1), (self.v * mean).sum(-1))
            count = torch.bincount(self.view[inliers & (apart > PARALLAX * scale)], minlength=self.views)
            known = known & (count >= (NEEDED + CHANCE * wrong if index is self.point else 2))
        return known

    def deviations(self, c: Tensor, X: Tensor, component: Tensor, scale: float) -> Float[Tensor, "v"]:
        """Of each centre, with the first camera of its component held, and how far the one farthest away is from it.

        What the rays leave open has the deviation of what is expected without any: 1 where all of a component is open.
        """
        if not len(self.v) or int(torch.bincount(component).amax()) > LARGEST:
            return c.new_zeros(self.views)
        scale = max(scale, TOLD)
        own = torch.arange(self.views, device=c.device)
        far = c.square().sum(-1)
        most = torch.zeros_like(far).scatter_reduce_(0, component, far, "amax")
        last = torch.zeros_like(own).scatter_reduce_(0, component, torch.where(far == most[component], own, 0), "amax")[
            component
        ]
        first, last = (t[(component == own) & (last != own)] for t in (own, last))
        apart = c[last] - c[first]
        distance = (X[self.point] - c[self.view]).norm(dim=-1)
        near = ((distance > 1 / FAR) & (distance < FAR)).nonzero()[:, 0]
        # All of a component may be open together, as the size of a part of it that hangs on one camera: then what is expected
        # of each would add up to something that is known.
        share = torch.bincount(component, minlength=self.views) + torch.bincount(
            component[self.view[near]], minlength=self.views
        )
        share = share.to(c.dtype).rsqrt()[component]
        direction = HELD * torch.nn.functional.normalize(apart, dim=-1)
        # A point is as uncertain as it is far away.
        of_points = (self.point[near],), (X[self.point[near]], share[self.view[near]] / distance[near])
        terms = [
            self._sines(scale, 1 / scale).select(near),
            Term(_apart, ("c",), (own,), (c, share)),
            Term(_apart, ("X",), *of_points),
            Term(_length, ("c", "c"), (first, last), (direction, HELD * apart.norm(dim=-1))),
        ]
        blocks = {"c": Block(c, fixed=component == own), "X": Block(X)}
        pairs, shared = self._shared(near)
        spread, between = (
            t.diagonal(dim1=-2, dim2=-1).sum(-1) for t in pair_covariance(blocks, terms, "c", pairs, eliminate="X")
        )
        # A part of free size may have come out so small that its deviation is, too, but not beside its own size.
        off, size = torch.zeros_like(spread), torch.zeros_like(spread)
        for i in pairs.unbind(1):
            off.index_add_(0, i, shared * (spread[pairs].sum(1) - 2 * between))
            size.index_add_(0, i, shared * (c[pairs[:, 0]] - c[pairs[:, 1]]).square().sum(-1))
        return torch.where(off > FREE**2 * size, torch.inf, spread.sqrt())

    def _shared(self, rays: Int[Tensor, "k"]) -> tuple[Int[Tensor, "q 2"], Float[Tensor, "q"]]:
        """Pairs of cameras, and how many points they share beyond the first, which leaves open how far apart they are."""
        different = torch.unique(self.point[rays] * self.views + self.view[rays])
        view, points = different % self.views, different // self.views
        found = [torch.unique(view[a] * self.views + view[b], return_counts=True) for a, b in pairs_within(points)]
        if not found:
            return self.view.new_zeros((0, 2)), self.v.new_zeros(0)
        key, place = torch.unique(torch.cat([key for key, _ in found]), return_inverse=True)
        number = torch.zeros_like(key).index_add_(0, place, torch.cat([count for _, count in found])).to(self.v.dtype)
        return torch.stack((key // self.views, key % self.views), 1), number - 1

    def _sines(self, scale: float, unit: float = 1.0) -> Term:
        """Sines of angles, in a unit."""
        loss = Huber(unit * HUBER * scale)
        data = unit * self.v, self.v
        return Term(_sine_scaled, ("c", "X"), (self.view, self.point), data, loss, self.weights, _linearize_sine)

    def _minimise(self, start: dict[str, Tensor], term: Term, max_iterations: int, tolerance: float) -> SparseResult:
        blocks = {name: Block(x) for name, x in start.items()}
        return minimise(blocks, [term], eliminate="X", max_iterations=max_iterations, function_tolerance=tolerance)


def _ahead(c: Tensor, X: Tensor, v: Tensor) -> Tensor:
    """From the nearest point of the half ray to X."""
    D = X - c
    return D - (v * D).sum(-1, keepdim=True).clamp(min=1) * v


def _linearize_ahead(c: Tensor, X: Tensor, v: Tensor, *, out: list[Tensor | None]) -> Tensor:
    """The same, and its derivatives: those of X, and for c their negatives."""
    along = ((X - c) * v).sum(-1)
    J = torch.eye(3, dtype=v.dtype, device=v.device) - torch.where((along > 1)[:, None, None], v[:, :, None] * v[:, None], 0.0)
    return _store(J, out, _ahead(c, X, v))


def _sine(c: Tensor, X: Tensor, v: Tensor) -> Tensor:
    """From the nearest point of the line through c and X, or from c where that lies behind, to the end of v."""
    u = torch.nn.functional.normalize(X - c, dim=-1)
    return v - (v * u).sum(-1, keepdim=True).clamp(min=0) * u


def _sine_scaled(c: Tensor, X: Tensor, scaled: Tensor, v: Tensor) -> Tensor:
    """The same in the unit of `scaled`, a multiple of v."""
    u = torch.nn.functional.normalize(X - c, dim=-1)
    return scaled - (scaled * u).sum(-1, keepdim=True) * torch.where((v * u).sum(-1, keepdim=True) > 0, u, 0.0)


def _linearize_sine(c: Tensor, X: Tensor, scaled: Tensor, v: Tensor, *, out: list[Tensor | None]) -> Tensor:
    """The same, and its derivatives."""
    D = X - c
    length = torch.linalg.vector_norm(D, dim=-1).clamp(min=1e-12)
    u = D / length[:, None]
    s = (scaled * u).sum(-1)
    ahead = (v * u).sum(-1) > 0
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    across = scaled - s[:, None] * u
    J = s[:, None, None] * (eye - u[:, :, None] * u[:, None]) + u[:, :, None] * across[:, None]
    J = torch.where(ahead[:, None, None], -J / length[:, None, None], 0.0)
    return _store(J, out, _sine_scaled(c, X, scaled, v))


def _store(J: Tensor, out: list[Tensor | None], residual: Tensor) -> Tensor:
    """Derivatives by X, their negatives by c."""
    if out[0] is not None:
        out[0].copy_(-J)
    if out[1] is not None:
        out[1].copy_(J)
    return residual


def _apart(a: Tensor, expected: Tensor, weight: Tensor) -> Tensor:
    return weight[:, None] * (a - expected)


def _length(a: Tensor, b: Tensor, direction: Tensor, length: Tensor) -> Tensor:
    """How much longer a difference is along a direction."""
    return ((b - a) * direction).sum(-1, keepdim=True) - length[:, None]


def _views_of(point: Tensor, view: Tensor, points: int, views: int) -> Int[Tensor, "p"]:
    """How many different cameras see each point."""
    different = torch.unique(point * max(views, 1) + view)
    return torch.bincount(different // max(views, 1), minlength=points)
