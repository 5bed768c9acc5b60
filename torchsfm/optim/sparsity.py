"""Which retained variables the reduced system brings together: those of one residual, and of two of one eliminated variable."""

import torch
from torch import Tensor

from torchsfm.optim.elimination_order import members
from torchsfm.optim.layout import Layout
from torchsfm.optim.schur_pairwise import pairs_of_points


def find_met(layout: Layout) -> Tensor:
    """Each pair of variables brought together on any rank, once, as numbers `i * count + j`; the first rank has them."""
    owner = layout.owners()
    count = int(owner[-1])
    # The first column of each variable stands for it.
    head = torch.ones_like(owner, dtype=torch.bool)
    head[1:] = owner[1:] != owner[:-1]
    keys = [owner[:0]]
    for piece in layout.pieces:
        keys.append(_met(variables := _variables(piece.columns, owner, head, count), variables, count))
    for family in layout.families:
        coupled = [piece for piece in family.pieces if piece.coupled and piece.point is not None]
        if not coupled:
            continue
        found = [_variables(piece.columns, owner, head, count) for piece in coupled]
        wide = max(v.shape[1] for v in found)
        of_slot = torch.cat([torch.nn.functional.pad(v, (0, wide - v.shape[1]), value=count) for v in found])
        starts = [0]
        for v in found:
            starts.append(starts[-1] + len(v))
        slots = torch.cat([piece.slots + start for piece, start in zip(coupled, starts, strict=False)])
        points = torch.cat([piece.point for piece in coupled if piece.point is not None])
        both = torch.unique(pairs_of_points(points, slots, len(of_slot))[2]).long()
        first, second = torch.div(both, len(of_slot), rounding_mode="floor"), both % len(of_slot)
        keys.append(_met(of_slot[first], of_slot[second], count))
    met: Tensor = torch.unique(layout.ranks.gather_first(torch.unique(torch.cat(keys))))
    return met


def partners(layout: Layout, met: Tensor, last: Tensor | None = None) -> tuple[list[int], list[Tensor], int]:
    """The partners of each variable as bits, its columns, and which have some last columns; like variables are one.

    These are such as have the same partners besides each other, and both some of the last columns, or neither.
    """
    owner = layout.owners()
    count = int(owner[-1])
    masks = [0] * count
    for i, j in zip(torch.div(met, count, rounding_mode="floor").tolist(), (met % count).tolist(), strict=True):
        masks[i] |= 1 << j
        masks[j] |= 1 << i
    return _merged(masks, owner[: layout.size], set() if last is None else set(owner[last].tolist()))


def _variables(columns: Tensor, owner: Tensor, head: Tensor, count: int) -> Tensor:
    """The variables of each slot, (slots, k), `count` for none."""
    heads = head[columns] & (owner[columns] < count)
    used = heads.any(0)
    return torch.where(heads, owner[columns], count)[:, used]


def _met(a: Tensor, b: Tensor, count: int) -> Tensor:
    """Each pair of a variable of a with one of b, of the same row, once: as numbers."""
    a, b = a[:, :, None], b[:, None]
    key: Tensor = torch.unique((torch.minimum(a, b) * count + torch.maximum(a, b))[(a < count) & (b < count) & (a != b)])
    return key


def _merged(masks: list[int], owner: Tensor, last: set[int]) -> tuple[list[int], list[Tensor], int]:
    """Variables that have the same partners besides each other, as one."""
    number, of_variable = dict[tuple[int, bool], int](), list[int]()
    for i, mask in enumerate(masks):
        of_variable.append(number.setdefault((mask | 1 << i, i in last), len(number)))
    kept = dict[int, int]()
    for i, k in enumerate(of_variable):
        kept.setdefault(k, i)
    alone = 0
    for i in kept.values():
        alone |= 1 << i
    found = []
    renumber = {i: k for k, i in kept.items()}
    for i in kept.values():
        found.append(sum(1 << renumber[j] for j in members(masks[i] & alone)))
    variable = torch.tensor(of_variable, device=owner.device)[owner]
    order = torch.argsort(variable, stable=True)
    columns = list(torch.split(order, torch.bincount(variable, minlength=len(number)).tolist()))
    return found, columns, sum(1 << k for k in {of_variable[i] for i in last})


def depth(partners: list[int]) -> int:
    """How many partners it takes from one end of the longest part to the other, but for those that most have."""
    near = (1 << len(partners)) - 1
    for i, mask in enumerate(partners):
        if 2 * mask.bit_count() > len(partners):
            near &= ~(1 << i)
    most, left = 0, near
    while left:
        start = left & -left
        # From anywhere to the farthest one, and from there.
        for _ in range(2):
            seen, front, steps, end = start, start, 0, start
            while front:
                end, steps, after = front, steps + 1, 0
                for i in members(front):
                    after |= partners[i]
                front = after & near & ~seen
                seen |= front
            start = end & -end
        most, left = max(most, steps - 1), left & ~seen
    return most
