"""An uncalibrated camera from correspondences with known points, of which many are wrong."""

from dataclasses import dataclass
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import damped_solve, nullspace_rows
from torchsfm.linalg.portions import portions
from torchsfm.optim import UnitSphere, attach_implicit, for_slots, wants_derivative
from torchsfm.resection.camera_dlt import BLURRED, other_camera
from torchsfm.resection.flat_structure import flatness, flatness_suspected, seen_places
from torchsfm.resection.focal import incidence_rows
from torchsfm.resection.reprojection_step import normal_equations, squared_reprojection
from torchsfm.robust import Degeneracy, RansacOptions, RobustResult, Weigh, check_door, estimate_robustly
from torchsfm.robust.moderation import moderate, present

_CHUNK = 4096
_EXACT = 1e-3
"""Part of the threshold within which two cameras agree with data that have no noise."""
_GLANCE = 2.0
"""How much farther than from all data another camera must be from a part of them."""


@dataclass(frozen=True)
class ProjectiveCameraEstimator:
    """Any 3x4 camera P, with |P| = 1 and points in front where the third coordinate of P X is positive.

    A sample is six points, of which the last gives one equation. Distances are reprojection errors in the unit of the image
    points.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(200, generator=g), torchsfm.random_poses(1, generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> seen = torchsfm.simulate_images(X, pose, camera, outliers=0.3, generator=g)
        >>> estimator = torchsfm.resection.ProjectiveCameraEstimator()
        >>> found = torchsfm.ransac(estimator, seen.x[0], X, threshold=2.0, generator=g)
        >>> estimator.sample_size, bool((found.inliers != seen.outlier[0]).float().mean() > 0.95)
        (6, True)
    """

    model_name: ClassVar[str] = "projective_camera"
    data_names: ClassVar[tuple[str, ...]] = ("x", "X")
    sample_size: ClassVar[int] = 6
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 11
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x: Float[Tensor, "*#batch 6 2"], X: Float[Tensor, "*#batch 6 3"]
    ) -> Solutions[Float[Tensor, "*batch 1 3 4"]]:
        """The camera of five and a half points."""
        batch = check_tensors(x=(x, "6 2"), X=(X, "6 3"))
        with torch.no_grad():
            rows = [a.detach().double().expand(*batch, 6, k).reshape(-1, 6, k).permute(1, 2, 0) for a, k in ((x, 2), (X, 3))]
            some = portions(max(rows[0].shape[-1], 1), _CHUNK, x.device)
            parts = [_minimal(*(r[..., part] for r in rows)) for part in some]
            P, valid = (torch.cat(part) for part in zip(*parts, strict=True))
            P, valid = P.reshape(*batch, 1, 3, 4).to(x.dtype), valid.reshape(*batch, 1)
        if wants_derivative(x, X):
            P = attach_implicit(equations, P, for_slots(x, batch), for_slots(X, batch), dims=2, valid=valid)
        return Solutions(P, valid)

    def squared_residual(
        self, model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch n 2"], X: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared reprojection error; infinite behind the camera."""
        return squared_reprojection(model, x, X)

    def degenerate(self, x: Float[Tensor, "*#batch 6 2"], X: Float[Tensor, "*#batch 6 3"]) -> Bool[Tensor, "*batch"]:
        """Whether two image points coincide."""
        pairs = [(i, j) for i in range(6) for j in range(i)]
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
        """A Gauss-Newton step on the reprojection error over the entries of P, across P itself."""
        S, batch = normal_equations(model, x, X, weigh)
        A, p = S[..., :12], model.double().expand(*batch, 3, 4).reshape(-1, 12, 1)
        # The scale is free: hold it, in units of the rest.
        trace = A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
        new = p + damped_solve(torch.addcmul(A, trace * p, p.mT), S[..., 12:])
        size = torch.linalg.vector_norm(new, dim=1, keepdim=True)
        return (new / torch.where(size > 0, size, 1.0)).view(*batch, 3, 4).to(x.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 11"]) -> Float[Tensor, "*batch 3 4"]:
        """P moved along the unit sphere."""
        moved = UnitSphere(12).retract(model.flatten(-2), step)
        return moved.reshape(*moved.shape[:-1], 3, 4)

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
        """Whether the inliers may be in a plane, or near to another camera."""
        flat = flatness_suspected(model, X, self._focal(model), inliers, threshold, 4 + chance)
        return flat | other_camera(x, X, inliers, _EXACT * threshold, _GLANCE * BLURRED)

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
        """What the inliers have in common, as far as can be seen.

        COLLINEAR or PLANAR: all but so few as chance explains are on a line or a plane; UNDETERMINED: a second camera is nearly
        as near to them, as where they are on a twisted cubic with the centre.
        """
        code = flatness(model, X, self._focal(model), inliers, threshold, 4 + chance)
        other = other_camera(x, X, inliers, _EXACT * threshold) & (code == Degeneracy.NONE)
        return torch.where(other, int(Degeneracy.UNDETERMINED), code).to(torch.int8)

    @staticmethod
    def _focal(model: Tensor) -> Tensor:
        focal: Tensor = torch.linalg.matrix_norm(model[..., :2, :3], dim=(-2, -1)).clamp_min(1e-12)
        return focal


def equations(
    model: Float[Tensor, "*#batch 3 4"], x: Float[Tensor, "*#batch 6 2"], X: Float[Tensor, "*#batch 6 3"]
) -> Float[Tensor, "*batch 12"]:
    """Eleven equations of five and a half points, and |P|^2 = 1."""
    Y = X @ model[..., :3].mT + model[..., None, :, 3]
    first, second = Y[..., 0] - x[..., 0] * Y[..., 2], Y[..., 1] - x[..., 1] * Y[..., 2]
    # Of the last point the equation that `_minimal` takes: across the image point, in the direction of the first axis.
    a, b = x[..., 5, :].unbind(-1)
    length = (a * a + b * b + 1).sqrt()
    k = 1 / (length + 1)
    u, v, w = 1 - a * a * k / length, -a * b * k / length, -a / length
    last = u * Y[..., 5, 0] + v * Y[..., 5, 1] + w * Y[..., 5, 2]
    size = model.square().sum((-2, -1)) - 1
    parts = torch.broadcast_tensors(*first[..., :5].unbind(-1), *second[..., :5].unbind(-1), last, size)  # type: ignore[no-untyped-call]
    return torch.stack(parts, -1)


def _minimal(x: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """P (batch, 12) and validity (batch) of x and X (point, coordinate, batch)."""
    good = torch.isfinite(x).all(0).all(0) & torch.isfinite(X).all(0).all(0)
    x, X = torch.where(good, x, 1.0), torch.where(good, X, 1.0)
    rows = incidence_rows(x, torch.cat((X, torch.ones_like(X[:, :1])), 1))
    basis, pivot = nullspace_rows(rows[:11])
    p = basis[0]
    depth = p[8] * X[:, 0] + p[9] * X[:, 1] + p[10] * X[:, 2] + p[11]
    front = (depth > 0).all(0)
    valid = good & (front | (depth < 0).all(0)) & (pivot > 1e-11) & torch.isfinite(p).all(0)
    p = torch.where(front, p, -p)
    nothing = torch.eye(3, 4, dtype=x.dtype, device=x.device).flatten()[:, None] / 3**0.5
    return torch.where(valid, p, nothing).T, valid


def estimate_camera_projective(
    x: Float[Tensor, "*#batch n 2"],
    X: Float[Tensor, "*#batch n 3"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 4"]]:
    """The uncalibrated 3x4 camera of each image, from correspondences of which many may be wrong.

    LO-RANSAC over six-point samples, then a robust minimum of the reprojection error over all eleven parameters. Computed in
    float64, hypotheses scored in float32.

    Args:
        x: Image points in pixels.
        X: The points in the world.
        threshold: Largest reprojection error of an inlier in pixels.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        Cameras with `|P[2, :3]| = 1` and inliers at positive third coordinates; inliers, support, iterations, status,
        degeneracy (COLLINEAR, PLANAR: neither determines the camera; UNDETERMINED: a second camera agrees as well, as of points
        on a twisted cubic through the centre), covariance (12 x 12, of rank 11). The cameras carry their
        derivatives with respect to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(200, generator=g), torchsfm.random_poses(1, generator=g)
        >>> K = torchsfm.random_intrinsics(generator=g)
        >>> seen = torchsfm.simulate_images(X, pose, torchsfm.Camera(K), outliers=0.3, generator=g)
        >>> found = torchsfm.estimate_camera_projective(seen.x[0], X, threshold=2.0, generator=g)
        >>> bool(torchsfm.geometry.krt_from_camera(found.model)[0].allclose(K, rtol=1e-4))
        True
    """
    check_door({"x": (x, "n 2"), "X": (X, "n 3")}, threshold, options)
    usable = present(options.get("mask"), x, X)
    y, middle, radius = moderate(x.double(), usable)
    Y, centre, size = moderate(X.double(), usable)

    def back(P: Tensor) -> Tensor:
        P = torch.cat((P[..., :3], P[..., 3:] * size[..., None, None] - P[..., :3] @ centre[..., None]), -1)
        P = torch.cat((P[..., :2, :] * radius[..., None, None] + middle[..., None] * P[..., 2:, :], P[..., 2:, :]), -2)
        third = torch.linalg.vector_norm(P[..., 2:, :3], dim=-1, keepdim=True)
        return P / torch.where(third > 0, third, 1.0)

    return estimate_robustly(
        ProjectiveCameraEstimator(), y, Y, threshold=threshold, dtype=x.dtype, scale=1 / radius, back=back, **options
    )  # fmt: skip
