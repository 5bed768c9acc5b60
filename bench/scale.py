"""How time and memory grow with the number of photographs, and what that says of more than one machine holds.

    python -m bench.scale photographs --images 50 100 200     # the whole job on rendered photographs; 400 800 take hours
    python -m bench.scale features --images 1000 3000 10000   # retrieval and the division of pairs, on simulated features
    python -m bench.scale recall --images 60                  # which verified pairs retrieval finds, k = 5 to 50
    python -m bench.scale bundle --ranks 1 2 4                # memory, bytes and processor time of a bundle over processes
    python -m bench.scale rotations --ranks 1 2               # of rotation averaging, and of `positions`; --images of each

prints markdown tables. Seconds are those of one processor core (`time.process_time`), so that other work on the machine does
not count; each row is a process of its own, so that its peak memory is its own. `exponent` is the slope of the logarithms
between a row and the one above. With `photographs` comes a prediction for 10^4, 10^5 and 10^6 images.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from torchsfm.geometry import Pose
    from torchsfm.simulation import TexturedScene

Row = dict[str, float]
WIDTH, HEIGHT, FEATURES, NEIGHBOURS = 480, 360, 1000, 20
LARGE = (10**4, 10**5, 10**6)


def ring(views: int, generator: torch.Generator) -> tuple["TexturedScene", "Pose"]:
    """The things of a courtyard and cameras on an arc around them, all of which see the same things."""
    from torchsfm.simulation import courtyard_scene, orbit_poses

    scene = courtyard_scene(texel=0.012, generator=generator)
    poses = orbit_poses(views, radius=5.2, height=(0.6, 2.2), sweep=math.radians(300), target=(0.0, 0.0, 0.7))
    # Behind its two walls cameras see nothing of the court.
    ground, _, _, *things = scene.objects
    return replace(scene, objects=(ground, *things)), poses


def render(folder: Path, views: int) -> list[Path]:
    """Photographs of the ring, some at a time."""
    from torchsfm.images import save_image
    from torchsfm.simulation import render_sequence

    generator = torch.Generator().manual_seed(0)
    scene, poses = ring(views, generator)
    files = []
    for some in torch.split(torch.arange(views), 10):
        rendered = render_sequence(scene, poses=poses[some], width=WIDTH, height=HEIGHT, points=0, generator=generator)
        for i, image in zip(some.tolist(), rendered.images, strict=True):
            files.append(folder / f"view{i:04d}.jpg")
            save_image(files[-1], image)
    return files


def memory() -> float:
    """Peak memory of this process so far, MB (Linux); what `resource` says has the peak of its parent in it."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


@dataclass
class StageClock:
    """Takes the seconds of this process that stages take, where it is told of the progress of a reconstruction."""

    last: float = field(default_factory=time.process_time)
    stage: str = "features"
    seconds: dict[str, float] = field(default_factory=dict)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """What came since the last call belongs to this stage; before they are looked at, pairs are chosen."""
        now = time.process_time()
        name = "pairs" if (self.stage, stage) in (("features", "look"), ("features", "match")) else stage
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last, self.stage = now, stage


def photographs(views: int, method: str) -> Row:
    """The whole job."""
    from torchsfm.reconstruction import reconstruct

    with tempfile.TemporaryDirectory() as folder:
        files = render(Path(folder), views)
        before, clock = memory(), StageClock()
        result = reconstruct(
            files, max_features=FEATURES, neighbours=NEIGHBOURS, method=method, out=Path(folder) / "out", progress=clock
        )
    names, spent = ("features", "pairs", "look", "match", "verify", "map"), clock.seconds
    return {
        "pairs compared": len(result.report.pairs.pairs),
        "registered": result.models[0].num_registered if result.models else 0,
        "doubtful": sum(bool(image.doubt) for image in result.report.images),
        **{f"{name} s": spent.get(name, 0.0) for name in names},
        "MB before": before,
        "MB": memory(),
    }


def simulated(views: int) -> Row:
    """Retrieval among features of a long street, in which each image shares most with those near it."""
    from torchsfm.images import Features, retrieve_pairs
    from torchsfm.reconstruction.matching.match_all import PairShards

    each = 100
    world = torch.randint(0, 100, (views * each // 10, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))

    def make(i: int) -> Features:
        generator = torch.Generator().manual_seed(i + 1)
        rows = (i * each // 10 + torch.randint(0, each, (each,), generator=generator)) % len(world)
        blank = torch.zeros(each)
        return Features(torch.zeros(each, 2), blank, blank, blank, world[rows])

    features = [make(i) for i in range(views)]
    before, start = memory(), time.process_time()
    pairs = retrieve_pairs(features, NEIGHBOURS)
    retrieved = time.process_time()
    work = PairShards.of(pairs)
    divided = time.process_time()
    apart = (pairs[:, 1] - pairs[:, 0]).minimum(views - pairs[:, 1] + pairs[:, 0])
    return {
        "pairs": len(pairs),
        "of neighbours": float((apart <= 10).double().mean()),
        "match shards": work.match_shards,
        "retrieval s": retrieved - start,
        "division s": divided - retrieved,
        "MB before": before,
        "MB": memory(),
    }


def recall(views: int) -> Row:
    """The share of the pairs that verification finds related among all, that are among the k most alike of either image."""
    from torchsfm.images import describe_images
    from torchsfm.reconstruction.matching import match_all
    from torchsfm.reconstruction.photographs import match_photographs

    with tempfile.TemporaryDirectory() as folder:
        match_all.MAX_IMAGES_ALL_PAIRS = views
        seen = match_photographs(
            render(Path(folder), views), sequence=False, max_features=FEATURES, max_pixels=10**7, neighbours=NEIGHBOURS,
            out=None, resume=False, seed=0, progress=lambda *_: None, masks=None,
        )  # fmt: skip
    described = describe_images(seen.points.features)
    order = (described @ described.mT).fill_diagonal_(-math.inf).argsort(1, descending=True)
    place = order.argsort(1)
    i, j = seen.graph.pairs.T
    rank = torch.minimum(place[i, j], place[j, i])
    row: Row = {"pairs": len(rank)}
    for inliers in (30, 100):
        good = seen.graph.fundamental_inliers >= inliers
        row[f"with {inliers} inliers"] = int(good.sum())
        row |= {f"recall {inliers}, k = {k}": float((rank[good] < k).double().mean()) for k in (5, 10, 20, 50)}
    return row


def make_bundle(size: int, mixed: bool) -> Any:
    """A bundle of cameras along a street; `mixed` has the points in another order."""
    from torchsfm.simulation import random_bundle_problem

    problem = random_bundle_problem(size, 600 * size, 3000 * size, generator=torch.Generator().manual_seed(0)).problem
    if not mixed:
        return problem
    order = torch.randperm(len(problem.X), generator=torch.Generator().manual_seed(0))
    return replace(problem, X=problem.X[order], point=torch.argsort(order)[problem.point])


def make_rotations(size: int, mixed: bool) -> Any:
    """Edges between cameras along a street, a fifth of them wrong."""
    from bench.view_graphs import make_view_graph

    graph = make_view_graph("corridor", size, outliers=0.2)
    order = torch.randperm(len(graph.edges), generator=torch.Generator().manual_seed(0)) if mixed else slice(None)
    return size, graph.edges[order], graph.R[order], graph.deviation[order]


def make_positions(size: int, mixed: bool) -> Any:
    """Rays of cameras above a field, a thousandth of a radian off."""
    from bench.view_graphs import look_around

    g = torch.Generator().manual_seed(0)
    seen = look_around("lawnmower", size, 1100.0, (1000, 750), generator=g)
    d = torch.cat(((seen.x - torch.tensor([499.5, 374.5])) / 1100.0, torch.ones(len(seen.x), 1).double()), -1)
    d[:, :2] += 1e-3 * torch.randn(len(d), 2, generator=g, dtype=torch.float64)
    order = torch.randperm(len(seen.X), generator=g) if mixed else torch.arange(len(seen.X))
    return d, seen.view, order[seen.point], seen.poses.R, len(seen.X)


def solve_bundle(problem: Any, group: Any) -> tuple[list[float], torch.Tensor]:
    """Its costs after each step, and the places of the cameras."""
    from torchsfm.bundle import bundle_adjust

    costs: dict[int, float] = {}
    found = bundle_adjust(
        problem, free=("focal", "k1", "k2"), linear_solver="pcg", max_iterations=5, tolerance=0.0, group=group,
        progress=costs.__setitem__,
    )  # fmt: skip
    return list(costs.values()), found.poses.centre


def solve_rotations(problem: Any, group: Any) -> tuple[list[float], torch.Tensor]:
    """No costs; the rotations of the cameras."""
    from torchsfm.motion import average_rotations

    size, edges, R, deviation = problem
    spread = deviation.square()[:, None, None] * torch.eye(3, dtype=torch.float64)
    return [], average_rotations(R, edges, views=size, deviation=spread, group=group).model


def solve_positions(problem: Any, group: Any) -> tuple[list[float], torch.Tensor]:
    """No costs; the places of the cameras."""
    from torchsfm.motion import position_globally

    *rays, points = problem
    return [], position_globally(*rays, points=points, group=group).centres


SHARED: dict[str, tuple[Callable[..., Any], Callable[..., Any], int, int]] = {
    "bundle": (make_bundle, solve_bundle, 200, 72),
    "rotations": (make_rotations, solve_rotations, 10_000, 24),
    "positions": (make_positions, solve_positions, 1_000, 24),
}
"""What processes share: how it is made and solved, the number of cameras, and the bytes of one."""


def share_out(job: str, size: int, ranks: int, mixed: bool = False) -> list[dict[str, Any]]:
    """One problem over processes: what each of them takes; `mixed` has the data in another order."""
    from torchsfm._types import tensor_map

    with tempfile.TemporaryDirectory() as folder:
        # Views of larger tensors would be saved with all of these.
        torch.save(tensor_map(torch.clone, SHARED[job][0](size, mixed)), Path(folder) / "problem")
        words = [sys.executable, "-m", "bench.scale", job, "--worker", folder, "--images", f"{size}"]
        group = [
            subprocess.Popen(words, env=os.environ | {"RANK": str(rank), "WORLD_SIZE": str(ranks)}, stdout=subprocess.PIPE)
            for rank in range(ranks)
        ]
        rows = [json.loads(process.communicate()[0].splitlines()[-1]) for process in group]
        return [row | {"answer": torch.load(Path(folder) / "answer")} for row in rows]


def rank_of(job: str, size: int, folder: str) -> dict[str, Any]:
    """One rank of `share_out`."""
    import torch.distributed as dist

    import torchsfm.bundle
    import torchsfm.motion  # noqa: F401 - before the clock starts

    ranks, rank = int(os.environ["WORLD_SIZE"]), int(os.environ["RANK"])
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=ranks)
    sent: list[int] = []
    reduce, gather = dist.all_reduce, dist.all_gather

    def counted(x: torch.Tensor, *options: Any, **more: Any) -> Any:
        sent.append(x.numel() * x.element_size())
        return reduce(x, *options, **more)

    def gathered(found: list[torch.Tensor], x: torch.Tensor, **more: Any) -> Any:
        sent.append(x.numel() * x.element_size())
        return gather(found, x, **more)

    dist.all_reduce, dist.all_gather = counted, gathered
    problem = torch.load(Path(folder) / "problem", weights_only=False)
    before, start = memory(), time.process_time()
    costs, answer = SHARED[job][1](problem, dist.group.WORLD)
    spent, own = time.process_time() - start, SHARED[job][3] * size
    if not rank:
        torch.save(answer, Path(folder) / "answer")
    row = {
        "costs": costs,
        "cpu s": spent,
        "MB before": before,
        "MB more": memory() - before,
        "messages": len(sent),
        "of all cameras": sent.count(own),
        "MB of others": (sum(sent) - own * sent.count(own)) / 1e6,
    }
    dist.destroy_process_group()
    return row


def compare_ranks(job: str, size: int, numbers: list[int]) -> None:
    """Print what a problem over processes takes, and how far costs and answers are from those of the first number of them."""
    found = {f"{ranks}": share_out(job, size, ranks) for ranks in numbers}
    found[f"{numbers[0]}, in another order"] = share_out(job, size, numbers[0], mixed=True)
    costs = {name: rows[0]["costs"] for name, rows in found.items()}
    answers = {name: rows[0]["answer"] for name, rows in found.items()}
    names = [name for name in found[f"{numbers[0]}"][0] if name not in ("costs", "answer")]
    most = {ranks: {name: max(row[name] for row in found[f"{ranks}"]) for name in names} for ranks in numbers}
    print(table(most, "ranks"))
    first = f"{numbers[0]}"
    for name, rows in found.items():
        apart = ", ".join(f"{abs(a / b - 1):.0e}" for a, b in zip(costs[name], costs[first], strict=True))
        off = float((answers[name] - answers[first]).abs().max())
        print(f"{name}: {sum(row['cpu s'] for row in rows):.1f} core-seconds in all; cameras differ by {off:.0e}", end="")
        print(f", costs after each step by {apart}" if apart else "")


def apart(job: str, size: int, method: str) -> Row:
    """One row in a process of its own."""
    words = [sys.executable, "-m", "bench.scale", job, "--images", str(size), "--methods", method, "--worker", "here"]
    return dict(json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()[-1]))


def table(rows: dict[int, Row], first: str) -> str:
    """Markdown, with the exponents of seconds and of the memory that is more than before."""
    names = list(next(iter(rows.values())))
    lines = [f"| {first} | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    last: tuple[int, Row] | None = None
    for size, row in rows.items():
        cells = []
        for name in names:
            text = f"{row[name]:.3g}" if isinstance(row[name], float) else f"{row[name]}"
            if last is not None and name.endswith((" s", "MB")) and min(row[name], last[1][name]) > 0.05:
                old, new = last[1][name], row[name]
                if name == "MB":
                    old, new = old - last[1]["MB before"], new - row["MB before"]
                if min(old, new) > 0:
                    text += f" (exponent {math.log(new / old) / math.log(size / last[0]):.2f})"
            cells.append(text)
        lines.append(f"| {size} | " + " | ".join(cells) + " |")
        last = (size, row)
    return "\n".join(lines)


def predict(rows: dict[int, Row]) -> str:
    """Core-hours at large sizes: linear parts by image and by pair of the largest run, retrieval by its square, on top.

    Mapping grows as from the second largest run to it.
    """
    *others, size = sorted(rows)
    row = rows[size]
    per_image, per_pair = row["features s"] / size, (row["match s"] + row["verify s"]) / row["pairs compared"]
    grows = math.log(row["map s"] / rows[others[-1]]["map s"]) / math.log(size / others[-1]) if others else math.nan
    names = ["images", "features h", "retrieval h", "pairs", "match and verify h", f"mapping h (exponent {grows:.2f})"]
    lines = [f"| {' | '.join([*names, 'in days on 16 cores, mapping on one'])} |", "|---" * 7 + "|"]
    for n in LARGE:
        pairs = 0.75 * n * NEIGHBOURS
        # A product of 64 x 128 numbers for each pair of images at 30 GFLOP/s.
        hours = [n * per_image / 3600, 2 * 8192 * n**2 / 30e9 / 3600, pairs * per_pair / 3600]
        mapping = row["map s"] * (n / size) ** grows / 3600
        cells = [f"{hours[0]:.3g}", f"{hours[1]:.3g}", f"{pairs:.2g}", f"{hours[2]:.3g}", f"{mapping:.3g}"]
        cells.append(f"{sum(hours) / 16 / 24 + mapping / 24:.3g}")
        lines.append(f"| 10^{round(math.log10(n))} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Print the tables of one job."""
    parser = argparse.ArgumentParser(prog="python -m bench.scale", description="Growth with the number of photographs.")
    parser.add_argument("job", choices=("photographs", "features", "recall", *SHARED))
    parser.add_argument("--images", type=int, nargs="+")
    parser.add_argument("--methods", nargs="+", default=["incremental", "global"], help="mappers of photographs")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    sizes = options.images or ([SHARED[options.job][2]] if options.job in SHARED else [50, 100, 200])
    jobs: dict[str, Callable[[int], Row]] = {
        "photographs": partial(photographs, method=options.methods[0]),
        "features": simulated,
        "recall": recall,
    }
    if options.worker:
        row = rank_of(options.job, sizes[0], options.worker) if options.job in SHARED else jobs[options.job](sizes[0])
        print(json.dumps(row))
    elif options.job in SHARED:
        for size in sizes:
            compare_ranks(options.job, size, options.ranks)
    else:
        for method in options.methods if options.job == "photographs" else options.methods[:1]:
            rows = {size: apart(options.job, size, method) for size in sizes}
            print(table(rows, f"images, {method}" if options.job == "photographs" else "images"), flush=True)
        if options.job == "photographs":
            print("\nSmall photographs: what is said of larger numbers of them is a prediction.\n", predict(rows), sep="\n")


if __name__ == "__main__":
    main()
