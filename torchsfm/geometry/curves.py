"""Curves of the plane and of space: ordered samples, and the smooth curve through them.

Between samples a curve is a cubic whose slopes at the samples are those of parabolas through three neighbours, by chord length
(Catmull & Rom 1974; Farin, Curves and Surfaces for CAGD, 9.8): it leaves a smooth curve by the third power of the spacing or
less.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_options, check_tensors

_NUMBERS = 1 << 22
"""Distances of points from segments that are computed at a time."""
_NEWTON = 4
"""Steps from the nearest point of the chord to that of the cubic."""


@dataclass(frozen=True)
class Curve:
    """Curves as ordered samples, in slots of which the first ones are `valid`; see `curve_from_samples`.

    Example:
        >>> import torch, torchsfm
        >>> corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> square = torchsfm.geometry.curve_from_samples(corners, closed=True)
        >>> square.length, square.number
        (tensor(4.), tensor(4))
        >>> square.reversed().x[1]
        tensor([0., 1.])
    """

    x: Float[Tensor, "*batch n d"]
    """Samples, d = 2 in images and 3 in space; zero in empty slots. A closed curve does not repeat its first sample."""
    valid: Bool[Tensor, "*batch n"]
    """Which slots hold a sample."""
    closed: Bool[Tensor, "*batch"]
    """Whether the last sample is next to the first."""

    @property
    def number(self) -> Int[Tensor, "*batch"]:
        """How many samples a curve has."""
        return self.valid.sum(-1)

    @property
    def length(self) -> Float[Tensor, "*batch"]:
        """The length of the polygon through the samples."""
        return segments_of(self).length.sum(-1)

    def tangents(self) -> Float[Tensor, "*batch n d"]:
        """Unit tangents at the samples, forwards; zero in empty slots and of single points."""
        return torch.nn.functional.normalize(segments_of(self).slope, dim=-1)

    def reversed(self) -> "Curve":
        """The same curves from their other end; closed ones keep their first sample."""
        slots = torch.arange(self.x.shape[-2], device=self.x.device)
        number = self.number[..., None]
        index = torch.where(self.closed[..., None], (number - slots) % number.clamp(min=1), number - 1 - slots)
        index = torch.where(self.valid, index, slots)
        return Curve(_rows(self.x, index), self.valid, self.closed)

    def resample(self, n: int) -> "Curve":
        """As many samples on the smooth curves, equally far apart along the polygon; open ends stay.

        A curve of fewer than two samples, or without length, has none.
        """
        check_options(n=(n, "int >= 2"))
        s = segments_of(self)
        end = s.length.cumsum(-1)
        total = end[..., -1:]
        share = torch.arange(n, dtype=self.x.dtype, device=self.x.device)
        share = share / torch.where(self.closed, n, n - 1)[..., None]
        place = total * share
        index = torch.searchsorted(end.contiguous(), place.contiguous(), right=True)
        index = torch.minimum(index, (s.there.sum(-1) - 1).clamp(min=0)[..., None])
        length = s.length.gather(-1, index)
        t = (place - end.gather(-1, index) + length) / torch.where(length > 0, length, 1)
        x, _, _ = s.take(index).at(t.clamp(0, 1))
        there = ((total > 0) & torch.isfinite(x).all(-1).all(-1, keepdim=True)).expand(x.shape[:-1])
        return Curve(torch.where(there[..., None], x, 0), there, self.closed)


class FootPoints(NamedTuple):
    """The points of curves nearest to given points.

    Example:
        >>> import torch, torchsfm
        >>> line = torchsfm.geometry.curve_from_samples(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))
        >>> x = torch.tensor([[0.5, 3.0], [-1.0, 0.0]])
        >>> foot = torchsfm.geometry.foot_points(line, x)
        >>> normal = torch.stack((-foot.tangent[:, 1], foot.tangent[:, 0]), -1)
        >>> ((x - foot.x) * normal).sum(-1).abs(), foot.within  # distances across; the second point is beyond the end
        (tensor([3., 0.]), tensor([ True, False]))
    """

    x: Float[Tensor, "*batch m d"]
    """The nearest points, on the smooth curves; zero where a curve has fewer than two samples."""
    tangent: Float[Tensor, "*batch m d"]
    """Unit tangents there, forwards."""
    within: Bool[Tensor, "*batch m"]
    """False where the nearest point is an open end that the given point lies beyond, or there is no curve."""


class Crossings(NamedTuple):
    """Where curves of the plane cross lines, along the curve, in slots of which the first are `valid`.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, -1.0], [2.0, 1.0], [3.0, 0.0], [4.0, 1.0]])  # up through the line y = 0, then down to it
        >>> curve = torchsfm.geometry.curve_from_samples(x)
        >>> found = torchsfm.geometry.curve_crossings(curve, torch.tensor([[0.0, 1.0, 0.0]]), most=4)
        >>> found.x[found.valid], found.sine[found.valid]  # both at 45 degrees
        (tensor([[1., 0.],
                [3., 0.]]), tensor([0.7071, 0.7071]))
    """

    x: Float[Tensor, "*batch m k 2"]
    """The crossings of each line, in the unit of the curve; zero in empty slots."""
    sine: Float[Tensor, "*batch m k"]
    """Of the angle between the curve and the line; 0 in empty slots."""
    valid: Bool[Tensor, "*batch m k"]
    """Which slots hold a crossing."""


def curve_from_samples(
    x: Float[Tensor, "*#batch n d"],
    *,
    valid: Bool[Tensor, "*#batch n"] | None = None,
    closed: Bool[Tensor, "*#batch"] | bool = False,
) -> Curve:
    """Curves through samples in order.

    Args:
        x: The samples. Those that are not finite are left out, as is one that repeats the one before it.
        valid: Which samples there are, all by default; wherever they are, they are moved to the first slots.
        closed: Whether the last sample is next to the first, for all curves or each.

    Returns:
        The curves.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> samples = torch.tensor([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 4.0]])  # one twice
        >>> curve = torchsfm.geometry.curve_from_samples(samples)
        >>> curve.number, curve.length
        (tensor(3), tensor(7.))
    """
    flag = closed if isinstance(closed, Tensor) else None
    check_options(closed=(closed, Tensor | bool))
    batch = check_tensors(x=(x, "n>=1 d>=2"), valid=(valid, "?n: bool"), closed=(flag, "?: bool"))
    n, d = x.shape[-2:]
    x = x.expand(*batch, n, d)
    there = torch.isfinite(x).all(-1)
    if valid is not None:
        there = there & valid
    x, there = _packed(x, there)
    repeated = (x[..., 1:, :] == x[..., :-1, :]).all(-1)
    there = torch.cat((there[..., :1], there[..., 1:] & ~repeated), -1)
    x, there = _packed(x, there)
    around = torch.tensor(closed, device=x.device) if flag is None else flag
    return Curve(x, there, around.expand(batch))


def foot_points(curve: Curve, y: Float[Tensor, "*#batch m d"]) -> FootPoints:
    """The points of curves nearest to given points: on the nearest chord, then by Newton's method on its cubic.

    Args:
        curve: The curves.
        y: Points.

    Returns:
        Nearest points, tangents and whether they are within the curve. `x` has the derivatives by the curve's samples of the
        point at the same share of its segment: exact across the curve, which is all that distances feel; none by `y`, and
        `tangent` has none.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> line = torchsfm.geometry.curve_from_samples(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))
        >>> foot = torchsfm.geometry.foot_points(line, torch.tensor([[0.5, 3.0], [-1.0, 0.0]]))
        >>> foot.x[0], foot.within
        (tensor([0.5000, 0.0000]), tensor([ True, False]))
    """
    d = curve.x.shape[-1]
    check_tensors(y=(y, f"m {d}"), curve=(curve.x, f"n {d}"))
    batch = broadcast_shapes(curve.x.shape[:-2], y.shape[:-2])
    n, m = curve.x.shape[-2], y.shape[-2]
    s = segments_of(
        Curve(
            curve.x.expand(*batch, n, d).reshape(-1, n, d),
            curve.valid.expand(*batch, n).reshape(-1, n),
            curve.closed.expand(batch).reshape(-1),
        )
    )
    with torch.no_grad():
        held = Segments(*(t.detach() for t in s))
        points = y.detach().expand(*batch, m, d).reshape(-1, m, d)
        rows = max(1, _NUMBERS // max(n * d * len(points), 1))
        parts = [_feet(held, points[:, i : i + rows]) for i in range(0, max(m, 1), rows)]
        index, share, tangent, good, beyond = (torch.cat(part, 1) for part in zip(*parts, strict=True))
    x = torch.where(good[..., None], s.take(index).at(share)[0], 0)
    return FootPoints(*(part.reshape(*batch, m, *part.shape[2:]) for part in (x, tangent, good & ~beyond)))


def curve_crossings(curve: Curve, line: Float[Tensor, "*#batch m 3"], most: int) -> Crossings:
    """Where the polygons of plane curves cross lines.

    Args:
        curve: Curves of the plane.
        line: Homogeneous lines of any scale.
        most: Slots for each line; of more crossings the first along the curve are kept.

    Returns:
        The crossings and the angles.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> zigzag = torchsfm.geometry.curve_from_samples(torch.tensor([[0.0, -1.0], [1.0, 1.0], [2.0, -1.0]]))
        >>> found = torchsfm.geometry.curve_crossings(zigzag, torch.tensor([[0.0, 1.0, 0.0]]), most=3)  # the line y = 0
        >>> found.x[found.valid]
        tensor([[0.5000, 0.0000],
                [1.5000, 0.0000]])
    """
    check_tensors(line=(line, "m 3"), curve=(curve.x, "n 2"))
    check_options(most=(most, "int >= 1"))
    s = segments_of(curve)
    normal, far = line[..., None, :2], line[..., None, 2]
    start = (normal * s.start[..., None, :, :]).sum(-1) + far
    rise = (normal * s.chord[..., None, :, :]).sum(-1)
    end = start + rise
    # A segment has its start and not its end, so that a crossing at a sample is counted once.
    crossed = s.there[..., None, :] & (((start <= 0) & (end > 0)) | ((start >= 0) & (end < 0)))
    crossed = crossed & torch.isfinite(start) & torch.isfinite(rise)
    slots = torch.arange(crossed.shape[-1], device=crossed.device)
    order = torch.where(crossed, slots, crossed.shape[-1])
    k = min(most, crossed.shape[-1])
    index = order.topk(k, dim=-1, largest=False).values
    valid = index < crossed.shape[-1]
    index = torch.where(valid, index, 0)
    a, b = start.gather(-1, index), rise.gather(-1, index)
    t = torch.where(valid, -a / torch.where(valid & (b != 0), b, 1), 0)
    own = s.take(index.flatten(-2))
    x = (own.start + own.chord * t.flatten(-2)[..., None]).reshape(*index.shape, 2)
    width = torch.linalg.vector_norm(line[..., :2], dim=-1)[..., None] * own.length.reshape(index.shape)
    sine = torch.where(valid & (width > 0), b.abs() / torch.where(width > 0, width, 1), 0).clamp(max=1)
    x = torch.where(valid[..., None], x, 0)
    pad = (0, most - k)
    return Crossings(
        torch.nn.functional.pad(x, (0, 0, *pad)), torch.nn.functional.pad(sine, pad), torch.nn.functional.pad(valid, pad)
    )


class Segments(NamedTuple):
    """Between each sample and the next: start, chord, its length, the slopes by length at both ends."""

    start: Float[Tensor, "*batch n d"]
    chord: Float[Tensor, "*batch n d"]
    length: Float[Tensor, "*batch n"]
    slope: Float[Tensor, "*batch n d"]
    next_slope: Float[Tensor, "*batch n d"]
    there: Bool[Tensor, "*batch n"]
    open: Bool[Tensor, "*batch"]
    """Whether the first and the last of them have ends."""

    def take(self, index: Int[Tensor, "*batch m"]) -> "Segments":
        """Some of them."""
        rows = (_rows(t, index) for t in (self.start, self.chord, self.slope, self.next_slope))
        start, chord, slope, next_slope = rows
        length, there = self.length.gather(-1, index), self.there.gather(-1, index)
        return Segments(start, chord, length, slope, next_slope, there, self.open)

    def at(self, t: Float[Tensor, "*batch n"]) -> tuple[Tensor, Tensor, Tensor]:
        """The point at a share of each, and the first and second derivative by the share."""
        h = self.length[..., None]
        t = t[..., None]
        a, b = h * self.slope, h * self.next_slope
        # p = start + a t + c t^2 + e t^3 with the chord and b at its end.
        e = a + b - 2 * self.chord
        c = 3 * self.chord - 2 * a - b
        return (
            self.start + t * (a + t * (c + t * e)),
            a + t * (2 * c + 3 * t * e),
            2 * c + 6 * t * e,
        )


def segments_of(curve: Curve) -> Segments:
    """The cubics between the samples of curves."""
    # A sample that is no number leaves nothing of its curve.
    sound = (torch.isfinite(curve.x).all(-1) | ~curve.valid).all(-1, keepdim=True)
    valid = curve.valid & sound
    x, number = torch.where(valid[..., None], curve.x, 0), valid.sum(-1, keepdim=True)
    slots = torch.arange(x.shape[-2], device=x.device)
    around = curve.closed[..., None] & (number > 2)
    after = torch.where(slots + 1 < number, slots + 1, 0)
    before = torch.where(slots > 0, slots - 1, (number - 1).clamp(min=0))
    there = valid & ((slots + 1 < number) | around)
    chord = torch.where(there[..., None], _rows(x, after) - x, 0)
    length = torch.linalg.vector_norm(chord, dim=-1)
    there = there & (length > 0) & (length < torch.inf)
    unit = chord / torch.where(there, length, 1)[..., None]
    # The parabola through three samples has at the middle one the mean of both chords' directions, the shorter counting more;
    # at the first, as far on the other side of the first chord's direction as the second's slope is on this.
    previous = there.gather(-1, before) & (around | (slots > 0))
    h, g = length[..., None], length.gather(-1, before)[..., None]
    back = _rows(unit, before)
    both = (there & previous)[..., None]
    middle = (g * unit + h * back) / torch.where(both, g + h, 1)
    first, last = (there & ~previous)[..., None], (previous & ~there)[..., None]
    single = torch.where(first, unit, torch.where(last, back, 0))
    neighbour = torch.where(first, _rows(middle, after), _rows(middle, before))
    has_middle = torch.where(first, _rows(both, after), _rows(both, before))
    slope = torch.where(both, middle, torch.where(has_middle, 2 * single - neighbour, single))
    return Segments(x, chord, length, slope, _rows(slope, after), there, ~around[..., 0])


def _feet(s: Segments, y: Float[Tensor, "b m d"]) -> tuple[Tensor, ...]:
    """Segment and share of the nearest points, unit tangents, whether there is any, and whether y is beyond an open end."""
    away = y[:, :, None] - s.start[:, None]
    square = s.length.square()[:, None]
    t = ((away * s.chord[:, None]).sum(-1) / torch.where(square > 0, square, 1)).clamp(0, 1)
    gap = (away - t[..., None] * s.chord[:, None]).square().sum(-1)
    index = torch.where(s.there[:, None], gap, torch.inf).nan_to_num(nan=torch.inf).argmin(-1)
    t = t.gather(-1, index[..., None])[..., 0]
    number, around = s.there.sum(-1, keepdim=True), ~s.open[:, None]
    for again in (True, False):
        own = s.take(index)
        for _ in range(_NEWTON):
            p, first, second = own.at(t)
            speed = first.square().sum(-1)
            bent = speed + ((p - y) * second).sum(-1)
            step = ((p - y) * first).sum(-1) / torch.maximum(bent, 0.3 * speed).clamp(min=1e-300)
            t = (t - step).clamp(0, 1)
        p, first, _ = own.at(t)
        slope = ((p - y) * first).sum(-1)
        before, after = (t <= 0) & (slope > 0), (t >= 1) & (slope < 0)
        if again:
            # Near a sample the nearest chord may be the one beside the nearest cubic.
            before, after = before & (around | (index > 0)), after & (around | (index < number - 1))
            moved = (index + after.long() - before.long()) % number.clamp(min=1)
            index, t = moved, torch.where(before, 1.0, torch.where(after, 0.0, t))
    beyond = (before & ~around & (index == 0)) | (after & ~around & (index == number - 1))
    tangent = torch.nn.functional.normalize(first, dim=-1)
    good = (number > 0) & torch.isfinite(y).all(-1) & torch.isfinite(p + tangent).all(-1)
    return index, t, torch.where(good[..., None], tangent, 0), good, beyond


def _packed(x: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """The samples that there are in the first slots, in order, zeros behind."""
    order = there.to(torch.int8).argsort(dim=-1, descending=True, stable=True)
    there = there.gather(-1, order)
    return torch.where(there[..., None], _rows(x, order), 0), there


def _rows(x: Shaped[Tensor, "*batch n d"], index: Int[Tensor, "*batch m"]) -> Shaped[Tensor, "*batch m d"]:
    return x.gather(-2, index[..., None].expand(*index.shape, x.shape[-1]))
