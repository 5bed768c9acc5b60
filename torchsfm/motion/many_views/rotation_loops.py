"""What loops of relative rotations say: how many there are, and whether unrelated rotations might close as many as well.

Along a tree any relative rotations agree with some rotations of the cameras; each edge more closes a loop, and only loops
contradict or confirm.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.motion.many_views.blocks import blocks
from torchsfm.motion.many_views.components import components

CHANCE, WIDER = 0.03, 1.5
"""How often unrelated rotations might pass for related ones, if loops lacked so many times more than they do."""
REACHES = tuple(1e-3 * 2**k for k in range(10))
"""Angles in radians within which edges may agree."""


def count_loops(edges: Int[Tensor, "e 2"], component: Int[Tensor, "v"]) -> int:
    """How many loops edges close, all others following from them, of cameras in components named by their smallest."""
    first = component == torch.arange(len(component), device=component.device)
    return len(edges) - len(component) + int(first.sum())


def vouched_parts(angle: Float[Tensor, "e"], edges: Int[Tensor, "e 2"], views: int) -> Int[Tensor, "v"]:
    """The smallest camera that each hangs together with by edges which loops confirm, or which are in no loop at all.

    Loops confirm those edges only that are in one block with them, however many there are elsewhere. A wrong edge closes a
    loop within an angle with the share of rotations that turn by less; of all edges at a block's cameras any may be chosen to
    agree, and within any angle.

    Args:
        angle: By how much each edge disagrees with the rotations that were found, in radians.
        edges: The cameras of each.
        views: How many cameras there are.
    """
    block = blocks(edges, views)
    vouched = (torch.bincount(block) == 1)[block]
    everything, part = components(edges, views), components(edges[vouched], views)
    for reach in REACHES:
        if torch.equal(part, everything):
            break
        agree = angle <= reach
        if not bool((agree & ~vouched).any()):
            continue
        inner = blocks(edges[agree], views)
        vouched[agree] |= _confirmed(inner, angle[agree], edges[agree], edges[~agree], views, reach)[inner]
        part = components(edges[vouched], views)
    return part


def _confirmed(block: Tensor, angle: Tensor, edges: Tensor, others: Tensor, views: int, reach: float) -> Bool[Tensor, "b"]:
    """Blocks that unrelated rotations would hardly close, of edges that agree and others at their cameras that do not."""
    number = torch.bincount(block).to(angle.dtype)
    member = torch.unique(torch.cat((block * views + edges[:, 0], block * views + edges[:, 1])))
    of_member, camera = member // views, member % views
    closed = number - torch.bincount(of_member) + 1
    # Edges that do not agree, once for each block that one of their ends is in.
    first, last = (torch.searchsorted(camera.sort().values, torch.arange(views, device=camera.device), side=side)
                   for side in ("left", "right"))  # fmt: skip
    order = camera.argsort(stable=True)
    touched = []
    for end in others.unbind(1):
        times = (last - first)[end]
        edge = torch.arange(len(end), device=end.device).repeat_interleave(times)
        before = times.cumsum(0) - times
        place = first[end].repeat_interleave(times) + torch.arange(len(edge), device=end.device)
        touched.append(of_member[order[place - before.repeat_interleave(times)]] * len(others) + edge)
    contrary = torch.bincount(torch.unique(torch.cat(touched)) // max(len(others), 1), minlength=len(number))
    # What a loop lacks is shared by its edges, whatever others have.
    lack = torch.zeros_like(number).index_add_(0, block, angle)
    lack = (WIDER * lack / closed.clamp(min=1)).clamp(reach, torch.pi)
    share = (lack - lack.sin()) / torch.pi
    ways = torch.lgamma(number + contrary + 1) - torch.lgamma(number + 1) - torch.lgamma(contrary + 1.0)
    return -closed * share.log() > ways - math.log(CHANCE)
