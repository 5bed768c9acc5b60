import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from chance import assert_share, numpy_seeded
from torch import Tensor

from torchsfm.images import Photograph, detect_features, match_descriptors, read_image


def blobs(centres: np.ndarray, sizes: np.ndarray, height: int = 240, width: int = 320) -> Tensor:
    """Gaussian blobs on grey, exact at every pixel centre."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    image = np.full((height, width), 0.35)
    for (cx, cy), s in zip(centres, sizes, strict=True):
        image += 0.4 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))
    return torch.from_numpy(image.astype(np.float32))[None]


def nearest(points: Tensor, centre: np.ndarray) -> int:
    return int((points.double() - torch.from_numpy(centre)).norm(dim=1).argmin())


@pytest.mark.parametrize(("size", "spread"), [(1.5, 0.03), (2.5, 0.06), (4.0, 0.08), (8.0, 0.12), (12.0, 0.2)])
def test_blobs_are_found_where_they_are(size: float, spread: float) -> None:
    rng = numpy_seeded(1)
    errors, scales = [], []
    for _ in range(6):
        # OpenCV leaves out a border of five pixels at the scale of the point.
        centres = np.array([[110.0, 120.0], [210.0, 120.0]]) + rng.uniform(-10, 10, (2, 2))
        features = detect_features(blobs(centres, np.array([size, size])))
        for centre in centres:
            i = nearest(features.x, centre)
            errors.append(features.x[i].double().numpy() - centre)
            scales.append(float(features.scale[i]) / size)
    errors = np.array(errors)
    # Without bias: a quarter of a pixel is what a wrong pixel-centre convention gives.
    assert np.abs(errors.mean(0)).max() < spread
    assert np.linalg.norm(errors, axis=1).max() < 4 * spread
    assert np.array(scales) == pytest.approx(1, abs=0.05)


def test_shrunk_images_give_positions_in_the_image_given() -> None:
    rng = numpy_seeded(2)
    found = []
    for _ in range(8):
        centres = np.array([[90.0, 120.0], [220.0, 110.0]]) + rng.uniform(-1, 1, (2, 2))
        sizes = rng.uniform(6, 12, 2)
        features = detect_features(blobs(centres, sizes), max_size=107)  # about a third
        for centre, size in zip(centres, sizes, strict=True):
            distance = (features.x.double() - torch.from_numpy(centre)).norm(dim=1)
            found.append(bool((distance < 5).any()))
            assert (distance[distance < 5] < 0.3).all()
            assert features.scale[distance < 5].numpy() == pytest.approx(size, rel=0.1)
    # OpenCV passes over one in ten perfect blobs: those whose size lies in the middle between two of its scales.
    assert_share(torch.tensor(found), 0.8)


def texture(seed: int, height: int = 240, width: int = 320) -> np.ndarray:
    rng = numpy_seeded(seed)
    image = sum(cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), s) * s for s in (1.5, 3, 6, 12))
    return ((image - image.min()) / np.ptp(image)).astype(np.float32)


def warp(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """What is at X comes to be at A X + b, with matrix = [A b]; bilinear, as common cubic kernels bend ramps."""
    height, width = image.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    points = (np.stack([x, y], -1) - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    grid = torch.from_numpy(points / [width - 1, height - 1] * 2 - 1)[None]
    values = torch.from_numpy(image).double()[None, None]
    values = torch.nn.functional.grid_sample(values, grid, mode="bilinear", padding_mode="reflection", align_corners=True)
    return values[0, 0].numpy().astype(np.float32)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 137.0])
def test_rotation_and_zoom_are_followed(degrees: float) -> None:
    angle, zoom = math.radians(degrees), 0.8
    A = zoom * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    centre = np.array([160.3, 119.6])
    matrix = np.hstack([A, (centre - A @ centre)[:, None]])
    first = texture(3)
    f1, f2 = (detect_features(torch.from_numpy(i)[None]) for i in (first, warp(first, matrix)))
    matches = match_descriptors(f1.descriptors, f2.descriptors)
    expected = f1.x[matches[:, 0]].double().numpy() @ A.T + matrix[:, 2]
    error = np.linalg.norm(f2.x[matches[:, 1]].double().numpy() - expected, axis=1)
    good = error < 1
    assert len(matches) > 150
    assert good.mean() > 0.97
    assert np.median(error) < 0.12
    assert np.abs((f2.x[matches[:, 1]].double().numpy() - expected)[good].mean(0)).max() < 0.03
    turned = (f2.angle[matches[:, 1]] - f1.angle[matches[:, 0]]).double().numpy()[good] - angle
    assert np.median(np.abs(np.angle(np.exp(1j * turned)))) < 0.03
    grown = (f2.scale[matches[:, 1]] / f1.scale[matches[:, 0]]).double().numpy()[good]
    assert np.median(grown) == pytest.approx(zoom, rel=0.02)


def test_angle_is_that_of_the_gradient() -> None:
    # A blob on a ramp that brightens downwards: its surroundings point along y, a quarter turn from x.
    image = blobs(np.array([[160.0, 120.0]]), np.array([5.0])) * 0.3 + torch.linspace(0, 0.5, 240)[None, :, None]
    features = detect_features(image)
    i = nearest(features.x, np.array([160.0, 120.0]))
    assert float(features.angle[i]) == pytest.approx(math.pi / 2, abs=0.1)


def test_the_first_are_kept() -> None:
    image = torch.from_numpy(texture(4))[None]
    every = detect_features(image, 100000)
    some = detect_features(image, 200)
    assert len(every) > 400
    assert len(some) == 200
    for name in ("x", "scale", "angle", "response"):
        assert torch.equal(getattr(some, name), getattr(every, name)[:200])
    # The same descriptors go with the same points.
    close = (some.descriptors.int() - every.descriptors[:200].int()).abs().amax(1) <= 1
    assert float(close.float().mean()) > 0.99


def test_strong_points_come_first_but_from_all_over() -> None:
    image = torch.from_numpy(texture(4))[None]
    image[:, :, 160:] = 0.5 + 0.7 * (image[:, :, 160:] - 0.5)  # the right half is dimmer
    every = detect_features(image, 100000)
    some = detect_features(image, 300)
    left, right = (int((some.x[:, 0] < 160).sum()), int((some.x[:, 0] >= 160).sum()))
    assert 30 < right < left
    # Where only one point of a cell is kept, it is the cell's strongest.
    cell, kept = ((x / (320 / 24)).floor() @ torch.tensor([1.0, 1000.0]) for x in (every.x, some.x))
    for c in kept.unique():
        strongest = every.response[cell == c].max()
        assert float(some.response[kept == c].max()) == float(strongest)


def test_an_image_with_few_points_is_given_weaker_ones_after_them() -> None:
    canvas = np.full((240, 320), 90, np.uint8)
    t = np.linspace(0, 2 * np.pi, 400)
    for k in range(48):  # thin loops, bent by three waves each
        r = 8 + 5 * (k % 4) + 3 * np.sin(3 * t + k)
        loop = np.stack((40 + 80 * (k // 4 % 4) + 1.4 * r * np.cos(t), 40 + 80 * (k // 16) + 1.2 * r * np.sin(t)), 1)
        cv2.polylines(canvas, [np.round(16 * loop).astype(np.int32)], True, 140, 1, cv2.LINE_AA, 4)
    image = torch.from_numpy(canvas)[None] / 255
    few, every = (detect_features(image, enough=k) for k in (0, 5000))
    assert 100 < len(few) < 0.8 * len(every)
    some = detect_features(image, enough=len(few) + 20)
    assert len(some) == len(few) + 20
    assert torch.equal(every.x[: len(few)], few.x)
    assert torch.equal(every.x[: len(some)], some.x)
    assert len(
        {(*x, s, a) for x, s, a in zip(every.x.tolist(), every.scale.tolist(), every.angle.tolist(), strict=True)}
    ) == len(every)
    assert len(detect_features(image, 60)) == 60
    # One that has enough keeps to the strict tests.
    rich = torch.from_numpy(texture(4))[None]
    assert torch.equal(detect_features(rich, enough=200).x, detect_features(rich, enough=0).x)


def test_the_answer_is_always_the_same() -> None:
    image = torch.from_numpy(texture(5))[None]
    before = image.clone()
    threads = cv2.getNumThreads()
    try:
        runs = []
        for count in (1, 4, 4):
            cv2.setNumThreads(count)
            runs.append(detect_features(image))
    finally:
        cv2.setNumThreads(threads)
    for run in runs[1:]:
        for name in ("x", "scale", "angle", "response", "descriptors"):
            assert torch.equal(getattr(run, name), getattr(runs[0], name))
    assert torch.equal(image, before)
    photograph = detect_features(Photograph(pixels=image, name="a"))
    assert torch.equal(photograph.x, runs[0].x)
    color = detect_features(image.expand(3, -1, -1))  # the luma's rounding may differ by one in 255
    assert len(color) == pytest.approx(len(runs[0]), rel=0.01)
    assert (color.x[:50, None] - runs[0].x).norm(dim=-1).amin(1).max() < 0.1


def test_descriptors_are_root_sift() -> None:
    features = detect_features(torch.from_numpy(texture(6))[None])
    assert features.descriptors.dtype == torch.uint8
    assert features.descriptors.shape == (len(features), 128)
    assert int(features.descriptors.max()) <= 127
    # The squares of RootSIFT are SIFT over its sum: they add up to one.
    total = (features.descriptors.double() / 256).square().sum(1)
    assert bool(((total - 1).abs() < 0.03).all())


def test_images_without_structure_have_no_features() -> None:
    for image in (torch.zeros(1, 50, 60), torch.full((3, 40, 40), 0.5), torch.zeros(1, 1, 1), torch.rand(1, 2, 3)):
        features = detect_features(image)
        assert len(features) == 0
        assert features.descriptors.shape == (0, 128)
        assert features.x.shape == (0, 2)
    assert len(detect_features(torch.full((1, 30, 30), torch.nan))) == 0


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_are_named() -> None:
    for shape in ((2, 30, 30), (30, 30), (1, 1, 30, 30), (1, 0, 5)):
        with pytest.raises(ValueError, match="image: wanted shape"):
            detect_features(torch.zeros(shape))
    with pytest.raises(ValueError, match="max_features"):
        detect_features(torch.zeros(1, 30, 30), 0)
    with pytest.raises(ValueError, match="enough"):
        detect_features(torch.zeros(1, 30, 30), enough=[1])  # type: ignore[arg-type]


def test_photographs_are_rich(data: Path) -> None:
    photo = read_image(data / "images" / "sceaux_castle" / "100_7103.JPG", gray=True)
    features = detect_features(photo)
    assert len(features) == 8192
    assert bool((features.x >= 0).all())
    assert bool((features.x[:, 0] <= photo.width - 1).all())
    assert bool((features.x[:, 1] <= photo.height - 1).all())
    assert len(torch.unique(torch.cat([features.x, features.scale[:, None], features.angle[:, None]], 1), dim=0)) == 8192
