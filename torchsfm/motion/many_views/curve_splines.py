"""Images of cubic B-splines in space, and their points nearest to what was measured.

Space curves are finite in the frame that is used, (problem, view, curve, point) the order of what is measured. Places along a
spline are told in knots: 0 to k - 3 of k control points of an open one, any number of a closed one.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry.curves import Cubics
from torchsfm.linalg.rows import combine_rows, inner

_POWERS = [[1.0, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]
"""Six times the coefficients of a spline after a knot, by the four control points about it."""
_NEWTON = 5
"""Steps to the nearest point, from where it was before."""
_LONGEST = 1.0
"""The longest of them, in knots."""
_BENT = 0.3
"""Least second derivative of half the squared distance along a spline, of what it were if the spline's image did not bend."""


class Splines(NamedTuple):
    """Cameras, space curves, and where on these the measured points are."""

    P: Float[Tensor, "p v 3 4"]
    control: Float[Tensor, "p c k 3"]
    t: Float[Tensor, "p v c n"]


class Images(NamedTuple):
    """Images of points of splines, how they move with these, and how far they are from what was measured."""

    y: Float[Tensor, "p v c n 3"]
    first: Float[Tensor, "p v c n 3"]
    """The derivative of y by the knots."""
    points: Float[Tensor, "p v c n 2"]
    away: Float[Tensor, "p v c n 2"]
    speed: Float[Tensor, "p v c n"]
    """The squared derivative of the point by the knots,"""
    bent: Float[Tensor, "p v c n"]
    """half the second one of its squared distance,"""
    slope: Float[Tensor, "p v c n"]
    """and half the first."""
    held: Bool[Tensor, "p v c n"]
    """At the end of an open spline, beyond which it would go."""


def see(x: Splines, closed: Bool[Tensor, "p c"], measured: Float[Tensor, "p v c n 2"]) -> Images:
    """Where points of splines are seen."""
    return _seen(_images(x, closed), x.t, closed, measured)


def _images(x: Splines, closed: Bool[Tensor, "p c"]) -> Cubics:
    """Homogeneous images of splines from each knot to the next, (p, v, c, k)."""
    about = torch.stack([x.control.roll(-i, 2) for i in range(4)], 3)
    powers = (x.control.new_tensor(_POWERS) / 6 @ about)[:, None]
    y = powers.flatten(3, 4) @ x.P[:, :, None, :, :3].mT
    y = y.reshape(*y.shape[:3], -1, 4, 3) + torch.nn.functional.pad(x.P[:, :, None, None, None, :, 3], (0, 0, 0, 3))
    return Cubics(y.flatten(4).mT.contiguous())


def _seen(images: Cubics, t: Float[Tensor, "p v c n"], closed: Bool[Tensor, "p c"], measured: Tensor) -> Images:
    """Where the points at places are seen."""
    ring, k = closed[:, None, :, None], images.coefficients.shape[-1]
    low = _knots(t, ring, k)
    index = low.long()  # in range also where a place is not finite
    y, first, second = images.take(torch.where(ring, index % k, index.clamp(0, k - 4))).rows(t - low)
    depth = y[..., 2:, :]
    depth = torch.where(depth == 0, 1e-300, depth)
    points = y[..., :2, :] / depth
    move = (first[..., :2, :] - points * first[..., 2:, :]) / depth
    bend = (second[..., :2, :] - points * second[..., 2:, :] - 2 * move * first[..., 2:, :]) / depth
    away = points - measured.mT
    rows, moves = away.unbind(-2), move.unbind(-2)
    speed = combine_rows(moves, moves)
    bent = torch.maximum(speed + combine_rows(rows, bend.unbind(-2)), _BENT * speed).clamp_min(1e-300)
    slope = combine_rows(rows, moves)
    end = torch.where(slope < 0, t >= k - 3, t <= 0)
    return Images(y.mT, first.mT, points.mT, away.mT, speed, bent, slope, end & ~ring)


def nearest(x: Splines, closed: Bool[Tensor, "p c"], measured: Float[Tensor, "p v c n 2"]) -> tuple[Splines, Images]:
    """The nearest points that are reached from given ones, each step to a nearer one."""
    images, t, most = _images(x, closed), x.t, _LONGEST
    seen = _seen(images, t, closed, measured)
    last = x.control.shape[2] - 3
    ring = closed[:, None, :, None]
    longest = torch.full_like(t, most)
    for _ in range(_NEWTON):
        move = (-seen.slope / seen.bent).clamp(-longest, longest)
        moved = torch.where(ring, t + move, (t + move).clamp(0, last))
        other = _seen(images, moved, closed, measured)
        nearer = inner(other.away, other.away) <= inner(seen.away, seen.away)
        longest = torch.where(nearer, most, move.abs() / 4)
        t = torch.where(nearer, moved, t)
        seen = Images(*(torch.where(nearer[(...,) + (None,) * (a.ndim - 4)], b, a) for a, b in zip(seen, other, strict=True)))
    return x._replace(t=t), seen


def _knots(t: Float[Tensor, "*b n"], ring: Bool[Tensor, "*#b 1"], k: int) -> Float[Tensor, "*b n"]:
    """The knot before each place; at the ends of open splines the first and the last that another follows."""
    return torch.where(ring, t.floor(), t.floor().clamp(0, k - 4))


def control_weights(
    t: Float[Tensor, "*b n"], closed: Bool[Tensor, "*#b"], k: int
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Weights of the four control points about places, two derivatives of these, and the points' numbers, (*b, n, 4)."""
    ring = closed[..., None]
    low = _knots(t, ring, k)
    index = low.long()[..., None] + torch.arange(4, device=t.device)
    u = t - low
    s = 1 - u
    weights = torch.stack((s**3, 3 * u**3 - 6 * u**2 + 4, 3 * s**3 - 6 * s**2 + 4, u**3), -1) / 6
    first = torch.stack((-(s**2), 3 * u**2 - 4 * u, 4 * s - 3 * s**2, u**2), -1) / 2
    second = torch.stack((s, 3 * u - 2, 3 * s - 2, u), -1)
    return (weights, first, second), torch.where(ring[..., None], index % k, index)


def spread(weights: Float[Tensor, "*b 4"], index: Tensor, k: int) -> Float[Tensor, "*b k"]:
    """Weights of all control points."""
    return weights.new_zeros(*weights.shape[:-1], k).scatter_add(-1, index, weights)


def third_differences(closed: Bool[Tensor, "p c"], k: int) -> Float[Tensor, "p c k k"]:
    """What takes third differences of control points, around closed splines."""
    eye = torch.eye(k, dtype=torch.float64, device=closed.device)
    D = eye.roll(-2, -1) - 3 * eye.roll(-1, -1) + 3 * eye - eye.roll(1, -1)
    inner = torch.arange(k, device=closed.device)
    inner = ((inner >= 1) & (inner < k - 2))[:, None]
    return torch.where(closed[..., None, None] | inner, D.mT, 0)


def courses(control: Float[Tensor, "p c k 3"], closed: Bool[Tensor, "p c"]) -> Float[Tensor, "p c k 3"]:
    """How splines run at control points."""
    ahead, behind = control.roll(-1, 2) - control, control - control.roll(1, 2)
    ends = torch.cat((ahead[:, :, :1], (ahead + behind)[:, :, 1:-1], behind[:, :, -1:]), 2)
    return torch.where(closed[..., None, None], ahead + behind, ends)
