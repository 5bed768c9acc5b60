"""Structure and motion from curves in three or more uncalibrated images, no point of which is in correspondence.

A sample of a space curve is seen on a curve in each of v images, where it may slide: v distances for the two coordinates across
the curve, v - 2 of which constrain the cameras (Berthilsson, Åström & Heyden 2001). Guesses of how the images of a curve run
alike, and samples equally far apart along them, are a start for the factorisation of points; from there cameras and samples go
to the least squares of the distances normal to the image curves.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.geometry.curve_places import CurvePlaces, curve_places
from torchsfm.geometry.curves import Curve
from torchsfm.motion.many_views.bilinear_fit import unit_frame
from torchsfm.motion.many_views.curve_anew import put_together
from torchsfm.motion.many_views.curve_fit import Scene
from torchsfm.motion.many_views.curve_search import Found, agreement, approach, finish, typical_misfit
from torchsfm.motion.many_views.curve_starts import Runs, guess_runs
from torchsfm.motion.many_views.curve_verdict import enough_shown, judge
from torchsfm.motion.many_views.factorization_points import factorize_points, signs_of_depths
from torchsfm.optim.pytree import cut, join, pick

_GUESSES = 8
"""Ways in which the image curves may run alike that are tried."""
_OTHERS = 2
"""Of the ways in which all curves but one may run alike."""
_AGAIN = 3
"""Most times that image curves are put together anew,"""
_FALLS = 0.7
"""as long as that leaves so much of the misfit at most."""
_AGREED = 0.9
"""Part of the samples that must be right for that."""
_KEPT = 3
"""Of what was found the time before, for the next."""
_FINE = 1e-6
"""Misfits below, in parts of the curves' extent, are those of the right cameras."""
_GRID = 60
"""Starts of closed curves that are tried."""
_POINT_STEPS = 30
"""Most steps of the factorisation of points at each of its stages."""


@dataclass(frozen=True)
class CurveFactorization:
    """Cameras and space curves of many images, up to one projective transformation of space.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 6.2, 60).double()
        >>> x, y, z = t.cos(), t.sin(), 0.3 * (2 * t).cos()
        >>> X = torch.stack((torch.stack((x, y, z), -1), torch.stack((z, x, y), -1), torch.stack((y, z, x), -1)))
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])).double()
        >>> P = K @ torchsfm.random_poses(6, spread=0.5, generator=torch.Generator().manual_seed(0)).matrix()
        >>> curves = torchsfm.geometry.curve_from_samples(torchsfm.project_points(P[:, None], X))
        >>> found = torchsfm.factorize_curves(curves, oriented=True, aligned=True)
        >>> found.used_view.all(), bool(found.error.nanmedian() < 0.1)  # pixels, across the curves
        (tensor(True), True)
        >>> X_found = found.X[0, :, :3] / found.X[0, :, 3:]  # samples of the first curve, in a projective frame
        >>> off = torchsfm.project_points(found.P[0], X_found) - found.x[0, 0]
        >>> bool(off.norm(dim=-1)[found.measured[0]].median() < 0.1)
        True
    """

    P: Float[Tensor, "*batch v 3 4"]
    """Camera matrices, |P| = 1; zero where `used_view` is False."""
    X: Float[Tensor, "*batch c m 4"]
    """Samples of the space curves in order, homogeneous, of norm 1; zero where the curves shown are too few for any search."""
    x: Float[Tensor, "*batch v c m 2"]
    """The nearest points of the image curves: points in correspondence; zero where an image does not show the curve."""
    error: Float[Tensor, "*batch v c m"]
    """Distance of each sample's image from the image curve, in its unit; inf where that does not count: not shown, beyond an
    open end, or not `measured`."""
    measured: Bool[Tensor, "*batch c m"]
    """Samples that three images and more agree on, in order with their neighbours."""
    used_view: Bool[Tensor, "*batch v"]
    """Views that show curves, where the status is not TOO_FEW."""
    status: Int8[Tensor, "*batch"]
    """OK; TOO_FEW: fewer than three views or two curves, two curves in three views, or fewer samples than the cameras need;
    DEGENERATE: the curves leave cameras undetermined (straight ones, all in one plane, views without baseline); NO_CONSENSUS:
    distances are larger than `threshold`, or smooth along the curves, as noise is not: the search ended at the wrong place, or
    the images do not show the same curves; NOT_CONVERGED."""


def factorize_curves(
    curves: Curve,
    *,
    samples: int = 40,
    oriented: bool = False,
    aligned: bool = False,
    threshold: float = 3.0,
    max_iterations: int = 50,
) -> CurveFactorization:
    """Find cameras and space curves from their images in three or more uncalibrated views, up to a projective transformation.

    Which image curve shows which space curve is known; which of its points show the same point is not. Closed curves may begin
    anywhere and run in any direction in each image. Of an open curve all images show about the same piece. Bent curves in
    general position are needed: two that do not lie in one plane, and three where there are three views only.

    The search goes by where smooth curves through the image samples go; samples of edges, nearer to each other than their noise
    is small, are smoothed first (`fit_spline`). In the end all image samples count, by their distances from images of splines
    in space, unless they are so exact that no spline of `samples` control points follows them.

    The search ends at a wrong place now and then, more often the farther views are apart (`status` then says `NO_CONSENSUS`).

    Args:
        curves: The image curves, in pixels, all curves of all views: fields of shape (*batch, v, c, n, 2), (*batch, v, c, n),
            (*batch, v, c). One with fewer than three samples is not shown. A curve is closed in all images that show it, or in
            none.
        samples: Samples of each space curve.
        oriented: Whether the images of each curve are known to run in the same direction, as edges with their bright side do.
        aligned: Whether they also begin at about the same point.
        threshold: Largest root mean square distance of samples from the image curves, in pixels.
        max_iterations: Most steps at the end.

    Returns:
        Cameras, samples of the space curves and where they are on the image curves, distances and status. Computed in float64,
        without derivatives. `x` are points in correspondence only as far as the curves tell: nothing measures them along a
        curve.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 6.2, 60).double()
        >>> x, y, z = t.cos(), t.sin(), 0.3 * (2 * t).cos()
        >>> X = torch.stack((torch.stack((x, y, z), -1), torch.stack((z, x, y), -1), torch.stack((y, z, x), -1)))
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])).double()
        >>> P = K @ torchsfm.random_poses(6, spread=0.5, generator=torch.Generator().manual_seed(0)).matrix()
        >>> curves = torchsfm.geometry.curve_from_samples(torchsfm.project_points(P[:, None], X))
        >>> found = torchsfm.factorize_curves(curves, oriented=True, aligned=True)
        >>> torchsfm.Status(int(found.status)).name, found.P.shape, found.X.shape
        ('OK', torch.Size([6, 3, 4]), torch.Size([3, 40, 4]))
    """
    check_options(
        curves=(curves, Curve), samples=(samples, "int >= 8"), oriented=(oriented, bool), aligned=(aligned, bool),
        threshold=(threshold, "float > 0"), max_iterations=(max_iterations, "int >= 1"),
    )  # fmt: skip
    batch = check_tensors(
        x=(curves.x, "v>=1 c>=1 n>=2 2"), valid=(curves.valid, "v c n: bool"), closed=(curves.closed, "v c: bool")
    )
    v, c, n = curves.x.shape[-4:-1]
    with torch.no_grad():
        flat = Curve(
            curves.x.detach().double().expand(*batch, v, c, n, 2).reshape(-1, v, c, n, 2),
            curves.valid.expand(*batch, v, c, n).reshape(-1, v, c, n),
            curves.closed.expand(*batch, v, c).reshape(-1, v, c),
        )
        count = len(flat.x)
        if count == 0:
            # The shapes of the answer come from one problem without curves.
            flat = tensor_map(lambda t: t.new_zeros(1, *t.shape[1:]), flat)
        # One after the other: searches that stop together would share their rounding.
        parts = [
            _factorize(cut(flat, i, i + 1), samples, oriented, aligned, threshold, max_iterations) for i in range(len(flat.x))
        ]
        fields = tensor_map(lambda t: t.to(curves.x.dtype) if t.is_floating_point() else t, join(parts))
        return tensor_map(lambda t: t[:count].reshape(batch + t.shape[1:]), fields)


def _factorize(
    curves: Curve, m: int, oriented: bool, aligned: bool, threshold: float, max_iterations: int
) -> CurveFactorization:
    c = curves.closed.shape[-1]
    places = curve_places(curves)
    there = (places.number >= 3) & torch.isfinite(curves.x).all(-1).all(-1)
    there = there & (there.sum(1, keepdim=True) >= 3)
    view = there.any(-1)
    # No search shows more than the curves do.
    if not bool(enough_shown(there.sum(1).to(curves.x.dtype)[..., None].expand(-1, -1, m), view)):
        return _too_few(there, m, curves.x)
    centre, scale = _frames(places, there)
    x = torch.where(curves.valid[..., None], (curves.x - centre[:, :, None, None]) / scale[:, None, None, None, None], 0)
    moved = Curve(torch.where(there[..., None, None], x, 0), curves.valid & there[..., None], curves.closed)
    ways = _ways(moved, there, oriented, aligned)
    turned, images, found = _search(moved, there, ways, m, max_iterations)
    status = judge(images, found, view, threshold / scale)
    # Where the curves leave cameras open they do so for whatever way they are put together: of 35 such, none came out right.
    if int(status) not in (Status.OK, Status.TOO_FEW, Status.DEGENERATE):
        other = _search_anew(moved, turned, there, found, aligned, oriented, max_iterations)
        if other is not None and int(again := judge(*other[1:], view, threshold / scale)) == Status.OK:
            (turned, images, found), status = other, again
    rows = scale[:, None, None, None] * found.x.P[:, :, :2] + centre[..., None] * found.x.P[:, :, 2:]
    P = torch.cat((rows, found.x.P[:, :, 2:]), 2)
    P = P / torch.linalg.matrix_norm(P)[..., None, None].clamp_min(1e-300)
    seen = (found.weight * found.measured[:, None]).flatten(2)
    side, turn = signs_of_depths((P @ found.x.u[:, None])[:, :, 2] * seen)
    X = (found.x.u * turn[:, None]).mT.reshape(len(turn), c, m, 4)
    counts = (found.weight > 0) & found.measured[:, None]
    foot = images.at(found.x.place)[0] * scale[:, None, None, None, None] + centre[:, :, None, None]
    r = found.seen.r.reshape(found.weight.shape).abs() * scale[:, None, None, None]
    used = view & (status != Status.TOO_FEW)[:, None]
    return CurveFactorization(
        torch.where(used[..., None, None], P * side[..., None, None], 0).nan_to_num(0.0, 0.0, 0.0),
        X.nan_to_num(0.0, 0.0, 0.0),
        torch.where(there[..., None, None], foot, 0).nan_to_num(0.0, 0.0, 0.0),
        torch.where(counts & torch.isfinite(r), r, torch.inf),
        found.measured,
        used,
        status.to(torch.int8),
    )


def _too_few(there: Bool[Tensor, "p v c"], m: int, like: Tensor) -> CurveFactorization:
    """What is said where the counts alone leave cameras open."""
    p, v, c = there.shape
    return CurveFactorization(
        like.new_zeros(p, v, 3, 4),
        like.new_zeros(p, c, m, 4),
        like.new_zeros(p, v, c, m, 2),
        like.new_full((p, v, c, m), torch.inf),
        there.new_zeros(p, c, m),
        there.new_zeros(p, v),
        torch.full((p,), int(Status.TOO_FEW), dtype=torch.int8, device=like.device),
    )


def _frames(places: CurvePlaces, there: Bool[Tensor, "p v c"]) -> tuple[Tensor, Tensor]:
    """The centre of each image's curves, and the one scale of all images, (p, v, 2) and (p)."""
    w = there[..., None, None].to(places.segments.start.dtype) * places.segments.there[..., None]
    x = places.segments.start
    number = w.sum((2, 3))
    centre = (w * x).sum((2, 3)) / number.clamp(min=1)
    away = (w * (x - centre[:, :, None, None])).square().sum((1, 2, 3, 4))
    scale = (away / (2 * number.sum((1, 2))).clamp(min=1)).sqrt()
    return centre, torch.where((scale > 0) & (scale < torch.inf), scale, 1)


def _ways(curves: Curve, there: Tensor, oriented: bool, aligned: bool, most: int = _GUESSES) -> Runs:
    if aligned:
        none = torch.zeros(there[:, None].shape, dtype=curves.x.dtype, device=there.device)
        return Runs(none > 0, none)
    places = curve_places(curves)
    return guess_runs(places.at(places.spread(_GRID))[0], there, curves.closed & there, oriented, most)


def _approached(curves: Curve, there: Tensor, ways: Runs, m: int) -> tuple[Curve, Scene, Tensor]:
    """The image curves as they run alike, cameras and samples, and the median misfit, for all guesses."""
    p, g = ways.back.shape[:2]
    each = torch.arange(p, device=there.device).repeat_interleave(g)
    curves, there = pick((each,), curves), there[each]
    back = ways.back.flatten(0, 1)
    other = curves.reversed()
    curves = Curve(torch.where(back[..., None, None], other.x, curves.x), curves.valid, curves.closed)
    images = curve_places(curves)
    place = images.spread(m, ways.start.flatten(0, 1))
    visible = there[..., None].expand(-1, -1, -1, m)
    start = factorize_points(images.at(place)[0].flatten(2, 3), visible=visible.flatten(2), max_iterations=_POINT_STEPS)
    P, u = unit_frame(start.P, start.X.mT)
    shown = visible.to(u.dtype)
    x = approach(images, shown, Scene(P, u, place))
    return curves, x, typical_misfit(images, shown, x)


def _search(curves: Curve, there: Tensor, ways: Runs, m: int, steps: int) -> tuple[Curve, CurvePlaces, Found]:
    """The image curves as they run alike, and the best that was found for any guess."""
    curves, x, misfit = _approached(curves, there, ways, m)
    best = misfit.argmin(-1, keepdim=True)
    curves, x = pick((best,), (curves, x))
    return curves, *finish(curve_places(curves), there[..., None].to(misfit.dtype).expand(-1, -1, -1, m), x, steps)


def _search_anew(
    curves: Curve, turned: Curve, there: Tensor, found: Found, aligned: bool, oriented: bool, steps: int
) -> tuple[Curve, CurvePlaces, Found] | None:
    """What comes of image curves that are put together anew, by the cameras found, and by those of all curves but one."""
    m = found.measured.shape[-1]
    shown = there[..., None].to(found.weight.dtype).expand(-1, -1, -1, m)
    usual = typical_misfit(curve_places(turned), shown, found.x)
    tries = [(turned, found.weight * found.measured[:, None], found.x, usual)]
    some = there.any(1)[0].nonzero()[:, 0].tolist()
    if not aligned and len(some) >= 3:
        tries += _all_but_one(curves, there, some, m, oriented)
    least, best = torch.inf, None
    for _ in range(_AGAIN):
        parts = [put_together(own, there, right, x, float(misfit)) for own, right, x, misfit in tries]
        starts = [part for part in parts if part is not None]
        if not starts:
            break
        turned, x = join([own for own, _ in starts]), join([scene for _, scene in starts])
        every = shown.expand(len(starts), -1, -1, -1)
        x = approach(curve_places(turned), every, x)
        misfit = typical_misfit(curve_places(turned), every, x)
        agreed = agreement(curve_places(turned), every, x) >= _AGREED
        # Where few samples are right their median says little.
        order = torch.where(agreed, misfit, misfit + 1).argsort()[:_KEPT]
        tries = [(cut(turned, i, i + 1), shown, cut(x, i, i + 1), misfit[i]) for i in order.tolist()]
        now = float(misfit[order[0]]) + float(~agreed[order[0]])
        if now < least:
            best = tries[0]
        if now < _FINE or (agreed[order[0]] and now > _FALLS * least):
            break
        least = min(now, least)
    if best is None:
        return None
    return best[0], *finish(curve_places(best[0]), shown, best[2], steps)


def _all_but_one(
    curves: Curve, there: Tensor, some: list[int], m: int, oriented: bool
) -> list[tuple[Curve, Tensor, Scene, Tensor]]:
    """Cameras by all curves but one, whichever that is: how they run, what counts, cameras and samples, and the misfit."""
    c = there.shape[2]
    none = torch.zeros(1, _OTHERS, *there.shape[1:], dtype=curves.x.dtype, device=there.device)
    backs, starts, fewer = [], [], []
    for k in some:
        rest = torch.tensor([i for i in range(c) if i != k], device=there.device)
        own = Curve(*(t.index_select(2, rest) for t in (curves.x, curves.valid, curves.closed)))
        ways = _ways(own, there.index_select(2, rest), oriented, False, _OTHERS)
        g = ways.back.shape[1]
        backs.append((none[:, :g] > 0).index_copy(3, rest, ways.back))
        starts.append(none[:, :g].index_copy(3, rest, ways.start))
        fewer.append((there & (torch.arange(c, device=there.device) != k)).expand(g, -1, -1))
    seen = torch.cat(fewer)
    every = pick((torch.zeros(len(seen), dtype=torch.long, device=seen.device),), curves)
    ways = Runs(*(torch.cat(t, 1).transpose(0, 1) for t in (backs, starts)))
    turned, x, misfit = _approached(every, seen, ways, m)
    right = seen[..., None].to(misfit.dtype).expand(-1, -1, -1, m)
    return [(cut(turned, i, i + 1), right[i : i + 1], cut(x, i, i + 1), misfit[i]) for i in range(len(seen))]
