"""How well the images of a bundle determine its cameras' intrinsics, without the covariance of everything else."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.bundle.blocks import Bundle
from torchsfm.bundle.intrinsics import intrinsics_prior
from torchsfm.geometry import Camera, Pose
from torchsfm.optim import Loss, marginal_covariance


def intrinsics_covariance(
    poses: Pose,
    cameras: Camera,
    X: Float[Tensor, "n 3"],
    x: Float[Tensor, "m 2"],
    view: Int[Tensor, "m"],
    point: Int[Tensor, "m"],
    *,
    camera_index: Int[Tensor, "v"] | None = None,
    free: Sequence[str] = ("focal",),
    fixed_intrinsics: Mapping[str, Bool[Tensor, "g"]] | None = None,
    loss: Loss | None = None,
    intrinsics_sigma: Mapping[str, float | Tensor] | None = None,
    intrinsics_mean: Camera | None = None,
) -> Float[Tensor, "g k k"]:
    """Compute the covariance of each camera's free intrinsics, by the arguments of `bundle_adjust` at its result.

    Poses and points are free, and no gauge matters. It costs about a step of the adjustment, where `bundle_covariance` costs
    many.

    Returns:
        Covariances in the order focal (pixels along x), aspect, skew, principal point, distortion, for noise of one pixel in
        each image coordinate; zero where a number is held, very large or NaN where nothing determines it.

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.
    """
    bundle = Bundle(
        poses, cameras, X, x, view, point, camera_index, free, None, None, None, None, fixed_intrinsics, None, None, loss, ()
    )
    with torch.no_grad():
        blocks, terms = bundle.problem()
        check_options(intrinsics_sigma=(intrinsics_sigma, Mapping | None))
        if intrinsics_sigma:
            terms.append(intrinsics_prior(intrinsics_sigma, cameras if intrinsics_mean is None else intrinsics_mean))
        return marginal_covariance(blocks, terms, "camera", eliminate="point")
