"""Which images of a model hang together: groups between which more matches contradict the model than agree with it.

Each image of a group that stands in a wrong place as a whole has pairs within the group that agree. Only the pairs across tell,
and only all together: groups that most matches across join are joined, those with the most first, until none are left (greedy
additive edge contraction; Keuper et al., "Efficient decomposition of image and mesh graphs by lifted multicuts", ICCV 2015).
"""

from heapq import heapify, heappop, heappush

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm.motion.many_views.blocks import blocks
from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.evidence.consistency import PairAgreement
from torchsfm.reconstruction.mapping.mapping import Mapping

FIRM = 20
"""Points that three images or more see hold the third to the other two: by so many an image is registered."""


def agreeing_groups(agreement: PairAgreement, views: int) -> Int[Tensor, "v"]:
    """A number for each image, equal within groups."""
    votes = torch.where(agreement.supports, agreement.matches, 0) - torch.where(agreement.contradicts, agreement.matches, 0)
    across: list[dict[int, int]] = [{} for _ in range(views)]
    for (i, j), vote in zip(agreement.pairs.tolist(), votes.tolist(), strict=True):
        across[i][j] = across[j][i] = vote
    group = torch.arange(views)
    waiting = [(-vote, i, j) for i, row in enumerate(across) for j, vote in row.items() if vote > 0 and i < j]
    heapify(waiting)
    while waiting:
        vote, i, j = heappop(waiting)
        if across[i].get(j) != -vote:
            continue  # joined to others since
        if len(across[i]) < len(across[j]):
            i, j = j, i
        group[group == j] = i
        for k, more in across[j].items():
            del across[k][j]
            if k != i:
                across[i][k] = across[k][i] = total = across[i].get(k, 0) + more
                if total > 0:
                    heappush(waiting, (-total, i, k))
        across[j] = {}
    return group


def outvoted_groups(agreement: PairAgreement, registered: Bool[Tensor, "v"]) -> Bool[Tensor, "v"]:
    """Images of groups other than the largest one that pairs with other groups contradict more than they agree."""
    group = agreeing_groups(agreement, len(registered))
    sizes = torch.bincount(group[registered], minlength=len(group))
    first, second = group[agreement.pairs].unbind(1)
    votes = torch.where(agreement.supports, agreement.matches, 0) - torch.where(agreement.contradicts, agreement.matches, 0)
    balance = torch.zeros_like(sizes)
    for own in (first, second):
        balance.index_add_(0, own[first != second], votes[first != second])
    return registered & (balance[group] < 0) & (group != sizes.argmax())


def hanging_groups(agreement: PairAgreement, registered: Bool[Tensor, "v"], hinge: Bool[Tensor, "q"]) -> Int[Tensor, "v"]:
    """How many images each one is in a group with, itself included, that a hinge holds to the largest of them; else 0.

    Args:
        agreement: How pairs agree with the model.
        registered: The images of the model.
        hinge: What `hinges` are among these pairs.
    """
    group = components(agreement.pairs[agreement.supports & ~hinge], len(registered))
    sizes = torch.bincount(group[registered], minlength=len(group))
    return torch.where(registered & (group != sizes.argmax()), sizes[group], 0)


def hinges(agreement: PairAgreement, mapping: Mapping) -> Bool[Tensor, "q"]:
    """Pairs of images that alone hold what is on one side of them to what is on the other.

    Two images of a thing far away leave open how it is turned, and the pair agrees with the model whatever that is. Each image
    of a group that stands anywhere along such a pair has others that agree. What a third image sees of the pair's points holds
    them, as it does an image that is registered, if these are `FIRM` or more.
    """
    supporting = agreement.supports.nonzero()[:, 0]
    block = blocks(agreement.pairs[supporting], len(mapping.registered))
    hinge = torch.zeros_like(agreement.supports)
    hinge[supporting[torch.bincount(block, minlength=1)[block] == 1]] = True
    node = mapping.observations()
    node = node[(torch.bincount(mapping.point[node], minlength=len(mapping.X)) >= 3)[mapping.point[node]]]
    view, point = mapping.graph.view[node], mapping.point[node]
    for q in hinge.nonzero()[:, 0].tolist():
        first, second = (point[view == i] for i in agreement.pairs[q].tolist())
        hinge[q] = int(torch.isin(first, second).sum()) < FIRM
    return hinge
