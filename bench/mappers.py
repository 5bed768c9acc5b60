"""The incremental and the global mapper on the same verified pairs of photographs with known poses.

    TORCHSFM_DATA=/path/to/data python -m bench.mappers [--sets fountain castle ...] [--seeds 3]
    python -m bench.mappers --views 50 100 200 400 [--families orbit crowd]       # simulated features in place of photographs

Photographs are matched once a set; then each mapper makes models of them, with each seed. Prints a markdown table: registered
images, the area under the curve of pose errors at 1, 2 and 5 degrees (mean over seeds), and the seconds of one processor core
(`time.process_time`, so that other work on the machine does not count) that mapping takes, finish included.

Simulated features are those of the cameras of `bench.view_graphs`: each point is seen by some of the cameras near one, half a
pixel off, and one observation of twenty is wrong; the focal length is first taken to be 3 % longer than it is.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from bench.real_data import SETS, PhotographSet, data_folder
from bench.view_graphs import FAMILIES, look_around
from torchsfm.geometry import Pose
from torchsfm.reconstruction.evaluation import pose_auc, pose_errors
from torchsfm.reconstruction.growth import Given, Wanted
from torchsfm.reconstruction.models import build_models
from torchsfm.reconstruction.photographs import NEIGHBOURS, match_photographs
from torchsfm.reconstruction.report import SfmResult
from torchsfm.reconstruction.stages import Stages
from torchsfm.reconstruction.track_graph import graph_from_tracks
from torchsfm.reconstruction.view_graph import ViewGraph

MAPPERS = ("incremental", "global")
SIZE, FOCAL, GUESS = (1000, 750), 1100.0, 1.03
"""Of simulated images in pixels, and how far off the first focal length is."""
OFF, WRONG = 0.5, 0.05
"""Errors in pixels; how many are wrong."""


@dataclass(frozen=True)
class Input:
    """Verified pairs, and what is known of the cameras that took the images."""

    name: str
    graph: ViewGraph
    labels: Sequence[str]
    focal: Sequence[float | None]
    K: Tensor | None
    truth: Pose | None


def nothing(stage: str, done: int, total: int) -> None:
    """No progress is shown."""


def matched(photographs: PhotographSet) -> Input:
    """The verified pairs of a set."""
    seen = match_photographs(
        photographs.paths, sequence=False, max_features=8192, max_pixels=10**8, neighbours=NEIGHBOURS, out=None,
        resume=False, seed=0, progress=nothing, masks=None,
    )  # fmt: skip
    truth = None
    if photographs.poses:
        rows = [photographs.poses[path.name] for path in photographs.paths]
        truth = Pose.from_matrix(torch.stack([torch.from_numpy(row) for row in rows]))
    K = None if photographs.K is None else torch.from_numpy(photographs.K)
    return Input(photographs.name, seen.graph, seen.points.labels, seen.points.focal, K, truth)


def simulated(family: str, views: int) -> Input:
    """The verified pairs of simulated features."""
    g = torch.Generator().manual_seed(0)
    seen = look_around(family, views, FOCAL, SIZE, generator=g)
    x = seen.x + OFF * torch.randn(len(seen.x), 2, generator=g, dtype=torch.float64)
    limits = torch.tensor(SIZE)
    wrong = torch.rand(len(x), 1, generator=g) < WRONG
    x = torch.where(wrong, torch.rand(len(x), 2, generator=g, dtype=torch.float64) * limits, x)
    inside = (x >= 0).all(-1) & (x < limits).all(-1)
    color = torch.full((int(inside.sum()), 3), 0.5).double()
    names = [f"view{i:05d}" for i in range(views)]
    graph, _ = graph_from_tracks(
        names, limits.expand(views, 2), x[inside], seen.view[inside], seen.point[inside], color, generator=g
    )
    return Input(f"{family}, {views}", graph, [""] * views, [GUESS * FOCAL] * views, None, seen.poses)


def mapped(given: Input, mapper: str, seed: int) -> tuple[SfmResult, float]:
    """What a mapper makes of verified pairs, and the seconds of a processor core that it takes."""
    start = time.process_time()
    result = build_models(
        Given(given.graph, given.labels, given.focal), Wanted(shared_camera=True, K=given.K, method=mapper),
        order=given.graph.names, generator=torch.Generator().manual_seed(seed), stages=Stages(None, False, ""),
        progress=nothing,
    )  # fmt: skip
    return result, time.process_time() - start


def row(given: Input, mapper: str, seeds: int) -> str:
    """One line of the table."""
    registered, points, error, areas, seconds = [], [], [], [], []
    for seed in range(seeds):
        result, spent = mapped(given, mapper, seed)
        seconds.append(spent)
        registered.append(sum(model.num_registered for model in result.models[:1]))
        for model in result.models[:1]:
            points.append(model.num_points)
            error.append(float(model.residuals().mean()))
        if given.truth is not None and result.models:
            areas.append(pose_auc(pose_errors(result.models[0].poses, given.truth, result.models[0].registered).pose))
        elif given.truth is not None:
            areas.append(torch.zeros(3).double())
    area = " / ".join(f"{a:.3f}" for a in torch.stack(areas).mean(0).tolist()) if areas else "no pose truth"
    cells = [
        given.name, mapper, f"{' '.join(map(str, sorted({*registered})))}/{len(given.graph.names)}",
        f"{sum(points) / max(len(points), 1):,.0f}", f"{sum(error) / max(len(error), 1):.3f}", area,
        f"{sum(seconds) / seeds:.1f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.mappers", description="The global mapper against the incremental one."
    )
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the data sets (default: $TORCHSFM_DATA)")
    parser.add_argument("--sets", nargs="+", choices=sorted(SETS), default=["fountain", "castle", "entry", "temple", "sceaux"])
    parser.add_argument("--views", type=int, nargs="+", help="numbers of simulated images, in place of photographs")
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=["orbit", "crowd"])
    parser.add_argument("--mappers", nargs="+", choices=MAPPERS, default=MAPPERS)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.data is None and not options.views:
        parser.error("name the folder of the data sets with --data or TORCHSFM_DATA")
    torch.set_num_threads(1)
    print(
        "| photographs | mapper | registered | points | error, px | AUC 1 / 2 / 5° | core-seconds |", "|---" * 7 + "|", sep="\n"
    )
    if options.views:
        inputs = (simulated(family, views) for family in options.families for views in options.views)
    else:
        inputs = (matched(SETS[name](options.data)) for name in options.sets)
    for given in inputs:
        for mapper in options.mappers:
            print(row(given, mapper, options.seeds), flush=True)


if __name__ == "__main__":
    main()
