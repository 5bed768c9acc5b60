"""What degenerate and bad input does to a solver, and to its neighbours in the batch."""

from collections.abc import Callable
from functools import partial

import torch

from bench.cases.case import Case, Sample
from bench.measures.recall import drawn

BATCH = 64


def outcome(case: Case, sample: Sample) -> str:
    """Of a batch of the same trouble."""
    solutions = case.solve(*sample)
    if not torch.isfinite(solutions.model).all():
        return "NOT FINITE"
    if not case.masked:
        return "finite, no mask"
    share = solutions.valid.any(-1).double().mean().item()
    return {0.0: "none valid", 1.0: "valid"}.get(share, f"{100 * share:.0f} % valid")


def neighbours_untouched(case: Case, sample: Sample) -> bool:
    """Whether a sample in the middle of a batch leaves the rest as it is, bit for bit."""
    good, _ = drawn(case, "random", 9, torch.float64)
    mixed = tuple(torch.cat((x[:4], y[:1], x[5:])) for x, y in zip(good, sample, strict=True))
    others = torch.arange(9) != 4
    before, after = case.solve(*good), case.solve(*mixed)
    return torch.equal(before.model[others], after.model[others]) and torch.equal(before.valid[others], after.valid[others])


def error_of(call: Callable[[], object]) -> str:
    """The name of what is raised."""
    try:
        call()
    except Exception as error:
        return type(error).__name__
    return "NO ERROR"


def rows(case: Case) -> list[tuple[str, str, str]]:
    """Trouble, outcome, and whether neighbours are the same."""
    table = []
    for family in case.degenerate:
        sample, _ = drawn(case, family, BATCH, torch.float64)
        table.append((family, outcome(case, sample), "same" if neighbours_untouched(case, sample) else "CHANGED"))
    good, _ = drawn(case, "random", BATCH, torch.float64)
    for poison in (torch.nan, torch.inf):
        results, same = set(), True
        for which in range(len(good)):
            sample = tuple(x.clone() for x in good)
            sample[which].flatten(1)[:, 1] = poison
            results.add(outcome(case, sample))
            same &= neighbours_untouched(case, sample)
        table.append((str(poison), "/".join(sorted(results)), "same" if same else "CHANGED"))
    empty = case.solve(*(x[:0] for x in good))
    table.append(("empty batch", f"shape {tuple(empty.valid.shape)}", ""))
    wrong = (torch.cat((good[0], good[0][..., :1]), -1), *good[1:])
    table.append(("wrong shape", error_of(partial(case.solve, *wrong)), ""))
    if len(good) > 1:
        table.append(("mixed dtype", error_of(partial(case.solve, good[0].float(), *good[1:])), ""))
    return table


def report(case: Case) -> None:
    """Print a line for each kind of trouble."""
    for trouble, result, same in rows(case):
        print(f"{case.name:18s} {trouble:18s} {result:26s} {same}", flush=True)


def header() -> str:
    return f"{'solver':18s} {'input':18s} {'outcome':26s} neighbours"
