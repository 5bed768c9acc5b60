"""Uniform bars beside pictures, and what only looks like one."""

import torch
from torch import Tensor

from torchsfm.images.bars import picture_in_bars


def picture(generator: torch.Generator, height: int = 60, width: int = 80) -> Tensor:
    """A picture that differs from its bars nearly everywhere."""
    return 0.3 + 0.7 * torch.rand(3, height, width, generator=generator)


def test_bars_of_all_sides(generator: torch.Generator) -> None:
    inside = picture(generator)
    assert picture_in_bars(inside) == (slice(0, 60), slice(0, 80))
    for top, bottom, left, right in ((10, 10, 0, 0), (0, 0, 12, 9), (7, 8, 9, 10), (0, 15, 0, 0)):
        whole = torch.nn.functional.pad(inside, (left, right, top, bottom), value=0.04)
        # What compression leaves.
        whole = whole + 0.01 * (2 * torch.rand(whole.shape, generator=generator) - 1)
        assert picture_in_bars(whole) == (slice(top, top + 60), slice(left, left + 80))
        assert picture_in_bars(1 - whole) == (slice(top, top + 60), slice(left, left + 80))


def test_sky_and_background_are_no_bars(generator: torch.Generator) -> None:
    whole = slice(0, 60), slice(0, 80)
    sky = picture(generator)
    sky[:, :20] = 0.9 - 0.02 * torch.linspace(0, 10, 20)[:, None]
    assert picture_in_bars(sky) == whole
    thing = torch.zeros(3, 60, 80)
    thing[:, 12:50, 30:52] = picture(generator, 38, 22)
    assert picture_in_bars(thing) == whole
    assert picture_in_bars(torch.zeros(3, 60, 80)) == whole
    assert picture_in_bars(picture(generator, 8, 8)) == (slice(0, 8), slice(0, 8))
