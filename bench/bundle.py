"""Bundle adjustment against Ceres (through pycolmap) and SciPy: cost against time, and memory, from one start with one loss.

`python -m bench.bundle` runs real problems (from `bal` in $TORCHSFM_DATA, where there is such) and generated ones with the
statistics of Bundle Adjustment in the Large, every program in a process of its own, and prints a table; `--trace` adds the cost
after every iteration, `--json FILE` writes all of it. `--problems C2000` is the one with 2,000 cameras.

Cameras have f, k1 and k2 free. Observations of points behind their cameras are left out for all (COLMAP drops them anyway), but
for the line `all`, which is this library's on everything. Runs alternate, and the one with least processor time (with one
thread; else least time) counts. The memory is the peak during the solution above what the process held before, problem and
imports included; a small problem is adjusted before, so that torch has loaded what it loads on first use.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from bench.bundle_programs import LOSSES, Run, in_front, run_ceres, run_scipy, run_torchsfm
from torchsfm.formats import read_bal, read_libmv
from torchsfm.geometry import BundleProblem
from torchsfm.simulation import random_bundle_problem

REAL = {
    "ladybug-49": "problem-49-7776-pre.txt.gz",
    "trafalgar-21": "problem-21-11315-pre.txt.gz",
    "libmv": "libmv_problem_01.bin",
}
GENERATED: dict[str, tuple[int, int, int, str]] = {
    "L49": (49, 7_700, 28_000, "path"),
    "L138": (138, 20_000, 81_000, "path"),
    "D16": (16, 22_000, 83_000, "dome"),
    "D356": (356, 226_000, 1_250_000, "dome"),
    "C2000": (2_000, 60_000, 300_000, "path"),
}
PROGRAMS: dict[str, Callable[[BundleProblem, int, str], Run]] = {
    "torchsfm": run_torchsfm,
    "all": run_torchsfm,
    "ceres-dense": lambda problem, threads, loss: run_ceres(problem, threads, loss, "DENSE_SCHUR"),
    "ceres-sparse": lambda problem, threads, loss: run_ceres(problem, threads, loss, "SPARSE_SCHUR"),
    "ceres-iterative": lambda problem, threads, loss: run_ceres(problem, threads, loss, "ITERATIVE_SCHUR"),
    "scipy": run_scipy,
}


def load(name: str, folder: Path) -> BundleProblem:
    """A problem by its name."""
    if name in GENERATED:
        *counts, layout = GENERATED[name]
        return random_bundle_problem(*counts, layout=layout, generator=torch.Generator().manual_seed(0)).problem  # type: ignore[arg-type]
    path = folder / REAL.get(name, name)
    return read_libmv(path) if path.suffix == ".bin" else read_bal(path)


def work(name: str, program: str, threads: int, loss: str, folder: Path) -> None:
    """One run, printed as a line of JSON."""
    problem = load(name, folder)
    # Libraries are loaded on first use; Ceres' already are.
    run_torchsfm(random_bundle_problem(4, 40, 120, generator=torch.Generator().manual_seed(0)).problem, threads, loss)
    print(json.dumps(asdict(PROGRAMS[program](problem if program == "all" else in_front(problem), threads, loss))))


def measure(name: str, program: str, threads: int, loss: str, folder: Path, limit: float) -> dict[str, Any]:
    """A run in a process of its own."""
    command = [sys.executable, "-m", "bench.bundle", "--folder", str(folder), "--worker", name, program, str(threads), loss]
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return {"note": f"not within {limit:g} s"}
    if done.returncode:
        return {"note": (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1][:60]}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", default=Path(os.environ.get("TORCHSFM_DATA", ".")) / "bal", type=Path)
    parser.add_argument("--problems", nargs="+", default=[*REAL, "L49", "L138", "D16"], help="names, or files in the folder")
    parser.add_argument("--programs", nargs="+", default=[*PROGRAMS], choices=[*PROGRAMS])
    parser.add_argument("--threads", nargs="+", type=int, default=[1])
    parser.add_argument("--loss", default="squares", choices=[*LOSSES])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--limit", type=float, default=600, help="most seconds a run may take")
    parser.add_argument("--trace", action="store_true", help="print the cost after each iteration")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        name, program, threads, loss = arguments.worker
        work(name, program, int(threads), loss, arguments.folder)
        return
    record = []
    head = f"{'problem':14s} {'program':16s} threads {'first cost':>13s} {'last cost':>13s} {'steps':>5s}"
    print(f"{head} {'time, s':>8s} {'cpu, s':>8s} {'ms / step':>9s} {'MB':>7s}")
    for name in arguments.problems:
        if name in REAL and not (arguments.folder / REAL[name]).exists():
            print(f"{name:14s} not in {arguments.folder}")
            continue
        for threads in arguments.threads:
            runs: dict[str, list[dict[str, Any]]] = {program: [] for program in arguments.programs}
            for _ in range(arguments.repeats):
                for program, found in runs.items():
                    if not found or "cost" in found[-1]:
                        found.append(measure(name, program, threads, arguments.loss, arguments.folder, arguments.limit))
            for program, found in runs.items():
                good = [run for run in found if "cost" in run]
                if not good:
                    print(f"{name:14s} {program:16s} {threads:7d} {found[-1]['note']}")
                    continue
                best = min(good, key=lambda run: run["cpu" if threads == 1 else "seconds"])
                record.append({"problem": name, "program": program, "threads": threads, **best})
                first = best["trace"][0][1] if best["trace"] else float("nan")
                step = 1e3 * best["seconds"] / max(best["iterations"], 1)
                print(
                    f"{name:14s} {program:16s} {threads:7d} {first:13.6g} {best['cost']:13.7g} {best['iterations']:5d}"
                    f" {best['seconds']:8.3f} {best['cpu']:8.3f} {step:9.1f} {best['memory']:7.1f}",
                    flush=True,
                )
                if arguments.trace:
                    print("    " + "  ".join(f"{seconds:.3f}: {cost:.6g}" for seconds, cost in best["trace"]))
    if arguments.json:
        arguments.json.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
