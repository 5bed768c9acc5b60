"""All cameras of a list at once, from the points and lines that each of them sees."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry import Camera, Pose, point_line_distance, project_lines
from torchsfm.resection.camera_dlt import camera_dlt
from torchsfm.resection.camera_pnp import camera_pnp
from torchsfm.resection.estimate_camera import estimate_camera
from torchsfm.resection.estimate_camera_projective import ProjectiveCameraEstimator, estimate_camera_projective
from torchsfm.resection.moderate_lines import is_segments, line_data, pixel_ends
from torchsfm.resection.refine_camera import refine_camera
from torchsfm.robust import Degeneracy, check_counts, constant_weights
from torchsfm.robust.moderation import middle_and_size

_STEPS = 8


@dataclass(frozen=True)
class ResectedCameras:
    """Cameras, what they agree with and what became of each.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(20, generator=g), torchsfm.random_poses(3, generator=g)
        >>> x = torchsfm.project_points(poses.matrix(), X)
        >>> x[1, :5] += 0.3  # wrong
        >>> visible = torch.ones(3, 20, dtype=torch.bool)
        >>> visible[2, 2:] = False  # two points do not make a pose
        >>> K = torch.eye(3).double().expand(3, 3, 3)
        >>> found = torchsfm.resect_cameras(x, X, K, visible=visible, threshold=0.01)
        >>> found.inliers.sum(-1), [torchsfm.Status(k).name for k in found.status.tolist()]
        (tensor([20, 15,  0]), ['OK', 'OK', 'TOO_FEW'])
    """

    model: Float[Tensor, "*batch v 3 4"]
    """`[R | t]` where K was given, otherwise P with `|P[2, :3]| = 1`; finite always."""
    inliers: Bool[Tensor, "*batch v m"]
    """The observations that count, of the n points and then of the k lines: nearer than the threshold, or all that are wanted
    where there is none."""
    error: Float[Tensor, "*batch v"]
    """Root-mean-square distance of the inliers in pixels: reprojection error of points, of lines the root of the sum of the
    squared distances of both ends."""
    status: Int8[Tensor, "*batch v"]
    """OK; TOO_FEW points for the camera; NOT_FINITE; DEGENERATE: the points do not determine it (in a line, for an uncalibrated
    camera in a plane); BEHIND; NOT_CONVERGED; NO_CONSENSUS."""


def resect_cameras(
    x: Float[Tensor, "*#batch v n 2"],
    X: Float[Tensor, "*#batch n 3"],
    K: Float[Tensor, "*#batch v 3 3"] | None = None,
    l: Float[Tensor, "*#batch v k 2 2"] | Float[Tensor, "*#batch v k 3"] | None = None,  # noqa: E741
    L: Float[Tensor, "*#batch k 6"] | None = None,
    *,
    threshold: float | Float[Tensor, "*#batch v"] | None = None,
    visible: Bool[Tensor, "*#batch v m"] | None = None,
    generator: torch.Generator | None = None,
    max_iterations: int = 10_000,
) -> ResectedCameras:
    """Every camera of a list of images of the same points, calibrated or not, in one batched call.

    With a threshold each camera is found among wrong correspondences (`estimate_camera`, `estimate_camera_projective`); without
    one all observations count, and the camera is the minimum of squared distances, from `camera_pnp` or `camera_dlt`, or with
    lines from the pose that half of them agree on best.
    Each image has its own points, sampling and stop.

    Args:
        x: Image points in pixels, without distortion.
        X: The points in the world.
        K: Intrinsics of each image, upper triangular with last row (0, 0, 1); None for uncalibrated cameras, without lines.
        l: Segments in the images, two image points each, without distortion; or homogeneous lines of any scale.
        L: The lines in the world, Pluecker vectors (d, m), the same ones in all images.
        threshold: Largest distance of an inlier in pixels (see `estimate_camera`); None to trust all observations.
        visible: Which image sees which of the n points, and then of the k lines; all by default.
        generator: Source of randomness.
        max_iterations: Most samples to draw for an image.

    Returns:
        The cameras, inliers, errors and a status for each.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, only one of `l` and `L` is given, or lines without K.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(20, generator=g), torchsfm.random_poses(5, generator=g)
        >>> K = torchsfm.random_intrinsics(5, generator=g)
        >>> found = torchsfm.resect_cameras(torchsfm.project_points(K @ poses.matrix(), X), X, K)
        >>> bool(found.model.allclose(poses.matrix())), found.inliers.sum(-1)
        (True, tensor([20, 20, 20, 20, 20]))
    """
    limit = threshold if isinstance(threshold, Tensor) else None
    if limit is None:
        check_options(threshold=(threshold, "?float > 0"))
    check_options(max_iterations=(max_iterations, "int >= 1"))
    lined = l is not None or L is not None
    lines = line_data(l, L, "v ") if lined else {}
    batch = check_tensors(
        x=(x, "v n 2"), X=(X, "n 3"), K=(K, "?v 3 3"), threshold=(limit, "?v"),
        visible=(visible, "?v m: bool" if lined else "?v n: bool"), **lines,
    )  # fmt: skip
    if lined and K is None:
        raise ValueError("K: wanted intrinsics, as there are lines, got None")
    v, n = x.shape[-3:-1]
    shape, m = (*batch, v), n
    x, X = x.expand(*shape, n, 2), X[..., None, :, :].expand(*shape, n, 3)
    if l is not None and L is not None:
        m = n + L.shape[-2]
        check_counts(m, visible=visible)
        l = l.expand(*shape, *l.shape[-3 if is_segments(l) else -2 :])  # noqa: E741
        L = L[..., None, :, :].expand(*shape, *L.shape[-2:])
    seen = torch.ones(*shape, m, dtype=torch.bool, device=x.device) if visible is None else visible.expand(*shape, m)
    K = None if K is None else K.expand(*shape, 3, 3)
    if threshold is not None:
        options = {"mask": seen, "generator": generator, "max_iterations": max_iterations}
        if K is not None:
            found = estimate_camera(x, X, K, l, L, threshold=threshold, **options)  # type: ignore[arg-type]
        else:
            found = estimate_camera_projective(x, X, threshold=threshold, **options)  # type: ignore[arg-type]
        open_ = (found.degeneracy != Degeneracy.NONE) & ((found.degeneracy != Degeneracy.PLANAR) | (K is None))
        status = torch.where((found.status == Status.OK) & open_, int(Status.DEGENERATE), found.status).to(torch.int8)
        model, inliers = found.model, found.inliers
    elif K is not None:
        model, status = _calibrated(x, X, K, l, L, seen, max_iterations)
        inliers = seen
    else:
        model, status = _uncalibrated(x, X, seen)
        inliers = seen
    return ResectedCameras(model, inliers, _error(model, K, x, X, l, L, inliers), status)


def _calibrated(
    x: Tensor,
    X: Tensor,
    K: Tensor,
    l: Tensor | None,  # noqa: E741
    L: Tensor | None,
    seen: Tensor,
    most: int,
) -> tuple[Tensor, Tensor]:
    """The pose of each camera from all that it sees."""
    with torch.no_grad():
        if l is None or L is None:
            h = torch.cat((x, torch.ones_like(x[..., :1])), -1)
            found = camera_pnp(h @ torch.linalg.inv_ex(K)[0].mT, X, weights=seen.to(x.dtype))
            start, known = found.model, found.status
        else:
            # The same start each time: nothing here is random to the caller.
            generator = torch.Generator().manual_seed(0)
            robust = estimate_camera(x, X, K, l, L, threshold=None, mask=seen, generator=generator, max_iterations=most)
            start = robust.model
            known = torch.where(robust.status == Status.NO_CONSENSUS, int(Status.OK), robust.status).to(torch.int8)
    refined = refine_camera(x, X, Pose.from_matrix(start), Camera(K), l, L, weights=seen)
    # What the start knows of the data stands: too few points, not determined.
    status = torch.where(known == Status.OK, refined.status, known)
    return refined.model, status.to(torch.int8)


def _uncalibrated(x: Tensor, X: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """P of each camera from all its points."""
    dtype, n = x.dtype, x.shape[-2]
    if n < 6:
        nothing = torch.eye(3, 4, dtype=dtype, device=x.device).expand(*seen.shape[:-1], 3, 4)
        return nothing, torch.full(seen.shape[:-1], int(Status.TOO_FEW), dtype=torch.int8, device=x.device)
    w = seen.to(dtype)
    start = camera_dlt(x, X, weights=w)
    finite = torch.isfinite(x).all(-1) & torch.isfinite(X).all(-1)
    use = seen & finite
    centre, size = middle_and_size(X.detach().double(), use)
    middle, radius = middle_and_size(x.detach().double(), use)
    y = torch.where(use[..., None], (x - middle[..., None, :]) / radius[..., None, None], 0.0)
    Y = torch.where(use[..., None], (X - centre[..., None, :]) / size[..., None, None], 0.0)
    P = start.model.double()
    P = torch.cat((P[..., :2, :] - middle[..., None] * P[..., 2:, :], P[..., 2:, :] * radius[..., None, None]), -2)
    P = torch.cat((P[..., :3] * size[..., None, None], P[..., 3:] + P[..., :3] @ centre[..., None]), -1)
    P = P / torch.linalg.vector_norm(P, dim=(-2, -1), keepdim=True)
    estimator = ProjectiveCameraEstimator()

    def cost(P: Tensor) -> Tensor:
        return torch.where(use, estimator.squared_residual(P, y, Y), 0.0).sum(-1)

    value = cost(P)
    for _ in range(_STEPS):
        new = estimator.step(P, y, Y, weigh=constant_weights(use.to(y.dtype)))
        after = cost(new)
        better = after <= value * (1 + 1e-12)
        P, value = torch.where(better[..., None, None], new, P), torch.where(better, after, value)
    P = torch.cat((P[..., :3] / size[..., None, None], P[..., 3:]), -1)
    P = torch.cat((P[..., :3], P[..., 3:] - P[..., :3] @ centre[..., None]), -1)
    P = torch.cat((P[..., :2, :] * radius[..., None, None] + middle[..., None] * P[..., 2:, :], P[..., 2:, :]), -2)
    third = torch.linalg.vector_norm(P[..., 2:, :3], dim=-1, keepdim=True)
    P = P / torch.where(third > 0, third, 1.0)
    P = P.to(dtype)
    good = ((start.status == Status.OK) & torch.isfinite(P).all(-1).all(-1) & (P != 0).any(-1).any(-1))[..., None, None]
    return torch.where(good, P, start.model), start.status


def _error(
    model: Tensor,
    K: Tensor | None,
    x: Tensor,
    X: Tensor,
    l: Tensor | None,  # noqa: E741
    L: Tensor | None,
    inliers: Tensor,
) -> Tensor:
    P = model if K is None else K @ model
    h = X @ P[..., :3].mT + P[..., None, :, 3]
    square = (h[..., :2] / h[..., 2:] - x).square().sum(-1)
    if l is not None and L is not None and K is not None:
        away = point_line_distance(pixel_ends(l, K), project_lines(P, L)[..., None, :])
        square = torch.cat((square, away.square().sum(-1)), -1)
    use = inliers & torch.isfinite(square)
    mean = torch.where(use, square, 0.0).sum(-1) / use.sum(-1).clamp_min(1)
    return torch.where(mean > 0, torch.where(mean > 0, mean, 1.0).sqrt(), 0.0)
