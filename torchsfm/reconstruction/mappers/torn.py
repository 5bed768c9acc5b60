"""Where a model is torn: the camera comes back to one place, which stands in two.

Rotations that drift do not let the centres of a long loop close. Under a robust loss it is then cheapest to tear the loop at
one place and to leave all the rest as it is. What is seen from both sides of the tear becomes two points of each track, or a
point from which one side is too far off to count, and nothing pulls them together any more. But all pairs of images across the
tear contradict the model, and their matches say which points are one. Like things at two places give such pairs, too: joined,
they must make more matches agree than they did apart.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import rotvec_from_rotation
from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.evidence.consistency import PairAgreement
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import point_uncertainty
from torchsfm.reconstruction.model.similarities import robust_similarity

SHARED = 8
"""Points of a pair of images that must say the same of how the two sides stand to each other."""
TURN, SIZE = math.radians(15), 1.5
"""By how much the sides may be turned against each other, and differ in size: drift is small, and no fold is to be made."""


def join_torn(model: Mapping, agreement: PairAgreement) -> Mapping | None:
    """The model with points as one that are two, by the matches of pairs of images which contradict it.

    Args:
        model: A model with the points of all tracks of the pairs that agree with it.
        agreement: How all pairs agree with it.

    Returns:
        The model, its cameras where they were, to be adjusted under a wide loss; None where no such pair has enough points that
        are one already, or that one similarity makes one, or where all that they show are one already and seen by both sides.
    """
    graph = model.graph
    contradicts = torch.zeros(len(graph.pairs), dtype=torch.bool)
    contradicts[agreement.index[agreement.contradicts]] = True
    match = contradicts[graph.match_pair].nonzero()[:, 0]
    node = graph.match[match]
    # Of a track that is whole, one side has the point, and the other is too far off for it.
    point, track = model.point[node], model.track[node]
    whole = (track[:, :1] >= 0) & (track[:, :1] == track[:, 1:])
    point = torch.where(whole & (point < 0), point.flip(1), point)
    match, node, point = (t[(point >= 0).all(1)] for t in (match, node, point))
    if not len(match):
        return None
    order = torch.argsort(graph.match_pair[match], stable=True)
    node, point = node[order], point[order]
    counts = torch.unique_consecutive(graph.match_pair[match[order]], return_counts=True)[1]
    known = point_uncertainty(model)
    one = [_one(model, some, known) for some in torch.split(point, counts.tolist())]
    if not bool(torch.cat(one).any()):
        return None
    node, point = node[torch.cat(one)], point[torch.cat(one)]
    # Which side comes first is not the same in all pairs, and three points may be one.
    group = components(point, len(model.X))
    new = model.point.index_copy(0, node.flatten(), point.flatten())
    new = torch.where(new >= 0, group[new.clamp(min=0)], -1)
    return replace(model, point=new).compacted() if int((new != model.point).sum()) >= SHARED else None


def _one(model: Mapping, points: Int[Tensor, "k 2"], known: Float[Tensor, "p"]) -> Bool[Tensor, "k"]:
    """Which pairs of points are one: enough are, or one similarity that is near the identity brings enough together."""
    same = points[:, 0] == points[:, 1]
    if int(same.sum()) >= SHARED or len(points) < SHARED:
        return same & (len(points) >= SHARED)
    (P, Q), (a, b) = model.X[points].unbind(1), known[points].unbind(1)
    similarity, used = robust_similarity(P, Q, sigma=a + b)
    turn, size = float(rotvec_from_rotation(similarity.R).norm()), float(similarity.scale)
    sure = bool(similarity.status == Status.OK) and int(used.sum()) >= SHARED
    return used & (sure and turn < TURN and 1 / SIZE < size < SIZE)
