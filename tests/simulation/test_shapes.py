import math

import pytest
import torch

from torchsfm.geometry import Ellipse
from torchsfm.simulation import paint_shapes, render_shapes

F64 = torch.float64


def test_areas_and_middles_are_those_of_the_shapes() -> None:
    shape = Ellipse(torch.tensor([31.3, 24.6], dtype=F64), torch.tensor([17.0, 9.0], dtype=F64), torch.tensor(0.7, dtype=F64))
    corners = torch.tensor([[40.2, 3.0], [60.0, 8.5], [52.0, 20.0]], dtype=F64)
    for thing, area, middle in (
        (shape, math.pi * 17 * 9, shape.centre),
        (corners, float(torch.linalg.det(corners[1:] - corners[0])) / 2, corners.mean(0)),
    ):
        image = paint_shapes([thing], torch.tensor([0.0, 1.0], dtype=F64), width=64, height=48)[0]
        assert float(image.sum()) == pytest.approx(area, rel=1e-3)
        y, x = torch.meshgrid(torch.arange(48.0, dtype=F64), torch.arange(64.0, dtype=F64), indexing="ij")
        centroid = torch.stack(((x * image).sum(), (y * image).sum())) / image.sum()
        assert float((centroid - middle).abs().max()) < 2e-3


def test_what_is_seen_is_what_differs_from_its_surroundings(generator: torch.Generator) -> None:
    """Just inside and just outside of outlines that are seen whole the image has two values."""
    scene = render_shapes(
        (2, 3), ellipses=5, rings=2, polygons=2, noise=0.0, width=200, height=160, radius=(10.0, 40.0), generator=generator
    )
    assert scene.images.shape == (2, 3, 1, 160, 200)
    assert scene.polygons.shape == (2, 3, 2, 4, 2)
    assert bool(((scene.ellipses_seen >= 0) & (scene.ellipses_seen <= 1)).all())
    assert bool((scene.ellipses.centre[..., -2:, :] == scene.ellipses.centre[..., :2, :]).all())
    steps = []
    for shift in (-4.0, 4.0):
        moved = Ellipse(scene.ellipses.centre, scene.ellipses.semi_axes + shift, scene.ellipses.angle)
        x = moved.points(torch.arange(24, dtype=F64) * (math.pi / 12)).round().long()
        inside = ((x >= 0) & (x < x.new_tensor([200, 160]))).all(-1)
        column, row = x[..., 0].clamp(0, 199), x[..., 1].clamp(0, 159)
        value = scene.images[..., 0, :, :].flatten(-2)[..., None, :].expand(2, 3, 5, -1).gather(-1, row * 200 + column)
        steps.append(torch.where(inside, value, torch.nan))
    # Something else may begin within four pixels: most places tell.
    differ = ((steps[0] - steps[1]).abs() > 0.05).double().mean(-1)
    assert float(differ[scene.ellipses_seen == 1].min()) > 0.6
    sides = scene.polygons.roll(-1, -2) - scene.polygons
    turn = sides[..., 0] * sides.roll(-1, -2)[..., 1] - sides[..., 1] * sides.roll(-1, -2)[..., 0]
    assert bool((turn > 0).all())


def test_the_same_stream_gives_the_same_scenes(generator: torch.Generator) -> None:
    state = generator.get_state()
    one = render_shapes((), width=64, height=48, generator=generator)
    generator.set_state(state)
    two = render_shapes((), width=64, height=48, generator=generator)
    assert torch.equal(one.images, two.images)
    assert torch.equal(one.sides_seen, two.sides_seen)


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    for name, wrong in {"ellipses": -1, "rings": 9, "corners": 2, "radius": (0.0, 1.0), "levels": 1, "blur": 0.0}.items():
        with pytest.raises(ValueError, match=name):
            render_shapes((), **{name: wrong})
    with pytest.raises(ValueError, match="levels"):
        paint_shapes([], torch.zeros(3), width=8, height=8)


def test_shapes_that_are_nowhere_cover_nothing() -> None:
    square = torch.tensor([[2.0, 2.0], [6.0, 2.0], [6.0, 6.0], [2.0, 6.0]])
    levels = torch.tensor([0.2, 0.9])
    for wrong in (torch.nan, torch.inf, -torch.inf, 1e30):
        corners = square.clone()
        corners[1, 0] = wrong
        image = paint_shapes([corners], levels, width=8, height=8)
        assert bool(image.isfinite().all())
        assert wrong > 0 or bool((image <= 0.9 + 1e-6).all())
    far = paint_shapes([square + 1e3, square - 1e3], torch.tensor([0.2, 0.9, 0.9]), width=8, height=8)
    torch.testing.assert_close(far, torch.full_like(far, 0.2))
