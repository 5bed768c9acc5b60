"""Bundle adjustment of a growing model, of all of it or of the neighbourhood of new images."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust
from torchsfm.bundle.bundle_adjust import BundleResult
from torchsfm.optim import Cauchy
from torchsfm.reconstruction.mapping.calibration import (
    ENOUGH,
    Free,
    as_expected,
    cameras_free,
    choose_free,
    folded_cameras,
    images_of_cameras,
    measure_noise,
    observation_weights,
)
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Adjustment, Mapping

NEIGHBOURS = 8
"""Images that move along with new ones in a local adjustment."""

LOSS = Cauchy(1.0)
"""The loss of reprojection errors in pixels."""
UNLIKELY = 3.0
"""Standard deviations beyond which what points lose by curves is not by chance."""
REWEIGHTED, WITHOUT, ROUGHLY = 4, 2, 1e-4
"""How often observations are weighed by what the adjustment before says of their tracks, and how often of these nearly without
tracks of two views; the tolerance of all but the last."""


def adjust(
    mapping: Mapping,
    *,
    free: Free | None = None,
    prior: CameraPrior | None = None,
    moving: Bool[Tensor, "v"] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-5,
    initial_damping: float = 1e-4,
) -> Mapping:
    """Minimise the robust reprojection error.

    Args:
        mapping: The model so far.
        free: Numbers of the cameras to adjust; none when None. Held in a local adjustment.
        prior: What to expect of the cameras before any image point was seen: wide enough to matter only where the images say
            little. Needed where something is free.
        moving: Images whose poses move; the points they see move with them, everything else is held. All images when None.
        weights: What the observations count, in their order, where all images move; all alike when None.
        max_iterations: Limit on the steps of the optimiser.
        tolerance: Relative decrease of the cost at which it stops.
        initial_damping: Of the first step; see `bundle_adjust`.
    """
    node = mapping.observations()
    fixed_poses = fixed_points = None
    if moving is not None:
        point = mapping.point[node]
        touched = torch.zeros(len(mapping.X), dtype=torch.bool)
        touched[point[moving[mapping.graph.view[node]]]] = True
        node = node[touched[point]]
        fixed_poses, fixed_points, free = ~moving, ~touched, None
    result = bundle_adjust(
        mapping.problem(node),
        fixed_poses=fixed_poses,
        fixed_points=fixed_points,
        weights=weights,
        loss=LOSS,
        max_iterations=max_iterations,
        tolerance=tolerance,
        initial_damping=initial_damping,
        **about_cameras(mapping, free, prior, weights),
    )
    adjusted = as_adjusted(mapping, result, free, prior)
    return adjusted if moving is None else replace(adjusted, adjustment=mapping.adjustment)


def adjust_all(
    mapping: Mapping,
    names: Sequence[str],
    prior: CameraPrior,
    *,
    faultless: int = 0,
    settled: bool = False,
    **limits: Any,
) -> Mapping:
    """Adjust everything, and of the cameras what the images determine; the rest is held where it was expected.

    A lens that comes out folded over was none: it is held as expected, too.

    Args:
        mapping: The model so far.
        names: Numbers of the cameras that may be estimated.
        prior: What is expected of the cameras.
        faultless: Cameras that took up to so many photographs count as those of many; see `choose_free`.
        settled: Whether the model has been adjusted so before, and has grown or hardly changed since. Where the images
            determined all numbers then, that is not found out again.
        **limits: When to stop; see `adjust`.
    """
    free = dict(mapping.adjustment.free) if settled and mapping.adjustment is not None else {}
    used = images_of_cameras(mapping) > 0
    if set(free) != set(names) or not all(bool(mask[used].all()) for mask in free.values()):
        free = choose_free(mapping, names, prior, loss=LOSS, faultless=faultless)
    adjusted = adjust(as_expected(mapping, free, prior), free=free, prior=prior, **limits)
    folded = folded_cameras(adjusted)
    if not bool(folded.any()):
        return adjusted
    folded = folded | prior.alike
    free |= {name: free[name] & ~folded for name in mapping.cameras.distortion.parameter_names if name in free}
    return adjust(as_expected(mapping, free, prior), free=free, prior=prior, **limits)


def adjust_by_tracks(mapping: Mapping, prior: CameraPrior, *, tolerance: float, **limits: Any) -> Mapping:
    """Adjust a finished model once more, observations counting by how well their tracks fit as a whole (`track_weights`).

    Not before it is finished: in a model that is still bent the longest tracks fit worst. And tracks of two views by how likely
    they are right, judged by cameras that longer ones have placed (`match_weights`).

    Args:
        mapping: The model. Of its cameras the same is free as in its last adjustment.
        prior: What is expected of the cameras.
        tolerance: Relative decrease of the cost at which the last adjustment stops.
        **limits: When else to stop; see `adjust`.
    """
    free = None if mapping.adjustment is None else mapping.adjustment.free
    for number, until in enumerate((ROUGHLY,) * (REWEIGHTED - 1) + (tolerance,)):
        weights = observation_weights(mapping, LOSS, enough=ENOUGH if number < WITHOUT else None)
        mapping = adjust(mapping, free=free, prior=prior, weights=weights, tolerance=until, **limits)
    return mapping


def as_adjusted(mapping: Mapping, result: BundleResult, free: Free | None, prior: CameraPrior | None) -> Mapping:
    """The model as `bundle_adjust` has left it, with one lens where all cameras are one.

    Raises:
        KeyboardInterrupt: The adjustment was interrupted: there is more to do than this.
    """
    if result.status == Status.INTERRUPTED:
        raise KeyboardInterrupt
    cameras = result.cameras
    if free and prior is not None:
        cameras = prior.made_alike(cameras, images_of_cameras(mapping) > 0)
    adjustment = Adjustment(result.status, result.iterations, free or {}, result.cost, result.initial_cost)
    return replace(mapping, poses=result.poses, cameras=cameras, X=result.X, adjustment=adjustment)


def about_cameras(
    mapping: Mapping, free: Free | None, prior: CameraPrior | None, weights: Float[Tensor, "m"] | None = None
) -> dict[str, Any]:
    """What is free in the cameras and expected of it, in the words of `bundle_adjust`."""
    if not free or prior is None:
        return {"free": ()}
    noise = measure_noise(mapping, LOSS, weights)
    return cameras_free(free) | prior.terms(noise, free, images_of_cameras(mapping) > 0)


def neighbourhood(mapping: Mapping, new: Bool[Tensor, "v"]) -> Bool[Tensor, "v"]:
    """The new images and the registered ones that share most points with them."""
    node = mapping.observations()
    view, point = mapping.graph.view[node], mapping.point[node]
    seen = torch.zeros(len(mapping.X), dtype=torch.bool)
    seen[point[new[view]]] = True
    shared = torch.bincount(view[seen[point]], minlength=len(new))
    shared[new] = 0
    closest = shared.topk(min(NEIGHBOURS, len(new))).indices
    moving = new.clone()
    moving[closest[shared[closest] > 0]] = True
    return moving


def support(mapping: Mapping, threshold: float, noise: float = 1.0) -> float:
    """By how much the observations of a model are better than such that just do not fit, all together.

    Args:
        mapping: The model.
        threshold: Largest reprojection error of an inlier in pixels.
        noise: Pixels in which errors are measured: by the noise of a good model others lose by their bends.
    """
    node = mapping.observations()
    error = mapping.errors(mapping.point[node], node).clamp(max=threshold) / noise
    return float((LOSS(error.new_tensor(threshold / noise).square()) - LOSS(error.square())).sum())


def points_agree(mapping: Mapping, moved: Mapping, excess: float = 1.0) -> bool:
    """Whether points lose no more than their own noise makes likely where lines or curves have moved the cameras.

    Their squared distances, over their noise, may grow by one for each number of a camera that lines or curves say better, and
    by as much more as chance makes likely.

    Args:
        mapping: The model, at the minimum of its points.
        moved: The same with other cameras, and its points where these want them.
        excess: By how much more points scatter together than by their own noise, as a ratio of variances (`excess_scatter`):
            true cameras are as much farther from their minimum.
    """
    weights = observation_weights(mapping, LOSS)
    lost = _cost(moved, weights) - _cost(mapping, weights)
    free = {} if mapping.adjustment is None else mapping.adjustment.free
    number = 6 * int(mapping.registered.sum()) + sum(int(mask.sum()) for mask in free.values())
    most = number + UNLIKELY * (2 * number) ** 0.5
    return bool(2 * lost <= excess * most * measure_noise(mapping, LOSS, weights) ** 2)


def _cost(mapping: Mapping, weights: Float[Tensor, "m"]) -> float:
    """Half the sum of the losses of observations, square pixels."""
    return 0.5 * float((weights * LOSS(mapping.problem().residuals().square())).nan_to_num(nan=0.0, posinf=0.0).sum())
