"""The blocks of a graph: the largest parts that hang together without any one of their vertices."""

import torch
from jaxtyping import Int
from torch import Tensor


def blocks(edges: Int[Tensor, "e 2"], count: int) -> Int[Tensor, "e"]:
    """The block that each edge of a graph is in, numbered from 0.

    Two edges are in one block where a loop goes through both. Loops of different blocks share a vertex at most, so that
    nothing of what one says follows for the other. An edge in no loop is a block by itself; edges between the same two
    vertices are a loop (Hopcroft & Tarjan, "Algorithm 447: efficient algorithms for graph manipulation", CACM 1973).
    """
    ends = edges.tolist()
    around: list[list[int]] = [[] for _ in range(count)]
    for k, (a, b) in enumerate(ends):
        around[a].append(k)
        around[b].append(k)
    label, number = [-1] * len(ends), 0
    depth, low, place = [-1] * count, [0] * count, [0] * count
    passed: list[int] = []
    for root in range(count):
        if depth[root] >= 0:
            continue
        depth[root] = low[root] = 0
        path = [(root, -1)]
        while path:
            v, entered = path[-1]
            if place[v] < len(around[v]):
                k = around[v][place[v]]
                place[v] += 1
                a, b = ends[k]
                w = a + b - v
                if k == entered or depth[w] > depth[v]:
                    continue
                passed.append(k)
                if depth[w] < 0:
                    depth[w] = low[w] = depth[v] + 1
                    path.append((w, k))
                else:
                    low[v] = min(low[v], depth[w])
                continue
            path.pop()
            if not path:
                continue
            up = path[-1][0]
            low[up] = min(low[up], low[v])
            if low[v] >= depth[up]:
                while label[entered] < 0:
                    label[passed.pop()] = number
                number += 1
    return torch.tensor(label, dtype=torch.long, device=edges.device)
