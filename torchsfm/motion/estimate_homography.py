"""The homography from correspondences of which many are wrong."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.geometry import line_and_plane_distances
from torchsfm.motion.epipolar_fit import forms, matrices, plane_rows
from torchsfm.motion.homography_4pt import homography_4pt
from torchsfm.motion.normalization import common_scale, largest_positive
from torchsfm.motion.plane_and_parallax import more_than_chance
from torchsfm.optim import UnitSphere
from torchsfm.robust import Degeneracy, Request, RobustResult, Score, damped_solve

# Where entry ((i, j), (k, l)) of a sum of Kronecker products is among 6 x 6 products, both in the order 00, 01, 02, 11, 12, 22.
_PAIR = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
_KRONECKER = [6 * _PAIR[i][k] + _PAIR[j][m] for i in range(3) for j in range(3) for k in range(3) for m in range(3)]


@dataclass(frozen=True)
class HomographyEstimator:
    """H with x2 ~ H x1, |H| = 1, from points of moderate size around 0. Distances are Sampson's, in the unit of the points.

    With the constraint c = w x2 - y, where (y, w) = H x1, and its derivative B = x2 h3' - H_2x2 over x1 and w I over x2, the
    squared distance is c' S^-1 c with S = B B' + w^2 I (Chum, Pajdla & Sturm 2005): to first order, the squared distance in
    both images together to the nearest pair of points that corresponds exactly.
    """

    model_name: ClassVar[str] = "homography"
    data_names: ClassVar[tuple[str, ...]] = ("x1", "x2")
    sample_size: ClassVar[int] = 4
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 8

    def minimal(
        self, x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]
    ) -> Solutions[Float[Tensor, "*batch 1 3 3"]]:
        """The homography of four points."""
        return homography_4pt(x1, x2)

    def squared_residual(
        self, H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared Sampson distance."""
        c0, c1, _, (s00, s01, s11), _ = _constraint(H, x1, x2)
        # The determinant and the numerator are positive but for rounding.
        det = (s00 * s11 - s01 * s01).clamp(min=1e-30)
        return (((s11 * c0 - 2 * s01 * c1) * c0 + s00 * c1 * c1) / det).abs()

    def residual(
        self, H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n"]:
        """Sampson distance."""
        return self.squared_residual(H, x1, x2).sqrt()

    def degenerate(self, x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]) -> Bool[Tensor, "*batch"]:
        """Whether three of the points are collinear in an image, or turn the other way round in the other.

        No plane in front of both cameras turns them round.
        """
        areas = []
        for x in (x1, x2):
            (u0, u1, u2, u3), (v0, v1, v2, v3) = x[..., 0].unbind(-1), x[..., 1].unbind(-1)
            a, b, c, d, e, f = u1 - u0, v1 - v0, u2 - u0, v2 - v0, u3 - u0, v3 - v0
            first, second, third = a * d - b * c, a * f - b * e, c * f - d * e
            areas.append((first, second, third, first + third - second))
        bad = areas[0][0] * areas[1][0] <= 0
        for one, other in zip(areas[0][1:], areas[1][1:], strict=True):
            bad = bad | (one * other <= 0)
        return bad

    def refine(
        self,
        H: Float[Tensor, "*#batch 3 3"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        weights: Float[Tensor, "*#batch n"],
    ) -> Float[Tensor, "*batch 3 3"]:
        """A Gauss-Newton step on Sampson's distance along the matrices of norm 1.

        Up to second order, the derivative of the distance is that of the constraint at the points corrected to first order,
        with S held fixed. The constraint is [I, -x2] H x1, so the normal matrix is a sum of Kronecker products of 3 x 3
        matrices.
        """
        c0, c1, w, (s00, s01, s11), B = _constraint(H, x1, x2)
        det = s00 * s11 - s01 * s01
        good = (det > 0) & (weights > 0)
        inverse = torch.where(good, 1 / torch.where(good, det, 1), 0)
        k0, k1 = (s11 * c0 - s01 * c1) * inverse, (s00 * c1 - s01 * c0) * inverse
        x, y = x1[..., 0] - B[0] * k0 - B[2] * k1, x1[..., 1] - B[1] * k0 - B[3] * k1
        one = torch.ones_like(x)
        u, v = x2[..., 0] - w * k0, x2[..., 1] - w * k1
        inverse, k0, k1 = inverse * weights, k0 * weights, k1 * weights
        q00, q01, q11 = s11 * inverse, -s01 * inverse, s00 * inverse
        # The distinct entries of [-I, x2]' S^-1 [-I, x2], and those of h1 h1'.
        z0, z1 = q00 * u + q01 * v, q01 * u + q11 * v
        metric = torch.stack((q00, q01, -z0, q11, -z1, z0 * u + z1 * v), -2)
        moments = (metric @ torch.stack((x * x, x * y, x, y * y, y, one), -2).mT).double().flatten(-2)
        A = matrices(moments.index_select(-1, torch.tensor(_KRONECKER, device=H.device)), 9)
        b = (torch.stack((-k0, -k1, k0 * u + k1 * v), -2) @ torch.stack((x, y, one), -2).mT).double().flatten(-2)
        h = H.double().flatten(-2)
        A = A + A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * h[..., :, None] * h[..., None, :]
        h = h - damped_solve(A, b[..., None])[..., 0]
        return matrices(h / (h * h).sum(-1, keepdim=True).sqrt(), 3).to(x1.dtype)

    def retract(self, H: Float[Tensor, "*#batch 3 3"], step: Float[Tensor, "*#batch 8"]) -> Float[Tensor, "*batch 3 3"]:
        """H moved along the unit sphere."""
        return matrices(UnitSphere(9).retract(H.flatten(-2), step), 3)

    def degeneracy(
        self,
        H: Float[Tensor, "*#batch 3 3"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """COLLINEAR: no two inliers more than chance explains are off a line; H takes lines to lines, so one image will do."""
        off, _ = line_and_plane_distances(x1, inliers)
        bad = ~more_than_chance((inliers & (off > 2 * threshold[..., None])).sum(-1), chance, -1)
        return torch.where(bad, int(Degeneracy.COLLINEAR), int(Degeneracy.NONE)).to(torch.int8)


def _constraint(
    H: Tensor, x1: Tensor, x2: Tensor
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]:
    """The constraint c, the depth w, S, and B row by row."""
    y0, y1, w = forms(H, plane_rows(x1))
    u, v = x2[..., 0], x2[..., 1]
    c0, c1 = u * w - y0, v * w - y1
    h00, h01, h10, h11, h20, h21 = (H[..., i, j, None] for i in range(3) for j in range(2))
    b00, b01, b10, b11 = u * h20 - h00, u * h21 - h01, v * h20 - h10, v * h21 - h11
    ww = w * w
    S = (b00 * b00 + b01 * b01 + ww, b00 * b10 + b01 * b11, b10 * b10 + b11 * b11 + ww)
    return c0, c1, w, S, (b00, b01, b10, b11)


def estimate_homography(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    scores: Float[Tensor, "*#batch n"] | None = None,
    weights: Float[Tensor, "*#batch n"] | None = None,
    score: Score | None = None,
    generator: torch.Generator | None = None,
    confidence: float = 0.9999,
    max_iterations: int = 10_000,
    covariance: bool = False,
) -> RobustResult[Float[Tensor, "*batch 3 3"]]:
    """The homography between each pair of images, from correspondences of which many may be wrong.

    LO-RANSAC over four-point samples whose triangles keep their sense, then a robust minimum of Sampson's distance. Computed in
    float64, hypotheses scored in float32.

    Args:
        x1: Points in the first image.
        x2: The corresponding points in the second image, in the same unit.
        threshold: Largest Sampson distance of an inlier, in the unit of the points. It counts errors in both images together:
            with the same noise in both, a transfer error to one image is about 1.4 times larger.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        mask: Which correspondences exist. Rows that are not finite are left out too.
        scores: How much each correspondence can be trusted, the larger the more, in any unit: the samples then favour the best.
        weights: For how many correspondences each one counts, 0 for absent.
        score: How models are compared (see `ransac`).
        generator: Source of randomness.
        confidence: Wanted probability of having drawn a sample without outliers.
        max_iterations: Most samples to draw.
        covariance: Compute the covariance of the entries of H, row by row.

    Returns:
        H with x2 ~ H x1, |H| = 1 (Frobenius) and its largest entry positive; inliers, score, iterations, status, degeneracy
        (COLLINEAR: the inliers are on a line but for so few as chance explains), covariance (9 x 9, of rank 8). H carries its
        derivatives with respect to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    request = Request(
        threshold=threshold, mask=mask, scores=scores, weights=weights, score=score, generator=generator,
        confidence=confidence, max_iterations=max_iterations, covariance=covariance,
    )  # fmt: skip
    request.check(x1=(x1, "n 2"), x2=(x2, "n 2"))
    y = common_scale(x1.double(), x2.double(), mask)
    T2_inverse = torch.linalg.inv_ex(y.T2)[0]

    def back(model: Tensor) -> Tensor:
        H = T2_inverse @ model @ y.T1
        size = (H * H).sum(-1, keepdim=True).sum(-2, keepdim=True)
        return largest_positive(H * torch.where(size > 0, size, 1).rsqrt())

    return request.answer(HomographyEstimator(), y.x1, y.x2, dtype=x1.dtype, scale=y.scale, back=back)
