import math

import numpy as np
import pytest
import torch
from chance import numpy_seeded
from painting import disc, half_plane, polygon
from torch import Tensor

from torchsfm.images import hough_lines

NAMES = ("line", "ends", "count", "scatter", "valid")


def squares(count: int, size: int = 96, side: float = 36.0) -> tuple[Tensor, Tensor]:
    rng = numpy_seeded()
    angle = torch.tensor(rng.uniform(0, 2 * math.pi, count))[:, None] + torch.arange(4) * math.pi / 2
    centre = (size - 1) / 2 + torch.tensor(rng.uniform(-3, 3, (count, 1, 2)))
    corners = centre + side * torch.stack((angle.cos(), angle.sin()), -1)
    return torch.stack([polygon(c, size) for c in corners]), corners


def test_sides_of_squares_are_found_between_the_bins() -> None:
    image, corners = squares(6)
    found = hough_lines(image, 12)
    assert bool((found.valid.sum(-1) == 4).all())
    torch.testing.assert_close(found.line[:, :4, :2].norm(dim=-1), torch.ones(6, 4, dtype=torch.float64))
    away = (corners[:, None] * found.line[:, :4, None, :2]).sum(-1) + found.line[:, :4, 2:]
    # Each line passes two corners that are next to each other, each side once; bins are a whole pixel and a degree.
    both = torch.maximum(away.abs(), away.roll(-1, -1).abs())
    least, side = both.min(-1)
    assert float(least.max()) < 0.06
    assert bool((side.sort(-1).values == torch.arange(4)).all())
    on_line = (found.ends[:, :4] * found.line[:, :4, None, :2]).sum(-1) + found.line[:, :4, 2:]
    assert float(on_line.abs().max()) < 1e-9
    length = (found.ends[:, :4, 1] - found.ends[:, :4, 0]).norm(dim=-1)
    assert bool(((length > 42) & (length < 52)).all())
    assert bool((found.count.diff() <= 0).all())


@pytest.mark.parametrize("angle", [0.0, math.pi / 2, math.pi, 1e-3, math.pi - 1e-3, -1e-3])
def test_where_angles_begin_there_is_one_line(angle: float) -> None:
    found = hough_lines(half_plane(angle, 3.3), 10)
    assert int(found.valid.sum()) == 1
    line = found.line[0] * torch.sign(found.line[0, :2] @ torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64))
    assert abs(float(torch.atan2(line[1], line[0])) - math.atan2(math.sin(angle), math.cos(angle))) % (2 * math.pi) < 1e-3
    assert abs(float(line[:2].sum() * 31.5 + line[2]) + 3.3) < 0.02


def test_a_broken_line_is_one_line_and_its_longest_part() -> None:
    image = half_plane(math.pi / 2, 0.2)
    image[:, :, 12:32] = 0.5  # twenty columns without the edge
    found, whole = (hough_lines(image, 9, max_gap=gap) for gap in (4.0, 30.0))
    # The sides of what was cut out are lines, too.
    slot = int((found.line[:, 1].abs() * found.valid).argmax())
    assert int(found.count[slot]) > 30
    x = found.ends[slot, :, 0].sort().values
    assert float(x[0]) > 24
    assert float(x[1]) > 57
    x = whole.ends[slot, :, 0].sort().values
    assert float(x[1] - x[0]) > 50


def test_round_and_flat_images_have_no_lines() -> None:
    image = torch.stack((disc(31, 32, 24), torch.full((1, 64, 64), 0.4), torch.full((1, 64, 64), torch.nan)))
    found = hough_lines(image, 8)
    assert not bool(found.valid.any())
    for name in NAMES:
        assert bool(getattr(found, name).isfinite().all())


@pytest.mark.parametrize("shape", [(), (1,), (2, 2), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    images = squares(max(1, math.prod(shape)), 64, 26.0)[0][: math.prod(shape)].reshape(*shape, 1, 64, 64).to(dtype)
    found = hough_lines(images, 6, min_count=20)
    assert found.line.shape == (*shape, 6, 3)
    assert found.ends.shape == (*shape, 6, 2, 2)
    assert found.line.dtype == dtype
    for index in np.ndindex(*shape):
        alone = hough_lines(images[index], 6, min_count=20)
        assert int(alone.valid.sum()) == 4
        assert torch.equal(found.valid[index], alone.valid)
        assert torch.equal(found.count[index], alone.count)
        torch.testing.assert_close(found.line[index], alone.line)
        torch.testing.assert_close(found.ends[index], alone.ends)


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    for name, wrong in {"max_lines": 0, "min_count": 1, "max_gap": 0.0, "blur": -1.0}.items():
        with pytest.raises(ValueError, match=name):
            hough_lines(torch.zeros(1, 40, 40), **{name: wrong})
