"""Pieces of space curves that the edges of one image are images of, by what the images around it see."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.linalg import inverse
from torchsfm.reconstruction.curve_sweep import Rays, sweep_depths
from torchsfm.reconstruction.edge_maps import EdgeMaps, EdgePoints, edge_maps
from torchsfm.triangulation.curve_path import best_path
from torchsfm.triangulation.curve_refinement import covariance_across, refine_samples
from torchsfm.triangulation.curve_views import CurveDistances, biweight, project_all

_EVERY = 2
"""Of so many edge points one is followed: neighbours are correlated."""
_KEPT = 12
"""Candidates of a sample."""
_REACH = 2.5
"""Distance of an edge, in pixels, that a pixel of the maps still feels."""
_FULL = 4.0
"""Votes of a sample that all images agree on, as far as the path is concerned: a leap is as dear among few as among many."""
_ALONG = 0.85
"""Least cosine of the angle between an edge and the image of the tangent of the curve that it belongs to."""


class Pieces(NamedTuple):
    """Samples of space curves, piece by piece, in order."""

    X: Float[Tensor, "n 3"]
    piece: Int[Tensor, "n"]
    image: Int[Tensor, "n"]
    """Whose edge it is."""
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
        agrees = (shown * edge).sum(-1) > _ALONG * torch.linalg.vector_norm(shown, dim=-1)
        normal = torch.stack((-edge[..., 1], edge[..., 0]), -1)
        weight = torch.where(agrees & (depth > 0), biweight(r, self.threshold), 0)
        return CurveDistances(torch.where(weight > 0, r, 0), y, depth, normal, weight)


def image_pieces(
    image: int,
    points: list[EdgePoints],
    P: Float[Tensor, "v 3 4"],
    size: tuple[int, int],
    *,
    threshold: float,
    least_views: int,
    shortest: int,
) -> Pieces:
    """The pieces that the edges of the first of some images are images of.

    Args:
        image: Its number among all.
        points: The edges of the images.
        P: Their cameras, scaled so that depths are those in the world.
        size: Height and width of the images.
        threshold: Distance in pixels of an edge that an image still agrees with.
        least_views: Images that must agree, the first one included.
        shortest: Samples of the shortest piece.
    """
    maps = edge_maps(points, *size)
    own = points[0]
    rank = torch.arange(len(own.x), device=own.x.device)
    start = torch.searchsorted(own.chain, own.chain)
    taken = (rank - start) % _EVERY == 0
    x, along, chain = own.x[taken], own.tangent[taken], own.chain[taken]
    x, there = _rows(x, chain)
    along, _ = _rows(along, chain)
    p, m = there.shape
    back, _ = inverse(P[0, :, :3])
    centre = -(back @ P[0, :, 3])
    direction = torch.nn.functional.normalize(torch.cat((x, torch.ones_like(x[..., :1])), -1) @ back.mT, dim=-1)
    across = torch.cat((along, torch.zeros_like(along[..., :1])), -1) @ back.mT
    across = across - (across * direction).sum(-1, keepdim=True) * direction
    across = torch.nn.functional.normalize(across, dim=-1)
    others = EdgeMaps(maps.table[1:], maps.x, maps.tangent)
    rays = Rays(centre, direction[there], across[there])
    found = sweep_depths(others, others.closeness(_REACH).float(), P[1:], rays, _KEPT, threshold)

    def lay(values: Tensor) -> Tensor:
        return values.new_zeros(p, m, *values.shape[1:]).masked_scatter(there.view(p, m, *[1] * (values.ndim - 1)), values)

    depth, votes, blur = lay(found.depth), lay(found.votes), lay(found.blur)
    share = min(1.0, _FULL / max(len(P) - 1, 1))
    path = best_path(depth, share * votes, threshold * blur, direction, _KEPT)
    chosen = (depth - path.depth[..., None]).abs().argmin(-1)[..., None, None].expand(p, m, 1, 3)
    tangent = lay(found.tangent).gather(2, chosen)[:, :, 0]
    X = centre + path.depth[..., None] * direction
    sight = _Sight(maps, P.expand(p, *P.shape), torch.ones(p, len(P), dtype=torch.bool), tangent, threshold)
    sure = path.sure & there
    X, basis, near, measured = refine_samples(sight, X, sure, torch.zeros(p, dtype=torch.bool))
    measured = measured & ((near.weight > 0.25).sum(1) >= least_views) & torch.isfinite(X).all(-1)
    covariance = covariance_across(sight, X, basis, near)
    sigma = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=0).sqrt()
    # A leap ends a piece.
    step = torch.linalg.vector_norm(X[:, 1:] - X[:, :-1], dim=-1)
    stride = torch.linalg.vector_norm(direction[:, 1:] - direction[:, :-1], dim=-1) * path.depth[:, 1:]
    breaks = torch.nn.functional.pad(~(measured[:, 1:] & measured[:, :-1]) | (step > 10 * stride), (1, 0), value=True)
    piece = breaks.flatten().cumsum(0)[measured.flatten()]
    length = torch.bincount(piece, minlength=1)[piece]
    keep = length >= shortest
    focal = torch.linalg.vector_norm(P[0, 0, :3])
    fields = (X[measured], piece, torch.full_like(piece, image), sigma[measured], path.depth[measured] / focal)
    return Pieces(*(f[keep] for f in fields))


def _rows(values: Float[Tensor, "n d"], chain: Int[Tensor, "n"]) -> tuple[Float[Tensor, "p m d"], Bool[Tensor, "p m"]]:
    """Samples of each chain in a row of its own."""
    _, row, number = torch.unique_consecutive(chain, return_inverse=True, return_counts=True)
    rank = torch.arange(len(chain)) - (number.cumsum(0) - number)[row]
    p, m = len(number), int(number.amax()) if len(number) else 0
    out, there = values.new_zeros(p, m, values.shape[-1]), torch.zeros(p, m, dtype=torch.bool)
    out[row, rank], there[row, rank] = values, True
    return out, there
