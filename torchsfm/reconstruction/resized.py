"""Photographs that were upright and lying, and were all resized to one square, as they are for networks.

The upright ones are stretched along x and the lying ones along y, which no ratio of focal lengths explains that all have in
common. The pairs tell which is which before anything is placed: their fundamental matrices are essential ones only with the
right ratio at both ends, as they are of one camera with the right focal length alone (`focal_from_fundamentals`).
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.autocalibration.focal_from_fundamentals import WIDE
from torchsfm.reconstruction.mappers.zoomed import disagreement, pair_asymmetry
from torchsfm.reconstruction.mapping.cameras import telling_pairs
from torchsfm.reconstruction.matching.view_graph import ViewGraph

RATIOS = 4 / 3, 3 / 2, 16 / 9
"""Shapes that photographs have."""
TRIED = 48
"""Focal lengths that are tried with each."""
SHARE = 0.85
"""What a plane explains of a pair at most that is asked: models decide where pairs are not sure."""
MOST = 2000
"""Pairs by which ratio and focal length are chosen, the strongest; all are asked with these."""
ASKED = 3.0
"""Logarithm of how many times likelier two shapes must be to be asked for."""
SWEEPS = 4
"""How often each image is asked again what it is, once all others have said."""


class Shapes(NamedTuple):
    """What square images were before.

    Attributes:
        aspect: How many times as much as along x each image is stretched along y: 1 where it is not square; of a square image
            that no pair tells of, as if it had been lying.
        clear: Whether the pairs say so by more than chance and the choice explain.
    """

    aspect: Float[Tensor, "v"]
    clear: bool


def shapes_of_squares(graph: ViewGraph) -> Shapes | None:
    """What the pairs say that square images were; None where as well all had one shape.

    Args:
        graph: Verified pairs.
    """
    size = graph.image_size
    square = (size == size.mode(0).values).all(1) & (size[:, 0] == size[:, 1])
    telling = (telling_pairs(graph, SHARE) & square[graph.pairs].all(1)).nonzero()[:, 0]
    if not len(telling):
        return None
    weight = graph.fundamental_inliers[telling]
    order = weight.argsort(descending=True, stable=True)
    weight, pairs, F = weight[order], graph.pairs[telling[order]], graph.F[telling[order]].double()
    side = float(size[pairs[0, 0], 0])
    focal = side * torch.linspace(math.log(WIDE[0]), math.log(WIDE[1]), TRIED, dtype=F.dtype).exp()
    images, ends = torch.unique(pairs[:MOST], return_inverse=True)
    cost = torch.cat([_costs(F[:MOST], side, ratio, focal) for ratio in RATIOS])
    both = torch.arange(2)
    # All were lying, or all upright, or none is stretched.
    unstretched = _costs(F[:MOST], side, 1.0, focal)[:, :, 0, 0]
    uniform = min(float(cost[:, :, both, both].sum(1).min()), float(unstretched.sum(1).min()))
    label, total = _told_apart(cost, ends, weight[:MOST])
    best = int(total.argmin())
    gain = uniform - float(total[best])
    if gain < ASKED or label[best].min() == label[best].max():
        return None
    # So much is gained by one answer of two for each image and by what is tried.
    clear = gain > len(images) * math.log(2) + math.log(len(cost))
    trial = best % len(cost)
    lying, kind = RATIOS[trial // TRIED], label[best]
    if len(F) > MOST:
        images, ends = torch.unique(pairs, return_inverse=True)
        label, total = _told_apart(_costs(F, side, lying, focal[[trial % TRIED]]), ends, weight)
        kind = label[total.argmin()]
    aspect = torch.where(square, lying, 1.0).double()
    return Shapes(aspect.index_copy(0, images, torch.where(kind == 0, lying, 1 / lying).double()), clear)


def _costs(F: Float[Tensor, "p 3 3"], side: float, ratio: float, focal: Float[Tensor, "t"]) -> Float[Tensor, "t p 2 2"]:
    """How badly pairs fit where their images were lying (0) or upright (1), with one ratio and every focal length.

    The side that was longer is shortened by that much more.
    """
    focal, kinds = focal[:, None], []
    for f, aspect in ((focal, ratio), (focal * ratio, 1 / ratio)):
        K = torch.diag_embed(torch.cat((f, f * aspect, torch.ones_like(f)), -1))
        K[:, :2, 2] = (side - 1) / 2
        kinds.append(K[:, None])
    of_first = [torch.stack([disagreement(pair_asymmetry(F, first, second)) for second in kinds], -1) for first in kinds]
    return torch.stack(of_first, -2)


def _told_apart(
    cost: Float[Tensor, "t p 2 2"], ends: Int[Tensor, "p 2"], weight: Int[Tensor, "p"]
) -> tuple[Int[Tensor, "s n"], Float[Tensor, "s"]]:
    """For each trial, begun by either kind, what every image is so that its pairs fit best, and how badly they fit.

    Along the strongest pairs, each image becomes what fits those before it; then each again what fits all others.
    """
    n = int(ends.max()) + 1
    order = _by_strength(ends, weight, n)
    begin, end = torch.cat((ends, ends.flip(1))).unbind(1)
    # Costs by what the image is that a pair begins at, either way.
    directed = torch.cat((cost, cost.mT), 1).repeat(2, 1, 1, 1)
    rows = [(begin == k).nonzero()[:, 0] for k in range(n)]
    label = torch.zeros(len(directed), n, dtype=torch.long)
    label[len(cost) :, order[0]] = 1
    known: Bool[Tensor, "n"] = torch.arange(n) == order[0]
    for k in order[1:] + SWEEPS * order:
        own, other = directed[:, rows[k]], end[rows[k]]
        beside = label[:, other, None, None].expand(-1, -1, 2, 1)
        label[:, k] = (own.gather(3, beside)[..., 0] * known[other, None]).sum(1).argmin(1)
        known[k] = True
    kind = torch.stack((label[:, ends[:, 0]], label[:, ends[:, 1]]), -1)
    pair = torch.arange(len(ends))
    trial = torch.arange(len(label))[:, None]
    return label, directed[trial, pair, kind[..., 0], kind[..., 1]].sum(1)


def _by_strength(ends: Int[Tensor, "p 2"], weight: Int[Tensor, "p"], n: int) -> list[int]:
    """Images in the order in which those before hold them best."""
    strength = torch.zeros(n, n, dtype=weight.dtype).index_put((ends[:, 0], ends[:, 1]), weight, accumulate=True)
    strength = strength + strength.T
    order = [int(strength.sum(0).argmax())]
    while len(order) < n:
        held = strength[order].sum(0)
        held[order] = -1
        order.append(int(held.argmax()))
    return order
