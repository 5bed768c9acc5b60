"""Lines of space from their images in known views: planes meet, then the ends of segments are brought near."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.linalg.portions import portion
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.linalg.vectors import cross
from torchsfm.optim import Loss, wants_derivative
from torchsfm.triangulation.line_chart import places
from torchsfm.triangulation.line_covariance import parameter_covariance, place_covariance, step_covariance, turn_variance
from torchsfm.triangulation.line_faults import LineFault, faults, one_plane
from torchsfm.triangulation.line_fit import fit, fit_from
from torchsfm.triangulation.line_layout import lay_out
from torchsfm.triangulation.line_start import start
from torchsfm.triangulation.line_views import LineViews, observe

PIECE = 1 << 16
"""Observations at a time, on a CPU: more take no less time each."""
_EXACT = 1e-11
"""Error, over the size of the coordinates, that is rounding's."""
_UNSURE = 0.3
"""Deviation across the line, over its distance from the cameras, at which noise of one unit leaves no line."""
_POINT = 5.0
"""Root-mean-square length of segments, in deviations of their ends, that says nothing: of points it is 2."""
_LONG = 16.0
"""The same from which on noise makes no segments seem longer than they are."""
_RARE = 1e-3
"""Chance that a line's noise is more than its errors seem to allow."""
_SLOPE = 1.0
"""Deviation of a line's slope along the rays at which noise leaves its direction open,"""
_SLOPE_OF_LONG = 4.0
"""and that of long segments, where it is the views that are near each other."""


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
    parallel, or segments too short to show a direction, but for noise of a unit (one over the root of the weight), or of less
    where what views of it leave of errors says so; BEHIND: what is seen of it is not in front of all views that see it;
    NOT_CONVERGED."""
    fault: Int8[Tensor, "*batch n"]
    """Why there is no line where the status is TOO_FEW or DEGENERATE, a `LineFault`."""
    in_front: Bool[Tensor, "*batch n"]
    """Whether the middles of all its segments are in front of the cameras that see them; True for lines without ends."""
    angle: Float[Tensor, "*batch n"]
    """The angle at which the planes of sight meet, radians: of two their own, of more a mean, which is no larger than that of
    the two that are farthest apart if all lie within a right angle."""
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
    data = lay_out(batch, l, last, P, visible, weights)
    step = max(1, portion(PIECE, P.device) // max(2, v))
    pieces = []
    for begin in range(0, max(lines, 1), step):
        some = (t if t is None or t.shape[-1] == 1 else t[..., begin : begin + step] for t in data)
        pieces.append(_solve(observe(*some), segments, loss, max_iterations))  # type: ignore[arg-type]
    parts = [part.reshape(*batch, n, *part.shape[1:]) for part in (torch.cat(some) for some in zip(*pieces, strict=True))]
    # Covariances of what is very far may be more than single precision has numbers for.
    most = torch.finfo(P.dtype).max
    return LineTriangulation(*(p.clamp(-most, most).to(P.dtype) if p.is_floating_point() else p for p in parts))


def _solve(views: LineViews, segments: bool, loss: Loss | None, max_iterations: int) -> tuple[Tensor, ...]:
    """What `LineTriangulation` holds, for one piece."""
    fixed = views.detached()
    with torch.no_grad():
        begin = start(fixed)
        used = fixed.used.to(fixed.w.dtype)
        number = add_rows(used)
        problem, chart, x, status = fit(fixed, begin.chart, used, loss, max_iterations)
        image, a, c = problem.images(x)
        t, meets = places(image, c)
        turned, span = _extent(t, (meets & fixed.used).all(0))
        point, d = chart.line(x)
        direction = d * (turned * combine_rows(d, d).rsqrt())
        model = torch.cat((direction, cross(point, direction)))
        error = _error(image.r, fixed.w, number)
    L = model.mT
    if wants_derivative(views.ends, views.P, views.w):
        # From the minimum to the minimum, for its derivatives.
        L, r, again = fit_from(views, chart, point, direction, loss, max_iterations)
        error, status = _error(r.permute(2, 1, 0), views.w, number), again.status
    with torch.no_grad():
        in_front = torch.ones_like(views.broken)
        if segments:
            # A camera at infinity has no front.
            depth = torch.addcmul(a[2], t.sum(0), c[2], value=0.5)
            in_front = ((depth * fixed.handed > 0) | (fixed.handed == 0) | ~fixed.used).all(0)
        C, determined = parameter_covariance(problem.normal_matrix(image, fixed.w)[0])
        end_covariance, trace = place_covariance(C, chart, d, span)
        # The weights say what noise is; without any it is a unit.
        blurred = _most_noise(error, number) * trace > _UNSURE**2 * (2 + combine_rows(d, d) * span.square())
        lost = begin.lost | ~determined | blurred[0] | blurred[1] | one_plane(fixed, error)
        noise = _noise(error, number)
        length = _square_length(fixed, number) / noise
        limit = torch.where(length < _LONG**2, _SLOPE**2, _SLOPE_OF_LONG**2)
        short = (length <= _POINT**2) | (~lost & (noise * turn_variance(C, chart, point, d, fixed) > limit))
        fault = faults(fixed, lost | short, short)
        # What is exact but for rounding is a minimum, whatever steps promise.
        size = combine_rows(combine_rows(fixed.ends.flatten(0, 1), fixed.ends.flatten(0, 1)), fixed.w)
        status = _status(views, fault, in_front, (status == Status.NOT_CONVERGED) & ~(error <= _EXACT * size.sqrt()))
        covariance = step_covariance(C, chart, point, d, model)
        good = (status == Status.OK) | (status == Status.BEHIND) | (status == Status.NOT_CONVERGED)
        covariance = torch.where(good[:, None, None], covariance, 0.0)
        end_covariance = torch.where(good[:, None, None, None], end_covariance, 0.0)
        ends = (point + chart.unit * d * span[:, None]).permute(2, 0, 1)
    return L, ends, status, fault.to(torch.int8), in_front, begin.angle, covariance, end_covariance, error


def _error(r: Tensor, w: Tensor, number: Tensor) -> Tensor:
    """The root-mean-square of distances (2, v, n), weighted."""
    square = combine_rows(combine_rows(r, r), w)
    some = square > 0
    error: Tensor = (torch.where(some, square, 1.0) / (2 * number.clamp_min(1))).sqrt() * some
    return error


def _square_length(views: LineViews, number: Tensor) -> Tensor:
    """The mean square of the lengths of segments (n), in units of the noise of their ends."""
    away = views.ends[:, 0] - views.ends[:, 1]
    return combine_rows(combine_rows(away, away), views.w) / number.clamp_min(1)


def _noise(error: Tensor, number: Tensor) -> Tensor:
    """The variance of noise (n): a unit, or the most of which one in twenty lines of so many views has such errors, if less."""
    free = 2 * number - 4
    some = free.clamp_min(2)
    # The quantile of chi-square, after Wilson and Hilferty.
    least = some * (1 - 2 / (9 * some) - 1.645 * (2 / (9 * some)).sqrt()) ** 3
    return torch.where(free > 0, (2 * number * error.square() / least).clamp(1e-20, 1), 1.0)


def _most_noise(error: Tensor, number: Tensor) -> Tensor:
    """The same for one line in a thousand."""
    free = 2 * number - 4
    half = free.clamp_min(2) / 2
    # No less of chi-square is below what the first term of its series says.
    least = 2 * (_RARE * torch.lgamma(half + 1).exp()) ** (1 / half)
    return torch.where(free > 0, (2 * number * error.square() / least).clamp(1e-20, 1), 1.0)


def _extent(t: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """The sign that turns lines along their segments (n), and the places (2, n) of the ends of all that is seen, in that order.

    Args:
        t: Places of the ends of segments (2, v, n).
        seen: Where there are both (v, n).
    """
    votes = add_rows(torch.where(seen, torch.sign(t[1] - t[0]), 0.0))
    turned = torch.where(votes < 0, -1.0, 1.0).to(t.dtype)
    t = t * turned
    low, high = (torch.where(seen, end, torch.inf) for end in (torch.minimum(t[0], t[1]), -torch.maximum(t[0], t[1])))
    number = seen.sum(0)
    span = torch.stack((_smallest(low, number // 4), -_smallest(high, number // 4)))
    return turned, torch.where(number > 0, span, 0.0) * turned


def _smallest(t: Tensor, rank: Tensor) -> Tensor:
    """The smallest of each column (v, n) but for as many as its rank (n) says."""
    if len(t) < 4:
        return t.amin(0)
    return t.sort(0).values.gather(0, rank[None])[0]


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
