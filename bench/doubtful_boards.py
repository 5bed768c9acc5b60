"""Calibration where board, lens or photographs are not what it takes them for: how far off K is, and what is said of it.

`python -m bench.doubtful_boards`: ten views of 9 x 6 points, focal length 480 px, 0.05 px of noise. Root mean square error of
fx in pixels, the same over its standard deviation, and the disagreement of the views: by the usual lens and a flat board, and
by those that the photographs ask for.
"""

import argparse
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsfm import Camera, Status, calibrate_planes
from torchsfm.autocalibration.plane_models import LENSES, calibrate_unknown_planes
from torchsfm.geometry import BrownConrady, Distortion, KannalaBrandt, Radial, intrinsics, rotation_from_rotvec
from torchsfm.optim import Huber

F64 = torch.float64
WIDTH, HEIGHT = 640.0, 480.0
X = torch.stack(torch.meshgrid(torch.arange(9), torch.arange(6), indexing="xy"), -1).reshape(-1, 2).to(F64)
OPTIONS: dict[str, Any] = {"image_size": (WIDTH, HEIGHT), "loss": Huber(1.0)}


def sagging(sag: float) -> Tensor:
    """A board that hangs through between its ends, in squares."""
    return torch.cat((X, sag * ((X[:, :1] - 4) / 4) ** 2), -1)


def lens(model: type[Distortion], *numbers: float) -> Distortion:
    """A lens of double numbers."""
    return model.from_parameters(torch.tensor(numbers, dtype=F64))


FLAT, USUAL = sagging(0.0), lens(Radial, -0.1, 0.02)


@dataclass(frozen=True)
class Case:
    """What is wrong."""

    name: str
    board: Tensor = FLAT
    lens: Distortion = USUAL
    focal: tuple[float, ...] = (480.0,)
    after: Callable[[Tensor], Tensor] = lambda x: x


def mirrored(x: Tensor) -> Tensor:
    """The first photograph mirrored."""
    return torch.cat((torch.stack((WIDTH - 1 - x[:1, :, 0], x[:1, :, 1]), -1), x[1:]))


CASES = (
    Case("as it should be"),
    Case("three photographs, each four times", after=lambda x: x[:3].repeat(4, 1, 1)),
    Case("one photograph mirrored", after=mirrored),
    Case("two zooms, 480 and 494", focal=(480.0, 494.0)),
    Case("two zooms, 480 and 624", focal=(480.0, 624.0)),
    Case("rows of the board 1 % too long", board=FLAT * torch.tensor([1.01, 1.0, 1.0], dtype=F64)),
    Case("sag of 0.02 squares", board=sagging(0.02)),
    Case("sag of 0.1 squares", board=sagging(0.1)),
    Case("decentred lens", lens=lens(BrownConrady, -0.1, 0.02, 0.002, -0.001, 0.0)),
    Case("fisheye, 92 degrees", lens=lens(KannalaBrandt, 0.01, -0.003, 0.0, 0.0), focal=(400.0,)),
    Case("fisheye, 131 degrees", lens=lens(KannalaBrandt, 0.01, -0.003, 0.0, 0.0), focal=(280.0,)),
)


def photographs(case: Case, g: torch.Generator, views: int = 10) -> Tensor:
    """Image points of views that show all of the board."""
    points: list[Tensor] = []
    middle = case.board.mean(0)
    while len(points) < views:
        f = case.focal[len(points) % len(case.focal)]
        R = rotation_from_rotvec((2 * torch.rand(3, generator=g, dtype=F64) - 1) * torch.tensor([0.6, 0.6, 0.5], dtype=F64))
        depth = 8.0 * min(case.focal) / 480 * (1 + 0.35 * torch.rand((), generator=g, dtype=F64))
        aside = 0.3 * (2 * torch.rand(2, generator=g, dtype=F64) - 1) * torch.tensor([WIDTH, HEIGHT], dtype=F64) / f
        t = torch.cat((depth * aside, depth[None])) - R @ middle
        K = intrinsics(torch.tensor(f, dtype=F64), torch.tensor([325.0, 236.0], dtype=F64))
        rays = case.board @ R.mT + t
        x = Camera(K, case.lens).project(rays)
        inside = (x > 5) & (x < torch.tensor([WIDTH - 6, HEIGHT - 6], dtype=F64))
        if bool(inside.all()) and float(rays[:, 2].min()) > 0.5:
            points.append(x + 0.05 * torch.randn(x.shape, generator=g, dtype=F64))
    return case.after(torch.stack(points))


def score(case: Case, sets: int, asked: bool) -> str:
    """Errors of K over sets of photographs."""
    g = torch.Generator().manual_seed(0)
    errors, chosen, apart = [], [], []
    for _ in range(sets):
        x = photographs(case, g)
        free = ("focal", "aspect", "principal_point")
        name, found = (
            calibrate_unknown_planes(x, X, lenses=LENSES, boards=(False, True), free=free, **OPTIONS)
            if asked
            else ("radial", calibrate_planes(x, X, **OPTIONS))
        )
        if int(found.status) == Status.OK:
            error = float(found.camera.K[0, 0]) - statistics.mean(case.focal)
            errors.append([error, error / float(found.deviation[0])])
            chosen.append(name + (" bent" if "stretch" in found.parameter_names else ""))
            apart.append(float(found.disagreement))
    off, relative = torch.tensor(errors, dtype=F64).square().mean(0).sqrt().tolist()
    most = max(set(chosen), key=chosen.count)
    return f"{off:7.2f} ({relative:5.2f}) {statistics.median(apart):5.1f}  {most:12} {len(errors)} of {sets} OK"


def main() -> None:
    """Print all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=10)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for case in CASES:
        print(f"{case.name:36}", *(score(case, options.sets, asked) for asked in (False, True)), sep=" | ", flush=True)


if __name__ == "__main__":
    main()
