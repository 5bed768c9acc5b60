"""The pose of a calibrated camera from correspondences with known points and lines, of which many are wrong."""

from dataclasses import dataclass
from typing import Any, ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.resection.camera_p3p import camera_p3p
from torchsfm.resection.flat_structure import flatness, flatness_suspected, seen_places
from torchsfm.resection.moderate_lines import image_rows, kinds, line_data, moderate_structure
from torchsfm.resection.point_line_camera import PointLineCameraEstimator
from torchsfm.resection.reprojection_step import camera_step, moved_pose, retracted_pose, squared_reprojection
from torchsfm.robust import RansacOptions, RobustResult, Weigh, check_counts, check_door, estimate_robustly
from torchsfm.robust.moderation import moderate, moved_and_scaled, present

_SAMPLES = 192
"""Of points and lines in the first round: the four solvers of such samples take little less time for fewer."""


@dataclass(frozen=True)
class CameraEstimator:
    """The pose [R | t] of a calibrated camera. Distances are reprojection errors in the unit of the image points.

    Attributes:
        K: Intrinsics of the camera of each problem; its last row is (0, 0, 1).

    Example:
        >>> import torch, torchsfm
        >>> estimator = torchsfm.resection.CameraEstimator(torch.eye(3, dtype=torch.float64))
        >>> X = torchsfm.random_points(50, generator=torch.Generator().manual_seed(0)) + torch.tensor([0, 0, 5])
        >>> x = torchsfm.project_points(torch.eye(3, 4, dtype=X.dtype), X)
        >>> x[:10] += 0.5  # one in five is wrong
        >>> found = torchsfm.ransac(estimator, x, X, threshold=0.01, generator=torch.Generator().manual_seed(0))
        >>> int(found.inliers.sum())
        40
    """

    K: Float[Tensor, "*batch 3 3"]

    model_name: ClassVar[str] = "camera"
    data_names: ClassVar[tuple[str, ...]] = ("x", "X")
    sample_size: ClassVar[int] = 3
    max_solutions: ClassVar[int] = 4
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 6
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x: Float[Tensor, "*#batch 3 2"], X: Float[Tensor, "*#batch 3 3"]
    ) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
        """The poses of three points."""
        h = torch.cat((x, torch.ones_like(x[..., :1])), -1)
        return camera_p3p(h @ torch.linalg.inv_ex(self.K)[0].mT, X)

    def squared_residual(
        self, model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared reprojection error; infinite behind the camera."""
        return squared_reprojection(self.K @ model, x, X)

    def degenerate(self, x: Float[Tensor, "*#batch 3 2"], X: Float[Tensor, "*#batch 3 3"]) -> Bool[Tensor, "*batch"]:
        """Whether two image points coincide."""
        a, b, c = x.unbind(-2)
        return (a == b).all(-1) | (b == c).all(-1) | (c == a).all(-1)

    def places(
        self, model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n 3"]:
        """The image points, and how far away the points are."""
        return seen_places(model, x, X, self._focal(model))

    def step(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 2"],
        X: Float[Tensor, "*#batch n 3"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 3 4"]:
        """A Gauss-Newton step on the reprojection error, along the rigid motions."""
        step, batch = camera_step(self.K @ model, 6, x, X, weigh)
        return moved_pose(model, step, batch).to(x.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch 3 4"]:
        """[R | t] <- exp(w) [R | t] + [0 | v], as `Pose.retract`."""
        return retracted_pose(model, step)

    def may_be_degenerate(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 2"],
        X: Float[Tensor, "*#batch n 3"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Bool[Tensor, "*batch"]:
        """Whether the inliers may be in a plane."""
        return flatness_suspected(model, X, self._focal(model), inliers, threshold, 2 + chance)

    def degeneracy(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 2"],
        X: Float[Tensor, "*#batch n 3"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """COLLINEAR: all inliers but so few as chance explains are on a line, as far as can be seen; PLANAR: in a plane."""
        return flatness(model, X, self._focal(model), inliers, threshold, 2 + chance)

    def _focal(self, model: Tensor) -> Tensor:
        focal: Tensor = (self.K[..., 0, 0] * self.K[..., 1, 1]).abs().sqrt()
        return focal


def estimate_camera(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    K: Float[Tensor, "*#batch 3 3"],
    l: Float[Tensor, "*#batch k 2 2"] | Float[Tensor, "*#batch k 3"] | None = None,  # noqa: E741
    L: Float[Tensor, "*#batch k 6"] | None = None,
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 4"]]:
    """The pose of each camera, from correspondences with known points, and with lines, of which many may be wrong.

    LO-RANSAC over samples of three points, or of three points and lines as they come, then a robust minimum of the distances in
    the image over the pose. Computed in float64, hypotheses scored in float32 after centring and scaling the world.

    With lines a datum is a point or a line, all points before all lines: `mask`, `quality`, `weights` and the result's
    `inliers` have n + k entries. The distance of a line is the root of the sum of the squared distances of both ends of its
    segment from its image, two errors as a point has; the weights say which of both is worth more.

    Args:
        x: Image points in pixels, without distortion; there may be none with lines.
        X: The points in the world.
        K: Intrinsics, upper triangular with last row (0, 0, 1).
        l: Segments, two image points each, without distortion; or homogeneous image lines of any scale, whose errors then count
            a focal length to each side of the point nearest to the principal point.
        L: The lines in the world, Pluecker vectors (d, m). What is no line (d'm is not 0) is left out.
        threshold: Largest distance of an inlier in pixels.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        The pose `[R | t]`, `X_cam = R X + t`; inliers (in front of the camera, but for lines without ends), support,
        iterations, status, degeneracy
        (COLLINEAR: all inliers but so few as chance explains are on a line, and the pose may turn about it; PLANAR: they are in
        a plane, which determines the pose, though a second one may fit nearly as well; UNDETERMINED: of so many lines and
        points no large motion of the camera is seen, as of lines that are parallel or meet in a point), covariance (6 x 6, of a
        perturbation (w, v) in the camera's frame as in `Pose.retract`). The pose carries its derivatives with respect to the
        inliers and K (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or only one of `l` and `L` is given.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(200, generator=g), torchsfm.random_poses(1, generator=g)
        >>> K = torch.eye(3, dtype=X.dtype)
        >>> seen = torchsfm.simulate_images(X, pose, torchsfm.Camera(K), outliers=0.3, generator=g)
        >>> found = torchsfm.estimate_camera(seen.x[0], X, K, threshold=1e-3, generator=g)
        >>> bool(found.model.allclose(pose.matrix()[0], atol=1e-6)), bool(found.inliers[~seen.outlier[0]].all())
        (True, True)
    """
    data: dict[str, tuple[Tensor | None, str]] = {"x": (x, "n 2"), "X": (X, "n 3"), "K": (K, "3 3")}
    if l is None and L is None:
        batch = check_door(data, threshold, options)
    else:
        batch = check_door(data | line_data(l, L), threshold, options, of_datum="m")
        of_each: Any = {name: options.get(name) for name in ("mask", "quality", "weights")}
        check_counts(x.shape[-2] + L.shape[-2], **of_each)  # type: ignore[union-attr]
    dtype = x.dtype
    x, X, K = x.double(), X.double(), K.double()
    intrinsics, middle, focal = _in_focal_lengths(K)
    estimator: CameraEstimator | PointLineCameraEstimator
    every: Any = options
    if l is None or L is None:
        world, centre, size = moderate(X, present(options.get("mask"), x, X))
        estimator, rows = CameraEstimator(intrinsics.expand(*batch, 3, 3)), [moved_and_scaled(x, middle, focal), world]
    else:
        world, centre, size = moderate_structure(X, L.double(), options.get("mask"))
        kind = kinds(x.shape[-2], l.double())
        estimator, rows = (
            PointLineCameraEstimator(intrinsics.expand(*batch, 3, 3)),
            [image_rows(x, l.double(), middle, focal), world, kind],
        )
        every = options | {"min_iterations": _SAMPLES}

    def back(model: Tensor) -> Tensor:
        return world_pose(model, centre, size)

    # [R | t] <- exp(w) [R | t] + [0 | v] in the scaled world is the same in the world, with v scaled back.
    unit = torch.cat((torch.ones_like(centre), size[..., None].expand_as(centre)), -1)
    return estimate_robustly(
        estimator, *rows, threshold=threshold, dtype=dtype, scale=1 / focal, back=back, step_unit=unit, **every
    )  # fmt: skip


def _in_focal_lengths(K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Intrinsics for images in focal lengths from the principal point, with K's derivatives; and that point and length."""
    focal = (K[..., 0, 0] * K[..., 1, 1]).abs().sqrt().detach()
    focal = torch.where(torch.isfinite(focal) & (focal > 0), focal, 1)
    middle = K[..., :2, 2].detach()
    offset = (K[..., :2, 2] - middle)[..., None]
    last = torch.eye(3, dtype=K.dtype, device=K.device)[2:].expand(*K.shape[:-2], 1, 3)
    return torch.cat((torch.cat((K[..., :2, :2], offset), -1) / focal[..., None, None], last), -2), middle, focal


def world_pose(model: Tensor, centre: Tensor, size: Tensor) -> Tensor:
    """[R | t] in the world, from that in the world of `moderate` points."""
    R = model[..., :3]
    t = model[..., 3:] * size[..., None, None] - R @ centre[..., None]
    return torch.cat((R, t), -1)
