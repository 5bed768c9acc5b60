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

from torchsfm._types import check_options, check_tensors


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
        x, _, _ = s.cubics().take(index).at(t.clamp(0, 1))
        there = ((total > 0) & torch.isfinite(x).all(-1).all(-1, keepdim=True)).expand(x.shape[:-1])
        return Curve(torch.where(there[..., None], x, 0), there, self.closed)


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

    def cubics(self) -> "Cubics":
        """The smooth curve along each of them."""
        h = self.length[..., None]
        a, b = h * self.slope, h * self.next_slope
        # p = start + a t + c t^2 + e t^3 with the chord and b at its end.
        c, e = 3 * self.chord - 2 * a - b, a + b - 2 * self.chord
        return Cubics(torch.cat((self.start, a, c, e), -1).mT.contiguous())


class Cubics(NamedTuple):
    """Points by their share of the way along segments; the segments last, as arithmetic over few coordinates there is slow."""

    coefficients: Float[Tensor, "*batch 4*d n"]
    """Of powers of the share from 0 to 3."""

    def take(self, index: Int[Tensor, "*batch m"]) -> "Cubics":
        """Some of them."""
        rows = self.coefficients
        return Cubics(rows.gather(-1, index[..., None, :].expand(*rows.shape[:-1], index.shape[-1])))

    def at(self, t: Float[Tensor, "*batch n"]) -> tuple[Tensor, Tensor, Tensor]:
        """The point at a share of each, and the first and second derivative by the share."""
        x, first, second = self.rows(t)
        return x.mT, first.mT, second.mT

    def rows(self, t: Float[Tensor, "*batch n"]) -> tuple[Tensor, Tensor, Tensor]:
        """As `at`, coordinates before segments."""
        start, a, c, e = self.coefficients.chunk(4, -2)
        t = t[..., None, :]
        te, c2 = t * e, 2 * c
        return start + t * (a + t * (c + te)), a + t * (c2 + 3 * te), c2 + 6 * te


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


def _packed(x: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """The samples that there are in the first slots, in order, zeros behind."""
    order = there.to(torch.int8).argsort(dim=-1, descending=True, stable=True)
    there = there.gather(-1, order)
    return torch.where(there[..., None], _rows(x, order), 0), there


def _rows(x: Shaped[Tensor, "*batch n d"], index: Int[Tensor, "*batch m"]) -> Shaped[Tensor, "*batch m d"]:
    return x.gather(-2, index[..., None].expand(*index.shape, x.shape[-1]))
