"""Which images are worth matching with one another, where there are too many to try all pairs."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.images.features import Features, check_features
from torchsfm.images.matching import unit_descriptors
from torchsfm.linalg.devices import on_the_cpu

SIMILARITIES = 2**22
"""Similarities of images computed at once."""
SAMPLED, LEAST_SAMPLED = 256, 16
"""Descriptors among which a visual word is found, and the least number taken from an image that gives any."""


@on_the_cpu
def retrieve_pairs(
    features: Sequence[Features],
    neighbours: int = 20,
    *,
    words: int = 64,
    generator: torch.Generator | None = None,
) -> Int[Tensor, "p 2"]:
    """Pairs of images that are likely to show the same things.

    Every image is paired with the `neighbours` images most like it by `describe_images`. Where that would be all of them, all
    pairs are returned and nothing is computed. Similarities are computed for some images at a time, so that the memory grows
    with the number of images and not with its square.

    Args:
        features: The features of every image, asked for one after the other: they need not all be in the memory.
        neighbours: How many partners to find for each image; an image may have more, as it may be the partner of others.
        words: Number of visual words.
        generator: Randomness for the choice of words; a fixed seed where not given.

    Returns:
        Pairs of indices, the smaller first, sorted, each once. An image without features is in no pair.

    Raises:
        ValueError: `neighbours` or `words` is not positive.

    Example:
        >>> import torch, torchsfm
        >>> images = torch.rand(4, 1, 60, 80, generator=torch.Generator().manual_seed(0))
        >>> features = [torchsfm.detect_features(image) for image in images]
        >>> torchsfm.images.retrieve_pairs(features, neighbours=20).shape  # few images: all pairs
        torch.Size([6, 2])
    """
    check_features(features)
    check_options(neighbours=(neighbours, "int >= 1"), words=(words, "int >= 1"))
    usable = torch.tensor([i for i, f in enumerate(features) if len(f) > 0], dtype=torch.long)
    n = len(usable)
    if n - 1 <= neighbours:
        return usable[torch.combinations(torch.arange(n)).reshape(-1, 2)]
    described = describe_images(features, words=words, generator=generator)[usable]
    partners = _most_alike(described, neighbours).cpu()
    pairs = torch.stack([torch.arange(n)[:, None].expand_as(partners), partners], -1).reshape(-1, 2)
    pairs = torch.unique(pairs.sort(dim=1).values, dim=0)
    return usable[pairs]


def _most_alike(rows: Float[Tensor, "n k"], count: int) -> Int[Tensor, "n count"]:
    """The other rows with the largest products with each, the first ones among equals, in order."""
    n = len(rows)
    found = []
    for some in torch.split(torch.arange(n, device=rows.device), max(1, SIMILARITIES // n)):
        similarity = rows[some] @ rows.mT
        similarity[torch.arange(len(some)), some] = -torch.inf
        least = similarity.topk(count).values[:, -1:]
        above, ties = similarity > least, similarity == least
        room = count - above.sum(1, keepdim=True)
        found.append((above | (ties & (ties.cumsum(1) <= room))).nonzero()[:, 1].view(-1, count))
    return torch.cat(found)


def describe_images(
    features: Sequence[Features], *, words: int = 64, generator: torch.Generator | None = None
) -> Float[Tensor, "v k"]:
    """One unit vector for each image, near those of images that show the same things.

    VLAD (Jegou et al., CVPR 2010): the sum of the descriptors' differences from the visual word nearest to them, normalised for
    each word (Arandjelovic and Zisserman, CVPR 2013). The words are found among the descriptors of these images.

    Args:
        features: The features of every image.
        words: Number of visual words; fewer are used where there are fewer descriptors.
        generator: Randomness for the choice of words; a fixed seed where not given.

    Returns:
        One row for each image; zeros for an image without features.

    Example:
        >>> import torch, torchsfm
        >>> images = torch.rand(3, 1, 60, 80, generator=torch.Generator().manual_seed(0))
        >>> d = torchsfm.images.describe_images([torchsfm.detect_features(image) for image in images], words=8)
        >>> d.shape, (d @ d.mT).diagonal()
        (torch.Size([3, 1024]), tensor([1.0000, 1.0000, 1.0000]))
    """
    check_features(features)
    check_options(words=(words, "int >= 1"))
    if not features:
        return torch.zeros(0, 0)
    filled = [i for i, f in enumerate(features) if len(f)]
    if not filled:
        return torch.zeros(len(features), words * features[0].descriptors.shape[1])
    device = features[0].descriptors.device
    generator = generator or torch.Generator().manual_seed(0)
    wanted = SAMPLED * words
    share = max(LEAST_SAMPLED, wanted // len(filled))
    sample = []
    # Of very many images, some are enough.
    for i in filled[:: max(1, len(filled) * LEAST_SAMPLED // wanted)]:
        f = features[i]
        chosen = torch.randperm(len(f), generator=generator, device=generator.device)[:share].to(device)
        sample.append(unit_descriptors(f.descriptors[chosen]))
    centres = _cluster(torch.cat(sample), words, generator)
    described = centres.new_empty((len(features), centres.numel()))
    for row, f in zip(described, features, strict=True):
        unit = unit_descriptors(f.descriptors)
        word = _nearest(unit, centres)
        total = torch.zeros_like(centres).index_add_(0, word, unit - centres[word])
        row.copy_(torch.nn.functional.normalize(total, dim=1).flatten())
    return torch.nn.functional.normalize(described, dim=1)


def _nearest(x: Tensor, centres: Tensor) -> Tensor:
    return (x @ centres.mT - 0.5 * centres.square().sum(1)).argmax(1)


def _cluster(x: Tensor, count: int, generator: torch.Generator, rounds: int = 15) -> Tensor:
    """Centres of clusters by Lloyd's iteration from random rows; a cluster that has lost its last row stays where it is."""
    centres = x[torch.randperm(len(x), generator=generator, device=generator.device)[:count].to(x.device)]
    for _ in range(rounds):
        label = _nearest(x, centres)
        total = torch.zeros_like(centres).index_add_(0, label, x)
        size = torch.bincount(label, minlength=len(centres))[:, None]
        centres = torch.where(size > 0, total / size.clamp_min(1), centres)
    return centres
