"""Targets tried at random in several processes, with a limit on the time of each trial, and the table of what went wrong.

A trial is made by its target's name and a seed alone, so that each failure can be seen again by itself. Its time is that of the
processor, for on a busy machine the clock says nothing.
"""

import argparse
import importlib
import multiprocessing
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

ASLEEP = 20
"""After so many times its limit by the clock a trial hangs though it takes no time of the processor."""
CHECKPOINT = 60.0
"""Seconds after which what is known is written down."""


class Trial(NamedTuple):
    """What came of one trial."""

    inputs: int
    """How many bad inputs it was made of."""
    broken: tuple[str, ...] = ()
    """The promises that were not kept, each as `kind: what`."""


@dataclass(frozen=True)
class Target:
    """Something that takes input."""

    name: str
    """With its room or format before it: `motion.fundamental_7pt`."""
    attempt: Callable[[int], Trial]
    """Make bad input from a seed, and say whether the promises hold. What it raises counts as broken."""


@dataclass
class Tally:
    """What came of all trials of a target."""

    trials: int = 0
    inputs: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    kinds: Counter[str] = field(default_factory=Counter)
    examples: dict[str, tuple[int, str]] = field(default_factory=dict)
    """Of each kind of failure the first seed, and the words."""

    def add(self, seed: int, trial: Trial, seconds: float) -> None:
        """Count one trial."""
        self.trials += 1
        self.inputs += trial.inputs
        self.seconds += seconds
        self.slowest = max(self.slowest, seconds)
        for broken in trial.broken:
            kind = broken.partition(":")[0]
            self.kinds[kind] += 1
            self.examples.setdefault(kind, (seed, broken))


def attempt(target: Target, seed: int) -> Trial:
    """One trial, in this process."""
    try:
        return target.attempt(seed)
    except Exception as error:  # whatever it is, it was not promised
        frame = next((f for f in reversed(traceback.extract_tb(error.__traceback__)) if "torchsfm" in f.filename), None)
        place = f"{Path(frame.filename).name}:{frame.lineno}" if frame else "?"
        text = " ".join(str(error).split())[:160]
        return Trial(1, (f"raised {type(error).__name__} at {place}: {text}",))


def targets_of(modules: Sequence[str]) -> dict[str, Target]:
    """The targets that modules make with their `load()`, by name."""
    return {target.name: target for module in modules for target in importlib.import_module(module).load()}


def _work(modules: Sequence[str], known: dict[str, Tally], first: int, step: int, limit: float, pipe: Connection) -> None:
    """Try the targets by turns; tell before and after each trial, which ends the process if it takes too long.

    Next is the one of which inputs times seconds so far are least, those of workers before it too: slow ones get fewer inputs,
    fast ones less time. A trial counts as one input at least, or one that never finds anything to try would be next for ever.
    """
    import torch

    torch.set_num_threads(1)
    targets = targets_of(modules)
    spent, inputs = ({name: one(tally) for name, tally in known.items()} for one in (lambda t: t.seconds, lambda t: t.inputs))
    timed = hasattr(signal, "setitimer")
    seeds = dict.fromkeys(known, first)
    while True:
        name = min(known, key=lambda name: (1 + inputs[name]) * spent[name])
        seed = seeds[name]
        seeds[name] += step
        pipe.send((name, seed, None, 0.0))
        if timed:
            signal.setitimer(signal.ITIMER_PROF, limit)  # SIGPROF ends the process also within one long call
        start = time.process_time()
        trial = attempt(targets[name], seed)
        seconds = time.process_time() - start
        if timed:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        spent[name] += seconds
        inputs[name] += max(trial.inputs, 1)
        pipe.send((name, seed, trial, seconds))


class _Worker:
    """A process, and what it is at."""

    def __init__(self, modules: Sequence[str], known: dict[str, Tally], first: int, step: int, limit: float) -> None:
        self.pipe, other = multiprocessing.Pipe()
        context: Any = multiprocessing.get_context("spawn")
        self.process = context.Process(target=_work, args=(modules, known, first, step, limit, other), daemon=True)
        self.process.start()
        other.close()
        self.at: tuple[str, int] | None = None
        self.since = time.perf_counter()

    def stop(self) -> None:
        """End the process, whatever it is at."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def run(
    modules: Sequence[str],
    names: list[str],
    *,
    workers: int,
    seed: int,
    inputs: int | None,
    seconds: float | None,
    limit: float,
    checkpoint: Callable[[dict[str, Tally]], object] = lambda tallies: None,
) -> dict[str, Tally]:
    """Try the targets of these names until there were enough inputs or the time is over.

    Args:
        modules: Those with a `load() -> list[Target]`, which each process calls.
        names: Which of them to try.
        workers: The number of processes.
        seed: The first seed of every target.
        inputs: After how many bad inputs to stop.
        seconds: After what time to stop.
        limit: The seconds of the processor after which a trial counts as hanging; its process is killed, and another goes on.
        checkpoint: Called now and then with what is known.
    """
    tallies = {name: Tally() for name in names}
    crew = [_Worker(modules, tallies, seed + i, workers, limit) for i in range(workers)]
    start, total, restarts = time.perf_counter(), 0, 0
    written = start
    try:
        while (inputs is None or total < inputs) and (seconds is None or time.perf_counter() - start < seconds):
            for ready in wait([worker.pipe for worker in crew], timeout=1.0):
                worker = next(w for w in crew if w.pipe is ready)
                try:
                    name, at, trial, took = worker.pipe.recv()
                except EOFError:
                    continue
                worker.since = time.perf_counter()
                worker.at = (name, at) if trial is None else None
                if trial is not None:
                    tallies[name].add(at, trial, took)
                    total += trial.inputs
            for i, worker in enumerate(crew):
                took = time.perf_counter() - worker.since
                dead = not worker.process.is_alive() and not worker.pipe.poll()
                if worker.at is not None and (dead or took > ASLEEP * limit):
                    name, at = worker.at
                    crashed = dead and worker.process.exitcode != -getattr(signal, "SIGPROF", 0)
                    what = f"crashed: exit code {worker.process.exitcode}" if crashed else f"hung: more than {limit:.0f} s"
                    tallies[name].add(at, Trial(1, (what,)), took)
                    worker.stop()
                    restarts += 1
                    crew[i] = _Worker(modules, tallies, seed + i + 1_000_003 * restarts, workers, limit)
                elif dead:
                    raise RuntimeError(f"a worker ended before its first trial, with exit code {worker.process.exitcode}")
            if time.perf_counter() - written > CHECKPOINT:
                written = time.perf_counter()
                checkpoint(tallies)
    finally:
        for worker in crew:
            worker.stop()
    return tallies


def report(tallies: dict[str, Tally]) -> str:
    """The table of targets, and the failures with the seeds that show them."""
    lines = [f"{'target':44} {'trials':>8} {'inputs':>9} {'ms each':>8} {'slowest s':>9} {'broken':>7}"]
    for name, tally in sorted(tallies.items()):
        each = 1e3 * tally.seconds / max(tally.trials, 1)
        broken = sum(tally.kinds.values())
        lines.append(f"{name:44} {tally.trials:8} {tally.inputs:9} {each:8.1f} {tally.slowest:9.2f} {broken or '':>7}")
    total = Tally()
    for tally in tallies.values():
        total.trials += tally.trials
        total.inputs += tally.inputs
        total.kinds += tally.kinds
    lines += ["", f"{total.trials} trials, {total.inputs} bad inputs, {sum(total.kinds.values())} promises broken"]
    for name, tally in sorted(tallies.items()):
        for kind, (seed, words) in sorted(tally.examples.items()):
            lines.append(f"{name} --seed {seed} ({tally.kinds[kind]} times): {words}")
    return "\n".join(lines)


def main(modules: Sequence[str], description: str | None) -> None:
    """The command line of a set of targets."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--inputs", "--files", type=int, help="stop after so many bad inputs")
    parser.add_argument("--seconds", type=float, help="stop after this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--rooms", nargs="*", help="rooms or formats; all by default")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of the processor after which a trial hangs")
    parser.add_argument("--only", help="try one target once, with this seed, and say what breaks")
    parser.add_argument("--list", action="store_true", help="names of the targets")
    parser.add_argument("--out", type=Path, help="write the table here too, each minute")
    options = parser.parse_args()
    targets = targets_of(modules)
    rooms = {name.partition(".")[0] for name in targets}
    unknown = set(options.rooms or ()) - rooms
    if unknown:
        parser.error(f"no room or format {', '.join(sorted(unknown))}; there are {', '.join(sorted(rooms))}")
    names = [name for name in targets if not options.rooms or name.partition(".")[0] in options.rooms]
    if options.list:
        print("\n".join(names))
        return
    if options.only:
        if options.only not in targets:
            parser.error(f"no target {options.only!r}")
        print("\n".join(targets[options.only].attempt(options.seed).broken) or "nothing broken")
        return
    inputs = options.inputs if options.inputs or options.seconds else 100_000

    def write(tallies: dict[str, Tally]) -> str:
        text = report(tallies)
        if options.out:
            options.out.write_text(text + "\n")
        return text

    tallies = run(
        modules, names, workers=options.workers, seed=options.seed, inputs=inputs, seconds=options.seconds, limit=options.limit,
        checkpoint=write,
    )  # fmt: skip
    print(write(tallies))
    sys.exit(any(tally.kinds for tally in tallies.values()))
