"""What loops of relative rotations say: how many there are, and whether unrelated rotations might close as many as well.

Along a tree any relative rotations agree with some rotations of the cameras; each edge more closes a loop, and only loops
contradict or confirm.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.motion.many_views.components import components

CHANCE, WIDER = 0.03, 1.5
"""How often unrelated rotations might pass for related ones, if loops lacked so many times more than they do."""
REACHES = tuple(1e-3 * 2**k for k in range(10))
"""Angles in radians within which edges may agree."""


def count_loops(edges: Int[Tensor, "e 2"], component: Int[Tensor, "v"]) -> int:
    """How many loops edges close, all others following from them, of cameras in components named by their smallest."""
    first = component == torch.arange(len(component), device=component.device)
    return len(edges) - len(component) + int(first.sum())


def close_by_chance(angle: Float[Tensor, "e"], edges: Int[Tensor, "e 2"], views: int) -> Bool[Tensor, "v"]:
    """Cameras of connected parts with loops where unrelated rotations may close as many as well.

    A wrong edge closes a loop within an angle with the share of rotations that turn by less; of all edges any may be chosen to
    agree, and within any angle. A part without loops contradicts nothing.

    Args:
        angle: By how much each edge disagrees with the rotations that were found, in radians.
        edges: The cameras of each.
        views: How many cameras there are.
    """
    part = components(edges, views)
    ones, of_edge = angle.new_ones(views), part[edges[:, 0]]

    def of_part(values: Tensor, place: Tensor = of_edge) -> Tensor:
        return torch.zeros_like(ones).index_add_(0, place, values)

    every, size = of_part(torch.ones_like(angle)), of_part(ones, part)
    related = every < size
    for reach in REACHES:
        agree = angle <= reach
        inner = components(edges[agree], views)
        pieces = of_part((inner == torch.arange(views, device=inner.device)).to(angle.dtype), part)
        number = of_part(agree.to(angle.dtype))
        closed = number - size + pieces
        # What a loop lacks is shared by its edges, whatever others have.
        lack = (WIDER * of_part(agree * angle) / closed.clamp(min=1)).clamp(reach, torch.pi)
        share = (lack - lack.sin()) / torch.pi
        ways = torch.lgamma(every + 1) - torch.lgamma(number + 1) - torch.lgamma(every - number + 1)
        related = related | (-closed * share.log() > ways - math.log(CHANCE))
    return ~related[part]
