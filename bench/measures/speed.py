"""Samples solved per second of CPU time on one thread, programs in turn."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from bench.cases.case import Case
from bench.measures.recall import drawn, singles

SINGLES = 500
"""Samples of a round of a program that takes one at a time."""


def timed(function: Callable[[], Any], samples: int) -> float:
    """Seconds a sample."""
    start = time.process_time()
    function()
    return (time.process_time() - start) / samples


def programs(case: Case, batch: int) -> dict[str, tuple[Callable[[], Any], int]]:
    """Calls to be timed, and how many samples each solves."""
    sample, _ = drawn(case, "random", batch, torch.float64)
    calls: dict[str, tuple[Callable[[], Any], int]] = {"torchsfm": (partial(case.solve, *sample), batch)}
    for name, peer in case.peers.items():
        if not peer.installed():
            continue
        solve = peer.make()
        if peer.batched:
            calls[name] = partial(solve, *sample), batch
        else:
            few = singles(tuple(x[:SINGLES] for x in sample))
            calls[name] = partial(looped, solve, few), len(few)
    return calls


def looped(solve: Callable[..., Any], few: list[tuple[Any, ...]]) -> None:
    for one in few:
        solve(*one)


def speeds(case: Case, batch: int, repeats: int) -> dict[str, float]:
    """The least seconds a sample of every program, in alternating rounds after one to warm up."""
    calls = programs(case, batch)
    best = dict.fromkeys(calls, float("inf"))
    for round_ in range(repeats + 1):
        for name, (call, samples) in calls.items():
            seconds = timed(call, samples)
            best[name] = min(best[name], seconds) if round_ else float("inf")
    return best


def report(case: Case, batch: int, repeats: int) -> dict[str, float]:
    """Print a line for each program."""
    found = speeds(case, batch, repeats)
    if case.published:
        found["PoseLib's C++ (published)"] = 1 / case.published
    for program, seconds in found.items():
        ratio = f"{found['PoseLib'] / seconds:7.2f}" if "PoseLib" in found else ""
        print(f"{case.name:18s} {program:26s} {1e6 * seconds:9.3f} {1 / seconds:12,.0f} {ratio}", flush=True)
    return found


def header() -> str:
    return f"{'solver':18s} {'program':26s} {'us':>9s} {'solves/s':>12s} times a call to PoseLib"
