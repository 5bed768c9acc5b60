"""One problem over several processes: each has some of the eliminated variables with their residuals, all have the others.

What residuals say of retained variables is a sum over residuals, so a rank adds up its own and an all-reduce does the rest.
What belongs to eliminated variables never leaves their rank before the end.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ParamSpec, Protocol, TypeVar, cast, runtime_checkable

import torch
import torch.distributed
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.optim.terms import Block, Term, block_names, eliminated_block

P = ParamSpec("P")
T = TypeVar("T")
LARGEST_KEY = 2**62
"""Of the numbers that several indices are written as."""


@runtime_checkable
class Group(Protocol):
    """A process group of `torch.distributed`, such as `torch.distributed.group.WORLD`."""

    def rank(self) -> int:
        """The number of this process."""

    def size(self) -> int:
        """The number of processes."""


@dataclass(frozen=True)
class Ranks:
    """The processes that share a problem; one alone communicates nothing.

    Every rank must call the same methods in the same order, with tensors of one shape. All get the same bits.
    """

    group: Group | None = None

    @property
    def size(self) -> int:
        """The number of processes."""
        return 1 if self.group is None else self.group.size()

    @property
    def rank(self) -> int:
        """The number of this process."""
        return 0 if self.group is None else self.group.rank()

    def sum(self, x: Tensor) -> Tensor:
        """The sum over the ranks, in the memory of `x` where that is contiguous."""
        return self._reduced(x, "SUM")

    def largest(self, x: Tensor) -> Tensor:
        """The largest value among the ranks."""
        return self._reduced(x, "MAX")

    def any(self, x: Tensor) -> Tensor:
        """Whether it is so on any rank."""
        return x if self.size == 1 else self.largest(x.to(torch.uint8)).bool()

    def all(self, x: Tensor) -> Tensor:
        """Whether it is so on all ranks."""
        return x if self.size == 1 else ~self.any(~x)

    def gather(self, x: Tensor) -> Tensor:
        """The rows of all ranks, rank by rank; each may have another number of them."""
        return x if self.size == 1 else self._gathered(x, everywhere=True)

    def gather_first(self, x: Tensor) -> Tensor:
        """The same on the first rank; no rows on the others."""
        return x if self.size == 1 else self._gathered(x, everywhere=False)

    def sum_first(self, x: Tensor) -> Tensor:
        """The sum over the ranks on the first one; what the others get says nothing."""
        if self.size > 1:
            x = x.contiguous()
            torch.distributed.reduce(x, self._first, group=cast(Any, self.group))
        return x

    def spread(self, x: Tensor) -> Tensor:
        """What the first rank has, in the memory of `x` where that is contiguous; others give something of the same shape."""
        if self.size > 1:
            x = x.contiguous()
            torch.distributed.broadcast(x, self._first, group=cast(Any, self.group))
        return x

    def once(self, device: torch.device, find: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
        """What `find` gives on the first rank, for all: the others wait, which takes no time of their processors.

        Tensors in it come to a device of each rank. It must not communicate.
        """
        if self.size == 1:
            return find(*arguments, **options)
        # A view would be sent with all that it is a view of.
        found = [tensor_map(lambda x: x.cpu().clone(), find(*arguments, **options)) if self.rank == 0 else None]
        torch.distributed.broadcast_object_list(found, self._first, group=cast(Any, self.group))
        return cast(T, tensor_map(lambda x: x.to(device), found[0]))

    @property
    def _first(self) -> int:
        """What the first rank of the group is called among all processes."""
        return torch.distributed.get_global_rank(cast(Any, self.group), 0)

    def _gathered(self, x: Tensor, *, everywhere: bool) -> Tensor:
        if x.dtype == torch.bool:
            return self._gathered(x.to(torch.uint8), everywhere=everywhere).bool()
        count = torch.zeros(self.size, dtype=torch.int64, device=x.device)
        count[self.rank] = len(x)
        counts = self.sum(count).tolist()
        padded = x.new_zeros((max(counts), *x.shape[1:]))
        padded[: len(x)] = x
        found = [torch.empty_like(padded) for _ in counts] if everywhere or self.rank == 0 else []
        if everywhere:
            torch.distributed.all_gather(found, padded, group=cast(Any, self.group))
        else:
            torch.distributed.gather(padded, found or None, self._first, group=cast(Any, self.group))
        return torch.cat([rows[:number] for rows, number in zip(found, counts, strict=True)]) if found else x[:0]

    def _reduced(self, x: Tensor, how: str) -> Tensor:
        if self.size == 1:
            return x
        x = x.contiguous()
        operation = getattr(torch.distributed.ReduceOp, how)
        torch.distributed.all_reduce(x, operation, group=cast(Any, self.group))
        return x


@dataclass(frozen=True)
class Share:
    """What one rank has of a problem: some of the variables of each eliminated block, and the residuals that meet them."""

    blocks: Mapping[str, Block]
    """All retained variables and its own eliminated ones."""
    terms: Sequence[Term]
    eliminated: tuple[str, ...]
    ranks: Ranks
    order: Sequence[Tensor] = ()
    """The rows of each term, those of the first rank first."""
    places: Mapping[str, Tensor] = field(default_factory=dict)
    """The variables of each eliminated block, those of the first rank first."""

    def whole(self, x: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The variables of all ranks, given those of this one."""
        if self.ranks.size == 1:
            return dict(x)
        whole = {name: self.ranks.gather(x[name]) for name in self.eliminated}
        return {**x, **{name: torch.empty_like(v).index_copy_(0, self.places[name], v) for name, v in whole.items()}}

    def rows(self, values: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """One tensor for each term with a row for each of its residuals, given those of this rank."""
        if self.ranks.size == 1:
            return tuple(values)
        whole = [self.ranks.gather(rows) for rows in values]
        return tuple(torch.empty_like(v).index_copy_(0, order, v) for v, order in zip(whole, self.order, strict=True))


def share(blocks: Mapping[str, Block], terms: Sequence[Term], eliminate: str | Sequence[str] | None, ranks: Ranks) -> Share:
    """Divide a problem that all ranks know, so that each has about as many residuals of each eliminated block, of few retained.

    Residuals of retained variables alone are divided evenly, those of the same variables together.

    Raises:
        ValueError: A residual depends on two eliminated variables.
    """
    names = block_names(eliminate)
    if ranks.size == 1:
        return Share(blocks, terms, names, ranks)
    met = [eliminated_block(term, names) for term in terms]
    owner, places, number, own_blocks = dict[str, Tensor](), dict[str, Tensor](), dict[str, Tensor](), dict(blocks)
    for name in names:
        block = blocks[name]
        places[name] = torch.argsort(_neighbourhood(name, blocks, terms), stable=True)
        at = torch.argsort(places[name])
        found = _owners(block, name, terms, places[name], ranks.size)
        mine = places[name][found == ranks.rank]
        own_blocks[name] = replace(block, x=block.x[mine], fixed=None if block.fixed is None else block.fixed[mine])
        owner[name], number[name] = found[at], at - int((found < ranks.rank).sum())
    own_terms, orders = [], []
    for term, eliminated in zip(terms, met, strict=True):
        if eliminated is None:
            alike = _alike(term)
            where = _evenly(torch.bincount(alike), ranks.size)[alike]
        else:
            where = owner[eliminated][term.index[term.blocks.index(eliminated)]]
        own = term.select((where == ranks.rank).nonzero()[:, 0])
        index = tuple(number[n][i] if n == eliminated else i for n, i in zip(term.blocks, own.index, strict=True))
        own_terms.append(replace(own, index=index))
        orders.append(torch.cat([(where == rank).nonzero()[:, 0] for rank in range(ranks.size)]))
    return Share(own_blocks, own_terms, names, ranks, orders, places)


def _neighbourhood(name: str, blocks: Mapping[str, Block], terms: Sequence[Term]) -> Tensor:
    """Where each variable stands among the retained ones that it meets: the mean of their numbers, in the block of most.

    Neighbours meet the same ones, so where they are on one rank it has to do with fewer of them.
    """
    block = blocks[name]
    with_it = [term for term in terms if name in term.blocks]
    total = torch.zeros(len(block.x), dtype=torch.float64, device=block.x.device)
    others = sorted({other for term in with_it for other in term.blocks} - {name})
    if not others:
        return total
    guide, count = max(others, key=lambda other: len(blocks[other].x)), torch.zeros_like(total)
    for term in with_it:
        index = term.index[term.blocks.index(name)]
        for other, met in zip(term.blocks, term.index, strict=True):
            if other == guide:
                total.index_add_(0, index, met.double())
                count.index_add_(0, index, torch.ones_like(met, dtype=torch.float64))
    return total / count.clamp_min(1)


def _owners(block: Block, name: str, terms: Sequence[Term], order: Tensor, ranks: int) -> Tensor:
    """The rank of each variable in an order of them, which never falls from one to the next."""
    count = torch.zeros(len(block.x), dtype=torch.int64, device=block.x.device)
    for term in terms:
        for other, index in zip(term.blocks, term.index, strict=True):
            if other == name:
                count += torch.bincount(index, minlength=len(count))
    return _evenly(count[order], ranks)


def _evenly(count: Tensor, ranks: int) -> Tensor:
    """The rank of each of several things with so many residuals, one after the other."""
    end = count.cumsum(0)
    return ((2 * end - count) * ranks // (2 * count.sum().clamp_min(1))).clamp_max(ranks - 1)


def _alike(term: Term) -> Tensor:
    """A number for each residual, the same for those of the same variables, in the order of these."""
    index = torch.stack(term.index)
    if len(set(term.blocks)) == 1:
        index = index.sort(0).values
    key, most = torch.zeros_like(index[0]), 1
    for row in index if index.numel() else []:
        count = int(row.max()) + 1
        if most * count > LARGEST_KEY:
            key = torch.unique(key, return_inverse=True)[1]
            most = len(key)
        key, most = key * count + row, most * count
    found: Tensor = torch.unique(key, return_inverse=True)[1]
    return found
