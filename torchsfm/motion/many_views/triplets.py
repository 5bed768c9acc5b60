"""Which relative rotations close with others to the identity around triangles of a view graph."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

AT_ONCE = 1 << 20
"""Paths of two edges looked at together: bounds memory, changes nothing."""
LOW, WIDTH = 0.05, 3.0
"""Triangles of right edges close within `WIDTH` times what the best of all, this fraction, close within."""
LEAST = 1e-6
"""Radians that right triangles are granted at least, for edges without noise."""


@dataclass(frozen=True)
class Triplets:
    """Triangles of a view graph, t of them.

    Attributes:
        edges: The three edges of each.
        angle: How far their rotations are from closing to the identity, in radians.
    """

    edges: Int[Tensor, "t 3"]
    angle: Float[Tensor, "t"]

    def votes(self, count: int) -> Float[Tensor, "e"]:
        """How many triangles speak for each of all edges: each by how well it closes, next to how well good ones close."""
        votes = self.angle.new_zeros(count)
        if not len(self.angle):
            return votes
        best = self.angle.kthvalue(1 + int(LOW * (len(self.angle) - 1))).values
        vote = torch.exp(-(self.angle / (WIDTH * best + LEAST)))
        return votes.index_add_(0, self.edges.flatten(), vote.repeat_interleave(3))


def find_triplets(R: Float[Tensor, "e 3 3"], edges: Int[Tensor, "e 2"], views: int) -> Triplets:
    """All triangles of a view graph, each once.

    Edges are directed from cameras with fewer edges to those with more, so that no camera has many that leave it: the work
    grows with the number of edges to the power 1.5 at worst. Of edges between the same two cameras the first counts.

    Args:
        R: Rotations from the first to the second camera of each edge.
        edges: The cameras, none paired with itself.
        views: Number of cameras.

    Returns:
        The triangles and how well they close.
    """
    low, high = edges.amin(1), edges.amax(1)
    key, order = torch.sort(low * views + high, stable=True)
    first = torch.ones_like(key, dtype=torch.bool)
    first[1:] = key[1:] != key[:-1]
    key, order = key[first], order[first]
    degree = torch.bincount(edges[order].flatten(), minlength=views)
    i, j = edges[order].unbind(-1)
    swap = (degree[i] > degree[j]) | ((degree[i] == degree[j]) & (i > j))
    tail, head = torch.where(swap, j, i), torch.where(swap, i, j)
    by_tail = torch.argsort(tail, stable=True)
    found, angles = [order.new_zeros((0, 3))], [R.new_zeros(0)]
    for a, b in pairs_within(tail[by_tail]):
        a, b = by_tail[a], by_tail[b]
        ends = torch.stack((head[a], head[b]), 1)
        wanted = ends.amin(1) * views + ends.amax(1)
        c = torch.searchsorted(key, wanted).clamp(max=max(len(key) - 1, 0))
        closed = key[c] == wanted
        a, b, c = a[closed], b[closed], c[closed]
        # From the tail over a to its head, over c to the head of b, and back over b.
        turns = [_along(R, edges, order[e], start) for e, start in ((a, tail[a]), (c, head[a]), (b, head[b]))]
        found.append(order[torch.stack((a, c, b), 1)])
        angles.append(turn_angle(turns[2] @ turns[1] @ turns[0]))
    return Triplets(torch.cat(found), torch.cat(angles))


def turn_angle(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The angle of rotations in radians, accurate for small ones."""
    sine = torch.stack((R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), -1)
    return torch.atan2(torch.linalg.vector_norm(sine, dim=-1), R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


def pairs_within(group: Int[Tensor, "n"]) -> Iterator[tuple[Int[Tensor, "k"], Int[Tensor, "k"]]]:
    """The places of all pairs of equal numbers among sorted ones, each once, some at a time."""
    place = torch.arange(len(group), device=group.device)
    first = torch.searchsorted(group, group)
    # Each goes with those before it.
    partners = place - first
    total = partners.cumsum(0)
    start = 0
    while start < len(group):
        done = int(total[start - 1]) if start else 0
        end = max(int(torch.searchsorted(total, done + AT_ONCE)), start + 1)
        count = partners[start:end]
        a = place[start:end].repeat_interleave(count)
        step = torch.arange(len(a), device=a.device) - (count.cumsum(0) - count).repeat_interleave(count)
        if len(a):
            yield a, first[a] + step
        start = end


def _along(R: Tensor, edges: Tensor, edge: Tensor, start: Tensor) -> Tensor:
    """The rotation of each edge walked from one of its cameras."""
    return torch.where((edges[edge, 0] == start)[:, None, None], R[edge], R[edge].mT)
