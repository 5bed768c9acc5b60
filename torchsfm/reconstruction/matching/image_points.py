"""The image points of all photographs: read each file, detect features, keep what the later stages need."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import overload

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.images import Features, ImageError, Photograph, detect_features, read_image
from torchsfm.images.bars import picture_in_bars
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.stages import Arrays, Shards, Stages
from torchsfm.reconstruction.messages import Progress, ReconstructionError

Found = tuple[Photograph, Features, Tensor, Tensor]
SHARDS, MOST_IMAGES = 64, 64
"""The photographs are divided into about so many shards, but none of more images than this."""
DETECTION_SIZE = 2400
"""Larger photographs are read and searched at this longer side; positions are those of the whole image."""
ENOUGH = 1024
"""Images with fewer features are given weaker ones too, up to so many."""


@dataclass(frozen=True)
class ImagePoints:
    """The readable images, what their files say of the camera, and the features of each."""

    files: tuple[Path, ...]
    names: tuple[str, ...]
    image_size: Int[Tensor, "v 2"]
    labels: tuple[str, ...]
    """What tells the camera of one from that of another: their folder, maker, model and focal length."""
    focal: tuple[float | None, ...]
    failures: dict[str, str]
    """Why the other files could not be read, by name."""
    x: tuple[Float[Tensor, "_ 2"], ...]
    """Where the features of each are, pixels."""
    color: tuple[Float[Tensor, "_ 3"], ...]
    weak: tuple[Bool[Tensor, "_"], ...]
    """Which of these are no more than what an image of few features has."""
    features: "SavedFeatures"
    """Their descriptors, read when they are asked for."""


@dataclass(frozen=True)
class SavedFeatures(Sequence[Features]):
    """The features of readable images; scale, angle and response are not kept."""

    shards: Shards
    place: tuple[tuple[int, int], ...]
    """The shard of each image, and its number there."""
    x: tuple[Tensor, ...]

    def __len__(self) -> int:
        return len(self.place)

    @overload
    def __getitem__(self, number: int) -> Features: ...
    @overload
    def __getitem__(self, number: slice) -> list[Features]: ...
    def __getitem__(self, number: int | slice) -> Features | list[Features]:
        if isinstance(number, slice):
            return [self[k] for k in range(len(self))[number]]
        shard, k = self.place[number]
        name, x = f"descriptors-{k}", self.x[number]
        return Features(x=x, scale=x[:, 0], angle=x[:, 0], response=x[:, 0], descriptors=self.shards.only(shard, name)[name])


def detect_all(
    files: Sequence[Path],
    names: Sequence[str],
    stages: Stages,
    max_features: int,
    max_pixels: int,
    progress: Progress,
    masks: Masks | None = None,
    least: int = 2,
) -> ImagePoints:
    """Features of all files, those that masks admit.

    Args:
        files: The photographs.
        names: By what to know them.
        stages: Where to save.
        max_features: Most features of an image.
        max_pixels: Larger images are left out.
        progress: Called as the work goes on.
        masks: Where nothing is to be found.
        least: How many files must be images.

    Raises:
        ReconstructionError: Fewer files could be read.
    """
    size = min(max(math.ceil(len(files) / SHARDS), 1), MOST_IMAGES)
    done = [0]
    counting = Lock()

    def work(path: Path) -> Found | str:
        try:
            photo = read_image(path, max_size=DETECTION_SIZE, max_pixels=max_pixels)
        except ImageError as error:
            return str(error)
        rows, columns = picture_in_bars(photo.pixels)
        inside = photo.pixels[:, rows, columns]
        features = detect_features(inside, max_features, max_size=DETECTION_SIZE)
        strong = len(features)
        if strong < ENOUGH:
            features = detect_features(inside, max_features, enough=ENOUGH, max_size=DETECTION_SIZE)
        features = replace(features, x=features.x + torch.tensor([columns.start, rows.start], dtype=features.x.dtype))
        weak = torch.arange(len(features)) >= strong
        zoom = torch.tensor([photo.size[0] / photo.width, photo.size[1] / photo.height])
        if masks is not None:
            try:
                admitted = masks.admit(path, (features.x + 0.5) * zoom - 0.5, photo.size)
            except ImageError as error:
                return str(error)
            features, weak = tensor_map(lambda rows: rows[admitted], features), weak[admitted]
        color = nearest_colors(photo.pixels, features.x)
        focal = None if photo.focal is None else photo.focal * max(photo.size) / max(photo.width, photo.height)
        # The pixels have served; only what the file says of the whole image is kept.
        whole = replace(photo, pixels=torch.zeros(1, 1, 1), focal=focal)
        return whole, replace(features, x=(features.x + 0.5) * zoom - 0.5), color, weak

    def shard(number: int) -> Arrays:
        found = []
        for path in files[size * number : size * (number + 1)]:
            found.append(work(path))
            with counting:
                done[0] += 1
                progress("features", done[0], len(files))
        return _pack(found)

    count = math.ceil(len(files) / size)
    return _unpack(stages.shards("features", count, shard, threads=max(1, torch.get_num_threads())), files, names, least)


def nearest_colors(pixels: Float[Tensor, "c h w"], x: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """Colours of the nearest pixels."""
    height, width = pixels.shape[-2:]
    column = x[:, 0].round().long().clamp(0, width - 1)
    row = x[:, 1].round().long().clamp(0, height - 1)
    return pixels[:, row, column].T.expand(-1, 3).float()


def _pack(found: list[Found | str]) -> Arrays:
    """The features of the readable images of a shard, one after the other, and a record per file."""
    good = [entry for entry in found if not isinstance(entry, str)]
    records = [entry if isinstance(entry, str) else _label(entry[0]) for entry in found]
    text = "\0".join(records).encode("utf-8", "surrogateescape")
    return {
        "readable": torch.tensor([not isinstance(entry, str) for entry in found]),
        "records": torch.frombuffer(bytearray(text or b"\0"), dtype=torch.uint8),
        "focal": torch.tensor([photo.focal or 0.0 for photo, _, _, _ in good], dtype=torch.float64),
        "size": torch.tensor([photo.size for photo, _, _, _ in good], dtype=torch.long).reshape(-1, 2),
        "count": torch.tensor([len(features) for _, features, _, _ in good], dtype=torch.long),
        "x": torch.cat([features.x for _, features, _, _ in good]) if good else torch.zeros(0, 2),
        "color": torch.cat([color for _, _, color, _ in good]) if good else torch.zeros(0, 3),
        "weak": torch.cat([weak for _, _, _, weak in good]) if good else torch.zeros(0, dtype=torch.bool),
        # Each by itself, so that one can be read without the others.
        **{f"descriptors-{k}": features.descriptors for k, (_, features, _, _) in enumerate(good)},
    }


def _label(photo: Photograph) -> str:
    """What tells one camera from another in the files."""
    focal = "" if photo.focal is None else f"{photo.focal / max(photo.size):.3f}"
    return "|".join([photo.make, photo.model, focal]).replace("\0", "")


def camera_label(name: str, record: str) -> str:
    """What tells the camera of a file from others: its folder, and what the file says of it."""
    return f"{PurePosixPath(name).parent}|{record}"


def _unpack(shards: Shards, files: Sequence[Path], names: Sequence[str], least: int) -> ImagePoints:
    """What shards say of files to be known under these names.

    Raises:
        ReconstructionError: Fewer files could be read than there must be.
    """
    parts = [shards.only(k, "readable", "records", "focal", "size", "count", "x", "color", "weak") for k in range(len(shards))]
    records = [r for part in parts for r in bytes(part["records"].numpy()).decode("utf-8", "surrogateescape").split("\0")]
    readable = [bool(ok) for part in parts for ok in part["readable"]]
    failures = {name: record for name, record, ok in zip(names, records, readable, strict=True) if not ok}
    if sum(readable) < least:
        worst = next(iter(failures.values()))
        raise ReconstructionError(f"{sum(readable)} of {len(files)} files can be read as images; first failure: {worst}")
    x, color, weak = (
        tuple(rows for part in parts for rows in torch.split(part[key], part["count"].tolist()))
        for key in ("x", "color", "weak")
    )
    place = tuple((k, i) for k, part in enumerate(parts) for i in range(len(part["count"])))
    return ImagePoints(
        files=tuple(path for path, ok in zip(files, readable, strict=True) if ok),
        names=tuple(name for name, ok in zip(names, readable, strict=True) if ok),
        image_size=torch.cat([part["size"] for part in parts]),
        labels=tuple(camera_label(name, record) for name, record, ok in zip(names, records, readable, strict=True) if ok),
        focal=tuple(f or None for part in parts for f in part["focal"].tolist()),
        failures=failures,
        x=x,
        color=color,
        weak=weak,
        features=SavedFeatures(shards, place, x),
    )
