"""The Oxford sequences: points and lines over several views with the cameras that Oxford estimated.

The sets are published by others and are not part of this project; see `bench.real_data`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

SEQUENCES = ("model_house", "corridor", "merton1", "library")


@dataclass(frozen=True)
class Sequence:
    """One sequence of v views.

    Attributes:
        x: Points (v, n, 2); without meaning where not visible.
        visible: Which view sees which point (v, n).
        segments: End points of line segments (v, m, 2, 2).
        line_visible: Which view sees which line (v, m).
        P: Oxford's cameras (v, 3, 4).
    """

    x: Tensor
    visible: Tensor
    segments: Tensor
    line_visible: Tensor
    P: Tensor

    def points(self, views: list[int]) -> Tensor:
        """The points that all of some views see."""
        return self.x[views][:, self.visible[views].all(0)]

    def lines(self, views: list[int]) -> Tensor:
        """The segments that all of some views see."""
        return self.segments[views][:, self.line_visible[views].all(0)]


def read_sequence(data: Path, name: str) -> Sequence:
    """One of `SEQUENCES`, from the folder of data sets."""
    folder = data / "vgg" / name / "2D"
    corners = [np.loadtxt(p) for p in sorted(folder.glob("*.corners")) if "nview" not in p.name]
    lines = [np.loadtxt(p)[:, :4].reshape(-1, 2, 2) for p in sorted(folder.glob("*.lines")) if "nview" not in p.name]
    cameras = sorted(folder.glob("*.P")) or sorted((folder.parent / "3D").glob("*.P"))
    x, visible = _matched(corners, next(folder.glob("*nview-corners")))
    segments, line_visible = _matched(lines, next(folder.glob("*nview-lines")))
    return Sequence(x, visible, segments, line_visible, torch.tensor(np.stack([np.loadtxt(p) for p in cameras])))


def lines_of(segments: Tensor) -> Tensor:
    """Homogeneous lines with unit normal through the end points of segments (..., 2, 2)."""
    a, b = segments.unbind(-2)
    normal = torch.stack((a[..., 1] - b[..., 1], b[..., 0] - a[..., 0]), -1)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    return torch.cat((normal, -(normal * (a + b) / 2).sum(-1, keepdim=True)), -1)


def _matched(features: list[np.ndarray], table: Path) -> tuple[Tensor, Tensor]:
    rows = [line.split() for line in table.read_text().splitlines() if line.strip()]
    index = torch.tensor([[-1 if entry == "*" else int(entry) for entry in row] for row in rows]).T
    found = [torch.tensor(f)[i.clamp_min(0)] for f, i in zip(features, index, strict=True)]
    return torch.stack(found), index >= 0
