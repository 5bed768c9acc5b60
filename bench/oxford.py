"""Trifocal and quadrifocal transfer in the Oxford sequences: points and lines over several views, and Oxford's cameras.

`TORCHSFM_DATA=... python -m bench.oxford` prints the table: half of the points that all views see are held out; their
positions in the last view are predicted from the other views, by the tensor of Oxford's cameras (which come from all points in
all views of the sequence) and by tensors from the other half. Median and root mean square of the distance, in pixels, the mean
over several ways to halve. The sets are published by others and are not part of this project; see `bench.real_data`.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.real_data import data_folder
from torchsfm import (
    estimate_trifocal,
    quadrifocal_6pt,
    quadrifocal_from_cameras,
    transfer_points_quadrifocal,
    transfer_points_trifocal,
    trifocal_7pt,
    trifocal_from_cameras,
)

VIEWS = {
    "model_house": ([0, 1, 2], [0, 3, 6], [0, 1, 2, 3], [0, 2, 4, 6]),
    "corridor": ([0, 1, 2], [0, 3, 6], [2, 4, 8], [0, 1, 2, 3], [0, 2, 4, 6]),
    "merton1": ([0, 1, 2],),
    "library": ([0, 1, 2],),
}
SEQUENCES = tuple(VIEWS)


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


def methods(sequence: Sequence, views: list[int], train: Tensor) -> dict[str, Callable[[], Tensor]]:
    """By name, what makes the tensor of some views."""
    P, segments = sequence.P[views], sequence.lines(views)
    if len(views) == 4:
        return {"Oxford's cameras": lambda: quadrifocal_from_cameras(*P), "points": lambda: quadrifocal_6pt(train).Q}
    found = {
        "Oxford's cameras": lambda: trifocal_from_cameras(*P),
        "points": lambda: trifocal_7pt(train).T,
        "points, robust": lambda: trifocal_from_cameras(
            *estimate_trifocal(train, threshold=2.0, generator=torch.Generator().manual_seed(0)).model
        ),
    }
    if segments.shape[1] >= 13:
        lines, ends = lines_of(segments), segments[0]
        found["points and lines"] = lambda: trifocal_7pt(train, lines, ends=ends).T
        found["10 points and lines"] = lambda: trifocal_7pt(train[:, :10], lines, ends=ends).T
        found["10 points"] = lambda: trifocal_7pt(train[:, :10]).T
        found["lines"] = lambda: trifocal_7pt(train[:, :0], lines, ends=ends).T
    return found


def transfer_error(tensor: Tensor, x: Tensor) -> tuple[float, float]:
    """Median and root mean square of the distance in the last view."""
    transfer = transfer_points_trifocal if len(x) == 3 else transfer_points_quadrifocal
    distance = (transfer(tensor, *x[:-1]) - x[-1]).norm(dim=-1)
    return float(distance.median()), float(distance.square().mean().sqrt())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.oxford", description=__doc__)
    parser.add_argument("--halvings", type=int, default=5)
    options = parser.parse_args()
    folder = data_folder()
    if folder is None:
        raise SystemExit("TORCHSFM_DATA does not name a folder of data sets")
    torch.set_num_threads(1)
    print(f"{'sequence':12s} {'views':14s} {'points':>6s} {'lines':>5s}  {'tensor from':20s} {'median px':>9s} {'rms px':>8s}")
    for name, choices in VIEWS.items():
        sequence = read_sequence(folder, name)
        for views in choices:
            x = sequence.points(views)
            errors: dict[str, list[tuple[float, float]]] = {}
            for seed in range(options.halvings):
                order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(seed))
                train, held = x[:, order[: len(order) // 2]], x[:, order[len(order) // 2 :]]
                for method, make in methods(sequence, views, train).items():
                    errors.setdefault(method, []).append(transfer_error(make(), held))
            label = ", ".join(map(str, views))
            for method, values in errors.items():
                median, rms = torch.tensor(values).mean(0).tolist()
                count = sequence.lines(views).shape[1]
                print(f"{name:12s} {label:14s} {x.shape[1]:6d} {count:5d}  {method:20s} {median:9.3f} {rms:8.2f}")


if __name__ == "__main__":
    main()
