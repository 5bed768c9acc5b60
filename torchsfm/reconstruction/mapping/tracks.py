"""From matches between pairs to tracks through many images."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm.motion.many_views.components import components

FIRST = 4
"""Of the matches in dispute the first quarter is joined at once, as far as it contradicts nothing."""


def build_tracks(
    view: Int[Tensor, "n"], match: Int[Tensor, "k 2"], priority: Int[Tensor, "k"] | None = None
) -> Int[Tensor, "n"]:
    """Join matching image points into tracks that pass through each image at most once.

    Matches are taken in order of priority (Kruskal's algorithm on the graph of matches); one that would put two points of the
    same image into one track contradicts better ones and is left out.

    Args:
        view: Image of each image point.
        match: Pairs of matching image points.
        priority: Matches with a larger value are taken first; among equals the earlier one.

    Returns:
        Track of each image point, numbered by first point, or -1 where a point matches nothing.
    """
    # Where no image is met twice all matches hold. Elsewhere they are taken one after the other.
    root, clash = _joined(view, match)
    disputed = clash[root[match[:, 0]]].nonzero()[:, 0]
    if len(disputed):
        if priority is not None:
            disputed = disputed[torch.argsort(priority[disputed], descending=True, stable=True)]
        root = torch.where(clash[root], _by_priority(view, match[disputed]), root)
    size = torch.bincount(root, minlength=len(view))
    first = torch.full((len(view),), len(view), dtype=torch.long)
    first = first.scatter_reduce(0, root, torch.arange(len(view)), "amin")
    _, track = torch.unique(torch.where(size[root] > 1, first[root], -1), return_inverse=True)
    unmatched = bool((size[root] == 1).any())
    numbered: Tensor = track - int(unmatched)
    return numbered


def _joined(view: Int[Tensor, "n"], match: Int[Tensor, "k 2"]) -> tuple[Int[Tensor, "n"], Bool[Tensor, "n"]]:
    """A point of its track for each point if all matches hold, and at these points whether the track meets an image twice."""
    n, images = len(view), int(view.max()) + 1 if len(view) else 1
    root = components(match, n)
    met = torch.unique(root * images + view).div(images, rounding_mode="floor")
    return root, torch.bincount(root, minlength=n) > torch.bincount(met, minlength=n)


def _by_priority(view: Int[Tensor, "n"], match: Int[Tensor, "k 2"]) -> Int[Tensor, "n"]:
    """A point of its track for each point, of matches in order of priority."""
    own = torch.arange(len(view))
    # What the first of them join without contradiction stays joined, and most of the others then join what is one already.
    known, clash = _joined(view, match[: len(match) // FIRST])
    known = torch.where(clash[known], own, known)
    parent = list(range(len(view)))
    # The images a track passes through, as the bits of one integer: disjointness is one operation at any number of images.
    bits = [1 << v for v in range(int(view.max()) + 1)]
    images = [bits[v] for v in view.tolist()]
    member = (known != own).nonzero()[:, 0]
    for a, v in zip(known[member].tolist(), view[member].tolist(), strict=True):
        images[a] |= bits[v]
    ends = known[match]
    # Two lists of numbers take a tenth of the time that a list of pairs does.
    for a, b in zip(*ends[ends[:, 0] != ends[:, 1]].mT.tolist(), strict=True):
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a != b and not images[a] & images[b]:
            parent[b] = a
            images[a] |= images[b]
    root = torch.tensor(parent, dtype=torch.long)
    while not torch.equal(root, further := root[root]):
        root = further
    return root[known]
