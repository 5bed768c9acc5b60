"""The relative pose of two cameras that know the vertical, from corresponding rays of which many are wrong."""

from dataclasses import dataclass, replace
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, Status
from torchsfm.geometry import rotation_from_rotvec
from torchsfm.linalg import cross
from torchsfm.motion.two_views.epipolar_fit import sphere_rows
from torchsfm.motion.two_views.estimate_essential import RelativePoseEstimator, pose_slack, unit_rays
from torchsfm.motion.two_views.plane_and_parallax import more_than_chance, squared_transfer
from torchsfm.motion.two_views.relative_upright_3pt import relative_upright_3pt
from torchsfm.motion.two_views.sampson_sphere import pose_step, step_equations, turned
from torchsfm.motion.two_views.vertical_evidence import contradicts_verticals, off_great_circle
from torchsfm.optim import UnitSphere, rotation_exponential
from torchsfm.robust import Degeneracy, RansacOptions, RobustResult, Weigh, check_door, estimate_robustly


@dataclass(frozen=True)
class UprightPoseEstimator:
    """The pose [R | t] of the second camera, |t| = 1 and R gravity1 = gravity2, from corresponding rays.

    Distances are those of `RelativePoseEstimator`.

    Attributes:
        gravity1: The vertical in the first camera, of length 1, for each problem.
        gravity2: The vertical in the second camera, of length 1.
        slack: By which angle in radians rays must miss the front to count as behind.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, t = torchsfm.random_points(200, generator=g), torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
        >>> R = torchsfm.geometry.rotation_from_rotvec(torch.tensor([0.0, 0.5, 0.0], dtype=t.dtype))  # about the vertical
        >>> d1, down = X + 5 * t, torch.tensor([0.0, 1.0, 0.0], dtype=t.dtype)
        >>> estimator = torchsfm.motion.UprightPoseEstimator(down, down, slack=torch.tensor(1e-3).double())
        >>> found = torchsfm.ransac(estimator, d1, d1 @ R.mT + t, threshold=1e-3, generator=g)
        >>> estimator.sample_size, found.inliers.sum()
        (3, tensor(200))
    """

    gravity1: Float[Tensor, "*batch 3"]
    gravity2: Float[Tensor, "*batch 3"]
    slack: Float[Tensor, "*batch"]

    model_name: ClassVar[str] = "upright_pose"
    data_names: ClassVar[tuple[str, ...]] = ("d1", "d2")
    sample_size: ClassVar[int] = 3
    max_solutions: ClassVar[int] = 4
    codimension: ClassVar[int] = 1
    dimension: ClassVar[int] = 3
    never_zero: ClassVar[bool] = True

    def minimal(
        self, d1: Float[Tensor, "*#batch 3 3"], d2: Float[Tensor, "*#batch 3 3"]
    ) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
        """The poses for which three rays meet in front of both cameras."""
        solutions = relative_upright_3pt(d1, d2, self.gravity1, self.gravity2)
        wide = RelativePoseEstimator(self.slack[..., None])
        behind = torch.isinf(wide.squared_residual(solutions.model.detach(), d1[..., None, :, :], d2[..., None, :, :]))
        return Solutions(solutions.model, solutions.valid & ~behind.any(-1))

    def squared_residual(
        self, model: Float[Tensor, "*#batch 3 4"], d1: Float[Tensor, "*#batch n 3"], d2: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared angular Sampson distance; infinite behind a camera."""
        return RelativePoseEstimator(self.slack).squared_residual(model, d1, d2)

    def degenerate(self, d1: Float[Tensor, "*#batch 3 3"], d2: Float[Tensor, "*#batch 3 3"]) -> Bool[Tensor, "*batch"]:
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
        """A Gauss-Newton step on Sampson's distance: R turned about the vertical, and t along the unit sphere."""
        A, b = step_equations(model, d1, d2, self.slack, weigh)
        R, t, up = model[..., :3].double(), model[..., 3].double(), self.gravity2.double()
        # Of all turns the one about the vertical.
        A = torch.cat(((up[..., None, :] @ A[..., :3, :]), A[..., 3:, :]), -2)
        A = torch.cat((A[..., :3] @ up[..., None], A[..., 3:]), -1)
        step = pose_step(A, torch.cat(((up * b[..., :3]).sum(-1, keepdim=True), b[..., 3:]), -1), t)
        t = t + step[..., 1:]
        t = t * (t * t).sum(-1, keepdim=True).clamp(min=1e-30).rsqrt()
        R = turned(step[..., :1] * up, R)
        # What a start in lower precision lacks to the vertical.
        R = rotation_from_rotvec(cross((R @ self.gravity1.double()[..., None])[..., 0], up)) @ R
        return torch.cat((R, t[..., None]), -1).to(d1.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 4"]:
        """R turned about the vertical by the first number of the step, and t moved along the unit sphere by the others."""
        # Where the verticals move, R moves with them.
        upright = rotation_exponential(cross((model[..., :3] @ self.gravity1[..., None])[..., 0], self.gravity2))
        R = rotation_exponential(step[..., :1] * self.gravity2) @ upright @ model[..., :3]
        t = UnitSphere(3).retract(model[..., 3].expand(R.shape[:-1]), step[..., 1:])
        return torch.cat((R, t[..., None]), -1)

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
        """Whether `degeneracy` may find something; it takes hardly longer."""
        return self.degeneracy(model, d1, d2, inliers=inliers, threshold=threshold, chance=chance) != int(Degeneracy.NONE)

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
        """ROTATION: a turn about the vertical relates the inliers but so few as chance explains, so that t is open.

        COLLINEAR: all but so few are on a line in an image; several poses then fit, if not more.
        """
        h1, h2 = sphere_rows(d1), sphere_rows(d2)
        near = squared_transfer(self._best_turn(model[..., :3], d1, d2, inliers), h1, h2, sphere=True)
        turned = inliers & (near < (4 * threshold * threshold)[..., None])
        rotation = turned.any(-1) & ~more_than_chance((inliers & ~turned).sum(-1), chance, 2)
        aside = torch.stack([off_great_circle(d, inliers, threshold) for d in (d1, d2)])
        lined = (~more_than_chance(aside, chance, 2) & (2 * aside <= inliers.sum(-1))).any(0)
        code = torch.where(lined, int(Degeneracy.COLLINEAR), int(Degeneracy.NONE))
        return torch.where(rotation, int(Degeneracy.ROTATION), code).to(torch.int8)

    def _best_turn(self, R: Tensor, d1: Tensor, d2: Tensor, inliers: Tensor) -> Float[Tensor, "*batch 3 3"]:
        """The turn that relates the inliers best: that of a pose may be off, where a sideways t makes up for it."""
        up = self.gravity2[..., None, :].to(d1.dtype)
        y, z = (unit_rays(d) for d in (d1 @ R.mT, d2))
        across = (y * z).sum(-1) - (y * up).sum(-1) * (z * up).sum(-1)
        around = (torch.linalg.cross(y, z, dim=-1) * up).sum(-1)
        angle = torch.atan2(*(torch.where(inliers, part, 0).sum(-1) for part in (around, across)))
        return rotation_from_rotvec(angle[..., None] * up[..., 0, :]) @ R


def estimate_upright(
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    gravity1: Float[Tensor, "*#batch 3"],
    gravity2: Float[Tensor, "*#batch 3"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 4"]]:
    """The relative pose of each pair of calibrated cameras that know the vertical, from rays of which many may be wrong.

    As `estimate_essential`, with samples of three rays: fewer of them are needed. R is exact about the vertical only as far as
    the two directions are; free it afterwards by `RelativePoseEstimator.refine` on the inliers where they are not.

    Args:
        d1: Rays of the first camera, of any length, pointing to the points.
        d2: The corresponding rays of the second camera.
        gravity1: The vertical in the first camera, of any length.
        gravity2: The vertical in the second camera.
        threshold: Largest Sampson distance of an inlier in radians, at most 0.1: pixels divided by the focal length.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        [R | t] with |t| = 1; inliers, support, iterations, status (NOT_FINITE also where a vertical has no direction;
        NO_CONSENSUS also where a pose that is more than 0.03 radians off the verticals fits the rays clearly better),
        degeneracy (ROTATION: a rotation relates all inliers but so few as chance explains, and t means nothing; COLLINEAR: so
        many are on a line in an image, and several poses fit), covariance (12 x 12, of rank 3). The pose carries its
        derivatives with respect to the inliers and the verticals (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit, or rays or threshold are in pixels.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, t = torchsfm.random_points(200, generator=g), torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
        >>> R = torchsfm.geometry.rotation_from_rotvec(torch.tensor([0.0, 0.5, 0.0], dtype=t.dtype))  # about the vertical
        >>> down = torch.tensor([0.0, 1.0, 0.0], dtype=t.dtype)
        >>> d1 = X + 5 * t
        >>> found = torchsfm.estimate_upright(d1, d1 @ R.mT + t, down, down, threshold=1e-3, generator=g)
        >>> bool(found.model.allclose(torchsfm.Pose(R, t).matrix(), atol=1e-6))
        True
    """
    batch = check_door(
        {"d1": (d1, "n 3"), "d2": (d2, "n 3"), "gravity1": (gravity1, "3"), "gravity2": (gravity2, "3")},
        threshold,
        options,
        radians=True,
    )
    up1, up2 = (unit_rays(g[..., None, :])[..., 0, :].expand(*batch, 3) for g in (gravity1, gravity2))
    known = torch.isfinite(up1 + up2).all(-1)[..., None]
    down = torch.eye(3, dtype=up1.dtype, device=up1.device)[2]
    up1, up2 = (torch.where(known, up, down) for up in (up1, up2))
    estimator = UprightPoseEstimator(up1, up2, pose_slack(threshold, d1).expand(batch))
    # Without verticals there are no data either.
    rays1 = torch.where(known[..., None], unit_rays(d1), torch.nan)
    rays2 = unit_rays(d2)
    found = estimate_robustly(estimator, rays1, rays2, threshold=threshold, dtype=d1.dtype, **options)
    counted = torch.isfinite(rays1).all(-1) & torch.isfinite(rays2).all(-1)
    for given in (options.get("mask"), options.get("weights")):
        counted = counted if given is None else counted & (given > 0)
    (rows,) = (found.status.flatten() == Status.OK).nonzero(as_tuple=True)

    def of_good(t: Tensor, dims: int) -> Tensor:
        """Those of the problems that have a pose."""
        t = t.detach().expand((*batch, *t.shape[t.ndim - dims :]))
        return t.reshape(batch.numel(), *t.shape[len(batch) :])[rows]

    with torch.no_grad():
        wrong = contradicts_verticals(
            of_good(found.model.double(), 2), of_good(rays1.nan_to_num(0, 0, 0), 2), of_good(rays2.nan_to_num(0, 0, 0), 2),
            of_good(up1, 1), of_good(up2, 1), of_good(counted, 1), of_good(found.threshold.double(), 0),
            of_good(estimator.slack, 0),
        )  # fmt: skip
    status = found.status.flatten().index_copy(0, rows, wrong.to(found.status.dtype) * int(Status.NO_CONSENSUS))
    return replace(found, status=status.view(found.status.shape))
