"""Which way the camera moved, as far as that decides what autocalibration can find.

Critical motions (Sturm, "Critical motion sequences for monocular self-calibration", CVPR 1997; Kahl, Triggs & Astrom, "Critical
motions for auto-calibration when some intrinsic parameters can vary", JMIV 2000) leave some intrinsics undetermined however
good the data are. The measures here are of the metric cameras found; which intrinsics suffer is told by the information of the
data.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry import rotvec_from_rotation
from torchsfm.linalg import eigh

SMALL_ANGLE = 0.03
"""Angle in radians below which a rotation, or its part off the common axis, counts as none."""
SMALL_TURN = 0.2
"""The same for the part off the common axis, over the whole: noise tilts large rotations by more."""
SMALL_SPREAD = 0.05
"""Ratio of lengths below which centres count as on a line or in a plane, and axes as meeting in a point."""


@dataclass(frozen=True)
class Motion:
    """How the cameras moved. Angles in radians, lengths as ratios; flags say where a measure is small.

    Example:
        >>> import torch, torchsfm
        >>> poses = torchsfm.simulation.orbit_poses(8, height=(1.0, 1.0))  # around a point on a circle
        >>> moved = torch.ones(8, dtype=torch.bool)
        >>> motion = torchsfm.autocalibration.diagnose_motion(poses.R, poses.centre, moved)
        >>> bool(motion.planar), bool(motion.one_axis), bool(motion.collinear)  # all turns are about the normal of one plane
        (True, True, False)
        >>> bool(motion.critical)
        True
    """

    rotation: Float[Tensor, "*batch"]
    """Root mean square angle of the views' rotations about their mean."""
    off_axis: Float[Tensor, "*batch"]
    """Its part off the best common axis."""
    line: Float[Tensor, "*batch"]
    """Distance of the centres from their best line, over their extent along it (root mean squares)."""
    plane: Float[Tensor, "*batch"]
    """Distance of the centres from their best plane, over their largest extent."""
    across_axis: Float[Tensor, "*batch"]
    """Sine of the angle between the common axis of rotation and the normal of that plane."""
    fixation: Float[Tensor, "*batch"]
    """Distance of the optical axes from the point nearest to all, over the centres' mean distance from it."""
    distance: Float[Tensor, "*batch"]
    """Spread of the centres' distances from that point, over their mean."""

    @property
    def translation(self) -> Bool[Tensor, "*batch"]:
        """No rotation to speak of: the images say nothing of K but through its change."""
        return self.rotation < SMALL_ANGLE

    @property
    def one_axis(self) -> Bool[Tensor, "*batch"]:
        """All rotations about one direction."""
        return ~self.translation & (self.off_axis < (SMALL_TURN * self.rotation).clamp_min(SMALL_ANGLE))

    @property
    def collinear(self) -> Bool[Tensor, "*batch"]:
        """All centres on a line."""
        return self.line < SMALL_SPREAD

    @property
    def planar(self) -> Bool[Tensor, "*batch"]:
        """All centres in a plane, all rotations about its normal."""
        return self.one_axis & (self.plane < SMALL_SPREAD) & (self.collinear | (self.across_axis < 0.1))

    @property
    def orbital(self) -> Bool[Tensor, "*batch"]:
        """All optical axes through one point, all centres at one distance from it."""
        return (self.fixation < SMALL_SPREAD) & (self.distance < SMALL_SPREAD)

    @property
    def critical(self) -> Bool[Tensor, "*batch"]:
        """Any of these."""
        return self.translation | self.one_axis | self.collinear | self.orbital


def diagnose_motion(
    R: Float[Tensor, "*batch v 3 3"], centre: Float[Tensor, "*batch v 3"], present: Bool[Tensor, "*batch v"]
) -> Motion:
    """Measure how near metric cameras are to critical motions.

    Args:
        R: Rotations, camera from world.
        centre: Camera centres.
        present: Views that take part.

    Returns:
        The measures; 0 where no view takes part.

    Example:
        >>> import torch, torchsfm
        >>> poses = torchsfm.simulation.orbit_poses(8, height=(1.0, 1.0))  # around a point on a circle
        >>> motion = torchsfm.autocalibration.diagnose_motion(poses.R, poses.centre, torch.ones(8, dtype=torch.bool))
        >>> bool(motion.orbital), bool(motion.translation)
        (True, False)
    """
    check_tensors(R=(R, "v>=1 3 3"), centre=(centre, "v 3"), present=(present, "v: bool"))
    w = present.to(R.dtype)[..., None]
    number = w.sum(-2).clamp_min(1)
    first = torch.nn.functional.one_hot(present.long().argmax(-1), R.shape[-3]).to(R.dtype)
    base = (first[..., None, None] * R).sum(-3, keepdim=True)
    turn = rotvec_from_rotation(R @ base.mT) * w
    # About the mean: without it the first view's own place would count twice.
    turn = (turn - turn.sum(-2, keepdim=True) / number[..., None]) * w
    values, axes = _axes(turn, number)
    off_axis = (values[..., 0] + values[..., 1]).clamp_min(0).sqrt()
    rotation = values.sum(-1).clamp_min(0).sqrt()
    # The axis in the world: rotations act from the left, in the first view's frame.
    axis = (base[..., 0, :, :].mT @ axes[..., :, 2:])[..., 0]

    centred = (centre - (centre * w).sum(-2, keepdim=True) / number[..., None]) * w
    spread, directions = _axes(centred, number)
    spread = spread.clamp_min(0)
    extent = spread[..., 2].clamp_min(1e-300).sqrt()
    some = spread[..., 2] > 0
    line = torch.where(some, (spread[..., 0] + spread[..., 1]).sqrt() / extent, 0.0)
    plane = torch.where(some, spread[..., 0].sqrt() / extent, 0.0)
    across = (1 - (axis * directions[..., :, 0]).sum(-1).square()).clamp_min(0).sqrt()

    z = R[..., 2, :]
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    off = (eye - z[..., :, None] * z[..., None, :]) * w[..., None]
    A = off.sum(-3)
    A = A + 1e-9 * number[..., None] * eye
    point = torch.linalg.solve_ex(A, (off @ centre[..., None]).sum(-3)).result[..., 0]
    point = torch.nan_to_num(point)
    to_point = (point[..., None, :] - centre) * w
    length = to_point.norm(dim=-1)
    mean = length.sum(-1) / number[..., 0]
    safe = mean.clamp_min(1e-300)
    fixation = ((off @ to_point[..., None])[..., 0].square().sum((-2, -1)) / number[..., 0]).sqrt() / safe
    distance = (((length - mean[..., None]) * w[..., 0]).square().sum(-1) / number[..., 0]).sqrt() / safe
    return Motion(rotation, off_axis, line, plane, across, fixation, distance)


def _axes(rows: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
    """Mean squares along the principal axes of rows, ascending, and the axes as columns."""
    moments = torch.nan_to_num(rows.mT @ rows / number[..., None], 0.0, 0.0, 0.0)
    values, vectors, _ = eigh(moments)
    return values, vectors
