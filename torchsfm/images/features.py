"""Distinctive points with descriptors (SIFT), for matching photographs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Shaped
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.images.reading import Photograph, pixels_of

_SCALE = 0.5 * 2 ** (1 / 6)
"""OpenCV gives twice the smaller of two Gaussians, of ratio 2^(1/3), whose difference answers most to what lies between."""

_CELLS = 24

_LOOSER = 3.0
"""By so much both tests of points are looser in images that have too few."""


@dataclass(frozen=True)
class Features:
    """Points of one image, each with a description of what is around it.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> found = torchsfm.detect_features(image)
        >>> best = found.response.topk(5).indices
        >>> found.x[best].shape, bool((found.scale > 0).all()), found.descriptors.dtype
        (torch.Size([5, 2]), True, torch.uint8)
    """

    x: Float[Tensor, "n 2"]
    """Pixel positions; the centre of the top-left pixel is (0, 0)."""
    scale: Float[Tensor, " n"]
    """Size in pixels: the standard deviation of a Gaussian blob that looks like the point."""
    angle: Float[Tensor, " n"]
    """Orientation in radians from the x axis towards the y axis (clockwise on the screen), in [0, 2 pi)."""
    response: Float[Tensor, " n"]
    """Contrast of the point; larger is more distinct."""
    descriptors: Shaped[Tensor, "n d"]
    """RootSIFT times 256 as uint8, at most 127 (d = 128), or unit vectors in floating point from another detector."""

    def __len__(self) -> int:
        return int(self.x.shape[0])


def check_features(features: object) -> None:
    """See that an argument is a sequence of `Features`.

    Raises:
        ValueError: It is not.
    """
    check_options(features=(features, Sequence))
    if not all(isinstance(f, Features) for f in cast(Sequence[object], features)):
        raise ValueError("features: wanted Features of each image")


def detect_features(
    image: Photograph | Float[Tensor, "c h w"],
    max_features: int = 8192,
    *,
    contrast: float = 0.01,
    edge: float = 10.0,
    enough: int = 0,
    max_size: int = 2400,
) -> Features:
    """SIFT points with RootSIFT descriptors (Lowe, IJCV 2004; Arandjelovic and Zisserman, CVPR 2012).

    A point with several strong gradient directions is given once for each of them, at the same position.

    Args:
        image: A photograph, or pixels in [0, 1], grey or red, green, blue.
        max_features: How many points are kept at most: those of high contrast, which match best, but from all over the image,
            as poses want them. A point's contrast counts divided by its rank among those of its cell, of 24 along the image.
        contrast: Smallest contrast, in the units of OpenCV's `contrastThreshold`.
        edge: Points whose principal curvatures have a larger ratio than this lie on an edge and are dropped.
        enough: An image with fewer points is given up to so many, after the others those of a third of that contrast and three
            times that ratio: bends of edges are most of what smooth things have. Fewer of these are found again elsewhere.
        max_size: Larger images are scaled down to this longer side for the detection; positions are those of the image given.

    Returns:
        The points in the order in which they were chosen, on the CPU; always the same for the same image. An image without
        structure has no points.

    Raises:
        ValueError: The shape of the image or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> found = torchsfm.detect_features(image)
        >>> len(found.x) > 20, found.descriptors.shape[1]
        (True, 128)
    """
    import cv2

    check_options(
        max_features=(max_features, "int >= 1"), contrast=(contrast, "float >= 0"), edge=(edge, "float > 0"),
        max_size=(max_size, "int >= 1"), enough=(enough, "int >= 0"),
    )  # fmt: skip
    gray = gray_bytes(pixels_of(image))
    height, width = gray.shape
    shrink = min(1.0, max_size / max(height, width))
    if shrink < 1:
        gray = cv2.resize(gray, (max(1, round(width * shrink)), max(1, round(height * shrink))), interpolation=cv2.INTER_AREA)
    # Without the precise option OpenCV's first octave, and with it every point, is shifted by a quarter of a pixel.
    keypoints: list[Any] = []
    for looser, most in ((1.0, max_features), (_LOOSER, min(enough, max_features))):
        if len(keypoints) < most:
            sift = cv2.SIFT.create(0, 3, contrast / looser, edge * looser, 1.6, enable_precise_upscale=True)
            known = {(*k.pt, k.size, k.angle) for k in keypoints}
            more = [k for k in sift.detect(gray, None) if (*k.pt, k.size, k.angle) not in known]
            keypoints += [more[i] for i in _spread(_table(more), max(gray.shape) / _CELLS)[: most - len(keypoints)]]
    table = _table(keypoints)
    raw = sift.compute(gray, keypoints)[1] if keypoints else np.zeros((0, 128), np.float32)
    zoom = np.array([width / gray.shape[1], height / gray.shape[0]])
    return Features(
        x=torch.from_numpy((table[:, :2] + 0.5) * zoom - 0.5).float(),
        scale=torch.from_numpy(table[:, 2] * (_SCALE * zoom.mean())).float(),
        angle=torch.from_numpy(np.deg2rad(table[:, 3])).float(),
        response=torch.from_numpy(table[:, 4]).float(),
        descriptors=_root_sift(torch.from_numpy(raw)),
    )


def _table(keypoints: Sequence[Any]) -> NDArray[np.float64]:
    """Rows (x, y, size, angle, response)."""
    return np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], np.float64).reshape(-1, 5)


def _spread(table: NDArray[np.float64], cell: float) -> NDArray[np.int64]:
    """The rows (x, y, size, angle, response) by response over rank in their cell."""
    order = np.lexsort((table[:, 3], table[:, 2], table[:, 0], table[:, 1], -table[:, 4]))
    row, column = (table[order, 1] // cell).astype(np.int64), (table[order, 0] // cell).astype(np.int64)
    by_cell = np.lexsort((column, row))  # stable: strongest first in each cell
    new = np.append(True, (np.diff(row[by_cell]) != 0) | (np.diff(column[by_cell]) != 0))[: len(order)]
    rank = np.empty(len(order))
    rank[by_cell] = np.arange(len(order)) - np.maximum.accumulate(np.where(new, np.arange(len(order)), 0)) + 1
    return order[np.argsort(-table[order, 4] / rank, kind="stable")]


def gray_bytes(pixels: Tensor) -> NDArray[np.uint8]:
    """An image as OpenCV takes it, grey."""
    check_options(image=(pixels, Tensor))
    if pixels.ndim != 3 or pixels.shape[0] not in (1, 3) or 0 in pixels.shape:
        raise ValueError(f"image: wanted shape (1, h, w) or (3, h, w), got {tuple(pixels.shape)}")
    pixels = pixels.detach().to("cpu", torch.float32)
    # In place, as a large photograph takes half a gigabyte.
    gray = pixels[0].clone()
    if pixels.shape[0] == 3:  # the luma of ITU-R BT.601, as JPEG has it
        gray.mul_(0.299).add_(pixels[1], alpha=0.587).add_(pixels[2], alpha=0.114)
    return gray.nan_to_num_().clamp_(0, 1).mul_(255).round_().to(torch.uint8).numpy()


def _root_sift(raw: Tensor) -> Tensor:
    raw = raw.float()
    root = (raw / raw.sum(-1, keepdim=True).clamp_min(1e-12)).sqrt()
    return (root * 256).round_().clamp_(0, 127).to(torch.uint8)
