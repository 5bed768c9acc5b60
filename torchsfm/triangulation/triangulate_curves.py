"""Curves in space from their images in known views, no point of which is in correspondence.

A sample of one image's curve is somewhere on its viewing ray. Where its epipolar line crosses another image's curve is a
candidate for its depth; further views vote for candidates by how near their curves pass. Of each sample one candidate is
chosen so that the curve in space hangs together: the path of most votes by dynamic programming (Viterbi 1967). Then each
sample moves in the plane across the curve to the least squares of the distances, normal to the image curves, in all views
that agree. Along the curve nothing moves it: the distances do not know where on the curve a sample is.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry import Curve, curve_crossings, curve_from_samples, foot_points
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import inverse
from torchsfm.optim import wants_derivative

_CROSSINGS = 6
"""Most crossings of an epipolar line with a curve that become candidates."""
_KEPT = 16
"""Candidates of a sample that the path chooses from."""
_PROBES = 24
"""Samples by which the view is chosen whose samples are followed."""
_STEEP = 0.1
"""Sine of the angle between curve and epipolar line below which a crossing says nothing of the depth."""
_ROUNDING = 1e-10
"""Of an epipole, relative to what it is a sum of: less is no baseline."""
_LEAP, _LEAP_COST = 10.0, 0.3
"""A step in depth of so many steps across the rays is a leap, and what it costs, in votes; shorter ones in proportion."""
_STEPS = 8
"""Gauss-Newton steps of samples: they begin within the threshold."""
_BLUR = 0.05
"""Standard deviation of a sample for noise of one pixel, relative to its depth, beyond which it is not determined."""
_LATTICE = 128
"""Samples of the image curves among which votes are counted."""
_NUMBERS = 1 << 23
"""Distances of candidates from image curves that are computed at a time."""
_SHARE = 0.5
"""Of the samples that must be determined for the curve to be found."""


@dataclass(frozen=True)
class CurveTriangulation:
    """Curves in space, and what is known of their samples."""

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
    """
    batch = check_tensors(
        x=(curves.x, "v>=1 n>=2 2"), valid=(curves.valid, "v n: bool"), closed=(curves.closed, "v: bool"),
        P=(P, "v 3 4"), visible=(visible, "?v: bool"),
    )  # fmt: skip
    check_options(samples=(samples, "int >= 4"), threshold=(threshold, "float > 0"))
    v, n = curves.x.shape[-3:-1]
    x = curves.x.double().expand(*batch, v, n, 2).reshape(-1, v, n, 2)
    valid = curves.valid.expand(*batch, v, n).reshape(-1, v, n)
    closed = curves.closed.expand(*batch, v).reshape(-1, v)
    cameras = P.double().expand(*batch, v, 3, 4).reshape(-1, v, 3, 4)
    seen = torch.ones_like(closed) if visible is None else visible.expand(*batch, v).reshape(-1, v)
    size = max(1, _NUMBERS // (samples * v * _CROSSINGS * v * min(n, _LATTICE)))
    pieces = (slice(i, i + size) for i in range(0, max(len(x), 1), size))
    largest = torch.finfo(P.dtype).max
    parts = [_triangulate(Curve(x[i], valid[i], closed[i]), cameras[i], seen[i], samples, threshold, largest) for i in pieces]
    fields = (torch.cat(field) for field in zip(*parts, strict=True))
    points, there, around, *rest = (
        (f.to(P.dtype) if f.is_floating_point() else f).reshape(batch + f.shape[1:]) for f in fields
    )
    return CurveTriangulation(Curve(points, there, around), *rest)


class _Views(NamedTuple):
    """Image curves and their cameras."""

    curve: Curve
    """(p, v)."""
    P: Float[Tensor, "p v 3 4"]
    """Scaled so that depths are those in the world, positive in front."""
    used: Bool[Tensor, "p v"]

    def project(self, X: Float[Tensor, "p m 3"]) -> tuple[Float[Tensor, "p v m 2"], Float[Tensor, "p v m"]]:
        """Image points and depths."""
        y = X[:, None] @ self.P[..., :3].mT + self.P[:, :, None, :, 3]
        return divide_safely(y[..., :2], y[..., 2]), y[..., 2]

    def others(self, reference: Int[Tensor, "p"]) -> Bool[Tensor, "p v"]:
        """The views in use but one."""
        return self.used & (torch.arange(self.used.shape[-1], device=reference.device) != reference[:, None])


class _Distances(NamedTuple):
    """Of the images of points from the image curves."""

    r: Float[Tensor, "p v m"]
    """Signed, along `normal`."""
    image: Float[Tensor, "p v m 2"]
    depth: Float[Tensor, "p v m"]
    normal: Float[Tensor, "p v m 2"]
    weight: Float[Tensor, "p v m"]
    """(1 - (r / threshold)^2)^2 (Tukey's biweight); 0 beyond the threshold, behind a camera and beyond an open end."""


def _triangulate(curve: Curve, P: Tensor, seen: Tensor, samples: int, threshold: float, largest: float) -> tuple[Tensor, ...]:
    """The fields of the curves in space, then the others of `CurveTriangulation`, for a flat batch."""
    with torch.no_grad():
        views = _views(Curve(curve.x.detach(), curve.valid, curve.closed), P.detach(), seen)
        reference, steep = _reference(views)
        row = torch.arange(len(reference), device=reference.device)
        ray = views.curve.resample(samples).x[row, reference]
        around = views.curve.closed[row, reference]
        centre, direction = _rays(views.P[row, reference], ray)
        depth, found = _path(views, reference, centre, direction, threshold)
        start = centre[:, None] + depth[..., None] * direction
        X, basis, near, measured = _refine(views, start, found, around, threshold)
        measured = measured & (X.abs() <= largest).all(-1)
        X = torch.where(measured[..., None], X, 0)
    if wants_derivative(curve.x, P):
        X = _with_derivative(curve, P, views, X, basis, near, measured)
    with torch.no_grad():
        enough = views.used.sum(-1) >= 2
        agreed = measured.sum(-1) >= _SHARE * samples
        status = torch.where(steep, int(Status.NO_CONSENSUS), int(Status.DEGENERATE))
        status = torch.where(agreed, int(Status.OK), status)
        status = torch.where(enough, status, int(Status.TOO_FEW)).to(torch.int8)
        covariance = _covariance(views, X.detach(), basis, near)
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


def _views(curve: Curve, P: Tensor, seen: Tensor) -> _Views:
    axes = torch.eye(3, 4, dtype=P.dtype, device=P.device)
    sound = torch.isfinite(P).flatten(2).all(-1)
    P = torch.where(sound[..., None, None], P, axes)
    last = torch.linalg.vector_norm(P[..., 2, :3], dim=-1)
    P = P / torch.where(last > 0, last, 1)[..., None, None]
    a, b, c = P[..., :3].unbind(-2)
    sign = (a * torch.linalg.cross(b, c)).sum(-1).sign()
    length = curve.length
    used = seen & sound & (last > 0) & (sign != 0) & (length > 0) & (length < torch.inf)
    return _Views(curve, torch.where(used[..., None, None], sign[..., None, None] * P, axes), used)


def _rays(P: Float[Tensor, "*b 3 4"], x: Float[Tensor, "*b m 2"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b m 3"]]:
    """The centres, and the unit directions of the rays of image points."""
    back, _ = inverse(P[..., :3])
    rays = torch.cat((x, torch.ones_like(x[..., :1])), -1) @ back.mT
    return -(back @ P[..., 3:])[..., 0], torch.nn.functional.normalize(rays, dim=-1)


def _candidates(
    views: _Views, reference: Int[Tensor, "p"], centre: Float[Tensor, "p 3"], direction: Float[Tensor, "p m 3"]
) -> Float[Tensor, "p v m k"]:
    """Depths at which rays of the reference view meet the viewing cones of the other curves; 0 where they do not."""
    M = views.P[..., :3]
    epipole = (M @ centre[:, None, :, None])[..., 0] + views.P[..., 3]
    size = torch.linalg.matrix_norm(M) * torch.linalg.vector_norm(centre, dim=-1)[:, None]
    baseline = torch.linalg.vector_norm(epipole, dim=-1) > _ROUNDING * (
        size + torch.linalg.vector_norm(views.P[..., 3], dim=-1)
    )
    vanishing = direction[:, None] @ M.mT
    a, b = epipole[:, :, None].expand_as(vanishing), vanishing
    met = curve_crossings(views.curve, torch.linalg.cross(a, b), _CROSSINGS)
    y = torch.cat((met.x, torch.ones_like(met.x[..., :1])), -1)
    a, b = a[..., None, :].expand_as(y), b[..., None, :].expand_as(y)
    across, far = torch.linalg.cross(y, b), torch.linalg.cross(y, a)
    square = across.square().sum(-1)
    depth = -(far * across).sum(-1) / torch.where(square > 0, square, 1)
    in_front = b[..., 2] * depth + a[..., 2] > 0
    good = met.valid & (square > 0) & (depth > 0) & in_front & (met.sine > _STEEP)
    return torch.where(good & (views.others(reference) & baseline)[..., None, None], depth, 0)


def _reference(views: _Views) -> tuple[Int[Tensor, "p"], Bool[Tensor, "p"]]:
    """The view whose samples meet most of the other curves, and whether half of its samples meet any."""
    probes = views.curve.resample(_PROBES).x
    met = []
    for i in range(views.used.shape[-1]):
        view = torch.full((len(probes),), i, device=probes.device)
        depth = _candidates(views, view, *_rays(views.P[:, i], probes[:, i]))
        met.append((depth > 0).any(-1).sum(1))
    number = torch.stack(met, 1)
    length = torch.where(views.used, views.curve.length, 0)
    # Of views that do as well, the one that sees most.
    score = number.clamp(max=4).sum(-1) + 0.5 * length / length.amax(-1, keepdim=True).clamp_min(1e-300)
    best = torch.where(views.used, score, -1).argmax(-1)
    steep = (number.gather(1, best[:, None, None].expand(-1, 1, _PROBES))[:, 0] > 0).sum(-1)
    return best, 2 * steep >= _PROBES


def _distances(views: _Views, X: Float[Tensor, "p m 3"], threshold: float) -> _Distances:
    y, depth = views.project(X)
    foot = foot_points(views.curve, y)
    normal = torch.stack((-foot.tangent[..., 1], foot.tangent[..., 0]), -1)
    r = ((y - foot.x) * normal).sum(-1)
    u = (r / threshold).square()
    counted = foot.within & (depth > 0) & views.used[..., None] & (u < 1)
    return _Distances(r, y, depth, normal, torch.where(counted, (1 - u).square(), 0))


def _path(
    views: _Views, reference: Tensor, centre: Tensor, direction: Tensor, threshold: float
) -> tuple[Float[Tensor, "p m"], Bool[Tensor, "p m"]]:
    """The depths of the path with most votes, and which samples have any."""
    depth = _candidates(views, reference, centre, direction).permute(0, 2, 1, 3).flatten(2)
    p, m, c = depth.shape
    X = centre[:, None, None] + depth[..., None] * direction[:, :, None]
    rough = views._replace(curve=views.curve.resample(min(_LATTICE, views.curve.x.shape[-2])))
    votes = _distances(rough, X.flatten(1, 2), threshold).weight * views.others(reference)[..., None]
    votes = torch.where(depth > 0, votes.sum(1).view(p, m, c), -torch.inf)
    votes, order = votes.topk(min(_KEPT, c), dim=-1)
    depth = depth.gather(-1, order)
    found = votes[..., 0] > 0
    votes = torch.where(found[..., None], votes, 0)
    # How far a sample moves across the rays from one to the next, for a depth of 1.
    stride = torch.linalg.vector_norm(direction[:, 1:] - direction[:, :-1], dim=-1)
    total, came = votes[:, 0], []
    for k in range(1, m):
        before = depth[:, k - 1, :, None]
        leap = (depth[:, k, None] - before).abs() / (_LEAP * stride[:, k - 1, None, None] * before).clamp_min(1e-300)
        known = found[:, k] & found[:, k - 1]
        best, index = (total[..., None] - _LEAP_COST * leap.clamp(max=1) * known[:, None, None]).max(1)
        came.append(index)
        total = best + votes[:, k]
    chosen = [total.argmax(-1, keepdim=True)]
    for index in reversed(came):
        chosen.append(index.gather(-1, chosen[-1]))
    slot = torch.stack(chosen[::-1], 1)
    chosen_depth = depth.gather(-1, slot)[..., 0]
    return chosen_depth, found & (chosen_depth > 0)


def _refine(
    views: _Views, X: Tensor, found: Tensor, around: Tensor, threshold: float
) -> tuple[Tensor, Float[Tensor, "p m 3 2"], _Distances, Bool[Tensor, "p m"]]:
    """Samples at the least squares of distances, directions across the curve, distances, and which samples are determined."""
    far = _depth(views, X)
    for _ in range(_STEPS):
        basis = _across(X, found, around)
        near = _distances(views, X, threshold)
        J = _slopes(views.P, near, basis)
        back, ok = inverse(_normal(J, near.weight))
        slope = ((near.weight * near.r)[..., None] * J).sum(1)
        step = -(basis @ (back @ slope[..., None]))[..., 0]
        # No farther than a tenth of the depth: a sample that little holds is not determined in the end.
        size = torch.linalg.vector_norm(step, dim=-1)
        step = step * (0.1 * far / size.clamp_min(1e-300)).clamp(max=1)[..., None]
        X = torch.where((found & ok & torch.isfinite(size))[..., None], X + step, X)
    basis = _across(X, found, around)
    near = _distances(views, X, threshold)
    A = _normal(_slopes(views.P, near, basis), near.weight)
    half, product = (A[..., 0, 0] + A[..., 1, 1]) / 2, A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1].square()
    least = product / (half + (half.square() - product).clamp(min=0).sqrt()).clamp_min(1e-300)
    # What two views agree on they always agree on; a third one tells.
    several = (near.weight > 0.25).sum(1) >= views.used.sum(-1, keepdim=True).clamp(max=3)
    measured = found & several & (least > 0) & (least.clamp_min(1e-300).rsqrt() < _BLUR * _depth(views, X))
    return X, basis, near, measured


def _depth(views: _Views, X: Tensor) -> Float[Tensor, "p m"]:
    """Distance from the nearest camera that is used."""
    depth = views.project(X)[1].abs()
    return torch.where(views.used[..., None], depth, torch.inf).amin(1).clamp(max=1e300)


def _across(X: Tensor, found: Tensor, around: Tensor) -> Float[Tensor, "p m 3 2"]:
    """Two unit vectors across the curve through the samples found; any at others."""
    tangent = foot_points(curve_from_samples(X, valid=found, closed=around), X).tangent
    some = (tangent != 0).any(-1, keepdim=True)
    tangent = torch.where(some, tangent, tangent.new_tensor([1.0, 0.0, 0.0]))
    helper = torch.zeros_like(tangent).scatter_(-1, tangent.abs().argmin(-1, keepdim=True), 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(tangent, helper), dim=-1)
    return torch.stack((first, torch.linalg.cross(tangent, first)), -1)


def _slopes(P: Tensor, near: _Distances, basis: Tensor) -> Float[Tensor, "p v m 2"]:
    """The derivatives of distances by steps across the curve: n' (M - y m3') / depth."""
    M = P[..., :3]
    rows = near.normal @ M[..., :2, :] - (near.normal * near.image).sum(-1, keepdim=True) * M[..., 2:, :]
    return divide_safely((rows[..., None, :] @ basis[:, None])[..., 0, :], near.depth)


def _normal(J: Tensor, weight: Tensor) -> Float[Tensor, "p m 2 2"]:
    return (weight[..., None, None] * J[..., :, None] * J[..., None, :]).sum(1)


def _covariance(views: _Views, X: Tensor, basis: Tensor, near: _Distances) -> Float[Tensor, "p m 3 3"]:
    """The inverse of the normal matrix, in the world: views that agree count alike."""
    counted = (near.weight > 0).to(X.dtype)
    back, _ = inverse(_normal(_slopes(views.P, near, basis), counted))
    return basis @ back @ basis.mT


def _with_derivative(
    curve: Curve, P: Tensor, views: _Views, X: Tensor, basis: Tensor, near: _Distances, measured: Tensor
) -> Tensor:
    """Attach the derivatives of measured samples: a Gauss-Newton step from the optimum is next to nothing and has them."""
    J = _slopes(views.P, near, basis)
    back, _ = inverse(_normal(J, near.weight))
    scale = (views.P[..., 2, :3] * P.detach()[..., 2, :3]).sum(-1) / views.P[..., 2, :3].square().sum(-1)
    safe = torch.where(views.used, scale, 1)[..., None, None]
    cameras = torch.where(views.used[..., None, None], P / safe, views.P)
    image, _ = _Views(views.curve, cameras, views.used).project(X)
    r = ((image - foot_points(curve, near.image).x) * near.normal).sum(-1)
    slope = ((near.weight * (r - r.detach()))[..., None] * J).sum(1)
    step = -(basis @ (back @ slope[..., None]))[..., 0]
    return X + torch.where(measured[..., None], step, 0)


def _bridged(X: Float[Tensor, "p m 3"], measured: Bool[Tensor, "p m"]) -> Float[Tensor, "p m 3"]:
    """Samples that are not measured on the straight line between the nearest that are."""
    m = X.shape[1]
    slots = torch.arange(m, device=X.device)
    before = torch.where(measured, slots, 0).cummax(-1).values
    after = torch.where(measured, slots, m - 1).flip(-1).cummin(-1).values.flip(-1)
    t = ((slots - before) / (after - before).clamp(min=1)).to(X.dtype)[..., None]
    place = torch.arange(len(X), device=X.device)[:, None]
    return torch.where(measured[..., None], X, X[place, before] * (1 - t) + X[place, after] * t)
