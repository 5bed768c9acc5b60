"""Is a derivative ever NaN?"""

import torch

from bench.cases.case import Case
from bench.measures.recall import drawn

CHUNK = 4096


def not_finite(case: Case, samples: int) -> tuple[int, int]:
    """Samples, from all families and degenerate ones, and those of them with a derivative or a model that is not finite."""
    families = ("random", *case.families, *case.degenerate)
    each = -(-samples // len(families))
    total, bad = 0, 0
    for number, family in enumerate(families):
        sample, _ = drawn(case, family, each, torch.float64, seed=100 + number)
        for start in range(0, each, CHUNK):
            inputs = [x[start : start + CHUNK].clone().requires_grad_() for x in sample]
            solutions = case.solve(*inputs)
            weights = torch.rand(solutions.model.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
            gradients = torch.autograd.grad((solutions.model * weights).sum(), inputs)
            fine = torch.isfinite(solutions.model.detach()).flatten(1).all(-1)
            for gradient in gradients:
                fine &= torch.isfinite(gradient).flatten(1).all(-1)
            total += len(fine)
            bad += int((~fine).sum())
    return total, bad


def report(case: Case, samples: int) -> tuple[int, int]:
    """Print the line of one solver."""
    total, bad = not_finite(case, samples)
    print(f"{case.name:18s} {bad} of {total} samples", flush=True)
    return total, bad


def header() -> str:
    return "derivatives that are not finite, over random, hard and degenerate samples"
