"""Missing correspondences: what two cameras at one place should both see, and do not, says that they are at two.

A thing that occurs twice makes photographs of the two match, and folds a model: cameras at one place take their bearings from
the thing alone. What stands around it differs, and no match is wrong there: they are missing (Zach, Irschara & Bischof 2008,
2010). In a folded model, two such cameras share many points in one part of the image, and in another part each has points of
its own, seen by others, none of which the other camera sees though nothing stands before them.

That nothing stands before a point is judged in two ways. Where each camera misses what the other sees in one and the same part
of the image, no thing in front of it explains both. And where a camera sees only what is as far away as a point, or
farther, beside the place where it should see that point, nothing hides it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.reconstruction.evidence.mutual_sight import CELLS, MutualSight, like_viewpoints
from torchsfm.reconstruction.mapping.mapping import Mapping

WRONG = 0.02
"""Share of points at which a wrong match is found where there can be no right one."""
SIGNIFICANCE = 0.01
"""Chance that a right model has a conflict anywhere, were all its points equally easy to find again."""
PART = 1 / 12
"""Part of the places that a place is compared with by which one that is taken for another is refuted, at least: where there are
many, chance refutes some, as points next to each other are missed together."""
PLACES = 0.01
"""Part of all places that are refuted so in a folded model, at least: of many hundred beside each other chance refutes one."""


@dataclass(frozen=True)
class Conflicts:
    """Pairs of registered images, and the logarithm of the odds that they show two things taken for one.

    Attributes:
        pairs: Images that look at the same points from like viewpoints, according to the model, `i < j`.
        score: Log-likelihood ratio, summed over the parts of the image where each misses what the other sees. Where it is below
            the limit, whatever chance finds, the most that it can be.
        limit: What chance exceeds once in a hundred models.
        place: Where each image was taken; copies of one photograph have one number.
    """

    pairs: Int[Tensor, "q 2"]
    score: Float[Tensor, "q"]
    limit: float
    place: Int[Tensor, "v"]

    @property
    def refuted(self) -> Int[Tensor, "r 2"]:
        """The pairs that chance does not explain."""
        return self.pairs[self.score > self.limit]

    @property
    def folded(self) -> bool:
        """Whether two places pass for one.

        One pair may miss what something without features hides. A place taken for another is refuted from more than one other,
        and from a `PART` of those it is compared with; one folds a model, or a part of all `PLACES` where there are many.
        """
        refuting, compared = (
            torch.bincount(torch.unique(self.place[pairs].sort(dim=1).values, dim=0).flatten(), minlength=len(self.place))
            for pairs in (self.refuted, self.pairs)
        )
        taken_for_another = int(((refuting >= 2) & (refuting >= PART * compared)).sum())
        return taken_for_another >= max(1.0, PLACES * int((compared > 0).sum()))

    @property
    def strength(self) -> float:
        """By how much the refuted pairs exceed what chance does, together."""
        return float((self.score - self.limit).clamp(min=0).sum())


def missing_correspondences(mapping: Mapping) -> Conflicts:
    """Compare every two cameras with like viewpoints, point by point, in each part of the image.

    The share of points that is seen (`MutualSight`) is the pair's own; a part of the image where it is zero speaks against the
    pair with the likelihood of so many misses at that share, if it is zero both for the points of the one camera and for those
    of the other, or if both miss points, each anywhere, at places that they see.

    What chance finds must be looked for at four places for each point. Few pairs are refuted by what speaks most against them:
    that it finds what was found. The others need not be asked.
    """
    sight, pairs = MutualSight.of(mapping), like_viewpoints(mapping)
    limit = math.log(2 * max(len(pairs), 1) * CELLS[0] * CELLS[1] / SIGNIFICANCE)
    score = _scores(*sight.parts(pairs, by_chance=False))
    asked = (score > limit).nonzero()[:, 0]
    score[asked] = _scores(*sight.parts(pairs[asked], by_chance=True))
    return Conflicts(pairs, score, limit, sight.site)


def _scores(
    own: Float[Tensor, "k d cells"], other: Float[Tensor, "k d cells"], through: Float[Tensor, "k d cells"]
) -> Float[Tensor, "q"]:
    """How much speaks against pairs, by what `MutualSight.parts` says of both directions of each."""
    expected, q = _Shares.of(own), own.shape[1] // 2
    swapped = torch.arange(2 * q).roll(q)
    both = 2 * torch.minimum(expected.against(own), expected.against(other)[swapped]).sum(-1)
    each = _Shares.of(through).against(through).sum(-1)
    return torch.maximum(both, torch.minimum(each, each[swapped])).reshape(2, -1).amax(0)


@dataclass(frozen=True)
class _Shares:
    """Which share of the points of one camera another finds again, and which it finds by chance, where that is known."""

    found: Float[Tensor, "q 1"]
    by_chance: Float[Tensor, "q 1"] | None

    @classmethod
    def of(cls, table: Float[Tensor, "k q cells"]) -> "_Shares":
        """Of points, points found, and points that chance would find."""
        total, hit, *chance = table.sum(-1)
        found = ((hit + 1) / (total + 2)).clamp(max=0.95)
        return cls(found[:, None], ((chance[0] + WRONG) / (total + 1)).clamp(min=WRONG)[:, None] if chance else None)

    def against(self, table: Float[Tensor, "k q cells"]) -> Float[Tensor, "q cells"]:
        """Log-likelihood that only chance finds points in a part, over that they are found as in the rest of the pair.

        The most that it can be where chance is not known: where it finds as large a share as is found.
        """
        n, k, *chance = table
        dead = k / n.clamp(min=1) if self.by_chance is None else (chance[0] + 5 * self.by_chance) / (n + 5)
        dead = dead.clamp(WRONG, 0.9)
        ratio = k * (dead / self.found).log() + (n - k) * ((1 - dead) / (1 - self.found)).log()
        return torch.where(dead < self.found, ratio, 0.0).clamp(min=0)
