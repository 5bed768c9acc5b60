"""The fundamental matrix from correspondences of which many are wrong."""

from dataclasses import dataclass
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.linalg import damped_solve, qr, svd
from torchsfm.motion.two_views.collinear import collinear, collinear_suspected
from torchsfm.motion.two_views.epipolar_fit import cofactors, cross_rows, matrices, plane_rows, product, with_left_epipole
from torchsfm.motion.two_views.estimate_homography import HomographyEstimator
from torchsfm.motion.two_views.normalization import common_scale, largest_positive
from torchsfm.motion.two_views.oriented_7pt import oriented_7pt
from torchsfm.motion.two_views.plane_and_parallax import dominant_plane, more_than_chance, most_by_chance, plane_alternatives
from torchsfm.motion.two_views.plane_glance import plane_suspected
from torchsfm.motion.two_views.rival_geometry import (
    rank_two_members,
    rival_explains,
    rival_suspected,
    undetermined_where_rivalled,
)
from torchsfm.motion.two_views.sampson_plane import homogeneous_rows, squared_distance, step_equations
from torchsfm.robust import Degeneracy, RansacOptions, RobustResult, Weigh, check_door, estimate_robustly

_TINY = 1e-30
"""In place of 0 below a fraction bar: what stands above is then less."""


@dataclass(frozen=True)
class FundamentalEstimator:
    """F with x2' F x1 = 0, |F| = 1, and the epipole e2 whose sign puts the points in front of the cameras: models are [F | e2].

    The points should be of moderate size around 0. Distances are Sampson's, in their unit, and infinite where e2 x h2 and F h1
    are opposite: such a point is behind one camera and in front of the other (Chum, Werner & Matas 2004; Hartley 1998). That
    rejects half of the wrong matches that happen to lie on their epipolar lines.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(100, generator=g), torchsfm.random_poses(2, generator=g)
        >>> x1, x2 = torchsfm.project_points(poses, X)
        >>> estimator = torchsfm.motion.FundamentalEstimator()
        >>> found = torchsfm.ransac(estimator, x1, x2, threshold=1e-3, generator=g)
        >>> found.model.shape, found.inliers.sum()  # [F | e2]
        (torch.Size([3, 4]), tensor(100))
    """

    model_name: ClassVar[str] = "oriented_fundamental"
    data_names: ClassVar[tuple[str, ...]] = ("x1", "x2")
    sample_size: ClassVar[int] = 7
    max_solutions: ClassVar[int] = 3
    codimension: ClassVar[int] = 1
    dimension: ClassVar[int] = 7
    never_zero: ClassVar[bool] = True
    solved_in_single: ClassVar[bool] = True

    def minimal(
        self, x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]
    ) -> Solutions[Float[Tensor, "*batch 3 3 4"]]:
        """The F of seven points that can be in front of both cameras."""
        return oriented_7pt(x1, x2)

    def squared_residual(
        self, model: Float[Tensor, "*#batch 3 4"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n"]:
        """Squared Sampson distance; infinite for points that are behind one camera."""
        return squared_distance(model, x1, x2)

    def degenerate(self, x1: Float[Tensor, "*#batch 7 2"], x2: Float[Tensor, "*#batch 7 2"]) -> Bool[Tensor, "*batch"]:
        """Whether the first two points coincide in an image."""
        return ((x1[..., 0, :] == x1[..., 1, :]).all(-1)) | ((x2[..., 0, :] == x2[..., 1, :]).all(-1))

    def places(
        self, model: Float[Tensor, "*#batch 3 4"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
    ) -> Float[Tensor, "*batch n 4"]:
        """Both points."""
        return torch.cat((x1, x2), -1)

    def step(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 3 4"]:
        """A Gauss-Newton step on Sampson's distance along the matrices of norm 1 and determinant 0.

        The step minimises the quadratic model under the linearised constraint (sequential quadratic programming). What that
        leaves of the determinant goes with one more step along its gradient: beside the manifold the loss may be less than
        anywhere on it, and every step from there would be one up.
        """
        F, e = torch.split(model, [3, 1], -1)
        A, b = step_equations(F, e, x1, x2, weigh)
        F, e = F.double(), e.double()
        f, normal = F.flatten(-2), cofactors(F).flatten(-2)
        # The unit sphere's normal, as large as the rest.
        size = A.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
        A = torch.addcmul(A, (size * f)[..., None], f[..., None, :])
        free, bound = damped_solve(A, torch.stack((b, normal), -1)).unbind(-1)
        # The determinant is a third of the product with its gradient.
        gap = (normal * torch.sub(f, free, alpha=3)).sum(-1, keepdim=True)
        share = (normal * bound).sum(-1, keepdim=True)
        f = torch.addcmul(f - free, gap / share.clamp(min=_TINY), bound, value=-1 / 3)
        return with_left_epipole(matrices(_determinant_step(f), 3), e[..., 0]).to(x1.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 7"]) -> Float[Tensor, "*batch 3 4"]:
        """F moved along a basis of the tangent space, then to determinant 0 up to fourth order, and to norm 1."""
        f = model[..., :3].detach().flatten(-2)
        normals = torch.stack((f, _cofactors(f)), -2)
        basis = svd(normals)[2][..., 2:, :]
        f = model[..., :3].flatten(-2) + (step[..., None, :] @ basis)[..., 0, :]
        return with_left_epipole(matrices(_determinant_step(f), 3), model[..., 3])

    def alternative_models(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        inside: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        seed: int,
    ) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
        """Where a plane holds most inliers: F of its homography and of two points off it (Chum, Werner & Matas 2005)."""
        return plane_alternatives(self, HomographyEstimator(), model, x1, x2, inside=inside, threshold=threshold, seed=seed)

    def may_be_degenerate(
        self,
        model: Float[Tensor, "p 3 4"],
        x1: Float[Tensor, "p n 2"],
        x2: Float[Tensor, "p n 2"],
        *,
        inliers: Bool[Tensor, "p n"],
        threshold: Float[Tensor, "p"],
        chance: Float[Tensor, "p"],
    ) -> Bool[Tensor, "p"]:
        """Whether half of the inliers, or all but so few as chance explains, may be in a plane, on a line or near another F."""
        F, e = model[..., :3], model[..., 3]
        h1, h2 = homogeneous_rows(x1), homogeneous_rows(x2)
        spare = most_by_chance(chance, 2)
        A = torch.linalg.cross(e[..., None], F, dim=-2)
        limit = 4 * threshold * threshold
        flat = plane_suspected(A, e, h1, h2, inliers, limit, spare)
        flat |= rival_suspected(F, h1, h2, inliers, limit, spare, sphere=False)
        return flat | collinear_suspected((x1, x2), inliers, threshold, chance)

    def degeneracy(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """What all inliers but so few as chance explains have in common, so that F is open.

        PLANAR: a homography relates them; two dimensions are open. COLLINEAR: in an image they are on a line. UNDETERMINED:
        they agree with another F as well.
        """
        F, e = model[..., :3], model[..., 3]
        limit = 4 * threshold * threshold
        _, on = dominant_plane(cross_rows(e, F), e, plane_rows(x1), plane_rows(x2), inliers, limit, sphere=False)
        planar = on.any(-1) & ~more_than_chance((inliers & ~on).sum(-1), chance, 2)
        code = torch.where(planar, int(Degeneracy.PLANAR), int(Degeneracy.NONE))
        code = torch.where(collinear((x1, x2), inliers, threshold, chance), int(Degeneracy.COLLINEAR), code)
        known = (model, 2), (x1, 2), (x2, 2), (inliers, 1), (threshold, 0), (chance, 0)
        return undetermined_where_rivalled(code, self._has_rival, *known)

    def _has_rival(
        self, model: Tensor, x1: Tensor, x2: Tensor, inliers: Tensor, threshold: Tensor, chance: Tensor
    ) -> Bool[Tensor, "p"]:
        """Whether the inliers agree with another F as well: one of rank 2 in the pencil of solutions."""
        F = model[..., :3]
        h1, h2 = homogeneous_rows(x1), homogeneous_rows(x2)
        limit, spare = 4 * threshold * threshold, most_by_chance(chance, 2)
        found, near = rank_two_members(F, h1, h2, inliers, limit, spare, sphere=False)
        e = with_left_epipole(found, torch.ones_like(found[..., 0]))[..., 3:]
        rivals = torch.stack([torch.cat((found, side * e), -1) for side in (1, -1)], 2)

        def rise(model: Tensor, others: Tensor, weights: Tensor) -> Tensor:
            F, e = torch.split(model, [3, 1], -1)
            A, _ = step_equations(F, e, x1[:, None], x2[:, None], lambda _: (weights, weights))
            f, g = F.flatten(-2), others[..., :3].flatten(-2)
            normals = torch.stack((f, cofactors(F).flatten(-2)), -1)
            basis = qr(normals)[0]
            d = torch.where((f * g).sum(-1, keepdim=True) < 0, -g, g) - f
            d = d[..., None] - basis @ (basis.mT @ d[..., None])
            return (d.mT @ A @ d)[..., 0, 0]

        return rival_explains(self, model, rivals, near, (x1, x2), inliers, threshold, chance, rise)


def _cofactors(f: Tensor) -> Tensor:
    return cofactors(matrices(f, 3)).flatten(-2)


def _determinant_step(f: Tensor) -> Tensor:
    """Move matrices of small determinant towards determinant 0 by a Newton step along its gradient, and to norm 1."""
    c = _cofactors(f)
    square = (c * c).sum(-1, keepdim=True)
    f = torch.addcmul(f, (c * f).sum(-1, keepdim=True) / square.clamp(min=_TINY), c, value=-1 / 3)
    length: Tensor = torch.linalg.vector_norm(f, dim=-1, keepdim=True)
    return f / length.clamp(min=_TINY)


def estimate_fundamental(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 3"]]:
    """The fundamental matrix of each pair of images, from correspondences of which many may be wrong.

    LO-RANSAC over seven-point samples with the oriented epipolar constraint; where most inliers are in a plane, also over its
    homography and pairs of points off it (DEGENSAC); then a robust minimum of Sampson's distance over the matrices of rank 2.
    Computed in float64, hypotheses scored in float32. Points of one plane alone, or a pure rotation of the camera, leave F open
    in two dimensions, and those of a ruled quadric through both centres agree with two or three F: `degeneracy` says so.

    Args:
        x1: Points in the first image.
        x2: The corresponding points in the second image, in the same unit.
        threshold: Largest Sampson distance of an inlier, in the unit of the points.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        F with x2' F x1 = 0, |F| = 1 (Frobenius), det F = 0 and its largest entry positive; inliers, support, iterations,
        status, degeneracy (PLANAR: a homography relates all inliers but so few as chance explains: a planar scene, or a camera
        that only turned; COLLINEAR: so many are on a line in an image; F is then one of many; UNDETERMINED: another F agrees
        with them as well), covariance (9 x 9, of rank 7).
        F carries its derivatives with respect to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(8, 200, generator=g), torchsfm.random_poses(8, 2, generator=g)  # eight pairs
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(8, 1, generator=g))
        >>> seen = torchsfm.simulate_images(X, poses, camera, noise=0.5, outliers=0.1, generator=g)
        >>> x1, x2 = seen.x.unbind(1)
        >>> found = torchsfm.estimate_fundamental(x1, x2, threshold=2.0, generator=g)
        >>> found.model.shape, bool((found.inliers.sum(-1) > 140).all())
        (torch.Size([8, 3, 3]), True)
    """
    check_door({"x1": (x1, "n 2"), "x2": (x2, "n 2")}, threshold, options)
    y = common_scale(x1.double(), x2.double(), options.get("mask"))

    def back(model: Tensor) -> Tensor:
        F = product(product(y.T2.mT, model[..., :3]), y.T1)
        return largest_positive(matrices(_determinant_step(F.flatten(-2)), 3))

    return estimate_robustly(
        FundamentalEstimator(), y.x1, y.x2, threshold=threshold, dtype=x1.dtype, scale=y.scale, back=back, **options
    )  # fmt: skip
