"""Which pairs of images share what no other images do: the relations that like things in several places do not imitate.

What occurs twice is matched across its copies, often better than across the photographs of one copy. Three signs tell such
matches. They are found in many images, where what stands around a copy is found in its neighbours alone. Followed from image to
image, they come back to one of the images elsewhere. And a chain of the most distinctive relations that reaches all images has
few chances to be wrong, where the best of all relations of one image has many (Roberts, Sinha, Szeliski & Steedly, Structure
from motion for scenes with large duplicate structures, 2011).
"""

from collections import deque
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.matching.view_graph import ViewGraph


@dataclass(frozen=True)
class Distinctiveness:
    """The matches of each pair of images, each counted by how much it tells the pair from others.

    A match counts as one over the number of images in which its image points are matched, the geometric mean of both, and not
    at all where matches connect its points with two in one image.

    Attributes:
        weight: What the matches count together.
        variance: By chance, as matches come and go: the sum of the squares of what they count.
    """

    weight: Float[Tensor, "q"]
    variance: Float[Tensor, "q"]

    @classmethod
    def of(cls, graph: ViewGraph) -> "Distinctiveness":
        """That of the pairs of a view graph."""
        n, v = len(graph.x), len(graph.names)
        a, b = graph.match.unbind(1)
        degree = torch.bincount(graph.match.flatten(), minlength=n).double()
        component = components(graph.match, n)
        images = torch.unique(component * v + graph.view) // v
        once = torch.bincount(component, minlength=n) == torch.bincount(images, minlength=n)
        one = once[component[a]] / (degree[a] * degree[b]).sqrt()
        total = degree.new_zeros(2, len(graph.pairs)).index_add_(1, graph.match_pair, torch.stack([one, one * one]))
        return cls(total[0], total[1])


@dataclass(frozen=True)
class Backbone:
    """The most distinctive relations without a loop: one way from each image to every other that is connected with it.

    Attributes:
        pairs: Pairs of images, those of the view graph.
        chosen: Pairs that belong to it.
    """

    pairs: Int[Tensor, "q 2"]
    chosen: Bool[Tensor, "q"]

    @classmethod
    def of(cls, pairs: Int[Tensor, "q 2"], weight: Float[Tensor, "q"], views: int) -> "Backbone":
        """The spanning forest of largest weights (Kruskal); pairs of weight zero are never in it."""
        parent = list(range(views))
        chosen = torch.zeros(len(pairs), dtype=torch.bool)
        for q in torch.argsort(weight, descending=True, stable=True)[: int((weight > 0).sum())].tolist():
            a, b = pairs[q].tolist()
            while parent[a] != a:
                a = parent[a]
            while parent[b] != b:
                b = parent[b]
            if a != b:
                parent[b] = a
                chosen[q] = True
        return cls(pairs, chosen)

    def way(self, first: int, second: int) -> list[int]:
        """The pairs that lead from one image to another; none where they are not connected."""
        arrived: dict[int, tuple[int, int]] = {first: (-1, -1)}
        queue = deque([first])
        own = self.chosen.nonzero()[:, 0].tolist()
        ends = [(q, *self.pairs[q].tolist()) for q in own]
        while queue and second not in arrived:
            here = queue.popleft()
            for q, a, b in ends:
                if here in (a, b) and (there := a + b - here) not in arrived:
                    arrived[there] = here, q
                    queue.append(there)
        way: list[int] = []
        while second in arrived and arrived[second][0] >= 0:
            second, q = arrived[second]
            way.append(q)
        return way

    def sides(self, pair: int, views: int) -> tuple[Bool[Tensor, "v"], Bool[Tensor, "v"]]:
        """The images that hang on the first and on the second image of a pair of the backbone."""
        rest = self.chosen.clone()
        rest[pair] = False
        group = components(self.pairs[rest], views)
        first, second = self.pairs[pair]
        return group == group[first], group == group[second]

    def smaller_side(self, pair: int, among: Bool[Tensor, "v"]) -> Bool[Tensor, "v"]:
        """The images, among some, that a pair of the backbone connects with more others."""
        return min((side & among for side in self.sides(pair, len(among))), key=lambda side: int(side.sum()))
