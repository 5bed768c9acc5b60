"""What all doors of robust estimation share: the options of a call, checked, and answered in the unit and type of the data."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.robust.optimum import push_forward
from torchsfm.robust.ransac import RobustResult, ransac
from torchsfm.robust.scores import Score

_MOST_RADIANS = 0.1
"""No camera is so inexact: a larger threshold is one in pixels."""
_WIDEST = 0.5
"""The widest threshold that tells right from wrong, in units of the median distance of the data from their middle."""


@dataclass(frozen=True)
class Request:
    """The options of a door, as `ransac` explains them. The door brings its data into a form that is good to estimate from."""

    threshold: float | Float[Tensor, "..."] | None
    mask: Bool[Tensor, "..."] | None
    scores: Float[Tensor, "..."] | None
    weights: Float[Tensor, "..."] | None
    score: Score | None
    generator: torch.Generator | None
    confidence: float
    max_iterations: int
    covariance: bool

    def check(self, **data: tuple[Tensor, str]) -> torch.Size:
        """Check data and options together, under the names the caller knows them by (see `check_tensors`).

        Returns:
            The shape to which the batch dimensions of all broadcast.

        Raises:
            ValueError: A shape, dtype, device or option does not fit.
        """
        limit = self.threshold if isinstance(self.threshold, Tensor) else None
        if limit is None:
            check_options(threshold=(self.threshold, "?float > 0"))
        options = {"mask": (self.mask, "?n: bool"), "scores": (self.scores, "?n"), "weights": (self.weights, "?n")}
        return check_tensors(**data, threshold=(limit, "?"), **options)

    def check_radians(self) -> None:
        """Refuse thresholds that cannot be meant as angles.

        Raises:
            ValueError: A threshold is larger than 0.1 radians.
        """
        threshold = self.threshold
        if isinstance(threshold, Tensor):
            wide = threshold.detach()[threshold.detach() > _MOST_RADIANS]
            threshold = float(wide.max()) if len(wide) else None
        if threshold is not None and threshold > _MOST_RADIANS:
            raise ValueError(
                f"threshold: wanted radians, at most {_MOST_RADIANS}, got {threshold}; "
                "for rays that is pixels divided by the focal length: threshold / focal"
            )

    def answer(
        self,
        estimator: Any,
        *data: Float[Tensor, "*#batch n _"],
        dtype: torch.dtype,
        scale: Float[Tensor, "*#batch"] | None = None,
        back: Callable[[Tensor], Tensor] | None = None,
        step_unit: Float[Tensor, "*#batch k"] | None = None,
    ) -> RobustResult[Tensor]:
        """Estimate in float64, hypotheses scored in float32, and bring the result back.

        The data should be of moderate size around 0 (see `moderation`), or rays of length 1.

        Args:
            estimator: The problem, its fields for the whole batch.
            *data: What to estimate from, in float64.
            dtype: The caller's type, which the result gets.
            scale: By what distances in the data have become larger than the caller's; 1 if not given.
            back: From the estimator's model to that of the caller, differentiable; none if they are the same.
            step_unit: The units of the numbers of a step along the manifold in the caller's world. If given, the covariance is
                that of the step; else that of the entries of the caller's model, row by row.
        """
        threshold, scores, weights = self.threshold, self.scores, self.weights
        if isinstance(threshold, Tensor):
            threshold = threshold.double()
        if threshold is not None and scale is not None:
            threshold = scale * threshold
        result = ransac(
            estimator, *data, threshold=threshold, mask=self.mask, scores=None if scores is None else scores.double(),
            weights=None if weights is None else weights.double(), score=self.score, generator=self.generator,
            confidence=self.confidence, max_iterations=self.max_iterations, scoring_dtype=torch.float32,
            covariance=self.covariance,
        )  # fmt: skip
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
            score=result.score.clamp(max=torch.finfo(dtype).max).to(dtype),
            threshold=(result.threshold if scale is None else result.threshold / scale).to(dtype),
            covariance=None if spread is None else spread.to(dtype),
        )
