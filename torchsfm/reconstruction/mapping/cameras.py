"""First guesses for cameras of which nothing, or little, is known."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import calibrate_view_graph, focal_from_fundamentals
from torchsfm.geometry import DISTORTION_MODELS, Camera, intrinsics
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, ViewGraph
from torchsfm.reconstruction.messages import ReconstructionError

SHORTEST = 0.01
"""No lens has a shorter focal length, in units of the longer side of its images, whose ends it would see at 89 degrees."""
DEFAULT_FOCAL = 1.2
"""Focal length over the longer side of the image (a view of 45 degrees) when nothing tells it."""


FOCAL_SIGMA = {
    "given": 0.01,
    "exif": 0.05,
    "autocalibration": 0.05,
    "fundamental matrices": 0.2,
    "view graph": 0.2,
    "default": 0.5,
}
"""How far a focal length may be off, as a fraction, by where it comes from."""
REFUTED = 3.0
"""A stated focal length that is off from that of the pairs by so many standard deviations of both is not that of the images:
they were cropped, or scaled, or what was stated is that of another film format."""


def focal_uncertainty(source: Sequence[str]) -> Float[Tensor, "g"]:
    """The uncertainty of each camera's focal length."""
    return torch.tensor([FOCAL_SIGMA[word] for word in source], dtype=torch.float64)


def group_cameras(
    image_size: Int[Tensor, "v 2"], labels: Sequence[str], shared: bool | None, aspect: Float[Tensor, "v"] | None = None
) -> Int[Tensor, "v"]:
    """Which images were taken by one camera.

    Args:
        image_size: Width and height; images of different size never share a camera.
        labels: What the files say of the camera (maker, model, focal length).
        shared: True to go by size alone, False for a camera per image, None to go by size and label.
        aspect: How many times as much as along x each image is stretched along y: by one camera all are alike.
    """
    if shared is False:
        return torch.arange(len(labels))
    stretched = [1.0] * len(labels) if aspect is None else aspect.tolist()
    named = zip(image_size.tolist(), labels, stretched, strict=True)
    keys = [(*size, "" if shared else label, ratio) for size, label, ratio in named]
    order = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return torch.tensor([order[key] for key in keys], dtype=torch.long)


def group_bodies(
    image_size: Int[Tensor, "v 2"], labels: Sequence[str], aspect: Float[Tensor, "v"] | None = None
) -> Int[Tensor, "v"]:
    """Which images one camera may have taken with all focal lengths of its zoom lens.

    Args:
        image_size: Width and height; cameras are not looked for among images of different size.
        labels: What the files say of the camera (maker, model, and last, after a bar, the focal length).
        aspect: As for `group_cameras`.
    """
    return group_cameras(image_size, [label.rpartition("|")[0] for label in labels], None, aspect)


def guess_cameras(
    graph: ViewGraph,
    camera_index: Int[Tensor, "v"],
    *,
    model: str,
    K: Float[Tensor, "3 3"] | None,
    exif_focal: Sequence[float | None],
    aspect: Float[Tensor, "v"] | None = None,
) -> tuple[Camera, tuple[str, ...]]:
    """Cameras to start from: no distortion, centred principal point, and the best word on the focal length.

    Args:
        graph: Verified pairs, whose fundamental matrices tell the focal length where no file does.
        camera_index: Which camera took each image.
        model: Name of the distortion model.
        K: Known intrinsics.
        exif_focal: Focal length in pixels that each file states; it counts unless the pairs refute it.
        aspect: Of cameras that are not known: focal length along y over that along x, for each image; of square pixels if None.

    Returns:
        The cameras, and where each focal length comes from, a key of `FOCAL_SIGMA`.

    Raises:
        ReconstructionError: There is no such distortion model, or K is not in pixels.
    """
    if K is not None and float(K[0, 0]) < SHORTEST * float(graph.image_size.max()):
        width, height = graph.image_size[0].tolist()
        raise ReconstructionError(
            f"K: wanted pixels, got a focal length of {float(K[0, 0]):g} for images of {width} x {height}"
        )
    g = int(camera_index.max()) + 1
    dtype = graph.x.dtype
    F, sizes, centres = with_square_pixels(graph, aspect)
    first = torch.stack([(camera_index == k).nonzero()[0, 0] for k in range(g)])
    size, c = sizes[first], centres[first]
    focal, source = [], []
    for k in range(g):
        stated = [f for f, index in zip(exif_focal, camera_index.tolist(), strict=True) if index == k and f]
        value, word = float(size[k].max()) * DEFAULT_FOCAL, "default"
        if stated:
            value, word = float(torch.tensor(stated, dtype=dtype).median()), "exif"
        found = None if K is not None else _focal_of_pairs(graph, F, camera_index == k, c[k], size[k])
        if found is not None and (not stated or _refutes(found, value)):
            value, word = found, "fundamental matrices"
        focal.append(value)
        source.append(word)
    if K is not None:
        matrices, source = K.to(dtype).expand(g, 3, 3).clone(), ["given"] * g
    else:
        f = _focals_of_graph(graph, F, camera_index, c, torch.tensor(focal, dtype=dtype), source)
        ratio = 1.0 if aspect is None else aspect[first].to(dtype)
        matrices = intrinsics(f, (graph.image_size[first].to(dtype) - 1) / 2, aspect=ratio)
    if model not in DISTORTION_MODELS:
        raise ReconstructionError(f"no camera model '{model}'; there are {', '.join(DISTORTION_MODELS)}")
    distortion = DISTORTION_MODELS[model]
    zero = torch.zeros(g, distortion.num_parameters, dtype=dtype)
    return Camera(matrices, distortion.from_parameters(zero)), tuple(source)


def _focal_of_pairs(
    graph: ViewGraph, F: Float[Tensor, "q 3 3"], member: Bool[Tensor, "v"], c: Float[Tensor, "2"], size: Float[Tensor, "2"]
) -> float | None:
    """One focal length that makes the fundamental matrices of a camera's pairs essential; None where they do not tell."""
    good = member[graph.pairs].all(-1) & telling_pairs(graph)
    if not bool(good.any()):
        return None
    weights = graph.fundamental_inliers[good].to(c.dtype)
    count = int(good.sum())
    found = focal_from_fundamentals(F[good], c.expand(count, 2), c.expand(count, 2), weights=weights, image_size=size)
    return float(found.model) if found.status == Status.OK else None


def _refutes(found: float, stated: float) -> bool:
    """Whether the focal length of many pairs and one that a file states cannot both be right."""
    sigma = math.hypot(FOCAL_SIGMA["fundamental matrices"], FOCAL_SIGMA["exif"])
    return abs(math.log(found / stated)) > REFUTED * sigma


def _focals_of_graph(
    graph: ViewGraph,
    F: Float[Tensor, "q 3 3"],
    camera_index: Int[Tensor, "v"],
    c: Float[Tensor, "g 2"],
    focal: Float[Tensor, "g"],
    source: list[str],
) -> Float[Tensor, "g"]:
    """Focal lengths that nothing told so far, by the pairs of images of different cameras; their `source` is changed."""
    if "default" not in source:
        return focal
    pairs = camera_index[graph.pairs]
    telling = telling_pairs(graph) & (pairs[:, 0] != pairs[:, 1])
    found = calibrate_view_graph(F[telling], pairs[telling], c, focal, focal_uncertainty(source).to(focal.dtype))
    told = (found.status == Status.OK) & torch.tensor([word == "default" for word in source])
    for k in told.nonzero()[:, 0].tolist():
        source[k] = "view graph"
    return torch.where(told, found.model, focal)


def with_square_pixels(
    graph: ViewGraph, aspect: Float[Tensor, "v"] | None
) -> tuple[Float[Tensor, "q 3 3"], Float[Tensor, "v 2"], Float[Tensor, "v 2"]]:
    """Fundamental matrices, and sizes and middles of the images, had these not been stretched along y by their `aspect`."""
    size = graph.image_size.to(graph.x.dtype)
    stretch = torch.ones(len(size), 3, dtype=size.dtype)
    if aspect is not None:
        stretch[:, 1] = aspect
    i, j = graph.pairs.unbind(1)
    return stretch[j, :, None] * graph.F * stretch[i, None], size / stretch[:, :2], (size - 1) / 2 / stretch[:, :2]


def telling_pairs(graph: ViewGraph, share: float = 0.7) -> Bool[Tensor, "q"]:
    """Pairs that determine F: neither a plane nor a rotation explains more than a share of what they have in common."""
    several = graph.fundamental_inliers >= 2 * MIN_INLIERS
    return several & (graph.homography_inliers < share * graph.fundamental_inliers.double())
