"""The covariance of a bundle: how well poses, cameras and points are known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.bundle.blocks import Bundle
from torchsfm.bundle.intrinsics import intrinsics_prior
from torchsfm.bundle.priors import Prior
from torchsfm.bundle.rig import Rig
from torchsfm.geometry import Camera, Pose
from torchsfm.optim import Loss, SparseCovariance, sparse_covariance


@dataclass(frozen=True)
class BundleCovariance:
    """Covariances of each pose, camera and point by itself.

    `poses` is in the coordinates of `Pose.retract`, (w, v): radians and the unit of the world, in the camera's frame; `cameras`
    in the free intrinsics in the order focal (pixels along x), aspect, skew, principal point, distortion; `X` in the world.
    Fixed ones are zero; those that are not determined have an infinite diagonal. `sigma` is the standard deviation of an image
    coordinate, given or estimated. `nullity` is the dimension of the free gauge: 7 without anything fixed. More means that
    something else is not determined either. `everything` is the engine's own result, with cross-covariances, for sigma = 1.
    """

    poses: Float[Tensor, "f 6 6"]
    cameras: Float[Tensor, "g k k"]
    X: Float[Tensor, "n 3 3"]
    determined_points: Bool[Tensor, "n"]
    sigma: float
    nullity: int
    everything: SparseCovariance
    sensors: Float[Tensor, "s 6 6"] | None = None
    """Of each place on the rig, (w, v), where there is a rig."""


def bundle_covariance(
    poses: Pose,
    cameras: Camera,
    X: Float[Tensor, "n 3"],
    x: Float[Tensor, "m 2"],
    view: Int[Tensor, "m"],
    point: Int[Tensor, "m"],
    *,
    camera_index: Int[Tensor, "v"] | None = None,
    free: Sequence[str] = ("focal",),
    fixed_poses: Bool[Tensor, "f"] | None = None,
    fixed_points: Bool[Tensor, "n"] | None = None,
    fixed_cameras: Bool[Tensor, "g"] | None = None,
    fixed_intrinsics: Mapping[str, Bool[Tensor, "g"]] | None = None,
    rig: Rig | None = None,
    fixed_sensors: Bool[Tensor, "k"] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    loss: Loss | None = None,
    priors: Sequence[Prior] = (),
    intrinsics_sigma: Mapping[str, float | Tensor] | None = None,
    intrinsics_mean: Camera | None = None,
    sigma: float | None = None,
) -> BundleCovariance:
    """Compute the covariance of an adjusted bundle, by the arguments of `bundle_adjust` at its result.

    With a free gauge, the covariance is that in the gauge in which the cameras move least: a spread of shape, not of place.

    Args:
        poses: Adjusted poses, batch (v,).
        cameras: Adjusted cameras, batch (g,).
        X: Adjusted points.
        x: Observations, pixels.
        view: Which view made each observation.
        point: Which point it shows.
        camera_index: Which camera took each view, as in `bundle_adjust`.
        free: What was optimised in the cameras.
        fixed_poses: Views that did not move.
        fixed_points: Points that did not move.
        fixed_cameras: Cameras that did not change.
        fixed_intrinsics: By names as in `free`, cameras in which these did not change.
        rig: The adjusted rig.
        fixed_sensors: Sensors whose place on the rig did not change.
        weights: Weights of the observations, inverse variances up to `sigma`.
        loss: The robust loss; observations count by its slope.
        priors: What was known of poses and points. Their covariances count in the unit of the observations, as in
            `bundle_adjust`: where `sigma` is not 1, all of them grow by its square.
        intrinsics_sigma: What was known of intrinsics, as in `bundle_adjust`; in the unit of the observations like `priors`.
        intrinsics_mean: Its means, which the covariance does not depend on but by the scale of focal lengths.
        sigma: Standard deviation of an image coordinate of weight 1, pixels; estimated from the residuals if not given.

    Returns:
        The covariances, float64.

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.
    """
    bundle = Bundle(
        poses, cameras, X, x, view, point, camera_index, free, rig, fixed_poses, fixed_points, fixed_cameras,
        fixed_intrinsics, fixed_sensors, weights, loss, priors,
    )  # fmt: skip
    check_options(sigma=(sigma, "?float > 0"), intrinsics_sigma=(intrinsics_sigma, Mapping | None))
    with torch.no_grad():
        blocks, terms = bundle.problem()
        if intrinsics_sigma:
            terms.append(intrinsics_prior(intrinsics_sigma, cameras if intrinsics_mean is None else intrinsics_mean))
        unit = sparse_covariance(blocks, terms, eliminate="point")
    scale = sigma if sigma is not None else (unit.square_sum / max(unit.redundancy, 1)) ** 0.5
    pose, camera, points = (unit.blocks[name] * scale**2 for name in ("pose", "camera", "point"))
    sensor = None if rig is None else unit.blocks["sensor"] * scale**2
    held = 0
    if fixed_intrinsics and camera.shape[-1]:
        # Those held in one camera but not in others stand in the system as directions that nothing determines.
        switch = blocks["camera"].x[:, -camera.shape[-1] :] > 0
        camera = torch.where(switch[:, :, None] & switch[:, None], camera, 0.0)
        held = int((~switch & (unit.columns["camera"] >= 0)).sum())
    return BundleCovariance(pose, camera, points, unit.determined["point"], scale, unit.nullity - held, unit, sensor)
