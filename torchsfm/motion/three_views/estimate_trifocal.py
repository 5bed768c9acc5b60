"""Three projective cameras from correspondences over three images of which many are wrong."""

from dataclasses import dataclass
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions
from torchsfm.linalg import damped_solve
from torchsfm.motion.three_views.multilinear_fit import frame_directions, free_directions, inverse_similarity
from torchsfm.motion.three_views.three_view_parallax import alternatives_of_plane, planar, planar_suspected
from torchsfm.motion.three_views.trifocal_6pt import trifocal_6pt
from torchsfm.motion.three_views.trifocal_reprojection import linear_depths, normal_equations, squared_distance
from torchsfm.motion.two_views.collinear import collinear, collinear_suspected
from torchsfm.motion.two_views.normalization import common_scale_of_views
from torchsfm.motion.two_views.plane_and_parallax import more_than_chance, most_by_chance
from torchsfm.robust import Degeneracy, RansacOptions, RobustResult, Weigh, check_door, estimate_robustly
from torchsfm.tensors import canonical_cameras
from torchsfm.tensors.canonical import canonical_frame


@dataclass(frozen=True)
class TrifocalEstimator:
    """Three projective cameras, the first [I | 0]; models are the other two (2, 3, 4) in the frame of `canonical_cameras`.

    The points should be of moderate size around 0. The distance of a triplet is the root of the sum of squared distances in
    the three images to those of one point in space, the best to first order from a linear start. It is infinite for points
    behind the second or third camera, which are signed so that the points they come from are in front.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(100, generator=g), torchsfm.random_poses(3, generator=g)
        >>> x = torchsfm.project_points(poses, X)
        >>> estimator = torchsfm.motion.TrifocalEstimator()
        >>> found = torchsfm.ransac(estimator, *x, threshold=1e-3, generator=g)
        >>> found.model.shape, found.inliers.sum()  # the second and the third camera
        (torch.Size([2, 3, 4]), tensor(100))
    """

    model_name: ClassVar[str] = "trifocal"
    data_names: ClassVar[tuple[str, ...]] = ("x1", "x2", "x3")
    sample_size: ClassVar[int] = 6
    max_solutions: ClassVar[int] = 3
    codimension: ClassVar[int] = 3
    dimension: ClassVar[int] = 18
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x1: Float[Tensor, "*#batch 6 2"], x2: Float[Tensor, "*#batch 6 2"], x3: Float[Tensor, "*#batch 6 2"]
    ) -> Solutions[Float[Tensor, "*batch 3 2 3 4"]]:
        """The cameras of six points that can be in front of all three."""
        x = torch.stack(torch.broadcast_tensors(x1, x2, x3), -3)  # type: ignore[no-untyped-call]
        solutions = trifocal_6pt(x)
        model = solutions.model[..., 1:, :, :]
        seen = [_rows(view.detach()[..., None, :, :]) for view in (x1, x2, x3)]
        depths = linear_depths(model.detach(), seen)
        plus, minus = depths.amin(-1) > 0, depths.amax(-1) < 0
        model = torch.where((minus & ~plus)[..., None, None], -model, model)
        return Solutions(model, solutions.valid & (plus | minus).all(-1))

    def squared_residual(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        x3: Float[Tensor, "*#batch n 2"],
    ) -> Float[Tensor, "*batch n"]:
        """Squared distance; infinite for points behind a camera."""
        squared, front = squared_distance(model, [_rows(x) for x in (x1, x2, x3)])
        return squared.masked_fill(~front, torch.inf)

    def degenerate(
        self, x1: Float[Tensor, "*#batch 6 2"], x2: Float[Tensor, "*#batch 6 2"], x3: Float[Tensor, "*#batch 6 2"]
    ) -> Bool[Tensor, "*batch"]:
        """Whether the first two points coincide in an image."""
        same = [(x[..., 0, :] == x[..., 1, :]).all(-1) for x in (x1, x2, x3)]
        return same[0] | same[1] | same[2]

    def step(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        x3: Float[Tensor, "*#batch n 2"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 2 3 4"]:
        """A Gauss-Newton step on the reprojection error over cameras and points, the frame and scales of the cameras held."""
        A, b = normal_equations(model, [_rows(x) for x in (x1, x2, x3)], weigh)
        P = model.double()
        G = frame_directions(P)
        G = G / (G * G).sum(-2, keepdim=True).clamp(min=1e-200).sqrt()
        A = A + A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * (G @ G.mT)
        step = damped_solve(A, b[..., None])[..., 0]
        moved = canonical_frame(P - step.reshape(*step.shape[:-1], 2, 3, 4), signed=False)
        return moved[..., 1:, :, :].to(x1.dtype)

    def retract(
        self, model: Float[Tensor, "*#batch 2 3 4"], step: Float[Tensor, "*#batch 18"]
    ) -> Float[Tensor, "*batch 2 3 4"]:
        """The cameras moved along a basis of the directions that change more than the frame and scales."""
        delta = (free_directions(model) @ step[..., None])[..., 0]
        moved: Tensor = model + delta.reshape(*delta.shape[:-1], 2, 3, 4)
        return moved

    def alternative_models(
        self,
        model: Float[Tensor, "p 2 3 4"],
        x1: Float[Tensor, "p n 2"],
        x2: Float[Tensor, "p n 2"],
        x3: Float[Tensor, "p n 2"],
        *,
        inside: Bool[Tensor, "p n"],
        threshold: Float[Tensor, "p"],
        seed: int,
    ) -> Solutions[Float[Tensor, "p k 2 3 4"]]:
        """Where most inliers are in a plane, the best cameras of that plane and two points off it."""
        return alternatives_of_plane(self, model, (x1, x2, x3), inside, threshold, seed)

    def may_be_degenerate(
        self,
        model: Float[Tensor, "p 2 3 4"],
        x1: Float[Tensor, "p n 2"],
        x2: Float[Tensor, "p n 2"],
        x3: Float[Tensor, "p n 2"],
        *,
        inliers: Bool[Tensor, "p n"],
        threshold: Float[Tensor, "p"],
        chance: Float[Tensor, "p"],
    ) -> Bool[Tensor, "p"]:
        """Whether half of the inliers may be in one plane, or all but so few as chance explains, there or on a line."""
        flat = planar_suspected(model, (x1, x2, x3), inliers, threshold * threshold, most_by_chance(chance, 2))
        return flat | collinear_suspected((x1, x2, x3), inliers, threshold, chance)

    def degeneracy(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        x3: Float[Tensor, "*#batch n 2"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """What all inliers but so few as chance explains have in common, so that the cameras are open.

        PLANAR: homographies from the first image relate them to both others. COLLINEAR: in an image they are on a line.
        """
        on = planar(model, (x1, x2, x3), inliers, threshold * threshold)
        flat = on.any(-1) & ~more_than_chance((inliers & ~on).sum(-1), chance, 2)
        code = torch.where(flat, int(Degeneracy.PLANAR), int(Degeneracy.NONE))
        lined = collinear((x1, x2, x3), inliers, threshold, chance)
        return torch.where(lined, int(Degeneracy.COLLINEAR), code).to(torch.int8)


def _rows(x: Tensor) -> list[Tensor]:
    return [x[..., 0], x[..., 1]]


def estimate_trifocal(
    x: Float[Tensor, "*#batch 3 n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 3 4"]]:
    """Three projective cameras for each triplet of images, from correspondences of which many may be wrong.

    LO-RANSAC over six-point samples; where most inliers are in a plane, also over its homographies and pairs of points off it
    (as DEGENSAC does for two views); then a robust minimum of the reprojection error over the cameras and all points. Computed
    in float64, hypotheses scored in float32. `trifocal_from_cameras` makes the tensor of them. Points of one plane, or centres
    that coincide, leave the cameras open.

    Args:
        x: Points in the three images.
        threshold: Largest distance of an inlier, in the unit of the points: the root of the sum of squared distances in the
            three images to those of one point in space. None where it is not known: more than half of the correspondences must
            then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        Cameras (*batch, view, 3, 4) in the frame of `canonical_cameras`; inliers, support, iterations, status, degeneracy
        (PLANAR: homographies relate all inliers but so few as chance explains; COLLINEAR: so many are on a line in an image;
        the cameras are then some of many), covariance (36 x 36, of rank 18). The cameras carry their derivatives with respect
        to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(100, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> found = torchsfm.estimate_trifocal(torchsfm.project_points(P, X), threshold=1e-3, generator=g)
        >>> bool(found.model.allclose(torchsfm.tensors.canonical_cameras(P), atol=1e-6))
        True
    """
    check_door({"x": (x, "3 n 2")}, threshold, options)
    y, S, scale = common_scale_of_views(list(x.double().unbind(-3)), options.get("mask"))
    S_inverse = inverse_similarity(torch.stack(S, -3))

    def back(model: Tensor) -> Tensor:
        first = torch.eye(3, 4, dtype=model.dtype, device=model.device).expand(*model.shape[:-3], 1, 3, 4)
        return canonical_cameras(S_inverse @ torch.cat((first, model), -3))

    return estimate_robustly(TrifocalEstimator(), *y, threshold=threshold, dtype=x.dtype, scale=scale, back=back, **options)
