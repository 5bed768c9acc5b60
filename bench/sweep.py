"""The tests under many seeds and many arithmetics: which of them depend on luck or on the processor?

    python -m bench.sweep --workers 16 --seconds 420 --out failures.txt
    python -m bench.sweep --seeds 50 --workers 16                 # 50 seeds of every room, spread over the arithmetics
    python -m bench.sweep --every --seeds 1 --workers 2           # all arithmetics with every seed
    python -m bench.sweep tests/motion --every -- -k focal        # some tests; what follows -- goes to pytest

A job is one room's tests in a process of its own, with one thread, one `--seed` and one pair of `ATEN_CPU_CAPABILITY` (which
vector instructions PyTorch uses) and `MKL_CBWR` (which the MKL does). Without `--every`, each seed gives each room one of the
pairs, the next seed the next.
"""

import argparse
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TextIO

import torch

ROOT = Path(__file__).parent.parent
VECTORS = ("default", "avx2", "avx512")
BRANCHES = ("", "COMPATIBLE", "AVX2")
"""Of the MKL; empty for its own choice."""


@dataclass(frozen=True)
class Job:
    """One process."""

    tests: str
    seed: int
    vectors: str
    branch: str

    @property
    def setting(self) -> str:
        """What to type in front of pytest and after it to see the same again."""
        branch = f" MKL_CBWR={self.branch}" if self.branch else ""
        return f"ATEN_CPU_CAPABILITY={self.vectors}{branch} --seed {self.seed}"


@dataclass(frozen=True)
class Outcome:
    """What a process said: `failures` as pytest's summary has them, `end` its last line."""

    job: Job
    failures: tuple[str, ...]
    end: str


def rooms() -> list[str]:
    """Folders of tests and single files beside them."""
    folder = ROOT / "tests"
    inside = [p for p in folder.iterdir() if (p.is_dir() and any(p.glob("test_*.py"))) or p.match("test_*.py")]
    return sorted(str(p.relative_to(ROOT)) for p in inside)


def arithmetics() -> list[tuple[str, str]]:
    """Those that this processor has; one asked for beyond what it has would end the process."""
    most = torch.backends.cpu.get_cpu_capability().lower()
    known = VECTORS[: VECTORS.index(most) + 1] if most in VECTORS else VECTORS[:1]
    return list(product(known, BRANCHES))


def jobs(tests: list[str], seeds: range, every: bool) -> list[Job]:
    """By seeds, so that what is cut off by the clock is the last ones."""
    pairs = arithmetics()
    chosen = [
        (s, i, p) for s in seeds for p in range(len(pairs)) for i in range(len(tests)) if every or (s + i) % len(pairs) == p
    ]
    return [Job(tests[i], s, *pairs[p]) for s, i, p in chosen]


def run(job: Job, options: list[str], deadline: float) -> Outcome | None:
    """None where the clock did not leave time to finish."""
    left = deadline - time.monotonic()
    if left <= 0:
        return None
    environment = {k: v for k, v in os.environ.items() if k != "MKL_CBWR"}
    environment |= {"ATEN_CPU_CAPABILITY": job.vectors, "OMP_NUM_THREADS": "1"}
    if job.branch:
        environment["MKL_CBWR"] = job.branch
    command = [
        sys.executable,
        "-m",
        "pytest",
        job.tests,
        "-q",
        "-rfE",
        "-p",
        "no:cacheprovider",
        "--seed",
        str(job.seed),
        *options,
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=left)
    except subprocess.TimeoutExpired:
        return None
    failures = tuple(line for line in done.stdout.splitlines() if re.match(r"(FAILED|ERROR) ", line))
    lines = (done.stdout + done.stderr).strip().splitlines()
    end = lines[-1].strip("= ") if lines else "nothing said"
    if done.returncode not in (0, 1, 5) and not failures:  # 5: no test was chosen
        failures = (f"ERROR {job.tests} - pytest ended with {done.returncode}: {end}",)
    return Outcome(job, failures, end)


def report(outcomes: list[Outcome], wanted: int, out: TextIO) -> bool:
    """Failures by test, most frequent first; whether there were none."""
    by_test = defaultdict(list)
    for outcome in outcomes:
        for line in outcome.failures:
            name, _, reason = line.partition(" - ")
            by_test[name.split(" ", 1)[1]].append((outcome.job.setting, reason))
    passed = sum(int(m[1]) for o in outcomes if (m := re.search(r"(\d+) passed", o.end)))
    print(f"{len(outcomes)} of {wanted} jobs, {passed} tests passed, {len(by_test)} different tests failed", file=out)
    for name, cases in sorted(by_test.items(), key=lambda item: -len(item[1])):
        print(f"\n{name}: {len(cases)} times", file=out)
        for setting, reason in cases:
            print(f"    {setting}: {reason}", file=out)
    return not by_test


def main() -> None:
    """Run, and end with 1 if a test failed."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.sweep", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tests", nargs="*", help="folders or files of tests; all rooms unless said")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--every", action="store_true", help="every seed with every arithmetic")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--seconds", type=float, default=10 * 24 * 3600.0, help="when to stop")
    parser.add_argument("--out", type=Path, help="where the report goes, rewritten as jobs end")
    arguments = sys.argv[1:]
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    chosen, options = parser.parse_args(arguments[:cut]), arguments[cut + 1 :]
    deadline = time.monotonic() + chosen.seconds
    todo = jobs(chosen.tests or rooms(), range(chosen.first, chosen.first + chosen.seeds), chosen.every)
    outcomes: list[Outcome] = []
    with ThreadPoolExecutor(chosen.workers) as pool:
        for future in as_completed([pool.submit(run, job, options, deadline) for job in todo]):
            outcome = future.result()
            if outcome is None:
                continue
            outcomes.append(outcome)
            print(f"{outcome.job.tests} {outcome.job.setting}: {outcome.end}", flush=True)
            if chosen.out:
                with chosen.out.open("w") as file:
                    report(outcomes, len(todo), file)
    sys.exit(not report(outcomes, len(todo), sys.stdout))


if __name__ == "__main__":
    main()
