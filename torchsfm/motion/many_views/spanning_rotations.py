"""A rotation for every camera of a view graph along a spanning tree of its best edges, and with it the graph's components."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def spanning_rotations(
    R: Float[Tensor, "e 3 3"], edges: Int[Tensor, "e 2"], quality: Float[Tensor, "e"], views: int
) -> tuple[Float[Tensor, "v 3 3"], Int[Tensor, "v"]]:
    """Chain relative rotations along the spanning forest of largest total quality.

    Boruvka's algorithm (1926), in which every camera holds its rotation relative to one camera of its tree: each tree takes its
    best edge to another tree, and the chains of trees that arise are followed by doubling. All trees are worked on at once, so
    a long chain of cameras costs no more rounds than a bush.

    Args:
        R: Rotations from the first to the second camera of each edge.
        edges: The cameras, all finite, none paired with itself.
        quality: How good each edge is; among equals the earlier one is taken.
        views: Number of cameras.

    Returns:
        Rotations, the identity for one camera of each component, and the smallest camera of the component of each.
    """
    device = R.device
    rank = torch.empty(len(edges), dtype=torch.long, device=device)
    rank[torch.argsort(quality, descending=True, stable=True)] = torch.arange(len(edges), device=device)
    found = torch.eye(3, dtype=R.dtype, device=device).repeat(views, 1, 1)
    root = torch.arange(views, device=device)
    own = torch.arange(views, device=device)
    left = torch.arange(len(edges), device=device)
    i, j = edges.unbind(-1)
    while True:
        left = left[root[i[left]] != root[j[left]]]
        if not len(left):
            break
        a, b = root[i[left]], root[j[left]]
        best = torch.full((views,), len(edges), dtype=torch.long, device=device)
        best.scatter_reduce_(0, a, rank[left], "amin").scatter_reduce_(0, b, rank[left], "amin")
        # The tree of b hangs on that of a by an edge if the edge is b's best, and the other way round.
        parent, turn = own.clone(), torch.eye(3, dtype=R.dtype, device=device).repeat(views, 1, 1)
        back, forth = left[best[a] == rank[left]], left[best[b] == rank[left]]
        # R_i = G_i Q_a and R_j = G_j Q_b with R_j = R R_i: Q_a = G_i' R' G_j Q_b.
        turn[root[i[back]]] = found[i[back]].mT @ R[back].mT @ found[j[back]]
        parent[root[i[back]]] = root[j[back]]
        turn[root[j[forth]]] = found[j[forth]].mT @ R[forth] @ found[i[forth]]
        parent[root[j[forth]]] = root[i[forth]]
        # Of two trees that chose the same edge the one with the smaller root stays.
        stays = (parent[parent] == own) & (own <= parent)
        parent = torch.where(stays, own, parent)
        turn[stays] = torch.eye(3, dtype=R.dtype, device=device)
        while not torch.equal(parent, parent[parent]):
            turn = turn @ turn[parent]
            parent = parent[parent]
        found = found @ turn[root]
        root = parent[root]
    least = torch.full((views,), views, dtype=torch.long, device=device).scatter_reduce_(0, root, own, "amin")
    return found, least[root]
