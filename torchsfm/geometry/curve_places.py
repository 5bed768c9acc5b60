"""Places on smooth curves as numbers: the sample before and the share of the way to the next.

Beyond its open ends a curve goes on straight, so that a point that moves along a curve moves smoothly past its end.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry.curves import Cubics, Curve, Segments, segments_of
from torchsfm.linalg.rows import combine_rows

_LONGEST = 1 / 40
"""Of a curve, by which a place moves at most in one step to a nearer one."""

_ACROSS = 5
"""Samples that tell the slope at the middle one where they are exact."""


@dataclass(frozen=True)
class CurvePlaces:
    """Smooth curves whose points are told by places; see `curve_places`."""

    segments: Segments
    cubics: Cubics
    number: Int[Tensor, "*batch"]
    """How many segments a curve has; places of a closed one repeat after so many."""
    closed: Bool[Tensor, "*batch"]

    def at(self, place: Float[Tensor, "*batch m"]) -> tuple[Tensor, Tensor, Tensor]:
        """The points at places, and the first and second derivatives by the place."""
        x, first, second = self.rows(place)
        return x.mT, first.mT, second.mT

    def rows(self, place: Float[Tensor, "*batch m"]) -> tuple[Tensor, Tensor, Tensor]:
        """As `at`, coordinates before places: arithmetic over few coordinates in the last dimension is slow."""
        number, index = self.number[..., None], place.floor()
        before = index.long()
        around = before % number.clamp(min=1)
        if bool(self.closed.all()):
            return self.cubics.take(around).rows(place - index)
        ring = self.closed[..., None]
        inside = torch.minimum(before.clamp(min=0), (number - 1).clamp(min=0))
        share = place - torch.where(ring, before, inside)
        on = share.clamp(0, 1)
        x, first, second = self.cubics.take(torch.where(ring, around, inside)).rows(on)
        beyond = (share - on)[..., None, :]
        return x + beyond * first, first, torch.where(beyond == 0, second, 0)

    def beyond(self, place: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """How far, in segments, a place is beyond an open end; 0 for others."""
        over = torch.maximum(-place, place - self.number[..., None])
        return torch.where(self.closed[..., None], 0, over.clamp(min=0))

    def nearest(self, place: Float[Tensor, "*batch m"], y: Float[Tensor, "*batch m d"], steps: int = 4) -> Tensor:
        """The places of the points nearest to `y` that are reached from given places without leaving the curve."""
        longest = _LONGEST * self.number[..., None].to(place.dtype)
        y = y.mT.contiguous()
        for _ in range(steps):
            x, *slopes = self.rows(place)
            away = (x - y).unbind(-2)
            first, second = (slope.unbind(-2) for slope in slopes)
            speed = combine_rows(first, first)
            bent = torch.maximum(speed + combine_rows(away, second), 0.3 * speed)
            move = combine_rows(away, first) / bent.clamp_min(1e-300)
            place = place - torch.minimum(torch.maximum(move, -longest), longest)
        return place

    def spread(self, m: int, start: Float[Tensor, "*batch"] | None = None) -> Float[Tensor, "*batch m"]:
        """Places equally far apart along the polygon, inside the ends of an open curve.

        Those of a closed one begin at its first sample, or at a share of its length from there.
        """
        end = self.segments.length.cumsum(-1)
        share = torch.arange(m, dtype=end.dtype, device=end.device) + torch.where(self.closed, 0.0, 0.5)[..., None]
        share = share / m if start is None else share / m + start[..., None]
        turns = torch.where(self.closed[..., None], share.floor(), 0)
        way = (end[..., -1:] * (share - turns)).contiguous()
        index = torch.searchsorted(end.contiguous(), way, right=True)
        index = torch.minimum(index, (self.number[..., None] - 1).clamp(min=0))
        length = self.segments.length.gather(-1, index)
        on = (way - end.gather(-1, index) + length) / torch.where(length > 0, length, 1)
        return index + on + turns * self.number[..., None]

    def through_exact_samples(self) -> "CurvePlaces":
        """The same places on cubics whose slopes are those of polynomials through five samples, by chord length.

        They leave a smooth curve by the fourth power of the spacing, and enlarge noise by a third more. Curves of fewer than
        five samples stay as they are.
        """
        s, number = self.segments, self.number[..., None]
        n = s.start.shape[-2]
        ring = self.closed[..., None]
        last = torch.where(ring, number - 1, number)
        slot = torch.arange(n, device=number.device).expand_as(s.length)
        first = torch.where(ring, slot - _ACROSS // 2, torch.minimum(slot - _ACROSS // 2, last + 1 - _ACROSS).clamp(min=0))
        index = first[..., None] + torch.arange(_ACROSS, device=number.device)
        own = (slot - first).clamp(max=_ACROSS - 1)[..., None]  # beyond the last sample there is nothing to find
        turns = torch.where(ring[..., None], index.div(number.clamp(min=1)[..., None], rounding_mode="floor"), 0)
        index = (index - turns * number[..., None]).clamp(0, n - 1).flatten(-2)
        far = s.length.cumsum(-1)
        way = (far - s.length).gather(-1, index).view(*slot.shape, _ACROSS) + turns * far[..., -1:, None]
        x = s.start.gather(-2, index[..., None].expand(*index.shape, s.start.shape[-1]))
        x = x.view(*slot.shape, _ACROSS, s.start.shape[-1])
        gap = way - way.gather(-1, own)
        slope = torch.zeros_like(s.slope)
        for j in range(_ACROSS):
            # The derivative of Lagrange's polynomial that is 1 at sample j and 0 at the others, at the own one.
            others = torch.arange(_ACROSS, device=gap.device) != j
            part = torch.where(others & (gap != 0), -gap / (gap[..., j : j + 1] - gap), 1).prod(-1)
            part = torch.where(gap[..., j] != 0, part / gap[..., j], 0)
            slope = slope + part[..., None] * (x[..., j, :] - s.start)
        enough = (number >= _ACROSS) & (slot <= last)
        slope = torch.where(enough[..., None] & torch.isfinite(slope), slope, s.slope)
        after = torch.where(ring, (slot + 1) % number.clamp(min=1), (slot + 1).clamp(max=n - 1))
        ahead = slope.gather(-2, after[..., None].expand_as(slope))
        ahead = torch.where((enough & s.there)[..., None], ahead, s.next_slope)
        segments = s._replace(slope=slope, next_slope=ahead)
        return replace(self, segments=segments, cubics=segments.cubics())


def curve_places(curve: Curve) -> CurvePlaces:
    """Make smooth curves' points ready to be told by places."""
    segments = segments_of(curve)
    return CurvePlaces(segments, segments.cubics(), segments.there.sum(-1), ~segments.open)
