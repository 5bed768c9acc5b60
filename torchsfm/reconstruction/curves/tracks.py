"""Which edge points of images show the samples of space curves."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.reconstruction.curves.edge_maps import EdgeMap, EdgeMaps, MapsOfImages
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.model.curves import Curves

_ALONG = 0.85
"""Least cosine of the angle between an edge and the image of the curve."""
_RUN = 4
"""Neighbouring samples, the least number, that an image shows on one chain: single ones are near an edge by chance."""
EDGE = 0.3
"""Standard deviation, pixels, with which the edges that views show of one curve differ: of rounded corners, shadows, paint."""


def track_samples(
    curves: Curves,
    tangent: Float[Tensor, "n 3"],
    edges: Sequence[ImageEdges],
    maps: MapsOfImages,
    P: Float[Tensor, "v 3 4"],
    threshold: float,
) -> Curves:
    """The curves with the edge points that show them.

    Args:
        curves: The curves.
        tangent: Which way they run.
        edges: Edge points of the images.
        maps: The same as cameras without distortion see them.
        P: These cameras.
        threshold: Largest distance of the image of a sample from its edge point across the edge, pixels.
    """
    X, tangent = curves.X.double(), tangent.double()
    count = [len(own) for own in edges]
    found = [
        _shown(X, tangent, curves.curve, maps[v], P[v], threshold) if count[v] else (curves.sample[:0], curves.sample[:0])
        for v in range(len(edges))
    ]
    view = torch.cat([torch.full_like(sample, v) for v, (sample, _) in enumerate(found)])
    sample = torch.cat([sample for sample, _ in found])
    edge = torch.cat([edge + sum(count[:v]) for v, (_, edge) in enumerate(found)])
    order = sample.argsort(stable=True)
    edge = edge[order]
    x, normal, curvature, sigma = (
        torch.cat([getattr(own, name) for own in edges]).to(curves.X)[edge] for name in ("x", "normal", "curvature", "sigma")
    )
    weight = 1 / (sigma.square() + EDGE**2)
    return replace(curves, x=x, normal=normal, curvature=curvature, weight=weight, view=view[order], sample=sample[order])


def _shown(
    X: Float[Tensor, "n 3"],
    tangent: Float[Tensor, "n 3"],
    curve: Int[Tensor, "n"],
    own: EdgeMap,
    P: Float[Tensor, "3 4"],
    threshold: float,
) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Samples that an image shows, and its edge points next to them."""
    maps, points = EdgeMaps.of([own]), own.points
    y = X @ P[:, :3].mT + P[:, 3]
    depth = y[:, 2:]
    y = y[:, :2] / torch.where(depth > 0, depth, torch.nan)
    edge = maps.nearest(y[None])[0]
    near = maps.near(y[None])
    shown = tangent @ P[:2, :3].mT - y * (tangent @ P[2, :3])[:, None]
    length = torch.linalg.vector_norm(shown, dim=-1)
    agrees = (shown * near.tangent[0]).sum(-1).abs() > _ALONG * length
    good = agrees & (near.r[0].abs() < threshold) & (edge < len(points.x))
    chain = torch.where(good, torch.nn.functional.pad(points.chain, (0, 1), value=-1)[edge], -1)
    good = good & _in_runs(torch.stack((chain, curve)))
    return good.nonzero()[:, 0], edge[good]


def _in_runs(keys: Int[Tensor, "f n"]) -> Bool[Tensor, "n"]:
    """What is in a run of equal keys that is not too short."""
    if not keys.shape[1]:
        return keys.new_zeros(0, dtype=torch.bool)
    new = torch.nn.functional.pad((keys[:, 1:] != keys[:, :-1]).any(0), (1, 0), value=True)
    run = new.cumsum(0) - 1
    return torch.bincount(run)[run] >= _RUN
