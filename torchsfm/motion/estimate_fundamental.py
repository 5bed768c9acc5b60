"""The fundamental matrix from correspondences of which many are wrong."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.motion.epipolar_fit import (
    damped_solve,
    frame,
    left_epipole,
    normal_equations,
    oriented,
    plane_rows,
    squared_distance,
)
from torchsfm.motion.fundamental_7pt import fundamental_7pt
from torchsfm.motion.normalization import common_scale
from torchsfm.robust import RobustResult, ransac


@dataclass(frozen=True)
class FundamentalEstimator:
    """F with x2' F x1 = 0, |F| = 1, from points of moderate size around 0. Distances are Sampson's, in the unit of the points."""

    model_name: ClassVar[str] = "fundamental"
    data_names: ClassVar[tuple[str, ...]] = ("x1", "x2")
    sample_size: ClassVar[int] = 7
    max_solutions: ClassVar[int] = 3

    def minimal(
        self, x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
    ) -> Solutions[Float[Tensor, "*batch 3 3 3"]]:
        """The F of seven points that can be in front of both cameras."""
        solutions = fundamental_7pt(x1, x2)
        possible = oriented(solutions.model, plane_rows(x1)[..., None, :, :], plane_rows(x2)[..., None, :, :])
        return replace(solutions, valid=solutions.valid & possible)

    def squared_residual(
        self, F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared Sampson distance."""
        return squared_distance(F, plane_rows(x1), plane_rows(x2), sphere=False)

    def residual(
        self, F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n"]:
        """Sampson distance."""
        return self.squared_residual(F, x1, x2).sqrt()

    def degenerate(self, x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]) -> Bool[Tensor, "*batch"]:
        """Whether the first two points coincide in an image."""
        return ((x1[..., 0, :] == x1[..., 1, :]).all(-1)) | ((x2[..., 0, :] == x2[..., 1, :]).all(-1))

    def refine(
        self,
        F: Float[Tensor, "*#batch 3 3"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        weights: Float[Tensor, "*#batch n"],
    ) -> Float[Tensor, "*batch 3 3"]:
        """A Gauss-Newton step on Sampson's distance along the matrices of rank 2.

        In frames that end in the two epipoles F is [[M, 0], [0, 0]], and its tangents change everything but the last entry.
        """
        A, b = normal_equations(F, plane_rows(x1), plane_rows(x2), weights, sphere=False)
        F = F.double()
        V2, V1 = frame(left_epipole(F)), frame(left_epipole(F.mT))
        basis = (V2[..., :, None, :, None] * V1[..., None, :, None, :]).flatten(-4, -3).flatten(-2)
        A, b = (basis.mT @ A @ basis)[..., :8, :8], (b[..., None, :] @ basis)[..., 0, :8]
        own = (V2.mT @ F @ V1).flatten(-2)[..., :8]
        A = A + A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * own[..., :, None] * own[..., None, :]
        entry = own - damped_solve(A, b)
        m0, m1, q0, m2, m3, q1, p0, p1 = entry.unbind(-1)
        det = m0 * m3 - m1 * m2
        corner = (p0 * (m3 * q0 - m1 * q1) + p1 * (m0 * q1 - m2 * q0)) / torch.where(det == 0, 1, det)
        F_new = V2 @ torch.cat((entry, corner[..., None]), -1).unflatten(-1, (3, 3)) @ V1.mT
        return (F_new / F_new.flatten(-2).norm(dim=-1)[..., None, None]).to(x1.dtype)


def estimate_fundamental(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    scores: Float[Tensor, "*#batch n"] | None = None,
    generator: torch.Generator | None = None,
    confidence: float = 0.9999,
    max_iterations: int = 10_000,
) -> RobustResult[Float[Tensor, "*batch 3 3"]]:
    """The fundamental matrix of each pair of images, from correspondences of which many may be wrong.

    LO-RANSAC over seven-point samples with the oriented epipolar constraint, then a robust minimum of Sampson's distance over the
    matrices of rank 2. Computed in float64, hypotheses scored in float32. Points of one plane, or a pure rotation of the camera,
    leave F undetermined without a sign of it here: compare with the inliers of `estimate_homography` at the same threshold.

    Args:
        x1: Points in the first image.
        x2: The corresponding points in the second image, in the same unit.
        threshold: Largest Sampson distance of an inlier, in the unit of the points.
        mask: Which correspondences exist. Rows that are not finite are left out too.
        scores: How much each correspondence can be trusted, the larger the more, in any unit.
        generator: Source of randomness.
        confidence: Wanted probability of having drawn a sample without outliers.
        max_iterations: Most samples to draw.

    Returns:
        F with x2' F x1 = 0, |F| = 1 (Frobenius) and det F = 0; inliers, score, iterations, status.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    limit = threshold if isinstance(threshold, Tensor) else None
    check_tensors(x1=(x1, "n 2"), x2=(x2, "n 2"), threshold=(limit, ""), mask=(mask, "n: bool"), scores=(scores, "n"))
    y = common_scale(x1.double(), x2.double(), mask)
    result = ransac(
        FundamentalEstimator(), y.x1, y.x2, threshold=y.scale * threshold, mask=mask,
        scores=None if scores is None else scores.double(), generator=generator, confidence=confidence,
        max_iterations=max_iterations, scoring_dtype=torch.float32,
    )  # fmt: skip
    F = y.T2.mT @ result.model @ y.T1
    size = F.flatten(-2).norm(dim=-1)[..., None, None]
    F = F / torch.where(size > 0, size, 1)
    return replace(result, model=F.to(x1.dtype), score=result.score.to(x1.dtype))
