"""Videos and other ordered images: which frames to compare, and corners followed from frame to frame."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.images import Features, read_image, retrieve_pairs, track_sequence
from torchsfm.reconstruction.image_points import ImagePoints, nearest_colors
from torchsfm.reconstruction.masks import Masks
from torchsfm.reconstruction.report import Progress, ReconstructionError
from torchsfm.reconstruction.stages import Arrays

WINDOW = 6
"""Each frame is compared with this many that follow it, and with those twice, four times, ... as far away."""
LOOPS = 4
"""And with this many that look most alike, wherever they are: where the camera comes back, the loop is closed."""


def sequence_pairs(features: Sequence[Features]) -> Int[Tensor, "p 2"]:
    """Pairs of frames worth comparing, the earlier first, sorted."""
    v = len(features)
    offsets = list(range(1, WINDOW + 1))
    while 2 * offsets[-1] < v:
        offsets.append(2 * offsets[-1])
    near = [(i, i + k) for i in range(v) for k in offsets if i + k < v]
    alike = retrieve_pairs(features, neighbours=LOOPS)
    pairs: Tensor = torch.unique(torch.cat([torch.tensor(near, dtype=torch.long), alike]), dim=0)
    return pairs


def track_corners(points: ImagePoints, max_pixels: int, progress: Progress, masks: Masks | None = None) -> Arrays:
    """Corners followed through all frames, where masks admit them: tensors `frame`, `track`, `x`, `color`, sorted by frame.

    Raises:
        ReconstructionError: The frames differ in size.
    """
    if len(torch.unique(points.image_size, dim=0)) > 1:
        raise ReconstructionError("the frames of a sequence must have one size")
    v = len(points.files)
    tracks = track_sequence(_pixels(points.files, max_pixels), progress=lambda done: progress("track", done, v))
    order = torch.argsort(tracks.frame, stable=True)
    if masks is not None:
        size: list[tuple[int, int]] = [(width, height) for width, height in points.image_size.tolist()]
        parts = torch.split(order, torch.bincount(tracks.frame, minlength=v).tolist())
        rows = zip(points.files, parts, size, strict=True)
        order = torch.cat([part[masks.admit(path, tracks.x[part], shape)] for path, part, shape in rows])
    frame, x = tracks.frame[order], tracks.x[order]
    counts = torch.bincount(frame, minlength=v).tolist()
    colors = [
        nearest_colors(p, part) for p, part in zip(_pixels(points.files, max_pixels), torch.split(x, counts), strict=True)
    ]
    return {"frame": frame, "track": tracks.track[order], "x": x, "color": torch.cat(colors)}


def _pixels(files: Sequence[Path], max_pixels: int) -> Iterator[Float[Tensor, "c h w"]]:
    """One frame after the other, so that a long video need not fit into memory."""
    for path in files:
        yield read_image(path, max_pixels=max_pixels).pixels


def add_corners(
    x: list[Float[Tensor, "_ 2"]],
    color: list[Float[Tensor, "_ 3"]],
    pairs: Int[Tensor, "p 2"],
    matches: list[Int[Tensor, "_ 2"]],
    corners: Arrays,
) -> None:
    """Append tracked corners to the image points, and to the matches of every pair of frames they link, in place."""
    frame, track = corners["frame"], corners["track"]
    counts = torch.bincount(frame, minlength=len(x))
    # Row of each track in each frame's table; a follower sees a track at most once per frame.
    local = torch.arange(len(frame)) - (counts.cumsum(0) - counts)[frame] + torch.tensor([len(p) for p in x])[frame]
    tables = list(zip(torch.split(track, counts.tolist()), torch.split(local, counts.tolist()), strict=True))
    for q, (i, j) in enumerate(pairs.tolist()):
        (track1, row1), (track2, row2) = tables[i], tables[j]
        position = torch.full((int(track.max()) + 1 if len(track) else 0,), -1, dtype=torch.long)
        position[track2] = row2
        both = position[track1] >= 0
        matches[q] = torch.cat([matches[q], torch.stack([row1[both], position[track1[both]]], 1)])
    parts = zip(torch.split(corners["x"], counts.tolist()), torch.split(corners["color"], counts.tolist()), strict=True)
    for i, (own_x, own_color) in enumerate(parts):
        x[i], color[i] = torch.cat([x[i], own_x]), torch.cat([color[i], own_color])
