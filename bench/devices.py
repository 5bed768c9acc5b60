"""One program on several devices: time and error of solvers, robust estimators and bundle adjustment.

`python -m bench.devices --devices cpu cuda` prints a line for each task, device and dtype. Data are made on the CPU and sent
before the clock starts; a run ends when the device has done its work. Times are the clock's, the least of some runs after one
that warms up; on the CPU they hold for the given number of threads.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any, TypeVar

import torch

from bench import ransac
from bench.cases import CASES, Case
from bench.cases.case import nearest
from bench.measures.recall import drawn
from torchsfm._types import tensor_map
from torchsfm.bundle import bundle_adjust_model
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.optim import Huber
from torchsfm.resection import estimate_camera
from torchsfm.simulation import random_bundle_problem

T = TypeVar("T")
SOLVERS = ("fundamental_7pt", "essential_5pt", "homography_4pt", "camera_p3p")
PROBLEMS = {"L138": (138, 20_000, 81_000, "path"), "D356": (356, 226_000, 1_250_000, "dome")}


def send(tree: T, device: str, dtype: torch.dtype) -> T:
    """All tensors of a tree on a device; those of floating point in a dtype."""
    moved: T = tensor_map(lambda x: x.to(device, dtype if x.is_floating_point() else x.dtype), tree)
    return moved


def wait(device: str) -> None:
    """Until the device has done its work."""
    if device != "cpu":
        torch.accelerator.synchronize()


def least(call: Callable[[], T], device: str, repeats: int) -> tuple[float, T]:
    """The least seconds of some calls after one that warms up, and what the last returned."""
    found = call()
    best = float("inf")
    for _ in range(repeats):
        wait(device)
        start = time.perf_counter()
        found = call()
        wait(device)
        best = min(best, time.perf_counter() - start)
    return best, found


def solver(case: Case, batch: int, repeats: int, device: str, dtype: torch.dtype) -> str:
    """Microseconds a sample, and the share of samples whose model is found."""
    sample, truth = drawn(case, "random", batch, torch.float64)
    there = send(sample, device, dtype)
    seconds, found = least(lambda: case.solve(*there), device, repeats)
    share = (nearest(case, send(found, "cpu", torch.float64), truth) < case.tolerances[dtype]).double().mean()
    return f"{1e6 * seconds / batch:9.4f} us a sample, found {share:.4f}"


def robust(model: str, pairs: int, inliers: float, repeats: int, device: str, dtype: torch.dtype) -> str:
    """Milliseconds a pair, and the errors as in `bench.ransac`."""
    scene = ransac.scenes(model, pairs, inliers, 0)
    x1, x2, K = send((scene.x1, scene.x2, ransac.K), device, dtype)
    doors: dict[str, Callable[..., Any]] = {
        "F": lambda **o: estimate_fundamental(x1, x2, **o),
        "H": lambda **o: estimate_homography(x1, x2, **o),
        "P": lambda **o: estimate_camera(x2, x1, K, **o),
        "E": lambda **o: estimate_essential(ransac.rays(x1), ransac.rays(x2), **o),
    }
    threshold = ransac.THRESHOLD[model] / (ransac.FOCAL if model == "E" else 1)

    def call() -> Any:
        generator = torch.Generator(device).manual_seed(0)
        return doors[model](threshold=threshold, confidence=ransac.CONFIDENCE, max_iterations=ransac.MOST, generator=generator)

    seconds, found = least(call, device, repeats)
    error = ransac.errors(model, scene, found.model.cpu().double())
    unit = "px" if model == "H" else "degrees"
    return f"{1e3 * seconds / pairs:9.4f} ms a pair, {error.median():.4f} {unit}, p95 {error.quantile(0.95):.4f}"


def bundle(name: str, device: str, dtype: torch.dtype) -> str:
    """Seconds of a whole adjustment, and the cost it ends at."""
    *counts, layout = PROBLEMS[name]
    problem = random_bundle_problem(*counts, layout=layout, generator=torch.Generator().manual_seed(0)).problem  # type: ignore[arg-type]
    there = send(problem, device, dtype)
    seconds, found = least(
        lambda: bundle_adjust_model(there, free=("focal", "k1", "k2"), loss=Huber(1.0), tolerance=1e-6).result, device, 1
    )
    return f"{seconds:9.3f} s, {found.iterations} steps, cost {found.cost:.6g}"


def tasks(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[str, torch.dtype], str], tuple[torch.dtype, ...]]]:
    """What is timed, by name, and in which dtypes."""
    both = (torch.float64, torch.float32)
    for case in (case for case in CASES if case.name in SOLVERS):
        for batch in options.samples:
            yield f"{case.name} {batch}", partial(solver, case, batch, options.repeats), both
    for model, pairs, inliers in product(options.models, options.pairs, options.inliers):
        yield f"{model} {pairs} pairs, {inliers:g} inliers", partial(robust, model, pairs, inliers, options.repeats), both
    for name in options.problems:
        yield f"bundle {name}", partial(bundle, name), both[:1]


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.devices", description=__doc__)
    parser.add_argument("--devices", nargs="+", default=["cpu"])
    parser.add_argument("--threads", type=int, default=1, help="of the CPU")
    parser.add_argument("--samples", type=int, nargs="*", default=[4096, 262144], help="batches of the solvers")
    parser.add_argument("--models", default="FHPE")
    parser.add_argument("--pairs", type=int, nargs="*", default=[1, 64, 1024])
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.5])
    parser.add_argument("--problems", nargs="*", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    for name, task, dtypes in tasks(options):
        for device in options.devices:
            for dtype in dtypes:
                try:
                    line = task(device, dtype)
                except RuntimeError as error:  # a device that lacks memory or an operation
                    line = str(error).splitlines()[0][:90]
                print(f"{name:26s} {device:5s} {str(dtype)[6:]:8s} {line}", flush=True)


if __name__ == "__main__":
    main()
