"""Samples, pools and packing: uniform, distinct, and a function of the problem alone."""

import math

import pytest
import torch

from torchsfm.robust.sampling import (
    PROSAC_SAMPLES,
    compact,
    draw_samples,
    draw_weighted,
    hash_integers,
    prosac_growth,
    prosac_pools,
)


def zeros(count: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(count)


def test_samples_are_distinct_and_in_range() -> None:
    count = torch.tensor([3, 4, 10, 1000])
    index = draw_samples(1, count, zeros(count), 500, 3)
    assert index.shape == (4, 3, 500)
    assert (index >= 0).all()
    assert (index < count[:, None, None]).all()
    ordered = index.sort(1).values
    assert (ordered.diff(dim=1) > 0).all()
    assert torch.equal(ordered[0], torch.arange(3)[:, None].expand(3, 500))


def test_every_subset_is_equally_likely() -> None:
    count = torch.tensor([6])
    index = draw_samples(5, count, zeros(count), 40_000, 3)[0].sort(0).values
    code = index[0] * 36 + index[1] * 6 + index[2]
    frequency = code.unique(return_counts=True)[1].double()
    assert len(frequency) == math.comb(6, 3)
    expected = 40_000 / 20
    chi_square = ((frequency - expected) ** 2 / expected).sum()
    # 19 degrees of freedom: beyond 44 once in a thousand.
    assert chi_square < 44


def test_samples_depend_on_the_problem_alone_and_continue() -> None:
    count = torch.tensor([50, 20, 80])
    together = draw_samples(9, count, zeros(count), 64, 4)
    alone = draw_samples(9, count[1:2], zeros(count[1:2]), 64, 4)
    assert torch.equal(alone[0], together[1])
    later = draw_samples(9, count, torch.tensor([32, 0, 16]), 32, 4)
    assert torch.equal(later[0], together[0, :, 32:])
    assert torch.equal(later[2], together[2, :, 16:48])
    assert not torch.equal(draw_samples(10, count, zeros(count), 64, 4), together)


def test_hash_spreads_single_bits() -> None:
    x = torch.arange(4096)
    flips = hash_integers(x) ^ hash_integers(x ^ 1)
    bits = torch.stack([(flips >> k) & 1 for k in range(64)]).double().mean(-1)
    assert ((bits - 0.5).abs() < 0.05).all()


def test_prosac_grows_as_published() -> None:
    """T'_n by the recursion of the paper, in Python integers."""
    size, count = 4, 60
    growth = prosac_growth(torch.tensor([count]), 64, size)[0].tolist()
    T, whole = float(PROSAC_SAMPLES), [1]
    for i in range(size):
        T *= (size - i) / (count - i)
    for n in range(size, count):
        grown = T * (n + 1) / (n + 1 - size)
        whole.append(whole[-1] + math.ceil(grown - T - 1e-9))
        T = grown
    assert growth[: len(whole)] == whole
    assert abs(T - PROSAC_SAMPLES) < 1e-3


def test_prosac_draws_the_newest_of_a_growing_pool() -> None:
    count, size, number = torch.tensor([200]), 4, 4000
    growth = prosac_growth(count, 256, size)
    pool, newest = prosac_pools(count, growth, torch.tensor([0]), number, size)
    sample = draw_samples(3, count, torch.tensor([0]), number, size, pool, newest)[0]
    assert (sample.sort(0).values.diff(dim=0) > 0).all()
    pool, newest = pool[0], newest[0]
    assert (pool[::2] == 200).all()
    assert not newest[::2].any()
    guided, own = pool[1::2], sample[:, 1::2]
    assert (guided.diff() >= 0).all()
    assert guided[0] == 4
    # Hypothesis t draws from n data while T'_{n-1} < t <= T'_n.
    t = torch.arange(1, number // 2 + 1)
    assert (growth[0, guided - size] >= t).all()
    assert (growth[0, (guided - size - 1).clamp(min=0)] < t)[guided > size].all()
    assert (own.amax(0) == guided - 1).all()


def test_weighted_samples_follow_the_weights() -> None:
    weight = torch.tensor([[0.0, 1.0, 2.0, 0.0, 4.0, 1.0, 0.0]], dtype=torch.float64)
    sample = draw_weighted(1, weight, torch.tensor([4]), torch.tensor([0]), 200_000, 2)[0]
    assert (sample[0] != sample[1]).all()
    assert (weight[0][sample] > 0).all()
    first = torch.bincount(sample[0], minlength=7) / 200_000
    torch.testing.assert_close(first.double(), weight[0] / 8, atol=5e-3, rtol=0)
    # Of what is left after datum 4, half is datum 2.
    after = sample[1][sample[0] == 4]
    assert abs((after == 2).double().mean() - 0.5) < 1e-2
    assert draw_weighted(1, weight, torch.tensor([4]), torch.tensor([0]), 1000, 4)[0].sort(0).values.unique(dim=1).shape[1] == 1


@pytest.mark.parametrize("n", [1, 2, 7, 30, 64, 97])
def test_packing_permutes_the_usable_data(n: int, generator: torch.Generator) -> None:
    usable = torch.rand(5, n, generator=generator) < 0.7
    count = usable.sum(-1)
    width = 128
    source = compact(usable, count, width)
    padded = torch.nn.functional.pad(usable, (0, 40))
    assert torch.equal(compact(padded, count, width), source)
    for row in range(5):
        chosen = source[row, : count[row]]
        assert torch.equal(chosen.sort().values, usable[row].nonzero()[:, 0])


def test_prefixes_of_packed_data_are_spread() -> None:
    """No run of inliers in the caller's order may fill or miss the first data looked at."""
    for n in (100, 128, 999, 1000, 1024, 2048, 5000):
        usable = torch.ones(1, n, dtype=torch.bool)
        first = compact(usable, torch.tensor([n]), 8192)[0, :64]
        share = torch.histc(first.double(), 4, 0, n)
        assert share.min() >= 12
