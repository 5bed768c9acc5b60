"""Stretches of lines: where views see them, and which parts several views see."""

import torch
from torch import Tensor

from torchsfm import random_intrinsics, random_points, random_poses
from torchsfm.geometry import project_points
from torchsfm.reconstruction.lines.stretch import places_on_lines, shared_stretch

F64 = torch.float64


def test_places_are_those_of_the_points_beside_which_segments_end(generator: torch.Generator) -> None:
    P = random_intrinsics(30, generator=generator) @ random_poses(30, generator=generator).matrix()
    ends = random_points(60, generator=generator).reshape(30, 2, 3)
    true = torch.rand(30, 2, generator=generator, dtype=F64)
    X = ends[:, :1] + true[..., None] * (ends[:, 1:] - ends[:, :1])
    x, image = project_points(P, X), project_points(P, ends)
    along = torch.nn.functional.normalize(image[:, 1] - image[:, 0], dim=-1)
    across = torch.stack((-along[:, 1], along[:, 0]), -1)
    x = x + across[:, None] * torch.randn(30, 2, 1, generator=generator, dtype=F64)
    assert places_on_lines(x, P, ends).allclose(true.sort(-1).values, atol=1e-8)


def covered(number: Tensor, view: Tensor, span: Tensor, line: int, place: Tensor) -> Tensor:
    """How many views show each place of a line, counted one by one."""
    views = torch.zeros(len(place), dtype=torch.long)
    for v in range(int(view.max()) + 1):
        own = span[(number == line) & (view == v)]
        views += ((place[:, None] >= own[:, 0]) & (place[:, None] <= own[:, 1])).any(1)
    return views


def test_shared_stretch_is_what_counting_finds(generator: torch.Generator) -> None:
    lines, count = 40, 400
    number = torch.cat((torch.arange(lines), torch.randint(lines, (count - lines,), generator=generator)))
    view = torch.randint(5, (count,), generator=generator)
    span = torch.rand(count, 2, generator=generator, dtype=F64).sort(-1).values
    stretch, there = shared_stretch(number, view, span, 3)
    order = torch.randperm(count, generator=generator)
    for again, same in zip(shared_stretch(number[order], view[order], span[order], 3), (stretch, there), strict=True):
        assert torch.equal(again, same)
    for line in range(lines):
        # What is covered changes at ends of segments alone.
        ends = span[number == line].flatten().sort().values
        middle = (ends[1:] + ends[:-1]) / 2
        (at,) = (covered(number, view, span, line, middle) >= 3).nonzero(as_tuple=True)
        assert bool(there[line]) == (len(at) > 0)
        wanted = torch.stack((ends[at[:1]], ends[at[-1:] + 1]), -1) if len(at) else torch.zeros(1, 2, dtype=F64)
        assert torch.equal(stretch[line], wanted[0])
    assert int(there.sum()) > 0


def test_segments_of_one_view_are_one_witness() -> None:
    number, view = torch.zeros(4, dtype=torch.long), torch.tensor([0, 0, 0, 1])
    span = torch.tensor([[0.0, 1.0], [0.2, 0.8], [0.1, 0.9], [0.0, 0.7]], dtype=F64)
    assert not shared_stretch(number, view, span, 3)[1].any()
    stretch, there = shared_stretch(number, view, span, 2)
    assert there.all()
    assert torch.equal(stretch, torch.tensor([[0.0, 0.7]], dtype=F64))


def test_no_lines() -> None:
    none = torch.zeros(0, dtype=torch.long)
    stretch, there = shared_stretch(none, none, torch.zeros(0, 2, dtype=F64), 3)
    assert stretch.shape == (0, 2)
    assert there.shape == (0,)
