"""Cameras of a few neighbouring frames from curves that were followed through them, when nothing is known of any camera.

A sample of a curve of the first frame is somewhere on its ray: one number, its inverse depth, against a distance from the image
curve in each further frame. So few unknowns are found by descents from many guesses of the motion at once, all samples at one
depth: ways around what is seen in several directions and of several speeds, and sideways.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.geometry import intrinsics
from torchsfm.geometry.curve_places import CurvePlaces, curve_places
from torchsfm.geometry.curves import Curve
from torchsfm.geometry.poses import Pose
from torchsfm.geometry.rotations import rotation_angle, rotation_from_rotvec
from torchsfm.linalg import damped_solve
from torchsfm.motion.many_views.bilinear_steps import schur_step
from torchsfm.motion.many_views.curve_fit import near_curves
from torchsfm.optim import GemanMcClure
from torchsfm.optim.descent import Options, descend
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, pick
from torchsfm.reconstruction.model.similarities import DEVIATION

_DIRECTIONS = 8
"""Axes of rotation that are tried, parallel to the first image."""
_TURNS = (1.5, 5.0, 15.0)
"""Degrees from a frame to the next that are tried."""
_STEPS = 8
"""Of each descent, after which it is seen anew which samples a frame shows."""
_CLOSE = 0.05
"""Depth, that of samples in the first frame about 1, below which a sample cannot be seen."""
_FLAT = 0.05
"""Weight of inverse depths' departure from their mean, so that those that nothing tells stay there."""
_SCALES = (8.0, 4.0, 2.0, 1.0)
"""Where the loss lets go, in pixels, in one descent after the other, from all guesses."""
_BEST = 5
"""Guesses that are followed to the end,"""
_LAST = 3
"""in so many descents, where the loss lets go at"""
_LONGER = 8
"""More of them, the most, while what would be another motion still changes:"""
_ARRIVED = 0.99
"""its cost falls to less than so much of what it was."""
_TRUSTED = 4.5
"""medians of the distances, and no less than"""
_FINEST = 0.05
"""pixels."""
_SAMPLES = 16
"""Of each curve."""
_FEWEST = 60
"""Samples in each frame, on average, that must agree, and"""
_AGREE = 0.7
"""what share of all that frames show by their motion, and"""
_SHOWN = 0.7
"""what share these must be of those that they show: past their ends curves, straight ones best, fit any motion."""
_PARALLAX = 2.0
"""Pixels, at least, by which near samples move more than far ones."""
_UNLIKELY = 3.0
"""Standard deviations by which a motion must be less likely than the best one,"""
APART = 4.0
"""from which it differs by so many degrees, not to be told as another explanation."""


class Motion(NamedTuple):
    """Cameras, depths, and where on the image curves samples are seen, for each guess."""

    R: Float[Tensor, "h v 3 3"]
    t: Float[Tensor, "h v 3"]
    """Of the frames but the first one, from the first one's camera."""
    rho: Float[Tensor, "h n"]
    """Inverse depths of samples in the first frame, about 1."""
    zoom: Float[Tensor, "h"]
    """Logarithm of the focal length over the expected one."""
    place: Float[Tensor, "h v c m"]


@dataclass(frozen=True)
class MotionSystem:
    """Robust squared distances linearised."""

    x: Motion
    cost: Tensor
    total: Tensor
    r: Float[Tensor, "h v n"]
    w: Float[Tensor, "h v n"]
    by_camera: Float[Tensor, "h v n 6"]
    by_zoom: Float[Tensor, "h v n"]
    by_depth: Float[Tensor, "h v n"]
    sigma: float
    flat: float

    def gradient(self) -> tuple[Tensor, Tensor]:
        """Of half the cost's sum by cameras (with the focal length last) and by depths."""
        wr = self.w * self.r
        cameras = (wr[..., None] * self.by_camera).sum(2).flatten(1)
        zoom = (wr * self.by_zoom).sum((1, 2)) + self.x.zoom / self.sigma**2
        return torch.cat((cameras, zoom[:, None]), 1), (wr * self.by_depth).sum(1) + self.flat * (self.x.rho - 1)

    def steepest(self) -> Tensor:
        """The largest derivative."""
        return torch.cat(self.gradient(), 1).abs().amax(-1)

    def along(self, delta: tuple[Tensor, Tensor]) -> Tensor:
        """The derivative of the cost along a step."""
        return 2 * (torch.cat(self.gradient(), 1) * torch.cat((delta[0], delta[1][:, 0]), 1)).sum(-1) / self.total

    def step(self, damping: Tensor, exact: Tensor | None = None) -> Step:
        """The step of cameras and depths; depths are eliminated."""
        h, v = self.r.shape[:2]
        J, w = self.by_camera, self.w[..., None]
        # By all cameras and the focal length: own blocks, and what they share.
        A = J.new_zeros(h, 6 * v + 1, 6 * v + 1)
        A[:, :-1, :-1].view(h, v, 6, v, 6).diagonal(dim1=1, dim2=3).copy_(((w * J).mT @ J).movedim(1, -1))
        A[:, :-1, -1] = A[:, -1, :-1] = (w * J * self.by_zoom[..., None]).sum(2).flatten(1)
        A[:, -1, -1] = (self.w * self.by_zoom.square()).sum((1, 2)) + 1 / self.sigma**2
        A.diagonal(dim1=1, dim2=2).mul_(1 + damping[:, None]).add_(1e-12)
        C = ((self.w * self.by_depth.square()).sum(1) + self.flat) * (1 + damping[:, None])
        a, b = self.gradient()
        inverse = C.rsqrt()[:, None]
        E = (w * J * self.by_depth[..., None]).transpose(2, 3).flatten(1, 2)
        F = inverse * torch.cat((E, (self.w * self.by_zoom * self.by_depth).sum(1, keepdim=True)), 1)
        g = inverse * b[:, None]
        return schur_step(A - F @ F.mT, a - (F @ g.mT)[..., 0], F, torch.stack((g, inverse), 1), self.total)


@dataclass(frozen=True)
class MotionDistances(Problem[MotionSystem]):
    """The robust mean of squared normal distances over cameras, depths and the focal length."""

    images: CurvePlaces
    """Of the frames but the first, (v, c); all guesses look at the same ones."""
    x: Float[Tensor, "n 2"]
    """Samples in the first frame, from the principal point."""
    centre: Float[Tensor, "2"]
    focal: Float[Tensor, "h"]
    weight: Float[Tensor, "h v n"]
    sigma: float
    flat: float
    scale: float

    def pick(self, at: Places) -> "MotionDistances":
        """Some of the guesses."""
        return replace(self, focal=pick(at, self.focal), weight=pick(at, self.weight))

    def linearize(self, x: Motion) -> MotionSystem:
        """The system of cameras and depths."""
        f = self.focal * x.zoom.exp()
        K = intrinsics(f, self.centre)[:, None]
        d = self.x / f[:, None, None]
        turned = torch.cat((d, torch.ones_like(d[..., :1])), -1)[:, None] @ x.R.mT
        Y = turned + x.rho[:, None, :, None] * x.t[:, :, None]
        near = near_curves(self.all_images, x.place, K @ torch.where(Y[..., 2:] > _CLOSE, Y, torch.nan).mT)
        shown = self.weight > 0
        r, slope = torch.where(shown, near.r, 0), torch.where(shown[..., None], (K.mT @ near.slope).mT, 0)
        # A longer focal length magnifies images, and narrows the rays.
        by_zoom = (slope[..., :2] * Y[..., :2]).sum(-1) - (slope * (d[:, None] @ x.R.mT[..., :2, :])).sum(-1)
        by_camera = torch.cat((torch.linalg.cross(turned, slope), x.rho[:, None, :, None] * slope), -1)
        loss = GemanMcClure(self.scale)
        total = self.weight.sum((1, 2)).clamp_min(1)
        prior = self.flat * (x.rho - 1).square().sum(-1) + x.zoom.square() / self.sigma**2
        cost = ((self.weight * loss(r.square())).sum((1, 2)) + prior) / total
        cost = torch.where(cost.isfinite(), cost, torch.inf)
        x = x._replace(place=torch.where(shown.view(x.place.shape), near.place, x.place))
        w, by_depth = self.weight * loss.slope(r.square()), (slope * x.t[:, :, None]).sum(-1)
        return MotionSystem(x, cost, total, r, w, by_camera, by_zoom, by_depth, self.sigma, self.flat)

    def advance(self, here: MotionSystem, step: Step) -> MotionSystem:
        """The system where a step leads."""
        move, depth = step.delta
        moves = move[:, :-1].unflatten(1, (-1, 6))
        R = rotation_from_rotvec(moves[..., :3]) @ here.x.R
        x = Motion(R, here.x.t + moves[..., 3:], here.x.rho + depth[:, 0], here.x.zoom + move[:, -1], here.x.place)
        return self.linearize(x)

    def rounding(self, here: MotionSystem) -> Tensor:
        """Nothing finer than a hundredth of a pixel matters here."""
        return torch.full_like(here.cost, 1e-6)

    @property
    def all_images(self) -> CurvePlaces:
        """The image curves of each guess, (h, v, c)."""
        return tensor_map(lambda t: t.expand(len(self.focal), *t.shape), self.images)

    def inside(self, place: Float[Tensor, "h v c m"]) -> Bool[Tensor, "h v n"]:
        """Samples that a frame shows, and not beyond the ends of what it shows of their curves."""
        return (self.weight > 0) & (self.all_images.beyond(place) == 0).flatten(2)


@dataclass(frozen=True)
class FirstCameras:
    """What was found."""

    poses: Pose
    """Of all frames; the world is the reference frame's camera, and samples are about 1 away."""
    focal: Float[Tensor, ""]
    X: Float[Tensor, "n 3"]
    """Samples that most frames agree on."""
    refusal: str
    """Why these are not to be used; empty where they are."""


def first_cameras(
    curves: Curve,
    reference: int,
    focal: Float[Tensor, ""],
    centre: Float[Tensor, "2"],
    sigma: float,
    starts: Float[Tensor, "s v 3 3"] | None = None,
    *,
    alone: bool = False,
) -> FirstCameras:
    """Cameras from curves that were followed through a few frames.

    Args:
        curves: Of each frame, all running alike: fields of shape (v, c, n, 2), (v, c, n), (v, c), float64.
        reference: Which frame's samples are placed in space; best one in the middle.
        focal: The focal length to expect, in pixels,
        centre: and the principal point.
        sigma: Standard deviation of the logarithm of the focal length.
        starts: Rotations of all frames that are tried besides, those of each trial in a world of their own.
        alone: No other ones are tried.
    """
    v = len(curves.x)
    curves = Curve(*(t[:, curve_places(curves).number[reference] >= 3] for t in (curves.x, curves.valid, curves.closed)))
    others = torch.tensor([k for k in range(v) if k != reference])
    places = curve_places(curves)
    c = places.number.shape[1]
    if c < 2:
        return _refused(v, focal, f"{c} curves could be followed")
    spread = places.spread(_SAMPLES)
    samples = places.at(spread)[0].flatten(1, 2) - centre
    images = curve_places(Curve(curves.x[others], curves.valid[others], curves.closed[others]))
    shown = (places.number[others] >= 3).repeat_interleave(_SAMPLES, 1).to(samples)
    R = rotation_from_rotvec(_turns(samples)[:, None] * (others - reference)[:, None])
    if starts is not None:
        R = torch.cat((R[:0] if alone else R, starts[:, others] @ starts[:, reference, None].mT))
    h = len(R)
    f = focal.expand(h)
    t = _translations(R, samples[reference], samples[others], shown, f)
    motion = Motion(R, t, t.new_ones(h, c * _SAMPLES), torch.zeros_like(f), spread[others].expand(h, -1, -1, -1))
    problem = MotionDistances(images, samples[reference], centre, f, shown.expand(h, -1, -1), sigma, _FLAT, 1.0)

    def descent(scale: float, steps: int, noise: float = 1.0) -> tuple[Motion, Tensor]:
        weight = problem.inside(motion.place).to(problem.weight)
        # What is expected counts as much as distances do, that are so large, in pixels.
        now = replace(problem, weight=weight, scale=scale, sigma=sigma / noise, flat=_FLAT * noise**2)
        found = descend(now, motion, Options(steps, 1e-4))
        # Where curves leave what frames show of them they have no distance, which is no merit.
        counted, seen = weight.sum((1, 2)), problem.inside(found.x.place).sum((1, 2))
        lost = scale**2 * (shown.sum() - seen)
        return found.x, (found.cost * counted.clamp_min(1) + lost) / shown.sum().clamp_min(1)

    for scale in _SCALES:
        motion, cost = descent(scale, _STEPS)
    best = (cost.argsort()[:_BEST],)
    motion, problem = pick(best, motion), problem.pick(best)
    k, rivals, last = 0, torch.empty(0), torch.full_like(cost[best], torch.inf)
    for turn in range(_LAST + _LONGER):
        r = problem.linearize(motion).r[k][problem.weight[k] > 0].abs()
        scale = max(_FINEST, _TRUSTED * float(r.median()))
        motion, cost = descent(scale, 2 * _STEPS, min(1.0, DEVIATION * scale / _TRUSTED))
        k = int(cost.argmin())
        apart = rotation_angle(motion.R @ motion.R[k].mT).rad2deg().amax(-1)
        rivals = (cost < cost[k] * _equal(shown)) & (apart > APART)
        if turn + 1 >= _LAST:
            # What still descends is no other minimum: focal lengths and turns are found slowly, together.
            if not bool((rivals & (cost < _ARRIVED * last)).any()):
                break
            going = rivals.index_fill(0, torch.tensor([k]), True)
            some = (going.nonzero()[:, 0],)
            k = int(going[:k].sum())
            motion, problem, cost = pick(some, motion), problem.pick(some), cost[some]
        last = cost
    counts = problem.inside(motion.place)[k]
    good = (problem.linearize(motion).r[k].abs() < scale) & counts
    depths = motion.rho[k].quantile(motion.rho.new_tensor([0.1, 0.9]))
    refusal = ""
    if int(good.sum()) < _FEWEST * (v - 1):
        refusal = f"{int(good.sum())} samples of curves followed through {v} frames agree with one motion, too few"
    elif int(good.sum()) < _AGREE * int(counts.sum()):
        refusal = f"only {int(good.sum())} of {int(counts.sum())} samples of curves agree with one motion"
    elif int(counts.sum()) < _SHOWN * int(shown.sum()):
        refusal = f"only {int(counts.sum())} of {int(shown.sum())} samples are where frames show their curves"
    elif float((depths[1] - depths[0]) * motion.t[k].norm(dim=-1).amax() * focal) < _PARALLAX:
        refusal = "the camera hardly moved, or only turned, which gives no depth"
    elif bool(rivals.any()):
        refusal = "several motions explain the curves as well"
    elif not bool(torch.isfinite(cost[k]) & (motion.rho[k].median() > 0)):
        refusal = "no motion explains the curves"
    own = torch.eye(3, dtype=t.dtype, device=t.device).repeat(v, 1, 1)
    own[others] = motion.R[k]
    poses = Pose(own, t.new_zeros(v, 3).index_copy(0, others, motion.t[k]))
    found = focal * motion.zoom[k].exp()
    sure = 2 * good.sum(0) >= v - 1
    rays = torch.cat((samples[reference] / found, torch.ones_like(samples[reference][:, :1])), -1)
    return FirstCameras(poses, found, (rays / motion.rho[k][:, None])[sure & (motion.rho[k] > 0)], refusal)


def _equal(shown: Float[Tensor, "w n"]) -> float:
    """How many times as large the cost of a motion may be that is about as likely as another.

    What a frame shows of a curve is wrong as a whole, and counts as one distance: of so many, the logarithm of the likelihood
    is half the number times that of the cost.
    """
    number = float(shown.sum()) / _SAMPLES - 6 * len(shown)
    return math.exp(_UNLIKELY**2 / max(number, _UNLIKELY**2))


def _refused(v: int, focal: Tensor, why: str) -> FirstCameras:
    return FirstCameras(Pose.identity(v, dtype=focal.dtype, device=focal.device), focal, focal.new_zeros(0, 3), why)


def _turns(like: Tensor) -> Float[Tensor, "h 3"]:
    """Rotations from a frame to the next that are tried."""
    angle = torch.arange(_DIRECTIONS, dtype=like.dtype, device=like.device) * (2 * math.pi / _DIRECTIONS)
    axis = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)
    return torch.cat((torch.zeros_like(axis[:1]), *(math.radians(size) * axis for size in _TURNS)))


def _translations(R: Tensor, x: Tensor, other: Tensor, shown: Tensor, f: Tensor) -> Tensor:
    """Where the frames' cameras are so that samples at one depth are seen where curves' samples are, (h, v, 3)."""
    d = torch.cat((x / f[:, None, None], torch.ones(len(f), len(x), 1, dtype=x.dtype)), -1)
    turned = d[:, None] @ R.mT
    u = other / f[:, None, None, None]
    # u z = x along both axes: t_x - u t_z = u z0 - x0.
    eye = torch.eye(2, dtype=x.dtype).expand(*u.shape, 2)
    rows = torch.cat((eye, -u[..., None]), -1).flatten(2, 3)
    right = (u * turned[..., 2:] - turned[..., :2]).flatten(2)
    w = shown.repeat_interleave(2, -1)
    A = rows.mT @ (w[..., None] * rows)
    return damped_solve(A, rows.mT @ (w * right)[..., None])[..., 0]
