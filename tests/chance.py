"""All that tests leave to chance: streams of random numbers, which `--seed` sets, and limits that follow from the trials."""

import numpy as np
import torch
from scipy.stats import binom, chi2
from torch import Tensor

FALSE_ALARM = 1e-6
"""How often a statistical test may fail where nothing is wrong. A run has some hundreds of them."""

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
    return torch.Generator(torch.get_default_device()).manual_seed(stream_seed(stream))


def numpy_seeded(stream: int = 0) -> np.random.Generator:
    """As `seeded`, of NumPy."""
    return np.random.default_rng(stream_seed(stream))


def assert_share(right: Tensor, at_least: float) -> None:
    """Fail where so few of these independent trials come out right that their rate is less than was asked for.

    The number of right ones is binomial: it is refused where a rate of `at_least` gives as few with a probability below
    `FALSE_ALARM`. So `at_least` is the rate itself, with nothing taken off for chance; the more trials, the sharper the test.
    """
    count, trials = int(right.sum()), right.numel()
    assert trials > 0, "no trials"
    chance = float(binom.cdf(count, trials, at_least))
    assert chance > FALSE_ALARM, (
        f"{count} of {trials} are right; a rate of {at_least:g} gives as few once in {1 / max(chance, 1e-300):.1g} runs"
    )


def assert_unit_variance(scores: Tensor, lost: int = 0, dim: int | None = None) -> None:
    """Fail where errors divided by their standard deviations are larger, or smaller, than normal numbers of variance 1 are.

    Their sum of squares, over all or over a dimension, is chi-square with as many degrees of freedom as there are, less those
    `lost` to what was estimated from them: refused is what is as far out with a probability below `FALSE_ALARM`.
    """
    squares = scores.square().sum() if dim is None else scores.square().sum(dim)
    freedom = (scores.numel() if dim is None else scores.shape[dim]) - lost
    assert freedom > 0, "no trials"
    law = chi2(freedom)
    sums = squares.reshape(-1).numpy(force=True)
    chance = 2 * len(sums) * np.minimum(law.cdf(sums), law.sf(sums)).min()
    assert chance > FALSE_ALARM, (
        f"mean squares from {sums.min() / freedom:.3g} to {sums.max() / freedom:.3g} with {freedom} degrees of freedom are "
        f"as far from 1 once in {1 / max(chance, 1e-300):.1g} runs"
    )
