"""The connected parts of a graph."""

import torch
from jaxtyping import Int
from torch import Tensor


def components(pairs: Int[Tensor, "q 2"], count: int) -> Int[Tensor, "v"]:
    """The smallest index that each vertex of a graph is connected to."""
    label = torch.arange(count, device=pairs.device)
    while True:
        least = label[pairs].amin(1)
        new = label.scatter_reduce(0, pairs.mT.flatten(), least.repeat(2), "amin")
        new = new[new]
        if torch.equal(new, label):
            return label
        label = new
