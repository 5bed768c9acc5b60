"""How time and memory grow with the number of photographs, and what that says of more than one machine holds.

    python -m bench.scale photographs --images 50 100 200     # the whole job on rendered photographs; 400 800 take hours
    python -m bench.scale features --images 1000 3000 10000   # retrieval and the division of pairs, on simulated features
    python -m bench.scale recall --images 60                  # which verified pairs retrieval finds, k = 5 to 50
    python -m bench.scale bundle --ranks 1 2 4                # memory, bytes and processor time of a bundle over processes

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
    from torchsfm.reconstruction.match_all import PairShards

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
    from torchsfm.reconstruction import match_all
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


def bundle(ranks: int, mixed: bool = False) -> list[dict[str, Any]]:
    """A bundle of 200 cameras over processes: what each of them takes; `mixed` has the points in another order."""
    from torchsfm._types import tensor_map
    from torchsfm.simulation import random_bundle_problem

    with tempfile.TemporaryDirectory() as folder:
        problem = random_bundle_problem(200, 120_000, 600_000, generator=torch.Generator().manual_seed(0)).problem
        if mixed:
            order = torch.randperm(len(problem.X), generator=torch.Generator().manual_seed(0))
            problem = replace(problem, X=problem.X[order], point=torch.argsort(order)[problem.point])
        # Views of larger tensors would be saved with all of these.
        torch.save(tensor_map(torch.clone, problem), Path(folder) / "problem")
        words = [sys.executable, "-m", "bench.scale", "bundle", "--worker", folder]
        group = [
            subprocess.Popen(words, env=os.environ | {"RANK": str(rank), "WORLD_SIZE": str(ranks)}, stdout=subprocess.PIPE)
            for rank in range(ranks)
        ]
        return [json.loads(process.communicate()[0].splitlines()[-1]) for process in group]


def bundle_worker(folder: str) -> dict[str, Any]:
    """One rank of `bundle`."""
    import torch.distributed as dist

    from torchsfm.bundle import bundle_adjust

    ranks = int(os.environ["WORLD_SIZE"])
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=int(os.environ["RANK"]), world_size=ranks)
    sent: list[int] = []
    reduce = dist.all_reduce

    def counted(x: torch.Tensor, *options: Any, **more: Any) -> Any:
        sent.append(x.numel() * x.element_size())
        return reduce(x, *options, **more)

    dist.all_reduce = counted
    problem = torch.load(Path(folder) / "problem", weights_only=False)
    costs: dict[int, float] = {}
    before, start = memory(), time.process_time()
    result = bundle_adjust(
        problem, free=("focal", "k1", "k2"), linear_solver="pcg", max_iterations=5, tolerance=0.0, group=dist.group.WORLD,
        progress=costs.__setitem__,
    )  # fmt: skip
    spent = time.process_time() - start
    own = 72 * len(problem.poses.t)
    row = {
        "costs": list(costs.values()),
        "final cost": result.cost,
        "cpu s": spent,
        "MB before": before,
        "MB more": memory() - before,
        "messages": len(sent),
        "of a CG step": sent.count(own),
        "bytes of others": sum(sent) - own * sent.count(own),
    }
    dist.destroy_process_group()
    return row


def compare_ranks(numbers: list[int]) -> None:
    """Print what a bundle over processes takes, and how far its costs are from those of the first number of them."""
    found = {f"{ranks}": bundle(ranks) for ranks in numbers} | {f"{numbers[0]}, points mixed": bundle(numbers[0], mixed=True)}
    costs = {name: rows[0].pop("costs") for name, rows in found.items()}
    most = {ranks: {name: max(row[name] for row in found[f"{ranks}"]) for name in found[f"{ranks}"][0]} for ranks in numbers}
    print(table(most, "ranks"))
    first = costs[f"{numbers[0]}"]
    for name, rows in found.items():
        apart = ", ".join(f"{abs(a / b - 1):.0e}" for a, b in zip(costs[name], first, strict=True))
        print(f"{name}: {sum(row['cpu s'] for row in rows):.1f} core-seconds in all; costs after each step differ by {apart}")


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
    parser.add_argument("job", choices=("photographs", "features", "recall", "bundle"))
    parser.add_argument("--images", type=int, nargs="+", default=[50, 100, 200])
    parser.add_argument("--methods", nargs="+", default=["incremental", "global"], help="mappers of photographs")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    jobs: dict[str, Callable[[int], Row]] = {
        "photographs": partial(photographs, method=options.methods[0]),
        "features": simulated,
        "recall": recall,
    }
    if options.worker:
        row = bundle_worker(options.worker) if options.job == "bundle" else jobs[options.job](options.images[0])
        print(json.dumps(row))
    elif options.job == "bundle":
        compare_ranks(options.ranks)
    else:
        for method in options.methods if options.job == "photographs" else options.methods[:1]:
            rows = {size: apart(options.job, size, method) for size in options.images}
            print(table(rows, f"images, {method}" if options.job == "photographs" else "images"), flush=True)
        if options.job == "photographs":
            print("\nSmall photographs: what is said of larger numbers of them is a prediction.\n", predict(rows), sep="\n")


if __name__ == "__main__":
    main()
