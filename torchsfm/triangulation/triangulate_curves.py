"""Curves in space from their images in known views, no point of which is in correspondence.

A sample of one image's curve is somewhere on its viewing ray. Where its epipolar line crosses another image's curve is a
candidate for its depth; further views vote for candidates by how near their curves pass. Of each sample one candidate is
chosen so that the curve in space hangs together: the path of most votes by dynamic programming (Viterbi 1967). Then each
sample moves in the plane across the curve to the least squares of the distances, normal to the image curves, in all views
that agree. Along the curve nothing moves it: the distances do not know where on the curve a sample is.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry import Curve
from torchsfm.optim import wants_derivative
from torchsfm.triangulation.curve_candidates import depth_candidates, depth_resolution, depth_votes, reference_view, samples_of
from torchsfm.triangulation.curve_path import best_path
from torchsfm.triangulation.curve_refinement import covariance_across, refine_samples, with_derivative
from torchsfm.triangulation.curve_views import curve_views

_KEPT = 16
"""Candidates of a sample that the path chooses from."""
_CELLS = 768
"""Crossings times samples of a lattice, by which the size of an element is reckoned."""
_NUMBERS = 1 << 23
"""Distances of candidates from image curves that are computed at a time."""
_SHARE = 0.5
"""Of the samples that must be determined for the curve to be found."""


@dataclass(frozen=True)
class CurveTriangulation:
    """Curves in space, and what is known of their samples.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 5, 100, dtype=torch.float64)
        >>> X = torch.stack((t.cos(), t.sin(), 0.2 * t), -1)  # a helix
        >>> K = torchsfm.intrinsics(torch.tensor(800.0, dtype=X.dtype), torch.tensor([320.0, 240.0], dtype=X.dtype))
        >>> P = K @ torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> curves = torchsfm.geometry.curve_from_samples(torchsfm.project_points(P, X))
        >>> found = torchsfm.triangulate_curves(curves, P, samples=30)
        >>> samples = found.curve.x[found.measured]
        >>> bool(torch.cdist(samples, X).min(-1).values.max() < 0.05), found.covariance.shape
        (True, torch.Size([30, 3, 3]))
    """

    curve: Curve
    """The curves, sample by sample as the `reference` view's curve runs, from the first sample that is measured to the last."""
    measured: Bool[Tensor, "*batch m"]
    """Which samples the views determine: three views agree, or both where there are only two. Others are bridged by straight
    lines."""
    error: Float[Tensor, "*batch v m"]
    """Distance of each sample's image from the view's curve in pixels; inf where the view does not count, as its curve ends
    before or passes farther away than the threshold, and where the sample is not measured."""
    covariance: Float[Tensor, "*batch m 3 3"]
    """Of measured samples across the curve, for independent noise of one pixel in every image curve; 0 for others."""
    reference: Int[Tensor, "*batch"]
    """The view whose curve was followed."""
    status: Int8[Tensor, "*batch"]
    """OK; TOO_FEW: fewer than two views with a curve of two samples; NO_CONSENSUS: the views agree on less than half of the
    samples; DEGENERATE: epipolar lines run along the curves, or no two views have a baseline."""


def triangulate_curves(
    curves: Curve,
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    samples: int = 100,
    threshold: float = 3.0,
    visible: Bool[Tensor, "*#batch v"] | None = None,
) -> CurveTriangulation:
    """Find space curves that project to given curves in two or more known views.

    The images need not show the same part of a curve, and no point of one is known to belong to a point of another. With two
    views an epipolar line may cross a curve several times: the answer is the one that hangs together best. Where epipolar lines
    run along the image curves in all views nothing tells the depth; such pieces are bridged, and said not to be `measured`.

    Outlines of smooth surfaces are not images of one curve: their samples agree with few views, or with none.

    Computed in float64. The derivative of the measured samples with respect to the curves' samples and the cameras is that of
    the least-squares optimum to first order in the distances (Gauss-Newton), along the curve zero.

    Args:
        curves: The image curves, one a view: fields of shape (*batch, v, n, 2), (*batch, v, n), (*batch, v), in pixels.
        P: Finite cameras `K [R | t]`, of any scale and sign.
        samples: Samples of each space curve.
        threshold: Largest distance, in pixels, of an image curve from the image of a sample that it agrees with.
        visible: Which views show the curve, all with at least two samples by default.

    Returns:
        The curves, which samples are determined, distances, covariances and status.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 5, 100, dtype=torch.float64)
        >>> X = torch.stack((t.cos(), t.sin(), 0.2 * t), -1)  # a helix
        >>> K = torchsfm.intrinsics(torch.tensor(800.0, dtype=X.dtype), torch.tensor([320.0, 240.0], dtype=X.dtype))
        >>> P = K @ torchsfm.random_poses(3, generator=torch.Generator().manual_seed(0)).matrix()
        >>> curves = torchsfm.geometry.curve_from_samples(torchsfm.project_points(P, X))
        >>> found = torchsfm.triangulate_curves(curves, P, samples=30)
        >>> found.status == torchsfm.Status.OK, bool(found.error[:, found.measured].max() < 0.1)
        (tensor(True), True)
    """
    check_options(curves=(curves, Curve), samples=(samples, "int >= 4"), threshold=(threshold, "float > 0"))
    batch = check_tensors(
        x=(curves.x, "v>=1 n>=2 2"), valid=(curves.valid, "v n: bool"), closed=(curves.closed, "v: bool"),
        P=(P, "v 3 4"), visible=(visible, "?v: bool"),
    )  # fmt: skip
    v, n = curves.x.shape[-3:-1]
    x = curves.x.double().expand(*batch, v, n, 2).reshape(-1, v, n, 2)
    valid = curves.valid.expand(*batch, v, n).reshape(-1, v, n)
    closed = curves.closed.expand(*batch, v).reshape(-1, v)
    cameras = P.double().expand(*batch, v, 3, 4).reshape(-1, v, 3, 4)
    seen = torch.ones_like(closed) if visible is None else visible.expand(*batch, v).reshape(-1, v)
    size = max(1, _NUMBERS // (samples * v * v * _CELLS))
    pieces = (slice(i, i + size) for i in range(0, max(len(x), 1), size))
    largest = torch.finfo(P.dtype).max
    parts = [_triangulate(Curve(x[i], valid[i], closed[i]), cameras[i], seen[i], samples, threshold, largest) for i in pieces]
    fields = (torch.cat(field) for field in zip(*parts, strict=True))
    points, there, around, *rest = (
        (f.to(P.dtype) if f.is_floating_point() else f).reshape(batch + f.shape[1:]) for f in fields
    )
    return CurveTriangulation(Curve(points, there, around), *rest)


def _triangulate(curve: Curve, P: Tensor, seen: Tensor, samples: int, threshold: float, largest: float) -> tuple[Tensor, ...]:
    """The fields of the curves in space, then the others of `CurveTriangulation`, for a flat batch."""
    with torch.no_grad():
        views = curve_views(Curve(curve.x.detach(), curve.valid, curve.closed), P.detach(), seen, threshold)
        reference, steep = reference_view(views)
        row = torch.arange(len(reference), device=reference.device)
        around = views.curve.closed[row, reference]
        followed = samples_of(views, reference, samples)
        depth = depth_candidates(views, followed).permute(0, 2, 1, 3).flatten(2)
        X = followed.at(depth)
        votes = depth_votes(views, X.flatten(1, 2), threshold) * views.others(reference)[..., None]
        votes = torch.where(depth > 0, votes.sum(1).view(depth.shape), 0)
        blur = threshold * depth_resolution(views, X, followed.direction)
        path = best_path(depth, votes, blur, followed.direction, _KEPT)
        start, found = followed.at(path.depth), path.sure
        X, basis, near, measured = refine_samples(views, start, found, around)
        measured = measured & (X.abs() <= largest).all(-1)
        X = torch.where(measured[..., None], X, 0)
    if wants_derivative(curve.x, P):
        X = with_derivative(curve, P, views, X, basis, near, measured)
    with torch.no_grad():
        enough = views.used.sum(-1) >= 2
        agreed = measured.sum(-1) >= _SHARE * samples
        status = torch.where(steep, int(Status.NO_CONSENSUS), int(Status.DEGENERATE))
        status = torch.where(agreed, int(Status.OK), status)
        status = torch.where(enough, status, int(Status.TOO_FEW)).to(torch.int8)
        covariance = covariance_across(views, X.detach(), basis, near)
        counted = (near.weight > 0) & measured[:, None]
        slots = torch.arange(samples, device=X.device)
        first = torch.where(measured, slots, samples).amin(-1, keepdim=True)
        last = torch.where(measured, slots, -1).amax(-1, keepdim=True)
        whole = around & (first == 0)[:, 0] & (last == samples - 1)[:, 0]
        there = slots <= last - first
        index = torch.where(there, slots + first, 0)
        kept = measured.gather(-1, index) & there
        error = torch.where(counted, near.r.abs(), torch.inf)
        error = error.gather(-1, index[:, None].expand(error.shape)).masked_fill(~there[:, None], torch.inf)
        covariance = torch.where(kept[..., None, None], covariance[row[:, None], index], 0)
    X = torch.where(there[..., None], _bridged(X, measured)[row[:, None], index], 0)
    return X, there, whole, kept, error, covariance, reference, status


def _bridged(X: Float[Tensor, "p m 3"], measured: Bool[Tensor, "p m"]) -> Float[Tensor, "p m 3"]:
    """Samples that are not measured on the straight line between the nearest that are."""
    m = X.shape[1]
    slots = torch.arange(m, device=X.device)
    before = torch.where(measured, slots, 0).cummax(-1).values
    after = torch.where(measured, slots, m - 1).flip(-1).cummin(-1).values.flip(-1)
    t = ((slots - before).to(X.dtype) / (after - before).clamp(min=1))[..., None]
    place = torch.arange(len(X), device=X.device)[:, None]
    return torch.where(measured[..., None], X, X[place, before] * (1 - t) + X[place, after] * t)
