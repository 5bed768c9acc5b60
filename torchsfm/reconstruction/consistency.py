"""Every camera of a model against all verified pairs of images, also those that the model made no use of."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.mapping import Mapping

MIN_MATCHES = 15
"""A pair of images with fewer matches has no relative pose of its own."""
CONFIDENT = 2.33
"""Standard deviations beyond which a share of matches is more, or less, than a half: one chance in a hundred."""


@dataclass(frozen=True)
class PairAgreement:
    """Verified pairs of registered images: how many of their matches there are, and how many agree with the model.

    A match agrees if its two rays meet in front of both cameras, up to the threshold, and if the points of the model that it
    shows lie there in both images. Wrong poses leave a pair a few matches along the epipolar lines that the model and the pair
    have in common, right ones nearly all; the pair speaks for or against the model where that is significantly more or less
    than a half of its matches.

    Epipolar lines alone tell little where the field of view is narrow: rays of two distant cameras meet whatever the angle
    between them about the normal of the plane in which they look (Koenderink & van Doorn 1991), and a model that is bent about
    it as about a hinge contradicts no pair. But it has two points, one on either side, where a match across shows one.
    """

    pairs: Int[Tensor, "q 2"]
    matches: Int[Tensor, "q"]
    agreeing: Int[Tensor, "q"]
    index: Int[Tensor, "q"]
    """Which pairs of the view graph these are."""

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


def pair_agreement(mapping: Mapping, *, threshold: float, poses_alone: bool = False) -> PairAgreement:
    """Compare a model with the verified matches of all pairs of its images.

    Args:
        mapping: The model.
        threshold: Largest distance of a match from the epipolar line, in pixels; a point may be off in the one image and in
            the other, twice as much together.
        poses_alone: Leave the points aside, for a model whose points are not what they will be.
    """
    rays = _MatchedRays.of(mapping)
    matches = torch.bincount(rays.pair, minlength=len(mapping.graph.pairs))
    agree = rays.agree(threshold)
    if not poses_alone:
        agree &= _points_lie_there(mapping, rays.match, 2 * threshold)
    agreeing = torch.bincount(rays.pair[agree], minlength=len(matches))
    compared = (matches > 0).nonzero()[:, 0]
    return PairAgreement(mapping.graph.pairs[compared], matches[compared], agreeing[compared], compared)


def _points_lie_there(mapping: Mapping, match: Int[Tensor, "m 2"], threshold: float) -> Bool[Tensor, "m"]:
    """Matches of which no image point shows a point that is elsewhere in the other image.

    Points that two images alone see count as unknown: where these stand close to each other they may be far off.
    """
    fits = torch.ones(len(match), dtype=torch.bool)
    known = torch.bincount(mapping.point[mapping.point >= 0], minlength=len(mapping.X)) >= 3
    for own, other in (match.unbind(1), match.flip(1).unbind(1)):
        shows = (mapping.point[own] >= 0).nonzero()[:, 0]
        shows = shows[known[mapping.point[own[shows]]]]
        fits[shows] &= mapping.errors(mapping.point[own[shows]], other[shows]) < threshold
    return fits


def excess_scatter(mapping: Mapping, *, threshold: float) -> float:
    """How much farther pairs of images would move than the independent noise of their matches lets them, as a variance ratio.

    Each pair by itself would take the relative rotation and direction that its own agreeing matches ask for. In the metric of
    its own covariance that step has five degrees of freedom; those of the poses are used up. Errors that matches of a pair have
    in common (highlights and outlines that move, a lens that the camera model does not describe) make the ratio larger than
    one, and the covariance of the model too small by as much.

    Args:
        mapping: An adjusted model.
        threshold: Largest distance of an agreeing match from the epipolar line, in pixels.

    Returns:
        The ratio, at least 1; 1 where too few pairs are left to tell.
    """
    rays = _MatchedRays.of(mapping)
    good = rays.agree(threshold)
    pair, r, t = rays.pair[good], rays.distance[good], rays.t[good]
    p, d = rays.p[good], rays.d[good]
    # The gradient of d'(t x p) by a turn of p, and by t.
    turn, shift = torch.linalg.cross(p, torch.linalg.cross(d, t)), torch.linalg.cross(p, d)
    # Two tangents of the unit sphere at t.
    axis = torch.eye(3, dtype=t.dtype)[t.abs().argmin(-1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(t, axis), dim=-1)
    second = torch.linalg.cross(t, first)
    J = torch.cat([turn, (shift * first).sum(-1, keepdim=True), (shift * second).sum(-1, keepdim=True)], -1)
    J = J * rays.scale[good, None]
    q = len(mapping.graph.pairs)
    counts = torch.bincount(pair, minlength=q)
    enough = counts >= MIN_MATCHES
    freedom = 5 * int(enough.sum()) - 6 * int(mapping.registered.sum()) + 7
    if freedom <= 0:
        return 1.0
    # A bounded influence: the deviation is 1.48 times the median of the absolute value.
    bound = 2.5 * 1.4826 * r.abs().median()
    influence = r.clamp(-bound, bound)
    H = J.new_zeros(q, 5, 5).index_add_(0, pair, J[:, :, None] * J[:, None])[enough]
    g = J.new_zeros(q, 5).index_add_(0, pair, J * influence[:, None])[enough]
    ridge = 1e-9 * H.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(5, dtype=J.dtype)
    step, info = torch.linalg.solve_ex(H + ridge, g)
    square = torch.where(info == 0, (g * step).sum(-1), 0.0) / influence.square().mean().clamp(min=1e-30)
    return max(float(square.sum()) / freedom, 1.0)


@dataclass(frozen=True)
class _MatchedRays:
    """The verified matches of registered images as unit rays, with the poses of their pairs."""

    pair: Int[Tensor, "m"]
    match: Int[Tensor, "m 2"]
    p: Float[Tensor, "m 3"]
    """Rays of the first camera, turned into the second."""
    d: Float[Tensor, "m 3"]
    """Rays of the second camera."""
    t: Float[Tensor, "m 3"]
    """Directions of the second camera's translation."""
    distance: Float[Tensor, "m"]
    """Sampson's distance on the sphere, in pixels, with its sign."""
    scale: Float[Tensor, "m"]
    """Pixels per unit of d'(t x p)."""
    ahead: Float[Tensor, "m"]
    """How far the rays are from where they would meet at infinity, in pixels; negative where they meet behind a camera."""

    @classmethod
    def of(cls, mapping: Mapping) -> "_MatchedRays":
        graph = mapping.graph
        chosen = mapping.registered[graph.pairs].all(-1)[graph.match_pair]
        a, b = graph.match[chosen].unbind(1)
        (d1, valid1), (d2, valid2) = mapping.rays(a), mapping.rays(b)
        i, j = graph.view[a], graph.view[b]
        focal = mapping.cameras.K[mapping.camera_index, 0, 0][torch.stack([i, j])].mean(0)
        first, second = mapping.poses[i], mapping.poses[j]
        R = second.R @ first.R.mT
        # A baseline of no length leaves the rays parallel; any direction will do.
        t = torch.nn.functional.normalize(second.t - (R @ first.t[..., None])[..., 0], dim=-1, eps=1e-30)
        p = torch.nn.functional.normalize((R @ d1[..., None])[..., 0], dim=-1)
        d = torch.nn.functional.normalize(d2, dim=-1)
        e = (torch.linalg.cross(t, p) * d).sum(-1)
        tp, td, cosine = (t * p).sum(-1), (t * d).sum(-1), (p * d).sum(-1)
        scale = focal / (2 - tp.square() - td.square() - 2 * e.square()).clamp(min=1e-12).sqrt()
        ahead = focal * torch.minimum(td - tp * cosine, td * cosine - tp)
        distance = torch.where(valid1 & valid2, e * scale, torch.inf)
        return cls(graph.match_pair[chosen], graph.match[chosen], p, d, t, distance, scale, ahead)

    def agree(self, threshold: float) -> Bool[Tensor, "m"]:
        """Matches whose rays meet in front of both cameras, up to the threshold in pixels."""
        return (self.distance.abs() < threshold) & (self.ahead > -threshold)
