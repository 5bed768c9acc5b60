"""Frames of a sequence: their edges, where what one shows is in the next, and how cameras turn by that."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.images import DenseMotion, detect_motion, read_image
from torchsfm.motion import estimate_essential
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.matching.stages import Arrays
from torchsfm.reconstruction.messages import Progress
from torchsfm.tensors import pose_from_essential

_PLACES = 600
"""Of edges, the most."""
_FEWEST = 50
"""The fewest that tell a rotation."""
_NEAR = 2.0
"""Pixels from an epipolar line, within which a place agrees."""


def detect_all_motion(files: Sequence[Path], max_pixels: int, progress: Progress, *, longest: int) -> Arrays:
    """Where what each file shows is in the next one, as tensors to save."""

    def photographs() -> Iterator[Tensor]:
        for k, file in enumerate(files):
            yield read_image(file, max_size=longest, max_pixels=max_pixels).pixels
            progress("motion", k + 1, len(files))

    found = detect_motion(photographs())
    # Tenths of pixels will do.
    return {"shift": torch.stack([m.shift.half() for m in found]), "sure": torch.stack([m.sure for m in found])}


def as_motion(arrays: Arrays) -> list[DenseMotion]:
    """From saved tensors."""
    return [DenseMotion(shift, sure) for shift, sure in zip(arrays["shift"], arrays["sure"], strict=True)]


class Turn(NamedTuple):
    """How a camera turns to the next."""

    R: Float[Tensor, "3 3"]
    E: Float[Tensor, "3 3"]
    """The essential matrix that this is from."""


class Frames(NamedTuple):
    """The frames of a sequence."""

    edges: Sequence[ImageEdges]
    motion: Sequence[DenseMotion] = ()
    """Where what each shows is in the next one; empty if that was not looked for."""
    turns: Sequence[Turn | None] = ()
    """From one camera to the next by that, None where it does not tell."""

    def seen_with(self, K: Float[Tensor, "3 3"]) -> "Frames":
        """With the rotations that a calibration gives."""
        return self._replace(turns=turns_between(self.edges, self.motion, K))

    def starts(self, views: Int[Tensor, "w"]) -> Float[Tensor, "1 w 3 3"] | None:
        """Rotations of a few cameras; None where those from one to the next are not known."""
        turns = [None if not self.turns else self.turns[i] for i in views[:-1].tolist()]
        R = [torch.eye(3, dtype=torch.float64)]
        for turn in turns:
            if turn is None:
                return None
            R.append(turn.R @ R[-1])
        return torch.stack(R)[None]


def turns_between(edges: Sequence[ImageEdges], motion: Sequence[DenseMotion], K: Float[Tensor, "3 3"]) -> list[Turn | None]:
    """What tells how each camera turns to the next; None where too little does.

    They are where to begin, no more: one plane has two, and the focal length is not known yet.

    Args:
        edges: Of each frame.
        motion: From each frame to the next.
        K: Calibration to expect.
    """
    turns: list[Turn | None] = []
    for own, step in zip(edges, motion, strict=False):
        x, y = moved_places(own, step)
        if len(x) < _FEWEST:
            turns.append(None)
            continue
        d1, d2 = rays_of(x, K), rays_of(y, K)
        found = estimate_essential(d1, d2, threshold=_NEAR / float(K[0, 0]), generator=torch.Generator().manual_seed(0))
        R = pose_from_essential(found.model, d1, d2, found.inliers).pose.R
        enough = int(found.inliers.sum()) >= _FEWEST and bool(R.isfinite().all())
        turns.append(Turn(R, found.model) if enough else None)
    return turns


def moved_places(edges: ImageEdges, motion: DenseMotion) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Some places at edges of a frame, and where they are in the next one, as far as that is sure."""
    x = edges.x.double()
    y, sure = motion.moved(x)
    some = sure.nonzero()[:, 0]
    some = some[:: max(1, len(some) // _PLACES)]
    return x[some], y[some]


def rays_of(x: Float[Tensor, "n 2"], K: Float[Tensor, "3 3"]) -> Float[Tensor, "n 3"]:
    """Rays of pixels, the lens taken for one without distortion."""
    d = (x - K[:2, 2]) / K[0, 0]
    return torch.cat((d, torch.ones_like(d[:, :1])), -1)
