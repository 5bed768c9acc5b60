"""The pose, and on request the inside, of cameras whose distances in the image are smallest."""

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
from torchsfm.resection.line_chords import line_chords
from torchsfm.resection.moderate_lines import line_data, pixel_ends
from torchsfm.resection.reprojection import Reprojection, inverse, like
from torchsfm.resection.squares import minimise_squares
from torchsfm.robust import check_counts

Data = tuple[Tensor, Tensor, Tensor, Camera]
"""Image points and ends of segments, points and chords of lines, weights, cameras."""
PIECE = 16384
"""Points at a time: what is in use stays in the cache."""


@dataclass(frozen=True)
class CameraRefinement:
    """Refined cameras and how well they are determined.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(50, generator=g), torchsfm.random_poses(generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> x = torchsfm.project_points(pose, X, camera)
        >>> found = torchsfm.refine_camera(x + torch.randn(50, 2, generator=g), X, pose, camera)  # noise of one pixel
        >>> found.covariance.shape, found.in_front.all().item(), round(found.error.item(), 1)
        (torch.Size([6, 6]), True, 1.5)
        >>> sigma = found.covariance.diagonal().sqrt()
        >>> turned = torchsfm.geometry.rotation_angle(found.pose.R @ pose.R.mT)
        >>> bool(turned < 3 * sigma[:3].norm())  # as sure as it says
        True
    """

    pose: Pose
    """`cam_from_world`."""
    camera: Camera
    """With the free parameters changed."""
    covariance: Float[Tensor, "*batch p p"]
    """Of the pose, as a perturbation (w, v) on the left in the camera's frame (`Pose.retract`), followed by the free
    parameters in the order given: logarithms of focal length and aspect, skew in focal lengths, principal point in pixels,
    distortion. For
    independent noise of variance 1 / weight in every image coordinate; zero where not determined."""
    in_front: Bool[Tensor, "*batch m"]
    """Which points, and then lines where they are seen, have positive depth."""
    error: Float[Tensor, "*batch"]
    """Weighted root-mean-square reprojection error in pixels, whatever the loss."""
    cost: Float[Tensor, "*batch"]
    """Half the weighted sum of losses, which is what was minimised."""
    iterations: Int[Tensor, "*batch"]
    """Steps tried."""
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
    l: Float[Tensor, "*#batch k 2 2"] | Float[Tensor, "*#batch k 3"] | None = None,  # noqa: E741
    L: Float[Tensor, "*#batch k 6"] | None = None,
    *,
    free: Sequence[str] = (),
    weights: Float[Tensor, "*#batch m"] | Bool[Tensor, "*#batch m"] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 50,
) -> CameraRefinement:
    """Minimise distances in the image over the pose of every camera of a batch, and over chosen parameters of its inside.

    Batched Levenberg-Marquardt, each camera with its own damping and its own stop. `pose` is the start, and so is
    `camera` for the parameters that are free. The pose carries the derivative of the optimum with respect to x, X, l, L,
    weights and what of the camera is held fixed. Data that are not finite make their camera NOT_FINITE unless their weight is
    0.

    With lines the sum of losses goes over points and lines, and so do `weights` and `in_front`: n points, then k lines. The
    squared distance of a line is the sum of those of both ends of its segment from its image, which distortion bends.

    Args:
        x: Image points in pixels, distorted as the camera distorts; there may be none with lines.
        X: The points in the world.
        pose: Starting poses.
        camera: The cameras.
        l: Segments, two image points each, distorted as the camera distorts; or homogeneous lines, whose errors then count a
            focal length to each side of the point nearest to the principal point.
        L: The lines in the world, Pluecker vectors (d, m).
        free: Any of "focal" (one factor for both focal lengths), "aspect" (their ratio), "skew", "principal_point" and the
            names of the distortion's parameters ("k1", ...).
        weights: Factors of the losses of points, or of points and lines, 0 or False for absent.
        loss: A robust loss of squared distances in pixels (see `torchsfm.optim.loss`); squared error by default.
        max_iterations: Most steps for each camera.

    Returns:
        Poses, cameras, covariances, errors and a status per camera.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, only one of `l` and `L` is given, or `free` names what the camera
            does not have.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(50, generator=g), torchsfm.random_poses(generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> x, start = torchsfm.project_points(pose, X, camera), pose.retract(torch.full((6,), 0.05, dtype=X.dtype))
        >>> found = torchsfm.refine_camera(x, X, start, camera)
        >>> bool(found.model.allclose(pose.matrix())), bool(found.error < 1e-6)
        (True, True)
    """
    check_options(
        pose=(pose, Pose), camera=(camera, Camera), free=(free, Sequence), loss=(loss, Callable | None),
        max_iterations=(max_iterations, "int >= 0"),
    )  # fmt: skip
    columns = intrinsic_columns(free, type(camera.distortion))
    if len(set(free)) != len(free):
        raise ValueError(f"free: wanted distinct names, got {tuple(free)}")
    lined = l is not None or L is not None
    kind = ("?m" if lined else "?n") + (": bool" if getattr(weights, "dtype", None) == torch.bool else "")
    lines = line_data(l, L) if lined else {}
    batch = check_tensors(x=(x, "n 2"), X=(X, "n 3"), R=(pose.R, "3 3"), K=(camera.K, "3 3"), weights=(weights, kind), **lines)
    if lined:
        check_counts(x.shape[-2] + L.shape[-2], weights=weights)  # type: ignore[union-attr]
    x, X = x.expand(*batch, *x.shape[-2:]), X.expand(*batch, *X.shape[-2:])
    pose = Pose(pose.R.expand(*batch, 3, 3), pose.t.expand(*batch, 3))
    camera = _expand(camera, batch)
    n, dtype = x.shape[-2], x.dtype
    finite = torch.isfinite(x).all(-1) & torch.isfinite(X).all(-1)
    if l is not None and L is not None:
        l, L = pixel_ends(l, camera.K).expand(*batch, -1, 2, 2), L.expand(*batch, *L.shape[-2:])  # noqa: E741
        good = torch.isfinite(l).flatten(-2).all(-1) & torch.isfinite(L).all(-1)
        good = good & (l[..., 0, :] != l[..., 1, :]).any(-1) & (L[..., :3] != 0).any(-1)
        finite = torch.cat((finite, good), -1)
    w = torch.ones_like(finite, dtype=dtype) if weights is None else weights.to(dtype).expand(finite.shape)
    wanted = ~(w <= 0)
    finite = finite & torch.isfinite(w)
    bad = (wanted & ~finite).any(-1) | ~(torch.isfinite(pose.R).all(-1).all(-1) & torch.isfinite(pose.t).all(-1))
    bad = bad | ~torch.isfinite(camera.K).all(-1).all(-1)
    use = wanted & finite & ~bad[..., None]
    w = torch.where(use, w, 0.0)
    x, X = (torch.where(use[..., :n, None], v, 0.0) for v in (x, X))
    x, X, w, pose, camera = tensor_map(torch.Tensor.double, (x, X, w, pose, camera))
    if l is not None and L is not None:
        l = torch.where(use[..., n:, None, None], l, l.new_tensor([[0.0, 0.0], [1.0, 0.0]])).double()  # noqa: E741
        L = torch.where(use[..., n:, None], L, L.new_tensor([1.0, 0, 0, 0, 0, 0])).double()
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    pose = Pose(torch.where(bad[..., None, None], eye, pose.R), torch.where(bad[..., None], 0.0, pose.t))
    skew = SKEW in columns or camera.K.requires_grad or bool((camera.K[..., 0, 1] != 0).any())
    problem = Reprojection(tuple(free), loss, len(columns), skew, None if l is None else n)
    theta = torch.zeros(*batch, problem.size, dtype=x.dtype, device=x.device)
    bends = l is not None and camera.distortion.parameter_names
    lens = camera
    # Where on a line its ends are seen matters only where straight lines are bent, and then little.
    for _ in range(2 if bends else 1):
        seen, local, middle = _centred(x, X, w, pose, lens, l, L)
        data = (seen, local, w, camera)
        start = Pose(pose.R, (pose.R @ middle[..., None])[..., 0] + pose.t)
        with torch.no_grad():
            fit = _fit(problem, *tensor_map(torch.Tensor.detach, (start, theta, data)), max_iterations)
        pose = Pose(fit.pose.R, fit.pose.t - (fit.pose.R @ middle[..., None])[..., 0])
        theta, lens = fit.theta, problem.inside(camera).moved(fit.theta)
    refined, theta = problem.attach((fit.pose, fit.theta), data, (fit.status == Status.OK) & ~bad)
    inside = problem.inside(camera)
    ahead = torch.where(fit.in_front, w, 0.0).sum(-1)
    R = refined.R
    place = refined.t - (R @ middle[..., None])[..., 0]
    # Numbers of the caller's kind may be too small for it.
    bad = bad | ~torch.isfinite(place.to(dtype)).all(-1)
    status = fit.status
    for condition, code in (
        ((status == Status.OK) & (2 * ahead <= w.detach().sum(-1)), Status.BEHIND),
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


def _centred(
    x: Tensor,
    X: Tensor,
    w: Tensor,
    pose: Pose,
    camera: Camera,
    l: Tensor | None,  # noqa: E741
    L: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Image points with the ends of segments, points with the chords of lines about their middle, and that (*batch, 3).

    The origin of the world goes to the points: far coordinates must not cost digits.
    """
    w = w.detach()
    if l is not None and L is not None:
        n = x.shape[-2]
        chords = line_chords(tensor_map(torch.Tensor.detach, pose), tensor_map(torch.Tensor.detach, camera), l.detach(), L)
        x, X = torch.cat((x, l.flatten(-3, -2)), -2), torch.cat((X, chords.flatten(-4, -2)), -2)
        w = torch.cat((w[..., :n], w[..., n:].repeat_interleave(4, -1)), -1)
    total = w.sum(-1, keepdim=True)
    middle = (w[..., None] * X.detach()).sum(-2) / torch.where(total > 0, total, 1.0)
    return x, X - middle[..., None, :], middle


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
    if problem.loss is None and problem.points is None:
        fit = minimise_squares(start, theta, x, X, w, problem.inside(camera), max_iterations)
        pose, theta = fit.x
        covariance, determined = inverse(fit.end.metric)
        total = w.sum(-1)
        error = (2 * fit.cost / torch.where(total > 0, total, 1.0)).clamp_min(0).sqrt()
        in_front = problem.in_front(pose, X)
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
    in_front = problem.in_front(pose, X)
    return _Fit(pose, theta, result.cost, result.iterations, result.status, covariance, determined, in_front, error)


def _or_zero(value: Tensor, good: Tensor) -> Tensor:
    return torch.where(like(good, value), value, 0.0)


def _expand(camera: Camera, batch: torch.Size) -> Camera:
    """The camera with the full batch shape."""
    distortion = tensor_map(lambda p: p.expand(batch), camera.distortion)
    return Camera(camera.K.expand(*batch, 3, 3), distortion)
