"""Large bundle adjustment problems with the statistics of real ones: who sees whom, how long tracks are, where they start."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.geometry import BundleProblem, Camera, Pose, Radial, intrinsics
from torchsfm.simulation.randomness import where_drawn
from torchsfm.simulation.viewpoints import look_at

NEIGHBOURS = 48
"""Cameras that are asked whether they see a point: the nearest to the one that found it."""
ROUNDS = 50
"""Most draws until every point is seen twice."""


@dataclass(frozen=True)
class SimulatedBundle:
    """A bundle adjustment problem and its truth.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, noise=0.5, outliers=0.1, generator=g)
        >>> off = (simulated.problem.x - simulated.truth.x).norm(dim=-1)  # pixels
        >>> bool(off[~simulated.outlier].max() < 3), bool(off[simulated.outlier].median() > 10)
        (True, True)
        >>> bool(simulated.truth.residuals().max() < 1e-6)
        True
        >>> start, truth = simulated.problem.poses.centre, simulated.truth.poses.centre
        >>> bool((start - truth).norm(dim=-1).max() > 1e-3)  # an adjustment starts at `problem`
        True
    """

    problem: BundleProblem
    """Disturbed poses, cameras and points, and noisy observations: where an adjustment starts."""
    truth: BundleProblem
    """The same without disturbance, noise and outliers."""
    outlier: Bool[Tensor, "m"]
    """Observations that are gross errors."""


@where_drawn
def random_bundle_problem(
    num_cameras: int,
    num_points: int,
    num_observations: int,
    *,
    layout: Literal["path", "dome"] = "path",
    noise: float = 0.5,
    outliers: float = 0.0,
    disturbance: float = 1.0,
    generator: torch.Generator | None = None,
) -> SimulatedBundle:
    """Draw a problem like those of Bundle Adjustment in the Large (Agarwal et al. 2010): every camera has its own f, k1, k2.

    Cameras go along a winding street and look ahead ("path", as Ladybug), or stand around an object at various distances and
    look at it ("dome", as Dubrovnik or Trafalgar). Every point lies in the field of view of some camera, and is seen by that
    one and by others near it that have it in their images, near ones rather than far ones: most tracks are short, some long.
    The images are 2000 pixels wide, 1500 high, with the principal point at the origin. All is made in float64 on the
    generator's device, on the CPU where none is given.

    Args:
        num_cameras: How many cameras, at least 2.
        num_points: How many points.
        num_observations: How many observations in all, at least two for each point.
        layout: Where cameras stand.
        noise: Standard deviation of image coordinates in pixels.
        outliers: Share of the observations that fall anywhere in the image.
        disturbance: How far the start is off, as a factor: 1 displaces cameras by a fiftieth of the distance to their
            neighbours and points by a hundredth of the distance from which they are seen, turns cameras by 0.2 degrees, scales
            focal lengths by one percent and takes distortion to be zero, which makes tens of pixels; 0 starts at the truth.
        generator: Source of randomness; torch's own where none is given.

    Returns:
        Problem and truth, observations in the order of the points.

    Raises:
        ValueError: Fewer than two cameras, or counts that cannot be had: fewer than two observations a point, or more than
            the cameras around a point can make.

    Example:
        >>> import torch, torchsfm
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, noise=0.5, generator=torch.Generator().manual_seed(0))
        >>> simulated.problem.x.shape, bool(simulated.truth.residuals().max() < 5)  # pixels
        (torch.Size([150, 2]), True)
    """
    places = {"path": _path, "dome": _dome}
    check_options(
        num_cameras=(num_cameras, "int >= 2"), num_points=(num_points, "int >= 1"),
        num_observations=(num_observations, "int >= 2"), layout=(layout, tuple(places)), noise=(noise, "float >= 0"),
        outliers=(outliers, "0 <= float <= 1"), disturbance=(disturbance, "float >= 0"),
    )  # fmt: skip
    if num_observations < 2 * num_points:
        raise ValueError(f"num_observations: wanted at least 2 for each of {num_points} points, got {num_observations}")
    poses = places[layout](num_cameras, generator)
    f = 900 * (0.15 * _normal(generator, num_cameras)).exp()
    k1, k2 = -0.08 + 0.02 * _normal(generator, num_cameras), 0.01 + 0.005 * _normal(generator, num_cameras)
    cameras = Camera(intrinsics(f, torch.zeros(num_cameras, 2, dtype=torch.float64)), Radial(k1, k2))
    near = torch.cdist(poses.centre, poses.centre).topk(min(NEIGHBOURS, num_cameras), largest=False).indices
    X, view, visible, rank = _points(poses, cameras, near, num_points, layout, generator)
    index, point = _choose(visible, rank, num_observations, generator)
    view = view[point, index]
    which = torch.arange(num_cameras)
    truth = BundleProblem(poses, cameras, which, X, torch.zeros(len(view), 2, dtype=torch.float64), view, point)
    truth = replace(truth, x=truth.projections())
    x = truth.x + noise * _normal(generator, len(view), 2)
    outlier = torch.rand(len(view), generator=generator, dtype=torch.float64) < outliers
    anywhere = (torch.rand(len(view), 2, generator=generator, dtype=torch.float64) - 0.5) * x.new_tensor(HALF_SIZE) * 2
    x = torch.where(outlier[:, None], anywhere, x)
    return SimulatedBundle(_disturb(replace(truth, x=x), disturbance, generator), truth, outlier)


HALF_SIZE = 1000.0, 750.0


def _normal(generator: torch.Generator | None, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _path(count: int, generator: torch.Generator | None) -> Pose:
    """One unit forward from camera to camera, the heading a slow random walk, the view ahead with some sway."""
    turn = 0.02 * _normal(generator, count).cumsum(0)
    heading = 0.3 * torch.sin(2 * math.pi * torch.arange(count, dtype=torch.float64) / 80) + turn
    step = torch.stack((heading.cos(), heading.sin(), torch.zeros(count, dtype=torch.float64)), -1)
    centre = step.cumsum(0) + 0.05 * _normal(generator, count, 3)
    return look_at(centre, centre + step + 0.05 * _normal(generator, count, 3))


def _dome(count: int, generator: torch.Generator | None) -> Pose:
    """Around an object of radius 1, at two to five times that distance, at eye level or above."""
    azimuth = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    height = 0.7 * torch.rand(count, generator=generator, dtype=torch.float64)
    distance = 2 + 3 * torch.rand(count, generator=generator, dtype=torch.float64) ** 2
    level = (1 - height**2).sqrt()
    direction = torch.stack((level * azimuth.cos(), level * azimuth.sin(), height), -1)
    return look_at(distance[:, None] * direction, 0.2 * _normal(generator, count, 3))


def _points(
    poses: Pose, cameras: Camera, near: Tensor, count: int, layout: str, generator: torch.Generator | None
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, "n k"], Bool[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Points in the view of a random camera each, the cameras near it, which of these see the point, and how near they are."""
    v = poses.shape[0]
    X = torch.zeros(count, 3, dtype=torch.float64)
    view = near[torch.randint(v, (count,), generator=generator)]
    visible = torch.zeros(view.shape, dtype=torch.bool)
    todo = torch.arange(count)
    for _ in range(ROUNDS):
        first = torch.randint(v, (len(todo),), generator=generator)
        draw = torch.rand(len(todo), 3, generator=generator, dtype=torch.float64)
        centre = poses[first].centre
        if layout == "path":
            # Houses along the street, from a few steps ahead to far away.
            ray, valid = cameras[first].unproject((draw[:, None, :2] * 2 - 1) * draw.new_tensor(HALF_SIZE) * 0.95)
            X[todo] = centre + (4 * torch.exp(2 * draw[:, 2:])) * (ray @ poses[first].R)[:, 0]
        else:
            # On the near side of the sphere of radius 1, with some relief.
            direction = centre / centre.norm(dim=1, keepdim=True) + 1.2 * (draw * 2 - 1)
            X[todo] = direction / direction.norm(dim=1, keepdim=True) * (1 + 0.05 * (draw[:, :1] - 0.5))
            valid = torch.ones_like(draw[:, :1], dtype=torch.bool)
        view[todo] = near[first]
        visible[todo] = _see(poses, cameras, X[todo], view[todo], layout) & valid
        visible[todo] &= visible[todo, :1]
        todo = todo[visible[todo].sum(1) < 2]
        if not len(todo):
            break
    else:
        raise ValueError(f"num_cameras: {v} cameras share too little for {count} points")
    # Near cameras first, not quite in order.
    rank = torch.arange(view.shape[1]) + 2.0 * torch.rand(view.shape, generator=generator, dtype=torch.float64)
    rank[:, 0] = -1
    return X, view, visible, rank


def _see(poses: Pose, cameras: Camera, X: Tensor, view: Tensor, layout: str) -> Tensor:
    """Which of the cameras `view (n, k)` have the points `X (n, 3)` in their images, in pieces to save memory."""
    seen = []
    for part, index in zip(torch.split(X, 4096), torch.split(view, 4096), strict=True):
        shape = index.shape
        pose, camera = poses[index.flatten()], cameras[index.flatten()]
        moved = pose.transform(part[:, None].expand(*shape, 3).reshape(-1, 1, 3))
        inside = (camera.project(moved)[:, 0].abs() <= moved.new_tensor(HALF_SIZE)).all(-1) & camera.in_domain(moved)[:, 0]
        inside &= moved[:, 0, 2] > 0.5
        if layout == "dome":
            # From behind the object hides its own surface: at most 70 degrees from the normal.
            outward = part / part.norm(dim=1, keepdim=True)
            towards = pose.centre.view(*shape, 3) - part[:, None]
            inside &= ((towards * outward[:, None]).sum(-1) > 0.34 * towards.norm(dim=-1)).flatten()
        seen.append(inside.view(shape))
    return torch.cat(seen)


def _choose(visible: Tensor, rank: Tensor, count: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Exactly `count` observations, two of each point at least, the others where rank over a random track length is least."""
    n = len(visible)
    if int(visible.sum()) < count:
        raise ValueError(
            f"num_observations: wanted at most {int(visible.sum())}, as the cameras near each point see, got {count}"
        )
    rank = torch.where(visible, rank, torch.inf)
    length = -torch.rand(n, 1, generator=generator, dtype=torch.float64).clamp_min(1e-9).log() + 0.2
    score = (rank + 1) / length
    order = rank.argsort(1)
    score.scatter_(1, order[:, :2], -1.0)
    score = torch.where(visible, score, torch.inf)
    chosen = torch.zeros(visible.numel(), dtype=torch.bool)
    chosen[score.flatten().argsort()[:count]] = True
    point, index = chosen.view_as(visible).nonzero().unbind(1)
    return index, point


def _disturb(problem: BundleProblem, size: float, generator: torch.Generator | None) -> BundleProblem:
    """Poses, cameras and points off by some amount."""
    v, centre = problem.poses.shape[0], problem.poses.centre
    apart = torch.cdist(centre, centre).fill_diagonal_(torch.inf).amin(1).median()
    turn = torch.cat((0.003 * size * _normal(generator, v, 3), torch.zeros(v, 3, dtype=torch.float64)), 1)
    poses = problem.poses.retract(turn)
    moved = centre + 0.02 * size * apart * _normal(generator, v, 3)
    poses = Pose(poses.R, -(poses.R @ moved[:, :, None])[:, :, 0])
    K = problem.cameras.K.clone()
    K[:, :2, :2] *= (0.01 * size * _normal(generator, v)).exp()[:, None, None]
    distance = (problem.X[problem.point] - centre[problem.view]).norm(dim=1)
    least = torch.full((len(problem.X),), torch.inf, dtype=torch.float64)
    least = least.scatter_reduce(0, problem.point, distance, "amin")
    X = problem.X + 0.01 * size * least[:, None] * _normal(generator, len(problem.X), 3)
    lens = Radial(torch.zeros(v, dtype=torch.float64), torch.zeros(v, dtype=torch.float64))
    return replace(problem, poses=poses, cameras=Camera(K, lens if size else problem.cameras.distortion), X=X)
