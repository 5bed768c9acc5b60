"""Videos and other ordered images: which frames to compare, and corners followed from frame to frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.images import Features, read_image, retrieve_pairs, track_sequence
from torchsfm.reconstruction.matching.image_points import ImagePoints, nearest_colors
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.stages import Arrays
from torchsfm.reconstruction.messages import Progress, ReconstructionError

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


@dataclass(frozen=True)
class Corners:
    """Tracked corners, frame by frame."""

    x: tuple[Float[Tensor, "_ 2"], ...]
    color: tuple[Float[Tensor, "_ 3"], ...]
    track: tuple[Int[Tensor, "_"], ...]
    """No track is twice in a frame."""
    tracks: int

    @classmethod
    def of(cls, saved: Arrays, frames: int) -> "Corners":
        """From the tensors of `track_corners`."""
        counts = torch.bincount(saved["frame"], minlength=frames).tolist()
        x, color, track = (tuple(torch.split(saved[key], counts)) for key in ("x", "color", "track"))
        return cls(x, color, track, int(saved["track"].max()) + 1 if len(saved["track"]) else 0)

    def matches(self, i: int, j: int) -> Int[Tensor, "_ 2"]:
        """The corners that two frames share, as their numbers in each."""
        position = torch.full((self.tracks,), -1, dtype=torch.long)
        position[self.track[j]] = torch.arange(len(self.track[j]))
        found = position[self.track[i]]
        return torch.stack([torch.arange(len(found)), found], 1)[found >= 0]
