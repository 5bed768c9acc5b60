"""Random samples that depend on the seed and the problem alone, not on the batch the problem is in.

Each random number is a hash of (seed, size of the problem, number of the hypothesis, position in the sample): a counter-based
generator (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011), with the finaliser of SplitMix64 as the hash.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor


def _signed(value: int) -> int:
    return value - (1 << 64) if value >= 1 << 63 else value


_GOLDEN = _signed(0x9E3779B97F4A7C15)
_FIRST = _signed(0xBF58476D1CE4E5B9)
_SECOND = _signed(0x94D049BB133111EB)


def hash_integers(x: Int[Tensor, "*shape"]) -> Int[Tensor, "*shape"]:
    """Scramble 64-bit integers, one to one."""
    x = (x ^ ((x >> 30) & ((1 << 34) - 1))) * _FIRST
    x = (x ^ ((x >> 27) & ((1 << 37) - 1))) * _SECOND
    return x ^ ((x >> 31) & ((1 << 33) - 1))


def draw_samples(
    seed: int,
    count: Int[Tensor, "g"],
    first: Int[Tensor, "g"],
    hypotheses: int,
    size: int,
    pool: Int[Tensor, "g h"] | None = None,
) -> Int[Tensor, "g size h"]:
    """Distinct indices below `count` for each problem and hypothesis, every subset equally likely (Floyd's algorithm).

    Args:
        seed: Seed of the whole call.
        count: Number of data of each problem, at least `size`.
        first: Number of the first hypothesis of each problem; the same hypothesis of the same problem always gets the same
            sample.
        hypotheses: How many samples to draw for each problem.
        size: Number of indices in a sample.
        pool: Draw hypothesis by hypothesis from the first `pool` data instead of all.

    Returns:
        The samples, indices first, so that one position of all samples is contiguous.
    """
    device = count.device
    limit = count[:, None] if pool is None else pool
    counter = (first[:, None] + torch.arange(hypotheses, device=device)) * size
    counter = counter[:, None] + torch.arange(size, device=device)[:, None]
    key = hash_integers(_signed(seed * 0xD1342543DE82EF95 & ((1 << 64) - 1)) + count * _GOLDEN)
    random = hash_integers(key[:, None, None] + counter * _GOLDEN)
    random = (random >> 33) & 0x7FFFFFFF
    below = limit[:, None] - size + 1 + torch.arange(size, device=device)[:, None]
    index = (random * below) >> 31
    for j in range(1, size):
        taken = (index[:, :j] == index[:, j : j + 1]).any(1)
        index[:, j] = torch.where(taken, below[:, j] - 1, index[:, j])
    return index


def guided_pools(
    count: Int[Tensor, "g"], first: Int[Tensor, "g"], hypotheses: int, size: int, growth: int = 20_000
) -> Int[Tensor, "g hypotheses"]:
    """From how many of the best-scored data each hypothesis draws: PROSAC's growing pool for odd ones, all data for even ones.

    The pool of hypothesis t grows as t^(1/size), so that a pool of k data gets samples in the proportion that it would have
    among `growth` samples of all data (Chum & Matas 2005). Half of the samples stay uniform, so that a misleading order of the
    data costs at most a factor of two.
    """
    t = first[:, None] + torch.arange(hypotheses, device=count.device)
    fraction = ((t + 1) / growth).clamp(max=1) ** (1 / size)
    grown = (count[:, None] * fraction).ceil().long().clamp(min=size)
    return torch.where(t % 2 == 1, torch.minimum(grown, count[:, None]), count[:, None])


def compact(usable: Bool[Tensor, "p n"], count: Int[Tensor, "p"], width: int) -> Int[Tensor, "p width"]:
    """Indices of the usable data of each problem, in an order whose every prefix is spread over all of them.

    The order steps through the data by about the golden ratio of their number, made coprime to it; slots beyond `count` repeat
    an arbitrary datum. It depends on the usable data of the problem alone.
    """
    device = usable.device
    p, n = usable.shape
    position = torch.where(usable, usable.cumsum(-1) - 1, width)
    packed = torch.zeros(p, width + 1, dtype=torch.long, device=device)
    packed.scatter_(1, position, torch.arange(n, device=device).expand(p, n))
    # Among 40 consecutive integers one is coprime to any number below 10^12.
    step = (count * 0.6180339887498949).long()[:, None] + torch.arange(40, device=device)
    step = step.clamp(min=1)
    coprime = torch.gcd(step, count[:, None]) == 1
    step = step.gather(1, coprime.to(torch.int8).argmax(1, keepdim=True))
    slot = torch.arange(width, device=device)
    order = (slot * step) % count[:, None].clamp(min=1)
    order = torch.where(slot < count[:, None], order, 0)
    return packed.gather(1, order)
