"""Which mapper suits a view graph: from two images on, or all images at once."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.mappers.incremental import UNKNOWN_FOCAL
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS

MANY = 500
"""Images that hang together, from which on they are mapped at once: up to 200 at least, one by one is as exact and as fast."""
HELD, MOST = 3, 0.9
"""Pairs by which an image must be held to be placed without its points (one of two may be wrong), and how many must be so."""


def choose_mapper(pairs: Int[Tensor, "q 2"], inliers: Int[Tensor, "q"], focal_sigma: Float[Tensor, "v"]) -> str:
    """The mapper for a view graph, as `reconstruct(method="auto")` chooses it.

    All images at once is for many images that many pairs hold together, whose focal lengths are known roughly. Images from
    which little is known but that they follow each other are better mapped one by one, each by the points that it sees.

    Args:
        pairs: Pairs of images.
        inliers: How many matches of each agree with its epipolar geometry.
        focal_sigma: How far off the focal length of each image may be, as a standard deviation of its logarithm.

    Returns:
        "incremental" or "global".
    """
    views = len(focal_sigma)
    related = pairs[inliers >= MIN_INLIERS]
    component = components(related, views)
    largest = component == torch.bincount(component, minlength=1).argmax()
    held = torch.bincount(related.flatten(), minlength=views) >= HELD
    known = focal_sigma < UNKNOWN_FOCAL

    def most(good: Bool[Tensor, "v"]) -> bool:
        return float(good[largest].double().mean()) >= MOST

    return "global" if int(largest.sum()) >= MANY and most(held) and most(known) else "incremental"
