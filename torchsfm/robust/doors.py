"""What all doors of robust estimation share: their options, explained once, and the answer in the unit and type of the data."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypedDict, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.robust.optimum import push_forward
from torchsfm.robust.ransac import RobustResult, ransac
from torchsfm.robust.samplers import Sampler
from torchsfm.robust.scoring import Scoring

_MOST_RADIANS = 0.1
"""No camera is so inexact: a larger threshold is one in pixels."""
_MOST_TANGENT = 30.0
"""Half of the image points of a camera are not farther from its axis, in units of the focal length: 88 degrees."""
_MOST_PIXELS = 1e6
"""No image is so wide; what is farther away is wrong in another way."""
_WIDEST = 0.5
"""The widest threshold that tells right from wrong, in units of the median distance of the data from their middle."""


class SearchOptions(TypedDict, total=False):
    """How to search for the model that most of the data agree on.

    Attributes:
        quality: How much each datum can be trusted, `(*batch, n)`, the larger the more, in any unit: the samples then favour
            the best.
        weights: For how many data each one counts, `(*batch, n)`, 0 for absent. Their unit is free.
        scoring: How models are compared: `Msac()` (the default), `Magsac()`, `InlierCount()`, `LeastMedian()`.
        sampler: How samples are drawn: `Uniform()` (the default), `Prosac()` (where `quality` is given), `Neighbours()`.
        generator: Source of randomness; PyTorch's global one if not given.
        confidence: Wanted probability of having drawn a sample without outliers; 0.9999 if not given.
        max_iterations: Most samples to draw for a problem; 10,000 if nothing else is said where the model is estimated.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.robust import SearchOptions
        >>> search: SearchOptions = {"scoring": torchsfm.Magsac(), "max_iterations": 500, "confidence": 0.999}
        >>> g = torch.Generator().manual_seed(0)
        >>> X, pose = torchsfm.random_points(50, generator=g), torchsfm.random_poses(generator=g)
        >>> x = torchsfm.project_points(pose.matrix(), X)
        >>> camera = torchsfm.estimate_camera(x, X, torch.eye(3).double(), threshold=1e-3, **search)  # the same for every door
        >>> plane = torchsfm.estimate_homography(x, x + 0.1, threshold=1e-3, **search)
        >>> camera.inliers.sum(), plane.inliers.sum()
        (tensor(50), tensor(50))
    """

    quality: Float[Tensor, "*#batch n"] | None
    weights: Float[Tensor, "*#batch n"] | None
    scoring: Scoring | None
    sampler: Sampler | None
    generator: torch.Generator | None
    confidence: float
    max_iterations: int


class RansacOptions(SearchOptions, total=False):
    """The options of every robust estimation: `estimate_fundamental(x1, x2, threshold=1.5, weights=w, covariance=True)`.

    Attributes:
        mask: Which data exist, `(*batch, n)`; all of them if not given. Problems of different size share a batch this way. Rows
            that are not finite are left out too.
        covariance: Compute the covariance of the model, from the scatter of the data around it; not if not given.

    Example:
        >>> import torch, torchsfm
        >>> options: torchsfm.RansacOptions = {"scoring": torchsfm.Magsac(), "max_iterations": 1000}
        >>> x = torch.rand(50, 2, generator=torch.Generator().manual_seed(0))
        >>> found = torchsfm.estimate_homography(x, x + 0.1, threshold=1e-3, **options)
        >>> found.inliers.sum()
        tensor(50)
    """

    mask: Bool[Tensor, "*#batch n"] | None
    covariance: bool


def check_door(
    data: dict[str, tuple[Tensor | None, str]],
    threshold: float | Tensor | None,
    options: Any,
    kind: type = RansacOptions,
    *,
    radians: bool = False,
    of_problem: str = "",
    of_datum: str = "n",
) -> torch.Size:
    """Check data and options of a door together, under the names the caller knows them by.

    Args:
        data: The data with their shapes, as for `check_tensors`.
        threshold: The threshold.
        options: The other options.
        kind: What options there are.
        radians: Whether the data are rays and the threshold is an angle: what cannot be meant as such is refused.
        of_problem: Dimensions of what belongs to a problem, of which there may be several in an element of the batch.
        of_datum: Dimensions of what belongs to a datum.

    Returns:
        The shape to which the batch dimensions of all broadcast.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
        TypeError: There is no such option.

    Example:
        >>> import torch, torchsfm
        >>> x1, x2 = torch.rand(8, 50, 2), torch.rand(50, 2)
        >>> torchsfm.robust.check_door({"x1": (x1, "n 2"), "x2": (x2, "n 2")}, 1.0, {"confidence": 0.99})
        torch.Size([8])
    """
    known = sorted(kind.__optional_keys__)  # type: ignore[attr-defined]
    for name in options.keys() - set(known):
        raise TypeError(f"there is no option {name!r}; there are {', '.join(known)}")
    limit = threshold if isinstance(threshold, Tensor) else None
    if limit is None:
        check_options(threshold=(threshold, "?float > 0"))
    more = {"mask": (options.get("mask"), f"?{of_datum}: bool")}
    more |= {name: (options.get(name), f"?{of_datum}") for name in ("quality", "weights")}
    batch = check_tensors(**data, threshold=(limit, f"?{of_problem}"), **more)
    if radians:
        _check_radians(threshold)
        for name, (d, shape) in data.items():
            if shape == f"{of_datum} 3":
                _check_rays(name, d)
    return batch


def check_counts(count: int, **given: Tensor | None) -> None:
    """Check that what is said of each datum is said of all, where these come in several tensors.

    Args:
        count: The number of data.
        **given: What is said of them, the last dimension for the data, under the names the caller knows it by; or None.

    Raises:
        ValueError: It names the argument, and the numbers wanted and given.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.robust.check_counts(3, weights=torch.ones(2))
        Traceback (most recent call last):
            ...
        ValueError: weights: wanted 3 in the last dimension, for all data, got shape (2,)
    """
    for name, t in given.items():
        if t is not None and t.shape[-1] != count:
            raise ValueError(f"{name}: wanted {count} in the last dimension, for all data, got shape {tuple(t.shape)}")


def _check_rays(name: str, d: Tensor | None) -> None:
    """Refuse image points in pixels, with a one behind them: most of those are nearly at right angles to the axis.

    Rays of cameras whose images reach so far to the side do not all have the same third coordinate.
    """
    if d is None or not d.numel() or not bool((d[..., 2] == 1).all()):
        return
    if _MOST_TANGENT < float(d[..., :2].detach().abs().amax(-1).median()) < _MOST_PIXELS:
        raise ValueError(f"{name}: wanted rays, got image points in pixels: take K^-1 (u, v, 1), or `Camera.unproject`")


def _check_radians(threshold: float | Tensor | None) -> None:
    """Refuse thresholds that cannot be meant as angles."""
    if isinstance(threshold, Tensor):
        wide = threshold.detach()[threshold.detach() > _MOST_RADIANS]
        threshold = float(wide.max()) if len(wide) else None
    if threshold is not None and threshold > _MOST_RADIANS:
        raise ValueError(
            f"threshold: wanted radians, at most {_MOST_RADIANS}, got {threshold}; "
            "for rays that is pixels divided by the focal length: threshold / focal"
        )


def estimate_robustly(
    estimator: Any,
    *data: Float[Tensor, "*#batch n _"],
    threshold: float | Float[Tensor, "*#batch"] | None,
    dtype: torch.dtype,
    scale: Float[Tensor, "*#batch"] | None = None,
    back: Callable[[Tensor], Tensor] | None = None,
    step_unit: Float[Tensor, "*#batch k"] | None = None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Tensor]:
    """Estimate in float64, hypotheses scored in float32, and bring the result back into the caller's world.

    The data should be of moderate size around 0 (see `moderation`), or rays of length 1.

    Args:
        estimator: The problem, its fields for the whole batch.
        *data: What to estimate from, in float64.
        threshold: Largest distance of an inlier, in the caller's unit.
        dtype: The caller's type, which the result gets.
        scale: By what distances in the data have become larger than the caller's; 1 if not given.
        back: From the estimator's model to that of the caller, differentiable; none if they are the same.
        step_unit: The units of the numbers of a step along the manifold in the caller's world. If given, the covariance is
            that of the step; else that of the entries of the caller's model, row by row.
        **options: The options of the door.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x = torch.rand(50, 2, generator=g, dtype=torch.float64)
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> options = {"threshold": 1e-3, "dtype": torch.float32, "generator": g}
        >>> found = torchsfm.robust.estimate_robustly(estimator, x, x + 0.1, **options)
        >>> found.model.dtype, found.inliers.sum()
        (torch.float32, tensor(50))
    """
    if isinstance(threshold, Tensor):
        threshold = threshold.double()
    if threshold is not None and scale is not None:
        threshold = scale * threshold
    in_double = {name: t.double() for name in ("quality", "weights") if isinstance(t := options.get(name), Tensor)}
    every: Any = options | in_double
    result = ransac(estimator, *data, threshold=threshold, scoring_dtype=torch.float32, **every)
    model, spread = result.model, result.covariance
    # All data agree with any model within so much, also those of another unit than the threshold's.
    vain = (result.threshold > _WIDEST) & (result.status == Status.OK)
    if spread is not None and step_unit is not None:
        spread = spread * step_unit[..., :, None] * step_unit[..., None, :]
    elif spread is not None:
        found = model.detach()

        def entries(step: Tensor) -> Tensor:
            moved: Tensor = estimator.retract(found, step)
            return (moved if back is None else back(moved)).flatten(step.ndim - 1)

        spread = push_forward(entries, spread)
    return replace(
        result,
        model=(model if back is None else back(model)).to(dtype),
        status=torch.where(vain, int(Status.NO_CONSENSUS), result.status).to(torch.int8),
        support=result.support.clamp(max=torch.finfo(dtype).max).to(dtype),
        threshold=(result.threshold if scale is None else result.threshold / scale).to(dtype),
        covariance=None if spread is None else spread.to(dtype),
    )
