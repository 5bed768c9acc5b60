"""Structure and motion from points in many uncalibrated images by factorisation.

`depth_ij (x_ij, 1) = P_i X_j`: with the right projective depths, the row spaces of all images' points lie in one space of
dimension four, the depth space of the points (Sparr 1996; Heyden, Berthilsson & Sparr 1999; Sturm & Triggs 1996). The depths
and that space are found together. Three things make it independent of what does not matter:

- each image is put into its balanced frame, which any projective change of its coordinates leaves as it is up to a rotation;
- all images count alike, there is no first one; the order of points plays no part;
- it starts from the depths 1 of the balanced rays, with a prior on them that is then let go (from 1 to 0.001, then 0), which
  needs no epipolar geometry, no pair of images with everything in common, and no start.

Missing data are left out of the sums; nothing is filled in.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry import to_homogeneous
from torchsfm.geometry.homogeneous import divide_safely, finite_or_zero
from torchsfm.geometry.shape import balanced_frame
from torchsfm.linalg import eigh, solve
from torchsfm.linalg.farthest_points import farthest_points
from torchsfm.motion.many_views.bilinear_fit import (
    Fit,
    Rays,
    core,
    fit_angles,
    fit_with_prior,
    in_own_frame,
    information,
    of_rank,
    squared_sines,
    with_derivative,
)
from torchsfm.optim import wants_derivative
from torchsfm.optim.likely_noise import QUARTER, likely_variance

_PRIORS = (1.0, 0.1, 0.01, 0.001)
_ENOUGH = 6
"""Points that an image must share with others, and images that a point must share: 2."""
_NUMBERS = 1 << 25
"""Numbers in the largest array of the problems solved at a time."""
_SCALES = (8.0, 6.0, 4.0, 3.0)
"""Where the robust loss lets go, in medians of the sines, one after the other."""
_UNDETERMINED = 0.08
"""Standard deviation of a camera matrix of norm 1 beyond which it is taken for undetermined. Where points leave it open, noise
that spreads them makes a tenth of it and more."""
_DISTINCT = 8
"""Points, apart from each other, that determine two cameras and more,"""
_APART = 6.0
"""by so many standard deviations in the root mean square over the images."""
_SMALLEST = 1e-24
"""Variance of the noise at least, over the square of the largest coordinate: rounding."""
_FLAT_STEPS = 15
"""Most steps of the homographies that are fitted for comparison: where they do not fit, their minimum does not matter."""


@dataclass(frozen=True)
class Factorization:
    """Cameras and points of many images, up to one projective transformation of space.

    Attributes:
        P: Camera matrices, |P| = 1; zero where `used_view` is False.
        X: Homogeneous points of norm 1, rows; zero where `used_point` is False.
        depths: Projective depths: `depths (x, 1) = P X`, mostly positive; 0 where not observed.
        proximity: How near the images' depth spaces were to a common space of dimension four, before the first and after each
            iteration without prior: root mean square sine of the angle between measured and reprojected rays in the balanced
            frames. It falls; the last value is repeated for problems that end early.
        error: Distance of each observed point from its reprojection, in the unit of the points; inf where not observed.
        weights: What each observation counted in the end: those given, times those of the robust loss.
        used_view: Views with at least six points that other views see too.
        used_point: Points in at least two used views.
        status: `OK`; `NOT_CONVERGED`; `TOO_FEW` views or points; `DEGENERATE`: the data leave cameras undetermined (points in
            a plane but for one, on two lines, in four places or five; views without baseline; parts that hang together too
            loosely), but for noise, which few redundant observations tell little of; or fewer points that are apart than the
            cameras need.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(30, generator=g), torchsfm.random_poses(6, generator=g).matrix()
        >>> x = torchsfm.project_points(P, X)
        >>> visible = torch.rand(6, 30, generator=g) < 0.8
        >>> found = torchsfm.factorize_points(x, visible=visible)  # what is not seen is filled in
        >>> X_found = found.X[found.used_point]
        >>> bool(torchsfm.project_points(found.P, X_found[:, :3] / X_found[:, 3:]).allclose(x[:, found.used_point], atol=1e-4))
        True
    """

    P: Float[Tensor, "*batch v 3 4"]
    X: Float[Tensor, "*batch n 4"]
    depths: Float[Tensor, "*batch v n"]
    proximity: Float[Tensor, "*batch k"]
    error: Float[Tensor, "*batch v n"]
    weights: Float[Tensor, "*batch v n"]
    used_view: Bool[Tensor, "*batch v"]
    used_point: Bool[Tensor, "*batch n"]
    status: Int[Tensor, "*batch"]


def factorize_points(
    x: Float[Tensor, "*#batch v n 2"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    weights: Float[Tensor, "*#batch v n"] | None = None,
    robust: bool = False,
    max_iterations: int = 100,
) -> Factorization:
    """Find cameras and points from points in two or more uncalibrated images, up to a projective transformation of space.

    Any change of an image's coordinates by a homography changes its P accordingly and nothing else; a permutation of images or
    points permutes. What is minimised is the squared sine of the angles between rays in the balanced frames: near to, but not
    quite, the reprojection error. Follow with `bundle_adjust_projective` where that matters.

    With few images of few points the search may end at a minimum that is not the least (one in forty of exact sets of eight
    points in two images); `error` and `proximity` then show it.

    Time grows with views^2 times points: of many thousand tracks, give the longest few thousand.

    Args:
        x: Points in the images, in any unit. Rows with NaN or inf count as not visible.
        visible: Which points were seen in which view.
        weights: Non-negative; of squared residuals.
        robust: Whether to expect wrong observations: weights then fall with the residual (Geman & McClure 1985), on a scale
            from the median, from wide to narrow. Up to about a fifth of the tracks may be wrong.
        max_iterations: Most steps at each value of the prior, and in the end.

    Returns:
        Cameras, points, depths, proximity and status. Computed in float64. The derivatives of `P` and `X` are those of the
        minimum to first order in the residuals (Gauss-Newton), in the gauge in which they move least.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, P = torchsfm.random_points(30, generator=g), torchsfm.random_poses(6, generator=g).matrix()
        >>> found = torchsfm.factorize_points(torchsfm.project_points(P, X))
        >>> found.P.shape, found.X.shape, bool(found.error.max() < 1e-6)
        (torch.Size([6, 3, 4]), torch.Size([30, 4]), True)
    """
    batch = check_tensors(x=(x, "v>=2 n>=1 2"), visible=(visible, "?v n: bool"), weights=(weights, "?v n"))
    check_options(robust=(robust, bool), max_iterations=(max_iterations, "int >= 1"))
    v, n = x.shape[-3:-1]
    full = x.double().expand(*batch, v, n, 2).reshape(-1, v, n, 2)
    w = torch.isfinite(full).all(-1).double()
    if visible is not None:
        w = w * visible.expand(*batch, v, n).reshape(-1, v, n)
    if weights is not None:
        given = weights.double().expand(*batch, v, n).reshape(-1, v, n)
        w = torch.where(torch.isfinite(given), w * given.clamp(min=0), 0)
    full = finite_or_zero(full)
    size = max(1, _NUMBERS // max(48 * v * n, 1))
    starts = range(0, max(len(full), 1), size)
    parts = [_factorize(full[i : i + size], w[i : i + size], robust, max_iterations) for i in starts]
    joined = (torch.cat(items) for items in zip(*parts, strict=True))
    floating = (t.to(x.dtype) if t.is_floating_point() else t for t in joined)
    return Factorization(*(t.reshape(batch + t.shape[1:]) for t in floating))


def _factorize(x: Tensor, w: Tensor, robust: bool, steps: int) -> tuple[Tensor, ...]:
    """The fields of `Factorization` for a flat batch."""
    with torch.no_grad():
        view, point = core(w, _ENOUGH)
        counts = (w > 0) & view[..., None] & point[:, None]
        frame, balanced = balanced_frame(x, w * counts)
        rays = _rays(x, w * counts, frame)
        fit, costs, done, trust = _search(rays, robust, steps)
        # Depths positive as often as can be, and then a frame: a camera that changes its sign changes the joint columns.
        side, turn = signs_of_depths((rays.a * (fit.P @ fit.u[:, None])).sum(2))
        fit = in_own_frame(Fit(fit.P * (side * view)[..., None, None], fit.u * turn[:, None], fit.cost), point)
        proximity = torch.stack(costs + [costs[-1]] * (steps + 1 - len(costs)), -1).sqrt()
        unknowns = 11 * view.sum(-1) + 3 * point.sum(-1) - 15
        enough = (view.sum(-1) >= 2) & (point.sum(-1) >= _ENOUGH) & (2 * counts.sum((-2, -1)) >= unknowns)
        trusted = Rays(rays.a, rays.w * trust)
        loose = _undetermined(trusted, fit, view, unknowns) | ~(balanced | ~view).all(-1)
        loose = loose | _flat(trusted, fit, view.sum(-1), point.sum(-1))
        status = torch.where(done, int(Status.OK), int(Status.NOT_CONVERGED))
        status = torch.where(loose, int(Status.DEGENERATE), status)
        status = torch.where(enough, status, int(Status.TOO_FEW)).to(torch.int8)
    P, u = fit.P, fit.u
    if wants_derivative(x, w):
        P, u = with_derivative(_rays(x, w * counts * trust, frame), fit)
    # Back to the coordinates that came, each camera and point of norm 1.
    P, _ = solve(frame, P)
    P = P / torch.linalg.matrix_norm(P)[..., None, None].clamp_min(1e-300)
    X = u.mT * point[..., None]
    y = (P.detach() @ X.detach().mT[:, None]).mT
    error = torch.linalg.vector_norm(divide_safely(y[..., :2], y[..., 2]) - x.detach(), dim=-1)
    repeated = _repeated(x.detach(), error.detach(), counts & (trust > 0.5), point, unknowns)
    status = torch.where((status != Status.TOO_FEW) & repeated, int(Status.DEGENERATE), status).to(torch.int8)
    return P, X, y[..., 2] * counts, proximity, torch.where(counts, error, torch.inf), rays.w * trust, view, point, status


def _rays(x: Tensor, w: Tensor, frame: Tensor) -> Rays:
    a = torch.nn.functional.normalize(to_homogeneous(x) @ frame.mT, dim=-1)
    return Rays(torch.where(w[..., None] > 0, a, 0).mT.contiguous(), w)


def _search(rays: Rays, robust: bool, steps: int, again: bool = True) -> tuple[Fit, list[Tensor], Tensor, Tensor]:
    """The fit, its cost after each step, whether it converged, and how far each observation is trusted."""
    P, trust = of_rank(rays, 4), torch.ones_like(rays.w)
    for prior in _PRIORS:
        P, u, _ = fit_with_prior(Rays(rays.a, rays.w * trust), P, prior, steps, 1e-5)
        if robust:
            trust = _trust(rays, P, u, _SCALES[0])
    for scale in _SCALES[1:] if robust else ():
        fit = fit_angles(Rays(rays.a, rays.w * trust), P, u, 10)[0]
        P, u = fit.P, fit.u
        trust = _trust(rays, P, u, scale)
    fit, history, done = fit_angles(Rays(rays.a, rays.w * trust), P, u, steps)
    if again:
        # Points beyond an image's line at infinity, which a homography may have moved there, have negative depths: what the
        # first attempt says of the signs makes a better start for those problems.
        flip = ((rays.a * (fit.P @ fit.u[:, None])).sum(2) * rays.w < 0) & (trust > 0.5)
        mixed = (flip.any(-1).any(-1) & (fit.cost > 1e-20)).nonzero()[:, 0]
        if len(mixed):
            turned = Rays(torch.where(flip[:, :, None], -rays.a, rays.a)[mixed], rays.w[mixed])
            other, more, end, other_trust = _search(turned, robust, steps, again=False)
            mixed, kept = mixed[other.cost < fit.cost[mixed]], other.cost < fit.cost[mixed]
            longest = max(len(history), len(more))
            history, more = (h + [h[-1]] * (longest - len(h)) for h in (history, more))
            history = [h.index_put((mixed,), m[kept]) for h, m in zip(history, more, strict=True)]
            new = (other.P, other.u, other.cost, end, other_trust)
            old = (fit.P, fit.u, fit.cost, done, trust)
            P, u, cost, done, trust = (o.index_put((mixed,), n[kept]) for o, n in zip(old, new, strict=True))
            fit = Fit(P, u, cost)
    return fit, history, done, trust


def _trust(rays: Rays, P: Tensor, u: Tensor, scale: float) -> Tensor:
    """Weights of Geman & McClure, 1 for no residual, at a scale that is a multiple of the median residual."""
    square = squared_sines(rays, P, u)
    median = torch.where(rays.w > 0, square, torch.nan).flatten(1).nanmedian(-1).values.nan_to_num(1.0)
    return (1 + square / (scale * scale * median.clamp_min(1e-24))[:, None, None]).reciprocal().square()


def _undetermined(rays: Rays, fit: Fit, view: Tensor, unknowns: Tensor) -> Tensor:
    """Whether the least determined direction of the cameras, gauge apart, is left to chance."""
    values = information(rays, fit)
    # Absent views have zeros only, and fifteen directions of space are free.
    first = (15 + 12 * (~view).sum(-1)).clamp(max=values.shape[-1] - 1)
    least = values.gather(-1, first[:, None])[:, 0]
    variance = likely_variance(fit.cost * rays.w.sum((-2, -1)), 2 * (rays.w > 0).sum((-2, -1)) - unknowns, QUARTER)
    return (least <= 1e-11 * values[:, -1]) | (variance > _UNDETERMINED**2 * least) | ~torch.isfinite(least)


def _repeated(x: Tensor, error: Tensor, counts: Tensor, point: Tensor, unknowns: Tensor) -> Tensor:
    """Whether the points that are apart, as far as the noise tells, are no more than any cameras agree with.

    Points that not all images see are taken to be apart. Distances are in the images as they came, each with its own noise.
    """
    seen = counts.any(-1)
    v = seen.sum(-1)
    whole = (counts | ~seen[..., None]).all(1) & point
    square = torch.where(counts, error.square(), 0.0)
    measured = 2 * counts.sum((-2, -1))
    share = (measured - unknowns).clamp(min=1) / measured.clamp(min=1)
    variance = square.sum(-1) / (2 * counts.sum(-1)).clamp(min=1) / share[:, None]
    scaled = x / (variance + _SMALLEST * x.square().amax((-2, -1))).clamp_min(1e-300).sqrt()[..., None, None]
    place = torch.where(whole[:, None, :, None] & seen[..., None, None], scaled, 0).transpose(1, 2).flatten(2)
    # Where none is, the first is one of none.
    squares = farthest_points(place, whole | ~whole.any(-1, keepdim=True), _DISTINCT - 1)[1]
    number = whole.any(-1) + (squares > (_APART**2 * v)[:, None]).sum(-1) + (point & ~whole).sum(-1)
    return (number < _DISTINCT) & (2 * v * number <= 11 * v + 3 * number - 15)


def _flat(rays: Rays, fit: Fit, v: Tensor, n: Tensor) -> Tensor:
    """Whether space explains no more than noise beyond a plane: points in one, or views without baseline.

    Homographies are fitted too. Of what they leave, a fourth dimension always takes some: of noise, the largest singular value
    of a matrix of 3 v times n, more than the number of its parameters. Three times more must be gone.
    """
    u = fit.u * (rays.w.sum(1, keepdim=True) > 0)
    plane = eigh(u @ u.mT)[1][..., 1:]
    P, y, _ = fit_with_prior(rays, fit.P @ plane[:, None], _PRIORS[-1], _FLAT_STEPS, 1e-5)
    homographies, _, _ = fit_angles(rays, P, y, _FLAT_STEPS)
    v, n = v.double(), n.double()
    equations = 2 * (rays.w > 0).sum((-2, -1)).double()
    flat_redundancy = (equations - (8 * v + 2 * n - 8)).clamp(min=1)
    redundancy = (equations - (11 * v + 3 * n - 15)).clamp(min=0)
    beyond = ((3 * v).sqrt() + n.sqrt()).square() - (3 * v + n - 7)
    of_noise = redundancy * redundancy / (redundancy + beyond).clamp(min=1) / flat_redundancy
    return fit.cost > of_noise / 3 * homographies.cost


def signs_of_depths(depths: Tensor) -> tuple[Tensor, Tensor]:
    """Signs of views (p, v) and points (p, n) that make the most of the depths positive."""
    depths = depths.sign()
    turn = torch.where(depths[:, 0] < 0, -1.0, 1.0).to(depths.dtype)
    for _ in range(4):
        side = torch.where((depths * turn[:, None]).sum(-1) < 0, -1.0, 1.0).to(depths.dtype)
        turn = torch.where((depths * side[..., None]).sum(-2) < 0, -1.0, 1.0).to(depths.dtype)
    return side, turn
