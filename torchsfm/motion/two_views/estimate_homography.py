"""The homography from correspondences of which many are wrong."""

from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.geometry import least_number_off, line_and_plane_distances
from torchsfm.linalg import damped_solve
from torchsfm.motion.two_views.epipolar_fit import matrices, product
from torchsfm.motion.two_views.homography_4pt import homography_4pt
from torchsfm.motion.two_views.normalization import common_scale, largest_positive
from torchsfm.motion.two_views.plane_and_parallax import more_than_chance
from torchsfm.motion.two_views.sampson_transfer import constraint, squared_distance
from torchsfm.optim import UnitSphere
from torchsfm.robust import Degeneracy, RansacOptions, RobustResult, Weigh, check_door, estimate_robustly

# Where entry ((i, j), (k, l)) of a sum of Kronecker products is among 6 x 6 products, both in the order 00, 01, 11, 02, 12, 22.
_PAIR = ((0, 1, 3), (1, 2, 4), (3, 4, 5))
_KRONECKER = [6 * _PAIR[i][k] + _PAIR[j][m] for i in range(3) for j in range(3) for k in range(3) for m in range(3)]


@dataclass(frozen=True)
class HomographyEstimator:
    """H with x2 ~ H x1, |H| = 1, from points of moderate size around 0. Distances are Sampson's, in the unit of the points.

    With the constraint c = y - w x2, where (y, w) = H x1, and its derivatives B = H_2x2 - x2 h3' over x1 and -w I over x2, the
    squared distance is c' S^-1 c with S = B B' + w^2 I (Chum, Pajdla & Sturm 2005): to first order, the squared distance in
    both images together to the nearest pair of points that corresponds exactly.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(100, 2, generator=g, dtype=torch.float64)
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> found = torchsfm.ransac(estimator, x1, x1 + 0.1, threshold=1e-3, generator=g)
        >>> found.model.shape, found.inliers.sum()
        (torch.Size([3, 3]), tensor(100))
    """

    model_name: ClassVar[str] = "homography"
    data_names: ClassVar[tuple[str, ...]] = ("x1", "x2")
    sample_size: ClassVar[int] = 4
    max_solutions: ClassVar[int] = 1
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 8
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]
    ) -> Solutions[Float[Tensor, "*batch 1 3 3"]]:
        """The homography of four points."""
        return homography_4pt(x1, x2)

    def squared_residual(
        self, H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared Sampson distance."""
        return squared_distance(H, x1, x2)

    def degenerate(self, x1: Float[Tensor, "*#batch 4 2"], x2: Float[Tensor, "*#batch 4 2"]) -> Bool[Tensor, "*batch"]:
        """Whether three of the points are collinear in an image, or turn the other way round in the other.

        No plane in front of both cameras turns them round.
        """
        areas = []
        for x in (x1, x2):
            (u0, u1, u2), (v0, v1, v2) = (row.unbind(-1) for row in (x[..., 1:, :] - x[..., :1, :]).unbind(-1))
            first, second = (u0 * v1).addcmul_(u1, v0, value=-1), (u1 * v2).addcmul_(u2, v1, value=-1)
            third = (u2 * v0).addcmul_(u0, v2, value=-1)
            areas.append((first, second, third, first + second + third))
        a, b, c, d = (one * other for one, other in zip(*areas, strict=True))
        return torch.minimum(torch.minimum(a, b), torch.minimum(c, d)) <= 0

    def places(
        self, H: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n 4"]:
        """Both points."""
        return torch.cat((x1, x2), -1)

    def step(
        self,
        H: Float[Tensor, "*#batch 3 3"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 3 3"]:
        """A Gauss-Newton step on Sampson's distance along the matrices of norm 1.

        Up to second order, the derivative of the distance is that of the constraint at the points corrected to first order,
        with S held fixed. The constraint is [I, -x2] H x1, so the normal matrix is a sum of Kronecker products of 3 x 3
        matrices.
        """
        (x, y), (u, v) = x1.unbind(-1), x2.unbind(-1)
        c0, c1, w, (s00, s01, s11), (b00, b01, b10, b11) = constraint(H, x, y, u, v)
        # So large that nothing overflows, and what has no weight adds nothing.
        least = torch.finfo(c0.dtype).tiny ** (1 / 3)
        inverse = (s00 * s11).addcmul_(s01, s01, value=-1).clamp_(min=least).reciprocal_()
        k0 = (s11 * c0).addcmul_(s01, c1, value=-1).mul_(inverse)
        k1 = (s00 * c1).addcmul_(s01, c0, value=-1).mul_(inverse)
        weights, curvature = weigh((k0 * c0).addcmul_(k1, c1).abs_())
        x = torch.addcmul(x, b00, k0, value=-1).addcmul_(b10, k1, value=-1)
        y = torch.addcmul(y, b01, k0, value=-1).addcmul_(b11, k1, value=-1)
        u, v = torch.addcmul(u, w, k0), torch.addcmul(v, w, k1)
        # The distinct entries of [I, -x2]' S^-1 [I, -x2] and those of S^-1 c times [I, -x2], but for their signs.
        inverse = inverse * curvature
        q00, q01, q11 = s11.mul_(inverse), s01.mul_(inverse), s00.mul_(inverse)
        z0, z1 = (q00 * u).addcmul_(q01, v, value=-1), (q11 * v).addcmul_(q01, u, value=-1)
        k0, k1 = k0.mul_(weights), k1.mul_(weights)
        rows = torch.stack((q00, q01, q11, z0, z1, (z0 * u).addcmul_(z1, v), k0, k1, (k0 * u).addcmul_(k1, v)), -2)
        products = torch.stack((x * x, x * y, y * y, x, y, torch.ones_like(x)), -2)
        entries, signs = _constants(H.device)
        moments = product(rows, products.mT) * signs
        A = moments[..., :6, :].flatten(-2).index_select(-1, entries)
        h = H.double().flatten(-2)
        # The unit sphere's normal, as large as the rest.
        size = A[..., ::10].mean(-1, keepdim=True)
        A = torch.addcmul(matrices(A, 9), (size * h)[..., None], h[..., None, :])
        h = h - damped_solve(A, moments[..., 6:, 3:].reshape(*h.shape, 1))[..., 0]
        return matrices(h / torch.linalg.vector_norm(h, dim=-1, keepdim=True), 3).to(x1.dtype)

    def retract(self, H: Float[Tensor, "*#batch 3 3"], step: Float[Tensor, "*#batch 8"]) -> Float[Tensor, "*batch 3 3"]:
        """H moved along the unit sphere."""
        return matrices(UnitSphere(9).retract(H.flatten(-2), step), 3)

    def may_be_degenerate(
        self,
        H: Float[Tensor, "*#batch 3 3"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Bool[Tensor, "*batch"]:
        """Whether the inliers may be on a line."""
        return ~more_than_chance(least_number_off(x1, inliers, 2 * threshold[..., None]), chance, -1)

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


@cache
def _constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """Where the entries of the normal matrix are among the moments, and the signs of the moments."""
    signs = torch.tensor((1, -1, 1, -1, -1, 1, 1, 1, -1), dtype=torch.float64, device=device)
    return torch.tensor(_KRONECKER, device=device), signs[:, None]


def estimate_homography(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
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
        **options: See `RansacOptions`.

    Returns:
        H with x2 ~ H x1, |H| = 1 (Frobenius) and its largest entry positive; inliers, support, iterations, status, degeneracy
        (COLLINEAR: the inliers are on a line but for so few as chance explains), covariance (9 x 9, of rank 8). H carries its
        derivatives with respect to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> H = torch.tensor([[1.0, 0.1, 0.0], [0.0, 1.2, 0.3], [0.0, 0.2, 1.0]], dtype=torch.float64)
        >>> x1 = torch.rand(100, 2, generator=g, dtype=H.dtype)
        >>> x2 = torchsfm.geometry.transform_points(H, x1)
        >>> x2[:40] = torch.rand(40, 2, generator=g, dtype=H.dtype)  # 40 % are wrong
        >>> found = torchsfm.estimate_homography(x1, x2, threshold=1e-3, generator=g)
        >>> bool((found.model / found.model[2, 2]).allclose(H, atol=1e-3)), bool(found.inliers[40:].all())
        (True, True)
    """
    check_door({"x1": (x1, "n 2"), "x2": (x2, "n 2")}, threshold, options)
    y = common_scale(x1.double(), x2.double(), options.get("mask"))
    T2_inverse = torch.linalg.inv_ex(y.T2)[0]

    def back(model: Tensor) -> Tensor:
        H = T2_inverse @ model @ y.T1
        size = (H * H).sum(-1, keepdim=True).sum(-2, keepdim=True)
        return largest_positive(H * torch.where(size > 0, size, 1).rsqrt())

    return estimate_robustly(
        HomographyEstimator(), y.x1, y.x2, threshold=threshold, dtype=x1.dtype, scale=y.scale, back=back, **options
    )  # fmt: skip
