"""Which pairs of images promise enough to compare all their features: those whose best features match (Wu, 3DV 2013)."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_one_problem, check_options
from torchsfm.images.features import Features, check_features
from torchsfm.images.matching import match_features

PARTNERS = 12
"""So many partners are kept for each image, whatever is found of them."""
BY_CHANCE, MARGIN = 1 / 40, 3.0
"""The share of features that match in images which have nothing in common (1 to 3 % of SIFT points at the usual ratio), and how
many standard deviations more make a pair worth comparing."""
_EIGHTH, _FEWEST, _MOST = 8, 128, 1024
"""An eighth of an image's features, between these numbers, is looked at."""


def preview_size(count: int) -> int:
    """How many of an image's features tell whether a pair is worth comparing."""
    return min(count, max(_FEWEST, min(_MOST, count // _EIGHTH)))


def preview_matches(features: Sequence[Features], pairs: Int[Tensor, "p 2"]) -> Float[Tensor, "p"]:
    """How many of the best features of the first image of each pair match, over how many do by chance.

    An eighth of the features is compared with all of the second image's, which takes an eighth of the time of comparing all.

    Args:
        features: The features of every image, the best first, as `detect_features` gives them.
        pairs: Which images to compare, as indices into `features`.

    Returns:
        One for each pair, in standard deviations of the number by chance beyond its mean: about 0 for unrelated images.

    Raises:
        ValueError: As `match_features`.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image, other = torch.nn.functional.avg_pool2d(torch.rand(2, 1, 240, 320, generator=g), 5, stride=1, padding=2)
        >>> features = [torchsfm.detect_features(one) for one in (image, image[..., 10:], other)]  # ten columns cut off
        >>> found = torchsfm.images.preview_matches(features, torch.tensor([[0, 1], [0, 2]]))
        >>> bool(found[0] > 30), bool(found[1] < 3)
        (True, True)
    """
    check_features(features)
    check_one_problem(pairs=(pairs, "p 2: int"))
    size = [preview_size(len(f)) for f in features]
    best = [
        Features(f.x[:k], f.scale[:k], f.angle[:k], f.response[:k], f.descriptors[:k])
        for f, k in zip(features, size, strict=True)
    ]
    whole = torch.stack((pairs[:, 0], pairs[:, 1] + len(features)), 1)
    found = match_features([*best, *features], whole)
    number = torch.tensor([len(m) for m in found], dtype=torch.float64, device=pairs.device)
    tried = torch.tensor(size, dtype=torch.float64, device=pairs.device)[pairs[:, 0]]
    chance = BY_CHANCE * tried
    return (number - chance) / chance.sqrt().clamp(min=1)


def promising_pairs(pairs: Int[Tensor, "p 2"], found: Float[Tensor, "p"], *, partners: int = PARTNERS) -> Bool[Tensor, "p"]:
    """Which pairs to compare in full: more matches than chance explains, or among the best of either image.

    Args:
        pairs: Pairs of images.
        found: What `preview_matches` found of them.
        partners: How many of each image's pairs to keep, whatever was found of them: weak ones may be all that there is.

    Example:
        >>> import torch, torchsfm
        >>> pairs = torch.combinations(torch.arange(4))  # 01 02 03 12 13 23
        >>> found = torch.tensor([9.0, 0.5, 0.2, 8.0, 0.1, 0.7])
        >>> torchsfm.images.promising_pairs(pairs, found, partners=1)  # 3 has nothing better than 2
        tensor([ True, False, False,  True, False,  True])
    """
    check_one_problem(pairs=(pairs, "p 2: int"), found=(found, "p"))
    check_options(partners=(partners, "int >= 0"))
    images = int(pairs.max()) + 1 if len(pairs) else 0
    # Both ends of each pair, those of an image together, its best first.
    order = torch.argsort(found.repeat(2), descending=True, stable=True)
    image = pairs.mT.flatten()[order]
    by_image = torch.argsort(image, stable=True)
    count = torch.bincount(image, minlength=images)
    rank = torch.arange(len(image), device=pairs.device) - (count.cumsum(0) - count).repeat_interleave(count)
    kept = order[by_image[rank < partners]] % max(len(pairs), 1)
    return (found > MARGIN).index_fill(0, kept, True)
