"""Photographs compared shard by shard: how pairs are divided, and that division changes nothing."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import project_points
from torchsfm.images import Features
from torchsfm.reconstruction.matching import match_all
from torchsfm.reconstruction.matching.image_points import SavedFeatures
from torchsfm.reconstruction.matching.match_all import NEAR_IMAGES, VERIFIED_AT_ONCE, PairShards
from torchsfm.reconstruction.matching.view_graph import ViewGraph, verify_pairs
from torchsfm.reconstruction.photographs import MatchedPhotographs, match_photographs
from torchsfm.simulation import random_points, random_poses


def matched(folder: Path, out: Path | None = None, **options: Any) -> MatchedPhotographs:
    options = {"sequence": False, "seed": 3, "progress": lambda *_: None, "first": 0.0} | options
    return match_photographs(
        folder, max_features=600, max_pixels=10**7, neighbours=20, out=out, resume=True, masks=None, **options
    )


def same_graph(a: ViewGraph, b: ViewGraph) -> bool:
    tensors = ViewGraph.__dataclass_fields__.keys() - {"names", "descriptors", "fixed", "still"}
    return (
        (a.names, a.still) == (b.names, b.still)
        and (a.fixed is None) == (b.fixed is None)
        and (a.fixed is None or b.fixed is None or torch.equal(a.fixed, b.fixed))
        and all(torch.equal(getattr(a, name), getattr(b, name)) for name in tensors)
        and (a.descriptors is None) == (b.descriptors is None)
        and (a.descriptors is None or b.descriptors is None or torch.equal(a.descriptors(), b.descriptors()))
    )


@pytest.mark.parametrize("images", [2, 40, 90, 300])
@pytest.mark.parametrize("share", [0.05, 1.0])
def test_shards_divide_the_pairs(images: int, share: float, generator: torch.Generator) -> None:
    pairs = torch.combinations(torch.arange(images))
    pairs = pairs[torch.rand(len(pairs), generator=generator) < share]
    work = PairShards.of(pairs)
    assert sorted(work.order.tolist()) == list(range(len(pairs)))
    seen, each = [], []
    for shard in range(work.verify_shards):
        own = [q for number in work.match_shards_of(shard) for q in work.matched(number).tolist()]
        assert sorted(own) == list(range(len(pairs)))[work.verified(shard)]
        seen += list(work.match_shards_of(shard))
    assert seen == list(range(work.match_shards))
    for number in seen:
        own = work.matched(number)
        assert 1 <= len(own) <= VERIFIED_AT_ONCE // 8
        each.append(len(torch.unique(pairs[own])) / len(own))
    if share == 1 and images > 4 * NEAR_IMAGES:
        # All against all of two blocks of 16: 32 images for 256 pairs, where the order of the pairs themselves needs 65 for 64.
        assert sum(each) / len(each) < 0.6


@pytest.mark.usefixtures("unchecked")  # the checks of annotations read an item, too
def test_an_image_is_read_for_the_pairs_at_hand_alone(courtyard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = matched(courtyard)
    asked: list[int] = []
    read = SavedFeatures.__getitem__
    monkeypatch.setattr(SavedFeatures, "__getitem__", lambda features, i: (asked.append(i), read(features, i))[1])
    monkeypatch.setattr(match_all, "MATCHED_AT_ONCE", 2)
    few = matched(courtyard, tmp_path)
    assert len(asked) <= 2 * len(few.graph.pairs)
    assert same_graph(alone.graph, few.graph)
    asked.clear()
    again = matched(courtyard, tmp_path, first=0.5)
    assert not asked, "what is saved is not matched again"
    assert same_graph(alone.graph, again.graph)


@pytest.mark.parametrize("sequence", [False, True])
def test_verification_in_parts_is_that_of_the_whole(
    sequence: bool, courtyard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the shards: a pair gets what the seed and its matches say, also with tracked corners."""
    whole = matched(courtyard, sequence=sequence)
    assert int(whole.graph.fundamental_inliers.sum()) > 500
    monkeypatch.setattr(match_all, "VERIFIED_AT_ONCE", 4)
    monkeypatch.setattr(PairShards, "of", classmethod(lambda cls, pairs: cls(torch.arange(len(pairs)), 2, "")))
    parts = matched(courtyard, tmp_path, sequence=sequence)
    assert len(list((tmp_path / "stages/verify").glob("*.npz"))) == 3
    assert torch.equal(parts.graph.num_matches, whole.graph.num_matches)
    for name in ("x", "fundamental_inliers", "homography_inliers", "match", "match_pair"):
        assert torch.equal(getattr(parts.graph, name), getattr(whole.graph, name)), name
    other = matched(courtyard, tmp_path, sequence=sequence, seed=4)
    assert not torch.equal(other.graph.F, parts.graph.F)


def test_a_pair_is_verified_by_its_own_matches(generator: torch.Generator) -> None:
    sizes = [16, 25, 33, 40, 60, 300]
    pose = random_poses(2, generator=generator)
    x: list[Tensor] = []
    for n in sizes:
        X = random_points(n, generator=generator)
        for P in pose.matrix():
            image = 500 + 800 * project_points(P, X)
            wrong = torch.rand(n, generator=generator) < 0.5
            noise = torch.randn(n, 2, generator=generator, dtype=torch.float64)
            x.append(
                torch.where(wrong[:, None], 1000 * torch.rand(n, 2, generator=generator, dtype=torch.float64), image + noise)
            )
    pairs = torch.arange(2 * len(sizes)).reshape(-1, 2)
    same = [torch.arange(n)[:, None].expand(-1, 2) for n in sizes]
    size = torch.full((2 * len(sizes), 2), 1000)
    together = verify_pairs(size, x, pairs, same, generator=torch.Generator().manual_seed(5))
    for q in range(len(sizes)):
        alone = verify_pairs(size, x, pairs[q : q + 1], same[q : q + 1], generator=torch.Generator().manual_seed(5))
        assert alone.fundamental_inliers[0] == together.fundamental_inliers[q]
        assert alone.homography_inliers[0] == together.homography_inliers[q]
        torch.testing.assert_close(alone.F[0], together.F[q], rtol=1e-6, atol=1e-12)
        assert torch.equal(alone.match, together.match[together.match_pair == q])


def test_images_of_few_features_match_by_a_looser_ratio(generator: torch.Generator) -> None:
    """Each descriptor of the first image has a partner, and one 20 % farther in angle: 0.83 is between the two ratios."""
    count = match_all.FEW_FEATURES
    d = torch.nn.functional.normalize(torch.randn(count, 128, generator=generator), dim=1)
    aside = torch.nn.functional.normalize(torch.randn(count, 128, generator=generator), dim=1)
    aside = torch.nn.functional.normalize(aside - (aside * d).sum(1, keepdim=True) * d, dim=1)
    near, far = (angle.cos() * d + angle.sin() * aside for angle in torch.tensor([0.2, 0.24]))
    x = torch.zeros(count, 2)

    def features(descriptors: Tensor) -> Features:
        return Features(x[: len(descriptors)], x[: len(descriptors), 0], *([x[: len(descriptors), 0]] * 2), descriptors)

    both = torch.stack((near[: count // 2], far[: count // 2]), 1).flatten(0, 1)
    images = [features(d), features(both), features(d[:-1]), features(both[:-1])]
    pairs = torch.tensor([[0, 3], [0, 1], [2, 1], [0, 1]])
    found = match_all._matches(images, pairs)
    assert len(found["match"]) == int(found["count"].sum())
    second, strict, first, again = found["count"].tolist()
    assert strict == again < 0.02 * count
    assert min(second, first) > 0.45 * count
