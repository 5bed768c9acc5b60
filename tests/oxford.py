"""The Oxford sequences as the tests read them: points and line segments of several views, with Oxford's cameras."""

from pathlib import Path

import torch
from torch import Tensor

from torchsfm.formats import read_vgg


def read(data: Path, name: str, views: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Points (v, n, 2) and segments (v, m, 2, 2) that all of some views see, and cameras (v, 3, 4)."""
    scene = read_vgg(data / "vgg" / name)
    points, lines = (seen[views].all(0) for seen in (scene.visible, scene.segments_visible))
    return scene.x[views][:, points], scene.segments[views][:, lines], scene.P[views]


def lines_of(segments: Tensor) -> Tensor:
    """Lines with unit normal through end points (..., 2, 2)."""
    a, b = (torch.nn.functional.pad(x, (0, 1), value=1.0) for x in segments.unbind(-2))
    line = torch.linalg.cross(a, b, dim=-1)
    return line / line[..., :2].norm(dim=-1, keepdim=True)
