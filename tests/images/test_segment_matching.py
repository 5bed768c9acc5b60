import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchsfm.formats import read_vgg
from torchsfm.images import Segments, describe_segments, detect_segments, match_segments, read_image
from torchsfm.images.segment_matching import epipolar_overlap
from torchsfm.tensors import fundamental_from_cameras


def texture(generator: torch.Generator, size: int = 160) -> Tensor:
    """Overlapping bright and dark polygons."""
    y, x = torch.meshgrid(*(torch.arange(size, dtype=torch.float64),) * 2, indexing="ij")
    image = torch.full((size, size), 0.5, dtype=torch.float64)
    for _ in range(14):
        cx, cy, w, h, a, v = torch.rand(6, generator=generator, dtype=torch.float64).tolist()
        u = (x - cx * size) * math.cos(3 * a) + (y - cy * size) * math.sin(3 * a)
        t = -(x - cx * size) * math.sin(3 * a) + (y - cy * size) * math.cos(3 * a)
        inside = torch.sigmoid(2 * ((15 + 25 * w) - u.abs())) * torch.sigmoid(2 * ((15 + 25 * h) - t.abs()))
        image = image + inside * (v - image)
    return image[None]


def moved(segments: Segments, image: Tensor, turns: int) -> Tensor:
    """Ends of the segments where quarter turns of the image take them."""
    ends = segments.ends
    for _ in range(turns):
        ends = torch.stack((ends[..., 1], image.shape[-1] - 1 - ends[..., 0]), -1)
    return ends


@pytest.mark.parametrize("turns", [0, 1, 2])
def test_turned_images_match(turns: int, generator: torch.Generator) -> None:
    image = texture(generator)
    other = torch.rot90(image, turns, (-2, -1))
    first, second = detect_segments(image, 200), detect_segments(other, 200)
    pairs, similarity = match_segments(first, second, image, other)
    assert len(pairs) > 0.5 * float(first.valid.sum())
    assert len(pairs) > 8
    ends = moved(first, image, turns)[pairs[:, 0]]
    away = (ends - second.ends[pairs[:, 1]]).norm(dim=-1).amax(-1)
    assert float((away < 1).double().mean()) > 0.9
    assert bool((similarity >= 0.8).all())
    assert len(set(pairs[:, 0].tolist())) == len(set(pairs[:, 1].tolist())) == len(pairs)


def test_descriptions_do_not_depend_on_contrast(generator: torch.Generator) -> None:
    image = texture(generator)
    segments = detect_segments(image, 60)
    ends = segments.ends[segments.valid]
    assert len(ends) > 10
    one = describe_segments(image, ends)
    torch.testing.assert_close(describe_segments(0.5 * image + 0.2, ends), one, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(one.norm(dim=-1), torch.ones(len(ends), dtype=torch.float64))
    flat = describe_segments(torch.full((1, 60, 60), 0.3, dtype=torch.float64), ends)
    assert bool(flat.isfinite().all())


def test_overlap_is_that_of_the_parts() -> None:
    # Epipolar lines are the rows of both images.
    F = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    first = torch.tensor([[[0.0, 10], [5, 30]]], dtype=torch.float64)
    second = torch.tensor(
        [[[50.0, 10], [60, 30]], [[50, 20], [80, 40]], [[50, 30], [51, 70]], [[0, 20], [90, 20]], [[40, 30], [0, 10]]],
        dtype=torch.float64,
    )
    wanted = torch.tensor([[1.0, 1 / 3, 0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(epipolar_overlap(first, second, F), wanted)


def test_empty_lists_match_nothing(generator: torch.Generator) -> None:
    image = texture(generator)
    flat = torch.full_like(image, 0.5)
    pairs, similarity = match_segments(detect_segments(image, 30), detect_segments(flat, 30), image, flat)
    assert pairs.shape == (0, 2)
    assert similarity.shape == (0,)


def test_oxford_lines_match(data: Path) -> None:
    """Pairs on lines that were matched by hand are on the same one."""
    scene = read_vgg(data / "vgg" / "merton1")
    images = []
    for name in ("001.jpg", "002.jpg"):
        images.append(read_image(next((data / "vgg" / "merton1").rglob(name))).pixels)
    segments = [detect_segments(i, 600) for i in images]
    F = fundamental_from_cameras(scene.P[0], scene.P[1]).to(torch.float32)
    for geometry in (None, F):
        pairs, _ = match_segments(*segments, *images, F=geometry)
        at = []
        for view in range(2):
            ends = segments[view].ends[pairs[:, view]].double()
            start, d = scene.segments[view, :, 0], scene.segments[view, :, 1] - scene.segments[view, :, 0]
            length = d.norm(dim=-1)
            along = ((ends.mean(1)[:, None] - start) * d).sum(-1) / length.square()
            away = ((ends[:, :, None] - start)[..., 0] * d[:, 1] - (ends[:, :, None] - start)[..., 1] * d[:, 0]).abs() / length
            off = torch.where((along > 0) & (along < 1) & scene.segments_visible[view], away.sum(1), torch.inf)
            least, which = off.min(-1)
            at.append(torch.where(least < 3, which, -1))
        both = (at[0] >= 0) & (at[1] >= 0)
        assert int(both.sum()) > 40
        assert float((at[0] == at[1])[both].double().mean()) > 0.88


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image = torch.zeros(1, 40, 40)
    segments = detect_segments(image, 5)
    with pytest.raises(ValueError, match="segments2"):
        match_segments(segments, None, image, image)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="segments1: wanted segments of one image"):
        match_segments(detect_segments(image[None], 5), segments, image, image)
    with pytest.raises(ValueError, match="ratio"):
        match_segments(segments, segments, image, image, ratio=0.0)
    with pytest.raises(ValueError, match="F: wanted"):
        match_segments(segments, segments, image, image, F=torch.zeros(3))
    with pytest.raises(ValueError, match="F: wanted one matrix"):
        match_segments(segments, segments, image, image, F=torch.zeros(2, 3, 3))
    with pytest.raises(ValueError, match="image2: wanted one image"):
        match_segments(segments, segments, image, image[None])
    with pytest.raises(ValueError, match="image2: wanted h2 >= 8"):
        match_segments(segments, segments, image, image[:, :1])
