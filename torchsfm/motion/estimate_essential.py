"""The essential matrix from corresponding rays of which many are wrong."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.geometry import cross_matrix, rotation_from_rotvec
from torchsfm.motion.epipolar_fit import (
    damped_solve,
    frame,
    left_epipole,
    normal_equations,
    oriented,
    sphere_rows,
    squared_distance,
)
from torchsfm.motion.essential_5pt import essential_5pt
from torchsfm.robust import RobustResult, ransac


@dataclass(frozen=True)
class EssentialEstimator:
    """E with d2' E d1 = 0, |E|^2 = 2. Distances are Sampson's on the sphere of rays, in radians."""

    model_name: ClassVar[str] = "essential"
    data_names: ClassVar[tuple[str, ...]] = ("d1", "d2")
    sample_size: ClassVar[int] = 5
    max_solutions: ClassVar[int] = 10

    def minimal(
        self, d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
    ) -> Solutions[Float[Tensor, "*batch 10 3 3"]]:
        """The E of five rays that can meet in front of both cameras."""
        solutions = essential_5pt(d1, d2)
        possible = oriented(solutions.model, d1.mT[..., None, :, :], d2.mT[..., None, :, :])
        return replace(solutions, valid=solutions.valid & possible)

    def squared_residual(
        self, E: Float[Tensor, "*#batch 3 3"], d1: Float[Tensor, "*#batch n 3"], d2: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared angular Sampson distance."""
        return squared_distance(E, sphere_rows(d1), sphere_rows(d2), sphere=True)

    def residual(
        self, E: Float[Tensor, "*#batch 3 3"], d1: Float[Tensor, "*#batch n 3"], d2: Float[Tensor, "*#batch n 3"]
    ) -> Float[Tensor, "*batch n"]:
        """Sampson distance in radians: by how much the two rays must turn together to meet, to first order."""
        return self.squared_residual(E, d1, d2).sqrt()

    def degenerate(self, d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]) -> Bool[Tensor, "*batch"]:
        """Whether the first two rays coincide in an image."""
        return ((d1[..., 0, :] == d1[..., 1, :]).all(-1)) | ((d2[..., 0, :] == d2[..., 1, :]).all(-1))

    def refine(
        self,
        E: Float[Tensor, "*#batch 3 3"],
        d1: Float[Tensor, "*#batch n 3"],
        d2: Float[Tensor, "*#batch n 3"],
        *,
        weights: Float[Tensor, "*#batch n"],
    ) -> Float[Tensor, "*batch 3 3"]:
        """A Gauss-Newton step on Sampson's distance along E <- exp(a) E exp(b), with b moving the first epipole alone."""
        A, b = normal_equations(E, sphere_rows(d1), sphere_rows(d2), weights, sphere=True)
        E = E.double()
        axes = torch.eye(3, dtype=E.dtype, device=E.device)
        turn = frame(left_epipole(E.mT))[..., :2].mT
        left = cross_matrix(axes) @ E[..., None, :, :]
        right = E[..., None, :, :] @ cross_matrix(turn)
        tangent = torch.cat((left, right), -3).flatten(-2).mT
        step = damped_solve(tangent.mT @ A @ tangent, (b[..., None, :] @ tangent)[..., 0, :])
        R2 = rotation_from_rotvec(-step[..., :3])
        R1 = rotation_from_rotvec(-(step[..., None, 3:] @ turn)[..., 0, :])
        E = R2 @ E @ R1
        return (E * (2**0.5 / E.flatten(-2).norm(dim=-1)[..., None, None])).to(d1.dtype)


def estimate_essential(
    d1: Float[Tensor, "*#batch n 3"],
    d2: Float[Tensor, "*#batch n 3"],
    *,
    threshold: float | Float[Tensor, "*#batch"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    scores: Float[Tensor, "*#batch n"] | None = None,
    generator: torch.Generator | None = None,
    confidence: float = 0.9999,
    max_iterations: int = 10_000,
) -> RobustResult[Float[Tensor, "*batch 3 3"]]:
    """The essential matrix of each pair of calibrated cameras, from corresponding rays of which many may be wrong.

    LO-RANSAC over five-point samples with the oriented epipolar constraint, then a robust minimum of Sampson's distance over the
    essential matrices. `pose_from_essential` turns the result into a pose. A pure rotation leaves E undetermined without a sign of
    it here: every translation then fits.

    Args:
        d1: Rays of the first camera, of any length, pointing to the points.
        d2: The corresponding rays of the second camera.
        threshold: Largest Sampson distance of an inlier in radians: pixels divided by the focal length.
        mask: Which correspondences exist. Rows that are not finite or of length 0 are left out too.
        scores: How much each correspondence can be trusted, the larger the more, in any unit.
        generator: Source of randomness.
        confidence: Wanted probability of having drawn a sample without outliers.
        max_iterations: Most samples to draw.

    Returns:
        E with d2' E d1 = 0, |E|^2 = 2 and singular values (1, 1, 0); inliers, score, iterations, status.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    limit = threshold if isinstance(threshold, Tensor) else None
    check_tensors(d1=(d1, "n 3"), d2=(d2, "n 3"), threshold=(limit, ""), mask=(mask, "n: bool"), scores=(scores, "n"))
    length1, length2 = d1.double().norm(dim=-1, keepdim=True), d2.double().norm(dim=-1, keepdim=True)
    # A ray of length 0 becomes NaN, and is left out.
    result = ransac(
        EssentialEstimator(), d1 / length1, d2 / length2,
        threshold=threshold.double() if isinstance(threshold, Tensor) else threshold, mask=mask,
        scores=None if scores is None else scores.double(), generator=generator, confidence=confidence,
        max_iterations=max_iterations, scoring_dtype=torch.float32,
    )  # fmt: skip
    return replace(result, model=result.model.to(d1.dtype), score=result.score.to(d1.dtype))
