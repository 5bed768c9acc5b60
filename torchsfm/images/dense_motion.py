"""Where what an image of a sequence shows is in the next one, however far: a prediction for what is followed through it.

Optical flow by inverse search (Kroeger et al., ECCV 2016), from one image to the other and back. From what returns to where it
came from and from matched features the motion around is guessed, and the flow found anew from there. Each pixel keeps the flow
that returns best, and is believed if it looks alike there.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import check_one_problem, check_options
from torchsfm.images.features import Features, detect_features, gray_bytes
from torchsfm.images.matching import match_features
from torchsfm.images.reading import Photograph, pixels_of
from torchsfm.linalg.devices import on_the_cpu

_ROUNDS = 3
"""Times that the flow is found, each from what agreed before."""
_PATCH = 8
"""Side of the patches that are followed, in pixels,"""
_STRIDE = 3
"""from one to the next, and"""
_DESCENTS = 50
"""steps of each."""
_RETURNS = 3.0
"""Pixels, the most, between a place and where the flow there and back leads,"""
_SEED = 1.0
"""and for the motion around to be guessed from it."""
_ALIKE = 0.7
"""The least correlation of what is around it here and there,"""
_BESIDE = 7
"""up to so many pixels away,"""
_FAINT = 2.0
"""where so many grey levels of 256 may be noise."""
_APART = 12
"""Pixels between places from which the motion is guessed,"""
_CELL = 8
"""and between those for which it is."""
_NEAREST = 5
"""Places whose median motion is the guess."""
_RATIO = 0.9
"""Of Lowe's test: neighbours have their say after it."""
_NEIGHBOURS = 10
"""Of a motion, of which at least"""
_SUPPORT = 3
"""must move alike:"""
_SLACK = (4.0, 0.25)
"""to so many pixels, and to such a part of how far they are apart."""
_STEP = 2
"""Pixels from one place of a field to the next."""
_SMALLEST = 4 * _PATCH
"""Shorter side of images, in pixels."""


@dataclass(frozen=True)
class DenseMotion:
    """Where what two images show is in the other one, at every other pixel of each.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> (motion,) = torchsfm.images.detect_motion([image, image.roll(30, -1)])
        >>> place, sure = motion.moved(torch.tensor([[60.0, 60.0]]))
        >>> place.round(), bool(sure)
        (tensor([[90., 60.]]), True)
    """

    shift: Float[Tensor, "2 h w 2"]
    """Pixels from where a thing is in the first image to where it is in the second, and the other way round."""
    sure: Bool[Tensor, "2 h w"]
    """Where the way there and back leads back, and what is there looks alike."""

    def moved(
        self, x: Float[Tensor, "*batch 2"], back: bool = False
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Where places of the first image are in the second, and which are sure; of the second in the first, if `back`."""
        shift, sure = self.shift[int(back)], self.sure[int(back)]
        h, w = sure.shape
        column, row = (x / _STEP).nan_to_num(-1.0, -1.0, -1.0).round().clamp(-1, max(h, w)).long().unbind(-1)
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        if h == 0 or w == 0:
            return x, inside
        at = row.clamp(0, h - 1), column.clamp(0, w - 1)
        good = inside & sure[at]
        return x + torch.where(good[..., None], shift[at].to(x), 0), good


@on_the_cpu
def detect_motion(images: Iterable[Photograph | Float[Tensor, "c h w"]]) -> list[DenseMotion]:
    """Where what images of a sequence show is in the next one.

    Things may move by a good part of the image. Where nothing can be told, as in flat or repeated patterns, where something is
    hidden, or where it changes its looks too much, no motion is sure.

    Args:
        images: In order, grey or red, green, blue in [0, 1], all of one size.

    Returns:
        One for each image and the next. Of images smaller than 32 pixels nothing is sure.

    Raises:
        ValueError: A shape is wrong.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> motions = torchsfm.images.detect_motion([image.roll(20 * i, -1) for i in range(3)])
        >>> [float(motion.sure.float().mean()) > 0.7 for motion in motions]  # not what enters on the left
        [True, True]
    """
    import cv2

    # What the flow's search hands on from patch to patch depends on the number of threads.
    count = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return _detect(images)
    finally:
        cv2.setNumThreads(count)


def _detect(images: Iterable[Photograph | Tensor]) -> list[DenseMotion]:
    found: list[DenseMotion] = []
    before: tuple[NDArray[np.uint8], Features] | None = None
    for gray, features in _looks(images):
        if before is not None:
            if before[0].shape != gray.shape:
                raise ValueError(f"images: wanted all of one size, got {before[0].shape} and {gray.shape}")
            (pairs,) = match_features((before[1], features), torch.tensor([[0, 1]]), ratio=_RATIO)
            found.append(_between(before[0], gray, before[1].x[pairs[:, 0]], features.x[pairs[:, 1]]))
        before = gray, features
    return found


def _looks(images: Iterable[Photograph | Tensor]) -> Iterator[tuple[NDArray[np.uint8], Features]]:
    """What each image is compared by."""
    check_options(images=(images, Iterable))
    for image in images:
        pixels = pixels_of(image)
        check_one_problem(images=(pixels, "c h>=1 w>=1"))
        yield gray_bytes(pixels), detect_features(pixels)


def _between(first: NDArray[np.uint8], second: NDArray[np.uint8], x1: Tensor, x2: Tensor) -> DenseMotion:
    """The motion between two images, some places of which were matched."""
    h, w = first.shape
    places = torch.stack(torch.meshgrid(torch.arange(w), torch.arange(h), indexing="xy"), -1).float()
    x1, x2 = x1.float(), x2.float()
    if min(h, w) < _SMALLEST:
        none = torch.zeros(2, *places[::_STEP, ::_STEP].shape)
        return DenseMotion(none, none[..., 0] > 0)
    agreeing = _supported(x1, x2)
    matches = x1[agreeing], x2[agreeing]
    seeds: tuple[Tensor, Tensor] | None = None
    shifts, gaps = places.new_zeros(2, h, w, 2), places.new_full((2, h, w), torch.inf)
    for _ in range(_ROUNDS):
        there = _flow(first, second, None if seeds is None else _around(*seeds, (h, w)))
        back = _flow(second, first, None if seeds is None else _around(*seeds[::-1], (h, w)))
        both = torch.stack((there, back))
        gap = torch.stack((_gap(there, back, places), _gap(back, there, places)))
        shifts = torch.where((gap < gaps)[..., None], both, shifts)
        gaps = torch.minimum(gap, gaps)
        middle = slice(_APART // 2, None, _APART)
        good = gaps[0, middle, middle] < _SEED
        x = places[middle, middle][good]
        y = x + shifts[0, middle, middle][good]
        agreeing = _supported(x, y)
        # Features have their turn first: what the first flow found may be elsewhere altogether.
        known = (matches,) if seeds is None and len(matches[0]) > 2 * _NEIGHBOURS else ((x[agreeing], y[agreeing]), matches)
        seeds = torch.cat([a for a, _ in known]), torch.cat([b for _, b in known])
    gaps = torch.stack((_gap(shifts[0], shifts[1], places), _gap(shifts[1], shifts[0], places)))
    grays = [torch.from_numpy(gray).float() for gray in (first, second)]
    alike = torch.stack([_likeness(grays[k], grays[1 - k], places + shifts[k]) for k in (0, 1)])
    sure = (gaps < _RETURNS) & (alike > _ALIKE)
    return DenseMotion(shifts[:, ::_STEP, ::_STEP].contiguous(), sure[:, ::_STEP, ::_STEP].contiguous())


def _flow(first: NDArray[np.uint8], second: NDArray[np.uint8], start: Float[Tensor, "h w 2"] | None) -> Float[Tensor, "h w 2"]:
    """Optical flow from one image to another."""
    import cv2

    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    search.setPatchSize(_PATCH)
    search.setPatchStride(_STRIDE)
    search.setGradientDescentIterations(_DESCENTS)
    return torch.from_numpy(search.calc(first, second, None if start is None else start.numpy().copy()))


def _gap(there: Float[Tensor, "h w 2"], back: Float[Tensor, "h w 2"], places: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w"]:
    """How far from each pixel the way there and back ends; infinitely where it leaves the image."""
    x = places + there
    size = torch.tensor(there.shape[1::-1], dtype=x.dtype) - 1
    inside = ((x >= 0) & (x <= size)).all(-1)
    seen = _seen_at(back.movedim(-1, 0), x).movedim(0, -1)
    return torch.where(inside, torch.linalg.vector_norm(there + seen, dim=-1), torch.inf)


def _likeness(first: Float[Tensor, "h w"], second: Float[Tensor, "h w"], x: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w"]:
    """Correlation of what is around each pixel with what is around its place in the other image.

    Flow of images that have nothing in common returns as well.
    """
    other = _seen_at(second[None], x)[0]
    parts = torch.stack((first, other, first.square(), other.square(), first * other))
    a, b, aa, bb, ab = torch.nn.functional.avg_pool2d(
        parts[None].double(), 2 * _BESIDE + 1, 1, _BESIDE, count_include_pad=False
    )[0]
    alike: Tensor = (ab - a * b) / ((aa - a * a + _FAINT**2) * (bb - b * b + _FAINT**2)).sqrt()
    return alike.float()


def _seen_at(values: Float[Tensor, "c h w"], x: Float[Tensor, "n m 2"]) -> Float[Tensor, "c n m"]:
    """What is at places of an image, or of anything else that each pixel has."""
    size = torch.tensor(values.shape[:0:-1], dtype=x.dtype) - 1
    return torch.nn.functional.grid_sample(
        values[None], (2 * x / size - 1)[None], mode="bilinear", padding_mode="border", align_corners=True
    )[0]


def _supported(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"]) -> Int[Tensor, " k"]:
    """Motions that some of their neighbours share, in both images."""
    index = torch.arange(len(x))
    for _ in range(2):
        good = torch.ones_like(index, dtype=torch.bool)
        for place in (x[index], y[index]):
            k = min(_NEIGHBOURS + 1, len(index))
            away, near = torch.cdist(place, place).topk(k, largest=False)
            shift = (y - x)[index]
            off = torch.linalg.vector_norm(shift[near] - shift[:, None], dim=-1)
            # Each is a neighbour of itself.
            good &= (off < _SLACK[0] + _SLACK[1] * away).sum(-1) > _SUPPORT
        index = index[good]
    return index


def _around(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"], size: tuple[int, int]) -> Float[Tensor, "h w 2"] | None:
    """The motion of all pixels, as that of places next to them."""
    if len(x) < _NEAREST:
        return None
    h, w = size
    rows, columns = (torch.arange(0, n + _CELL - 1, _CELL).float() for n in (h, w))
    cells = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    near = torch.cdist(cells.flatten(0, 1), x).topk(_NEAREST, largest=False).indices
    shift = (y - x)[near].median(1).values.reshape(*cells.shape)
    full = [(len(t) - 1) * _CELL + 1 for t in (rows, columns)]
    whole = torch.nn.functional.interpolate(shift.movedim(-1, 0)[None], size=full, mode="bilinear", align_corners=True)
    return whole[0, :, :h, :w].movedim(0, -1).contiguous()
