"""From samples of space curves to splines through all that was measured, and back.

Samples meet image curves where these are drawn smoothly between measured points. That is exact where points are many and exact;
where they are few or noisy splines know better. What they leave tells which it is.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm.geometry.curve_places import CurvePlaces
from torchsfm.linalg import determinant_3x3, eigh, qr, solve
from torchsfm.motion.many_views.bilinear_fit import unit_frame
from torchsfm.motion.many_views.curve_fit import Scene
from torchsfm.motion.many_views.curve_spline_fit import (
    SplineDistances,
    all_directions,
    approach_splines,
    fit_splines,
    held_directions,
    typical_distance,
)
from torchsfm.motion.many_views.curve_splines import Splines, control_weights, spread
from torchsfm.motion.many_views.factorization_points import signs_of_depths

_POINTS = 4 / 3
"""Measured points of the longest image curve for each control point, at least; where there are fewer, stiffness decides."""
_FEWEST = 6
"""Control points."""
_STIFF = 1e-3
"""Weight of second differences of control points, of a sample's, at the start."""
_FINITE = 0.02
"""Sine of the angle between a sample and the plane at infinity, at least."""
_TURNS = 100
"""Of a plane away from what is nearest to it."""
_ROUNDS = 3
"""Of weights by distances and of stiffness."""
_STIFFER = 2.0
"""Splines whose median distance is so many standard deviations of those of samples do not follow what was measured."""
_TOLERANCE = 1e-6
"""End when no more than this part of the cost is left to gain: of a thousand distances, a thousandth of what one brings."""


class Refit(NamedTuple):
    """Cameras and samples by splines."""

    x: Scene
    status: Int8[Tensor, "p"]
    """Of the descent."""


def refit(
    images: CurvePlaces, counts: Float[Tensor, "p v c m"], x: Scene, noise: Float[Tensor, "p"], steps: int
) -> Refit | None:
    """Cameras and samples by the least squares of measured points from splines.

    None where splines are too stiff for what was measured exactly, or points too few for splines.

    Args:
        images: The image curves.
        counts: 1 where a sample is seen rightly, of what all views show.
        x: Cameras and samples near the least squares.
        noise: Standard deviation of the samples' distances.
        steps: Most steps.
    """
    shown = images.number >= 3
    points = images.number + ~images.closed
    m = x.place.shape[-1]
    k = min(m, int(torch.where(shown, points, 0).amax() / _POINTS))
    frame = finite_frame(x, counts)
    if k < _FEWEST or frame is None:
        return None
    P, X = frame
    closed = (images.closed & shown).any(1)
    right = (counts > 0).any(1)
    share, known = _shares(images, x.place, counts > 0)
    middle = known[0][..., m : 2 * m]
    span = torch.where(closed, k, k - 3)[..., None]
    knot = share * span
    control = _through(X.view(*share.shape, 3), knot, right, closed, k)
    n = images.segments.start.shape[-2]
    slot = torch.arange(n, dtype=P.dtype, device=P.device).expand(*shown.shape, n).contiguous()
    t = _interpolated(*known, slot) * span[:, None]
    weight = ((slot < points[..., None]) & shown[..., None] & (t.isfinite())).to(P.dtype)
    start = Splines(P, control, torch.where(weight > 0, t, 0))
    none = torch.zeros_like(knot[..., 0])
    problem = SplineDistances(images.at(slot)[0], weight, closed, none, all_directions(control), held_directions(P))
    for _ in range(_ROUNDS):
        problem, start = approach_splines(problem, start)
        here = problem.linearize(start)
        if bool((typical_distance(problem, here) > _STIFFER * noise).any()):
            return None
    end = fit_splines(problem, start, steps, _TOLERANCE)
    # The samples where they were along the curves.
    weights = _basis(knot, closed, k)
    Y = (weights @ end.x.control).flatten(1, 2)
    Y = torch.cat((Y, torch.ones_like(Y[..., :1])), -1)
    P, u = unit_frame(end.x.P, Y.mT)
    return Refit(Scene(P, u, torch.where(shown[..., None], middle, x.place)), end.status)


def finite_frame(x: Scene, counts: Tensor, *, cameras: bool = False) -> tuple[Tensor, Tensor] | None:
    """Cameras and samples (p, n, 3) in a frame in which the samples are finite and spread alike in all directions.

    With `cameras` these are finite too, all before or all behind the samples where that may be (Hartley & Zisserman, 21.7).
    """
    seen = counts.flatten(2)
    side, turn = signs_of_depths((x.P @ x.u[:, None])[:, :, 2] * seen)
    right = (seen > 0).any(1)
    u = (x.u * turn[:, None]).mT
    w = torch.nn.functional.normalize((u * right[..., None]).sum(1), dim=-1)
    if cameras:
        w = _between(u * right[..., None], _centres(x.P * side[..., None, None]), w)
    depth = (u @ w[..., None])[..., 0]
    if bool((right & (depth < _FINITE)).any()):
        return None
    eye = torch.eye(4, dtype=u.dtype, device=u.device)[:, :3].expand(len(u), 4, 3)
    Q = qr(torch.cat((w[..., None], eye), -1))[0][..., 1:]
    X = torch.where(right[..., None], (u @ Q) / torch.where(right, depth, 1)[..., None], 0)
    number = right.sum(-1).clamp(min=1)[:, None]
    mean = X.sum(1) / number
    X = torch.where(right[..., None], X - mean[:, None], 0)
    values, vectors, _ = eigh(X.mT @ X / number[..., None])
    E = vectors * values.clamp_min(1e-6 * values[:, -1:]).sqrt().clamp_min(1e-100)[:, None]
    M = x.P @ Q[:, None]
    P = torch.cat((M @ E[:, None], M @ mean[:, None, :, None] + x.P @ w[:, None, :, None]), -1)
    return P / torch.linalg.matrix_norm(P)[..., None, None].clamp_min(1e-100), solve(E, X.mT)[0].mT


def _centres(P: Float[Tensor, "p v 3 4"]) -> Float[Tensor, "p v 4"]:
    """Centres of cameras, by minors: their signs go with those of the cameras."""
    minors = [determinant_3x3(P[..., [j for j in range(4) if j != i]]) * (-1) ** (i + 1) for i in range(4)]
    return torch.nn.functional.normalize(torch.stack(minors, -1), dim=-1)


def _between(u: Float[Tensor, "p n 4"], centres: Float[Tensor, "p v 4"], w: Float[Tensor, "p 4"]) -> Float[Tensor, "p 4"]:
    """A plane with all samples on its positive side, and all centres on one, near `w` (Rosenblatt's perceptron)."""
    best, gap = w, torch.full_like(w[:, 0], -torch.inf)
    for sign in (1.0, -1.0):
        z = torch.cat((u, sign * centres), 1)
        there = (z != 0).any(-1)
        v, total = w, w
        for _ in range(_TURNS):
            inside = torch.where(there, (z @ v[..., None])[..., 0], torch.inf)
            least, worst = inside.min(-1)
            better = least > gap
            best, gap = torch.where(better[:, None], v, best), torch.where(better, least, gap)
            total = total + z.gather(1, worst[:, None, None].expand(-1, 1, 4))[:, 0]
            v = torch.nn.functional.normalize(total, dim=-1)
    return best


def _shares(images: CurvePlaces, place: Tensor, right: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Where along its curve each sample is, by shares of the measured points of all views; and by the places in each view."""
    turn = torch.where(images.closed, images.number, 0)[..., None]
    m = place.shape[-1]
    around = torch.cat((place - turn, place, place + turn), -1)
    ring = images.closed[..., None]
    good = torch.cat((right & ring, right, right & ring), -1)
    slot = torch.arange(3 * m, device=place.device).expand(good.shape)
    before = torch.where(good, slot, -1).cummax(-1).values
    after = torch.where(good, slot, 3 * m).flip(-1).cummin(-1).values.flip(-1)
    first = torch.where(before < 0, after, before).clamp(0, 3 * m - 1)
    last = torch.where(after >= 3 * m, before, after).clamp(0, 3 * m - 1)
    low, high = around.gather(-1, first), around.gather(-1, last)
    step = images.number[..., None] / m
    inner = low + (high - low) * (slot - first) / (last - first).clamp(min=1)
    filled = torch.where(last > first, inner, low + (slot - first) * step)
    filled = (filled.cummax(-1).values + filled.flip(-1).cummin(-1).values.flip(-1)) / 2
    seen = right.any(-1, keepdim=True)
    share = filled / images.number[..., None].clamp(min=1)
    share = torch.where(seen, share, 0).sum(1) / seen.sum(1).clamp(min=1)
    ring = ring.any(1)
    middle = share[..., m : 2 * m]
    # An open curve is taken to go on for half a step at both ends.
    start = middle[..., :1] - (middle[..., 1:2] - middle[..., :1]) / 2
    end = middle[..., -1:] + (middle[..., -1:] - middle[..., -2:-1]) / 2
    share = torch.where(ring, share, (share - start) / (end - start).clamp_min(1e-12))
    open_only = torch.where(ring, slot[:, 0] >= 0, (slot[:, 0] >= m) & (slot[:, 0] < 2 * m))
    known = torch.where(open_only[:, None], filled, torch.where(slot < m, -torch.inf, torch.inf))
    return share[..., m : 2 * m], (known, share[:, None].expand_as(known))


def _interpolated(x: Tensor, y: Tensor, query: Tensor) -> Tensor:
    """Values at places between given ones in order, infinite where none is given; beyond the ends straight on."""
    x, y, query = x.contiguous(), y.contiguous(), query.contiguous()
    after = torch.searchsorted(x, query, right=True)
    given = x.isfinite()
    first = given.to(torch.int8).argmax(-1, keepdim=True)
    last = first + given.sum(-1, keepdim=True) - 1
    before = torch.minimum(torch.maximum(after - 1, first), last - 1).clamp(min=0)
    low, high = x.gather(-1, before), x.gather(-1, before + 1)
    share = (query - low) / (high - low).clamp_min(1e-9)
    return torch.lerp(y.gather(-1, before), y.gather(-1, before + 1), share)


def _basis(knot: Float[Tensor, "p c m"], closed: Bool[Tensor, "p c"], k: int) -> Float[Tensor, "p c m k"]:
    """Weights of control points at places told in knots."""
    weights, index = control_weights(knot, closed, k)
    return spread(weights[0], index, k)


def _through(X: Tensor, knot: Tensor, right: Tensor, closed: Tensor, k: int) -> Float[Tensor, "p c k 3"]:
    """Control points of splines near samples."""
    B = _basis(knot, closed, k) * right[..., None]
    eye = torch.eye(k, dtype=X.dtype, device=X.device)
    bend = eye.roll(-1, -1) - 2 * eye + eye.roll(1, -1)
    inner = ((torch.arange(k, device=X.device) > 0) & (torch.arange(k, device=X.device) < k - 1))[:, None]
    bend = torch.where(closed[..., None, None] | inner, bend, 0)
    A = B.mT @ B + _STIFF * bend.mT @ bend
    return solve(A + 1e-9 * eye, B.mT @ X)[0]
