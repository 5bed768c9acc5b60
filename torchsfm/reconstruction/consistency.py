"""Every camera of a model against all verified pairs of images, also those that the model made no use of."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.mapping import Mapping

CONFIDENT = 2.33
"""Standard deviations beyond which a share of matches is more, or less, than a half: one chance in a hundred."""


@dataclass(frozen=True)
class PairAgreement:
    """Verified pairs of registered images: how many of their matches there are, and how many agree with the model.

    A match agrees if its two rays meet in front of both cameras, up to the threshold. Wrong poses leave a pair a few matches
    along the epipolar lines that the model and the pair have in common, right ones nearly all; the pair speaks for or against
    the model where that is significantly more or less than a half of its matches.
    """

    pairs: Int[Tensor, "q 2"]
    matches: Int[Tensor, "q"]
    agreeing: Int[Tensor, "q"]

    @property
    def deviation(self) -> Float[Tensor, "q"]:
        """By how many standard deviations the number of agreeing matches differs from a half."""
        return (2 * self.agreeing - self.matches) / self.matches.clamp(min=1).double().sqrt()

    @property
    def supports(self) -> Bool[Tensor, "q"]:
        """Pairs that agree with the model."""
        return self.deviation > CONFIDENT

    @property
    def contradicts(self) -> Bool[Tensor, "q"]:
        """Pairs that do not."""
        return self.deviation < -CONFIDENT

    def balance(self, views: int) -> Int[Tensor, "v"]:
        """Matches of the pairs that support each image's place, less those of the pairs that contradict it."""
        return self.per_view(self.supports, self.matches, views) - self.per_view(self.contradicts, self.matches, views)

    def per_view(self, chosen: Bool[Tensor, "q"], weights: Tensor, views: int) -> Tensor:
        """A sum over the chosen pairs of each image."""
        total = torch.zeros(views, dtype=weights.dtype)
        for side in range(2):
            total.index_add_(0, self.pairs[chosen, side], weights[chosen])
        return total


def pair_agreement(mapping: Mapping, *, threshold: float) -> PairAgreement:
    """Compare the poses of a model with the verified matches of all pairs of its images.

    Args:
        mapping: The model.
        threshold: Largest distance of a match from the epipolar line, in pixels.
    """
    graph = mapping.graph
    both = mapping.registered[graph.pairs].all(-1)
    chosen = both[graph.match_pair]
    pair, (a, b) = graph.match_pair[chosen], graph.match[chosen].unbind(1)
    (d1, valid1), (d2, valid2) = mapping.rays(a), mapping.rays(b)
    i, j = graph.view[a], graph.view[b]
    focal = (mapping.cameras.K[mapping.camera_index, 0, 0][torch.stack([i, j])]).mean(0)
    limit = threshold / focal
    first, second = mapping.poses[i], mapping.poses[j]
    R = second.R @ first.R.mT
    t = second.t - (R @ first.t[..., None])[..., 0]
    # A baseline of no length leaves the rays parallel; any direction will do.
    t = torch.nn.functional.normalize(t, dim=-1, eps=1e-30)
    p = torch.nn.functional.normalize((R @ d1[..., None])[..., 0], dim=-1)
    d = torch.nn.functional.normalize(d2, dim=-1)
    e = (torch.linalg.cross(t, p) * d).sum(-1)
    tp, td = (t * p).sum(-1), (t * d).sum(-1)
    # Sampson's distance on the sphere, and how far each ray is from where it would meet the other at infinity.
    distance = e.abs() / (2 - tp.square() - td.square() - 2 * e.square()).clamp(min=1e-12).sqrt()
    cosine = (p * d).sum(-1)
    ahead = torch.minimum(td - tp * cosine, td * cosine - tp)
    good = (distance < limit) & (ahead > -limit) & valid1 & valid2
    q = len(graph.pairs)
    matches = torch.bincount(pair, minlength=q)
    agreeing = torch.bincount(pair[good], minlength=q)
    compared = matches > 0
    return PairAgreement(graph.pairs[compared], matches[compared], agreeing[compared])
