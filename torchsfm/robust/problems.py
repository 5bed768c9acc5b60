"""The problems of a call: in one batch dimension, sorted by size and packed without gaps, and back in the caller's order."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.robust.estimator import Estimator, check_estimator
from torchsfm.robust.models import cast, take
from torchsfm.robust.sampling import compact, prosac_growth, spread_order

T = TypeVar("T")

SMALLEST_WIDTH = 8
_EMPTY = 1 << 13
"""How many empty slots take less time than a group of problems of its own."""
_SHOWS = 16
"""Of problems this small rounding may show, as much is left open: it is not to depend on others."""


@dataclass(frozen=True)
class Flat:
    """All problems of a call in one batch dimension, in the caller's order.

    Attributes:
        batch: The caller's batch dimensions.
        estimator: What to solve; its tensor fields are per problem.
        data: `(p, n, d)` each.
        bound: Thresholds.
        exists: Which data exist; None for all.
        of_data: What else the caller knows of each datum, `(p, n)`, by name.
    """

    batch: tuple[int, ...]
    estimator: Any
    data: tuple[Float[Tensor, "p n _"], ...]
    bound: Float[Tensor, "p"]
    exists: Bool[Tensor, "p n"] | None
    of_data: dict[str, Float[Tensor, "p n"]]

    @classmethod
    def of(
        cls,
        estimator: Any,
        data: Sequence[Tensor],
        threshold: Any,
        mask: Tensor | None,
        *,
        unknown_threshold: float | None = None,
        **of_data: Tensor | None,
    ) -> "Flat":
        """Check what a call consists of, and bring it into one batch dimension.

        Args:
            estimator: The problem.
            data: The data.
            threshold: A number or one for each problem.
            mask: Which data exist.
            unknown_threshold: What stands for a threshold that is None; if not given it may not be.
            **of_data: Numbers `(*batch, n)` for the data, under the names the caller knows them by, or None.

        Raises:
            ValueError: A shape, dtype or device does not fit, or the estimator is none.
        """
        if not data:
            raise ValueError("data: wanted at least one tensor of shape (*batch, n, d), got none")
        check_estimator(estimator)
        limit = threshold if isinstance(threshold, Tensor) else None
        if limit is None:
            check_options(threshold=(threshold, "float > 0" if unknown_threshold is None else "?float > 0"))
        known = {f"data[{i}]": (d, f"n d{i}") for i, d in enumerate(data)}
        more = {name: (t, "?n") for name, t in of_data.items()}
        batch = check_tensors(**known, threshold=(limit, "?"), mask=(mask, "?n: bool"), **more)
        if limit is None:
            limit = data[0].new_tensor(unknown_threshold if threshold is None else threshold)

        def flat(t: Tensor, own: int) -> Tensor:
            """With all batch dimensions in one; the last `own` dimensions are its own."""
            trailing = t.shape[t.ndim - own :]
            if t.shape != batch + trailing:
                t = t.expand(batch + trailing)
            return t if len(batch) == 1 else t.reshape(batch.numel(), *trailing)

        return cls(
            batch,
            tensor_map(lambda t: flat(t, t.ndim - len(batch)), estimator),
            tuple(flat(d, 2) for d in data),
            flat(limit.detach(), 0),
            None if mask is None else flat(mask, 1),
            {name: flat(t, 1) for name, t in of_data.items() if t is not None},
        )

    @property
    def shape(self) -> tuple[int, int]:
        """The number of problems, and of data in each."""
        p, n = self.data[0].shape[:2]
        return p, n

    def usable(self) -> Bool[Tensor, "p n"] | None:
        """Which data exist and are finite; None for all."""
        usable = self.exists
        for d in self.data:
            # A sum is finite only if all numbers are.
            if not math.isfinite(float(d.detach().sum())):
                row = torch.isfinite(d).all(-1)
                usable = row if usable is None else usable & row
        return usable

    def refused(self) -> Int[Tensor, "p"]:
        """What becomes of problems with too few usable data: `TOO_FEW` or `NOT_FINITE`."""
        p, n = self.shape
        count = torch.full((p,), n, device=self.bound.device) if self.exists is None else self.exists.sum(-1)
        few = count < self.estimator.sample_size
        return torch.where(few, int(Status.TOO_FEW), int(Status.NOT_FINITE)).to(torch.int8)

    def no_models(self, *slots: int) -> Any:
        """Zeros in the form of models, for each problem so many."""
        none = tensor_map(lambda t: t[:0], self.estimator)
        samples = [d.new_zeros(0, self.estimator.sample_size, d.shape[-1]) for d in self.data]
        return tensor_map(lambda t: t.new_zeros(self.shape[0], *slots, *t.shape[2:]), none.minimal(*samples).model)

    def unflatten(self, tree: T, dtype: torch.dtype | None = None) -> T:
        """Bring what belongs to the problems back into the caller's batch dimensions, and into a dtype if given."""
        return tensor_map(lambda t: t.to(dtype or t.dtype).reshape(self.batch + t.shape[1:]), tree)


@dataclass(frozen=True)
class Problems:
    """Problems with up to `width` data each, most of them with half as many, all tensors with the problem first.

    What becomes of a problem does not depend on the width, but for rounding.

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

    @property
    def counts(self) -> Tensor:
        """What the data count: their weights, or which slots hold data."""
        return self.inside if self.weight is None else self.weight

    def take(self, index: Tensor) -> "Problems":
        """Some of the problems, in their order."""
        return take(self, index, len(self.count))

    def narrowed(self, width: int) -> "Problems":
        """With so many slots, enough for all data of each; without what only a search knows."""
        data, inside, source = tuple(d[:, :width] for d in self.data), self.inside[:, :width], self.source[:, :width]
        return replace(self, data=data, inside=inside, source=source, weight=None, ranking=None, growth=None)

    def spread(self) -> "Problems":
        """With a dimension of size 1 after the problem in estimator and data, to meet several models per problem."""
        data = tuple(d[:, None] for d in self.data)
        return replace(self, estimator=tensor_map(lambda t: t[:, None], self.estimator), data=data)

    def cast(self, dtype: torch.dtype) -> "Problems":
        """With estimator, data and thresholds of another type."""
        return cast(self, dtype)

    def scatter(self, values: Tensor, n: int, fill: int = 0) -> Tensor:
        """Bring properties of the slots, `(..., p, width)`, back into the caller's order, `(..., p, n)`."""
        out = torch.full((*values.shape[:-1], n + 1), fill, dtype=values.dtype, device=values.device)
        return out.scatter_(-1, torch.where(self.inside, self.source, n).expand_as(values), values)[..., :n]


def pack(
    flat: Flat,
    usable: Bool[Tensor, "p n"] | None,
    chosen: Bool[Tensor, "p"],
    quality: Float[Tensor, "p n"] | None = None,
    weights: Float[Tensor, "p n"] | None = None,
) -> Iterator[Problems]:
    """Sort the chosen problems by their number of usable data: one group for each power of two, or for several if they are few.

    Args:
        flat: All problems.
        usable: Which data to use; all of them if not given.
        chosen: Which problems to pack.
        quality: How much each datum can be trusted.
        weights: What each datum counts.
    """
    p, n = flat.shape
    device = flat.bound.device
    if usable is None:
        order = spread_order(n, _width(n), device)
        count, groups = torch.full((p,), n, device=device), [(len(order), chosen)]
    else:
        count = usable.sum(-1)
        widths = torch.tensor([SMALLEST_WIDTH << i for i in range(_width(n).bit_length())], device=device)
        width = widths[torch.searchsorted(widths, count)]
        groups, least = [], 0
        for size in _sizes(width[chosen].tolist()):
            groups.append((size, chosen & (width > least) & (width <= size)))
            least = size
    for size, group in groups:
        member = group.nonzero()[:, 0]
        if not len(member):
            continue
        every = len(member) == p
        own = partial(_rows, index=None if every else member)
        inside = torch.arange(size, device=device) < (n if usable is None else own(count)[:, None])
        if usable is None:
            source, inside = order.expand(len(member), -1), inside.expand(len(member), -1)
        else:
            source = compact(own(usable), own(count), size)
        place = (source + member[:, None] * n).flatten()
        rows = [d.permute(2, 0, 1).flatten(1).index_select(1, place) for d in flat.data]
        packed = tuple(r.view(-1, *source.shape).permute(1, 2, 0) for r in rows)
        ranking = growth = weight = None
        if weights is not None:
            weight = torch.where(inside, own(weights).gather(1, source), 0)
        if quality is not None:
            sorted_by = torch.where(inside, own(quality).gather(1, source), -torch.inf)
            ranking = sorted_by.argsort(dim=-1, descending=True, stable=True)
            growth = prosac_growth(own(count), size, flat.estimator.sample_size)
        fields = tensor_map(own, flat.estimator)
        limit = own(flat.bound) * own(flat.bound)
        yield Problems(fields, packed, inside, own(count), limit, ranking, growth, weight, source, member)


def _sizes(widths: list[int]) -> list[int]:
    """To which widths to bring problems so that empty slots cost less than one more group of them does."""
    kept: list[int] = []
    empty = 0
    for size in sorted(set(widths), reverse=True):
        # Brought to the next larger one.
        empty += widths.count(size) * (kept[-1] - size) if kept else 0
        if not kept or empty > _EMPTY or size <= _SHOWS:
            kept.append(size)
            empty = 0
    return kept[::-1]


def _width(number: int) -> int:
    """The number of slots for so many data."""
    return max(SMALLEST_WIDTH, 1 << (number - 1).bit_length())


def _rows(t: Tensor, index: Tensor | None) -> Tensor:
    return t if index is None else t[index]
