"""Problems of different size, sorted by size and packed without gaps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.models import cast
from torchsfm.robust.sampling import compact, prosac_growth

SMALLEST_WIDTH = 8


@dataclass(frozen=True)
class Problems:
    """Problems with between `width / 2` and `width` data each, all tensors with the problem first.

    Attributes:
        estimator: What to solve; its tensor fields, if any, are per problem.
        data: `(p, width, d)` each, in memory with the coordinate before the datum, so that one coordinate is contiguous.
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
        """Some of the problems."""
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
    usable: Bool[Tensor, "p n"],
    chosen: Bool[Tensor, "p"],
    limit: Float[Tensor, "p"],
    trust: Float[Tensor, "p n"] | None,
    weights: Float[Tensor, "p n"] | None,
) -> Iterator[Problems]:
    """Sort the chosen problems by their number of usable data: one group for each power of two."""
    count = usable.sum(-1)
    width = SMALLEST_WIDTH * torch.ones_like(count)
    while bool((wider := width < count).any()):
        width = torch.where(wider, 2 * width, width)
    for size in sorted(set(width[chosen].tolist())):
        member = (chosen & (width == size)).nonzero()[:, 0]
        source = compact(usable[member], count[member], size)
        inside = torch.arange(size, device=count.device) < count[member, None]
        ranking = growth = weight = None
        if weights is not None:
            weight = torch.where(inside, weights[member].gather(1, source), 0)
        if trust is not None:
            sorted_by = torch.where(inside, trust[member].gather(1, source), -torch.inf)
            ranking = sorted_by.argsort(dim=-1, descending=True, stable=True)
            growth = prosac_growth(count[member], size, estimator.sample_size)
        packed = tuple(d[member].mT.gather(2, source[:, None].expand(-1, d.shape[-1], -1)).mT for d in data)
        own = _at(estimator, member)
        yield Problems(own, packed, inside, count[member], limit[member], ranking, growth, weight, source, member)


def _at(estimator: Estimator[Any], member: Tensor) -> Estimator[Any]:
    return tensor_map(lambda t: t[member], estimator)
