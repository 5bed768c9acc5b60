"""How many steps bundle adjustment takes to its minimum, and whether the derivatives it returns are those of the minimum.

`python -m bench.convergence` prints a line for each set of problems: generated ones (six cameras in a row, each with its own f,
k1 and k2, 80 points, 400 observations, with and without 10 % gross outliers), and those from `bal` in $TORCHSFM_DATA, where
there is such. A problem is adjusted to a tolerance of 1e-13 in at most `--steps`; `ok` counts those that end OK, `wrong` those
of them that twice as many steps from there still bring down by more than 1e-9. Then the default call is made with a derivative
wanted: `said` counts those that end OK, `off` those of them whose derivative is more than 1e-3 off central differences of the
minimum, and `worst` is the largest relative error among them.
"""

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import torch
from torch import Tensor

from bench.bundle import REAL, load
from bench.bundle_programs import LOSSES
from torchsfm._types import Status
from torchsfm.bundle import BundleResult, bundle_adjust_model
from torchsfm.bundle.bundle_adjust_model import BundleOptions
from torchsfm.geometry import BundleProblem
from torchsfm.optim.solver_choice import Solver
from torchsfm.simulation import random_bundle_problem

FREE = ("focal", "k1", "k2")


@dataclass(frozen=True)
class Outcome:
    """One problem: status and steps to 1e-13, what is left to gain there, and the error of the default call's derivative."""

    status: Status
    steps: int
    left: float
    default: Status | None = None
    error: float = 0.0


def generated(problems: int, outliers: float, first: int = 0) -> Iterator[BundleProblem]:
    """Problems by seed; seeds that show too little are left out."""
    found = 0
    for seed in count(first):
        if found == problems:
            return
        try:
            yield random_bundle_problem(6, 80, 400, outliers=outliers, generator=torch.Generator().manual_seed(seed)).problem
        except ValueError:
            continue
        found += 1


def shape(result: BundleResult) -> Tensor:
    """A number that no gauge changes: ratios of baselines, and focal lengths."""
    length = torch.linalg.vector_norm(result.poses.centre.diff(dim=0), dim=1)
    return 100 * (length[1:] / length[:-1]).sum() + result.cameras.K[:, 0, 0].sum()


def derivative_error(problem: BundleProblem, loss: str, solver: Solver) -> tuple[Status, float]:
    """The relative error of the derivative along a random change of the observations, by central differences."""
    options: BundleOptions = {"free": FREE, "loss": LOSSES[loss], "linear_solver": solver}
    leaf = problem.x.clone().requires_grad_()
    default = bundle_adjust_model(replace(problem, x=leaf), **options)
    if default.result.status != Status.OK:
        return default.result.status, 0.0
    (gradient,) = torch.autograd.grad(shape(default.result), leaf)
    away = 1e-4 * torch.randn(leaf.shape, generator=torch.Generator().manual_seed(0), dtype=leaf.dtype)
    # The minima must be known better than what they move by: at 1e-15 of the cost they are not.
    options |= {"tolerance": 1e-20, "max_iterations": 200}
    with torch.no_grad():
        sides = [replace(default.model, x=problem.x + sign * away) for sign in (1, -1)]
        plus, minus = (shape(bundle_adjust_model(side, **options).result) for side in sides)
    wanted, terms = (plus - minus) / 2, gradient * away
    # A sum of many terms may come near zero by chance.
    return Status.OK, float((terms.sum() - wanted).abs() / torch.maximum(wanted.abs(), terms.norm()))


def measure(problem: BundleProblem, loss: str, steps: int, solver: Solver, derivative: bool) -> Outcome:
    """Adjust, adjust again from there, and compare a derivative."""
    options: BundleOptions = {"free": FREE, "loss": LOSSES[loss], "linear_solver": solver, "max_iterations": steps}
    first = bundle_adjust_model(problem, **options | {"tolerance": 1e-13})
    again = bundle_adjust_model(first.model, **options | {"tolerance": 1e-15, "max_iterations": 2 * steps}).result
    left = (first.result.cost - again.cost) / max(first.result.cost, 1e-300)
    known = derivative_error(problem, loss, solver) if derivative else (None, 0.0)
    return Outcome(first.result.status, first.result.iterations, left, *known)


def line(name: str, loss: str, outcomes: list[Outcome]) -> str:
    """The table's line."""
    ok = [o for o in outcomes if o.status == Status.OK]
    steps = sorted(o.steps for o in ok)
    wrong = sum(o.left > 1e-9 for o in ok)
    said = [o for o in outcomes if o.default == Status.OK]
    found = f"{len(outcomes):4d} {len(ok):4d} {wrong:5d} {steps[len(steps) // 2] if steps else 0:6d} {max(steps, default=0):4d}"
    off = sum(not o.error <= 1e-3 for o in said)
    return f"{name:18s} {loss:8s} {found} {len(said):5d} {off:4d} {max((o.error for o in said), default=0.0):9.1e}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.convergence", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", default=Path(os.environ.get("TORCHSFM_DATA", ".")) / "bal", type=Path)
    parser.add_argument("--problems", type=int, default=50, help="generated ones of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--losses", nargs="+", default=["squares", "cauchy"], choices=[*LOSSES])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--solver", default="auto", choices=["auto", "dense", "sparse", "pcg"])
    parser.add_argument("--no-derivatives", dest="derivatives", action="store_false")
    parser.add_argument("--no-real", dest="real", action="store_false")
    parser.add_argument("--each", action="store_true", help="print every problem too")
    chosen = parser.parse_args()
    print(f"{'problems':18s} {'loss':8s} {'':>4s} {'ok':>4s} wrong median most  said  off     worst")
    for outliers in (0.0, 0.1):
        for loss in chosen.losses:
            outcomes = []
            for k, problem in enumerate(generated(chosen.problems, outliers, chosen.first)):
                outcomes.append(measure(problem, loss, chosen.steps, chosen.solver, chosen.derivatives))
                if chosen.each:
                    print(f"    {k} {outcomes[-1]}", flush=True)
            print(line(f"{outliers:.0%} outliers", loss, outcomes), flush=True)
    for name in [*REAL, "dubrovnik-3-7-pre.txt"] if chosen.real and chosen.folder.is_dir() else []:
        for loss in chosen.losses:
            outcome = measure(load(name, chosen.folder), loss, chosen.steps, chosen.solver, False)
            print(line(name.removesuffix("-pre.txt"), loss, [outcome]), flush=True)


if __name__ == "__main__":
    main()
