"""Masks of photographs: where to look for nothing."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.images import SUFFIXES, ImageError, read_image
from torchsfm.reconstruction.matching.sources import Sources
from torchsfm.reconstruction.messages import ReconstructionError

_LABEL = 1.5 / 255
"""What is darker even where it is brightest holds labels."""


@runtime_checkable
class Admission(Protocol):
    """Says which places of photographs count."""

    def admit(self, file: Path, x: Float[Tensor, "*n 2"], size: tuple[int, int]) -> Bool[Tensor, "*n"]:
        """Which places of a photograph of this width and height count."""
        ...


@dataclass(frozen=True)
class Masks:
    """Pictures in a folder whose black parts (below half of white) are those of photographs that do not count.

    The mask of `view.jpg` is `view.jpg.png`, `view.png`, `view.jpg` or a picture of another kind, the first that is there, of
    the same shape as the upright photograph; a photograph that has none counts as a whole. Masks of photographs in subfolders
    lie in subfolders of the same names. Where the values are 0 and 1 alone, of 255 or 65,535, as labels are, 1 is white.
    """

    folder: Path
    photographs: Path
    """The folder of the photographs."""

    @classmethod
    def of(cls, folder: str | Path, sources: Sources) -> "Masks":
        """Those of some photographs.

        Raises:
            ReconstructionError: There is none for any of them.
        """
        masks = cls(Path(folder), sources.folder)
        if not any(map(masks.path, sources.files)):
            name = sources.names[0]
            raise ReconstructionError(f"{folder}: no mask for any image; that of {name} would be {name}.png")
        return masks

    def path(self, file: Path) -> Path | None:
        """The mask of a photograph; None where there is none."""
        kinds = [name + kind for name in (file.name, file.stem) for kind in sorted(SUFFIXES)]
        names = (f"{file.name}.png", f"{file.stem}.png", file.name, *kinds)
        place = self.folder / os.path.relpath(file.parent, self.photographs)
        return next((place / name for name in names if (place / name).is_file()), None)

    def admit(self, file: Path, x: Float[Tensor, "*n 2"], size: tuple[int, int]) -> Bool[Tensor, "*n"]:
        """Which places of a photograph of this width and height count.

        Raises:
            ImageError: The mask cannot be read, or has another shape than the photograph.
        """
        path = self.path(file)
        if path is None:
            return torch.ones(x.shape[:-1], dtype=torch.bool)
        mask = read_image(path, gray=True)
        (width, height), wanted = (mask.width, mask.height), size
        if abs(width * wanted[1] - height * wanted[0]) >= max(wanted):
            raise ImageError(f"{path}: a mask of {width} x {height} pixels for an image of {wanted[0]} x {wanted[1]}")
        zoom = torch.tensor([width / wanted[0], height / wanted[1]], dtype=x.dtype)
        column, row = ((x + 0.5) * zoom - 0.5).round().long().unbind(-1)
        white = float(mask.pixels.max())
        level = 0.5 * white if 0 < white < _LABEL else 0.5
        admitted: Tensor = mask.pixels[0, row.clamp(0, height - 1), column.clamp(0, width - 1)] >= level
        return admitted
