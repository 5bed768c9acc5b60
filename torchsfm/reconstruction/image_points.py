"""The image points of all photographs: read each file, detect features, keep what the later stages need."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.images import Features, ImageError, Photograph, detect_features, read_image
from torchsfm.reconstruction.masks import Masks
from torchsfm.reconstruction.report import Progress, ReconstructionError
from torchsfm.reconstruction.stages import Arrays

Found = tuple[Photograph, Features, Tensor]
DETECTION_SIZE = 2400
"""Larger photographs are read and searched at this longer side; positions are those of the whole image."""


@dataclass(frozen=True)
class ImagePoints:
    """The readable images, what their files say of the camera, and the features of each."""

    files: tuple[Path, ...]
    names: tuple[str, ...]
    image_size: Int[Tensor, "v 2"]
    labels: tuple[str, ...]
    focal: tuple[float | None, ...]
    failures: dict[str, str]
    """Why the other files could not be read, by name."""
    features: tuple[Features, ...]
    color: tuple[Tensor, ...]


def image_names(files: Sequence[Path]) -> list[str]:
    """A name for each file, no two the same: without its folder, or where that is not enough from the common folder on.

    Raises:
        ReconstructionError: A file is given twice.
    """
    names = [path.name for path in files]
    if len(set(names)) < len(names):
        full = [os.path.abspath(path) for path in files]
        if len(set(full)) < len(full):
            twice = next(path for i, path in enumerate(full) if path in full[:i])
            raise ReconstructionError(f"{twice}: given twice")
        names = [os.path.relpath(path, os.path.commonpath(full)) for path in full]
    return names


def detect_all(
    files: Sequence[Path], max_features: int, max_pixels: int, progress: Progress, masks: Masks | None = None
) -> Arrays:
    """Features of all files, those that masks admit, as tensors to save; `unpack` reads them."""

    def work(path: Path) -> Found | str:
        try:
            photo = read_image(path, max_size=DETECTION_SIZE, max_pixels=max_pixels)
        except ImageError as error:
            return str(error)
        features = detect_features(photo, max_features, max_size=DETECTION_SIZE)
        zoom = torch.tensor([photo.size[0] / photo.width, photo.size[1] / photo.height])
        if masks is not None:
            try:
                admitted = masks.admit(path, (features.x + 0.5) * zoom - 0.5, photo.size)
            except ImageError as error:
                return str(error)
            features = tensor_map(lambda rows: rows[admitted], features)
        color = nearest_colors(photo.pixels, features.x)
        focal = None if photo.focal is None else photo.focal * max(photo.size) / max(photo.width, photo.height)
        # The pixels have served; only what the file says of the whole image is kept.
        whole = replace(photo, pixels=torch.zeros(1, 1, 1), focal=focal)
        return whole, replace(features, x=(features.x + 0.5) * zoom - 0.5), color

    found: list[Found | str] = []
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        for result in pool.map(work, files):
            found.append(result)
            progress("features", len(found), len(files))
    return _pack(found)


def nearest_colors(pixels: Float[Tensor, "c h w"], x: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """Colours of the nearest pixels."""
    height, width = pixels.shape[-2:]
    column = x[:, 0].round().long().clamp(0, width - 1)
    row = x[:, 1].round().long().clamp(0, height - 1)
    return pixels[:, row, column].T.expand(-1, 3).float()


def _pack(found: list[Found | str]) -> Arrays:
    """One table of features of all readable images, and a record per file."""
    good = [entry for entry in found if not isinstance(entry, str)]
    records = [entry if isinstance(entry, str) else _label(entry[0]) for entry in found]
    text = "\0".join(records).encode("utf-8", "surrogateescape")
    return {
        "readable": torch.tensor([not isinstance(entry, str) for entry in found]),
        "records": torch.frombuffer(bytearray(text or b"\0"), dtype=torch.uint8),
        "focal": torch.tensor([photo.focal or 0.0 for photo, _, _ in good], dtype=torch.float64),
        "size": torch.tensor([photo.size for photo, _, _ in good], dtype=torch.long).reshape(-1, 2),
        "count": torch.tensor([len(features) for _, features, _ in good], dtype=torch.long),
        "x": torch.cat([features.x for _, features, _ in good]) if good else torch.zeros(0, 2),
        "descriptors": torch.cat([f.descriptors for _, f, _ in good]) if good else torch.zeros(0, 128, dtype=torch.uint8),
        "color": torch.cat([color for _, _, color in good]) if good else torch.zeros(0, 3),
    }


def _label(photo: Photograph) -> str:
    """What tells one camera from another in the files."""
    focal = "" if photo.focal is None else f"{photo.focal / max(photo.size):.3f}"
    return "|".join([photo.make, photo.model, focal]).replace("\0", "")


def unpack(saved: Arrays, files: Sequence[Path], names: Sequence[str]) -> ImagePoints:
    """What `detect_all` found in files to be known under these names.

    Raises:
        ReconstructionError: Fewer than two files could be read.
    """
    records = bytes(saved["records"].numpy()).decode("utf-8", "surrogateescape").split("\0")
    readable = saved["readable"].tolist()
    failures = {name: record for name, record, ok in zip(names, records, readable, strict=True) if not ok}
    if sum(readable) < 2:
        worst = next(iter(failures.values()))
        raise ReconstructionError(f"{sum(readable)} of {len(files)} files can be read as images; first failure: {worst}")
    counts = saved["count"].tolist()
    x, descriptors, color = (torch.split(saved[key], counts) for key in ("x", "descriptors", "color"))
    return ImagePoints(
        files=tuple(path for path, ok in zip(files, readable, strict=True) if ok),
        names=tuple(name for name, ok in zip(names, readable, strict=True) if ok),
        image_size=saved["size"],
        labels=tuple(record for record, ok in zip(records, readable, strict=True) if ok),
        focal=tuple(f or None for f in saved["focal"].tolist()),
        failures=failures,
        # Scale, angle and response are not needed any more.
        features=tuple(
            Features(x=a, scale=a[:, 0], angle=a[:, 0], response=a[:, 0], descriptors=b)
            for a, b in zip(x, descriptors, strict=True)
        ),
        color=tuple(color),
    )
