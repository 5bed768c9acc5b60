"""The view graph of given tracks."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.reconstruction.matching.view_graph import ViewGraph, verify_pairs


def graph_from_tracks(
    names: Sequence[str],
    image_size: Int[Tensor, "v 2"],
    x: Float[Tensor, "n 2"],
    view: Int[Tensor, "n"],
    track: Int[Tensor, "n"],
    color: Float[Tensor, "n 3"],
    *,
    generator: torch.Generator | None = None,
) -> tuple[ViewGraph, Int[Tensor, "n"]]:
    """The view graph of given tracks: every pair of images that share enough of them, verified.

    Args:
        names: File names of the images.
        image_size: Width and height in pixels.
        x: Image points in pixels.
        view: Image of each point.
        track: Track of each point; two points of one image in one track keep the first.
        color: Colour at each point.
        generator: Source of randomness.

    Returns:
        The graph, whose image points are sorted by image, and their tracks.
    """
    order = torch.argsort(view, stable=True)
    x, view, track, color = x[order], view[order], track[order], color[order]
    v, labels = len(names), int(track.max()) + 1 if len(track) else 0
    node = torch.full((v, labels), -1, dtype=torch.long)
    flipped = torch.arange(len(x)).flip(0)
    node[view[flipped], track[flipped]] = flipped
    counts = torch.bincount(view, minlength=v)
    start = counts.cumsum(0) - counts
    seen = (node >= 0).double()
    shared = (seen @ seen.T).triu(1)
    pairs = (shared >= 15).nonzero()
    matches = []
    for i, j in pairs.tolist():
        both = (node[i] >= 0) & (node[j] >= 0)
        matches.append(torch.stack([node[i][both] - start[i], node[j][both] - start[j]], 1))
    points, colors = torch.split(x, counts.tolist()), torch.split(color, counts.tolist())
    verified = verify_pairs(image_size, points, pairs, matches, generator=generator)
    return verified.graph(names, image_size, points, colors, pairs), track
