"""Samples of data of several kinds, where it takes so many of each: of points and of lines, for instance."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.robust.estimator import Mixed
from torchsfm.robust.problems import Problems
from torchsfm.robust.sampling import draw_weighted

_APART = 0x9E3779B9
"""Between the seeds of the kinds."""


def draw_mixtures(
    problems: Problems, part: Int[Tensor, "g"], drawn: Int[Tensor, "g"], number: int, seed: int, chosen: Bool[Tensor, "p width"]
) -> Int[Tensor, "g m number"]:
    """Samples of chosen data that are mixtures which the estimator can solve, by turns; as they come where there are none.

    Arguments as of `Sampler.draw`.
    """
    count, some = problems.count[part], problems.take(part)
    weight = chosen[part].double() if some.weight is None else some.weight.double() * chosen[part]
    kind, mixtures, possible = _possible(some, weight > 0)
    turn = (drawn[:, None] + torch.arange(number, device=drawn.device)) % possible.sum(-1, keepdim=True).clamp(min=1)
    samples = draw_weighted(seed, weight, count, drawn, number, some.estimator.sample_size)
    for i, mixture in enumerate(mixtures):
        rows = []
        for k, m in enumerate(mixture):
            of_kind = weight * (kind == k)
            # Where there are too few of a kind the sample is not used.
            of_kind = torch.where(possible[:, i, None], of_kind, weight)
            if m:
                rows.append(draw_weighted(seed + _APART * (i * len(mixture) + k + 1), of_kind, count, drawn, number, m))
        own = possible[:, i, None] & (turn == (possible[:, :i].sum(-1, keepdim=True)))
        samples = torch.where(own[:, None], torch.cat(rows, 1), samples)
    return samples


def share_of_mixtures(problems: Problems, near: Bool[Tensor, "p width"], chosen: Bool[Tensor, "p width"]) -> Float[Tensor, "p"]:
    """The share of such samples that consist of near data alone."""
    weight = chosen.double() if problems.weight is None else problems.weight.double() * chosen
    kind, mixtures, possible = _possible(problems, weight > 0)
    total = torch.zeros_like(weight[:, 0])
    for i, mixture in enumerate(mixtures):
        share = torch.ones_like(total)
        for k, m in enumerate(mixture):
            of_kind = weight * (kind == k)
            share = share * _share(of_kind, of_kind * near, m, problems.weight is None)
        total = total + torch.where(possible[:, i], share, 0)
    as_they_come = _share(weight, weight * near, problems.estimator.sample_size, problems.weight is None)
    turns = possible.sum(-1)
    return torch.where(turns > 0, total / turns.clamp(min=1), as_they_come)


def _possible(problems: Problems, there: Tensor) -> tuple[Tensor, tuple[tuple[int, ...], ...], Tensor]:
    """The kind of each datum, the mixtures, and which of them the data of each problem allow (p, mixtures)."""
    estimator = problems.estimator
    assert isinstance(estimator, Mixed), "seen to by the samplers"
    kind, mixtures = estimator.kinds(*problems.data), estimator.mixtures
    number = [[(there & (kind == k)).sum(-1) >= m for k, m in enumerate(mixture)] for mixture in mixtures]
    possible = [torch.stack(enough, -1).all(-1) for enough in number]
    return kind, mixtures, torch.stack(possible, -1) if possible else there.new_zeros(len(there), 0)


def _share(all_: Tensor, good: Tensor, m: int, alike: bool) -> Tensor:
    """Of samples of m of some data, drawn by their weights, that hold good ones alone."""
    all_, good = all_.sum(-1), good.sum(-1)
    if not alike:
        return (good / all_.clamp(min=1e-300)) ** m
    steps = torch.arange(m, device=good.device)
    return ((good[:, None] - steps).clamp(min=0) / (all_[:, None] - steps).clamp(min=1)).prod(-1)
