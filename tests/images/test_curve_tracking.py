"""Curves through sequences: which is which, however chains are broken; how near to the truth; what is lost; wrong input."""

import math

import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm.geometry import Ellipse, curve_from_samples, foot_points
from torchsfm.images import Edges, detect_edges, track_curves
from torchsfm.simulation import paint_shapes

F64 = torch.float64


def moving_rings(v: int, c: int, generator: torch.Generator) -> Tensor:
    """Bent rings of a thousand points in images that turn, stretch and shift a little from one to the next, (v, c, n, 2)."""
    t = torch.arange(1000, dtype=F64) * (2 * math.pi / 1000)
    waves = torch.stack([w for k in (1, 2, 3) for w in ((k * t).cos() / k**2, (k * t).sin() / k**2)], -1)
    bends = 0.4 * torch.randn(c, 6, 2, generator=generator, dtype=F64)
    bends[:, :2] = torch.eye(2, dtype=F64) + 0.3 * bends[:, :2]
    cell = torch.stack((torch.arange(c) % 3, torch.arange(c) // 3), -1).to(F64)
    rings = (30 * waves @ bends + (90 + 130 * cell)[:, None]).expand(v, c, 1000, 2)
    maps = torch.eye(2, dtype=F64) + 0.03 * torch.randn(v, c, 2, 2, generator=generator, dtype=F64)
    centre = rings.mean(-2, keepdim=True)
    drift = torch.arange(v, dtype=F64)[:, None, None] * torch.tensor([7.0, -4.0], dtype=F64)
    shift = drift + torch.randn(v, c, 2, generator=generator, dtype=F64)
    return (rings - centre) @ maps.mT + centre + shift[:, :, None]


def edges_of(rings: Tensor, runs: list[list[tuple[int, int, int]]]) -> Edges:
    """Edge points about a pixel apart: of each image its runs (ring, first point, number), as chains."""
    images = []
    for x, image in zip(rings, runs, strict=True):
        parts = []
        for chain, (k, first, number) in enumerate(image):
            index = (first + torch.arange(0, number, 5)) % x.shape[1]
            tangent = x[k, (index + 1) % x.shape[1]] - x[k, index - 1]
            gradient = torch.stack((tangent[:, 1], -tangent[:, 0]), -1)
            gradient = 0.2 * gradient / gradient.norm(dim=-1, keepdim=True)
            closed = torch.full((len(index),), float(number == x.shape[1]), dtype=F64)
            labels = torch.stack((torch.full_like(closed, chain), closed), -1)
            parts.append(torch.cat((x[k, index], gradient, labels), -1))
        images.append(torch.cat(parts))
    n = max(len(image) for image in images)
    table = torch.stack([torch.cat((image, image.new_full((n - len(image), 6), -1.0))) for image in images])
    valid = table[..., 4] >= 0
    one = torch.ones_like(table[..., 0])
    return Edges(
        torch.where(valid[..., None], table[..., :2], 0), torch.where(valid[..., None], table[..., 2:4], 0), 0.02 * one, one,
        0 * one, table[..., 4].long(), valid & (table[..., 5] > 0), valid, one[:, 0], valid.sum(-1) * 0,
    )  # fmt: skip


def nearest_rings(x: Tensor, rings: Tensor) -> tuple[Tensor, Tensor]:
    """Which ring the samples of each curve are on, and how far they are from it, root mean square."""
    feet = foot_points(curve_from_samples(rings[:, ::10], closed=True), x[:, None])
    rms = (feet.x - x[:, None]).square().sum(-1).mean(-1).sqrt()
    return rms.argmin(-1), rms.amin(-1)


def test_whole_rings(generator: torch.Generator) -> None:
    """All are found in all images, and begin at about the same point."""
    v, c = 5, 6
    rings = moving_rings(v, c, generator)
    runs = [
        [
            (k, int(torch.randint(1000, (1,), generator=generator)), 1000)
            for k in torch.randperm(c, generator=generator).tolist()
        ]
        for _ in range(v)
    ]
    found = track_curves(edges_of(rings, runs))
    assert found.chain.shape == (v, c)
    assert found.curves.closed.all()
    expected = torch.tensor([[run[0] for run in image] for image in runs])
    ring = expected.gather(1, found.chain)
    assert (ring == ring[:1]).all()
    for i in range(v):
        for k in range(c):
            x = found.curves.x[i, k][found.curves.valid[i, k]]
            index, rms = nearest_rings(x[None], rings[i])
            assert index == ring[i, k]
            assert rms < 0.1
    place = torch.stack([torch.cdist(found.curves.x[i, :, :1], rings[i, ring[i]])[:, 0].argmin(-1) for i in range(v)])
    apart = (place - place[v // 2] + 500) % 1000 - 500
    assert_share(apart.abs() < 60, 0.95)


def test_chains_that_break_anywhere(generator: torch.Generator) -> None:
    """What all images show of a ring in one run is followed, by the same way and to about the same ends."""
    v, c = 5, 6
    rings = moving_rings(v, c, generator)
    runs = []
    for _ in range(v):
        first = torch.randint(150, (c,), generator=generator).tolist()
        number = torch.randint(500, 650, (c,), generator=generator).tolist()
        image = [(k, first[k], number[k]) for k in range(c)]
        image += [(k, (first[k] + number[k] + 20) % 1000, 960 - number[k]) for k in range(c)]
        runs.append([image[j] for j in torch.randperm(2 * c, generator=generator).tolist()])
    found = track_curves(edges_of(rings, runs))
    assert (found.chain >= 0).any()
    assert not found.curves.closed.any()
    told, ends = [], []
    for k in range(found.chain.shape[1]):
        shown = (found.chain[:, k] >= 0).nonzero()[:, 0].tolist()
        ring = torch.tensor([runs[i][int(found.chain[i, k])][0] for i in shown])
        told.append(bool((ring == ring[0]).all()))
        if len(shown) < v:
            continue
        for side in (0, -1):
            x = torch.stack([found.curves.x[i, k][found.curves.valid[i, k]][side] for i in shown])
            place = (x[:, None] - rings[shown, ring]).norm(dim=-1).argmin(-1)
            ends.append(bool(((place - place[0] + 500) % 1000 - 500).abs().max() < 80))
    assert_share(torch.tensor(told), 0.95)
    assert len(ends) >= c
    assert_share(torch.tensor(ends), 0.8)


def test_from_pixels(generator: torch.Generator) -> None:
    """Ellipses that move a few pixels, one of which leaves: outlines to a tenth of a pixel."""
    centre = torch.tensor([[40.0, 40.0], [110.0, 45.0], [70.0, 95.0]])
    axes = torch.tensor([[22.0, 14.0], [18.0, 17.0], [26.0, 12.0]])
    shapes, images = [], []
    for i in range(4):
        move = torch.tensor([3.0 * i, -2.0 * i]) + torch.rand(3, 2, generator=generator)
        moved = Ellipse(centre + move, axes * (1 + 0.02 * i), torch.tensor([0.3, 0.0, 1.0]) + 0.03 * i)
        each = [Ellipse(moved.centre[k], moved.semi_axes[k], moved.angle[k]) for k in range(3 if i < 3 else 2)]
        shapes.append(each)
        images.append(paint_shapes(each, torch.tensor([0.3, 0.9, 0.7, 0.05])[: len(each) + 1], width=170, height=130))
    found = track_curves(detect_edges(torch.stack(images)))
    assert (found.chain >= 0).sum(0).tolist() == [4, 4, 3]
    assert (found.chain[3] >= 0).tolist() == [True, True, False]
    for i, k in (found.chain >= 0).nonzero().tolist():
        x = found.curves.x[i, k][found.curves.valid[i, k]]
        gap = []
        for shape in shapes[i]:
            c, s = shape.angle.cos(), shape.angle.sin()
            z = (x - shape.centre) @ torch.stack((torch.stack((c, -s)), torch.stack((s, c)))) / shape.semi_axes
            gap.append(((z.norm(dim=-1) - 1) * shape.semi_axes.amin()).abs().max())
        assert torch.stack(gap).min() < 0.15


def test_an_image_without_edges_ends_what_is_followed() -> None:
    disc = Ellipse(torch.tensor([40.0, 30.0]), torch.tensor([16.0, 12.0]), torch.tensor(0.2))
    image = paint_shapes([disc], torch.tensor([0.2, 0.9]), width=80, height=60)
    empty = torch.full_like(image, 0.2)
    found = track_curves(detect_edges(torch.stack((empty, image, image, image, empty, image))))
    assert (found.chain[:, 0] >= 0).tolist() == [False, True, True, True, False, False]
    assert (found.curves.number[:, 0] > 0).tolist() == [False, True, True, True, False, False]


def test_no_edges() -> None:
    found = track_curves(detect_edges(torch.zeros(3, 1, 20, 30)))
    assert found.chain.shape == (3, 0)
    assert found.curves.x.shape[:2] == (3, 0)
    assert track_curves(detect_edges(torch.zeros(0, 1, 20, 30))).chain.shape == (0, 0)


def test_an_edge_point_far_beyond_any_image_is_none() -> None:
    place = Ellipse(torch.tensor([24.0, 22.0]), torch.tensor([11.0, 8.0]), torch.tensor(0.3))
    image = paint_shapes([place], torch.tensor([0.2, 0.9]), width=48, height=44)
    edges = detect_edges(torch.stack((image, image, image)))
    far = edges.x.clone()
    far[1, 0] = torch.tensor([1e30, 3.0])
    found = track_curves(Edges(**{**vars(edges), "x": far}))
    assert bool((found.chain[:, 0] >= 0).all())


def test_wrong_input(unchecked: None) -> None:
    edges = detect_edges(torch.zeros(3, 1, 20, 30))
    with pytest.raises(ValueError, match="start: wanted one of 3 images"):
        track_curves(edges, start=3)
    with pytest.raises(ValueError, match="reach: wanted"):
        track_curves(edges, reach=-1.0)
    with pytest.raises(ValueError, match="edges: wanted those of images"):
        track_curves(detect_edges(torch.zeros(1, 20, 30)))
