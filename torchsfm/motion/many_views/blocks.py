"""The blocks of a graph: the largest parts that hang together without any one of their vertices."""

import torch
from jaxtyping import Int
from torch import Tensor

from torchsfm.motion.many_views.components import components, spanning_forest


def blocks(edges: Int[Tensor, "e 2"], count: int) -> Int[Tensor, "e"]:
    """The block that each edge of a graph is in, numbered from 0.

    Two edges are in one block where a loop goes through both. Loops of different blocks share a vertex at most, so that
    nothing of what one says follows for the other. An edge in no loop is a block by itself; edges between the same two
    vertices are a loop. Of any spanning forest each edge stands for a block with those that a loop ties to it: an edge left
    over ties the tree edges above its two ends, and one that leads out of what hangs on a vertex the two tree edges there
    (Tarjan & Vishkin, "An efficient parallel biconnectivity algorithm", SIAM J. Computing 1985).
    """
    if not len(edges):
        return edges.new_zeros(0)
    tree = spanning_forest(edges, count)
    parent, first, number = _walk(edges[tree], count)
    last = first + number
    other = torch.ones(len(edges), dtype=torch.bool, device=edges.device).index_fill_(0, tree, False)
    # In the order of the walk, what hangs on a vertex are the next ones after it.
    a, b = first[edges[other]].sort(1).values.unbind(1)
    at = torch.empty_like(first).index_copy_(0, first, torch.arange(count, device=first.device))
    low, high = (torch.arange(count, device=first.device) for _ in range(2))
    low.scatter_reduce_(0, b, a, "amin")
    high.scatter_reduce_(0, a, b, "amax")
    low, high = _least(low, first, last), -_least(-high, first, last)
    own = (parent >= 0).nonzero()[:, 0]
    own = own[parent[parent[own]] >= 0]
    up = parent[own]
    leaves = (low[own] < first[up]) | (high[own] >= last[up])
    across = b >= last[at[a]]
    ties = torch.cat((torch.stack((own, up), 1)[leaves], torch.stack((at[a], at[b]), 1)[across]))
    label = components(ties, count)
    # Of each edge, the end that the walk comes to last: of a tree edge the one that it leads to.
    i, j = edges.unbind(1)
    block: Tensor = torch.unique(label[torch.where(first[i] > first[j], i, j)], return_inverse=True)[1]
    return block


def _walk(tree: Int[Tensor, "t 2"], count: int) -> tuple[Int[Tensor, "v"], Int[Tensor, "v"], Int[Tensor, "v"]]:
    """A walk along a forest, each tree from its smallest vertex.

    Of each vertex the parent (-1 for the first), its place, and how many hang on it, with itself. Each edge is gone both ways,
    and after coming to a vertex by one edge the walk goes on by the next one there. How far each step is from the end of the
    walk is found by doubling.
    """
    device = tree.device
    root = components(tree, count)
    own = torch.arange(count, device=device)
    tail, head = torch.cat((tree, tree.flip(1))).unbind(1)
    m = len(tail)
    order = torch.argsort(tail, stable=True)
    begin = torch.searchsorted(tail[order], own)
    place = torch.empty_like(order).index_copy_(0, order, torch.arange(m, device=device))
    # After a step comes the one behind its reverse, around its vertex; the end of a walk is one place more.
    after = place.roll(-m // 2) + 1
    degree = torch.bincount(tail, minlength=count)
    wraps = after == (begin + degree)[head]
    after = torch.where(wraps, begin[head], after)
    following = torch.full((m + 1,), m, device=device)
    following[:m] = torch.where(wraps & (root[head] == head), m, order[after])
    left = (torch.arange(m + 1, device=device) < m).long()
    while bool((following < m).any()):
        left = left + left[following]
        following = following[following]
    left = left[:m]
    back = left.roll(m // 2)
    forth = left > back
    parent = torch.full_like(own, -1).index_copy_(0, head[forth], tail[forth])
    size = torch.bincount(root, minlength=count)
    number = size.index_copy(0, head[forth], (left - back)[forth] // 2 + 1)
    # Trees one after the other; in each as many vertices come before one as there were steps forth, and its first.
    trees = (root == own).long().cumsum(0)
    walked = torch.argsort(2 * (size.cumsum(0)[root[head]] - 1) - left)
    before = torch.empty_like(left).index_copy_(0, walked, forth[walked].long().cumsum(0))
    place = (size.cumsum(0) - size)[root]
    return parent, place.index_copy(0, head[forth], before[forth] + trees[root[head[forth]]] - 1), number


def _least(x: Int[Tensor, "v"], first: Int[Tensor, "v"], last: Int[Tensor, "v"]) -> Int[Tensor, "v"]:
    """The least of the values from one place to before another, from those of twice as many places at a time."""
    found = torch.full_like(x, torch.iinfo(x.dtype).max)
    number, size = last - first, 1
    while size <= len(found):
        some = ((number >= size) & (number < 2 * size)).nonzero()[:, 0]
        found[some] = torch.minimum(x[first[some]], x[last[some] - size])
        x = torch.minimum(x[:-size], x[size:])
        size *= 2
    return found
