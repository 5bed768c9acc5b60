"""From which data samples are drawn, and how many it takes: an argument of `ransac`, as the scoring is."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.robust.estimator import Mixed
from torchsfm.robust.mixtures import draw_mixtures, share_of_mixtures
from torchsfm.robust.problems import Problems
from torchsfm.robust.sampling import draw_samples, draw_weighted, prosac_pools, uniform_numbers

_BY_CHANCE = 0.05
"""Share of wrong data taken to agree with a wrong model, as PROSAC's end assumes."""


@runtime_checkable
class Sampler(Protocol):
    """How samples are drawn. Small frozen objects; `Uniform()`, `Prosac()`, `Neighbours()`.

    What a sampler draws for a problem must be a function of the problem, the seed and the number of the sample alone: then the
    result for a problem does not depend on the batch it is in.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.robust import Neighbours, Prosac, Uniform
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(200, 2, generator=g, dtype=torch.float64)
        >>> x2 = torch.cat((x1[:60] + 0.1, torch.rand(140, 2, generator=g, dtype=torch.float64)))  # 70 % are wrong
        >>> options = {"quality": torch.linspace(1, 0, 200).double(), "threshold": 1e-3}
        >>> for sampler in (Uniform(), Prosac(), Neighbours()):
        ...     found = torchsfm.estimate_homography(x1, x2, sampler=sampler, generator=g, **options)
        ...     print(sampler, bool(found.inliers[:60].all()))
        ...
        Uniform() True
        Prosac() True
        Neighbours(sizes=(10, 20, 40)) True
    """

    def draw(
        self, problems: Problems, part: Int[Tensor, "g"], drawn: Int[Tensor, "g"], number: int, seed: int
    ) -> Int[Tensor, "g m number"]:
        """Distinct slots below `problems.count` for each sample of some of the problems.

        Args:
            problems: All problems, with their data.
            part: Which of them to draw for.
            drawn: How many samples each had before.
            number: How many to draw.
            seed: Seed of the whole call.
        """
        ...

    def needed(self, problems: Problems, near: Bool[Tensor, "p width"], confidence: float) -> Float[Tensor, "p"]:
        """How many samples it takes to have drawn one of inliers alone.

        Args:
            problems: All problems, with their data.
            near: The inliers of each problem's best model.
            confidence: The probability wanted, below 1.
        """
        ...


@dataclass(frozen=True)
class Uniform:
    """Every sample is as likely as every other; with weights, a datum as likely as it counts.

    Of data of several kinds (see `Mixed`) all samples of the same mixture are.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x = torch.rand(50, 2, generator=g)
        >>> found = torchsfm.estimate_homography(x, x + 0.1, threshold=1e-3, sampler=torchsfm.Uniform(), generator=g)
        >>> found.inliers.sum()
        tensor(50)
    """

    def draw(self, problems: Problems, part: Tensor, drawn: Tensor, number: int, seed: int) -> Int[Tensor, "g m number"]:
        """Independent samples."""
        if isinstance(problems.estimator, Mixed):
            return draw_mixtures(problems, part, drawn, number, seed, problems.inside)
        size, count = problems.estimator.sample_size, problems.count[part]
        if problems.weight is None:
            return draw_samples(seed, count, drawn, number, size)
        return draw_weighted(seed, problems.weight[part], count, drawn, number, size)

    def needed(self, problems: Problems, near: Tensor, confidence: float) -> Float[Tensor, "p"]:
        """By the exact probability of such a sample."""
        if isinstance(problems.estimator, Mixed):
            return draws(share_of_mixtures(problems, near, problems.inside), confidence)
        size = problems.estimator.sample_size
        if problems.weight is None:
            share = share_of_samples(near.sum(-1, keepdim=True), problems.count[:, None], size)[:, 0]
        else:
            share = (problems.weight * near).double().sum(-1) / problems.weight.double().sum(-1)
            share = share**size
        return draws(share, confidence)


@dataclass(frozen=True)
class Prosac:
    """Every other sample favours the data of the best quality, more and more of them (PROSAC, Chum & Matas 2005).

    A misleading order of the data costs a factor of two at most. Ends as soon as the samples of the best data suffice.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(200, 2, generator=g, dtype=torch.float64)
        >>> x2 = torch.cat((x1[:60] + 0.1, torch.rand(140, 2, generator=g, dtype=torch.float64)))  # 70 % are wrong
        >>> quality = torch.linspace(1, 0, 200, dtype=torch.float64)  # and known to be doubtful
        >>> options = {"quality": quality, "sampler": torchsfm.Prosac(), "generator": g}
        >>> found = torchsfm.estimate_homography(x1, x2, threshold=1e-3, **options)
        >>> bool(found.inliers[:60].all())
        True
    """

    def draw(self, problems: Problems, part: Tensor, drawn: Tensor, number: int, seed: int) -> Int[Tensor, "g m number"]:
        """From the best data and from all of them by turns."""
        ranking, growth = _ranked(problems)
        size, count = problems.estimator.sample_size, problems.count[part]
        pool, newest = prosac_pools(count, growth[part], drawn, number, size)
        return by_rank(ranking[part], draw_samples(seed, count, drawn, number, size, pool, newest))

    def needed(self, problems: Problems, near: Tensor, confidence: float) -> Float[Tensor, "p"]:
        """As many as uniform samples need, or fewer by PROSAC's own end (Chum & Matas 2005, 2.2).

        That is: inliers enough among the n best, and no chance, for the samples drawn of them.
        """
        size, (ranking, growth) = problems.estimator.sample_size, _ranked(problems)
        count = problems.count[:, None]
        plain = draws(share_of_samples(near.sum(-1, keepdim=True), count, size)[:, 0], confidence)
        number = torch.arange(size, near.shape[-1] + 1, device=near.device)
        ranked = near.gather(-1, ranking).cumsum(-1)[:, size - 1 :]
        own = draws(share_of_samples(ranked, number, size), confidence)
        spare = (number - size).double()
        chance = size + _BY_CHANCE * spare + 3.1 * (_BY_CHANCE * (1 - _BY_CHANCE) * spare).sqrt()
        good = (ranked > chance) & (growth >= own) & (number <= count)
        return torch.minimum(plain, torch.where(good, 2 * own, torch.inf).amin(-1))


@dataclass(frozen=True)
class Neighbours:
    """Most samples are a datum and some of its nearest neighbours: right ones are often together (NAPSAC, Myatt et al. 2002).

    For data that hold several structures, or in high dimensions. Samples of near data determine a model less well, so by turns
    they come from neighbourhoods of several sizes and from all data. Near are data that are near in all tensors of the data,
    each in units of its spread. Time grows with the square of the number of data.

    Attributes:
        sizes: Numbers of neighbours to draw from.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x = torch.rand(100, 2, generator=g, dtype=torch.float64)
        >>> shift = torch.where(x[:, :1] < 0.3, 0.1, torch.rand(100, 2, generator=g))  # what moved lies together
        >>> sampler = torchsfm.Neighbours()
        >>> found = torchsfm.estimate_homography(x, x + shift, threshold=1e-4, sampler=sampler, generator=g)
        >>> bool(found.inliers[x[:, 0] < 0.3].all())
        True
    """

    sizes: tuple[int, ...] = (10, 20, 40)

    def draw(self, problems: Problems, part: Tensor, drawn: Tensor, number: int, seed: int) -> Int[Tensor, "g m number"]:
        """From neighbourhoods of all sizes, and from all data, by turns."""
        size, device = problems.estimator.sample_size, problems.count.device
        samples = torch.empty(len(part), size, number, dtype=torch.long, device=device)
        for i, (member, count, first) in enumerate(
            zip(part.tolist(), problems.count[part].tolist(), drawn.tolist(), strict=True)
        ):
            place = _in_units_of_spread([d[member, :count] for d in problems.data])
            nearest = nearest_neighbours(place, min(max(*self.sizes, size - 1), count - 1))
            # Every sample has random numbers of its own, whatever the number of samples drawn before it at a time.
            random = uniform_numbers(seed, number, max(*self.sizes, size - 1, 1) + 1, device, first)
            start = (random[:, 0] * count).long()
            kind = (first + torch.arange(number, device=device)) % (len(self.sizes) + 1)
            row = draw_samples(seed, problems.count[part[i : i + 1]], drawn[i : i + 1], number, size)[0]
            for level, near in enumerate(self.sizes):
                if max(near, size - 1) >= count - 1:
                    continue
                chosen = random[:, 1 : max(near, size - 1) + 1].topk(size - 1, dim=-1).indices
                own = torch.cat((start[None], nearest[start[:, None], chosen].mT))
                row = torch.where(kind == level, own, row)
            samples[i] = row
        return samples

    def needed(self, problems: Problems, near: Tensor, confidence: float) -> Float[Tensor, "p"]:
        """As if samples came from all data: those that do are enough, however the right data lie."""
        return (len(self.sizes) + 1) * Uniform().needed(problems, near, confidence)


@dataclass(frozen=True)
class Among:
    """Samples of chosen data alone: local optimisation draws from the inliers.

    Attributes:
        chosen: Which slots to draw from, at least as many as a sample has.
    """

    chosen: Bool[Tensor, "p width"]

    def draw(self, problems: Problems, part: Tensor, drawn: Tensor, number: int, seed: int) -> Int[Tensor, "g m number"]:
        """Independent samples."""
        if isinstance(problems.estimator, Mixed):
            return draw_mixtures(problems, part, drawn, number, seed, self.chosen)
        chosen = self.chosen[part]
        ranking = chosen.to(torch.int8).argsort(dim=-1, descending=True, stable=True)
        pool = chosen.sum(-1, keepdim=True).expand(-1, number)
        return by_rank(ranking, draw_samples(seed, problems.count[part], drawn, number, problems.estimator.sample_size, pool))

    def needed(self, problems: Problems, near: Tensor, confidence: float) -> Float[Tensor, "p"]:
        """By the exact probability of such a sample."""
        if isinstance(problems.estimator, Mixed):
            return draws(share_of_mixtures(problems, near, self.chosen), confidence)
        size = problems.estimator.sample_size
        both = (near & self.chosen).sum(-1, keepdim=True)
        return draws(share_of_samples(both, self.chosen.sum(-1, keepdim=True), size)[:, 0], confidence)


def share_of_samples(good: Int[Tensor, "*batch"], count: Int[Tensor, "*#batch"], size: int) -> Float[Tensor, "*batch"]:
    """The share of the samples of some data that consist of good ones alone."""
    steps = torch.arange(size, device=good.device)
    return ((good[..., None] - steps).clamp(min=0).double() / (count[..., None] - steps).double()).prod(-1)


def draws(share: Float[Tensor, "*batch"], confidence: float) -> Float[Tensor, "*batch"]:
    """After how many draws something of which the probability is `share` has come up with the given confidence."""
    return math.log(1 - confidence) / torch.log1p(-share)


def by_rank(ranking: Int[Tensor, "g width"], index: Int[Tensor, "g m number"]) -> Int[Tensor, "g m number"]:
    """The slots of what is drawn by rank."""
    return ranking.gather(1, index.flatten(1)).view_as(index)


def _in_units_of_spread(data: list[Tensor]) -> Float[Tensor, "n d"]:
    """The data side by side, each in units of its spread."""
    spread = [d.std(0, correction=0).norm() for d in data]
    return torch.cat([d / torch.where(s > 0, s, 1) for d, s in zip(data, spread, strict=True)], -1)


def nearest_neighbours(place: Float[Tensor, "n d"], number: int) -> Int[Tensor, "n number"]:
    """The nearest other data of each, nearest first."""
    near = []
    for i in range(0, len(place), 512):
        # The datum itself is its own nearest neighbour, or as near as any.
        gap = torch.cdist(place[i : i + 512], place, compute_mode="donot_use_mm_for_euclid_dist")
        row = torch.arange(len(gap), device=place.device)
        gap[row, row + i] = torch.inf
        near.append(gap.topk(number, largest=False).indices)
    return torch.cat(near)


def _ranked(problems: Problems) -> tuple[Tensor, Tensor]:
    assert problems.ranking is not None, "seen to by ransac"
    assert problems.growth is not None, "made with it"
    return problems.ranking, problems.growth
