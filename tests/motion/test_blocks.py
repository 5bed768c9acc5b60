"""Blocks of graphs, against their definition: no single vertex parts what one block holds."""

import torch
from torch import Tensor

from torchsfm.motion.many_views.blocks import blocks
from torchsfm.motion.many_views.components import components


def test_blocks_are_what_no_vertex_parts(generator: torch.Generator) -> None:
    count = 8
    for edges_wanted in range(40):
        edges = torch.randint(count, (edges_wanted // 2, 2), generator=generator)
        edges = edges[edges[:, 0] != edges[:, 1]]
        found = blocks(edges, count)
        together = torch.ones(len(edges), len(edges), dtype=torch.bool)
        for vertex in range(-1, count):
            part = components(edges[(edges != vertex).all(1)], count)
            of_edge: Tensor = part[torch.where(edges[:, 0] == vertex, edges[:, 1], edges[:, 0])]
            together &= of_edge[:, None] == of_edge
        assert torch.equal(found[:, None] == found, together)
    assert len(blocks(torch.zeros(0, 2, dtype=torch.long), 3)) == 0
