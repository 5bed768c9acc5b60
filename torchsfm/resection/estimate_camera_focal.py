"""Pose and focal length of a camera from correspondences with known points, of which many are wrong."""

from dataclasses import dataclass
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.resection.camera_p4pf import camera_p4pf
from torchsfm.resection.estimate_camera import world_pose
from torchsfm.resection.flat_structure import flatness, flatness_suspected, seen_places
from torchsfm.resection.reprojection_step import camera_step, moved_pose, retracted_pose, squared_reprojection
from torchsfm.robust import RansacOptions, RobustResult, Weigh, check_door, estimate_robustly
from torchsfm.robust.moderation import middle_and_size, moderate, moved_and_scaled, present


@dataclass(frozen=True)
class FocalCameraEstimator:
    """The camera `diag(f, f, 1) [R | t]` in images whose origin is the principal point.

    Distances are reprojection errors in the unit of the image points.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(200, generator=g), torchsfm.random_poses(1, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.zeros(2)).double()  # the origin is the principal point
        >>> seen = torchsfm.simulate_images(X, pose, torchsfm.Camera(K), outliers=0.3, generator=g)
        >>> estimator = torchsfm.resection.FocalCameraEstimator()
        >>> found = torchsfm.ransac(estimator, seen.x[0], X, threshold=2.0, generator=g)
        >>> estimator.sample_size, bool((found.inliers != seen.outlier[0]).float().mean() > 0.95)
        (4, True)
    """

    model_name: ClassVar[str] = "focal_camera"
    data_names: ClassVar[tuple[str, ...]] = ("x", "X")
    sample_size: ClassVar[int] = 4
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 7
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x: Float[Tensor, "*#batch 4 2"], X: Float[Tensor, "*#batch 4 3"]
    ) -> Solutions[Float[Tensor, "*batch 1 3 4"]]:
        """The camera of four points."""
        return camera_p4pf(x, X)

    def squared_residual(
        self, model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared reprojection error; infinite behind the camera."""
        return squared_reprojection(model, x, X)

    def degenerate(self, x: Float[Tensor, "*#batch 4 2"], X: Float[Tensor, "*#batch 4 3"]) -> Bool[Tensor, "*batch"]:
        """Whether two image points coincide."""
        pairs = [(i, j) for i in range(4) for j in range(i)]
        same = torch.stack([(x[..., i, :] == x[..., j, :]).all(-1) for i, j in pairs])
        return same.any(0).expand(torch.broadcast_shapes(same.shape[1:], X.shape[:-2]))  # type: ignore[no-untyped-call]

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
        """A Gauss-Newton step on the reprojection error over pose and logarithm of the focal length."""
        step, batch = camera_step(model, 7, x, X, weigh)
        f, pose = _split(model.double())
        zoomed = f * step[:, 6, 0].clamp(-1, 1).exp().view(batch)
        return _join(zoomed, moved_pose(pose, step, batch)).to(x.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 7"]) -> Float[Tensor, "*batch 3 4"]:
        """[R | t] <- exp(w) [R | t] + [0 | v], f <- exp(g) f for steps (w, v, g)."""
        f, pose = _split(model)
        return _join(f * step[..., 6].exp(), retracted_pose(pose, step[..., :6]))

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

    @staticmethod
    def _focal(model: Tensor) -> Tensor:
        focal: Tensor = torch.linalg.vector_norm(model[..., 0, :3], dim=-1).clamp_min(1e-12)
        return focal


def _split(P: Tensor) -> tuple[Tensor, Tensor]:
    """The focal length and `[R | t]`."""
    f = torch.linalg.vector_norm(P[..., :2, :3], dim=(-2, -1)) * 0.5**0.5
    f = torch.where(f > 0, f, 1.0)
    return f, torch.cat((P[..., :2, :] / f[..., None, None], P[..., 2:, :]), -2)


def _join(f: Tensor, pose: Tensor) -> Tensor:
    return torch.cat((f[..., None, None] * pose[..., :2, :], pose[..., 2:, :]), -2)


def estimate_camera_focal(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    c: Float[Tensor, "*#batch 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 4"]]:
    """The camera of each image, its focal length included, from correspondences of which many may be wrong.

    LO-RANSAC over four-point samples (`camera_p4pf`), then a robust minimum of the reprojection error over pose and focal
    length. Pixels are square and undistorted. Computed in float64, hypotheses scored in float32.

    Args:
        x: Image points in pixels, without distortion.
        X: The points in the world.
        c: Principal points in pixels (the middle of the image, if nothing better is known).
        threshold: Largest reprojection error of an inlier in pixels.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        Cameras `P = K [R | t]` with `K = ((f, 0, c_x), (0, f, c_y), (0, 0, 1))`, which `krt_from_camera` takes apart; inliers
        (in front of the camera), support, iterations, status, degeneracy (COLLINEAR; PLANAR: all inliers in a plane, which
        determines the focal length the better the more it is tilted, and not at all where it faces the camera), covariance
        (7 x 7, of (w, v) in the camera's frame as in `Pose.retract` and log f). The cameras carry their derivatives with
        respect to the inliers and c (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(200, generator=g), torchsfm.random_poses(1, generator=g)
        >>> K = torchsfm.random_intrinsics(generator=g)
        >>> seen = torchsfm.simulate_images(X, pose, torchsfm.Camera(K), outliers=0.3, generator=g)
        >>> found = torchsfm.estimate_camera_focal(seen.x[0], X, K[:2, 2], threshold=2.0, generator=g)
        >>> bool(torchsfm.geometry.krt_from_camera(found.model)[0].allclose(K, rtol=1e-4))
        True
    """
    check_door({"x": (x, "n 2"), "X": (X, "n 3"), "c": (c, "2")}, threshold, options)
    dtype = x.dtype
    x, X, c = x.double(), X.double(), c.double()
    usable = present(options.get("mask"), x, X)
    Y, centre, size = moderate(X, usable)
    offset = (x - c[..., None, :]).detach()
    both = None if usable is None else torch.cat((usable, usable), -1)
    _, radius = middle_and_size(torch.cat((offset, -offset), -2), both)

    def back(model: Tensor) -> Tensor:
        f, pose = _split(model)
        P = _join(f * radius, world_pose(pose, centre, size))
        return torch.cat((P[..., :2, :] + origin[..., :, None] * P[..., 2:, :], P[..., 2:, :]), -2)

    one = torch.ones_like(centre)
    unit = torch.cat((one, one * size[..., None], one[..., :1]), -1)
    y = moved_and_scaled(x, c, radius)
    # Where it is not finite there are no data, but the zeros in place of a camera are to stay finite.
    origin = torch.where(torch.isfinite(c), c, 0.0)
    return estimate_robustly(
        FocalCameraEstimator(), y, Y, threshold=threshold, dtype=dtype, scale=1 / radius, back=back, step_unit=unit, **options
    )  # fmt: skip
