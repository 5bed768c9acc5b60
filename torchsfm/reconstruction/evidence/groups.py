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


def hanging_groups(agreement: PairAgreement, registered: Bool[Tensor, "v"]) -> Int[Tensor, "v"]:
    """How many images each one is in a group with, itself included, that a single pair holds to the largest of them; else 0.

    Two images of a thing far away leave a hinge open, and the pair agrees with the model however it is turned. A group that
    one pair alone holds may stand anywhere along it, though each of its images has several pairs that agree.
    """
    pairs = agreement.pairs[agreement.supports]
    block = blocks(pairs, len(registered))
    alone = torch.bincount(block, minlength=1)[block] == 1
    group = components(pairs[~alone], len(registered))
    sizes = torch.bincount(group[registered], minlength=len(group))
    return torch.where(registered & (group != sizes.argmax()), sizes[group], 0)
