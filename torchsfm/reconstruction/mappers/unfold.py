"""Map a folded model again, from the relations that its copies do not imitate outwards."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.evidence.consistency import PairAgreement, pair_agreement
from torchsfm.reconstruction.evidence.distinctive import Backbone, Distinctiveness
from torchsfm.reconstruction.evidence.groups import outvoted_groups
from torchsfm.reconstruction.evidence.missing import Conflicts, missing_correspondences
from torchsfm.reconstruction.mappers.incremental import MappingOptions, extend_model, grow_model
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph

Grow = Callable[[Mapping, MappingOptions, Callable[[int, int], None]], tuple[Mapping, dict[int, str]] | None]
"""Makes a model of the images that are not registered, see `grow_model`."""
ROUNDS = 3
"""Models that are made anew, each without the relations that the one before refuted."""


@dataclass(frozen=True)
class Unfolded:
    """A model as its most distinctive relations want it.

    Attributes:
        model: The model; if it was mapped again, its view graph keeps the pairs that agree with it, and those of other images.
        uncertain: Images that hang on a relation which contradicts the model, or is no more distinctive than false ones are.
        conflicts: What missing correspondences say of it.
        support: How distinctive the pairs are together that agree with it.
        agreement: How all pairs of images agree with its poses.
    """

    model: Mapping
    uncertain: Bool[Tensor, "v"]
    conflicts: Conflicts
    support: float
    agreement: PairAgreement


def unfold(
    empty: Mapping,
    model: Mapping,
    elsewhere: Bool[Tensor, "v"],
    options: MappingOptions,
    progress: Callable[[int, int], None],
    grow: Grow = grow_model,
    agreement: PairAgreement | None = None,
) -> Unfolded:
    """Look for a better model where missing correspondences refute one, or it contradicts its most distinctive relations.

    Only the backbone of the most distinctive relations is mapped first; then the pairs that agree with that model come in. If
    two places still pass for one, some relation on the way between two cameras that refute each other is wrong: the one most
    often on such ways, for what it is worth, is given up with all pairs that say the same, and the rest is mapped anew.

    Args:
        empty: A mapping of nothing, with all image points and matches, and the cameras as they were expected.
        model: The model that was made of all pairs.
        elsewhere: Images that belong to other models and are left alone.
        options: How models are grown.
        progress: Called with the number of registered images and of all.
        grow: Makes a model of the backbone, as the given one was made of all pairs.
        agreement: How all pairs agree with the model, if that is known.

    Returns:
        The best of the given model and the new ones: that which is refuted least and which the most distinctive pairs support.
        The given one where the most distinctive relations alone give the same and nothing refutes it any more.
    """
    graph, v = empty.graph, len(empty.graph.names)
    distinct = Distinctiveness.of(graph)
    backbone = Backbone.of(graph.pairs, torch.where(elsewhere[graph.pairs].any(1), 0.0, distinct.weight), v)
    if agreement is not None and model.graph is graph:
        agreement = agreement.of_poses
    else:
        agreement = pair_agreement(replace(model, graph=graph), threshold=options.reprojection, poses_alone=True)
    contradicted = agreement.index[agreement.contradicts & backbone.chosen[agreement.index]]
    uncertain = _hanging_on(backbone, contradicted, model.registered)
    first = best = Unfolded(model, uncertain, missing_correspondences(model), _support(agreement, distinct.weight), agreement)
    if not len(contradicted) and not first.conflicts.folded:
        return first
    for trial in _trials(empty, distinct, elsewhere, options, progress, grow):
        if not trial.conflicts.folded and not len(contradicted) and _alike(trial, first):
            # The most distinctive relations alone give the same model, and refute nothing: chance had refuted it.
            return replace(first, conflicts=trial.conflicts)
        # Less than a fold is no reason to give images up.
        complete = int(trial.model.registered.sum()) >= int(best.model.registered.sum())
        better = (trial.conflicts.strength, -trial.support) < (best.conflicts.strength, -best.support)
        if better and (complete or best.conflicts.folded):
            best = trial
    return best


def _alike(one: Unfolded, other: Unfolded) -> bool:
    """Whether two models have the same images, and no pair of these that agrees with the one contradicts the other."""
    if not torch.equal(one.model.registered, other.model.registered):
        return False
    a, b = one.agreement, other.agreement
    return not bool(((a.supports & b.contradicts) | (a.contradicts & b.supports)).any())


def _contradicted_by_points(model: Mapping, graph: ViewGraph, threshold: float) -> Bool[Tensor, "q"]:
    """Pairs whose matches show points of a model elsewhere than it has them."""
    agreement = pair_agreement(replace(model, graph=graph), threshold=threshold)
    wrong = torch.zeros(len(graph.pairs), dtype=torch.bool)
    wrong[agreement.index] = agreement.contradicts
    return wrong


def _support(agreement: PairAgreement, weight: Float[Tensor, "q"]) -> float:
    return float(weight[agreement.index[agreement.supports]].sum())


def hanging_on_copies(graph: ViewGraph, model: Mapping, others: Bool[Tensor, "v"], *, threshold: float) -> Bool[Tensor, "v"]:
    """The images of a model that hang on relations no more distinctive than those which were given up to part it from others.

    Args:
        graph: All pairs of images, those that were given up among them.
        model: The model.
        others: Images of other models.
        threshold: Largest reprojection error of an observation, in pixels.
    """
    distinct = Distinctiveness.of(graph)
    backbone = _agreeing_backbone(
        distinct, graph, pair_agreement(replace(model, graph=graph), threshold=threshold, poses_alone=True)
    )
    given_up = model.registered[graph.pairs].any(1) & others[graph.pairs].any(1)
    doubtful = backbone.chosen & imitated(distinct, backbone, given_up, model.registered)
    return _hanging_on(backbone, doubtful.nonzero()[:, 0], model.registered)


def outvoted_by_rivals(graph: ViewGraph, model: Mapping, *, threshold: float) -> Bool[Tensor, "v"]:
    """The images of a model whose place pairs contradict that are as distinctive as those which the model believes instead.

    What was given up as matches of like things may be of one thing. All pairs are asked how groups of images stand to each
    other, but for those that are less distinctive, by more than chance, than each relation on the way between their images.

    Args:
        graph: All pairs of images, those that were given up among them.
        model: The model.
        threshold: Largest reprojection error of an observation, in pixels.
    """
    distinct, agreement = Distinctiveness.of(graph), pair_agreement(replace(model, graph=graph), threshold=threshold)
    backbone, rival = _agreeing_backbone(distinct, graph, agreement), ~agreement.contradicts
    for k in agreement.contradicts.nonzero()[:, 0].tolist():
        q, way = int(agreement.index[k]), backbone.way(*agreement.pairs[k].tolist())
        scatter = (distinct.variance[way] + distinct.variance[q]).sqrt()
        rival[k] = bool((distinct.weight[q] > distinct.weight[way] - scatter).any()) or not way
    fields = agreement.pairs, agreement.matches, agreement.agreeing, agreement.index, agreement.by_poses
    asked = (field[rival] for field in fields)
    return outvoted_groups(PairAgreement(*asked), model.registered)


def _agreeing_backbone(distinct: Distinctiveness, graph: ViewGraph, agreement: PairAgreement) -> Backbone:
    """The most distinctive of the pairs that agree with a model."""
    supports = torch.zeros(len(graph.pairs), dtype=torch.bool)
    supports[agreement.index] = agreement.supports
    return Backbone.of(graph.pairs, torch.where(supports, distinct.weight, 0.0), len(graph.names))


def imitated(
    distinct: Distinctiveness, backbone: Backbone, false: Bool[Tensor, "q"], registered: Bool[Tensor, "v"]
) -> Bool[Tensor, "q"]:
    """Pairs of a backbone that false ones equal in distinctiveness, so that they may be false themselves.

    A pair that no false one anywhere exceeds still has rivals: those that would put the images which hang on it elsewhere. It
    must exceed them by more than both vary by chance.
    """
    weight = torch.where(false, distinct.weight, 0.0)
    alike = backbone.chosen & (distinct.weight < weight.amax())
    for q in (backbone.chosen & ~alike).nonzero()[:, 0].tolist():
        side = backbone.smaller_side(q, registered)
        leads_away = side[backbone.pairs].sum(1) == 1
        rival = int(torch.where(leads_away, weight, 0.0).argmax())
        scatter = float(distinct.variance[[q, rival]].sum()) ** 0.5
        alike[q] = bool(leads_away[rival]) and float(distinct.weight[q] - weight[rival]) < scatter
    return alike


def _hanging_on(backbone: Backbone, pairs: Int[Tensor, "k"], registered: Bool[Tensor, "v"]) -> Bool[Tensor, "v"]:
    """The registered images that pairs of the backbone connect with more others."""
    hanging = torch.zeros_like(registered)
    for q in pairs.tolist():
        hanging |= backbone.smaller_side(q, registered)
    return hanging


def _trials(
    empty: Mapping,
    distinct: Distinctiveness,
    elsewhere: Bool[Tensor, "v"],
    options: MappingOptions,
    progress: Callable[[int, int], None],
    grow: Grow,
) -> Iterator[Unfolded]:
    graph, weight, v = empty.graph, distinct.weight, len(empty.graph.names)
    refuted, suspected = (torch.zeros(len(graph.pairs), dtype=torch.bool) for _ in range(2))
    for _ in range(ROUNDS):
        usable = ~refuted & ~elsewhere[graph.pairs].any(1)
        backbone = Backbone.of(graph.pairs, torch.where(usable, weight, 0.0), v)
        grown = _from_backbone(replace(empty, graph=graph.only(usable)), backbone, elsewhere, options, progress, grow)
        if grown is None:
            return
        conflicts = missing_correspondences(grown)
        agreement = pair_agreement(replace(grown, graph=graph), threshold=options.reprojection, poses_alone=True)
        ways = [backbone.way(i, j) for i, j in conflicts.refuted.tolist()]
        suspected[[q for way in ways for q in way]] = True
        false = refuted.clone()
        false[agreement.index[agreement.contradicts]] = True
        doubtful = suspected | imitated(distinct, backbone, false, grown.registered)
        uncertain = _hanging_on(backbone, (backbone.chosen & doubtful).nonzero()[:, 0], grown.registered)
        kept = _agreeing(agreement, ~refuted) & ~_contradicted_by_points(grown, graph, options.reprojection)
        model = _with_pairs(grown, graph, kept)
        yield Unfolded(model, uncertain, conflicts, _support(agreement, weight), agreement)
        if not any(ways):
            return
        refuted = refuted | _given_up(backbone, weight, ways, agreement, v)


def _from_backbone(
    empty: Mapping,
    backbone: Backbone,
    elsewhere: Bool[Tensor, "v"],
    options: MappingOptions,
    progress: Callable[[int, int], None],
    grow: Grow,
) -> Mapping | None:
    """The model of the backbone, and then of all pairs that agree with it."""
    grown = grow(replace(_with_pairs(empty, empty.graph, backbone.chosen), registered=elsewhere), options, progress)
    if grown is None:
        return None
    model = replace(grown[0], graph=empty.graph)
    agreement = pair_agreement(model, threshold=options.reprojection, poses_alone=True)
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
