"""Random samples that depend on the seed and the problem alone, not on the batch the problem is in.

Each random number is a hash of (seed, size of the problem, number of the hypothesis, position in the sample): a counter-based
generator (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011), with the finaliser of SplitMix64 as the hash.
"""

from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
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


def draw_seed(generator: torch.Generator | None) -> int:
    """The seed of a call, from a generator or PyTorch's global one."""
    return int(torch.randint(1 << 62, (), generator=generator, device=None if generator is None else generator.device))


def uniform_numbers(seed: int, rows: int, columns: int, device: torch.device, first: int = 0) -> Float[Tensor, "rows columns"]:
    """Random numbers between 0 and 1 that are a hash of the seed, the row, counted from the first, and the column."""
    counter = (first + torch.arange(rows, device=device))[:, None] * (1 << 32) + torch.arange(columns, device=device)
    key = hash_integers(torch.tensor(seed, device=device))
    random = (hash_integers(hash_integers(counter + 1) ^ key) >> 11) & ((1 << 53) - 1)
    return (random.double() + 0.5) * 2.0**-53


def draw_samples(
    seed: int,
    count: Int[Tensor, "g"],
    first: Int[Tensor, "g"],
    hypotheses: int,
    size: int,
    pool: Int[Tensor, "g h"] | None = None,
    newest: Bool[Tensor, "g h"] | None = None,
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
        newest: For which hypotheses the last datum of the pool belongs to the sample.

    Returns:
        The samples, indices first, so that one position of all samples is contiguous.
    """
    device = count.device
    limit = count[:, None] if pool is None else pool
    random = random_integers(seed, count, first, hypotheses, size)
    below = limit[:, None] + torch.arange(1 - size, 1, device=device)[:, None]
    index = (random * below) >> 31
    columns, last = torch.split(index, 1, 1), torch.split(below - 1, 1, 1)
    for j in range(1, size):
        taken = (index[:, :j] == columns[j]).any(1, keepdim=True)
        torch.where(taken, last[j], columns[j], out=columns[j])
    if newest is not None:
        # The others are then a sample of the rest: Floyd's algorithm adds one datum to the pool at a time.
        index[:, -1] = torch.where(newest, limit - 1, index[:, -1])
    return index


def random_integers(
    seed: int, count: Int[Tensor, "g"], first: Int[Tensor, "g"], hypotheses: int, size: int
) -> Int[Tensor, "g size h"]:
    """Integers of 31 random bits for each problem (known by the number of its data), hypothesis and position in a sample."""
    device = count.device
    counter = (first[:, None] + torch.arange(hypotheses, device=device)) * size
    counter = counter[:, None] + torch.arange(size, device=device)[:, None]
    key = hash_integers(_signed(seed * 0xD1342543DE82EF95 & ((1 << 64) - 1)) + count * _GOLDEN)
    return (hash_integers(key.view(-1, 1, 1) + counter * _GOLDEN) >> 33) & 0x7FFFFFFF


def draw_weighted(
    seed: int,
    weight: Float[Tensor, "g n"],
    count: Int[Tensor, "g"],
    first: Int[Tensor, "g"],
    hypotheses: int,
    size: int,
) -> Int[Tensor, "g size h"]:
    """Distinct indices, drawn one after the other with probabilities in proportion to the weights of what is left.

    Args:
        seed: Seed of the whole call.
        weight: Weights, 0 for what is not there; at least `size` positive ones.
        count: Number of data of each problem.
        first: Number of the first hypothesis of each problem.
        hypotheses: How many samples to draw for each problem.
        size: Number of indices in a sample.
    """
    weight = weight.double()
    upper = (weight / weight.sum(-1, keepdim=True)).cumsum(-1)
    weight = upper.diff(dim=-1, prepend=torch.zeros_like(upper[:, :1]))
    random = (random_integers(seed, count, first, hypotheses, size).double() + 0.5) / (1 << 31)
    last = (weight > 0).to(torch.int8).flip(-1).argmax(-1, keepdim=True)
    last = weight.shape[-1] - 1 - last
    drawn: list[Tensor] = []
    for j in range(size):
        # A number between 0 and the total of what is left, moved past what is taken, in ascending order.
        place = random[:, j]
        if drawn:
            taken = torch.stack(drawn, 1).sort(dim=1).values
            mass = weight.gather(1, taken.flatten(1)).reshape(taken.shape)
            start = upper.gather(1, taken.flatten(1)).reshape(taken.shape) - mass
            place = place * (upper[:, -1:] - mass.sum(1)).clamp(min=0)
            for i in range(j):
                place = torch.where(place >= start[:, i], place + mass[:, i], place)
        index = torch.searchsorted(upper, place.contiguous(), right=True).clamp(max=weight.shape[-1] - 1)
        drawn.append(torch.minimum(index, last))
    return torch.stack(drawn, 1)


PROSAC_SAMPLES = 200_000
"""After so many samples PROSAC draws from all data (Chum & Matas 2005, 2.1)."""


def prosac_growth(count: Int[Tensor, "g"], width: int, size: int) -> Int[Tensor, "g _"]:
    """T'_n of PROSAC for n = size, size + 1, ..., width: how many samples are drawn before the pool grows beyond n data.

    T_n = `PROSAC_SAMPLES` (n over size) / (count over size) and T'_{n+1} = T'_n + ceil(T_{n+1} - T_n), T'_size = 1.
    """
    n = torch.arange(size, width + 1, device=count.device)
    total, chosen = count[:, None].double(), n.double()
    steps = torch.arange(size, device=count.device)
    samples = PROSAC_SAMPLES * ((chosen[:, None] - steps) / (total[..., None] - steps).clamp(min=1)).prod(-1)
    grown = samples.diff(dim=-1).ceil()
    return torch.cat((torch.ones_like(samples[:, :1]), 1 + grown.cumsum(-1)), -1).clamp(max=1 << 40).long()


def prosac_pools(
    count: Int[Tensor, "g"], growth: Int[Tensor, "g _"], first: Int[Tensor, "g"], hypotheses: int, size: int
) -> tuple[Int[Tensor, "g hypotheses"], Bool[Tensor, "g hypotheses"]]:
    """From how many of the best data each hypothesis draws, and whether the last of them is in the sample.

    PROSAC for every other hypothesis, all data for the others: a misleading order of the data costs a factor of two at most.
    """
    t = first[:, None] + torch.arange(hypotheses, device=count.device)
    own = t // 2 + 1
    grown = torch.searchsorted(growth, own).clamp(max=growth.shape[-1] - 1)
    pool = torch.minimum(size + grown, count[:, None])
    guided = t % 2 == 1
    # With T'_{n-1} < t <= T'_n: the datum n and size - 1 before it.
    newest = guided & (size + grown <= count[:, None]) & (growth.gather(1, grown) >= own)
    return torch.where(guided, pool, count[:, None]), newest


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
    step = (count.double() * 0.6180339887498949).long()[:, None] + torch.arange(40, device=device)
    step = step.clamp(min=1)
    coprime = torch.gcd(step, count[:, None]) == 1
    step = step.gather(1, coprime.to(torch.int8).argmax(1, keepdim=True))
    slot = torch.arange(width, device=device)
    order = (slot * step) % count[:, None].clamp(min=1)
    order = torch.where(slot < count[:, None], order, 0)
    return packed.gather(1, order)


@lru_cache(maxsize=64)
def spread_order(count: int, width: int, device: torch.device) -> Int[Tensor, "width"]:
    """The order of `compact` where all data are usable."""
    with torch.inference_mode(False):
        usable = torch.ones(1, count, dtype=torch.bool, device=device)
        return compact(usable, torch.tensor([count], device=device), width)[0]
