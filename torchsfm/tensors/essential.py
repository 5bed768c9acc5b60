"""Two calibrated views: the essential matrix, the pose it comes from and the poses it allows, and F where both K are known.

Throughout `x2' F x1 = 0`, and the second camera is `d2 ~ R d1 + t`, so that `E = [t]x R`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, Status, check_options, check_tensors
from torchsfm.geometry.poses import Pose
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import adjugate_3x3, cross, determinant_3x3, nearest_rank, nearest_rotation


@dataclass(frozen=True)
class RelativePose:
    """The pose of a second camera relative to a first, `d2 ~ R d1 + t`, up to the length of the baseline.

    `model` is [R | t] with |t| = 1. `in_front` says which rays meet in front of both cameras or at infinity ahead of them.
    `status` is OK, TOO_FEW (no finite ray has weight), BEHIND (half of the weight or less is in front), DEGENERATE (E has rank
    below 2) or NOT_FINITE (E is not finite).

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(20, generator=torch.Generator().manual_seed(0)) + torch.tensor([0, 0, 5])
        >>> R, t = torch.eye(3, dtype=X.dtype), torch.tensor([0.6, 0.0, 0.8], dtype=X.dtype)
        >>> E = torchsfm.tensors.essential_from_pose(R, t)
        >>> found = torchsfm.tensors.pose_from_essential(E, X, X @ R.mT + t)
        >>> bool(found.pose.centre.allclose(-t)), found.model.shape, int(found.in_front.sum())
        (True, torch.Size([3, 4]), 20)
    """

    model: Float[Tensor, "*batch 3 4"]
    in_front: Bool[Tensor, "*batch n"]
    status: Int[Tensor, "*batch"]

    @property
    def pose(self) -> Pose:
        """The model as a `Pose`, `cam2_from_cam1`."""
        return Pose.from_matrix(self.model)


def essential_from_pose(R: Float[Tensor, "*#batch 3 3"], t: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The essential matrix E = [t]x R of a second camera `d2 ~ R d1 + t`.

    Args:
        R: Rotation of the second camera relative to the first.
        t: Translation; its length is kept, |E|^2 = 2 |t|^2. Zero gives the zero matrix.

    Returns:
        E with d2' E d1 = 0.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.tensors.essential_from_pose(torch.eye(3), torch.tensor([0.0, 0.0, 1.0]))  # straight ahead
        tensor([[ 0., -1.,  0.],
                [ 1.,  0.,  0.],
                [ 0.,  0.,  0.]])
    """
    check_tensors(R=(R, "3 3"), t=(t, "3"))
    return cross_matrix(t) @ R


def poses_from_essential(E: Float[Tensor, "*batch 3 3"]) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
    """The four second cameras [R | t] with |t| = 1 whose essential matrix is E up to sign and scale (HZ 9.6.2).

    In closed form, R = (cof E -+ [t]x E) / |t|^2 (Horn 1990), after E is brought to rank 2. Where E is not an essential matrix
    (its two large singular values differ), the four are those of the essential matrix nearest to E, as by SVD.

    Args:
        E: Essential matrices of any scale.

    Returns:
        Four slots (Ra, t), (Ra, -t), (Rb, t), (Rb, -t). All are valid, or none where E has rank below 2 or is not finite.
        Differentiable.

    Example:
        >>> import torch, torchsfm
        >>> E = torchsfm.tensors.essential_from_pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))
        >>> poses = torchsfm.tensors.poses_from_essential(E)
        >>> poses.model.shape, poses.valid
        (torch.Size([4, 3, 4]), tensor([True, True, True, True]))
    """
    check_tensors(E=(E, "3 3"))
    finite = torch.isfinite(E).all(-1).all(-1)
    largest = torch.where(finite[..., None, None], E, 0).detach().abs().amax((-2, -1))
    good = finite & (largest > 0)
    # Stands in where there is nothing to decompose: [e3]x.
    dummy = cross_matrix(torch.tensor([0.0, 0.0, 1.0], dtype=E.dtype, device=E.device))
    scaled = torch.where(good[..., None, None], E, dummy) / torch.where(good, largest, 1)[..., None, None]
    scaled = nearest_rank(scaled, 2)
    # cof E = t (R't)': its columns are multiples of t.
    cofactors = adjugate_3x3(scaled).mT
    lengths = (cofactors * cofactors).sum(-2)
    longest, best = lengths.detach().max(-1)
    good = good & (longest > (256 * torch.finfo(E.dtype).eps) ** 2)
    scaled = torch.where(good[..., None, None], scaled, dummy)
    cofactors = torch.where(good[..., None, None], cofactors, adjugate_3x3(dummy).mT)
    best = torch.where(good, best, 2)
    column = cofactors.gather(-1, best[..., None, None].expand(*best.shape, 3, 1))[..., 0]
    b = column / (column * column).sum(-1, keepdim=True).sqrt()
    length = (0.5 * (scaled * scaled).sum((-2, -1))).sqrt()[..., None, None]
    turned = length * (cross_matrix(b) @ scaled)
    R = nearest_rotation(torch.stack((cofactors - turned, cofactors + turned), -3))
    t = torch.stack((b, -b, b, -b), -2)
    model = torch.cat((R.repeat_interleave(2, -3), t[..., None]), -1)
    return Solutions(model, good[..., None].expand(*good.shape, 4))


def _parallax(model: Tensor, d1: Tensor, d2: Tensor) -> Tensor:
    """Sine of the angle between two rays that meet, with the sign of 'in front of both'; -1 if they look apart."""
    f1 = d1 @ model[..., :3].mT
    t = model[..., None, :, 3]
    normal = cross(f1, d2)
    sine = (normal * normal).sum(-1).sqrt()
    # Depths times the square of the sine: no division, no cancellation at small angles.
    depth1 = -(cross(t, d2) * normal).sum(-1)
    depth2 = -(cross(t, f1) * normal).sum(-1)
    ahead = (f1 * d2).sum(-1) > 0
    signed = torch.where((depth1 > 0) & (depth2 > 0), sine, -sine)
    return torch.where(ahead | (signed > 0), signed, -1)


def pose_from_essential(
    E: Float[Tensor, "*#batch 3 3"],
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    weights: Float[Tensor, "*#batch n"] | Bool[Tensor, "*#batch n"] | None = None,
    *,
    parallax: float = 1e-4,
) -> RelativePose:
    """The one of the four poses of E that has the rays meet in front of both cameras.

    Each ray votes for a pose with its weight, and with less where the angle at which the two rays meet is below `parallax`: for
    a point far away noise decides on which side of the cameras the rays meet. Such a point counts as in front as long as both
    cameras look towards it.

    Args:
        E: Essential matrices of any scale.
        d1: Rays of the first camera, of any length. Rays that are not finite or zero do not vote.
        d2: Rays of the second camera.
        weights: Weights >= 0, or a mask; 0 or False means absent. None: all 1.
        parallax: Angle in radians below which a point may be infinitely far away: the noise of the rays.

    Returns:
        The pose, which rays are in front (absent ones never are), and the status. Differentiable in E.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(20, generator=torch.Generator().manual_seed(0)) + torch.tensor([0, 0, 5])
        >>> R, t = torch.eye(3, dtype=X.dtype), torch.tensor([0.6, 0.0, 0.8], dtype=X.dtype)
        >>> E = -torchsfm.tensors.essential_from_pose(R, t)  # of either sign
        >>> found = torchsfm.tensors.pose_from_essential(E, X, X @ R.mT + t)
        >>> found.pose.t, int(found.in_front.sum())
        (tensor([0.6000, 0.0000, 0.8000], dtype=torch.float64), 20)
    """
    kind = "?n: bool" if getattr(weights, "dtype", None) == torch.bool else "?n"
    check_options(parallax=(parallax, "0 <= float <= 0.1 radians"))
    batch = check_tensors(E=(E, "3 3"), d1=(d1, "n 3"), d2=(d2, "n 3"), weights=(weights, kind))
    shape = (*batch, d1.shape[-2])
    w = torch.ones_like(d1[..., 0]) if weights is None else weights.to(d1.dtype)
    rays, present = [], (w > 0) & torch.isfinite(w)
    for d in (d1.detach(), d2.detach()):
        largest = d.abs().amax(-1)
        present = present & (largest > 0) & torch.isfinite(largest)
        safe = torch.where(present[..., None], d, 1)
        safe = safe / safe.abs().amax(-1, keepdim=True)
        rays.append(safe / (safe * safe).sum(-1, keepdim=True).sqrt())
    present = present.expand(shape)
    w = torch.where(present, w, 0)
    poses = poses_from_essential(E)
    signed = _parallax(poses.model.detach(), rays[0][..., None, :, :], rays[1][..., None, :, :])
    votes = (w[..., None, :] * (signed / parallax).clamp(-1, 1)).sum(-1)
    best = votes.argmax(-1)
    models = poses.model.expand(*batch, 4, 3, 4)
    model = models.gather(-3, best[..., None, None, None].expand(*batch, 1, 3, 4)).squeeze(-3)
    chosen = signed.gather(-2, best[..., None, None].expand(*batch, 1, shape[-1])).squeeze(-2)
    in_front = (chosen > -parallax) & present
    status = torch.full(batch, Status.OK, dtype=torch.int8, device=E.device)
    ahead = torch.where(in_front, w, 0).sum(-1) > 0.5 * w.sum(-1)
    status = torch.where(ahead, status, Status.BEHIND)
    status = torch.where(present.any(-1), status, Status.TOO_FEW)
    status = torch.where(poses.valid[..., 0], status, Status.DEGENERATE)
    status = torch.where(torch.isfinite(E).all(-1).all(-1), status, Status.NOT_FINITE)
    return RelativePose(model, in_front & poses.valid[..., :1], status.to(torch.int8))


def _inverse(K: Tensor) -> Tensor:
    """The inverse, or the adjugate where there is none, so that the result is always finite for finite input."""
    det = determinant_3x3(K)
    good = det != 0
    return adjugate_3x3(K) / torch.where(good, det, 1)[..., None, None]


def fundamental_from_essential(
    E: Float[Tensor, "*#batch 3 3"], K1: Float[Tensor, "*#batch 3 3"], K2: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """F = K2^-T E K1^-1 (HZ 9.12), the scale as it comes.

    Args:
        E: Essential matrix.
        K1: Calibration matrix of the first camera.
        K2: Calibration matrix of the second camera. A singular K gives a meaningless finite result.

    Returns:
        F with x2' F x1 = 0 in pixels.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(500.0), torch.tensor([320.0, 240.0]))
        >>> E = torchsfm.tensors.essential_from_pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))
        >>> F = torchsfm.tensors.fundamental_from_essential(E, K, K)
        >>> torchsfm.geometry.epipolar_distance(F, torch.tensor([[100.0, 50.0]]), torch.tensor([[80.0, 53.0]]))  # pixels
        tensor([3.])
    """
    check_tensors(E=(E, "3 3"), K1=(K1, "3 3"), K2=(K2, "3 3"))
    return _inverse(K2).mT @ E @ _inverse(K1)


def essential_from_fundamental(
    F: Float[Tensor, "*#batch 3 3"], K1: Float[Tensor, "*#batch 3 3"], K2: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """E = K2' F K1 (HZ 9.12), the scale as it comes. Essential only as far as F and both K are right.

    Args:
        F: Fundamental matrix.
        K1: Calibration matrix of the first camera.
        K2: Calibration matrix of the second camera.

    Returns:
        E with d2' E d1 = 0.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(500.0), torch.tensor([320.0, 240.0]))
        >>> F = torchsfm.tensors.fundamental_from_pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]), K, K)
        >>> E = torchsfm.tensors.essential_from_fundamental(F, K, K)
        >>> torch.linalg.svdvals(E)  # two equal singular values, and a zero
        tensor([1.0000, 1.0000, 0.0000])
    """
    check_tensors(F=(F, "3 3"), K1=(K1, "3 3"), K2=(K2, "3 3"))
    return K2.mT @ F @ K1


def fundamental_from_pose(
    R: Float[Tensor, "*#batch 3 3"],
    t: Float[Tensor, "*#batch 3"],
    K1: Float[Tensor, "*#batch 3 3"],
    K2: Float[Tensor, "*#batch 3 3"],
) -> Float[Tensor, "*batch 3 3"]:
    """F of two calibrated cameras, `d2 ~ R d1 + t`: K2^-T [t]x R K1^-1.

    Args:
        R: Rotation of the second camera relative to the first.
        t: Translation, in any unit. Zero gives the zero matrix.
        K1: Calibration matrix of the first camera.
        K2: Calibration matrix of the second camera.

    Returns:
        F with x2' F x1 = 0 in pixels.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(500.0), torch.tensor([320.0, 240.0]))
        >>> F = torchsfm.tensors.fundamental_from_pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]), K, K)
        >>> torchsfm.geometry.epipolar_distance(F, torch.tensor([[100.0, 50.0]]), torch.tensor([[80.0, 53.0]]))  # pixels
        tensor([3.])
    """
    check_tensors(R=(R, "3 3"), t=(t, "3"), K1=(K1, "3 3"), K2=(K2, "3 3"))
    return fundamental_from_essential(essential_from_pose(R, t), K1, K2)


def poses_from_fundamental(
    F: Float[Tensor, "*#batch 3 3"], K1: Float[Tensor, "*#batch 3 3"], K2: Float[Tensor, "*#batch 3 3"]
) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
    """The four calibrated second cameras [R | t], |t| = 1, that F allows when both calibrations are known.

    Args:
        F: Fundamental matrix of any scale.
        K1: Calibration matrix of the first camera.
        K2: Calibration matrix of the second camera.

    Returns:
        Four slots as `poses_from_essential` returns them.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(500.0), torch.tensor([320.0, 240.0]))
        >>> F = torchsfm.tensors.fundamental_from_pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]), K, K)
        >>> poses = torchsfm.tensors.poses_from_fundamental(F, K, K)
        >>> poses.model[:, :, 3].abs()[0]  # of each t the first coordinate alone is not zero
        tensor([1., 0., 0.])
    """
    return poses_from_essential(essential_from_fundamental(F, K1, K2))
