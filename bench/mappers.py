"""The incremental and the global mapper, and COLMAP's two, on the same verified pairs of photographs with known poses.

    TORCHSFM_DATA=/path/to/data python -m bench.mappers [--sets fountain castle ...] [--seeds 3]
    python -m bench.mappers --rendered 50 100 200 400      # the photographs of `bench.scale`
    python -m bench.mappers --views 50 100 200 400 [--families orbit crowd]       # simulated features in place of photographs
    python -m bench.mappers ... --mappers incremental global COLMAP "COLMAP, global" [--kept FOLDER]

Photographs are matched once a set (verified pairs stay in the folder `--kept` and are taken from there); then each mapper makes
models of them, with each seed, in a process of its own. Prints a markdown table: registered images, the area under the curve of
pose errors at 1, 2 and 5 degrees (mean over seeds), the seconds of one processor core (`time.process_time`, so that other work
on the machine does not count) that mapping takes, finish included, and the most memory that it takes on top of what the process
had before; COLMAP reads a database of the verified pairs. Exponents are the slopes of logarithms to the row of fewer images.

Simulated features are those of the cameras of `bench.view_graphs`: each point is seen by some of the cameras near one, half a
pixel off, and one observation of twenty is wrong; the focal length is first taken to be 3 % longer than it is.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.bundle_programs import Run, measured
from bench.mapper_peers import run as run_colmap
from bench.mapper_peers import write_pairs
from bench.real_data import SETS, PhotographSet, data_folder
from bench.scale import FEATURES, render, ring
from bench.view_graphs import FAMILIES, look_around
from torchsfm.geometry import Pose
from torchsfm.reconstruction.mappers.growth import Given, Wanted
from torchsfm.reconstruction.matching.image_points import ImagePoints
from torchsfm.reconstruction.matching.stages import Stages
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.model.evaluation import pose_auc, pose_errors
from torchsfm.reconstruction.models import build_models
from torchsfm.reconstruction.photographs import NEIGHBOURS, match_photographs

Row = dict[str, Any]
MAPPERS = ("incremental", "global")
PEERS = {"COLMAP": False, "COLMAP, global": True}
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


def itself(x: Tensor) -> Tensor:
    """What is given."""
    return x


def match(files: Sequence[Path], features: int) -> tuple[ViewGraph, ImagePoints]:
    """The verified pairs of photographs, of which nothing is left to be read."""
    seen = match_photographs(
        files, sequence=False, max_features=features, max_pixels=10**8, neighbours=NEIGHBOURS, out=None,
        resume=False, seed=0, progress=nothing, masks=None,
    )  # fmt: skip
    assert seen.graph.descriptors is not None
    return replace(seen.graph, descriptors=partial(itself, seen.graph.descriptors())), seen.points


def matched(photographs: PhotographSet) -> Input:
    """The verified pairs of a set."""
    graph, points = match(photographs.paths, 8192)
    truth = None
    if photographs.poses:
        rows = [photographs.poses[path.name] for path in photographs.paths]
        truth = Pose.from_matrix(torch.stack([torch.from_numpy(row) for row in rows]))
    K = None if photographs.K is None else torch.from_numpy(photographs.K)
    return Input(photographs.name, graph, points.labels, points.focal, K, truth)


def rendered(views: int) -> Input:
    """The verified pairs of rendered photographs."""
    with tempfile.TemporaryDirectory() as folder:
        graph, points = match(render(Path(folder), views), FEATURES)
    truth = ring(views, torch.Generator().manual_seed(0))[1]
    return Input(f"rendered, {views}", graph, points.labels, points.focal, None, truth)


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


def mapped(given: Input, mapper: str, seed: int) -> Row:
    """What this library's mapper makes of verified pairs."""
    run = Run()
    with measured(run):
        result = build_models(
            Given(given.graph, given.labels, given.focal), Wanted(shared_camera=True, K=given.K, method=mapper),
            order=given.graph.names, generator=torch.Generator().manual_seed(seed), stages=Stages(None, False, ""),
            progress=nothing,
        )  # fmt: skip
    row: Row = {"seconds": run.cpu, "MB": run.memory, "registered": 0}
    for model in result.models[:1]:
        row |= {"registered": model.num_registered, "points": model.num_points, "error": float(model.residuals().mean())}
        row |= accuracy(given, model.poses, model.registered)
    return row


def mapped_by_colmap(given: Input, together: bool, seed: int) -> Row:
    """What COLMAP's mapper makes of the same pairs."""
    run = Run()
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        write_pairs(database, given.graph, given.focal[0], given.K)
        with measured(run):
            model = run_colmap(database, together, given.K is not None, seed)
    row: Row = {"seconds": run.cpu, "MB": run.memory, "registered": 0}
    if model is not None:
        poses = torch.eye(3, 4, dtype=torch.float64).repeat(len(given.graph.names), 1, 1)
        registered = torch.zeros(len(poses), dtype=torch.bool)
        number = {name: i for i, name in enumerate(given.graph.names)}
        for image in model.images.values():
            if image.has_pose:
                poses[number[image.name]] = torch.from_numpy(image.cam_from_world().matrix())
                registered[number[image.name]] = True
        row |= {"registered": int(registered.sum()), "points": model.num_points3D()}
        row |= {"error": model.compute_mean_reprojection_error()} | accuracy(given, Pose.from_matrix(poses), registered)
    return row


def accuracy(given: Input, poses: Pose, registered: Tensor) -> Row:
    """The areas under the curve of pose errors, where the truth is known."""
    return {} if given.truth is None else {"areas": pose_auc(pose_errors(poses, given.truth, registered).pose).tolist()}


def apart(given: Path, mapper: str, seed: int) -> Row:
    """One mapper in a process of its own."""
    words = [sys.executable, "-m", "bench.mappers", "--worker", str(given), "--mappers", mapper, "--seeds", str(seed)]
    done = subprocess.run(words, capture_output=True, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1])) if done.returncode == 0 else {"failed": done.stderr.strip()[-200:]}


def line(given: Input, mapper: str, rows: list[Row], before: tuple[int, float] | None) -> tuple[str, float]:
    """One line of the table, and the mean seconds; `before` are the images and seconds of the line with fewer of them."""
    views = len(given.graph.names)

    def mean(name: str) -> float:
        values = [float(row[name]) for row in rows if name in row]
        return sum(values) / max(len(values), 1)

    areas = [row.get("areas", [0.0] * 3) for row in rows]
    seconds = mean("seconds")
    grown = f" ({math.log(seconds / before[1]) / math.log(views / before[0]):.2f})" if before and before[1] else ""
    cells = [
        given.name, mapper, f"{' '.join(map(str, sorted({row['registered'] for row in rows})))}/{views}",
        f"{mean('points'):,.0f}", f"{mean('error'):.3f}",
        "no pose truth" if given.truth is None else " / ".join(f"{sum(a) / len(a):.3f}" for a in zip(*areas, strict=True)),
        f"{seconds:.1f}{grown}", f"{mean('MB'):.0f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |", seconds


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.mappers", description="The global mapper against the incremental one."
    )
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the data sets (default: $TORCHSFM_DATA)")
    parser.add_argument("--sets", nargs="+", choices=sorted(SETS), default=["fountain", "castle", "entry", "temple", "sceaux"])
    parser.add_argument("--rendered", type=int, nargs="+", help="numbers of rendered photographs, in place of real ones")
    parser.add_argument("--views", type=int, nargs="+", help="numbers of simulated images, in place of photographs")
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=["orbit", "crowd"])
    parser.add_argument("--mappers", nargs="+", choices=[*MAPPERS, *PEERS], default=MAPPERS)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--kept", type=Path, help="folder of verified pairs")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.worker:
        given, (mapper,) = torch.load(options.worker, weights_only=False), options.mappers
        how = partial(mapped_by_colmap, together=PEERS[mapper]) if mapper in PEERS else partial(mapped, mapper=mapper)
        print(json.dumps(how(given, seed=options.seeds)))
        return
    if options.data is None and not (options.views or options.rendered):
        parser.error("name the folder of the data sets with --data or TORCHSFM_DATA")
    print(
        "| photographs | mapper | registered | points | error, px | AUC 1 / 2 / 5° | core-seconds | MB |", "|---" * 8 + "|",
        sep="\n",
    )  # fmt: skip
    inputs: list[tuple[str, Callable[[], Input]]] = []
    if options.rendered:
        inputs += [(f"rendered, {views}", partial(rendered, views)) for views in options.rendered]
    if options.views:
        inputs += [(f"{kind}, {n}", partial(simulated, kind, n)) for kind in options.families for n in options.views]
    if not inputs:
        inputs += [(name, lambda name=name: matched(SETS[name](options.data))) for name in options.sets]  # type: ignore[misc]
    last: dict[tuple[str, str], tuple[int, float]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.kept or Path(scratch)
        folder.mkdir(exist_ok=True)
        for name, make in inputs:
            file = folder / name
            if not file.exists():
                torch.save(make(), file)
            given = torch.load(file, weights_only=False)
            for mapper in options.mappers:
                rows = [apart(file, mapper, seed) for seed in range(options.seeds)]
                if any("failed" in row for row in rows):
                    print(
                        f"| {name} | {mapper} | failed: {next(row['failed'] for row in rows if 'failed' in row)} |", flush=True
                    )
                    continue
                kind = name.split(",")[0], mapper
                text, seconds = line(given, mapper, rows, last.get(kind) if "," in name else None)
                last[kind] = len(given.graph.names), seconds
                print(text, flush=True)


if __name__ == "__main__":
    main()
