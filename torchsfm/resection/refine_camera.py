"""The pose, and on request the inside, of cameras whose reprojection error is smallest."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.geometry import Camera, Pose
from torchsfm.geometry.intrinsic_parameters import SKEW, intrinsic_columns
from torchsfm.optim import Loss, levenberg_marquardt
from torchsfm.resection._reprojection import Reprojection, inverse, like
from torchsfm.resection._squares import minimise_squares

Data = tuple[Tensor, Tensor, Tensor, Camera]
"""Image points, points, weights, cameras."""
PIECE = 16384
"""Points at a time: what is in use stays in the cache."""


@dataclass(frozen=True)
class CameraRefinement:
    """Refined cameras and how well they are determined."""

    pose: Pose
    """`cam_from_world`."""
    camera: Camera
    """With the free parameters changed."""
    covariance: Float[Tensor, "*batch p p"]
    """Of the pose, as a perturbation (w, v) on the left in the camera's frame (`Pose.retract`), followed by the free
    parameters in the order given: logarithms of focal length and aspect, skew in focal lengths, principal point in pixels,
    distortion. For
    independent noise of variance 1 / weight in every image coordinate; zero where not determined."""
    in_front: Bool[Tensor, "*batch n"]
    """Which points have positive depth."""
    error: Float[Tensor, "*batch"]
    """Weighted root-mean-square reprojection error in pixels, whatever the loss."""
    cost: Float[Tensor, "*batch"]
    """Half the weighted sum of losses, which is what was minimised."""
    iterations: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]
    """OK, NOT_CONVERGED, TOO_FEW, NOT_FINITE; DEGENERATE: the parameters are not determined (points in a line, all far away,
    ...); BEHIND: half of the weight or more is behind the camera."""

    @property
    def model(self) -> Float[Tensor, "*batch 3 4"]:
        """The pose as a matrix `[R | t]`."""
        return self.pose.matrix()


def refine_camera(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    pose: Pose,
    camera: Camera,
    *,
    free: Sequence[str] = (),
    weights: Float[Tensor, "*#batch n"] | Bool[Tensor, "*#batch n"] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 50,
) -> CameraRefinement:
    """Minimise reprojection errors over the pose of every camera of a batch, and over chosen parameters of its inside.

    Batched Levenberg-Marquardt, each camera with its own damping and its own stop. `pose` is the start, and so is
    `camera` for the parameters that are free. The pose carries the derivative of the optimum with respect to x, X,
    weights and what of the camera is held fixed. Points whose image or position is not finite make their camera
    NOT_FINITE unless their weight is 0.

    Args:
        x: Image points in pixels, distorted as the camera distorts.
        X: The points in the world.
        pose: Starting poses.
        camera: The cameras.
        free: Any of "focal" (one factor for both focal lengths), "aspect" (their ratio), "skew", "principal_point" and the
            names of the distortion's parameters ("k1", ...).
        weights: Factors of the points' losses, 0 or False for absent.
        loss: A robust loss of squared distances in pixels (see `torchsfm.optim.loss`); squared error by default.
        max_iterations: Most steps for each camera.

    Returns:
        Poses, cameras, covariances, errors and a status per camera.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or `free` names what the camera does not have.
    """
    check_options(
        pose=(pose, Pose), camera=(camera, Camera), free=(free, Sequence), loss=(loss, Callable | None),
        max_iterations=(max_iterations, "int >= 0"),
    )  # fmt: skip
    columns = intrinsic_columns(free, type(camera.distortion))
    if len(set(free)) != len(free):
        raise ValueError(f"free: wanted distinct names, got {tuple(free)}")
    kind = "?n: bool" if getattr(weights, "dtype", None) == torch.bool else "?n"
    batch = check_tensors(x=(x, "n 2"), X=(X, "n 3"), R=(pose.R, "3 3"), K=(camera.K, "3 3"), weights=(weights, kind))
    x, X = x.expand(*batch, *x.shape[-2:]), X.expand(*batch, *X.shape[-2:])
    pose = Pose(pose.R.expand(*batch, 3, 3), pose.t.expand(*batch, 3))
    camera = _expand(camera, batch)
    w = (
        torch.ones(x.shape[:-1], dtype=x.dtype, device=x.device)
        if weights is None
        else weights.to(x.dtype).expand(x.shape[:-1])
    )
    wanted = ~(w <= 0)
    finite = torch.isfinite(x).all(-1) & torch.isfinite(X).all(-1) & torch.isfinite(w)
    bad = (wanted & ~finite).any(-1) | ~(torch.isfinite(pose.R).all(-1).all(-1) & torch.isfinite(pose.t).all(-1))
    bad = bad | ~torch.isfinite(camera.K).all(-1).all(-1)
    use = wanted & finite & ~bad[..., None]
    w = torch.where(use, w, 0.0)
    x, X = torch.where(use[..., None], x, 0.0), torch.where(use[..., None], X, 0.0)
    dtype = x.dtype
    x, X, w, pose, camera = tensor_map(torch.Tensor.double, (x, X, w, pose, camera))

    # The origin of the world goes to the points: far coordinates must not cost digits.
    total = w.detach().sum(-1, keepdim=True)
    middle = (w.detach()[..., None] * X.detach()).sum(-2) / torch.where(total > 0, total, 1.0)
    local = X - middle[..., None, :]
    t = (pose.R @ middle[..., None])[..., 0] + pose.t
    start = Pose(torch.where(bad[..., None, None], torch.eye(3, dtype=x.dtype, device=x.device), pose.R), t)
    skew = SKEW in columns or camera.K.requires_grad or bool((camera.K[..., 0, 1] != 0).any())
    problem = Reprojection(tuple(free), loss, len(columns), skew)
    theta = torch.zeros(*batch, problem.size, dtype=x.dtype, device=x.device)
    data = (x, local, w, camera)
    with torch.no_grad():
        fit = _fit(problem, *tensor_map(torch.Tensor.detach, (start, theta, data)), max_iterations)
    refined, theta = problem.attach((fit.pose, fit.theta), data, (fit.status == Status.OK) & ~bad)
    inside = problem.inside(camera)
    ahead = torch.where(fit.in_front, w, 0.0).sum(-1)
    R = refined.R
    place = refined.t - (R @ middle[..., None])[..., 0]
    # Numbers of the caller's kind may be too small for it.
    bad = bad | ~torch.isfinite(place.to(dtype)).all(-1)
    status = fit.status
    for condition, code in (
        ((status == Status.OK) & (2 * ahead <= total[..., 0]), Status.BEHIND),
        ((status != Status.TOO_FEW) & ~fit.determined, Status.DEGENERATE),
        (bad, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    known = fit.determined & ~bad
    world = Pose(torch.where(bad[..., None, None], torch.eye(3, dtype=R.dtype, device=R.device), R), _or_zero(place, ~bad))
    return CameraRefinement(
        Pose(world.R.to(dtype), world.t.to(dtype)),
        tensor_map(lambda v: v.to(dtype), inside.moved(theta)),
        torch.where(known[..., None, None], fit.covariance, 0.0).to(dtype),
        fit.in_front & ~bad[..., None],
        _or_zero(fit.error, ~bad).to(dtype),
        _or_zero(fit.cost, ~bad).to(dtype),
        fit.iterations,
        status,
    )


class _Fit(NamedTuple):
    """What a minimisation ends with."""

    pose: Pose
    theta: Tensor
    cost: Tensor
    iterations: Tensor
    status: Tensor
    covariance: Tensor
    determined: Tensor
    in_front: Tensor
    error: Tensor


def _fit(problem: Reprojection, start: Pose, theta: Tensor, data: Data, max_iterations: int) -> _Fit:
    """Minimise in pieces that fit the cache."""
    batch, n = data[0].shape[:-2], data[0].shape[-2]

    def flat(v: Tensor) -> Tensor:
        return v.reshape(batch.numel(), *v.shape[len(batch) :])

    start, theta, data = tensor_map(flat, (start, theta, data))
    step = max(1, PIECE // max(1, n))
    parts = []
    for i in range(0, max(batch.numel(), 1), step):
        piece = tensor_map(lambda v: v[i : i + step], (start, theta, data))  # noqa: B023
        parts.append(_minimum(problem, *piece, max_iterations))
    joined = parts[0]
    if len(parts) > 1:
        poses = Pose(torch.cat([p.pose.R for p in parts]), torch.cat([p.pose.t for p in parts]))
        joined = _Fit(poses, *(torch.cat(v) for v in zip(*(p[1:] for p in parts), strict=True)))
    found: _Fit = tensor_map(lambda v: v.reshape(batch + v.shape[1:]), joined)
    return found


def _minimum(problem: Reprojection, start: Pose, theta: Tensor, data: Data, max_iterations: int) -> _Fit:
    x, X, w, camera = data
    plain = problem.loss is None
    if plain:
        fit = minimise_squares(start, theta, x, X, w, problem.inside(camera), max_iterations)
        pose, theta = fit.x
        covariance, determined = inverse(fit.end.metric)
        total = w.sum(-1)
        error = (2 * fit.cost / torch.where(total > 0, total, 1.0)).clamp_min(0).sqrt()
        in_front = pose.transform(X)[..., 2] > 0
        return _Fit(pose, theta, fit.cost, fit.iterations, fit.status, covariance, determined, in_front, error)
    result = levenberg_marquardt(
        problem.residual, (start, theta), x, X, camera, retract=problem.retract, size=6 + problem.size, weights=w,
        loss=problem.loss, linearize=problem.linearize, max_iterations=max_iterations, function_tolerance=1e-6,
        step_tolerance=1e-12,
    )  # fmt: skip
    pose, theta = result.x
    for _ in range(5):
        pose, theta = problem.settle((pose, theta), x, X, w, camera)
    r, J = problem.linearize((pose, theta), x, X, camera)
    covariance, determined = inverse(problem.normal_matrix(J, problem.slopes(r, w)))
    total = w.sum(-1)
    square = (w * (r * r).sum(-1)).sum(-1)
    error = (square / torch.where(total > 0, total, 1.0)).sqrt()
    in_front = pose.transform(X)[..., 2] > 0
    return _Fit(pose, theta, result.cost, result.iterations, result.status, covariance, determined, in_front, error)


def _or_zero(value: Tensor, good: Tensor) -> Tensor:
    return torch.where(like(good, value), value, 0.0)


def _expand(camera: Camera, batch: torch.Size) -> Camera:
    """The camera with the full batch shape."""
    distortion = tensor_map(lambda p: p.expand(batch), camera.distortion)
    return Camera(camera.K.expand(*batch, 3, 3), distortion)
