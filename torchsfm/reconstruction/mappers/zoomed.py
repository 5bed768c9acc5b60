"""Photographs of one size that were taken with different focal lengths: a zoom lens, or several cameras, and no file tells.

Images of one size share a camera, which makes it well determined. Where that is wrong most images find no place. The
fundamental matrices of the pairs tell before anything is placed: with a focal length for each image they are essential matrices
by more than as many further numbers bring about by chance (Schwarz, "Estimating the dimension of a model", Annals of
Statistics 1978). Lenses that distort and principal points off the middle make them look so as well, so that models decide. Few
images find their places with a wrong focal length, too, far from the right ones, and have too few pairs to tell: of these
models are asked wherever they could.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.autocalibration import calibrate_view_graph
from torchsfm.autocalibration.focal_from_fundamentals import SCALE, WIDE
from torchsfm.geometry import intrinsics
from torchsfm.linalg import svdvals
from torchsfm.reconstruction.evidence.consistency import excess_scatter
from torchsfm.reconstruction.mappers.beginning import Beginning, Grown
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mapping.adjust import LOSS, adjust, support
from torchsfm.reconstruction.mapping.calibration import FEW, calibration_of, measure_noise
from torchsfm.reconstruction.mapping.cameras import FOCAL_SIGMA, telling_pairs, with_square_pixels
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import triangulate_tracks
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, ViewGraph

TRIED = 64
"""Common focal lengths that are tried."""
MORE, MUCH_MORE = 1.03, 1.08
"""By how much more of what is seen must be explained, as numbers of their own make up for a little of all errors: by focal
lengths that differ, and by such as one lens has but for a photograph's own faults."""
ANY_ANGLE = 1e-4
"""Points count at any angle when models are compared: a wrong one may have them nearer, and explains no more by it."""
FOCAL_FAULTS = 0.02
"""By how much a photograph's own faults make its focal length look another."""
NEAR: dict[str, Any] = {"max_iterations": 30, "tolerance": 1e-5}
"""Where adjustments that are compared end."""
ENOUGH = 2.0
"""Pairs for each image, of whatever kind, by which models tell focal lengths where pairs do not; of few images one for each."""
MOST = 60
"""Images of one size that are asked: those of the most pairs."""


def part_zoomed(
    graph: ViewGraph, camera_index: Int[Tensor, "v"], told: Bool[Tensor, "v"], aspect: Float[Tensor, "v"] | None = None
) -> Int[Tensor, "v"] | None:
    """Give each image a camera of its own where the pairs say that those of one have several focal lengths, or cannot tell.

    Args:
        graph: Verified pairs.
        camera_index: Which camera took each image, as far as sizes and files tell.
        told: Images whose file states a focal length: those of one camera have the same.
        aspect: Focal lengths along y over those along x of each image; of square pixels if None.

    Returns:
        Which camera took each image, numbered from 0 in the order of the images; None where it stays as it is.
    """
    differ: dict[int, bool | None] = {
        k: _focal_lengths_differ(graph, camera_index == k, aspect)
        for k in torch.unique(camera_index[~told]).tolist()
        if not bool(told[camera_index == k].any())
    }
    several = [k for k, answer in differ.items() if answer] or [k for k, answer in differ.items() if answer is None]
    if not several:
        return None
    own = torch.isin(camera_index, camera_index.new_tensor(several))
    v = len(camera_index)
    keys = torch.where(own, v + torch.arange(v), camera_index).tolist()
    order = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return camera_index.new_tensor([order[key] for key in keys])


def better_beginning(
    together: Beginning,
    apart: Beginning,
    make: Callable[[Mapping, MappingOptions], tuple[Grown, Mapping] | None],
) -> tuple[Beginning, Grown | None]:
    """Cameras of their own for some images, if these explain clearly more of what is seen, else those that images share.

    Args:
        together: With cameras that images share.
        apart: With cameras of their own.
        make: Makes a model, and what is left of it without images that contradict it.

    Returns:
        The better one, and the model that came of it.
    """
    one, several = (make(begun.empty, begun.options) for begun in (together, apart))
    if several is None:
        return together, None if one is None else one[0]
    if one is None:
        return apart, several[0]
    threshold = together.options.reprojection
    models = [triangulate_tracks(model, threshold=threshold, min_angle=ANY_ANGLE) for _, model in (one, several)]
    # What bends move is less than a pixel, and many times what noise does.
    noise = min(measure_noise(model, LOSS) for model in models)
    known, more = (support(model, threshold, noise) for model in models)
    shared = together.empty.camera_index
    if more > MUCH_MORE * known or (more > MORE * known and not one_focal_length(several[1], apart.options, shared)):
        return apart, several[0]
    return together, one[0]


def one_focal_length(model: Mapping, options: MappingOptions, family: Int[Tensor, "v"]) -> bool:
    """Whether cameras of their own have about one focal length in each family of images.

    Each is more probably the same, but for what a photograph's own faults make of it, than one of another camera.
    """
    if model.adjustment is None:
        return False
    prior = replace(options, alike=False).prior(model)
    far = adjust(model, free=model.adjustment.free, prior=prior, **NEAR)
    found = calibration_of(far, prior, loss=LOSS, excess=excess_scatter(far, threshold=options.reprojection))
    of, camera = torch.unique(torch.stack((family, model.camera_index))[:, model.registered], dim=1)
    focal, variance = found.values[camera, 0].log(), (found.deviation[camera, 0] / found.values[camera, 0]).square()
    for own in (of == k for k in torch.unique(of)):
        square = (focal[own] - focal[own].median()).square()
        same, other = (variance[own] + width**2 for width in (FOCAL_FAULTS, FOCAL_SIGMA["fundamental matrices"]))
        if not bool((square / same + same.log() < square / other + other.log()).all()):
            return False
    return True


def _focal_lengths_differ(graph: ViewGraph, member: Bool[Tensor, "v"], aspect: Float[Tensor, "v"] | None) -> bool | None:
    """Whether a focal length for each image explains the pairs of some images so much better than one for all.

    None where too few pairs tell, but models of as many pairs as there are do.
    """
    telling = telling_pairs(graph) & member[graph.pairs].all(-1)
    pairs = graph.pairs[telling]
    number = torch.bincount(pairs.flatten(), minlength=len(member))
    asked = torch.zeros_like(member)
    asked[number.argsort(descending=True, stable=True)[:MOST]] = True
    among = asked[pairs].all(-1)
    images, ends = torch.unique(pairs[among], return_inverse=True)
    # Fewer pairs than focal lengths always agree with some.
    if len(ends) <= len(images):
        within = (graph.fundamental_inliers >= MIN_INLIERS) & member[graph.pairs].all(-1)
        count = len(torch.unique(graph.pairs[within]))
        # Few images tell where they show something besides a plane.
        beside = within & (graph.fundamental_inliers - graph.homography_inliers >= MIN_INLIERS)
        few = count <= FEW and int(beside.sum()) >= count
        return None if count and (few or int(within.sum()) >= ENOUGH * count) else False
    F, size, c = with_square_pixels(graph, aspect)
    F, size, c = F[telling][among].double(), size[images].double(), c[images].double()
    tried = size.max() * torch.linspace(math.log(WIDE[0]), math.log(WIDE[1]), TRIED, dtype=F.dtype).exp()
    first, second = (intrinsics(tried[:, None], centre) for centre in c[ends].unbind(1))
    costs = disagreement(pair_asymmetry(F, first, second)).sum(-1)
    common = tried[costs.argmin()].expand(len(images))
    sigma = torch.full_like(common, FOCAL_SIGMA["default"])
    found = calibrate_view_graph(F, ends, c, common, sigma)
    gain = float(costs.min() - disagreement(found.asymmetry).sum())
    return gain > 0.5 * (len(images) - 1) * math.log(len(ends))


def disagreement(asymmetry: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Minus the logarithm of how probable asymmetries are, some of which belong to wrong pairs."""
    return torch.log1p((asymmetry / SCALE).square()) / 2


def pair_asymmetry(
    F: Float[Tensor, "p 3 3"], first: Float[Tensor, "k #p 3 3"], second: Float[Tensor, "k #p 3 3"]
) -> Float[Tensor, "k p"]:
    """`(s1 - s2) / (s1 + s2)` of the essential matrices that intrinsics make of pairs: 0 of the right ones."""
    s, _ = svdvals(second.mT @ F @ first)
    return (s[..., 0] - s[..., 1]) / (s[..., 0] + s[..., 1]).clamp(min=1e-300)
