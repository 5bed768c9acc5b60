"""COLMAP's text files: one entry a line (two lines for an image), words between spaces, comments behind `#`."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from torchsfm.formats.colmap_model import (
    PARAMETERS,
    STILL,
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    Motion,
    motion,
)

Entry = TypeVar("Entry")
CAMERA = "CAMERA"


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read cameras.txt."""

    def camera(words: list[str]) -> tuple[int, ColmapCamera]:
        camera_id, model, width, height, *rest = words
        if model not in PARAMETERS:
            raise ValueError(f"camera {camera_id} is of the model {model!r}, which is unknown")
        count = PARAMETERS[model].size
        if len(rest) != count:
            raise ValueError(f"{model} has {count} parameters, got {len(rest)}")
        return int(camera_id), ColmapCamera(model, int(width), int(height), tuple(map(float, rest)))

    return _table(path, "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS", camera)


def read_images(path: Path) -> dict[int, ColmapImage]:
    """Read images.txt, in which the image points are on the line after the image, also when there are none."""
    lines = _lines(path)
    images: dict[int, ColmapImage] = {}
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        with _reading(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID of each image point"):
            words = line.split(None, 9)
            image_id, name = int(words[0]), words[9] if len(words) == 10 else ""
            if image_id in images:
                raise ValueError(f"image {image_id} occurs twice")
            pose = motion([float(word) for word in words[1:8]])
            points = next(lines, (number, ""))[1].split()
            if len(points) % 3:
                raise ValueError(f"{len(points)} words are no whole number of image points")
            x = np.array([points[0::3], points[1::3]], dtype=np.float64).T
            ids = np.array([int(word) for word in points[2::3]], dtype=np.int64)
            images[image_id] = ColmapImage(int(words[8]), name, pose, x, ids)
    return images


def read_points(path: Path) -> ColmapPoints:
    """Read points3D.txt."""
    ids, rows, colors, tracks = [], [], [], []
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        with _reading(path, number, "POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX of each image point"):
            words = line.split()
            if len(words) < 8 or len(words) % 2:
                raise ValueError(f"got {len(words)} words")
            ids.append(int(words[0]))
            rows.append([float(word) for word in (*words[1:4], words[7])])
            colors.append([int(word) for word in words[4:7]])
            tracks.append(np.array([int(word) for word in words[8:]], dtype=np.int64).reshape(-1, 2))
            if not all(0 <= level < 256 for level in colors[-1]) or not 0 <= ids[-1] < 2**63:
                raise ValueError("a number out of range")
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return ColmapPoints(
        np.array(ids, dtype=np.int64),
        table[:, :3],
        np.array(colors, dtype=np.uint8).reshape(-1, 3),
        table[:, 3],
        np.array([len(track) for track in tracks], dtype=np.int64),
        np.concatenate([np.empty((0, 2), np.int64), *tracks]),
    )


def read_rigs(path: Path) -> dict[int, dict[int, Motion | None]]:
    """Read rigs.txt."""

    def rig(words: list[str]) -> tuple[int, dict[int, Motion | None]]:
        rest = iter(words)
        rig_id, count = int(next(rest)), int(next(rest))
        sensors: dict[int, Motion | None] = {}
        for k in range(count):
            kind, sensor_id = next(rest), int(next(rest))
            pose: Motion | None = STILL
            if k > 0:
                pose = motion([float(next(rest)) for _ in range(7)]) if int(next(rest)) else None
            if kind == CAMERA:
                sensors[sensor_id] = pose
        _end(rest)
        return rig_id, sensors

    return _table(path, "RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID and the other sensors", rig)


def read_frames(path: Path) -> dict[int, ColmapFrame]:
    """Read frames.txt."""

    def frame(words: list[str]) -> tuple[int, ColmapFrame]:
        rest = iter(words)
        frame_id, rig_id = int(next(rest)), int(next(rest))
        pose = motion([float(next(rest)) for _ in range(7)])
        data = [(next(rest), int(next(rest)), int(next(rest))) for _ in range(int(next(rest)))]
        _end(rest)
        return frame_id, ColmapFrame(rig_id, pose, tuple((sensor, image) for kind, sensor, image in data if kind == CAMERA))

    return _table(path, "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS and the data", frame)


def write_files(model: ColmapModel) -> dict[str, bytes]:
    """The contents of all five files, by name.

    Raises:
        ValueError: The name of an image cannot stand on a line.
    """
    for image in model.images.values():
        if image.name != image.name.strip() or not image.name or "\n" in image.name or "\r" in image.name:
            raise ValueError(f"COLMAP's text files cannot hold the name {image.name!r}")
    points = model.points
    track = np.split(points.track, np.cumsum(points.track_length)[:-1]) if len(points.X) else []
    rows = zip(points.point_id, points.X, points.color, points.error, track, strict=True)
    return {
        "cameras.txt": _text(
            _line(i, camera.model, camera.width, camera.height, *camera.parameters) for i, camera in model.cameras.items()
        ),
        "images.txt": _text(
            _line(i, *image.cam_from_world, image.camera_id, image.name) + _line(*_points_of(image))
            for i, image in model.images.items()
        ),
        "points3D.txt": _text(_line(i, *X, *color, error, *seen.flat) for i, X, color, error, seen in rows),
        "rigs.txt": _text(_line(i, len(rig), *_sensors(rig)) for i, rig in model.rigs.items()),
        "frames.txt": _text(
            _line(
                i,
                frame.rig_id,
                *frame.rig_from_world,
                len(frame.images),
                *(w for pair in frame.images for w in (CAMERA, *pair)),
            )
            for i, frame in model.frames.items()
        ),
    }


def _points_of(image: ColmapImage) -> Iterator[object]:
    return (word for x, point in zip(image.x, image.point_id, strict=True) for word in (*x, point))


def _sensors(rig: dict[int, Motion | None]) -> Iterator[object]:
    """The words for the sensors of a rig, of which the first is the reference."""
    for k, (sensor_id, pose) in enumerate(rig.items()):
        yield from (CAMERA, sensor_id)
        if k > 0:
            yield from (0,) if pose is None else (1, *pose)


def _line(*words: object) -> str:
    """A line; `str` of a number has all its digits."""
    return " ".join(str(word) for word in words) + "\n"


def _text(lines: Iterable[str]) -> bytes:
    return "".join(lines).encode("utf-8", "surrogateescape")


def _end(rest: Iterator[str]) -> None:
    if next(rest, None) is not None:
        raise ValueError("more words than announced")


def _table(path: Path, wanted: str, entry: Callable[[list[str]], tuple[int, Entry]]) -> dict[int, Entry]:
    """Entries of one line each, by their numbers."""
    entries: dict[int, Entry] = {}
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        with _reading(path, number, wanted):
            key, value = entry(line.split())
            if key in entries:
                raise ValueError(f"{key} occurs twice")
            entries[key] = value
    return entries


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Number and text of each line; names of files may be any bytes."""
    text = path.read_bytes().decode("utf-8", "surrogateescape")
    return ((number, line.strip()) for number, line in enumerate(text.split("\n"), start=1))


@contextmanager
def _reading(path: Path, number: int, wanted: str) -> Iterator[None]:
    """Say where and what was wanted when a line cannot be read."""
    try:
        yield
    except (ValueError, OverflowError, IndexError, RuntimeError, StopIteration) as error:
        raise ValueError(f"{path}, line {number}: wanted {wanted} ({str(error)[:100] or 'too short'})") from None
