import math

import numpy as np
import pytest
import torch
from chance import assert_share, numpy_seeded
from painting import disc, half_plane, polygon
from scipy.stats import chi2
from torch import Tensor

from torchsfm.geometry import line_from_points
from torchsfm.images import Segments, detect_edges, detect_segments
from torchsfm.images.step_fit import fit_steps
from torchsfm.images.straight_runs import axis, moments, straight_runs

NAMES = ("ends", "support", "line", "length", "count", "scatter", "sigma", "independent", "contrast", "log_nfa", "valid")


def squares(count: int, size: int = 96, side: float = 36.0) -> tuple[Tensor, Tensor]:
    """Images of turned squares and their corners, in the order in which x turns to y."""
    rng = numpy_seeded()
    angle = torch.tensor(rng.uniform(0, 2 * math.pi, count))[:, None] + torch.arange(4) * math.pi / 2
    centre = (size - 1) / 2 + torch.tensor(rng.uniform(-3, 3, (count, 1, 2)))
    corners = centre + side * torch.stack((angle.cos(), angle.sin()), -1)
    return torch.stack([polygon(c, size) for c in corners]), corners


def errors(segments: Segments, corners: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of the four longest: angle in degrees, offset of the middle, what is missing at the ends, and which side it is."""
    ends, q = segments.ends[..., :4, :, :], corners.roll(-1, -2)
    # A bright square is walked around from y to x: the bright side is on the left on the screen.
    along = torch.nn.functional.normalize(corners - q, dim=-1)
    normal = torch.stack((along[..., 1], -along[..., 0]), -1)
    d = torch.nn.functional.normalize(ends[..., 1, :] - ends[..., 0, :], dim=-1)
    side = (d[..., :, None, :] * along[..., None, :, :]).sum(-1).argmax(-1)
    p, along, normal = (v.gather(-2, side[..., None].expand(*side.shape, 2)) for v in (corners, along, normal))
    cross = d[..., 0] * along[..., 1] - d[..., 1] * along[..., 0]
    offset = ((ends.mean(-2) - p) * normal).sum(-1)
    missing = (corners - q).norm(dim=-1).gather(-1, side) - segments.length[..., :4]
    return torch.rad2deg(torch.asin(cross)).abs(), offset.abs(), missing, side


def test_sides_of_squares_are_found_in_place() -> None:
    image, corners = squares(8)
    segments = detect_segments(image, 20)
    assert bool((segments.valid.sum(-1) == 4).all())
    angle, offset, missing, side = errors(segments, corners)
    assert bool((side.sort(-1).values == torch.arange(4)).all())
    assert float(angle.max()) < 0.015
    assert float(offset.max()) < 0.005
    assert float(missing.max()) < 6.5
    assert float(missing.min()) > 0
    line = line_from_points(segments.ends[..., 0, :], segments.ends[..., 1, :])
    torch.testing.assert_close(line[segments.valid], segments.line[segments.valid])
    assert bool((segments.contrast[segments.valid] > 0.1).all())
    assert bool((segments.log_nfa[segments.valid] < 0).all())


def test_what_is_said_of_the_noise_is_so(generator: torch.Generator) -> None:
    """Distances of the true line from both points of the fit, over their deviations."""
    noise, angle, offset = 0.02, 0.7, 0.3
    image = half_plane(angle, offset).expand(100, 1, 64, 64)
    image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
    segments = detect_segments(image, 5, noise=noise, high=0.1)
    assert bool(segments.valid[:, 0].all())
    points, weights = segments.fit_points()
    away = (points[:, 0] - 31.5) @ torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64) - offset
    score = away.square() * weights[:, :1]
    # The count of independent points is an approximation; a factor of two would show.
    assert 0.5 < float(score.mean()) < 1.6
    assert bool((weights[~segments.valid] == 0).all())


def test_noise_moves_sides_little_more_than_it_must(generator: torch.Generator) -> None:
    """Against the Cramer-Rao bound of a whole side; near corners, whose points do not count, edge points alone have 1.75."""
    noise, side, blur = 0.02, 36 * math.sqrt(2), math.sqrt(0.6**2 + 1 / 12)
    image, corners = squares(60)
    image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
    angle, offset, _, _ = errors(detect_segments(image, 20), corners)
    # Pixels tell of a shift of a step of 1 by the square of its slope.
    information = 1 / (2 * math.sqrt(math.pi) * blur * noise**2)
    least = torch.rad2deg(torch.tensor(12 / (side**3 * information)).sqrt())
    assert float((angle / least).square().mean()) < 2.4
    assert float(offset.square().mean()) * side * information < 2.0


def test_steps_are_where_they_were_painted(generator: torch.Generator) -> None:
    """Distances of the true line from both points of the fit, over their deviations; not where there is more than a step."""
    noise, angle, offset = 0.02, 0.7, 0.3
    normal = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    middle, along = 31.5 + offset * normal, 20 * torch.tensor([-normal[1], normal[0]])
    ends = torch.stack((middle - along, middle + along))
    # The bright side is to the left on the screen.
    ends = (ends + 0.2 * normal).expand(200, 2, 2)
    image = half_plane(angle, offset)
    noisy = image + noise * torch.randn((200, 64, 64), generator=generator, dtype=image.dtype)
    level, spread = torch.full((200,), noise, dtype=image.dtype), torch.full((200,), 1.0, dtype=image.dtype)
    found = fit_steps(noisy, level, torch.arange(200), ends, spread)
    assert_share(found.good, 0.99)
    half = found.half[:, None] * found.direction
    points = torch.stack((found.middle - half, found.middle + half), 1)
    score = ((points - 31.5) @ normal - offset).square() / found.variance[:, None]
    assert chi2.ppf(1e-6, 400) < float(score[found.good].sum()) * 200 / int(found.good.sum()) < chi2.ppf(1 - 1e-6, 400) * 1.1
    # Another edge two pixels beside it.
    bar = noisy - half_plane(angle, offset + 2)
    assert not bool(fit_steps(bar, level, torch.arange(200), ends, spread).good.any())
    assert not bool(fit_steps(-noisy, level, torch.arange(200), ends, spread).good.any())
    none = fit_steps(noisy * torch.nan, level, torch.arange(200), ends, spread)
    assert not bool(none.good.any())
    assert all(bool(v.isfinite().all()) for v in none)


@pytest.mark.parametrize(("width", "contrast"), [(4.0, 0.8), (6.0, 0.2)])
def test_bars_keep_their_width(generator: torch.Generator, width: float, contrast: float) -> None:
    """By edge points bars of 4 px are 0.11 px too wide; one step alone would be drawn to the other where noise hides that."""
    angle = 0.4
    image = contrast * (half_plane(angle, -width / 2) - half_plane(angle, width / 2))
    image = image + 0.02 * torch.randn((60, 1, 64, 64), generator=generator, dtype=image.dtype)
    ends = detect_segments(image, 2).ends
    normal = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    outward = ((ends.mean(-2) - 31.5) @ normal).abs() - width / 2
    assert abs(float(outward.median())) < 0.025
    assert float(outward.std()) < 0.06


def test_what_is_bent_is_no_segment(generator: torch.Generator) -> None:
    assert int(detect_segments(disc(31, 32, 20), 50).valid.sum()) == 0
    image = 0.5 + 0.1 * torch.randn(4, 1, 128, 128, generator=generator, dtype=torch.float64)
    assert int(detect_segments(image, 50).valid.sum()) <= 1


def test_runs_are_cut_at_corners(generator: torch.Generator) -> None:
    t = torch.arange(40.0, dtype=torch.float64)[:, None]
    x = torch.cat((t * torch.tensor([1.0, 0.2]), 39 * torch.tensor([1.0, 0.2]) + (t + 1) * torch.tensor([-0.3, 1.0])))
    x = x + 0.02 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    ring = torch.stack((torch.cos(t / 40 * 2 * math.pi), torch.sin(t / 40 * 2 * math.pi)), -1)[:, 0] * 8
    x = torch.cat((x, ring))
    chain = torch.tensor([0] * 80 + [1] * 40)
    runs = straight_runs(x, torch.full((120,), 0.02**2), chain, chain == 1, 0.15)
    assert len(set(runs.number[:38].tolist())) == len(set(runs.number[45:80].tolist())) == 1
    assert int(runs.number[0]) != int(runs.number[79])
    assert runs.number[80:].unique().numel() >= 4
    assert not set(runs.number[:80].tolist()) & set(runs.number[80:].tolist())
    # The sums are those of the points.
    torch.testing.assert_close(moments(x, runs.number, len(runs.sums)), runs.sums)
    middle, direction, square = axis(runs.sums[runs.number[:1]])
    mine = x[runs.number == runs.number[0]]
    values, vectors = torch.linalg.eigh((mine - mine.mean(0)).T @ (mine - mine.mean(0)))
    torch.testing.assert_close(square[0], values[0])
    assert float((direction[0] * vectors[:, 1]).sum().abs()) > 1 - 1e-12
    torch.testing.assert_close(middle[0], mine.mean(0))


def test_a_ring_has_no_beginning() -> None:
    """A side in whose middle the chain of a square starts is one segment, wherever that is."""
    corners = torch.tensor([[20.0, 20], [76, 20], [76, 76], [20, 76]])
    image = polygon(corners, 96)
    edges = detect_edges(image, 1000)
    assert bool(edges.closed[edges.valid].all())
    segments = detect_segments(image, 20)
    assert int(segments.valid.sum()) == 4
    assert float(segments.length[:4].min()) > 48


@pytest.mark.parametrize("shape", [(), (1,), (2, 2), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    images = squares(max(1, math.prod(shape)), 64, 22.0)[0]
    images = images[: math.prod(shape)].reshape(*shape, 1, 64, 64)
    images = (images + 0.01 * torch.randn(images.shape, generator=generator)).to(dtype)
    segments = detect_segments(images, 7)
    assert segments.ends.shape == (*shape, 7, 2, 2)
    assert segments.ends.dtype == segments.sigma.dtype == dtype
    for index in np.ndindex(*shape):
        alone = detect_segments(images[index], 7)
        assert int(alone.valid.sum()) >= 4
        for name in NAMES:
            assert torch.equal(getattr(segments, name)[index], getattr(alone, name))
    assert bool((segments.length.diff() <= 0).all())


def test_one_image_is_looked_at_through_several_masks(generator: torch.Generator) -> None:
    image = squares(1, 64, 22.0)[0][0]
    masks = torch.ones(2, 64, 64, dtype=torch.bool)
    masks[1, :, 32:] = False
    segments = detect_segments(image, 6, mask=masks)
    for number, mask in enumerate(masks):
        alone = detect_segments(image, 6, mask=mask)
        for name in NAMES:
            assert torch.equal(getattr(segments, name)[number], getattr(alone, name))
    assert segments.valid.sum(-1)[0] > segments.valid.sum(-1)[1] > 0


def test_flat_and_broken_images_have_none_and_spoil_none() -> None:
    image = squares(3, 64, 22.0)[0]
    good = detect_segments(image, 6)
    bad = image.clone()
    bad[1], bad[2] = 0.4, torch.nan
    found = detect_segments(bad, 6)
    assert found.valid.any(-1).tolist() == [True, False, False]
    for name in NAMES:
        assert torch.equal(getattr(found, name)[0], getattr(good, name)[0])
        assert bool(getattr(found, name).isfinite().all())


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image = torch.zeros(1, 40, 40)
    for name, wrong in {"max_segments": 0, "min_length": 0.0, "tolerance": -1.0, "blur": 0.0, "noise": -1.0}.items():
        with pytest.raises(ValueError, match=name):
            detect_segments(image, **{name: wrong})
