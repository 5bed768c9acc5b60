"""The main job: photographs in, cameras and points out."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.images import (
    Features,
    ImageError,
    Photograph,
    detect_features,
    list_images,
    match_features,
    read_image,
    retrieve_pairs,
    track_sequence,
)
from torchsfm.reconstruction.models import build_models
from torchsfm.reconstruction.report import ReconstructionError, SfmResult
from torchsfm.reconstruction.stages import Arrays, Stages, fingerprint
from torchsfm.reconstruction.view_graph import ViewGraph, graph_from_tracks, verify_pairs

Progress = Callable[[str, int, int], None]
"""Called with the stage, the number of items done and the number of all."""

MAX_IMAGES_ALL_PAIRS = 80
"""Up to this many images every pair is matched; beyond it, each image with those that look most alike."""


@dataclass(frozen=True)
class _Input:
    """The readable images: file names, sizes, what the files say of the camera."""

    names: tuple[str, ...]
    image_size: Int[Tensor, "v 2"]
    labels: tuple[str, ...]
    focal: tuple[float | None, ...]
    failures: dict[str, str]


def reconstruct(
    images: str | Path | Sequence[str | Path],
    *,
    sequence: bool = False,
    camera: str | None = None,
    shared_camera: bool | None = None,
    K: Float[Tensor, "3 3"] | None = None,
    free_principal_point: bool = True,
    max_features: int = 8192,
    neighbours: int = 20,
    seed: int = 0,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> SfmResult:
    """Reconstruct cameras and 3D points from photographs, with nothing known of the camera.

    The steps: SIFT features; matches between all pairs; epipolar geometry of all pairs in one batched call; focal length from
    Exif, else from the fundamental matrices, else a default; incremental structure from motion with bundle adjustment over
    poses, points, focal length and distortion. Images that have nothing in common form several models.

    Args:
        images: A folder, or image files.
        sequence: The images are consecutive frames of a video: corners are tracked instead of matching features of all pairs.
        camera: Distortion model: "pinhole", "simple_radial", "radial", "opencv" or "fisheye". By default "radial", or "pinhole"
            when `K` is given.
        shared_camera: Whether one camera took all images of the same size. By default it did where the files name the same
            camera and focal length, or name none.
        K: Known intrinsics of all images, in pixels; they are not adjusted.
        free_principal_point: Estimate the principal point too, of models of four images or more, expected within 1 % of the
            image's size from its centre, instead of holding it there.
        max_features: Features per image.
        neighbours: Images each one is matched with when there are many.
        seed: The same seed gives the same model.
        out: Folder in which finished stages are saved.
        resume: Use the stages that an earlier run with the same images and options saved there.
        progress: Called as the work goes on.

    Returns:
        The models, the largest first, and a report on every image and pair. World frames have arbitrary place, direction and
        scale.

    Raises:
        ReconstructionError: Wrong input: no such folder, fewer than two readable images, an unknown camera model.
        ValueError: An argument has the wrong shape.
    """
    if K is not None and K.shape != (3, 3):
        raise ValueError(f"K: wanted shape (3, 3), got {tuple(K.shape)}")
    report = progress or (lambda stage, done, total: None)
    files = _files(images)
    model = camera or ("pinhole" if K is not None else "radial")
    # What is saved depends on these alone; cameras and models are made from it each time.
    options = {"sequence": sequence, "features": max_features, "neighbours": neighbours}
    stages = Stages(None if out is None else Path(out), resume, fingerprint(files, options))
    generator = torch.Generator().manual_seed(seed)
    if sequence:
        found, graph, track = _tracked_graph(files, stages, report, generator)
    else:
        found, graph = _matched_graph(files, stages, report, generator, max_features=max_features, neighbours=neighbours)
        track = None
    return build_models(
        graph,
        track,
        labels=found.labels,
        exif_focal=found.focal,
        failures=found.failures,
        order=[path.name for path in files],
        camera=model,
        shared_camera=shared_camera,
        K=K,
        free_principal_point=free_principal_point,
        generator=generator,
        stages=stages,
        progress=report,
    )


def _files(images: str | Path | Sequence[str | Path]) -> list[Path]:
    try:
        files = list_images(images) if isinstance(images, str | Path) else [Path(path) for path in images]
    except ImageError as error:
        raise ReconstructionError(str(error)) from None
    if not files:
        raise ReconstructionError(f"{images}: no images in this folder")
    if len(files) == 1:
        raise ReconstructionError(f"{files[0]}: one image is not enough, two views are the least")
    if missing := [path for path in files if not path.is_file()]:
        raise ReconstructionError(f"{missing[0]}: no such file")
    return files


def _matched_graph(
    files: list[Path],
    stages: Stages,
    progress: Progress,
    generator: torch.Generator,
    *,
    max_features: int,
    neighbours: int,
) -> tuple[_Input, ViewGraph]:
    """Features of all images, matches of all pairs, verified."""

    def detect() -> Arrays:
        found: list[tuple[Photograph, Features, Tensor] | str] = []

        def work(path: Path) -> tuple[Photograph, Features, Tensor] | str:
            try:
                photo = read_image(path)
            except ImageError as error:
                return str(error)
            features = detect_features(photo, max_features)
            color = _colors(photo.pixels, features.x)
            # The pixels have served; only what the file says is kept.
            return replace(photo, pixels=torch.zeros(1, 1, 1)), features, color

        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            for result in pool.map(work, files):
                found.append(result)
                progress("features", len(found), len(files))
        return _pack(found)

    features_saved = stages.run("features", detect)
    found = _input(features_saved, files)
    counts = features_saved["count"].tolist()
    x = list(torch.split(features_saved["x"], counts))
    descriptors = list(torch.split(features_saved["descriptors"], counts))
    color = list(torch.split(features_saved["color"], counts))
    features = [
        Features(x=a, scale=a[:, 0], angle=a[:, 0], response=a[:, 0], descriptors=b)
        for a, b in zip(x, descriptors, strict=True)
    ]

    def match() -> Arrays:
        v = len(features)
        if v <= MAX_IMAGES_ALL_PAIRS:
            pairs = torch.tensor(list(combinations(range(v), 2)), dtype=torch.long).reshape(-1, 2)
        else:
            pairs = retrieve_pairs(features, neighbours=neighbours)
        rows: list[Tensor] = []
        for start in range(0, len(pairs), 8):
            rows += match_features(features, pairs[start : start + 8])
            progress("match", len(rows), len(pairs))
        return {
            "pairs": pairs,
            "count": torch.tensor([len(m) for m in rows], dtype=torch.long),
            "match": torch.cat(rows) if rows else torch.zeros(0, 2, dtype=torch.long),
        }

    matched = stages.run("match", match)
    matches = list(torch.split(matched["match"], matched["count"].tolist()))
    with stages.timed("verify"):
        progress("verify", 0, len(matches))
        graph = verify_pairs(
            found.names,
            found.image_size,
            [a.double() for a in x],
            [c.double() for c in color],
            matched["pairs"],
            matches,
            generator=generator,
        )
        progress("verify", len(matches), len(matches))
    return found, graph


def _pack(found: list[tuple[Photograph, Features, Tensor] | str]) -> Arrays:
    """One table of features of all readable images, and a record per file."""
    good = [entry for entry in found if not isinstance(entry, str)]
    records = [entry if isinstance(entry, str) else _label(entry[0]) for entry in found]
    text = "\0".join(records).encode()
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


def _input(saved: Arrays, files: list[Path]) -> _Input:
    records = bytes(saved["records"].numpy()).decode().split("\0")
    readable = saved["readable"].tolist()
    failures = {path.name: record for path, record, ok in zip(files, records, readable, strict=True) if not ok}
    if sum(readable) < 2:
        worst = next(iter(failures.values()))
        raise ReconstructionError(f"{sum(readable)} of {len(files)} files can be read as images; first failure: {worst}")
    return _Input(
        names=tuple(path.name for path, ok in zip(files, readable, strict=True) if ok),
        image_size=saved["size"],
        labels=tuple(record for record, ok in zip(records, readable, strict=True) if ok),
        focal=tuple(f or None for f in saved["focal"].tolist()),
        failures=failures,
    )


def _colors(pixels: Float[Tensor, "c h w"], x: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """Colours of the nearest pixels."""
    height, width = pixels.shape[-2:]
    column = x[:, 0].round().long().clamp(0, width - 1)
    row = x[:, 1].round().long().clamp(0, height - 1)
    return pixels[:, row, column].T.expand(-1, 3).float()


def _tracked_graph(
    files: list[Path], stages: Stages, progress: Progress, generator: torch.Generator
) -> tuple[_Input, ViewGraph, Int[Tensor, "n"]]:
    """Corners tracked through a sequence, with the pairs of frames they link verified."""

    def track() -> Arrays:
        photos: list[Photograph] = []
        found: list[tuple[Photograph, Features, Tensor] | str] = []
        empty = Features(torch.zeros(0, 2), *(torch.zeros(0),) * 3, torch.zeros(0, 128, dtype=torch.uint8))
        for path in files:
            try:
                photo = read_image(path)
            except ImageError as error:
                found.append(str(error))
                continue
            found.append((photo, empty, torch.zeros(0, 3)))
            photos.append(photo)
            progress("track", len(found), 2 * len(files))
        if len({photo.size for photo in photos}) > 1:
            raise ReconstructionError("the frames of a sequence must have one size")
        packed = _pack(found)
        if len(photos) < 2:
            return packed
        tracks = track_sequence([photo.pixels for photo in photos])
        order = torch.argsort(tracks.frame, stable=True)
        packed["frame"], packed["track"], packed["x"] = tracks.frame[order], tracks.track[order], tracks.x[order]
        packed["color"] = torch.cat(
            [_colors(photo.pixels, packed["x"][packed["frame"] == i]) for i, photo in enumerate(photos)]
        )
        progress("track", 2 * len(files), 2 * len(files))
        return packed

    saved = stages.run("track", track)
    found = _input(saved, files)
    with stages.timed("verify"):
        progress("verify", 0, 1)
        graph, tracks = graph_from_tracks(
            found.names,
            found.image_size,
            saved["x"].double(),
            saved["frame"],
            saved["track"],
            saved["color"].double(),
            generator=generator,
        )
        progress("verify", 1, 1)
    return found, graph, tracks
