"""Pairs that promise little are left out, and no others."""

from pathlib import Path

import pytest
import torch
from chance import seeded

from torchsfm.images import Features, detect_features, preview_matches, promising_pairs, save_image
from torchsfm.images.preemptive import MARGIN, PARTNERS, preview_size
from torchsfm.reconstruction.photographs import match_photographs


def crops(images: int, generator: torch.Generator) -> list[torch.Tensor]:
    """Images of one texture, each a few pixels beside the others."""
    texture = torch.nn.functional.avg_pool2d(torch.rand(1, 200, 300, generator=generator), 5, stride=1, padding=2)
    return [texture[:, k : k + 150, 3 * k : 3 * k + 220] for k in range(images)]


@pytest.mark.parametrize("partners", [0, 1, 3, 40])
def test_the_best_of_each_image_and_all_that_are_clear_are_kept(partners: int, generator: torch.Generator) -> None:
    pairs = torch.combinations(torch.arange(20))
    pairs = pairs[torch.rand(len(pairs), generator=generator) < 0.6]
    found = 1.2 * MARGIN * torch.rand(len(pairs), generator=generator, dtype=torch.float64)
    kept = promising_pairs(pairs, found, partners=partners)
    wanted = found > MARGIN
    for image in range(20):
        own = (pairs == image).any(1).nonzero()[:, 0]
        wanted[own[found[own].argsort(descending=True)[:partners]]] = True
    assert torch.equal(kept, wanted)


def test_no_pairs_are_no_trouble() -> None:
    none = torch.zeros(0, 2, dtype=torch.long)
    assert promising_pairs(none, torch.zeros(0)).shape == (0,)
    assert preview_matches([], none).shape == (0,)
    blank = Features(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0), torch.zeros(0), torch.zeros(0, 128, dtype=torch.uint8))
    assert preview_matches([blank, blank], torch.tensor([[0, 1]])).tolist() == [0]


def test_what_is_found_of_a_pair_is_its_own(generator: torch.Generator) -> None:
    features = [detect_features(image) for image in (*crops(3, generator), *crops(2, generator))]
    pairs = torch.combinations(torch.arange(5))
    together = preview_matches(features, pairs)
    alone = torch.cat([preview_matches(features, pair[None]) for pair in pairs])
    assert torch.equal(together, alone)
    same = (pairs < 3).all(1) | (pairs >= 3).all(1)
    assert (together[same] > MARGIN).all()
    assert (together[~same] < MARGIN).all()


def test_only_the_first_features_are_looked_at(generator: torch.Generator) -> None:
    (one,) = (detect_features(image) for image in crops(1, generator))
    size = preview_size(len(one))
    assert size < len(one)
    noise = torch.randint(0, 40, one.descriptors.shape, dtype=torch.uint8, generator=generator)
    rest = Features(one.x, one.scale, one.angle, one.response, torch.cat([one.descriptors[:size], noise[size:]]))
    for other in (one, rest):
        assert torch.equal(
            preview_matches([other, one], torch.tensor([[0, 1]])), preview_matches([one, one], torch.tensor([[0, 1]]))
        )


def test_photographs_of_other_things_are_hardly_compared(tmp_path: Path) -> None:
    """Two groups larger than the partners that every image has at least: all pairs within are compared, few across."""
    size = PARTNERS + 2  # more than partners, and together more images than are compared without a look
    generator = seeded()
    for group in "ab":
        for k, image in enumerate(crops(size, generator)):
            save_image(tmp_path / f"{group}{k:02d}.png", image)
    seen = match_photographs(
        tmp_path, sequence=False, max_features=2000, max_pixels=10**6, neighbours=20, out=None, resume=False, seed=0,
        progress=lambda *_: None, masks=None,
    )  # fmt: skip
    compared = {tuple(pair) for pair in seen.graph.pairs.tolist()}
    within = {(i + k, j + k) for i, j in torch.combinations(torch.arange(size)).tolist() for k in (0, size)}
    assert within <= compared
    assert len(compared - within) < 0.05 * size**2
    assert bool((seen.graph.fundamental_inliers > 15).any())
