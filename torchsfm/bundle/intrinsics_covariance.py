"""How well the images of a bundle determine its cameras' intrinsics, without the covariance of everything else."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.bundle.blocks import Bundle
from torchsfm.bundle.priors import Prior
from torchsfm.geometry import BundleProblem, Camera
from torchsfm.optim import Loss, marginal_covariance


def intrinsics_covariance(
    problem: BundleProblem,
    *,
    free: Sequence[str] = ("focal",),
    fixed_intrinsics: Mapping[str, Bool[Tensor, "g"]] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    loss: Loss | None = None,
    intrinsics_sigma: Mapping[str, float | Tensor] | None = None,
    intrinsics_mean: Camera | None = None,
    priors: Sequence[Prior] = (),
) -> Float[Tensor, "g k k"]:
    """Compute the covariance of each camera's free intrinsics, by the arguments of `bundle_adjust` at its result.

    Poses and points are free, and no gauge matters. It costs about a step of the adjustment, where `bundle_covariance` costs
    many.

    Args:
        problem: The result of the adjustment with its observations.
        free: The intrinsics that were free, by name.
        fixed_intrinsics: By names as in `free`, cameras in which these were held.
        weights: The weight of each observation's squared distance.
        loss: The robust loss, squares if not given.
        intrinsics_sigma: Standard deviations of the priors on intrinsics, by names as in `free`.
        intrinsics_mean: Where these were centred; the cameras of the problem if not given.
        priors: What else is known of poses, points and cameras.

    Returns:
        Covariances in the order focal (pixels along x), aspect, skew, principal point, distortion, for noise of one pixel in
        each image coordinate; zero where a number is held, very large or NaN where nothing determines it.

    Raises:
        ValueError: Shapes, dtypes, indices or names do not fit.

    Example:
        >>> import torch, torchsfm
        >>> truth = torchsfm.random_bundle_problem(4, 50, 150, generator=torch.Generator().manual_seed(0)).truth
        >>> torchsfm.bundle.intrinsics_covariance(truth, free=("focal", "k1")).shape  # of four cameras
        torch.Size([4, 2, 2])
    """
    bundle = Bundle(
        problem, free=free, fixed_intrinsics=fixed_intrinsics, weights=weights, loss=loss,
        intrinsics_sigma=intrinsics_sigma, intrinsics_mean=intrinsics_mean, priors=priors,
    )  # fmt: skip
    with torch.no_grad():
        blocks, terms = bundle.problem()
        return marginal_covariance(blocks, terms, "camera", eliminate="point")
