"""Places on smooth curves as numbers: the sample before and the share of the way to the next.

Beyond its open ends a curve goes on straight, so that a point that moves along a curve moves smoothly past its end.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry.curves import Curve, Segments, segments_of

_LONGEST = 1 / 40
"""Of a curve, by which a place moves at most in one step to a nearer one."""


@dataclass(frozen=True)
class CurvePlaces:
    """Smooth curves whose points are told by places; see `curve_places`."""

    segments: Segments
    number: Int[Tensor, "*batch"]
    """How many segments a curve has; places of a closed one repeat after so many."""
    closed: Bool[Tensor, "*batch"]

    def at(self, place: Float[Tensor, "*batch m"]) -> tuple[Tensor, Tensor, Tensor]:
        """The points at places, and the first and second derivatives by the place."""
        number = self.number[..., None]
        last = (number - 1).clamp(min=0)
        index = place.floor().long()
        around = index % number.clamp(min=1)
        inside = torch.minimum(index.clamp(min=0), last)
        before = torch.where(self.closed[..., None], index, inside)
        share = place - before
        on = share.clamp(0, 1)
        x, first, second = self.segments.take(torch.where(self.closed[..., None], around, inside)).at(on)
        beyond = (share - on)[..., None]
        return x + beyond * first, first, torch.where(beyond == 0, second, 0)

    def beyond(self, place: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """How far, in segments, a place is beyond an open end; 0 for others."""
        over = torch.maximum(-place, place - self.number[..., None])
        return torch.where(self.closed[..., None], 0, over.clamp(min=0))

    def nearest(self, place: Float[Tensor, "*batch m"], y: Float[Tensor, "*batch m d"], steps: int = 4) -> Tensor:
        """The places of the points nearest to `y` that are reached from given places without leaving the curve."""
        longest = _LONGEST * self.number[..., None].to(place.dtype)
        for _ in range(steps):
            x, first, second = self.at(place)
            away, speed = x - y, first.square().sum(-1)
            bent = torch.maximum(speed + (away * second).sum(-1), 0.3 * speed)
            move = (away * first).sum(-1) / bent.clamp_min(1e-300)
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


def curve_places(curve: Curve) -> CurvePlaces:
    """Make smooth curves' points ready to be told by places."""
    segments = segments_of(curve)
    return CurvePlaces(segments, segments.there.sum(-1), ~segments.open)
