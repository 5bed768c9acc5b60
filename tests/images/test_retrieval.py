import weakref
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.images import Features, describe_images, detect_features, list_images, read_image, retrieval, retrieve_pairs


def scene_features(scenes: int, views: int, generator: torch.Generator, points: int = 200) -> list[Features]:
    """Views of scenes: each sees half of its scene's descriptors, with noise, among others of no scene."""
    result = []
    for _ in range(scenes):
        world = torch.rand(points, 32, generator=generator).pow(4)
        for _ in range(views):
            seen = world[torch.randperm(points, generator=generator)[: points // 2]]
            stray = torch.rand(points // 4, 32, generator=generator).pow(4)
            values = torch.cat([seen, stray]) + 0.02 * torch.rand(points // 2 + points // 4, 32, generator=generator)
            result.append(features_of(values))
    return result


def features_of(descriptors: Tensor) -> Features:
    n = len(descriptors)
    return Features(torch.zeros(n, 2), torch.ones(n), torch.zeros(n), torch.ones(n), descriptors)


def test_views_of_one_scene_find_each_other(generator: torch.Generator) -> None:
    features = scene_features(6, 5, generator)
    pairs = retrieve_pairs(features, 4, words=16)
    scene = pairs // 5
    assert float((scene[:, 0] == scene[:, 1]).float().mean()) > 0.95
    assert len(pairs) >= 6 * 10 - 3


def test_pairs_are_sorted_unique_and_enough(generator: torch.Generator) -> None:
    features = scene_features(4, 6, generator)
    pairs = retrieve_pairs(features, 3, words=8)
    assert bool((pairs[:, 0] < pairs[:, 1]).all())
    key = pairs[:, 0] * 100 + pairs[:, 1]
    assert bool((key.diff() > 0).all())
    assert int(torch.bincount(pairs.flatten(), minlength=24).min()) >= 3
    assert torch.equal(retrieve_pairs(features, 3, words=8), pairs)
    twice = [retrieve_pairs(features, 3, words=8, generator=seeded(5)) for _ in range(2)]
    assert torch.equal(*twice)


def test_few_images_give_all_pairs(generator: torch.Generator) -> None:
    features = scene_features(1, 5, generator)
    assert retrieve_pairs(features).tolist() == torch.combinations(torch.arange(5)).tolist()
    assert retrieve_pairs(features, 4).shape == (10, 2)
    assert retrieve_pairs(features[:1]).shape == (0, 2)
    assert retrieve_pairs([]).shape == (0, 2)


def test_images_without_features_are_in_no_pair(generator: torch.Generator) -> None:
    features = scene_features(2, 4, generator)
    features.insert(3, features_of(torch.zeros(0, 32)))
    assert 3 not in retrieve_pairs(features, 2, words=8)
    assert 3 not in retrieve_pairs(features)
    described = describe_images(features, words=8)
    assert described.shape == (9, 8 * 32)
    norm = described.norm(dim=1)
    assert float(norm[3]) == 0
    assert torch.allclose(norm[torch.arange(9) != 3], torch.ones(8))
    empty = describe_images([features[3]] * 2, words=8)
    assert bool((empty == 0).all())
    assert describe_images([]).shape == (0, 0)


def test_fewer_descriptors_than_words(generator: torch.Generator) -> None:
    features = [features_of(torch.rand(2, 32, generator=generator)) for _ in range(6)]
    assert len(retrieve_pairs(features, 2)) >= 6


def test_errors_name_the_argument(generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match="neighbours"):
        retrieve_pairs(scene_features(1, 3, generator), 0)


def test_two_places_are_told_apart(data: Path) -> None:
    folder = data / "images"
    paths = list_images(folder / "fountain-P11" / "images")[:7] + list_images(folder / "sceaux_castle")[:7]
    features = [detect_features(read_image(path, gray=True, max_size=640), 1500) for path in paths]
    place = retrieve_pairs(features, 3) // 7
    assert float((place[:, 0] == place[:, 1]).float().mean()) > 0.95


@pytest.mark.parametrize("entries", [1, 700, 2**22])
def test_partners_are_those_of_the_whole_table(
    entries: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many similarities are computed at once; among images equally alike the first ones are taken."""
    monkeypatch.setattr(retrieval, "SIMILARITIES", entries)
    features = scene_features(5, 6, generator)
    # Integers, so that many products are equal.
    rows = torch.randint(-3, 4, (40, 6), generator=generator).float()
    for count in (1, 5, 39):
        similarity = (rows @ rows.mT).fill_diagonal_(-torch.inf)
        expected = similarity.argsort(dim=1, descending=True, stable=True)[:, :count].sort(1).values
        assert torch.equal(retrieval._most_alike(rows, count), expected)
    described = describe_images(features, words=8)
    similarity = (described @ described.mT).fill_diagonal_(-torch.inf)
    partners = similarity.argsort(dim=1, descending=True, stable=True)[:, :4]
    wanted = {(min(i, j), max(i, j)) for i, row in enumerate(partners.tolist()) for j in row}
    assert {tuple(pair) for pair in retrieve_pairs(features, 4, words=8).tolist()} == wanted


class OneAtATime(Sequence[Features]):
    """Features that are made when they are asked for and counted while anybody has them."""

    def __init__(self, count: int, scenes: int) -> None:
        self.count, self.scenes, self.there, self.most = count, scenes, 0, 0

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> Features:  # type: ignore[override]
        if number >= self.count:
            raise IndexError(number)
        scene = seeded(number % self.scenes + 1)
        world = torch.rand(40, 16, generator=scene).pow(4)
        made = features_of(world + 0.02 * torch.rand(40, 16, generator=seeded(number + 1000)))
        self.there += 1
        self.most = max(self.most, self.there)
        weakref.finalize(made, self.leave)
        return made

    def leave(self) -> None:
        self.there -= 1


def test_features_need_not_be_in_the_memory_together() -> None:
    """Of more images than give descriptors for the words, too."""
    features = OneAtATime(180, 36)
    pairs = retrieve_pairs(features, 4, words=8)
    assert features.most <= 3
    assert float((pairs[:, 0] % 36 == pairs[:, 1] % 36).double().mean()) > 0.9
