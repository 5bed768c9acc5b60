"""Is the true model among the solutions?"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from bench.cases.case import Case, Peer, Sample, nearest
from torchsfm import Solutions

QUANTILES = (0.5, 0.9, 0.99, 0.999)


class Recall(NamedTuple):
    """Of one solver on one family."""

    share: float
    """Of samples whose model is found to the case's tolerance."""
    quantiles: tuple[float, ...]
    """Of the error of the nearest solution."""


def drawn(case: Case, family: str, samples: int, dtype: torch.dtype, seed: int = 1) -> tuple[Sample, Tensor]:
    """Exact samples of a family and the truth; the same for every program and dtype."""
    return case.scene(family, samples, torch.Generator().manual_seed(seed), dtype)


def judged(case: Case, solutions: Solutions[Tensor], truth: Tensor, tolerance: float) -> Recall:
    error = nearest(case, solutions, truth)
    # Quantiles with infinities among them.
    order = error.sort().values
    at = [order[min(int(q * len(order)), len(order) - 1)].item() for q in QUANTILES]
    return Recall((error < tolerance).double().mean().item(), tuple(at))


def recall(case: Case, family: str, samples: int, dtype: torch.dtype) -> Recall:
    sample, truth = drawn(case, family, samples, dtype)
    return judged(case, case.solve(*sample), truth, case.tolerances[dtype])


def peer_recall(case: Case, peer: Peer, family: str, samples: int) -> Recall:
    sample, truth = drawn(case, family, samples, torch.float64)
    return judged(case, peer_solutions(case, peer, sample), truth, case.tolerances[torch.float64])


def peer_solutions(case: Case, peer: Peer, sample: Sample) -> Solutions[Tensor]:
    """What a peer finds, in slots."""
    solve = peer.make()
    if peer.batched:
        models = solve(*sample).double()
    else:
        rows = [[torch.as_tensor(m) for m in solve(*one)] for one in singles(sample)]
        slots = max(case.slots, *map(len, rows))
        shape = next((row[0].shape for row in rows if row), torch.Size((3, 3)))
        models = torch.full((len(rows), slots, *shape), torch.nan, dtype=torch.float64)
        for i, row in enumerate(rows):
            if row:
                models[i, : len(row)] = torch.stack(row).double()
    flat = models.flatten(2)
    valid = torch.isfinite(flat).all(-1) & (flat != 0).any(-1)
    return Solutions(models.nan_to_num(0.0), valid)


def singles(sample: Sample) -> list[tuple[Any, ...]]:
    """The samples one by one, as numpy arrays of their own."""
    return [tuple(a.copy() for a in arrays) for arrays in zip(*(x.numpy() for x in sample), strict=True)]


def report(case: Case, samples: int, peer_samples: int) -> None:
    """Print a line for each family, dtype and program."""
    for family in ("random", *case.families):
        lines = [(f"torchsfm {str(d)[6:]}", recall(case, family, samples, d)) for d in (torch.float64, torch.float32)]
        for name, peer in case.peers.items():
            if peer.installed():
                lines.append((name, peer_recall(case, peer, family, min(samples, peer_samples))))
        for program, (share, quantiles) in lines:
            numbers = " ".join(f"{q:9.1e}" for q in quantiles)
            print(f"{case.name:18s} {family:22s} {program:17s} {share:8.4f} {numbers}", flush=True)


def header() -> str:
    return f"{'solver':18s} {'family':22s} {'program':17s} {'recall':>8s} " + " ".join(f"{100 * q:7g} %" for q in QUANTILES)
