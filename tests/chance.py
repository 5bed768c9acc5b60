"""All that tests leave to chance: streams of random numbers, which `--seed` sets, and limits that follow from the trials."""

import numpy as np
import torch

_run = 0


def set_seed(seed: int) -> None:
    """Begin a run of its own: every stream becomes another."""
    global _run
    _run = seed


def stream_seed(stream: int = 0) -> int:
    """A seed for what takes a number: that of a stream of this run."""
    return 1_000_003 * _run + stream


def seeded(stream: int = 0) -> torch.Generator:
    """A stream of random numbers: the same for the same number within a run, independent of the others."""
    return torch.Generator().manual_seed(stream_seed(stream))


def numpy_seeded(stream: int = 0) -> np.random.Generator:
    """As `seeded`, of NumPy."""
    return np.random.default_rng(stream_seed(stream))
