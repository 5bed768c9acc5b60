"""The connected parts of a graph."""

import torch
from jaxtyping import Int
from torch import Tensor


def components(pairs: Int[Tensor, "q 2"], count: int) -> Int[Tensor, "v"]:
    """The smallest index that each vertex of a graph is connected to.

    Every vertex points to one of its part with a smaller index, in the end to the smallest. In each round a part hangs itself
    on the smallest of those it has edges to, and edges inside a part are laid aside.
    """
    label = torch.arange(count, device=pairs.device)
    a, b = pairs.unbind(1)
    while True:
        first, second = label[a], label[b]
        across = (first != second).nonzero()[:, 0]
        if not len(across):
            return label
        a, b, first, second = a[across], b[across], first[across], second[across]
        label = label.scatter_reduce(0, torch.maximum(first, second), torch.minimum(first, second), "amin")
        while not torch.equal(label, further := label[label]):
            label = further


def spanning_forest(edges: Int[Tensor, "e 2"], count: int) -> Int[Tensor, "t"]:
    """The numbers of edges that keep all parts of a graph together, without a loop.

    As in `components`, of each part the first edge by which it hangs itself on another.
    """
    label = torch.arange(count, device=edges.device)
    left = torch.arange(len(edges), device=edges.device)
    found = [left[:0]]
    while True:
        first, second = label[edges[left]].unbind(1)
        across = (first != second).nonzero()[:, 0]
        if not len(across):
            return torch.cat(found)
        left, first, second = left[across], first[across], second[across]
        high, low = torch.maximum(first, second), torch.minimum(first, second)
        hung = label.scatter_reduce(0, high, low, "amin")
        by = hung[high] == low
        chosen = torch.full_like(label, len(edges)).scatter_reduce_(0, high[by], left[by], "amin")
        found.append(chosen[chosen < len(edges)])
        label = hung
        while not torch.equal(label, further := label[label]):
            label = further
