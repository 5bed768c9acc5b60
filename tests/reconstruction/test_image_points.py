"""The image points of photographs larger than detection needs."""

from pathlib import Path

import pytest
import torch
from chance import seeded

from torchsfm.images import detect_features, read_image, save_image
from torchsfm.reconstruction.matching import image_points
from torchsfm.reconstruction.matching.image_points import detect_all
from torchsfm.reconstruction.matching.stages import Stages


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_positions_are_those_of_the_whole_image(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A photograph read at half the size has its points where those of the same photograph, searched at that size, are."""
    monkeypatch.setattr(image_points, "DETECTION_SIZE", 400)
    noise = torch.rand(1, 3, 75, 100, generator=seeded())
    image = torch.nn.functional.interpolate(noise, size=(600, 800), mode="bicubic").clamp(0, 1)[0]
    files = [tmp_path / f"{i}{suffix}" for i in range(2)]
    for file in files:
        save_image(file, image, quality=98)
    points = detect_all(files, ["a", "b"], Stages(None, False, ""), 500, 10**6, lambda *_: None)
    assert points.image_size.tolist() == [[800, 600]] * 2
    expected = detect_features(read_image(files[0]), 500, max_size=400).x
    found = points.features[0].x
    distance = torch.cdist(found, expected).min(1).values
    assert len(found) > 100
    assert float(distance.median()) < 0.3
    near = torch.cdist(found, expected).argmin(1)[distance < 1]
    assert float((found[distance < 1] - expected[near]).mean(0).abs().max()) < 0.1
    assert float((distance < 1).double().mean()) > 0.9
    assert float((points.color[0] - image[:, found[:, 1].long(), found[:, 0].long()].T).abs().mean()) < 0.1


def test_images_of_few_features_have_weak_ones_besides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = torch.rand(2, 3, 30, 40, generator=seeded())
    images = torch.nn.functional.interpolate(noise, size=(240, 320), mode="bicubic").clamp(0, 1)
    files = [tmp_path / f"{i}.png" for i in range(2)]
    for file, image in zip(files, images, strict=True):
        save_image(file, image)
    pixels = [read_image(file) for file in files]
    strong = [detect_features(image, enough=0) for image in pixels]
    enough = max(map(len, strong)) + 20
    monkeypatch.setattr(image_points, "ENOUGH", enough)
    points = detect_all(files, ["a", "b"], Stages(None, False, ""), 5000, 10**6, lambda *_: None)
    for found, x, weak, image in zip(strong, points.x, points.weak, pixels, strict=True):
        torch.testing.assert_close(x, detect_features(image, 5000, enough=enough).x, atol=1e-3, rtol=0)
        assert weak.tolist() == [False] * len(found) + [True] * (len(x) - len(found))
        torch.testing.assert_close(x[~weak], found.x, atol=1e-3, rtol=0)
        assert weak.any()
    monkeypatch.setattr(image_points, "ENOUGH", 10)
    again = detect_all(files, ["a", "b"], Stages(None, False, ""), 5000, 10**6, lambda *_: None)
    assert not any(weak.any() for weak in again.weak)
