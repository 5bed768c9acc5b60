"""Every camera of a model against all verified pairs of images, also those that the model made no use of."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.mapping.mapping import Mapping

MIN_MATCHES = 15
"""A pair of images with fewer matches has no relative pose of its own."""
CONFIDENT = 2.33
"""Standard deviations beyond which a share of matches is more, or less, than a half: one chance in a hundred."""

PIECE = 16384
"""Matches looked at together."""


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
    by_poses: Int[Tensor, "q"]
    """How many matches agree with the poses, wherever points lie."""

    @property
    def of_poses(self) -> "PairAgreement":
        """How they agree with the poses alone."""
        return replace(self, agreeing=self.by_poses)

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

    @property
    def explained(self) -> int:
        """Agreeing matches of the pairs that support the model."""
        return int(self.agreeing[self.supports].sum())

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
    return pair_agreements(mapping, (threshold,), poses_alone=poses_alone)[0]


def pair_agreements(mapping: Mapping, thresholds: Sequence[float], *, poses_alone: bool = False) -> list[PairAgreement]:
    """The same by several thresholds, for hardly more than by one."""
    q, t = len(mapping.graph.pairs), len(thresholds)
    matches, agreeing, by_poses = (torch.zeros(*shape, dtype=torch.long) for shape in ((q,), (t, q), (t, q)))
    fits = [None if poses_alone else _PointsThere.of(mapping, 2 * threshold) for threshold in thresholds]
    for rays in _matched_rays(mapping):
        matches += torch.bincount(rays.pair, minlength=q)
        for k, (threshold, fit) in enumerate(zip(thresholds, fits, strict=True)):
            agree = rays.agree(threshold)
            by_poses[k] += torch.bincount(rays.pair[agree], minlength=q)
            if fit is not None:
                agree &= fit.at(rays.match)
                agreeing[k] += torch.bincount(rays.pair[agree], minlength=q)
    compared = (matches > 0).nonzero()[:, 0]
    both = (by_poses if poses_alone else agreeing)[:, compared], by_poses[:, compared]
    pairs, matches = mapping.graph.pairs[compared], matches[compared]
    return [PairAgreement(pairs, matches, own, compared, loose) for own, loose in zip(*both, strict=True)]


@dataclass(frozen=True)
class _PointsThere:
    """Whether the points that matched image points show lie there in both images.

    Points that two images alone see count as unknown: where these stand close to each other they may be far off.
    """

    mapping: Mapping
    threshold: float
    known: Bool[Tensor, "n"]
    """Image points that show a point of which more is known,"""
    there: Bool[Tensor, "n"]
    """and those that lie where it is seen."""

    @classmethod
    def of(cls, mapping: Mapping, threshold: float) -> "_PointsThere":
        node = (mapping.point >= 0).nonzero()[:, 0]
        node = node[(torch.bincount(mapping.point[node], minlength=len(mapping.X)) >= 3)[mapping.point[node]]]
        none = torch.zeros(len(mapping.point), dtype=torch.bool)
        there = mapping.errors(mapping.point[node], node) < threshold
        return cls(mapping, threshold, none.index_fill(0, node, True), none.index_put((node,), there))

    def at(self, match: Int[Tensor, "m 2"]) -> Bool[Tensor, "m"]:
        """Matches of which no image point shows a point that is elsewhere in the other image."""
        fits = torch.ones(len(match), dtype=torch.bool)
        point = self.mapping.point
        same = point[match[:, 0]] == point[match[:, 1]]
        for own, other in (match.unbind(1), match.flip(1).unbind(1)):
            shows = self.known[own]
            fits &= ~(shows & same) | self.there[other]
            rest = (shows & ~same).nonzero()[:, 0]
            fits[rest] &= self.mapping.errors(point[own[rest]], other[rest]) < self.threshold
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
    none = mapping.X.new_zeros(5, 0)
    found = [(torch.zeros(0, dtype=torch.long), none[0], none)]
    for rays in _matched_rays(mapping):
        good = rays.agree(threshold).nonzero()[:, 0]
        found.append((rays.pair[good], rays.distance[good], rays.slopes(good)))
    pair, r, J = (torch.cat(parts, -1) for parts in zip(*found, strict=True))
    q = len(mapping.graph.pairs)
    counts = torch.bincount(pair, minlength=q)
    enough = counts >= MIN_MATCHES
    freedom = 5 * int(enough.sum()) - 6 * int(mapping.registered.sum()) + 7
    if freedom <= 0:
        return 1.0
    # A bounded influence: the deviation is 1.48 times the median of the absolute value.
    bound = 2.5 * 1.4826 * r.abs().median()
    influence = r.clamp(-bound, bound)
    H, g = J.new_zeros(5, 5, q), J.new_zeros(5, q).index_add_(1, pair, J * influence)
    for k in range(5):
        H[k, k:].index_add_(1, pair, J[k] * J[k:])
        H[k:, k] = H[k, k:].clone()
    H, g = H.permute(2, 0, 1)[enough], g.mT[enough]
    ridge = 1e-9 * H.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(5, dtype=J.dtype)
    step, info = torch.linalg.solve_ex(H + ridge, g)
    square = torch.where(info == 0, (g * step).sum(-1), 0.0) / influence.square().mean().clamp(min=1e-30)
    return max(float(square.sum()) / freedom, 1.0)


@dataclass(frozen=True)
class _MatchedRays:
    """Some of the verified matches of registered images as unit rays in the world, with the baselines of their pairs."""

    pair: Int[Tensor, "m"]
    match: Int[Tensor, "m 2"]
    p: Float[Tensor, "3 m"]
    """Rays of the first camera."""
    d: Float[Tensor, "3 m"]
    """Rays of the second camera."""
    t: Float[Tensor, "3 m"]
    """Directions from the second camera to the first."""
    distance: Float[Tensor, "m"]
    """Sampson's distance on the sphere, in pixels, with its sign."""
    scale: Float[Tensor, "m"]
    """Pixels per unit of d'(t x p)."""
    ahead: Float[Tensor, "m"]
    """How far the rays are from where they would meet at infinity, in pixels; negative where they meet behind a camera."""
    tangents: tuple[Float[Tensor, "3 q"], Float[Tensor, "3 q"]]
    """Of the unit sphere at the baseline of each pair of images."""

    def agree(self, threshold: float) -> Bool[Tensor, "m"]:
        """Matches whose rays meet in front of both cameras, up to the threshold in pixels."""
        return (self.distance.abs() < threshold) & (self.ahead > -threshold)

    def slopes(self, some: Int[Tensor, "k"]) -> Float[Tensor, "5 k"]:
        """The derivatives of the distance of some matches by a turn of p, and by t along two tangents of the unit sphere."""
        p, d, t = self.p[:, some], self.d[:, some], self.t[:, some]
        turn, shift = _cross(p, _cross(d, t)), _cross(p, d)
        along = [(shift * tangent.index_select(1, self.pair[some])).sum(0) for tangent in self.tangents]
        return torch.cat((turn, torch.stack(along))) * self.scale[some]


def _matched_rays(mapping: Mapping) -> Iterator[_MatchedRays]:
    """All verified matches of registered images, so many at a time that they stay in the cache."""
    graph = mapping.graph
    chosen = mapping.registered[graph.pairs].all(-1)[graph.match_pair].nonzero()[:, 0]
    # Each image point has many matches.
    node = mapping.registered[graph.view].nonzero()[:, 0]
    d, valid = mapping.rays(node)
    d = torch.nn.functional.normalize(d, dim=-1)
    world = (mapping.poses.R.mT[graph.view[node]] @ d[..., None])[..., 0]
    rays = d.new_full((3, len(graph.view)), torch.nan)
    rays[:, node] = torch.where(valid[:, None], world, torch.nan).mT
    i, j = graph.pairs.unbind(1)
    # A baseline of no length leaves the rays parallel; any direction will do.
    centre = mapping.poses.centre
    baseline = torch.nn.functional.normalize(centre[i] - centre[j], dim=-1, eps=1e-30).mT.contiguous()
    axis = torch.eye(3, dtype=d.dtype)[:, baseline.abs().argmin(0)]
    first = torch.nn.functional.normalize(_cross(baseline, axis), dim=0)
    tangents = first, _cross(baseline, first)
    focal = mapping.cameras.K[mapping.camera_index, 0, 0][graph.pairs].mean(-1)
    for some in torch.split(chosen, PIECE):
        pair, match = graph.match_pair[some], graph.match[some]
        p, d, t, f = rays[:, match[:, 0]], rays[:, match[:, 1]], baseline[:, pair], focal[pair]
        e = (_cross(t, p) * d).sum(0)
        tp, td, cosine = (t * p).sum(0), (t * d).sum(0), (p * d).sum(0)
        scale = f / (2 - tp * tp - td * td - 2 * e * e).clamp(min=1e-12).sqrt()
        ahead = f * torch.minimum(td - tp * cosine, td * cosine - tp)
        yield _MatchedRays(pair, match, p, d, t, e * scale, scale, ahead, tangents)


def _cross(a: Float[Tensor, "3 m"], b: Float[Tensor, "3 m"]) -> Float[Tensor, "3 m"]:
    """Cross products of columns: along rows of memory, several times as fast as `torch.linalg.cross`."""
    return a.roll(-1, 0) * b.roll(-2, 0) - a.roll(-2, 0) * b.roll(-1, 0)
