import re
from pathlib import Path
from typing import Any

import pytest
import torch
from chance import seeded, stream_seed
from kornia import feature

from torchsfm.images import Features, Photograph, load_detector, load_matcher


@pytest.fixture(scope="module")
def picture() -> torch.Tensor:
    return torch.rand(3, 61, 75, generator=seeded())


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """The network with random weights, and a file of them as its authors publish theirs."""
    torch.manual_seed(stream_seed())
    network = feature.DISK().eval()
    path = tmp_path_factory.mktemp("weights") / "disk.pth"
    torch.save({"extractor": network.state_dict()}, path)
    return network, path


def test_disk_gives_what_the_network_says(disk: tuple[Any, Path], picture: torch.Tensor) -> None:
    network, path = disk
    features = load_detector("disk", path)(Photograph(picture, "a"), 100)
    with torch.inference_mode():
        expected = network(picture[None], 100, pad_if_not_divisible=True)[0]
    order = expected.detection_scores.argsort(descending=True, stable=True)
    assert len(features) == expected.n > 20
    torch.testing.assert_close(features.x, expected.keypoints[order])
    torch.testing.assert_close(features.response, expected.detection_scores[order])
    torch.testing.assert_close(features.descriptors, expected.descriptors[order])
    assert bool((features.x >= 0).all())
    assert bool((features.x <= torch.tensor([74.0, 60.0])).all())
    assert not features.x.is_inference()
    assert len(load_detector("disk", path)(picture[:1], 10)) == 10  # grey


def test_shrunk_images_give_positions_in_the_image_given(disk: tuple[Any, Path]) -> None:
    # Enlarged threefold and shrunk again, the network sees about the same image; most of its points stay.
    small = torch.nn.functional.avg_pool2d(torch.rand(1, 3, 96, 112, generator=seeded(1)), 4, 1)[0]
    large = small.repeat_interleave(3, 1).repeat_interleave(3, 2)
    detector = load_detector("disk", disk[1])
    one, three = detector(small, 60), detector(large, 60, max_size=max(small.shape))
    assert float(three.scale[0]) == pytest.approx(3)
    distance = torch.cdist((three.x + 0.5) / 3 - 0.5, one.x).amin(1)
    assert float((distance < 1e-3).float().mean()) > 0.6


@pytest.mark.filterwarnings("ignore:CUDA is not available")  # kornia 0.8
def test_dedode_has_its_first_pixel_at_zero(tmp_path: Path) -> None:
    network = feature.DeDoDe(descriptor_model="B", amp_dtype=torch.float32).eval()
    torch.save(network.detector.state_dict(), tmp_path / "detector.pth")
    torch.save(network.descriptor.state_dict(), tmp_path / "descriptor.pth")
    detector = load_detector("dedode-b", [tmp_path / "detector.pth", tmp_path / "descriptor.pth"])
    image = torch.rand(3, 30, 45, generator=seeded(1))
    features = detector(image, 10000)  # more than there are pixels: every pixel is a point
    assert len(features) == 30 * 45
    assert features.descriptors.shape == (30 * 45, 256)
    torch.testing.assert_close(features.x.amin(0), torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(features.x.amax(0), torch.tensor([44.0, 29.0]), atol=1e-4, rtol=0)
    assert bool((features.response.diff() <= 0).all())


@pytest.mark.parametrize("name", ["disk", "sift"])
def test_lightglue_gives_what_the_network_says(tmp_path: Path, name: str) -> None:
    settings = {"input_dim": 128, "add_scale_ori": name == "sift"}
    network = feature.LightGlue(features=None, filter_threshold=0.0, **settings).eval()
    state = network.state_dict()
    # The authors' files name the layers differently, and leave out what can be computed.
    theirs = {re.sub(r"transformers\.(\d+)\.(self|cross)_attn", r"\2_attn.\1", k): v for k, v in state.items()}
    del theirs["confidence_thresholds"]
    torch.save(theirs, tmp_path / "theirs.pth")
    torch.save(state, tmp_path / "own.pth")
    first, second = (points(seed, n) for seed, n in ((1, 40), (2, 50)))
    matches = load_matcher(name, tmp_path / "theirs.pth", min_score=0.0)(first, second, (200, 100), (150, 120))
    with torch.inference_mode():
        expected = network({"image0": as_input(first, (200, 100)), "image1": as_input(second, (150, 120))})["matches"][0]
    assert len(expected) > 3
    assert sorted(matches.tolist()) == sorted(expected.tolist())
    assert bool((matches[:, 0].diff() > 0).all())
    assert len(set(matches[:, 1].tolist())) == len(matches)
    own = load_matcher(name, tmp_path / "own.pth", min_score=0.0)
    assert torch.equal(own(first, second, (200, 100), (150, 120)), matches)
    assert own(first, points(3, 0), (200, 100), (150, 120)).shape == (0, 2)
    with pytest.raises(ValueError, match="descriptors of 128 values, got 64"):
        own(first, Features(second.x, second.scale, second.angle, second.response, second.descriptors[:, :64]), (9, 9), (9, 9))


def points(seed: int, n: int) -> Features:
    generator = seeded(seed)
    x = torch.rand(n, 2, generator=generator) * 90
    scale, angle = torch.rand(n, generator=generator) * 5 + 1, torch.rand(n, generator=generator) * 6
    return Features(x, scale, angle, torch.ones(n), torch.nn.functional.normalize(torch.randn(n, 128, generator=generator)))


def as_input(features: Features, size: tuple[int, int]) -> dict[str, torch.Tensor]:
    return {
        "keypoints": features.x[None],
        "descriptors": features.descriptors[None],
        "image_size": torch.tensor([size], dtype=torch.float32),
        "scales": features.scale[None] * 2 * 2 ** (-1 / 6),
        "oris": features.angle[None],
    }


def test_errors_name_the_file(tmp_path: Path, disk: tuple[Any, Path]) -> None:
    (tmp_path / "text.pth").write_text("not weights")
    (tmp_path / "cut.pth").write_bytes(disk[1].read_bytes()[:5000])
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({"a": torch.zeros(2)}, tmp_path / "other.pth")
    torch.save({"a": Path("code")}, tmp_path / "code.pth")
    for name, reason in (
        ("missing.pth", "no such file"),
        ("text.pth", "not a readable file"),
        ("cut.pth", "not a readable file"),
        ("list.pth", "no named parameters"),
        ("other.pth", "not the weights of disk"),
        ("code.pth", "not a readable file"),
    ):
        with pytest.raises(ValueError, match=reason) as caught:
            load_detector("disk", tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="wants 2 files, got 1"):
        load_detector("dedode-b", disk[1])
    with pytest.raises(ValueError, match="not the weights of LightGlue"):
        load_matcher("disk", disk[1])


@pytest.mark.usefixtures("unchecked")
def test_unknown_names() -> None:
    with pytest.raises(ValueError, match="name: wanted 'disk'"):
        load_detector("superpoint", "a")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="name: wanted 'disk'"):
        load_matcher("superpoint", "a")  # type: ignore[arg-type]
