"""What is fixed to the images and not to the scene: watermarks, dates, a part of the vehicle, the wall behind a turntable.

Its points match at the same place in all images, and may be so many that a camera seems not to have moved. One pair tells when
its other matches move, agree on an epipolar geometry, and what stands still contradicts that. Many images at the same place
make sure: a camera that rests for a while, before which something moves, has no such places in most of its images.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import sampson_distance
from torchsfm.reconstruction.matching.masks import Admission, Masks
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, ViewGraph, scale_of_images, verify_pairs

_STILL, _MOVING = 1.0, 5.0
"""Pixels, of images of 1600 pixels or less, by which what stands still differs from one image to another at most; and by which
what moves does at least."""
_OFF = 2.0
"""How far from its epipolar line, in thresholds of verification, a still point is one of another geometry."""
_THRESHOLD = 3.0
_PAIRS = 8
"""How many pairs of an image are asked, those with most that moves: all show the same, if they show anything."""
_ABOUT, _BESIDE = 2.0, 16.0
"""Pixels by which a point about where overlays are moves at most to be one of theirs, by noise; and as far as it reaches into
what points beside it look like."""
_ROWS = 1024
"""Image points whose distances are looked at together."""
_CELL = 4.0
"""The width of the cells of places, in distances of what stands still."""
_IMAGES, _SHARE = 3, 0.5
"""The fewest images, of three and more, and which part of those of one size that move, that show an overlay at a place."""
_BLOCK = 8
"""In or next to a block of so many cells that has a place of an overlay the fewest images are enough: what is behind a
watermark hides parts of it."""

Matches = Mapping[int, Int[Tensor, "_ 2"]]


def find_overlays(
    image_size: Int[Tensor, "v 2"],
    x: Sequence[Float[Tensor, "_ 2"]],
    pairs: Int[Tensor, "q 2"],
    matches: Callable[[], Iterable[Matches]],
    *,
    generator: torch.Generator | None = None,
) -> Bool[Tensor, "n"]:
    """Find the image points that are fixed to the images, of which the rest moves.

    They stand still, in some pair, at a place where many images have something that does. What they match elsewhere is wrong,
    or the same but for noise.

    Args:
        image_size: Width and height in pixels.
        x: Image points per image, in pixels.
        pairs: Pairs of images.
        matches: Goes through the matches of some pairs at a time, by the number of the pair; asked for once or twice.
        generator: Source of randomness.

    Returns:
        Which points of all images, one image after the other, are of an overlay.
    """
    offset = torch.tensor([0, *(len(points) for points in x)]).cumsum(0)
    fixed = torch.zeros(int(offset[-1]), dtype=torch.bool)
    cells = _places(image_size, x, pairs, matches(), generator)
    if not len(cells):
        return fixed
    for some in matches():
        for q, match in some.items():
            i, j = pairs[q].tolist()
            if bool((image_size[i] == image_size[j]).all()):
                shown = match[_shown(cells, image_size[i], x[i][match[:, 0]], x[j][match[:, 1]])]
                fixed[shown + offset[pairs[q]]] = True
    return fixed


def beside_overlays(
    image_size: Int[Tensor, "v 2"], x: Sequence[Float[Tensor, "_ 2"]], fixed: Bool[Tensor, "n"]
) -> Bool[Tensor, "n"]:
    """Which image points are so near to one that is fixed to the image that it changes what they look like."""
    beside = torch.zeros_like(fixed)
    end = 0
    for points, reach in zip(x, (_BESIDE * scale_of_images(image_size)).tolist(), strict=True):
        begin, end = end, end + len(points)
        beside[begin:end] = _beside(points, points[fixed[begin:end]], reach)
    return beside


@dataclass(frozen=True)
class WithoutOverlays:
    """Where photographs show the scene: where their masks admit it, and not beside what is fixed to the images."""

    fixed: dict[Path, Float[Tensor, "_ 2"]]
    """The image points of overlays in each photograph."""
    masks: Masks | None

    @classmethod
    def of(cls, files: Sequence[Path], graph: ViewGraph, masks: Masks | None) -> "Admission | None":
        """Of the photographs that a view graph is of; the masks alone where there are no overlays."""
        if graph.fixed is None:
            return masks
        own = [graph.fixed & (graph.view == i) for i in range(len(files))]
        return cls({file: graph.x[points] for file, points in zip(files, own, strict=True)}, masks)

    def admit(self, file: Path, x: Float[Tensor, "*n 2"], size: tuple[int, int]) -> Bool[Tensor, "*n"]:
        """Which places of a photograph of this width and height count.

        Raises:
            ImageError: Its mask cannot be read, or has another shape.
        """
        reach = _BESIDE * float(scale_of_images(torch.tensor(size)))
        free = ~_beside(x.flatten(0, -2).double(), self.fixed[file], reach).view(x.shape[:-1])
        return free if self.masks is None else free & self.masks.admit(file, x, size)


def _beside(x: Float[Tensor, "n 2"], fixed: Float[Tensor, "m 2"], reach: float) -> Bool[Tensor, "n"]:
    """Which places are nearer than this to one that is fixed."""
    near = torch.zeros(len(x), dtype=torch.bool)
    for row in range(0, len(x) if len(fixed) else 0, _ROWS):
        near[row : row + _ROWS] = (torch.cdist(x[row : row + _ROWS], fixed) < reach).any(-1)
    return near


def _shown(
    cells: Int[Tensor, "c 3"], size: Int[Tensor, "2"], x1: Float[Tensor, "k 2"], x2: Float[Tensor, "k 2"]
) -> Bool[Tensor, "k"]:
    """Which matches of two images of this size stand still about where overlays are."""
    own = cells[(cells[:, :2] == size).all(-1)]
    still = _moved(x1, x2) <= _ABOUT * scale_of_images(size)
    rows = still.nonzero()[:, 0]
    here = torch.cat([size.expand(len(rows), 2), _cells(x1[rows], size)[:, :1]], 1)
    block = _blocks(torch.cat((own, here)))[0]
    return still.index_copy(0, rows, torch.isin(block[len(own) :], block[: len(own)]))


def _places(
    image_size: Int[Tensor, "v 2"],
    x: Sequence[Float[Tensor, "_ 2"]],
    pairs: Int[Tensor, "q 2"],
    matches: Iterable[Matches],
    generator: torch.Generator | None,
) -> Int[Tensor, "c 3"]:
    """Where something stands still in images of which the rest moves: their width and height, and the number of a cell."""
    scale = scale_of_images(image_size)
    asked: dict[int, tuple[Tensor, Tensor]] = {}
    moves = torch.zeros(len(x), dtype=torch.bool)
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
            if int(still.sum()) >= MIN_INLIERS:
                asked[q] = match[still], match[moving]
        asked = _most_telling(pairs, asked)
    if not asked:
        return pairs.new_zeros(0, 3)
    chosen = sorted(asked)
    moving_ones = [asked[q][1] for q in chosen]
    verified = verify_pairs(image_size, x, pairs[chosen], moving_ones, threshold=_THRESHOLD, generator=generator)
    rows, images = [], []
    for k, q in enumerate(chosen):
        if int(verified.fundamental_inliers[k]) < MIN_INLIERS:
            continue
        (i, j), still = pairs[q].tolist(), asked[q][0]
        x1, x2 = x[i][still[:, 0]], x[j][still[:, 1]]
        if int((sampson_distance(verified.F[k], x1, x2) > _OFF * _THRESHOLD * scale[i]).sum()) >= MIN_INLIERS:
            # Also what fits by chance, as all does next to the axis of a small turn; in the scene that is at other places.
            cells = _cells(torch.cat((x1, x2)), image_size[i])
            rows.append(torch.cat((image_size[i].expand(*cells.shape, 2), cells[..., None]), -1).flatten(0, 1))
            images.append(pairs[q].repeat_interleave(len(still)).repeat_interleave(cells.shape[1]))
    if not rows:
        return pairs.new_zeros(0, 3)
    return _common(torch.cat(rows), torch.cat(images), image_size[moves])


def _most_telling(pairs: Int[Tensor, "q 2"], asked: Mapping[int, tuple[Tensor, Tensor]]) -> dict[int, tuple[Tensor, Tensor]]:
    """Of pairs, with what stands still and what moves in them, those that are among the first of one of their images.

    Where most of what matches stands still, as behind a turntable, the rest tells a geometry only in the few pairs that show
    the same side of what turns: elsewhere it is wrong.
    """
    kept, often = dict[int, tuple[Tensor, Tensor]](), dict[int, int]()
    for q in sorted(asked, key=lambda q: (-len(asked[q][1]), q)):
        images = pairs[q].tolist()
        if any(often.get(i, 0) < _PAIRS for i in images):
            kept[q] = asked[q]
            often |= {i: often.get(i, 0) + 1 for i in images}
    return kept


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
