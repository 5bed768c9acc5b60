import math

import numpy as np
import pytest
import torch
from chance import assert_share, numpy_seeded
from painting import disc
from torch import Tensor

from torchsfm.geometry import Ellipse
from torchsfm.images import Ellipses, detect_ellipses
from torchsfm.simulation import paint_shapes, render_shapes

NUMBERS = ("covariance", "count", "coverage", "scatter", "contrast", "log_nfa", "valid")
SHAPE = ("centre", "semi_axes", "angle")


def ellipse(centre: tuple[float, float], axes: tuple[float, float], angle: float = 0.0) -> Ellipse:
    return Ellipse(*(torch.tensor(v, dtype=torch.float64) for v in (centre, axes, angle)))


def paint(shapes: list[Ellipse | Tensor], levels: list[float], width: int = 160, height: int = 120) -> Tensor:
    return paint_shapes(shapes, torch.tensor(levels, dtype=torch.float64), width=width, height=height, fine=4)


def nearest(found: Ellipses, true: Ellipse) -> tuple[Tensor, Tensor]:
    """Error of centre and semi-axes together, in pixels, and the slot, of the found one that is nearest to each true one."""
    parts = [
        (getattr(found.ellipse, name)[..., None, :, :] - getattr(true, name)[..., :, None, :]).abs().amax(-1)
        for name in SHAPE[:2]
    ]
    error = torch.where(found.valid[..., None, :], torch.maximum(*parts), torch.inf)
    return error.min(-1)


def test_whole_ellipses_are_found_in_place() -> None:
    scene = render_shapes((6,), ellipses=3, polygons=0, radius=(10.0, 30.0), width=160, height=120, noise=0.005)
    found = detect_ellipses(scene.images)
    error, slot = nearest(found, scene.ellipses)
    whole = scene.ellipses_seen == 1
    assert int(whole.sum()) >= 3
    assert float(error[whole].max()) < 0.15
    assert float(error[whole].median()) < 0.03
    assert bool((found.coverage.gather(-1, slot)[whole] > 0.9).all())
    assert bool((found.log_nfa[found.valid] <= 0).all())
    # What is seen in part is found too, but nothing that is not there.
    off = (found.ellipse.centre[..., :, None, :] - scene.ellipses.centre[..., None, :, :]).norm(dim=-1).amin(-1)
    assert_share((off < 0.1 * found.ellipse.semi_axes[..., 0])[found.valid], 0.95)


def test_what_is_said_of_the_noise_is_so(generator: torch.Generator) -> None:
    noise, true = 0.02, ellipse((47.3, 38.6), (28.0, 17.0), 0.5)
    image = paint([true], [0.3, 0.7], 96, 80).expand(80, 1, 80, 96)
    image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
    found = detect_ellipses(image, 2, noise=noise)
    assert bool(found.valid[:, 0].all())
    d = torch.cat([(getattr(found.ellipse, n)[:, 0] - getattr(true, n)).reshape(80, -1) for n in SHAPE], -1)
    score = (d * torch.linalg.solve(found.covariance[:, 0], d)).sum(-1) / 5
    # The count of independent edge points is an approximation; a factor of two would show.
    assert 0.5 < float(score.mean()) < 1.8
    assert bool((found.covariance[:, 1] == 0).all())


def test_smooth_outlines_that_ellipses_only_touch_have_none(generator: torch.Generator) -> None:
    """Half of an outline of two or three lobes may fit an ellipse to a twentieth of a pixel, and goes smoothly on, off it."""
    t = torch.arange(120, dtype=torch.float64) * (2 * math.pi / 120)
    found = 0
    for lobes, bent in ((2, 0.3), (2, 0.32), (3, 0.13), (3, 0.15), (3, 0.17)):
        r = 40 * (1 + bent * (lobes * t).cos())
        outline = torch.stack((90 + 1.2 * r * t.cos(), 70 + r * t.sin()), -1)
        image = paint_shapes([outline], torch.tensor([0.2, 0.8], dtype=torch.float64), width=200, height=140, fine=2)
        image = image + 0.005 * torch.randn(image.shape, generator=generator, dtype=image.dtype)
        found += int(detect_ellipses(image).valid.sum())
    assert found == 0


@pytest.mark.parametrize("degrees", [130, 180, 240])
def test_hidden_ellipses_are_found_by_what_is_seen(degrees: int) -> None:
    rng = numpy_seeded(degrees)
    for _ in range(4):
        turn = rng.uniform(0, 2 * math.pi)
        axes = (rng.uniform(42, 50), rng.uniform(32, 40))
        true = ellipse((79.5 + rng.uniform(-3, 3), 69.5 + rng.uniform(-3, 3)), axes, rng.uniform(-1.5, 1.5))
        # A square whose one side cuts the circle of the parameter at these degrees.
        near, far = math.cos(math.radians(degrees / 2)), 4.0
        corners = torch.tensor([[near, -far], [far, -far], [far, far], [near, far]], dtype=torch.float64)
        c, s = math.cos(turn), math.sin(turn)
        corners = corners @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64) * torch.tensor(axes, dtype=torch.float64)
        c, s = float(true.angle.cos()), float(true.angle.sin())
        corners = true.centre + corners @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
        found = detect_ellipses(paint([true, corners], [0.2, 0.6, 0.9], height=140))
        error, slot = nearest(found, Ellipse(true.centre[None], true.semi_axes[None], true.angle[None]))
        d = torch.cat([(getattr(found.ellipse, name)[slot[0]] - getattr(true, name)).abs() for name in SHAPE[:2]])
        assert float((d / found.covariance[slot[0]].diagonal()[:4].sqrt()).max()) < 5
        assert float(error) < {130: 0.2, 180: 0.8, 240: 5.0}[degrees]
        assert 0.5 * (1 - degrees / 360) < float(found.coverage[slot]) < 1.5 * (1 - degrees / 360)
        assert int(found.valid.sum()) == 1


def test_concentric_and_overlapping_ellipses_are_told_apart() -> None:
    outer, inner = ellipse((60.2, 58.7), (42.0, 30.0), 0.3), ellipse((60.2, 58.7), (35.0, 24.0), 0.3)
    beside = ellipse((105.4, 66.1), (30.0, 26.0), -0.4)
    found = detect_ellipses(paint([outer, inner, beside], [0.2, 0.8, 0.45, 0.95]))
    true = Ellipse(*(torch.stack([getattr(e, name) for e in (outer, inner, beside)]) for name in SHAPE))
    error, slot = nearest(found, true)
    assert float(error.max()) < 0.3
    assert int(found.valid.sum()) == 3
    # The gradient points outwards where the outside is brighter.
    assert (found.contrast[slot] > 0).tolist() == [False, True, False]


def test_small_circles_are_found() -> None:
    rng = numpy_seeded(4)
    for radius in (4.0, 6.0, 9.0):
        cx, cy = 31.5 + rng.uniform(-0.5, 0.5, 2)
        found = detect_ellipses(disc(cx, cy, radius))
        assert int(found.valid.sum()) == 1
        assert float((found.ellipse.semi_axes[0] - radius).abs().max()) < 0.06
        assert float((found.ellipse.centre[0] - torch.tensor([cx, cy])).abs().max()) < 0.02


def test_noise_and_polygons_have_none(generator: torch.Generator) -> None:
    image = 0.5 + 0.1 * torch.randn(4, 1, 128, 128, generator=generator, dtype=torch.float64)
    assert int(detect_ellipses(image).valid.sum()) == 0
    scene = render_shapes((6,), ellipses=0, polygons=6, width=200, height=160, radius=(15.0, 60.0), generator=generator)
    assert int(detect_ellipses(scene.images).valid.sum()) <= 1


@pytest.mark.parametrize("shape", [(), (1,), (3,), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    scene = render_shapes(shape, ellipses=4, polygons=2, width=96, height=72, radius=(8.0, 24.0), generator=generator)
    images = scene.images.to(dtype)
    found = detect_ellipses(images, 6)
    assert found.covariance.shape == (*shape, 6, 5, 5)
    assert found.ellipse.centre.dtype == found.scatter.dtype == dtype
    assert found.count.dtype == torch.long
    for index in np.ndindex(*shape):
        alone = detect_ellipses(images[index], 6)
        assert torch.equal(found.valid[index], alone.valid)
        for name in SHAPE:
            torch.testing.assert_close(getattr(found.ellipse, name)[index], getattr(alone.ellipse, name))
        for name in NUMBERS:
            torch.testing.assert_close(getattr(found, name)[index], getattr(alone, name))
    assert bool((found.count.diff() <= 0).all())
    few = detect_ellipses(images, 1)
    assert torch.equal(few.count, found.count[..., :1])


def test_flat_and_broken_images_have_none_and_spoil_none() -> None:
    image = torch.stack([disc(30.2, 31.7, 14.0)] * 3)
    good = detect_ellipses(image, 3)
    bad = image.clone()
    bad[1], bad[2] = 0.4, torch.nan
    found = detect_ellipses(bad, 3)
    assert found.valid.any(-1).tolist() == [True, False, False]
    for name in NUMBERS:
        values = getattr(found, name)
        torch.testing.assert_close(values[0], getattr(good, name)[0])
        assert bool(values.isfinite().all())
    assert int(detect_ellipses(image[0], mask=torch.zeros(64, 64, dtype=torch.bool)).valid.sum()) == 0


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image = torch.zeros(1, 40, 40)
    wrong = {"max_ellipses": 0, "min_coverage": 1.5, "min_radius": 0.0, "max_scatter": 0.0, "tolerance": -1.0, "noise": -1.0}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=name):
            detect_ellipses(image, **{name: value})
