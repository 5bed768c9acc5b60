"""What is fixed to the images and not to the scene: watermarks, dates, a part of the vehicle, the ground of a turntable.

Its points match at the same place in all images, and may be so many that a camera seems not to have moved. One pair tells when
its other matches move, agree on an epipolar geometry, and what stands still contradicts that. Many images at the same place
make sure: a camera that rests for a while, before which something moves, has no such places in most of its images.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import sampson_distance
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, scale_of_images, verify_pairs

_STILL, _MOVING = 1.0, 5.0
"""Pixels, of images of 1600 pixels or less, by which what stands still differs from one image to another at most; and by which
what moves does at least."""
_OFF = 2.0
"""How far from its epipolar line, in thresholds of verification, a still point is one of another geometry."""
_THRESHOLD = 3.0
_PAIRS = 4
"""How many pairs of an image are asked: all show the same."""
_CELL = 4.0
"""The width of the cells of places, in distances of what stands still."""
_IMAGES, _SHARE = 3, 0.5
"""The fewest images, of three and more, and which part of those of one size that move, that show an overlay at a place."""
_BLOCK = 8
"""In or next to a block of so many cells that has a place of an overlay the fewest images are enough: what is behind a
watermark hides parts of it."""

Matches = Mapping[int, Int[Tensor, "_ 2"]]


@dataclass(frozen=True)
class Overlays:
    """Places of images at which something stands still, for each size of image; where there are none, all is admitted."""

    cells: Int[Tensor, "c 3"]
    """Width and height of the images, and the number of a cell, see `_cells`."""

    def admit(self, size: Int[Tensor, "2 2"], x1: Float[Tensor, "k 2"], x2: Float[Tensor, "k 2"]) -> Bool[Tensor, "k"]:
        """Which matches of two images of these sizes do not stand still at such a place."""
        kept = torch.ones(len(x1), dtype=torch.bool)
        if not len(self.cells) or not bool((size[0] == size[1]).all()):
            return kept
        own = self.cells[(self.cells[:, :2] == size[0]).all(-1), 2]
        still = (_moved(x1, x2) <= _STILL * scale_of_images(size[0])).nonzero()[:, 0]
        found = torch.isin(_cells(x1[still], size[0]), own).any(-1)
        return kept.index_copy(0, still, ~found)


NONE = Overlays(torch.zeros(0, 3, dtype=torch.long))


def find_overlays(
    image_size: Int[Tensor, "v 2"],
    x: Sequence[Float[Tensor, "_ 2"]],
    pairs: Int[Tensor, "q 2"],
    matches: Iterable[Matches],
    *,
    generator: torch.Generator | None = None,
) -> Overlays:
    """Find the places at which something stands still in images of which the rest moves.

    Args:
        image_size: Width and height in pixels.
        x: Image points per image, in pixels.
        pairs: Pairs of images.
        matches: Those of some pairs at a time, by the number of the pair.
        generator: Source of randomness.
    """
    scale = scale_of_images(image_size)
    asked: dict[int, tuple[Tensor, Tensor]] = {}
    moves, often = torch.zeros(len(x), dtype=torch.bool), torch.zeros(len(x), dtype=torch.long)
    alike = (image_size[pairs[:, 0]] == image_size[pairs[:, 1]]).all(-1).tolist()
    for some in matches:
        for q, match in some.items():
            if not alike[q] or len(match) < 2 * MIN_INLIERS:
                continue
            i, j = pairs[q].tolist()
            way = _moved(x[i][match[:, 0]], x[j][match[:, 1]]) / scale[i]
            still, moving = way <= _STILL, way >= _MOVING
            if int(moving.sum()) < 2 * MIN_INLIERS:
                continue
            moves[pairs[q]] = True
            if int(still.sum()) >= MIN_INLIERS and bool((often[pairs[q]] < _PAIRS).any()):
                asked[q] = match[still], match[moving]
                often[pairs[q]] += 1
    if not asked:
        return NONE
    chosen = sorted(asked)
    moving_ones = [asked[q][1] for q in chosen]
    verified = verify_pairs(image_size, x, pairs[chosen], moving_ones, threshold=_THRESHOLD, generator=generator)
    rows, images = [], []
    for k, q in enumerate(chosen):
        if int(verified.fundamental_inliers[k]) < MIN_INLIERS:
            continue
        (i, j), still = pairs[q].tolist(), asked[q][0]
        x1, x2 = x[i][still[:, 0]], x[j][still[:, 1]]
        off = sampson_distance(verified.F[k], x1, x2) > _OFF * _THRESHOLD * scale[i]
        if int(off.sum()) >= MIN_INLIERS:
            cells = _cells(torch.cat((x1[off], x2[off])), image_size[i])
            rows.append(torch.cat((image_size[i].expand(*cells.shape, 2), cells[..., None]), -1).flatten(0, 1))
            images.append(pairs[q].repeat_interleave(int(off.sum())).repeat_interleave(cells.shape[1]))
    if not rows:
        return NONE
    return Overlays(_common(torch.cat(rows), torch.cat(images), image_size[moves]))


def _common(rows: Int[Tensor, "r 3"], images: Int[Tensor, "r"], sizes: Int[Tensor, "a 2"]) -> Int[Tensor, "c 3"]:
    """The cells that enough of the images show, or that are around those."""
    once = torch.unique(torch.cat((rows, images[:, None]), 1), dim=0)
    cells, count = torch.unique(once[:, :3], dim=0, return_counts=True)
    kinds, number = torch.unique(sizes, dim=0, return_counts=True)
    of_size = ((cells[:, None, :2] == kinds).all(-1) * number).sum(-1)
    common = count >= torch.minimum((_SHARE * of_size).clamp(min=_IMAGES), of_size)
    likely = count >= of_size.clamp(max=_IMAGES)
    block, around = _blocks(cells)
    reached = torch.zeros_like(common)
    while not bool((common == reached).all()):
        reached = common
        common = common | likely & torch.isin(around, block[common]).any(-1)
    found: Tensor = cells[common]
    return found


def _blocks(cells: Int[Tensor, "c 3"]) -> tuple[Int[Tensor, "c"], Int[Tensor, "c 9"]]:
    """The block of `_BLOCK` by `_BLOCK` cells of a grid that each cell is in, see `_cells`, and those around with it."""
    size, number = cells[:, :2], cells[:, 2]
    columns, rows = ((size / (_CELL * _STILL * scale_of_images(size))[:, None]).long() + 3).unbind(-1)
    place = torch.stack([number // rows % columns, number % rows], -1) // _BLOCK + 1
    _, kind = torch.unique(size, dim=0, return_inverse=True)
    wide, high = (place.amax(0) + 2).tolist() if len(place) else (1, 1)
    step = torch.cartesian_prod(torch.arange(-1, 2), torch.arange(-1, 2))
    near = place[:, None] + step
    around = (kind[:, None] * wide + near[..., 0]) * high + near[..., 1]
    return around[:, 4], around


def _cells(x: Float[Tensor, "k 2"], size: Int[Tensor, "2"]) -> Int[Tensor, "k 4"]:
    """The numbers of the cells of places in four grids, each half a cell off the others: what is near shares one of them."""
    shift = torch.tensor([[0.0, 0.0], [0.0, 0.5], [0.5, 0.0], [0.5, 0.5]], dtype=x.dtype)
    width = _CELL * _STILL * scale_of_images(size)
    # Corners may be found a little beside the image.
    column, row = ((x[:, None] / width + shift).floor().long() + 1).clamp(min=0).unbind(-1)
    columns, rows = ((size / width).long() + 3).tolist()
    cells: Tensor = (torch.arange(4) * columns + column.clamp(max=columns - 1)) * rows + row.clamp(max=rows - 1)
    return cells


def _moved(x1: Tensor, x2: Tensor) -> Float[Tensor, "k"]:
    """By how many pixels points differ."""
    way: Tensor = torch.linalg.vector_norm(x2 - x1, dim=-1)
    return way
