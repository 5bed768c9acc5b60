"""Try cameras again that most of their pairs contradict, and part what only contradictions hold together."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.evidence.consistency import PairAgreement, pair_agreement
from torchsfm.reconstruction.mappers.incremental import MappingOptions, extend_model
from torchsfm.reconstruction.mapping.mapping import Mapping

ROUNDS = 3
"""Times that cameras are taken out and tried again."""


def settle(
    model: Mapping, elsewhere: Bool[Tensor, "v"], options: MappingOptions, progress: Callable[[int, int], None]
) -> tuple[Mapping, dict[int, str], PairAgreement | None]:
    """Move cameras to where their pairs agree with the model, as long as that makes more matches agree.

    A camera whose place is contradicted by pairs with more matches than agree with it is taken out with its observations and
    registered anew to what remains, which it may have bent before. Then images that contradictions part from the largest set
    held together by agreeing pairs are left to a model of their own.

    Args:
        model: A grown model.
        elsewhere: Images that belong to other models and are left alone.
        options: How the model was grown.
        progress: Called with the number of registered images and of all.

    Returns:
        The mapping, for each image that was taken out for good the reason, and how all pairs agree with the mapping if that is
        known.
    """
    agreement = pair_agreement(model, threshold=options.reprojection)
    for _ in range(ROUNDS):
        suspect = model.registered & (agreement.balance(len(model.registered)) < 0)
        # Where most are contradicted, like things stand at several places, and no camera is worse than another.
        if not bool(suspect.any()) or 2 * int(suspect.sum()) >= int(model.registered.sum()):
            break
        trial, _ = extend_model(_without_images(model, suspect), elsewhere, options, progress)
        tried = pair_agreement(trial, threshold=options.reprojection)
        if tried.explained <= agreement.explained:
            break
        model, agreement = trial, tried
    apart = _apart(model, agreement)
    if not bool(apart.any()):
        return model, {}, agreement
    reason = "the pairs of images that agree with its place contradict the rest of the model"
    model, _ = extend_model(_without_images(model, apart), elsewhere | apart, options, progress)
    return model, dict.fromkeys(apart.nonzero()[:, 0].tolist(), reason), None


def _without_images(model: Mapping, images: Bool[Tensor, "v"]) -> Mapping:
    """Take images and their observations out of a model, and what they determined of its cameras."""
    node = model.observations()
    model = model.without(node[images[model.graph.view[node]]])
    return replace(model, registered=model.registered & ~images, adjustment=None)


def _apart(model: Mapping, agreement: PairAgreement) -> Bool[Tensor, "v"]:
    """Images outside the largest set linked by pairs that agree more than not, if pairs between the sets contradict it."""
    group = components(agreement.pairs[agreement.deviation > 0], len(model.registered))
    largest = torch.bincount(group[model.registered]).argmax()
    outside = model.registered & (group != largest)
    across = agreement.contradicts & (outside[agreement.pairs].sum(1) == 1)
    contradicted = torch.zeros_like(outside)
    contradicted[agreement.pairs[across].flatten()] = True
    # A set goes as a whole.
    parted = torch.isin(group, group[outside & contradicted])
    return outside & parted
