"""The line segments of all photographs, with what is beside them."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.images import ImageError, describe_segments, detect_segments, read_image
from torchsfm.reconstruction.matching.image_points import DETECTION_SIZE, nearest_colors
from torchsfm.reconstruction.matching.masks import Admission
from torchsfm.reconstruction.matching.stages import Arrays
from torchsfm.reconstruction.messages import Progress

MAX_SEGMENTS = 2000
"""Segments of an image, the longest ones."""
SHORTEST = 0.013
"""Length of the shortest segments, over the longer side of the image."""
EDGE = 0.3
"""Standard deviation, pixels, with which the edges that views show of one line differ: of rounded corners, shadows, paint."""


def detect_all_segments(files: Sequence[Path], max_pixels: int, progress: Progress, masks: Admission | None = None) -> Arrays:
    """Segments of all files as tensors to save, those of a file after those of the one before; none of what cannot be read.

    Where not all places of photographs count, those whose ends and middle do.
    """

    def work(path: Path) -> dict[str, Tensor]:
        try:
            photo = read_image(path, max_size=DETECTION_SIZE, max_pixels=max_pixels)
        except ImageError:
            return {}
        found = detect_segments(photo.pixels, MAX_SEGMENTS, min_length=SHORTEST * max(photo.width, photo.height))
        zoom = torch.tensor([photo.size[0] / photo.width, photo.size[1] / photo.height])
        valid = found.valid
        if masks is not None:
            places = torch.cat([found.ends, found.ends.mean(1, keepdim=True)], 1)
            valid = valid & masks.admit(path, (places + 0.5) * zoom - 0.5, photo.size).all(-1)
        ends = found.ends[valid]
        variance = zoom.max() ** 2 * (2 * found.sigma.square() / found.independent.clamp_min(1))[valid] + EDGE**2
        return {
            "ends": (ends + 0.5) * zoom - 0.5,
            "weight": 1 / variance,
            "color": _mean_colors(photo.pixels, ends),
            "descriptor": describe_segments(photo.pixels, ends),
        }

    found: list[dict[str, Tensor]] = []
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        for result in pool.map(work, files):
            found.append(result)
            progress("segments", len(found), len(files))
    empty = {
        "ends": torch.zeros(0, 2, 2),
        "weight": torch.zeros(0),
        "color": torch.zeros(0, 3),
        "descriptor": torch.zeros(0, 84),
    }
    joined = {key: torch.cat([none, *(f[key] for f in found if f)]) for key, none in empty.items()}
    return joined | {"count": torch.tensor([len(f["ends"]) if f else 0 for f in found], dtype=torch.long)}


def _mean_colors(pixels: Float[Tensor, "c h w"], ends: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n 3"]:
    """Mean colours along segments."""
    share = torch.linspace(0, 1, 9)[:, None, None]
    places = (1 - share) * ends[:, 0] + share * ends[:, 1]
    return nearest_colors(pixels, places.flatten(0, 1)).reshape(9, -1, 3).mean(0)
