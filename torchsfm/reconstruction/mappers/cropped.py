"""Photographs that were cropped: principal points far from the middle, each image with a camera of its own.

Where each image has its own size, each gets its own camera, whose principal point is expected in the middle: of a single image
it is what errors of all kinds pass for. Cropped photographs do not have it there, and a model that takes it so is bent. The
images tell: with principal points anywhere they fit better by far more than chance and what matches have in common explain.
Mostly it was one camera, too, the images cut out at several places. That is a much stronger model, with which all is done anew.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import focal_from_fundamentals
from torchsfm.geometry import Camera
from torchsfm.reconstruction.evidence.consistency import excess_scatter
from torchsfm.reconstruction.mappers.beginning import Grown
from torchsfm.reconstruction.mappers.incremental import MappingOptions, extend_model
from torchsfm.reconstruction.mappers.zoomed import NEAR, one_focal_length
from torchsfm.reconstruction.mapping.adjust import LOSS, adjust, support
from torchsfm.reconstruction.mapping.calibration import choose_free, images_of_cameras, measure_noise
from torchsfm.reconstruction.mapping.cameras import FOCAL_SIGMA, telling_pairs, with_square_pixels
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS

MIN_IMAGES = 3
"""Fewer leave cameras as they were expected."""
ODDS = math.log(100)
"""Principal points are not in the middle where that is so much more probable."""
MOST, CHANGED = 4, 0.05
"""Models made with one camera, at most, from focal lengths that differ by more than this part."""


def may_be_off_centre(model: Mapping, options: MappingOptions) -> bool:
    """Whether the principal points of cameras that took one image each seem not to be where those of whole images are.

    Photographs of one size are not asked: they are hardly crops, and where each has a focal length of its own, errors of the
    structure move principal points as well.

    Args:
        model: A finished model, whose principal points were expected in the middle.
        options: How it was made.
    """
    images = images_of_cameras(model)
    adjusted = {} if model.adjustment is None else model.adjustment.free
    believed = adjusted.get("principal_point", torch.zeros_like(images, dtype=torch.bool))
    if "principal_point" not in options.free or int(images.sum()) < MIN_IMAGES or bool(((images != 1) | believed).all()):
        return False
    if len(torch.unique(model.graph.image_size[model.registered & (images == 1)[model.camera_index]], dim=0)) == 1:
        return False
    gain, excess = _gain_off_centre(model, options)
    # A wrong model has errors of all kinds: where they alone leave it open, a better one will tell.
    return _are_off(excess * gain, model)


def _are_off(gain: float, model: Mapping) -> bool:
    """Whether principal points scatter so much wider than expected, rather than so by chance.

    `gain` is half the sum of their squares, in units of what was expected: the wider Gaussian is the one of their own width.
    """
    n = 2 * int((images_of_cameras(model) == 1).sum())
    square = 2 * gain / max(n, 1)
    return square > 1 and n / 2 * (square - 1 - math.log(square)) > ODDS


def _gain_off_centre(model: Mapping, options: MappingOptions) -> tuple[float, float]:
    """How much more probable the images are if principal points lie anywhere, as a logarithm; and their excess scatter.

    Errors that matches have in common count: images say less by as much as these move pairs of images more than noise does.
    """
    lone = images_of_cameras(model) == 1
    prior, wide = (replace(options, cropped=cropped).prior(model) for cropped in (False, True))
    free = choose_free(model, options.free, prior, loss=LOSS, faultless=1)
    free["principal_point"] = free["principal_point"] | lone
    far = adjust(model, free=free, prior=wide, **NEAR)
    excess = excess_scatter(far, threshold=options.reprojection)
    near = adjust(far, free=free, prior=prior.against(excess), **NEAR)
    far = adjust(near, free=free, prior=wide.against(excess), **NEAR)
    if near.adjustment is None or far.adjustment is None:
        return 0.0, 1.0
    return (near.adjustment.cost - far.adjustment.cost) / (measure_noise(far, LOSS) ** 2 * excess), excess


def map_cropped(
    empty: Mapping,
    grown: Mapping,
    elsewhere: Bool[Tensor, "v"],
    options: MappingOptions,
    family: Int[Tensor, "v"],
    grow: Callable[[Mapping, MappingOptions], Grown | None],
    progress: Callable[[int, int], None],
) -> tuple[Grown, MappingOptions] | None:
    """Make a model anew whose principal points may be anywhere, with one camera for all if that explains the images as well.

    Args:
        empty: The mapping before anything was registered.
        grown: The model with principal points in the middle.
        elsewhere: Images that belong to other models and are left alone.
        options: How it was made.
        family: Images of the same number may be of one camera, by what is known of them.
        grow: Makes a model of the images that are not elsewhere.
        progress: Called with the number of registered images and of all.

    Returns:
        The model with the reasons of images that did not fit, and how it was made; None where that is no better.
    """
    cropped = replace(options, cropped=True)
    found: tuple[Grown, MappingOptions] | None = None
    if len(torch.unique(family[grown.registered])) == 1:
        found = _of_one_camera(empty, grown, cropped, grow)
    if found is None or not one_focal_length(found[0][0], found[1], family):
        several = extend_model(grown, elsewhere, cropped, progress), cropped
        # Several cameras explain more than one in the right place can: if they do not, the model is wrong, not the tie.
        if found is None or support(several[0][0], options.reprojection) > support(found[0][0], options.reprojection):
            found = several
    (model, _), made = found
    better = support(model, options.reprojection) > support(grown, options.reprojection)
    return found if better and _are_off(_gain_off_centre(model, made)[0], model) else None


def crops_of_one_plane(model: Mapping, options: MappingOptions) -> bool:
    """Whether most pairs of images that seem to be cropped show little besides one plane.

    Several focal lengths with principal points of their own explain images of a plane about as well, and standard deviations
    hold near one of them only.

    Args:
        model: A finished model.
        options: How it was made.
    """
    graph = model.graph
    pairs = (graph.fundamental_inliers >= MIN_INLIERS) & model.registered[graph.pairs].all(1)
    return options.cropped and 2 * int((telling_pairs(graph) & pairs).sum()) < int(pairs.sum())


def _of_one_camera(
    empty: Mapping, grown: Mapping, options: MappingOptions, grow: Callable[[Mapping, MappingOptions], Grown | None]
) -> tuple[Grown, MappingOptions] | None:
    """The best model of images of one camera that were cropped, from several focal lengths, and how it was made."""
    best: tuple[Grown, MappingOptions, float] | None = None
    images = empty.camera_index[grown.registered]
    bar = support(grown, options.reprojection)
    focals = [_focal_of_pairs(empty), *(float(c.K[images, 0, 0].median()) for c in (options.expected, grown.cameras))]
    tried: list[float] = []
    sigma = torch.full_like(options.focal_sigma, FOCAL_SIGMA["fundamental matrices"])
    while focals and len(tried) < MOST:
        focal = focals.pop(0)
        if focal is None or any(abs(math.log(focal / f)) < CHANGED for f in tried):
            continue
        tried.append(focal)
        one = replace(options, alike=True, expected=_with_focal(options.expected, focal), focal_sigma=sigma)
        trial = grow(replace(empty, cameras=one.expected), one)
        if trial is None:
            continue
        score = support(trial[0], options.reprojection)
        if score < bar:
            # Not of one camera, or else the first focal lengths would be more wrong than those of a wrong model.
            break
        if best is None or score > best[2]:
            best = trial, one, score
            # What was found from a wrong one, is found better from the right one.
            focals.insert(0, float(trial[0].cameras.K[images, 0, 0].median()))
    return None if best is None else best[:2]


def _focal_of_pairs(empty: Mapping) -> float | None:
    """The focal length that the pairs tell if all images have the same."""
    graph, K = empty.graph, empty.cameras.K
    F, size, c = with_square_pixels(graph, (K[:, 1, 1] / K[:, 0, 0])[empty.camera_index])
    good = telling_pairs(graph)
    if not bool(good.any()):
        return None
    i, j = graph.pairs[good].unbind(1)
    weights = graph.fundamental_inliers[good].to(c.dtype)
    found = focal_from_fundamentals(F[good], c[i], c[j], weights=weights, image_size=size.amax(0))
    return float(found.model) if found.status == Status.OK else None


def _with_focal(cameras: Camera, focal: float) -> Camera:
    """Cameras with another focal length, all the same, and without distortion."""
    K: Float[Tensor, "g 3 3"] = cameras.K.clone()
    K[:, :2, :2] *= (focal / K[:, 0, 0])[:, None, None]
    lens = type(cameras.distortion)
    return Camera(K, lens.from_parameters(torch.zeros_like(cameras.distortion.parameters())))
