"""Map a folded model again, from the relations that its copies do not imitate outwards."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.reconstruction.consistency import PairAgreement, pair_agreement
from torchsfm.reconstruction.distinctive import Backbone, distinctiveness
from torchsfm.reconstruction.incremental import MappingOptions, extend_model, grow_model
from torchsfm.reconstruction.mapping import Mapping
from torchsfm.reconstruction.missing import Conflicts, missing_correspondences
from torchsfm.reconstruction.tracks import build_tracks
from torchsfm.reconstruction.view_graph import ViewGraph

ROUNDS = 3
"""Models that are made anew, each without the relations that the one before refuted."""


@dataclass(frozen=True)
class Unfolded:
    """A model that was mapped again.

    Attributes:
        model: The model; its view graph keeps the pairs that agree with it, and those between images that are not in it.
        uncertain: Images that a relation connects with the rest which a false one may equal.
    """

    model: Mapping
    uncertain: Bool[Tensor, "v"]


def unfold(
    empty: Mapping,
    model: Mapping,
    elsewhere: Bool[Tensor, "v"],
    options: MappingOptions,
    progress: Callable[[int, int], None],
) -> Unfolded | None:
    """Look for a model that fewer missing correspondences refute.

    Only the backbone of the most distinctive relations is mapped first; then the pairs that agree with that model come in. If
    two places still pass for one, some relation on the way between two cameras that refute each other is wrong: the one most
    often on such ways, for what it is worth, is given up with all pairs that say the same, and the rest is mapped anew.

    Args:
        empty: A mapping of nothing, with all image points and matches, and the cameras as they were expected.
        model: The model that was made of all pairs.
        elsewhere: Images that belong to other models and are left alone.
        options: How models are grown.
        progress: Called with the number of registered images and of all.

    Returns:
        The best of the new models, or None if the given one is not refuted or no other is better.
    """
    before = missing_correspondences(model)
    if not len(before.refuted):
        return None
    strength, best = before.strength, None
    for unfolded, conflicts in _trials(empty, elsewhere, options, progress):
        # One refuted pair is no reason to give images up.
        complete = int(unfolded.model.registered.sum()) >= int(model.registered.sum())
        if conflicts.strength < strength and (complete or before.folded):
            strength, best = conflicts.strength, unfolded
    return best


def _trials(
    empty: Mapping, elsewhere: Bool[Tensor, "v"], options: MappingOptions, progress: Callable[[int, int], None]
) -> Iterator[tuple[Unfolded, Conflicts]]:
    graph, v = empty.graph, len(empty.graph.names)
    weight = distinctiveness(graph)
    refuted, suspected = (torch.zeros(len(graph.pairs), dtype=torch.bool) for _ in range(2))
    for _ in range(ROUNDS):
        usable = ~refuted & ~elsewhere[graph.pairs].any(1)
        backbone = Backbone.of(graph.pairs, torch.where(usable, weight, 0.0), v)
        grown = _from_backbone(replace(empty, graph=graph.only(usable)), backbone, elsewhere, options, progress)
        if grown is None:
            return
        conflicts = missing_correspondences(grown)
        agreement = pair_agreement(replace(grown, graph=graph), threshold=options.reprojection)
        ways = [backbone.way(i, j) for i, j in conflicts.refuted.tolist()]
        suspected[[q for way in ways for q in way]] = True
        # A relation no more distinctive than those that are false may be one of them.
        false = refuted.clone()
        false[agreement.index[agreement.contradicts]] = True
        alike = weight < torch.where(false, weight, 0.0).amax()
        uncertain = torch.zeros(v, dtype=torch.bool)
        for q in (backbone.chosen & (suspected | alike)).nonzero()[:, 0].tolist():
            uncertain |= min((side & grown.registered for side in backbone.sides(q, v)), key=lambda side: int(side.sum()))
        yield Unfolded(_with_pairs(grown, graph, _agreeing(agreement, ~refuted)), uncertain), conflicts
        if not any(ways):
            return
        refuted = refuted | _given_up(backbone, weight, ways, agreement, v)


def _from_backbone(
    empty: Mapping,
    backbone: Backbone,
    elsewhere: Bool[Tensor, "v"],
    options: MappingOptions,
    progress: Callable[[int, int], None],
) -> Mapping | None:
    """The model of the backbone, and then of all pairs that agree with it."""
    grown = grow_model(replace(_with_pairs(empty, empty.graph, backbone.chosen), registered=elsewhere), options, progress)
    if grown is None:
        return None
    model = replace(grown[0], graph=empty.graph)
    agreement = pair_agreement(model, threshold=options.reprojection)
    return extend_model(_with_pairs(model, empty.graph, _agreeing(agreement, backbone.chosen)), elsewhere, options, progress)[0]


def _agreeing(agreement: PairAgreement, others: Bool[Tensor, "q"]) -> Bool[Tensor, "q"]:
    """The pairs that agree with a model, and of those that it says nothing of the given ones."""
    kept = others.clone()
    kept[agreement.index] = agreement.supports
    return kept


def _with_pairs(model: Mapping, graph: ViewGraph, kept: Bool[Tensor, "q"]) -> Mapping:
    """The model over the matches of some pairs, with the tracks that they make."""
    graph = graph.only(kept)
    return replace(model, graph=graph, track=build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair]))


def _given_up(
    backbone: Backbone, weight: Float[Tensor, "q"], ways: Sequence[list[int]], agreement: PairAgreement, views: int
) -> Bool[Tensor, "q"]:
    """Relations that part all cameras that refute each other, and all pairs that say the same."""
    says_so = torch.zeros(len(weight), dtype=torch.bool)
    says_so[agreement.index] = agreement.deviation > 0
    wrong = torch.zeros_like(says_so)
    remaining = [way for way in ways if way]
    while remaining:
        on = torch.bincount(torch.tensor([q for way in remaining for q in way]), minlength=len(weight))
        worst = int((on / weight.clamp(min=1e-30)).argmax())
        first, second = backbone.sides(worst, views)
        ends = torch.stack([first[backbone.pairs], second[backbone.pairs]])
        wrong |= says_so & ends.any(-1).all(0)
        wrong[worst] = True
        remaining = [way for way in remaining if worst not in way]
    return wrong
