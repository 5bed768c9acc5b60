"""Trifocal and quadrifocal transfer in the Oxford sequences: points and lines over several views, and Oxford's cameras.

`TORCHSFM_DATA=... python -m bench.oxford` prints the table: half of the points that all views see are held out; their
positions in the last view are predicted from the other views, by the tensor of Oxford's cameras (which come from all points in
all views of the sequence) and by tensors from the other half. Median and root mean square of the distance, in pixels, the mean
over several ways to halve. The sets are published by others and are not part of this project; see `bench.real_data`.
"""

import argparse
from collections.abc import Callable

import torch
from torch import Tensor

from bench.real_data import data_folder
from torchsfm import (
    VggScene,
    estimate_trifocal,
    quadrifocal_6pt,
    quadrifocal_from_cameras,
    read_vgg,
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


def points(scene: VggScene, views: list[int]) -> Tensor:
    """The points that all of some views see."""
    return scene.x[views][:, scene.visible[views].all(0)]


def lines(scene: VggScene, views: list[int]) -> Tensor:
    """The segments that all of some views see."""
    return scene.segments[views][:, scene.segments_visible[views].all(0)]


def lines_of(segments: Tensor) -> Tensor:
    """Homogeneous lines with unit normal through the end points of segments (..., 2, 2)."""
    a, b = segments.unbind(-2)
    normal = torch.stack((a[..., 1] - b[..., 1], b[..., 0] - a[..., 0]), -1)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    return torch.cat((normal, -(normal * (a + b) / 2).sum(-1, keepdim=True)), -1)


def methods(scene: VggScene, views: list[int], train: Tensor) -> dict[str, Callable[[], Tensor]]:
    """By name, what makes the tensor of some views."""
    P, segments = scene.P[views], lines(scene, views)
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
        line, ends = lines_of(segments), segments[0]
        found["points and lines"] = lambda: trifocal_7pt(train, line, ends=ends).T
        found["10 points and lines"] = lambda: trifocal_7pt(train[:, :10], line, ends=ends).T
        found["10 points"] = lambda: trifocal_7pt(train[:, :10]).T
        found["lines"] = lambda: trifocal_7pt(train[:, :0], line, ends=ends).T
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
        scene = read_vgg(folder / "vgg" / name)
        for views in choices:
            x = points(scene, views)
            errors: dict[str, list[tuple[float, float]]] = {}
            for seed in range(options.halvings):
                order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(seed))
                train, held = x[:, order[: len(order) // 2]], x[:, order[len(order) // 2 :]]
                for method, make in methods(scene, views, train).items():
                    errors.setdefault(method, []).append(transfer_error(make(), held))
            label = ", ".join(map(str, views))
            for method, values in errors.items():
                median, rms = torch.tensor(values).mean(0).tolist()
                count = lines(scene, views).shape[1]
                print(f"{name:12s} {label:14s} {x.shape[1]:6d} {count:5d}  {method:20s} {median:9.3f} {rms:8.2f}")


if __name__ == "__main__":
    main()
