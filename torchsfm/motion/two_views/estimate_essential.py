"""The essential matrix from corresponding rays of which many are wrong."""

from dataclasses import dataclass, replace
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.geometry import rotvec_from_rotation
from torchsfm.motion.two_views.epipolar_fit import cross_rows, sphere_rows
from torchsfm.motion.two_views.plane_and_parallax import dominant_plane, more_than_chance, most_by_chance, squared_transfer
from torchsfm.motion.two_views.plane_glance import plane_suspected
from torchsfm.motion.two_views.relative_5pt import relative_5pt
from torchsfm.motion.two_views.rival_geometry import (
    rank_two_members,
    rival_explains,
    rival_suspected,
    undetermined_where_rivalled,
)
from torchsfm.motion.two_views.sampson_sphere import pose_step, squared_distance, step_equations, turned, unit_rows
from torchsfm.optim import UnitSphere, rotation_exponential
from torchsfm.robust import Degeneracy, RansacOptions, RobustResult, Weigh, check_door, estimate_robustly
from torchsfm.tensors import essential_from_pose, poses_from_essential

_SLACK = 2e-3
"""By which angle rays may miss the front where no threshold says how large the noise is, in radians."""


@dataclass(frozen=True)
class RelativePoseEstimator:
    """The pose [R | t] of the second camera, |t| = 1, from corresponding rays.

    Distances are Sampson's on the sphere of rays, in radians, and infinite for rays that meet behind a camera. Of two rays that
    meet far away the noise decides on which side: they must miss the front by an angle to count as behind.

    Attributes:
        slack: That angle in radians, for each problem.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(100, generator=g), torchsfm.random_poses(2, generator=g)
        >>> d1, d2 = torch.nn.functional.normalize(poses[:, None].transform(X[:, None])[..., 0, :], dim=-1)
        >>> estimator = torchsfm.motion.RelativePoseEstimator(slack=torch.tensor(1e-3, dtype=X.dtype))
        >>> found = torchsfm.ransac(estimator, d1, d2, threshold=1e-3, generator=g)
        >>> found.model.shape, found.inliers.sum()  # [R | t]
        (torch.Size([3, 4]), tensor(100))
    """

    slack: Float[Tensor, "*batch"]

    model_name: ClassVar[str] = "relative_pose"
    data_names: ClassVar[tuple[str, ...]] = ("d1", "d2")
    sample_size: ClassVar[int] = 5
    max_solutions: ClassVar[int] = 10
    codimension: ClassVar[int] = 1
    dimension: ClassVar[int] = 5
    never_zero: ClassVar[bool] = True

    def minimal(
        self, d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
    ) -> Solutions[Float[Tensor, "*batch 10 3 4"]]:
        """The poses for which five rays meet in front of both cameras; at most one of the four of each E."""
        return relative_5pt(d1, d2, self.slack)

    def squared_residual(
        self, model: Float[Tensor, "*#batch 3 4"], d1: Float[Tensor, "*#batch n 3"], d2: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared angular Sampson distance; infinite behind a camera."""
        return squared_distance(model, d1, d2, self.slack)

    def degenerate(self, d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]) -> Bool[Tensor, "*batch"]:
        """Whether the first two rays coincide in an image."""
        return ((d1[..., 0, :] == d1[..., 1, :]).all(-1)) | ((d2[..., 0, :] == d2[..., 1, :]).all(-1))

    def places(
        self, model: Float[Tensor, "*#batch 3 4"], d1: Float[Tensor, "*#batch n 3"], d2: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n 6"]:
        """Both rays."""
        return torch.cat((d1, d2), -1)

    def step(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        d1: Float[Tensor, "*#batch n 3"],
        d2: Float[Tensor, "*#batch n 3"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 3 4"]:
        """A Gauss-Newton step on Sampson's distance: R <- exp(w) R, and t along the unit sphere."""
        A, b = step_equations(model, d1, d2, self.slack, weigh)
        R, t = model[..., :3].double(), model[..., 3].double()
        step = pose_step(A, b, t)
        t = t + step[..., 3:]
        t = t * (t * t).sum(-1, keepdim=True).clamp(min=1e-30).rsqrt()
        return torch.cat((turned(step[..., :3], R), t[..., None]), -1).to(d1.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 5"]) -> Float[Tensor, "*batch 3 4"]:
        """R <- exp(w) R, and t along the unit sphere."""
        R = rotation_exponential(step[..., :3]) @ model[..., :3]
        return torch.cat((R, UnitSphere(3).retract(model[..., 3], step[..., 3:])[..., None]), -1)

    def may_be_degenerate(
        self,
        model: Float[Tensor, "p 3 4"],
        d1: Float[Tensor, "p n 3"],
        d2: Float[Tensor, "p n 3"],
        *,
        inliers: Bool[Tensor, "p n"],
        threshold: Float[Tensor, "p"],
        chance: Float[Tensor, "p"],
    ) -> Bool[Tensor, "p"]:
        """Whether R alone, R + t n' or another pose may relate all inliers but so few as chance explains."""
        h1, h2 = d1.mT, d2.mT
        h2 = h2 * (h2 * h2).sum(-2, keepdim=True).rsqrt()
        R, t = model[..., :3], model[..., 3]
        limit, spare = 4 * threshold * threshold, most_by_chance(chance, 2)
        flat = plane_suspected(R, t, h1, h2, inliers, limit, spare)
        return flat | rival_suspected(_unit_essential(R, t), h1, h2, inliers, limit, spare, sphere=True)

    def degeneracy(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        d1: Float[Tensor, "*#batch n 3"],
        d2: Float[Tensor, "*#batch n 3"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """What relates the inliers but so few as chance explains.

        ROTATION: R alone, so that t is open; PLANAR: R + t n'; UNDETERMINED: another pose, as well as this one.
        """
        R, t, h1, h2 = model[..., :3], model[..., 3], sphere_rows(d1), sphere_rows(d2)
        limit = 4 * threshold * threshold
        turned = inliers & (squared_transfer(R, h1, h2, sphere=True) < limit[..., None])
        rotation = turned.any(-1) & ~more_than_chance((inliers & ~turned).sum(-1), chance, 2)
        _, on = dominant_plane(R, t, h1, h2, inliers, limit, sphere=True)
        planar = on.any(-1) & ~more_than_chance((inliers & ~on).sum(-1), chance, 2)
        code = torch.where(planar, int(Degeneracy.PLANAR), int(Degeneracy.NONE))
        code = torch.where(rotation, int(Degeneracy.ROTATION), code)
        known = (self.slack, 0), (model, 2), (d1, 2), (d2, 2), (inliers, 1), (threshold, 0), (chance, 0)
        return undetermined_where_rivalled(code, self._has_rival, *known)

    def _has_rival(
        self, slack: Tensor, model: Tensor, d1: Tensor, d2: Tensor, inliers: Tensor, threshold: Tensor, chance: Tensor
    ) -> Bool[Tensor, "p"]:
        """Whether the inliers agree with another pose as well: one near to a member of rank 2 in the pencil of solutions."""
        E = _unit_essential(model[..., :3], model[..., 3])
        limit, spare = 4 * threshold * threshold, most_by_chance(chance, 2)
        found, near = rank_two_members(E, unit_rows(d1), unit_rows(d2), inliers, limit, spare, sphere=True)
        rivals = poses_from_essential(found).model

        def rise(model: Tensor, others: Tensor, weights: Tensor) -> Tensor:
            A, _ = step_equations(model, d1[:, None], d2[:, None], slack[:, None], lambda _: (weights, weights))
            turn = rotvec_from_rotation(others[..., :3] @ model[..., :3].mT)
            d = torch.cat((turn, others[..., 3] - model[..., 3]), -1)[..., None]
            return (d.mT @ A @ d)[..., 0, 0]

        own = replace(self, slack=slack)
        return rival_explains(own, model, rivals, near, (d1, d2), inliers, threshold, chance, rise)


def estimate_essential(
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 3"]]:
    """The essential matrix of each pair of calibrated cameras, from corresponding rays of which many may be wrong.

    LO-RANSAC over the poses of five-point samples, scored by Sampson's distance for rays that meet in front of both cameras,
    then a robust minimum of that distance over the poses. `pose_from_essential` turns the result into a pose. After a pure
    rotation every translation fits, and points of one plane, or of certain ruled quadrics through both centres, may fit two
    poses: `degeneracy` says so.

    Args:
        d1: Rays of the first camera, of any length, pointing to the points.
        d2: The corresponding rays of the second camera.
        threshold: Largest Sampson distance of an inlier in radians, at most 0.1: pixels divided by the focal length.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        E with d2' E d1 = 0, |E|^2 = 2 and singular values (1, 1, 0); inliers, support, iterations, status, degeneracy
        (ROTATION: a rotation relates all inliers but so few as chance explains, and the translation means nothing; PLANAR: a
        homography does, and a second pose may fit as well; UNDETERMINED: a second pose does), covariance (9 x 9, of rank 5). E
        carries its derivatives with respect to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or rays or threshold are in pixels.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, R = torchsfm.random_points(200, generator=g), torch.eye(3, dtype=torch.float64)
        >>> X, t = X + torch.tensor([0, 0, 5]), torch.tensor([0.6, 0.0, 0.8], dtype=X.dtype)
        >>> d1, d2 = X, torch.cat(((X @ R.mT + t)[:140], X[140:].roll(1, 0)))  # 30 % are wrong
        >>> found = torchsfm.estimate_essential(d1, d2, threshold=1e-3, generator=g)
        >>> torchsfm.tensors.pose_from_essential(found.model, d1, d2, found.inliers).pose.t
        tensor([0.6000, 0.0000, 0.8000], dtype=torch.float64)
    """
    batch = check_door({"d1": (d1, "n 3"), "d2": (d2, "n 3")}, threshold, options, radians=True)
    estimator = RelativePoseEstimator(pose_slack(threshold, d1).expand(batch))

    def back(model: Tensor) -> Tensor:
        return essential_from_pose(model[..., :3], model[..., 3])

    d1, d2, dtype = *both_unit_rays(d1, d2), d1.dtype
    return estimate_robustly(estimator, d1, d2, threshold=threshold, dtype=dtype, back=back, **options)


def _unit_essential(R: Tensor, t: Tensor) -> Tensor:
    E: Tensor = cross_rows(t, R) * 0.5**0.5
    return E


def pose_slack(threshold: float | Tensor | None, like: Tensor) -> Tensor:
    """By which angle rays must miss the front to count as behind: the threshold, where there is one."""
    if isinstance(threshold, Tensor):
        return threshold.double()
    return torch.tensor(_SLACK if threshold is None else threshold, dtype=torch.float64, device=like.device)


def both_unit_rays(d1: Tensor, d2: Tensor) -> tuple[Tensor, Tensor]:
    """`unit_rays` of both cameras, at once where they come in one shape."""
    if d1.shape != d2.shape:
        return unit_rays(d1), unit_rays(d2)
    first, second = unit_rays(torch.stack((d1, d2))).unbind()
    return first, second


def unit_rays(d: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
    """Rays of length 1 in float64; NaN for those without direction, so that they are left out."""
    # Coordinates first: sums of three are then taken along the memory.
    rows = d.double().movedim(-1, 0).contiguous()
    square = (rows * rows).sum(0)
    good = (square > 0) & (square < torch.inf)
    if bool(good.all()):
        return (rows * square.rsqrt()).movedim(0, -1)
    safe = torch.where(good, rows, 1)
    return torch.where(good, safe * (safe * safe).sum(0).rsqrt(), torch.nan).movedim(0, -1)
