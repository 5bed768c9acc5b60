"""Which linear solver serves which scene: streets, rings and crowds of cameras, by every solver and by what `auto` takes.

    python -m bench.linear_solvers [--cameras 200 600 2000] [--solvers auto dense sparse pcg]

Bundles with the statistics of Bundle Adjustment in the Large, tens of pixels off at the start, 50 points and 250 observations a
camera. Cameras go along a street ("path"), where the system of cameras is a long band, or stand around one object ("dome"),
where all have to do with all. Dense systems of more than 9,000 columns are left out. Seconds are those of a core.
"""

import argparse
import time

import torch

from torchsfm.bundle import bundle_adjust
from torchsfm.optim.solver_choice import LARGEST
from torchsfm.simulation import random_bundle_problem

COLUMNS = 9
"""Of a camera: pose, focal length, two numbers of distortion."""


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.linear_solvers", description="Bundles by every linear solver.")
    parser.add_argument("--cameras", type=int, nargs="+", default=[200, 600, 2000])
    parser.add_argument("--scenes", nargs="+", default=["path", "dome"])
    parser.add_argument("--solvers", nargs="+", default=["auto", "dense", "sparse", "pcg"])
    parser.add_argument("--iterations", type=int, default=50)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| scene | cameras | solver | steps | cost | status | core-seconds |", "|---" * 7 + "|", sep="\n")
    for scene in options.scenes:
        for cameras in options.cameras:
            generator = torch.Generator().manual_seed(0)
            problem = random_bundle_problem(cameras, 50 * cameras, 250 * cameras, layout=scene, generator=generator).problem
            for solver in options.solvers:
                if solver == "dense" and COLUMNS * cameras > LARGEST:
                    continue
                start = time.process_time()
                found = bundle_adjust(
                    problem, free=("focal", "k1", "k2"), linear_solver=solver, max_iterations=options.iterations
                )
                seconds = time.process_time() - start
                cells = scene, cameras, solver, found.iterations, f"{found.cost:.9g}", found.status.name, f"{seconds:.1f}"
                print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
