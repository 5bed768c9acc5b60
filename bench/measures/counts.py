"""How many solutions: against PoseLib on the same samples, the same one twice, and where two merge."""

import torch
from torch import Tensor

from bench.cases.case import Case, Sample
from bench.measures.recall import drawn, peer_solutions
from torchsfm import Solutions

STEPS = (1e-3, 1e-5, 1e-7)
"""Distances from where two solutions merge, relative to the distance of two random samples."""


def histogram(valid: Tensor, slots: int) -> list[float]:
    """The share of samples with 0, 1, 2, ... solutions."""
    count = valid.sum(-1).clamp_max(slots)
    return [(count == k).double().mean().item() for k in range(slots + 1)]


def duplicates(case: Case, solutions: Solutions[Tensor], closer: float = 1e-7) -> float:
    """The share of samples of which two valid slots hold the same solution."""
    slots = solutions.valid.shape[-1]
    same = torch.zeros(len(solutions.valid), dtype=torch.bool)
    for i in range(slots):
        for j in range(i):
            both = solutions.valid[:, i] & solutions.valid[:, j]
            gap = case.error(solutions.model[:, i : i + 1].double(), solutions.model[:, j].double())[:, 0]
            same |= both & (gap < closer)
    return same.double().mean().item()


def where_two_merge(case: Case, samples: int) -> dict[float, tuple[float, float]]:
    """On the way from one sample to another the number of solutions changes where two merge, and this is found by bisection.

    Returns:
        For each distance from there, on the side where both exist: the share of samples of which both are found, and of those
        that have no more solutions than that.
    """
    a, _ = drawn(case, "random", samples, torch.float64, seed=2)
    b, _ = drawn(case, "random", samples, torch.float64, seed=3)

    def at(s: Tensor) -> Sample:
        return tuple(x + s.reshape(-1, *[1] * (x.ndim - 1)) * (y - x) for x, y in zip(a, b, strict=True))

    def count(s: Tensor) -> Tensor:
        return case.solve(*at(s)).valid.sum(-1)

    low, high = torch.zeros(samples, dtype=torch.float64), torch.full((samples,), 0.02, dtype=torch.float64)
    first = count(low)
    for _ in range(45):
        middle = 0.5 * (low + high)
        left = count(middle) == first
        low, high = torch.where(left, middle, low), torch.where(left, high, middle)
    before, after = count(low), count(high)
    more = torch.maximum(before, after)
    change = (before - after).abs() == 2
    result = {}
    for step in STEPS:
        found = count(torch.where(before > after, low - step, high + step))[change]
        result[step] = (found >= more[change]).double().mean().item(), (found <= more[change]).double().mean().item()
    return result


def report(case: Case, samples: int) -> None:
    """Print the counts of one solver."""
    sample, _ = drawn(case, "random", samples, torch.float64, seed=4)
    ours = case.solve(*sample)
    lines = {"torchsfm": ours}
    for name in ("PoseLib", "OpenCV"):
        if name in case.peers and case.peers[name].installed():
            lines[name] = peer_solutions(case, case.peers[name], sample)
    for name, solutions in lines.items():
        mean = solutions.valid.sum(-1).double().mean().item()
        shares = " ".join(f"{100 * share:5.2f}" for share in histogram(solutions.valid, case.slots))
        same = duplicates(case, solutions)
        print(
            f"{case.name:18s} {name:10s} mean {mean:.4f}; % with 0, 1, ...: {shares}; the same twice {100 * same:.3f} %",
            flush=True,
        )
    if case.slots > 1:
        near = ", ".join(f"{step:g}: {100 * f:.2f} %" for step, (f, _) in where_two_merge(case, min(samples, 2000)).items())
        print(f"{case.name:18s} both of two close solutions found at a distance from where they merge of {near}", flush=True)


def header() -> str:
    return "number of solutions on the same random samples"
