"""Along lines in space: which stretch of each do several views show?"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def places_on_lines(x: Float[Tensor, "k 2 2"], P: Float[Tensor, "k 3 4"], ends: Float[Tensor, "k 2 3"]) -> Float[Tensor, "k 2"]:
    """The stretch of a line that each segment shows, least first: 0 is the line's first end, 1 its second.

    That is where points of the line have the feet of the segment's ends as images.
    """
    h = torch.nn.functional.pad(ends, (0, 1), value=1.0) @ P.mT
    start, step = h[:, 0], h[:, 1] - h[:, 0]
    image = torch.linalg.cross(start, step)
    along = torch.stack((-image[:, 1], image[:, 0]), -1)[:, None]
    value = ((start[:, None, :2] - start[:, None, 2:] * x) * along).sum(-1)
    slope = ((step[:, None, :2] - step[:, None, 2:] * x) * along).sum(-1)
    place = -value / torch.where(slope == 0, 1.0, slope)
    return torch.where(slope == 0, 0.0, place).sort(-1).values


def shared_stretch(
    number: Int[Tensor, "k"], view: Int[Tensor, "k"], span: Float[Tensor, "k 2"], least: int
) -> tuple[Float[Tensor, "l 2"], Bool[Tensor, "l"]]:
    """From the first place on each line that at least so many views show to the last, and whether there is one.

    Args:
        number: Line of each segment; every line has one.
        view: View of each segment.
        span: Stretch of the line that it shows.
        least: Number of views.
    """
    lines = int(number.max()) + 1 if len(number) else 0
    stretch = span.new_zeros(lines, 2)
    if not lines:
        return stretch, torch.zeros(0, dtype=torch.bool)
    # Segments of one view that overlap count once: what a view shows, piece by piece.
    order = span[:, 0].argsort(stable=True)
    order = order[(number * (int(view.max()) + 1) + view)[order].argsort(stable=True)]
    number, view, span = number[order], view[order], span[order]
    other = torch.ones(len(order), dtype=torch.bool)
    other[1:] = (number[1:] != number[:-1]) | (view[1:] != view[:-1])
    reach = _running_maximum(span[:, 1], other.cumsum(0) - 1)
    fresh = other.clone()
    fresh[1:] |= span[1:, 0] > reach[:-1]
    piece, owner = fresh.cumsum(0) - 1, number[fresh]
    last = torch.full((len(owner),), -torch.inf, dtype=span.dtype).scatter_reduce(0, piece, span[:, 1], "amax")
    # Number of views from each start or end of a piece to the next one: starts first.
    place, change = torch.cat((span[fresh, 0], last)), torch.ones(2 * len(owner), dtype=torch.long)
    change[len(owner) :] = -1
    owner = owner.repeat(2)
    order = place.argsort(stable=True)
    order = order[owner[order].argsort(stable=True)]
    place, owner, views = place[order], owner[order], change[order].cumsum(0)
    (enough,) = (views >= least).nonzero(as_tuple=True)
    low = torch.full((lines,), torch.inf, dtype=span.dtype).scatter_reduce(0, owner[enough], place[enough], "amin")
    high = torch.full((lines,), -torch.inf, dtype=span.dtype).scatter_reduce(0, owner[enough], place[enough + 1], "amax")
    there = high > low
    return torch.where(there[:, None], torch.stack((low, high), -1), stretch), there


def _running_maximum(value: Tensor, group: Tensor) -> Tensor:
    """The largest value so far of each group, which are in order."""
    rank = torch.empty_like(group).index_copy(0, value.argsort(stable=True), torch.arange(len(value)))
    # Ranks are exact whatever the values are.
    key = (group * len(value) + rank).cummax(0).values - group * len(value)
    return value.sort(stable=True).values[key]
