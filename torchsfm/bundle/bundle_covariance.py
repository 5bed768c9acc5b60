"""The covariance of a bundle: how well poses, cameras and points are known."""

from dataclasses import dataclass
from typing import Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.bundle.blocks import Bundle, BundleTerms, structure_blocks
from torchsfm.geometry import BundleProblem
from torchsfm.optim import SparseCovariance, sparse_covariance


@dataclass(frozen=True)
class BundleCovariance:
    """Covariances of each pose, camera and point by itself.

    `poses` is in the coordinates of `Pose.retract`, (w, v): radians and the unit of the world, in the camera's frame; `cameras`
    in the free intrinsics in the order focal (pixels along x), aspect, skew, principal point, distortion; `X` in the world.
    Fixed ones are zero; those that are not determined have an infinite diagonal; `determined_points` says of which points that
    is not so. `sigma` is the standard deviation of an image coordinate, given or estimated. `nullity` is the dimension of the
    free gauge: 7 without anything fixed. More means that something else is not determined either. `everything` is the engine's
    own result, with cross-covariances, for sigma = 1.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.5, generator=g).problem
        >>> better = torchsfm.bundle_adjust_model(problem, free=()).model
        >>> found = torchsfm.bundle_covariance(better, free=())
        >>> found.nullity  # place, turn and size of the world, which no image tells
        7
        >>> deviation = found.X.diagonal(dim1=-2, dim2=-1).sqrt()  # of each point, in the unit of the world
        >>> deviation.shape, bool(found.determined_points.all())
        (torch.Size([50, 3]), True)
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
    structure: tuple[Float[Tensor, "_ _ _"], ...] = ()
    """Of what is seen besides points, in the order given, each in the coordinates its class names."""


def bundle_covariance(
    problem: BundleProblem,
    *,
    sigma: float | None = None,
    points: bool = True,
    joint: bool = True,
    **terms: Unpack[BundleTerms],
) -> BundleCovariance:
    """Compute the covariance of an adjusted bundle, by the arguments of `bundle_adjust` at its result.

    With a free gauge, the covariance is that in the gauge in which the cameras move least: a spread of shape, not of place.
    Weights are inverse variances up to `sigma`, and with a robust loss observations count by its slope. Priors on poses, points
    and intrinsics count in the unit of the observations, as in `bundle_adjust`: where `sigma` is not 1, their covariances grow
    by its square.

    Args:
        problem: Adjusted poses, cameras and points, and the observations.
        sigma: Standard deviation of an image coordinate of weight 1, pixels; estimated from the residuals if not given.
        points: Whether covariances of points (and of other structure) are wanted, which are most of the work. Without, theirs
            are not finite.
        joint: Whether `everything.joint` is wanted. Without it and points, films take time in proportion to their length.
        **terms: What was adjusted, held and known; see `BundleTerms`.

    Returns:
        The covariances, float64.

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.5, generator=g).problem
        >>> better = torchsfm.bundle_adjust_model(problem, free=("focal", "k1", "k2")).model
        >>> found = torchsfm.bundle_covariance(better, free=("focal", "k1", "k2"))
        >>> found.poses.shape, found.X.shape, bool(0.2 < found.sigma < 1)  # pixels
        (torch.Size([4, 6, 6]), torch.Size([50, 3, 3]), True)
    """
    check_options(sigma=(sigma, "?float > 0"), points=(points, bool), joint=(joint, bool))
    bundle = Bundle(problem, **terms)
    with torch.no_grad():
        blocks, residuals = bundle.problem()
        unit = sparse_covariance(blocks, residuals, eliminate=structure_blocks(bundle), of_eliminated=points, joint=joint)
    scale = sigma if sigma is not None else (unit.square_sum / max(unit.redundancy, 1)) ** 0.5
    pose, camera, X = (unit.blocks[name] * scale**2 for name in ("pose", "camera", "point"))
    sensor = None if bundle.rig is None else unit.blocks["sensor"] * scale**2
    structure = tuple(some.covariance(blocks[some.block].x, unit.blocks[some.block] * scale**2) for some in bundle.structure)
    held = 0
    if bundle.fixed_intrinsics and camera.shape[-1]:
        # Those held in one camera but not in others stand in the system as directions that nothing determines.
        switch = blocks["camera"].x[:, -camera.shape[-1] :] > 0
        camera = torch.where(switch[:, :, None] & switch[:, None], camera, 0.0)
        held = int((~switch & (unit.columns["camera"] >= 0)).sum())
    return BundleCovariance(pose, camera, X, unit.determined["point"], scale, unit.nullity - held, unit, sensor, structure)
