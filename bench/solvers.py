"""Solvers judged: recall, speed, number of solutions, derivatives, bad input, against PoseLib, OpenCV and kornia; one thread.

`python -m bench.solvers` prints the tables, `--write` writes the short one into RESULTS.md; `pytest bench/solvers.py` times the
solvers with pytest-benchmark. PoseLib and OpenCV solve one sample a call, kornia and this library a batch; a call to a C++
solver from Python costs a few microseconds by itself. Solvers are added in `bench/cases/`.
"""

import argparse
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.cases import CASES, Case
from bench.cases.case import nearest
from bench.measures import bad_data, counts, gradients, recall, speed

RESULTS = Path(__file__).parent / "RESULTS.md"
MARKERS = "<!-- solvers: made by `python -m bench.solvers --write` -->", "<!-- end of solvers -->"
PARTS = ("recall", "speed", "counts", "gradients", "bad")


def short_row(case: Case, options: argparse.Namespace) -> str:
    """One solver's line of the short table."""
    double, single = (recall.recall(case, "random", options.samples, d).share for d in (torch.float64, torch.float32))
    shares = [(recall.recall(case, family, options.samples, torch.float64).share, family) for family in case.families]
    least, where = min(shares, default=(1.0, ""))
    times = speed.speeds(case, options.batch, options.repeats)
    peers = ", ".join(f"{name} {1e6 * times[name]:.2f}" for name in case.peers if name in times)
    cells = [
        f"`{case.name}`",
        str(case.size),
        str(case.slots),
        f"{double:.4f} / {single:.4f}",
        (f"{least:.4f}" if shares else "") + (f" ({where})" if least < 1 else ""),
    ]
    cells += [f"{1e6 * times['torchsfm']:.2f}", peers]
    return "| " + " | ".join(cells) + " |"


def write_results(rows: list[str]) -> None:
    """Put the table between the markers."""
    table = [
        "| solver | data | solutions | recall f64 / f32 | least recall on hard scenes | µs | µs of others |",
        "|---|---|---|---|---|---|---|",
        *rows,
    ]
    text = RESULTS.read_text()
    pattern = re.compile(re.escape(MARKERS[0]) + ".*?" + re.escape(MARKERS[1]), re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise SystemExit(f"{RESULTS} has no place for the table: {MARKERS}")
    block = "\n".join((MARKERS[0], *table, MARKERS[1]))
    RESULTS.write_text(pattern.sub(lambda _: block, text))


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m bench.solvers", description=__doc__)
    names = [case.name for case in CASES]
    parser.add_argument("--solvers", nargs="+", choices=names, default=names)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--samples", type=int, default=10_000, help="for recall, per family, and for counts")
    parser.add_argument("--peer-samples", type=int, default=2000, help="the most for a peer's recall")
    parser.add_argument("--gradient-samples", type=int, default=100_000)
    parser.add_argument("--batch", type=int, default=16384, help="samples for timing")
    parser.add_argument("--repeats", type=int, default=5, help="rounds of timing")
    parser.add_argument("--write", action="store_true", help="the short table alone, into RESULTS.md")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cases = [case for case in CASES if case.name in options.solvers]
    if options.write:
        rows = []
        for case in cases:
            rows.append(short_row(case, options))
            print(rows[-1], flush=True)
        write_results(rows)
        return
    for part in options.parts:
        module = {"recall": recall, "speed": speed, "counts": counts, "gradients": gradients, "bad": bad_data}[part]
        print(f"\n{module.header()}")
        for case in cases:
            if part == "recall":
                recall.report(case, options.samples, options.peer_samples)
            elif part == "speed":
                speed.report(case, options.batch, options.repeats)
            elif part == "counts":
                counts.report(case, options.samples)
            elif part == "gradients":
                gradients.report(case, options.gradient_samples)
            else:
                bad_data.report(case)


@pytest.mark.parametrize("batch", [256, 4096])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_speed(benchmark: Any, case: Case, batch: int) -> None:
    torch.set_num_threads(1)
    sample, truth = recall.drawn(case, "random", batch, torch.float64)
    solutions = benchmark(case.solve, *sample)
    assert (nearest(case, solutions, truth) < case.tolerances[torch.float64]).double().mean() > 0.99


if __name__ == "__main__":
    main()
