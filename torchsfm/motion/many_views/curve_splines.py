"""Images of cubic B-splines in space, and their points nearest to what was measured.

Space curves are finite in the frame that is used, (problem, view, curve, point) the order of what is measured. Places along a
spline are told in knots: 0 to k - 3 of k control points of an open one, any number of a closed one.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

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
    """Derivatives of y by the knots,"""
    second: Float[Tensor, "p v c n 3"]
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
    k = x.control.shape[2]
    weights, index = control_weights(x.t, closed[:, None], k)
    own = x.control[:, None].expand(-1, x.t.shape[1], -1, -1, -1)
    own = own.gather(3, index.flatten(3)[..., None].expand(*index.shape[:3], -1, 3)).view(*index.shape, 3)
    X, X1, X2 = ((w[..., None] * own).sum(-2) for w in weights)
    M, a = x.P[:, :, None, :, :3].mT, x.P[:, :, None, None, :, 3]
    y, first, second = X @ M + a, X1 @ M, X2 @ M
    depth = torch.where(y[..., 2:] == 0, 1e-300, y[..., 2:])
    points = y[..., :2] / depth
    move = (first[..., :2] - points * first[..., 2:]) / depth
    bend = (second[..., :2] - points * second[..., 2:] - 2 * move * first[..., 2:]) / depth
    away, speed = points - measured, move.square().sum(-1)
    bent = torch.maximum(speed + (away * bend).sum(-1), _BENT * speed).clamp_min(1e-300)
    slope = (away * move).sum(-1)
    end = torch.where(slope < 0, x.t >= k - 3, x.t <= 0)
    return Images(y, first, second, points, away, speed, bent, slope, end & ~closed[:, None, :, None])


def nearest(x: Splines, closed: Bool[Tensor, "p c"], measured: Float[Tensor, "p v c n 2"]) -> tuple[Splines, Images]:
    """The nearest points that are reached from given ones, each step to a nearer one."""
    seen, most = see(x, closed, measured), _LONGEST
    last = x.control.shape[2] - 3
    ring = closed[:, None, :, None]
    longest = torch.full_like(x.t, most)
    for _ in range(_NEWTON):
        move = (-seen.slope / seen.bent).clamp(-longest, longest)
        t = torch.where(ring, x.t + move, (x.t + move).clamp(0, last))
        other = see(x._replace(t=t), closed, measured)
        nearer = other.away.square().sum(-1) <= seen.away.square().sum(-1)
        longest = torch.where(nearer, most, move.abs() / 4)
        x = x._replace(t=torch.where(nearer, t, x.t))
        seen = Images(*(torch.where(nearer[(...,) + (None,) * (a.ndim - 4)], b, a) for a, b in zip(seen, other, strict=True)))
    return x, seen


def control_weights(
    t: Float[Tensor, "*b n"], closed: Bool[Tensor, "*#b"], k: int
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Weights of the four control points about places, two derivatives of these, and the points' numbers, (*b, n, 4)."""
    ring = closed[..., None]
    low = torch.where(ring, t.floor(), t.floor().clamp(0, k - 4))
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
