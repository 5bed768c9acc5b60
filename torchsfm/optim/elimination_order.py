"""In which order a sparse symmetric system is eliminated, so that little fills in, and which variables are eliminated together.

The variable with the fewest partners goes first, and its partners become partners of each other (minimum degree: Rose 1972;
George & Liu, "The evolution of the minimum degree ordering algorithm", 1989). Of equals the one that was met last: so a chain
is rolled up from its ends, a ring from where it is opened, and what is eliminated one after the other has about the same
partners. Such variables join to fronts, dense matrices, while a few zeros cost less than one front more (Ashcraft & Grimes,
"The influence of relaxed supernode partitions on the multifrontal method", 1989). Sets are integers, a bit for a member.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

FLOP = 1.0 / 12e9
"""Seconds for a multiplication with an addition in a dense product, on a usual core."""
ENTRY = 4e-9
"""Seconds to add an entry of one front into another."""
MEET = 2e-6
"""Seconds to look after one partner of one variable while the order is found."""
VISIT = 2e-4
"""Seconds that a front costs, whatever its size."""


@dataclass
class Front:
    """Variables eliminated together."""

    pivots: list[int]
    """In their order."""
    border: int
    """The later variables that these have to do with, as bits."""
    children: list[int]
    """Fronts that add to this one, by their place among all."""
    width: int
    """Columns of the pivots,"""
    beyond: int
    """and of the border."""

    @property
    def seconds(self) -> float:
        """About what its elimination takes."""
        return _seconds(self.width, self.beyond)


def _seconds(p: int, b: int) -> float:
    return FLOP * (p * p * p / 3 + p * p * b + p * b * b) + ENTRY * (b * b + p * p + p * b) + VISIT


@lru_cache(maxsize=2)
def order_elimination(
    partners: tuple[int, ...], widths: tuple[int, ...], limit: float, last: int = 0
) -> tuple[Front, ...] | None:
    """The fronts, children before what they add to; None if their elimination takes longer than a limit.

    The last answers are kept: several adjustments of the same cameras and points follow each other.

    Args:
        partners: Of each variable, as bits; not itself.
        widths: Its number of columns.
        limit: In seconds.
        last: Variables that are the pivots of the last front, as bits.
    """
    found = _least_partners(partners, widths, limit, last)
    return None if found is None else tuple(_join(*found, widths, last))


def _least_partners(
    partners: Sequence[int], widths: Sequence[int], limit: float, last: int
) -> tuple[list[int], list[int], list[int]] | None:
    """The variables in their order, which later ones each has to do with, and the columns of these."""
    left = list(partners)
    columns = [sum(widths[j] for j in members(mask)) for mask in left]
    met = [0] * len(left)
    heap = [(columns[i], 0, i) for i in range(len(left)) if not last >> i & 1]
    heapq.heapify(heap)
    order, border, beyond = list[int](), list[int](), list[int]()
    gone, work, flops = 0, 0, float(sum(widths[i] for i in members(last))) ** 3 / 3
    while heap:
        degree, clock, i = heapq.heappop(heap)
        if gone >> i & 1 or degree != columns[i] or -clock != met[i]:
            continue
        own = left[i]
        gone |= 1 << i
        order.append(i)
        border.append(own)
        beyond.append(degree)
        flops += widths[i] * degree * degree
        # All of the border have to do with each other from now on. And finding an order must not take longer than using it.
        if (flops + degree**3 / 3) * FLOP > limit or work * MEET > limit:
            return None
        for j in members(own):
            before = left[j]
            after = (before | own) & ~(1 << i | 1 << j)
            work += 1
            if fill := after & ~before:
                columns[j] += sum(widths[k] for k in members(fill))
                work += fill.bit_count()
            columns[j] -= widths[i]
            left[j], met[j] = after, len(order)
            if last >> j & 1:
                continue
            heapq.heappush(heap, (columns[j], -met[j], j))
    return order, border, beyond


def _join(order: list[int], border: list[int], beyond: list[int], widths: Sequence[int], last: int) -> list[Front]:
    """The fronts, given what each variable has to do with."""
    rank = {i: len(order) for i in members(last)} | {i: k for k, i in enumerate(order)}
    found = list[Front]()
    waiting: list[list[int]] = [[] for _ in range(len(order) + 1)]
    roots = list[int]()
    for i, mask, wide in zip(order, border, beyond, strict=True):
        here = Front([i], mask, [], widths[i], wide)
        # The child of the most columns first: most often the border of the one is all of the other.
        for number in sorted(waiting[rank[i]], key=lambda f: -found[f].width):
            child = found[number]
            together, width = _seconds(child.width + here.width, here.beyond), child.width + here.width
            # What comes later will share the cost of a new front, so it must be less for each column, too.
            if together <= min(child.seconds + here.seconds, child.seconds * width / child.width):
                here.pivots = child.pivots + here.pivots
                here.width += child.width
                here.children += child.children
            else:
                here.children.append(number)
        (waiting[min(rank[j] for j in members(mask))] if mask else roots).append(len(found))
        found.append(here)
    if last:
        own = list(members(last))
        roots.append(len(found))
        found.append(Front(own, 0, waiting[-1], sum(widths[i] for i in own), 0))
    return _in_order(found, roots)


def _in_order(found: list[Front], roots: list[int]) -> list[Front]:
    """Those that were not joined, children first."""
    order, stack = list[int](), list(roots)
    while stack:
        order.append(stack.pop())
        stack += found[order[-1]].children
    place = {number: k for k, number in enumerate(reversed(order))}
    for number in order:
        found[number].children = [place[child] for child in found[number].children]
    return [found[number] for number in reversed(order)]


def members(mask: int) -> Iterator[int]:
    """The bits that are set."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low
