"""Pieces of space curves that the edges of one image are images of, by what the images around it see."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg import inverse
from torchsfm.reconstruction.curves.edge_maps import EdgeMap, EdgeMaps, EdgePoints
from torchsfm.reconstruction.curves.sweep import Candidates, Rays, agreement, sweep_depths
from torchsfm.triangulation.curve_path import best_path
from torchsfm.triangulation.curve_refinement import covariance_across, refine_samples
from torchsfm.triangulation.curve_views import CurveDistances, biweight, project_all

_EVERY = 2
"""Of so many edge points one is followed, as neighbours are correlated."""
_KEPT = 12
"""Candidates of a sample."""
_FULL = 4.0
"""Votes of a sample that all images agree on, as far as the path is concerned: a leap is as dear among few as among many."""
_LEAP = 10.0
"""A step of so many steps across the rays ends a piece."""
_SLOTS = 1 << 14
"""Slots of samples that are followed at a time."""
_ALONG = 0.85
"""Least cosine of the angle between an edge and the image of the tangent of the curve that it belongs to."""


class Pieces(NamedTuple):
    """Samples of space curves, piece by piece, in order."""

    X: Float[Tensor, "n 3"]
    piece: Int[Tensor, "n"]
    image: Int[Tensor, "n"]
    """Whose edge it is."""
    edge: Int[Tensor, "n"]
    """Which edge point of that image."""
    sigma: Float[Tensor, "n"]
    """Standard deviation across the curve, in its worse direction, for noise of one pixel in every image."""
    pixel: Float[Tensor, "n"]
    """Size of a pixel of the image there."""


class _Sight(NamedTuple):
    """What maps of edges say of points of curves with known tangents."""

    maps: EdgeMaps
    P: Float[Tensor, "p v 3 4"]
    used: Bool[Tensor, "p v"]
    tangent: Float[Tensor, "p m 3"]
    threshold: float

    def distances(self, X: Float[Tensor, "p m 3"]) -> CurveDistances:
        """How far the images of points are from edges that run as they do."""
        y, depth = project_all(self.P, X)
        near = self.maps.near(y.transpose(0, 1))
        edge, r = near.tangent.transpose(0, 1), near.r.transpose(0, 1)
        image = self.tangent[:, None] @ self.P[..., :3].mT
        shown = image[..., :2] - y * image[..., 2:]
        agrees = agreement(shown, edge, _ALONG) * (depth > 0)
        normal = torch.stack((-edge[..., 1], edge[..., 0]), -1)
        weight = agrees * biweight(r, self.threshold)
        return CurveDistances(torch.where(weight > 0, r, 0), y, depth, normal, weight)


def image_pieces(
    image: int,
    sights: Sequence[EdgeMap],
    P: Float[Tensor, "v 3 4"],
    *,
    every: int = _EVERY,
    threshold: float,
    least_views: int,
    shortest: int,
) -> Pieces:
    """The pieces that the edges of the first of some images are images of.

    Args:
        image: Its number among all.
        sights: The edges of the images.
        P: Their cameras, scaled so that depths are those in the world.
        every: Of so many edge points one is followed.
        threshold: Distance in pixels of an edge that an image still agrees with.
        least_views: Images that must agree, the first one included.
        shortest: Samples of the shortest piece.
    """
    maps = EdgeMaps.of(sights)
    others = EdgeMaps(maps.table[1:], maps.x, maps.tangent)
    closeness = torch.stack([sight.closeness for sight in sights[1:]])
    own = sights[0].points
    rank = torch.arange(len(own.x), device=own.x.device)
    taken = (rank - torch.searchsorted(own.chain, own.chain)) % every == 0
    own, edge = EdgePoints(own.x[taken], own.tangent[taken], own.chain[taken]), rank[taken]
    groups, offset = [], 0
    for part in _groups(own.chain):
        samples = _samples(EdgePoints(own.x[part], own.tangent[part], own.chain[part]), P[0])
        there = samples.there
        rays = Rays(samples.centre, samples.direction[there], samples.across[there])
        found = sweep_depths(others, closeness, P[1:], rays, _KEPT, threshold)
        X, sigma, piece = _followed(maps, P, samples, found, threshold, least_views)
        measured = piece >= 0
        length = torch.bincount(piece[measured], minlength=1)
        keep = measured & (length[piece.clamp(min=0)] >= shortest)
        depth = torch.linalg.vector_norm(X[keep] - samples.centre, dim=-1)
        number = piece[keep] + offset
        pixel = depth / torch.linalg.vector_norm(P[0, 0, :3])
        source = torch.zeros_like(piece).masked_scatter(there, edge[part])[keep]
        groups.append(Pieces(X[keep], number, torch.full_like(number, image), source, sigma[keep], pixel))
        offset += len(length)
    return Pieces(*(torch.cat(field) for field in zip(*groups, strict=True)))


class _Samples(NamedTuple):
    """Samples of chains, a chain a row, and their rays."""

    there: Bool[Tensor, "p m"]
    centre: Float[Tensor, "3"]
    direction: Float[Tensor, "p m 3"]
    """Unit vectors."""
    across: Float[Tensor, "p m 3"]
    """Unit vectors in the plane of sight of the tangent, across the rays, forwards."""


def _samples(own: EdgePoints, P: Float[Tensor, "3 4"]) -> _Samples:
    x, there = _rows(own.x, own.chain)
    along, _ = _rows(own.tangent, own.chain)
    back, _ = inverse(P[:, :3])
    direction = torch.nn.functional.normalize(torch.cat((x, torch.ones_like(x[..., :1])), -1) @ back.mT, dim=-1)
    across = torch.cat((along, torch.zeros_like(along[..., :1])), -1) @ back.mT
    across = across - (across * direction).sum(-1, keepdim=True) * direction
    return _Samples(there, -(back @ P[:, 3]), direction, torch.nn.functional.normalize(across, dim=-1))


def _followed(
    maps: EdgeMaps, P: Tensor, samples: _Samples, found: Candidates, threshold: float, least_views: int
) -> tuple[Float[Tensor, "p m 3"], Float[Tensor, "p m"], Int[Tensor, "p m"]]:
    """Positions at the least squares of distances along the best paths, deviations, and numbers of pieces; -1 outside all."""
    there, direction = samples.there, samples.direction
    p, m = there.shape

    def lay(values: Tensor) -> Tensor:
        return values.new_zeros(p, m, *values.shape[1:]).masked_scatter(there.view(p, m, *[1] * (values.ndim - 1)), values)

    depth, votes, blur = lay(found.depth), lay(found.votes), lay(found.blur)
    share = min(1.0, _FULL / max(len(P) - 1, 1))
    path = best_path(depth, share * votes, threshold * blur, direction, _KEPT)
    chosen = (depth - path.depth[..., None]).abs().argmin(-1)[..., None, None].expand(p, m, 1, 3)
    tangent = lay(found.tangent).gather(2, chosen)[:, :, 0]
    X = samples.centre + path.depth[..., None] * direction
    used = torch.ones(p, len(P), dtype=torch.bool, device=P.device)
    sight = _Sight(maps, P.expand(p, *P.shape), used, tangent, threshold)
    X, basis, near, measured = refine_samples(sight, X, path.sure & there, torch.zeros_like(used[:, 0]))
    measured = measured & ((near.weight > 0.25).sum(1) >= least_views) & torch.isfinite(X).all(-1)
    covariance = covariance_across(sight, X, basis, near)
    sigma = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=0).sqrt()
    step = torch.linalg.vector_norm(X[:, 1:] - X[:, :-1], dim=-1)
    stride = torch.linalg.vector_norm(direction[:, 1:] - direction[:, :-1], dim=-1) * path.depth[:, 1:]
    breaks = torch.nn.functional.pad(~(measured[:, 1:] & measured[:, :-1]) | (step > _LEAP * stride), (1, 0), value=True)
    return X, sigma, torch.where(measured, breaks.flatten().cumsum(0).view(p, m) - 1, -1)


def _groups(chain: Int[Tensor, "n"]) -> list[slice]:
    """Samples of consecutive chains that fill not too many slots, where each chain has as many as the longest."""
    _, number = torch.unique_consecutive(chain, return_counts=True)
    groups, first, last, longest, count = [], 0, 0, 0, 0
    for n in number.tolist():
        if count and (count + 1) * max(longest, n) > _SLOTS:
            groups.append(slice(first, last))
            first, longest, count = last, 0, 0
        last, longest, count = last + n, max(longest, n), count + 1
    return [*groups, slice(first, last)]


def _rows(values: Float[Tensor, "n d"], chain: Int[Tensor, "n"]) -> tuple[Float[Tensor, "p m d"], Bool[Tensor, "p m"]]:
    """Samples of each chain in a row of its own."""
    _, row, number = torch.unique_consecutive(chain, return_inverse=True, return_counts=True)
    rank = torch.arange(len(chain), device=chain.device) - (number.cumsum(0) - number)[row]
    p, m = len(number), int(number.amax()) if len(number) else 0
    out, there = values.new_zeros(p, m, values.shape[-1]), torch.zeros(p, m, dtype=torch.bool, device=chain.device)
    out[row, rank], there[row, rank] = values, True
    return out, there
