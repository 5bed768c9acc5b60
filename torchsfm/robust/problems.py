"""Problems of different size, sorted by size and packed without gaps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import cast
from torchsfm.robust.sampling import compact, prosac_growth, spread_order

SMALLEST_WIDTH = 8


@dataclass(frozen=True)
class Problems:
    """Problems with between `width / 2` and `width` data each, all tensors with the problem first.

    Attributes:
        estimator: What to solve; its tensor fields, if any, are per problem.
        data: `(p, width, d)` each, in memory with the coordinate first, so that one coordinate of all is contiguous.
        inside: Which slots hold data; they come first.
        count: Number of data.
        limit: Squared threshold.
        ranking: Slots of the data from the most to the least trusted one, where the caller knows.
        growth: How many samples to draw from the first m, m + 1, ... of these (PROSAC).
        weight: What the data count, 0 in slots without; None if all count alike.
        source: Where in the caller's arrays the data of each slot are.
        member: Which problem of the caller each one is.
    """

    estimator: Estimator[Any]
    data: tuple[Float[Tensor, "p *models width _"], ...]
    inside: Bool[Tensor, "p width"]
    count: Int[Tensor, "p"]
    limit: Float[Tensor, "p"]
    ranking: Int[Tensor, "p width"] | None
    growth: Int[Tensor, "p _"] | None
    weight: Float[Tensor, "p width"] | None
    source: Int[Tensor, "p width"]
    member: Int[Tensor, "p"]

    @property
    def width(self) -> int:
        """The number of slots for data."""
        return self.inside.shape[-1]

    def take(self, index: Tensor) -> "Problems":
        """Some of the problems, in their order."""
        if len(index) == len(self.count):
            return self
        return tensor_map(lambda t: t[index], self)

    def spread(self) -> "Problems":
        """With a dimension of size 1 after the problem in estimator and data, to meet several models per problem."""
        data = tuple(d[:, None] for d in self.data)
        return replace(self, estimator=tensor_map(lambda t: t[:, None], self.estimator), data=data)

    def cast(self, dtype: torch.dtype) -> "Problems":
        """With estimator, data and thresholds of another type."""
        return cast(self, dtype)

    def scatter(self, flag: Bool[Tensor, "p width"], n: int) -> Bool[Tensor, "p n"]:
        """Bring a property of the slots back into the caller's order."""
        out = torch.zeros(len(flag), n + 1, dtype=torch.bool, device=flag.device)
        return out.scatter_(1, torch.where(self.inside, self.source, n), flag)[:, :n]


def pack(
    estimator: Estimator[Any],
    data: Sequence[Float[Tensor, "p n _"]],
    usable: Bool[Tensor, "p n"] | None,
    chosen: Bool[Tensor, "p"],
    limit: Float[Tensor, "p"],
    trust: Float[Tensor, "p n"] | None,
    weights: Float[Tensor, "p n"] | None,
) -> Iterator[Problems]:
    """Sort the chosen problems by their number of usable data: one group for each power of two.

    Args:
        estimator: The problem, its tensor fields per problem.
        data: The data.
        usable: Which data to use; all of them if not given.
        chosen: Which problems to pack.
        limit: Squared thresholds.
        trust: How much each datum can be trusted.
        weights: What each datum counts.
    """
    p, n = data[0].shape[:2]
    if usable is None:
        order = spread_order(n, _width(n), limit.device)
        count, groups = torch.full((p,), n, device=limit.device), [(len(order), chosen)]
    else:
        count = usable.sum(-1)
        widths = torch.tensor([SMALLEST_WIDTH << i for i in range(_width(n).bit_length())], device=limit.device)
        width = widths[torch.searchsorted(widths, count)]
        groups = [(size, chosen & (width == size)) for size in sorted(set(width[chosen].tolist()))]
    for size, group in groups:
        member = group.nonzero()[:, 0]
        if not len(member):
            continue
        every = len(member) == p
        own = partial(_rows, index=None if every else member)
        inside = torch.arange(size, device=count.device) < (n if usable is None else own(count)[:, None])
        if usable is None:
            source, inside = order.expand(len(member), -1), inside.expand(len(member), -1)
        else:
            source = compact(own(usable), own(count), size)
        place = (source + member[:, None] * n).flatten()
        rows = [d.permute(2, 0, 1).flatten(1).index_select(1, place) for d in data]
        packed = tuple(r.view(-1, *source.shape).permute(1, 2, 0) for r in rows)
        ranking = growth = weight = None
        if weights is not None:
            weight = torch.where(inside, own(weights).gather(1, source), 0)
        if trust is not None:
            sorted_by = torch.where(inside, own(trust).gather(1, source), -torch.inf)
            ranking = sorted_by.argsort(dim=-1, descending=True, stable=True)
            growth = prosac_growth(own(count), size, estimator.sample_size)
        fields = tensor_map(own, estimator)
        yield Problems(fields, packed, inside, own(count), own(limit), ranking, growth, weight, source, member)


def _width(number: int) -> int:
    """The number of slots for so many data."""
    return max(SMALLEST_WIDTH, 1 << (number - 1).bit_length())


def _rows(t: Tensor, index: Tensor | None) -> Tensor:
    return t if index is None else t[index]
