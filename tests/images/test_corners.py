import math

import cv2
import numpy as np
import pytest
import torch
from chance import numpy_seeded
from kornia.feature import gftt_response, harris_response
from torch import Tensor

from torchsfm.images import detect_corners
from torchsfm.images.corners import box_maximum, corner_response, structure_tensor


def corner_image(kind: str, angle: float, centre: np.ndarray, blur: float, size: int = 64, fine: int = 16) -> Tensor:
    """A corner painted sixteen times finer, averaged down and blurred as a lens does."""
    y, x = (np.mgrid[: size * fine, : size * fine] + 0.5) / fine - 0.5
    u = math.cos(angle) * (x - centre[0]) + math.sin(angle) * (y - centre[1])
    v = -math.sin(angle) * (x - centre[0]) + math.cos(angle) * (y - centre[1])
    painted = (u > 0) ^ (v > 0) if kind == "saddle" else (u > 0) & (v > 0)
    image = painted.astype(np.float32).reshape(size, fine, size, fine).mean((1, 3))
    return torch.from_numpy(0.2 + 0.6 * cv2.GaussianBlur(image, (0, 0), blur))[None]


@pytest.mark.parametrize(
    ("kind", "blur", "most"), [("saddle", 0.8, 0.1), ("saddle", 1.2, 0.1), ("square", 0.5, 0.25), ("square", 1.0, 0.35)]
)
def test_corners_are_where_edges_meet(kind: str, blur: float, most: float) -> None:
    rng = numpy_seeded()
    errors = []
    for angle in rng.uniform(0, 2 * math.pi, 8):
        centre = 31 + rng.uniform(0, 2, 2)
        corners = detect_corners(corner_image(kind, angle, centre, blur), 1)
        assert bool(corners.valid.all())
        errors.append(np.linalg.norm(corners.x[0].numpy() - centre))
    # The worst of eight saddles is off by 0.03 to 0.06 px. Blur rounds a square corner, and moves what can be seen of it
    # inwards; a saddle is free of that.
    assert max(errors) < most


def texture(seed: int, *shape: int) -> Tensor:
    noise = numpy_seeded(seed).random(shape)
    flat = noise.reshape(-1, *shape[-2:])
    return torch.from_numpy(np.stack([cv2.GaussianBlur(f, (0, 0), 1.5) for f in flat]).reshape(shape))


def test_shifted_images_have_shifted_corners() -> None:
    image = texture(1, 1, 80, 100)
    first = detect_corners(image[:, :70, :90], 300, border=1)
    second = detect_corners(image[:, 7:77, 5:95], 300, border=1)
    back = second.x[second.valid] + torch.tensor([5.0, 7.0])
    inner = ((back > 16) & (back < torch.tensor([73.0, 53.0]))).all(-1)
    distance = torch.cdist(back[inner], first.x[first.valid]).amin(1)
    assert int(inner.sum()) > 8
    assert float(distance.max()) < 1e-6


@pytest.mark.reference
@pytest.mark.parametrize(("name", "reference"), [("gftt", gftt_response), ("harris", harris_response)])
def test_responses_are_kornias(name: str, reference: object) -> None:
    image = texture(2, 2, 1, 40, 50)
    torch.testing.assert_close(corner_response(structure_tensor(image), name), reference(image), rtol=1e-9, atol=1e-12)


def test_box_maximum_is_a_pooling() -> None:
    maps = texture(3, 2, 30, 40)
    for radius in (1, 2, 5, 6):
        pooled = torch.nn.functional.max_pool2d(maps, 2 * radius + 1, stride=1, padding=radius)
        assert torch.equal(box_maximum(maps, radius), pooled)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_a_batch_is_its_elements(shape: tuple[int, ...]) -> None:
    images = texture(4, *shape, 3, 40, 50) if 0 not in shape else torch.zeros(0, 3, 40, 50)
    corners = detect_corners(images, 30)
    assert corners.x.shape == (*shape, 30, 2)
    assert corners.valid.shape == corners.score.shape == (*shape, 30)
    for index in np.ndindex(*shape):
        alone = detect_corners(images[index], 30)
        assert int(alone.valid.sum()) > 3
        for name in ("x", "score", "valid"):
            assert torch.equal(getattr(corners, name)[index], getattr(alone, name))


def test_corners_keep_their_distance_and_order() -> None:
    corners = detect_corners(texture(5, 1, 90, 120), 200, min_distance=7, border=9)
    x, valid = corners.x[corners.valid], corners.valid
    assert 10 < len(x) < 200
    assert bool((corners.score.diff() <= 0).all())
    assert bool((valid[1:] <= valid[:-1]).all())
    assert bool((corners.x[~valid] == 0).all())
    assert bool((corners.score[~valid] == 0).all())
    apart = torch.cdist(x, x, p=float("inf")).fill_diagonal_(torch.inf)
    assert float(apart.min()) > 7 - 2 * 3 * math.sqrt(2)  # up to three pixels of refinement on either side
    more = detect_corners(texture(5, 1, 90, 120), 5, min_distance=7, border=9)
    assert torch.equal(more.x, corners.x[:5])


def test_equal_neighbours_give_one_corner() -> None:
    # Symmetric about the middle of two pixels: both have the same response.
    image = torch.zeros(1, 40, 40, dtype=torch.float64)
    image[:, 10:20, 10:30] = 1
    corners = detect_corners(image, 100)
    assert int(corners.valid.sum()) == 4
    assert torch.unique(corners.x[corners.valid].round(), dim=0).shape[0] == 4


def test_mask_and_quality() -> None:
    image = texture(6, 1, 60, 80)
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[:, :40] = True
    left = detect_corners(image, 100, mask=mask)
    everywhere = detect_corners(image, 100)
    assert 0 < int(left.valid.sum()) < int(everywhere.valid.sum())
    assert float(left.x[left.valid][:, 0].max()) < 40 + 3
    strict = detect_corners(image, 100, quality=0.5)
    assert bool((strict.score[strict.valid] > 0.5 * everywhere.score.max()).all())


def test_flat_and_broken_images_have_none_and_spoil_none() -> None:
    images = texture(7, 3, 1, 40, 50)
    good = detect_corners(images[0], 20)
    images[1] = 0.5
    images[2, :, 20:] = torch.nan
    corners = detect_corners(images, 20)
    assert torch.equal(corners.x[0], good.x)
    assert not bool(corners.valid[1].any())
    assert bool(corners.x.isfinite().all())
    assert bool((corners.x[2][corners.valid[2]][:, 1] < 20).all())


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image = torch.zeros(1, 40, 40)
    with pytest.raises(ValueError, match="1 or 3 channels"):
        detect_corners(torch.zeros(2, 40, 40))
    with pytest.raises(ValueError, match="image"):
        detect_corners(torch.zeros(40, 40))
    with pytest.raises(ValueError, match="h >= 8"):
        detect_corners(torch.zeros(1, 5, 40))
    with pytest.raises(ValueError, match="response"):
        detect_corners(image, response="moravec")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="max_corners: wanted int >= 1"):
        detect_corners(image, 0)
