"""Three projective cameras from correspondences over three images of which many are wrong."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Unpack

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes
from torchsfm.linalg import damped_solve
from torchsfm.motion.three_views.multilinear_fit import frame_directions, free_directions, inverse_similarity
from torchsfm.motion.three_views.point_line_trifocal import PointLineTrifocalEstimator
from torchsfm.motion.three_views.three_view_parallax import alternatives_of_plane, planar, planar_suspected
from torchsfm.motion.three_views.trifocal_6pt import trifocal_6pt
from torchsfm.motion.three_views.trifocal_reprojection import linear_depths, normal_equations, squared_distance
from torchsfm.motion.three_views.unseen_change import change_unseen
from torchsfm.motion.two_views.collinear import collinear, collinear_suspected
from torchsfm.motion.two_views.normalization import common_scale_of_views
from torchsfm.motion.two_views.plane_and_parallax import more_than_chance, most_by_chance
from torchsfm.robust import (
    Degeneracy,
    RansacOptions,
    RobustResult,
    Weigh,
    check_counts,
    check_door,
    constant_weights,
    estimate_robustly,
)
from torchsfm.tensors import canonical_cameras
from torchsfm.tensors.canonical import canonical_frame

_CLEAR, _FINE = 3.0, 0.05
"""How far points must move for a change of cameras to be seen: so many standard deviations, and so much of the threshold."""


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

    def places(
        self,
        model: Float[Tensor, "*#batch 2 3 4"],
        x1: Float[Tensor, "*#batch n 2"],
        x2: Float[Tensor, "*#batch n 2"],
        x3: Float[Tensor, "*#batch n 2"],
    ) -> Float[Tensor, "*batch n 6"]:
        """All three points."""
        return torch.cat((x1, x2, x3), -1)

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
        few = collinear_suspected((x1, x2, x3), inliers, threshold, chance)
        return flat | few | _unseen(model, (x1, x2, x3), inliers, threshold, 2 + chance)

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
        UNDETERMINED: they leave a large change of the cameras unseen for another reason.
        """
        on = planar(model, (x1, x2, x3), inliers, threshold * threshold)
        flat = on.any(-1) & ~more_than_chance((inliers & ~on).sum(-1), chance, 2)
        unseen = _unseen(model, (x1, x2, x3), inliers, threshold, 2 + chance)
        code = torch.where(unseen, int(Degeneracy.UNDETERMINED), int(Degeneracy.NONE))
        code = torch.where(flat, int(Degeneracy.PLANAR), code)
        lined = collinear((x1, x2, x3), inliers, threshold, chance)
        return torch.where(lined, int(Degeneracy.COLLINEAR), code).to(torch.int8)


def _unseen(model: Tensor, x: Sequence[Tensor], inliers: Tensor, threshold: Tensor, spare: Tensor) -> Tensor:
    """Whether the inliers leave a large change of the cameras unseen."""
    # Noise may be far less than the threshold allows.
    squared, _ = squared_distance(model, [_rows(y) for y in x])
    mean = torch.where(inliers, squared, 0.0).sum(-1) / inliers.sum(-1).clamp(min=1)
    noise = (mean.to(threshold.dtype) / 3).sqrt()
    threshold = torch.minimum(torch.maximum(_CLEAR * noise, _FINE * threshold), threshold)
    one = constant_weights(torch.ones_like(inliers, dtype=model.dtype)[..., None])
    alone, _ = normal_equations(model[..., None, :, :, :], [_rows(y[..., None, :]) for y in x], one)
    return change_unseen(model, alone, inliers, threshold, spare)


def _rows(x: Tensor) -> list[Tensor]:
    return [x[..., 0], x[..., 1]]


def estimate_trifocal(
    x: Float[Tensor, "*#batch 3 n 2"],
    l: Float[Tensor, "*#batch 3 k 2 2"] | None = None,  # noqa: E741
    *,
    threshold: float | Float[Tensor, "*#batch"] | None,
    **options: Unpack[RansacOptions],
) -> RobustResult[Float[Tensor, "*batch 3 3 4"]]:
    """Three projective cameras for each triplet of images, from points, and lines, of which many may be wrong.

    LO-RANSAC over six-point samples; where most inliers are in a plane, also over its homographies and pairs of points off it
    (as DEGENSAC does for two views); then a robust minimum of the reprojection error over the cameras and all points. Computed
    in float64, hypotheses scored in float32. `trifocal_from_cameras` makes the tensor of them. Points of one plane, or centres
    that coincide, leave the cameras open.

    With lines a datum is a point or a line, all points before all lines: `mask`, `quality`, `weights` and the result's
    `inliers` have n + k entries. Samples are of points, and of four points and three lines, by turns; where fewer than four
    points are given, of thirteen lines, which cost many more samples where much is wrong.

    Args:
        x: Points in the three images; there may be none with lines.
        l: Segments of the same lines in the three images, two points each. They need not show the same piece of a line.
        threshold: Largest distance of an inlier, in the unit of the points: the root of the sum of squared distances in the
            three images to those of one point in space; of a line, of all six ends of its segments from the images of one line.
            None where it is not known: more than half of the correspondences must then be right (`LeastMedian`).
        **options: See `RansacOptions`.

    Returns:
        Cameras (*batch, view, 3, 4) in the frame of `canonical_cameras`; inliers, support, iterations, status, degeneracy
        (PLANAR: homographies relate all inliers but so few as chance explains; COLLINEAR: so many are on a line in an image;
        UNDETERMINED: a large change of the cameras is not seen by more than so few, as of points on two lines or where
        centres coincide; the cameras are then some of many), covariance (36 x 36, of rank 18). The cameras carry their
        derivatives with respect to the inliers (see `ransac`).

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(100, generator=g), torchsfm.random_poses(3, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> found = torchsfm.estimate_trifocal(x, threshold=1e-3, generator=g)
        >>> bool(found.model.allclose(torchsfm.tensors.canonical_cameras(P), atol=1e-6))
        True
        >>> segments = torch.stack((x[:, :40], x[:, 40:80]), -2)  # forty lines besides five points
        >>> found = torchsfm.estimate_trifocal(x[:, 80:85], segments, threshold=1e-3, generator=g)
        >>> found.inliers.sum(), bool(found.model.allclose(torchsfm.tensors.canonical_cameras(P), atol=1e-6))
        (tensor(45), True)
    """
    data: dict[str, tuple[Tensor | None, str]] = {"x": (x, "3 n 2"), "l": (l, "?3 k 2 2")}
    check_door(data, threshold, options, of_datum="n" if l is None else "m")
    estimator: TrifocalEstimator | PointLineTrifocalEstimator
    mask = options.get("mask")
    if l is None:
        rows, S, scale = common_scale_of_views(list(x.double().unbind(-3)), mask)
        estimator = TrifocalEstimator()
    else:
        check_counts(x.shape[-2] + l.shape[-3], **{name: options.get(name) for name in ("mask", "quality", "weights")})  # type: ignore[arg-type]
        rows, S, scale = _table(x.double(), l.double(), mask)
        estimator = PointLineTrifocalEstimator(7 if x.shape[-2] >= 4 else 13)
    S_inverse = inverse_similarity(torch.stack(S, -3))

    def back(model: Tensor) -> Tensor:
        first = torch.eye(3, 4, dtype=model.dtype, device=model.device).expand(*model.shape[:-3], 1, 3, 4)
        return canonical_cameras(S_inverse @ torch.cat((first, model), -3))

    return estimate_robustly(estimator, *rows, threshold=threshold, dtype=x.dtype, scale=scale, back=back, **options)


def _table(x: Tensor, l: Tensor, mask: Tensor | None) -> tuple[list[Tensor], list[Tensor], Tensor]:  # noqa: E741
    """The rows of points and lines of moderate size around 0, and what they are; NaN for segments that are none."""
    batch = broadcast_shapes(x.shape[:-3], l.shape[:-4])
    n, k = x.shape[-2], l.shape[-3]
    ends = l.expand(*batch, 3, k, 2, 2)
    none = ((ends[..., 0, :] == ends[..., 1, :]).all(-1) | ~ends.isfinite().flatten(-2).all(-1)).any(-2)
    ends = torch.where(none[..., None, :, None, None], torch.nan, ends)
    # A line has two places in an image.
    places = torch.cat((x.expand(*batch, 3, n, 2), ends[..., 0, :], ends[..., 1, :]), -2)
    each = None if mask is None else torch.cat((mask, mask[..., n:]), -1)
    views, S, scale = common_scale_of_views(list(places.unbind(-3)), each)
    rows = [torch.cat((v[..., : n + k, :], torch.cat((v[..., :n, :], v[..., n + k :, :]), -2)), -1) for v in views]
    kind = torch.cat((x.new_zeros(n, 1), x.new_ones(k, 1)))
    return [*rows, kind], S, scale
