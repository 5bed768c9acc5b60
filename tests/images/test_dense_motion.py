"""Motion between images: how far things may move, what is hidden, what changes its light, and wrong input."""

import pytest
import torch
from torch import Tensor

from torchsfm.images import DenseMotion, detect_edges, detect_motion, track_curves
from torchsfm.simulation import paint_shapes

F64 = torch.float64
HEIGHT, WIDTH = 220, 320


def texture(generator: torch.Generator, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    """Blurred noise, of all sizes."""
    image = torch.zeros(1, height, width)
    for size in (3, 9, 21):
        noise = torch.randn(1, height + size, width + size, generator=generator)
        soft = torch.nn.functional.avg_pool2d(torch.nn.functional.avg_pool2d(noise, size, 1, size // 2), size, 1, size // 2)
        image += 0.1 * (soft / soft.std())[:, :height, :width]
    return (0.5 + image).clamp(0, 1)


def test_near_and_far_each_move_their_way(generator: torch.Generator) -> None:
    """The middle moves by a fifth of the image, what is behind it the other way by a sixteenth."""
    behind, before = texture(generator), texture(generator, 100, 120)

    def look(i: int) -> Tensor:
        image = behind.roll(-20 * i, -1).clone()
        image[:, 60:160, 50 + 60 * i : 170 + 60 * i] = before
        return image

    (motion,) = detect_motion([look(0), look(1)])
    x = torch.stack(torch.meshgrid(torch.arange(0.0, WIDTH, 4), torch.arange(0.0, HEIGHT, 4), indexing="xy"), -1)
    y, sure = motion.moved(x)
    near = (x[..., 0] >= 50) & (x[..., 0] < 170) & (x[..., 1] >= 60) & (x[..., 1] < 160)
    shift = torch.where(near, 60.0, -20.0)[..., None] * torch.tensor([1.0, 0.0])
    good = sure & ((y - x - shift).norm(dim=-1) < 1.5)
    hidden = ~near & (x[..., 0] >= 130) & (x[..., 0] < 250) & (x[..., 1] >= 60) & (x[..., 1] < 160) | (x[..., 0] < 20)
    assert good.sum() > 0.9 * sure.sum()
    assert good[near].float().mean() > 0.7
    assert good[~near & ~hidden].float().mean() > 0.7
    back, returned = motion.moved(y[good], back=True)
    assert (back - x[good])[returned].norm(dim=-1).median() < 1.0


def test_flat_images_and_others_move_nowhere_surely(generator: torch.Generator) -> None:
    (motion,) = detect_motion([texture(generator), texture(generator)])
    assert motion.sure.float().mean() < 0.3
    for size in ((1, 1), (8, 20), (31, 50)):
        (small,) = detect_motion([torch.rand(1, *size, generator=generator)] * 2)
        assert not small.sure.any()
        assert not small.moved(torch.tensor([[0.0, 0.0]]))[1].any()
    assert detect_motion([]) == []
    assert detect_motion([texture(generator)]) == []


def test_places_beyond_the_image_are_not_sure(generator: torch.Generator) -> None:
    image = texture(generator)
    (motion,) = detect_motion([image, image])
    bad = torch.tensor([[-9.0, 5.0], [5.0, 1e9], [torch.nan, 3.0], [torch.inf, 3.0]])
    y, sure = motion.moved(bad)
    assert not sure.any()
    assert torch.equal(y[:2], bad[:2])
    assert motion.moved(torch.tensor([50.0, 50.0], dtype=F64))[0].dtype == F64


def test_wrong_input(generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match="one size"):
        detect_motion([torch.rand(1, 40, 40), torch.rand(1, 40, 41)])
    edges = detect_edges(torch.zeros(3, 1, 40, 40))
    none = DenseMotion(torch.zeros(2, 20, 20, 2), torch.zeros(2, 20, 20, dtype=torch.bool))
    with pytest.raises(ValueError, match="motion: wanted one for each"):
        track_curves(edges, motion=[none])


def test_like_curves_in_a_row_are_told_apart(generator: torch.Generator) -> None:
    """Discs 40 pixels apart move by 45: those next to where they were are others."""
    v, ground = 3, texture(generator, 100, 400)
    at = 30.0 + 40.0 * torch.arange(9, dtype=F64)
    grey = torch.tensor([0.0, *([1.0] * 9)], dtype=F64)
    frames = []
    for i in range(v):
        discs = [torch.stack((x + 13 * c.cos(), 50 + 13 * c.sin()), -1) for x in at + 45.0 * i for c in [circle()]]
        inside = paint_shapes(discs, grey, width=400, height=100).float()
        moved = ground.roll(45 * i, -1)
        frames.append(0.25 * moved + 0.5 * inside)
    images = torch.stack(frames)
    edges = detect_edges(images)
    motion = detect_motion(images)

    def moves(**options: object) -> Tensor:
        curves = track_curves(edges, reach=16.0, min_length=60.0, **options).curves
        round_ones = curves.closed.all(0)
        middle = curves.x[:, round_ones].mean(-2)
        return middle.diff(dim=0)[..., 0]

    found = moves(motion=motion)
    assert found.shape[1] >= 4
    assert (found - 45).abs().max() < 2.0
    alone = moves()
    assert alone.numel() == 0 or (alone - 45).abs().min() > 20.0


def circle() -> Tensor:
    return torch.arange(64, dtype=F64) * (2 * torch.pi / 64)
