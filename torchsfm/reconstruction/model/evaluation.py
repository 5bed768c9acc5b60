"""How good is a reconstruction whose true poses are known?

A reconstruction from images has an arbitrary frame and scale. Relative poses between pairs of images do not depend on them and
give the errors that `pose_auc` sums up; positions are compared after a similarity has carried the one frame onto the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Pose, Similarity, similarity_from_points
from torchsfm.linalg import nearest_rotation, svdvals
from torchsfm.reconstruction.model.reconstruction import Reconstruction

COLLINEAR = 1e-3
"""Camera centres this much thinner than long (ratio of standard deviations) do not fix the rotation about their line."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated poses against true ones; infinite where an image is not registered.

    Attributes:
        pair: The two images of each pair, `i < j`, in the order of `torch.combinations`.
        rotation: Angle between estimated and true relative rotation of each pair, degrees.
        direction: Angle between estimated and true direction of the relative translation of each pair, degrees; zero where
            the true centres coincide and there is no direction to find.
        image_rotation: Angle of each image's rotation error after one common rotation of the world (the mean of all), degrees.
        image_position: Distance of each camera centre from its true place after a common similarity, in the truth's unit.
    """

    pair: Int[Tensor, "p 2"]
    rotation: Float[Tensor, "*batch p"]
    direction: Float[Tensor, "*batch p"]
    image_rotation: Float[Tensor, "*batch v"]
    image_position: Float[Tensor, "*batch v"]

    @property
    def pose(self) -> Float[Tensor, "*batch p"]:
        """The larger of rotation and direction error of each pair, degrees: what `pose_auc` wants."""
        return torch.maximum(self.rotation, self.direction)


def align_poses(poses: Pose, poses_true: Pose, registered: Bool[Tensor, "*batch v"] | None = None) -> Similarity:
    """The similarity that carries the estimated world onto the true one: Umeyama's over the registered camera centres.

    Where the centres are collinear, or fewer than three, they leave the rotation open; it is then the mean of the rotations
    that carry each estimated orientation onto the true one.

    Args:
        poses: Estimated poses of the views, cam_from_world; anything where not registered.
        poses_true: True poses of the same views.
        registered: Which views count; all where not given.

    Returns:
        `true_from_estimated`, with `X_true ~ scale R X + t`. One registered view leaves the scale at Umeyama's choice; none
        gives the identity rotation.
    """
    weights = _weights(poses, registered)
    source, target = poses.centre, poses_true.centre
    umeyama = similarity_from_points(source, target, weights)
    R = _mean_rotation(poses, poses_true, weights)

    # With the rotation given, Umeyama's scale is the ratio of the covariance along it to the source's variance.
    total = weights.sum(-1).clamp(min=1)[..., None]
    centroid, centroid_true = ((weights[..., None] * c).sum(-2) / total for c in (source, target))
    spread = weights[..., None] * (source - centroid[..., None, :])
    spread_true = weights[..., None] * (target - centroid_true[..., None, :])
    variance = spread.square().sum((-2, -1))
    scale = (spread_true * (spread @ R.mT)).sum((-2, -1)) / torch.where(variance > 0, variance, 1)
    scale = torch.where(scale > 0, scale, 1)

    singular, _ = svdvals(spread_true)
    width = singular[..., 1] if singular.shape[-1] > 1 else torch.zeros_like(singular[..., 0])
    by_points = (width > COLLINEAR * singular[..., 0]) & (weights.sum(-1) >= 3)
    R = torch.where(by_points[..., None, None], umeyama.R, R)
    scale = torch.where(by_points, umeyama.scale, scale)
    t = centroid_true - scale[..., None] * (R @ centroid[..., None])[..., 0]
    return Similarity(scale, R, t)


def align_reconstruction(reconstruction: Reconstruction, poses_true: Pose) -> Reconstruction:
    """Carry a reconstruction into the frame, scale and unit of the true poses.

    Args:
        reconstruction: What was estimated.
        poses_true: True poses (cam_from_world) of all its images, in the order of its names; anything where not registered.

    Returns:
        The same reconstruction after the similarity of `align_poses`.
    """
    return reconstruction.transform(align_poses(reconstruction.poses, poses_true, reconstruction.registered))


def pose_errors(poses: Pose, poses_true: Pose, registered: Bool[Tensor, "*batch v"] | None = None) -> PoseErrors:
    """Compare estimated poses with true ones: every pair of images by itself, and every image after alignment.

    Args:
        poses: Estimated poses of the views, cam_from_world, in any frame and scale; anything where not registered.
        poses_true: True poses of the same views.
        registered: Which views have an estimate; all where not given.

    Returns:
        The errors, infinite for images that are not registered and for their pairs.
    """
    weights = _weights(poses, registered)
    known = weights > 0
    views = weights.shape[-1]
    pair = torch.combinations(torch.arange(views, device=weights.device), 2).reshape(-1, 2)
    i, j = pair.unbind(-1)

    def relative(p: Pose) -> tuple[Tensor, Tensor]:
        R = p.R[..., j, :, :] @ p.R[..., i, :, :].mT
        return R, p.t[..., j, :] - (R @ p.t[..., i, :, None])[..., 0]

    (R, t), (R_true, t_true) = relative(poses), relative(poses_true)
    infinite = weights.new_full((), torch.inf)
    both = known[..., i] & known[..., j]
    spread = poses_true.centre - poses_true.centre[..., :1, :]
    no_baseline = t_true.norm(dim=-1) <= 1e-9 * spread.norm(dim=-1).amax(-1, keepdim=True)
    direction = torch.where(no_baseline, 0, _angle_between(t, t_true))

    similarity = align_poses(poses, poses_true, registered)
    position = (similarity.transform(poses.centre) - poses_true.centre).norm(dim=-1)
    mean = _mean_rotation(poses, poses_true, weights)
    turned = poses.R @ mean[..., None, :, :].mT @ poses_true.R.mT
    return PoseErrors(
        pair,
        torch.where(both, _angle(R @ R_true.mT), infinite),
        torch.where(both, direction, infinite),
        torch.where(known, _angle(turned), infinite),
        torch.where(known, position, infinite),
    )


def pose_auc(
    errors: Float[Tensor, "*batch p"], thresholds: Sequence[float] = (1.0, 2.0, 5.0)
) -> Float[Tensor, "*batch thresholds"]:
    """Area under the cumulative curve of pose errors up to each threshold, as a share of the largest area possible.

    The curve is drawn as the image matching benchmarks draw it: straight lines through (0, 0) and (e_k, k / p) for the errors
    sorted, level from the last error below the threshold to the threshold.

    Args:
        errors: One error per image pair, in the thresholds' unit; inf where there is no pose.
        thresholds: Where to cut the curve.

    Returns:
        One number in [0, 1] per threshold, 1 where all errors are zero; 0 where there are no pairs.

    Source:
        Sarlin et al., SuperGlue, CVPR 2020, section 5.2; Jin et al., Image Matching across Wide Baselines, IJCV 2021.
    """
    count = errors.shape[-1]
    if count == 0:
        return errors.new_zeros((*errors.shape[:-1], len(thresholds)))
    ordered = errors.sort(dim=-1).values
    before = torch.cat([torch.zeros_like(ordered[..., :1]), ordered[..., :-1]], -1)
    middle = (torch.arange(count, dtype=errors.dtype, device=errors.device) + 0.5) / count
    areas = []
    for threshold in thresholds:
        below = ordered < threshold
        rising = torch.where(below, middle * (ordered - before), 0).sum(-1)
        last = torch.where(below, ordered, 0).amax(-1)
        areas.append((rising + (threshold - last) * below.sum(-1) / count) / threshold)
    return torch.stack(areas, -1)


def position_rmse(poses: Pose, poses_true: Pose, registered: Bool[Tensor, "*batch v"] | None = None) -> Float[Tensor, "*batch"]:
    """Root mean square distance of the registered camera centres from the true ones after alignment, in the truth's unit.

    Args:
        poses: Estimated poses of the views, cam_from_world; anything where not registered.
        poses_true: True poses of the same views.
        registered: Which views count; all where not given. Report their number beside this figure.

    Returns:
        The error; inf where no view is registered.
    """
    position = pose_errors(poses, poses_true, registered).image_position
    known = torch.isfinite(position)
    total = torch.where(known, position, 0).square().sum(-1)
    count = known.sum(-1)
    return torch.where(count > 0, (total / count.clamp(min=1)).sqrt(), torch.inf)


def _weights(poses: Pose, registered: Tensor | None) -> Tensor:
    weights = torch.ones_like(poses.t[..., 0])
    return weights if registered is None else weights * registered.to(weights)


def _mean_rotation(poses: Pose, poses_true: Pose, weights: Tensor) -> Tensor:
    """The rotation of the world that best carries estimated orientations onto true ones, in the chordal mean."""
    each = weights[..., None, None] * (poses_true.R.mT @ poses.R)
    total = each.sum(-3)
    none = (weights.sum(-1) == 0)[..., None, None]
    return nearest_rotation(torch.where(none, torch.eye(3, dtype=total.dtype, device=total.device), total))


def _angle(R: Tensor) -> Tensor:
    """Rotation angle in degrees, exact for small angles too (the arc cosine of the trace is not)."""
    skew = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(skew.norm(dim=-1), trace - 1).rad2deg()


def _angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Angle between vectors in degrees; 90 where the first has no length and so no direction."""
    cross = torch.linalg.cross(a, b)
    dot = (a * b).sum(-1)
    return torch.where(a.norm(dim=-1) > 0, torch.atan2(cross.norm(dim=-1), dot).rad2deg(), 90)
