"""Lines of space from their images in known views: planes meet, then the ends of segments are brought near."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry import Line3D
from torchsfm.geometry.line_manifold import line_tangents, world_covariance
from torchsfm.linalg import cross, eigvalsh, inverse
from torchsfm.optim import Loss, levenberg_marquardt
from torchsfm.triangulation.line_views import (
    SAME,
    LineViews,
    SeenParts,
    frame_of_centres,
    frame_of_line,
    in_frame,
    in_world,
    linear_lines,
    linearize,
    observe,
    one_centre,
    one_plane,
    residuals,
    seen_parts,
)

PIECE = 1 << 17
"""Observations at a time."""
_EXACT = 1e-11
"""Error, over the size of the coordinates, that is rounding's."""
_UNSURE = 0.3
"""Deviation across the line, over its distance from the cameras, at which noise of one unit leaves no line."""


class LineFault(IntEnum):
    """Why views do not determine a line.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.triangulation import LineFault
        >>> t = torch.tensor([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]).double()  # two cameras side by side
        >>> pose = torchsfm.Pose(torch.eye(3).double().expand(2, 3, 3), t)
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])).double()
        >>> P = K @ pose.matrix()
        >>> upright, level = [[0.0, -1.0, 5.0], [0.0, 1.0, 5.0]], [[-1.0, 0.5, 5.0], [1.0, 0.5, 5.0]]
        >>> x = torchsfm.project_points(P[:, None], torch.tensor([upright, level]).double())
        >>> [LineFault(k).name for k in torchsfm.triangulate_lines(x, P).fault.tolist()]
        ['NONE', 'EPIPOLAR_PLANE']
    """

    NONE = 0
    TOO_FEW = 1
    """Fewer than two views see it."""
    ONE_CENTRE = 2
    """The views that see it have one centre."""
    EPIPOLAR_PLANE = 3
    """Two centres, and the line lies in a plane through both: both see it in corresponding epipolar lines."""
    COLLINEAR_CENTRES = 4
    """More centres, all in one line, and the line lies in a plane with them."""
    PLANE_OF_CENTRES = 5
    """The line lies in the one plane of all centres."""


@dataclass(frozen=True)
class LineTriangulation:
    """Lines and what is known about them.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_intrinsics(3, generator=g) @ torchsfm.random_poses(3, generator=g).matrix()
        >>> X = torchsfm.random_points(10, generator=g).reshape(5, 2, 3)  # ends of five segments
        >>> found = torchsfm.triangulate_lines(torchsfm.project_points(P[:, None], X), P)
        >>> bool(found.ends.allclose(X)), found.model.shape, found.end_covariance.shape
        (True, torch.Size([5, 6]), torch.Size([5, 2, 3, 3]))
    """

    model: Float[Tensor, "*batch n 6"]
    """Pluecker vectors (d, m) with |d| = 1, d pointing from the first ends of the segments to the second; finite always.
    Where `status` is not OK they may mean little."""
    ends: Float[Tensor, "*batch n 2 3"]
    """The part of the line that the segments show together; with four views or more without the farthest of each quarter."""
    status: Int8[Tensor, "*batch n"]
    """OK; NOT_FINITE: a wanted observation is not finite; TOO_FEW: fewer than two; DEGENERATE: the planes of sight are one or
    parallel, but for noise of a unit (one over the root of the weight); BEHIND: what is seen of it is not in front of all
    views that see it; NOT_CONVERGED."""
    fault: Int8[Tensor, "*batch n"]
    """Why there is no line where the status is TOO_FEW or DEGENERATE, a `LineFault`."""
    in_front: Bool[Tensor, "*batch n"]
    """Whether the middles of all its segments are in front of the cameras that see them; True for lines without ends."""
    angle: Float[Tensor, "*batch n"]
    """The angle at which the planes of sight meet: that of the two that are farthest apart is at least as large. Radians."""
    covariance: Float[Tensor, "*batch n 4 4"]
    """Of the steps of `Line3D` from `model`, for independent noise of variance 1 / weight of the ends across each image line;
    zero where the data do not determine it, and for lines through the world's origin, where those steps say too little."""
    end_covariance: Float[Tensor, "*batch n 2 3 3"]
    """Of the place of the line at both `ends`, across it."""
    error: Float[Tensor, "*batch n"]
    """Root-mean-square distance (weighted) of the ends of segments from the line's images, in pixels."""


def triangulate_lines(
    l: Float[Tensor, "*#batch v n 3"] | Float[Tensor, "*#batch v n 2 2"],  # noqa: E741
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    weights: Float[Tensor, "*#batch v n"] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 100,
) -> LineTriangulation:
    """Lines from their images in two known views or more, by least squares on distances of segment ends.

    Every view gives a plane of sight. The start is the line through the two points that are least off all planes, which is
    nearly as accurate as the data allow; Levenberg-Marquardt over the lines of space (Bartoli and Sturm 2005) then minimises
    the distances between the ends of the segments and the line's images. Ends need not correspond between views. Computed in
    float64 whatever comes in; `model` and `error` carry the derivative of the minimum (implicit function theorem).

    Args:
        l: Segments, two image points each; or homogeneous image lines of any scale, whose errors then count a focal length
            to each side of the point nearest to the principal point.
        P: Cameras `K [R | t]` or projective ones, of any scale and sign.
        visible: Which views see which line; all by default.
        weights: Factors of the squared distances (inverse variances of an end across its line), 0 for absent. Of detected
            segments `Segments.fit_points` gives points and weights that say what their edge points do; end points alone
            would count the angle too much.
        loss: Robust loss of each view's squared distance, the two ends together.
        max_iterations: Of Levenberg-Marquardt, for each line.

    Returns:
        The lines with their ends, status, covariance and error.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_intrinsics(3, generator=g) @ torchsfm.random_poses(3, generator=g).matrix()
        >>> x = torchsfm.project_points(P, torchsfm.random_points(2, generator=g))  # the ends of a segment
        >>> found = torchsfm.triangulate_lines(x[:, None], P)
        >>> found.status == torchsfm.Status.OK, found.fault == torchsfm.triangulation.LineFault.NONE
        (tensor([True]), tensor([True]))
        >>> bool(torchsfm.project_points(P, found.ends[0]).allclose(x))
        True
    """
    segments = isinstance(l, Tensor) and l.ndim > 3 and l.shape[-2:] == (2, 2)
    batch = check_tensors(
        l=(l, "v n 2 2" if segments else "v n 3"), P=(P, "v 3 4"), visible=(visible, "?v n: bool"), weights=(weights, "?v n")
    )
    check_options(max_iterations=(max_iterations, "int >= 0"), loss=(loss, Callable | None))
    last = 2 if segments else 1
    v, n = l.shape[-last - 2 : -last]
    lines = batch.numel() * n

    def flat(t: Tensor | None, rest: int) -> Tensor | None:
        """One line after the other: (lines, v, ...)."""
        if t is None:
            return None
        t = t.expand(*batch, *t.shape[t.ndim - 2 - rest :]).movedim(-1 - rest, -2 - rest)
        return t.reshape(lines, v, *t.shape[t.ndim - rest :])

    cameras = P.expand(*batch, v, 3, 4)[..., None, :, :, :].expand(*batch, n, v, 3, 4).reshape(lines, v, 3, 4)
    data = [flat(l, last), cameras, flat(visible, 0), flat(weights, 0)]
    step = max(1, PIECE // max(1, v))
    pieces = []
    for start in range(0, max(lines, 1), step):
        views = observe(*(None if t is None else t[start : start + step] for t in data))  # type: ignore[arg-type]
        pieces.append(_solve(views, segments, loss, max_iterations))
    joined = (torch.cat(parts) if len(parts) > 1 else parts[0] for parts in zip(*pieces, strict=True))
    parts = [part.reshape(*batch, n, *part.shape[1:]) for part in joined]
    return LineTriangulation(*(p.to(P.dtype) if p.is_floating_point() else p for p in parts))


def _solve(views: LineViews, segments: bool, loss: Loss | None, max_iterations: int) -> tuple[Tensor, ...]:
    """What `LineTriangulation` holds, for one piece."""
    with torch.no_grad():
        fixed = LineViews(*(t.detach() for t in views))
        origin, unit, start, fault, angle = _start(fixed)
    inner = views.moved(origin, unit)
    rows = inner.rows()
    found = levenberg_marquardt(
        residuals, start, rows, retract=Line3D().retract, size=4, weights=views.w, loss=loss, linearize=linearize,
        max_iterations=max_iterations,
    )  # fmt: skip
    r = residuals(found.x, rows)
    square = (views.w[..., None] * r.square()).sum((1, 2))
    number = views.used.sum(1)
    error = (torch.where(square > 0, square, 1.0) / (2 * number.clamp_min(1))).sqrt() * (square > 0)
    model = in_world(found.x, origin, unit)
    line = found.x.detach()
    with torch.no_grad():
        seen = seen_parts(LineViews(*(t.detach() for t in inner)), line)
        turned, ends = _extent(fixed, seen)
    model = model * turned[:, None]
    with torch.no_grad():
        in_front = _in_front(fixed, seen) if segments else torch.ones_like(views.broken)
        local, determined = _covariance(line, rows.detach(), fixed.w)
        end_covariance = _across(line, ends, local) * (unit.square())[:, None, None, None]
        distance = (1 + ends.square().sum(-1)).sqrt() * unit[:, None]
        blurred = end_covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt() > _UNSURE * distance
        # The weights say what noise is; without any it is a unit.
        lost = ~determined | blurred.any(-1) | one_plane(fixed)
        fault = torch.where(fault == 0, _faults(fixed, lost & (fault == 0)), fault)
        # What is exact but for rounding is a minimum, whatever steps promise.
        exact = error <= _EXACT * (views.w * fixed.ends.square().sum((-2, -1))).sum(1).sqrt()
        status = _status(views, fault, in_front, (found.status == Status.NOT_CONVERGED) & ~exact)
        covariance = world_covariance(local, line, model.detach(), origin, unit)
        good = (status == Status.OK) | (status == Status.BEHIND) | (status == Status.NOT_CONVERGED)
        covariance = torch.where(good[:, None, None], covariance, 0.0)
        end_covariance = torch.where(good[:, None, None, None], end_covariance, 0.0)
        ends = ends * unit[:, None, None] + origin[:, None]
    return model, ends, status, fault.to(torch.int8), in_front, angle, covariance, end_covariance, error


def _start(views: LineViews) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Origin and unit of the frame, the line in it, the fault if there is one that rounding tells, and the planes' angle."""
    mean, spread = frame_of_centres(views)
    outer = views.moved(mean, spread)
    line, _ = linear_lines(outer, views.w)
    # A plane misses a point by more where it is farther away: once more, with what is known now.
    seen = seen_parts(outer, line)
    square = (seen.points() - outer.centre[..., None, :]).square().sum(-1)
    counted = seen.finite & outer.near[..., None] & (square > 0)
    depth = torch.where(counted, square, 0.0).sum(-1) / counted.sum(-1).clamp_min(1)
    line, singular = linear_lines(outer, views.w / torch.where(counted.any(-1), depth, 1.0).clamp_min(1e-12))
    largest = singular[:, 3].clamp_min(1e-300)
    # Planes of one centre may well meet in different lines, but only through it.
    fault = _faults(views, (singular[:, 2] <= SAME * largest) | one_centre(views))
    angle = 2 * torch.atan(singular[:, 2] / largest)
    inner_origin, inner_unit = frame_of_line(outer, seen_parts(outer, line))
    line = in_frame(line, inner_origin, inner_unit)
    line = line / torch.linalg.vector_norm(line, dim=-1, keepdim=True).clamp_min(1e-300)
    sound = line.isfinite().all(-1, keepdim=True) & (line != 0).any(-1, keepdim=True)
    line = torch.where(sound, line, line.new_tensor([1.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    return mean + spread[:, None] * inner_origin, spread * inner_unit, line, fault, angle


def _faults(views: LineViews, lost: Tensor) -> Tensor:
    """The fault of lines that are lost, 0 elsewhere (n)."""
    fault = torch.zeros_like(lost, dtype=torch.int64)
    (at,) = lost.nonzero(as_tuple=True)
    return fault.index_put((at,), _why(LineViews(*(t[at] for t in views)))) if len(at) else fault


def _why(views: LineViews) -> Tensor:
    """The fault of lines whose planes of sight are one, from the centres of the views (n)."""
    centre, finite = views.centre, views.near
    counted = (finite & views.used)[..., None]
    number = counted.sum(1).clamp_min(1)
    mean = torch.where(counted, centre, 0.0).sum(1) / number
    reach = torch.where(counted, centre.square(), 0.0).sum((1, 2)).div(number[:, 0])
    apart = torch.where(counted, centre - mean[:, None], 0.0)
    values, _ = eigvalsh(apart.mT @ apart)
    # Eigenvalues are squares: a part in 1e10 is five digits.
    several = (values[:, 2] > 1e-22 * reach) | (views.used & ~finite).any(1)
    collinear = values[:, 1] <= 1e-10 * values[:, 2]
    distinct = _number_of_centres(centre, views.used, values[:, 2])
    fault = torch.where(collinear, int(LineFault.COLLINEAR_CENTRES), int(LineFault.PLANE_OF_CENTRES))
    fault = torch.where(distinct <= 2, int(LineFault.EPIPOLAR_PLANE), fault)
    fault = torch.where(several, fault, int(LineFault.ONE_CENTRE))
    return torch.where(views.used.sum(1) < 2, int(LineFault.TOO_FEW), fault)


def _number_of_centres(centre: Tensor, used: Tensor, size: Tensor) -> Tensor:
    """How many different centres the views in use have (n)."""
    gap = (centre[:, :, None] - centre[:, None]).square().sum(-1)
    before = torch.ones(gap.shape[1:], dtype=torch.bool, device=gap.device).tril(-1)
    earlier = before & used[:, None]
    repeated = (earlier & (gap <= 1e-14 * size[:, None, None])).any(-1)
    return (used & ~repeated).sum(-1)


def _extent(views: LineViews, seen: SeenParts) -> tuple[Tensor, Tensor]:
    """The sign that turns d along the segments (n), and the ends of all that is seen (n, 2, 3)."""
    along = seen.along
    both = (seen.finite & views.used[..., None]).all(-1)
    votes = torch.where(both, torch.sign(along[..., 1] - along[..., 0]), 0.0).sum(1)
    turned = torch.where(votes < 0, -1.0, 1.0).to(along.dtype)
    along = along * turned[:, None, None]
    low, high = along.amin(-1), along.amax(-1)
    drop = both.sum(1) // 4
    rank = drop.clamp_max((both.shape[1] - 1) if both.shape[1] else 0)[:, None]
    if both.shape[1]:
        low = torch.where(both, low, torch.inf).sort(1).values.gather(1, rank)[:, 0]
        high = torch.where(both, high, -torch.inf).sort(1, descending=True).values.gather(1, rank)[:, 0]
    else:
        low = high = along.new_zeros(len(along))
    span = torch.where(both.any(1)[:, None], torch.stack((low, high), -1), 0.0)
    return turned, seen.foot[:, None] + (span * turned[:, None])[..., None] * seen.d[:, None]


def _in_front(views: LineViews, seen: SeenParts) -> Tensor:
    """Whether the middles of all segments are in front of the cameras that see them (n)."""
    # A camera at infinity has no front.
    return ((seen.depth * views.handed > 0) | (views.handed == 0) | ~views.used).all(1)


def _covariance(line: Tensor, rows: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse (n, 4, 4) of the normal matrix in the line's frame, and where it exists."""
    _, J = linearize(line, rows)
    J = (J * w.sqrt()[..., None, None]).flatten(1, 2)
    N = J.mT @ J
    scale = N.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    unit = N * scale[:, :, None] * scale[:, None]
    values, ok = eigvalsh(unit)
    regular = ok & (values[:, 0] > 1e-13)
    unit = torch.where(regular[:, None, None], unit, torch.eye(4, dtype=N.dtype, device=N.device))
    C = inverse(unit)[0] * scale[:, :, None] * scale[:, None]
    return torch.where(regular[:, None, None], C, 0.0), regular


def _across(line: Tensor, ends: Tensor, C: Tensor) -> Tensor:
    """Covariance (n, 2, 3, 3) of the line's place at two of its points, across it."""
    size = torch.linalg.vector_norm(line[:, :3], dim=-1).clamp_min(1e-300)
    moved = line_tangents(line) / size[:, None, None]
    d = (line[:, :3] / size[:, None])[:, None, :, None]
    # X x d = m, so that across the line dX = d x (dm - X x dd).
    dm, dd = moved[:, None, 3:], moved[:, None, :3]
    G = _cross_columns(d, dm - _cross_columns(ends[..., None], dd))
    return G @ C[:, None] @ G.mT


def _cross_columns(a: Tensor, b: Tensor) -> Tensor:
    """The cross products of columns."""
    return cross(a.mT, b.mT).mT


def _status(views: LineViews, fault: Tensor, in_front: Tensor, unfinished: Tensor) -> Tensor:
    status = torch.full(fault.shape, int(Status.OK), dtype=torch.int8, device=fault.device)
    for condition, code in (
        (unfinished, Status.NOT_CONVERGED),
        (~in_front, Status.BEHIND),
        (fault != 0, Status.DEGENERATE),
        (fault == LineFault.TOO_FEW, Status.TOO_FEW),
        (views.broken, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    return status
