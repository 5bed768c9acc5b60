"""Textures: in range, rich at every scale, repeatable, and halved without a change of mean."""

import pytest
import torch
from chance import seeded

from torchsfm.simulation.patterns import fractal_noise
from torchsfm.simulation.textures import STYLES, mip_pyramid, paint


@pytest.mark.parametrize("style", sorted(STYLES))
def test_every_style_is_a_rich_repeatable_picture(style: str) -> None:
    first, again, other = (paint(style, 1.2, 0.9, texel=0.006, generator=seeded(s)) for s in (3, 3, 4))
    assert first.shape == (3, 150, 200)
    assert first.min() >= 0
    assert first.max() <= 1
    assert torch.equal(first, again)
    assert (first - other).abs().mean() > 0.02
    gray = first.mean(0)
    # Detail at the scale of one, four and sixteen texels: something for a feature detector on every octave.
    for scale in (1, 4, 16):
        small = torch.nn.functional.avg_pool2d(gray[None, None], scale)[0, 0] if scale > 1 else gray
        assert (small[:, 1:] - small[:, :-1]).square().mean().sqrt() > 0.012


@pytest.mark.parametrize("style", sorted(STYLES))
def test_every_style_is_the_same_under_another_default_dtype(style: str) -> None:
    plain = paint(style, 0.5, 0.4, texel=0.006, generator=seeded(3))
    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(paint(style, 0.5, 0.4, texel=0.006, generator=seeded(3)), plain)
    finally:
        torch.set_default_dtype(usual)


def test_a_texture_does_not_repeat(generator: torch.Generator) -> None:
    gray = paint("ground", 4.0, 4.0, texel=0.02, generator=generator).mean(0)
    gray = gray - torch.nn.functional.avg_pool2d(gray[None, None], 15, 1, 7, count_include_pad=False)[0, 0]
    patch = gray[80:112, 80:112]
    windows = gray.unfold(0, 32, 2).unfold(1, 32, 2)
    energy = windows.square().sum((-1, -2)).sqrt() * patch.norm()
    correlation = (windows * patch).sum((-1, -2)) / energy
    assert correlation.max() > 0.999
    correlation[40 - 8 : 40 + 9, 40 - 8 : 40 + 9] = 0
    assert correlation.max() < 0.6


def test_noise_has_about_unit_deviation(generator: torch.Generator) -> None:
    noise = fractal_noise(400, 500, 20.0, generator=generator)
    assert 0.6 < noise.std() < 1.6
    assert noise.mean().abs() < 0.2


def test_mip_levels_keep_the_mean(generator: torch.Generator) -> None:
    image = torch.rand(3, 64, 96, generator=generator)
    levels = mip_pyramid(image)
    assert [tuple(level.shape[1:]) for level in levels] == [(64, 96), (32, 48), (16, 24), (8, 12), (4, 6)]
    for level in levels:
        assert torch.allclose(level.mean((1, 2)), image.mean((1, 2)), atol=1e-6)


def test_odd_sizes_lose_no_texel() -> None:
    image = torch.zeros(3, 33, 17)
    image[:, -1, -1] = 1
    assert (mip_pyramid(image)[1][:, -1, -1] == 1).all()


def test_wrong_options() -> None:
    with pytest.raises(ValueError, match="style: wanted one of"):
        paint("tartan", 1.0, 1.0)
    with pytest.raises(ValueError, match="positive sizes"):
        paint("wood", 0.0, 1.0)
