"""COLMAP's binary files: little-endian, packed, each table a number of entries (64 bits) and the entries.

Every number of entries is compared with what is left of the file before anything is made of it.
"""

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchsfm.formats.colmap_model import (
    CAMERA_SENSOR,
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

OBSERVATION = np.dtype([("x", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<i8"), ("X", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")])
MODELS = {parameters.number: name for name, parameters in PARAMETERS.items()}


class _Cursor:
    """Reads a file from its beginning to its end."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, path.read_bytes(), 0

    def take(self, layout: str, what: str) -> tuple[int | float, ...]:
        """Numbers, as `struct` names them."""
        return struct.unpack_from("<" + layout, self.data, self.skip(struct.calcsize("<" + layout), what))

    def skip(self, size: int, what: str) -> int:
        """Pass over so many bytes; return where they begin."""
        start = self.place
        self._need(start + size, what)
        self.place += size
        return start

    def count(self, layout: str, least: int, what: str) -> int:
        """A number of entries, each of which takes `least` bytes at least."""
        count = int(self.take(layout, f"the number of {what}")[0])
        self._need(self.place + count * least, f"{count} {what}")
        return count

    def text(self, what: str) -> str:
        """What stands before the next zero byte."""
        end = self.data.find(b"\0", self.place)
        if end < 0:
            raise ValueError(f"{self.path}: truncated: {what} has no end")
        text = self.data[self.place : end].decode("utf-8", "surrogateescape")
        self.place = end + 1
        return text

    def motion(self, what: str) -> Motion:
        """A rotation and a translation."""
        try:
            return motion(self.take("7d", what))
        except ValueError as error:
            raise self.fault(f"{what}: {error}") from None

    def close(self) -> None:
        """See that this was all."""
        if self.place != len(self.data):
            raise ValueError(f"{self.path}: too long: {len(self.data) - self.place} bytes after the last entry")

    def fault(self, what: str) -> ValueError:
        """An error that names the file."""
        return ValueError(f"{self.path}: {what.removeprefix(f'{self.path}: ')}")

    def _need(self, end: int, what: str) -> None:
        if end > len(self.data):
            raise ValueError(f"{self.path}: truncated: {what} would end at byte {end}, the file ends at {len(self.data)}")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read cameras.bin."""
    file, cameras = _Cursor(path), dict[int, ColmapCamera]()
    for _ in range(file.count("Q", 24 + 24, "cameras")):
        camera_id, number, width, height = (int(value) for value in file.take("IiQQ", "a camera"))
        if number not in MODELS:
            raise file.fault(f"camera {camera_id} is of the model number {number}, which is unknown")
        name = MODELS[number]
        parameters = file.take(f"{PARAMETERS[name].size}d", f"camera {camera_id}")
        if camera_id in cameras:
            raise file.fault(f"camera {camera_id} occurs twice")
        cameras[camera_id] = ColmapCamera(name, width, height, parameters)
    file.close()
    return cameras


def read_images(path: Path) -> dict[int, ColmapImage]:
    """Read images.bin."""
    file, images = _Cursor(path), dict[int, ColmapImage]()
    for _ in range(file.count("Q", 4 + 56 + 4 + 1 + 8, "images")):
        image_id = int(file.take("I", "an image")[0])
        pose = file.motion(f"image {image_id}")
        camera_id = int(file.take("I", f"image {image_id}")[0])
        name = file.text(f"the name of image {image_id}")
        count = file.count("Q", OBSERVATION.itemsize, f"points of image {image_id}")
        seen = np.frombuffer(file.data, OBSERVATION, count, file.skip(count * OBSERVATION.itemsize, "image points"))
        if image_id in images:
            raise file.fault(f"image {image_id} occurs twice")
        images[image_id] = ColmapImage(camera_id, name, pose, seen["x"], seen["point"])
    file.close()
    return images


def read_points(path: Path) -> ColmapPoints:
    """Read points3D.bin, in which every point is followed by its track."""
    file = _Cursor(path)
    starts: list[int] = []
    for _ in range(file.count("Q", POINT.itemsize, "3D points")):
        starts.append(file.place)
        length = file.take("Q24x3x8xQ", "a 3D point")[1]
        file.skip(8 * int(length), "the track of a 3D point")
    file.close()
    data = np.frombuffer(file.data, np.uint8)
    place, of_track = _places(np.array(starts, dtype=np.int64), len(data))
    of_track[:8] = False
    head = np.frombuffer(data[place].tobytes(), POINT)
    track = np.frombuffer(data[of_track].tobytes(), "<u4").reshape(-1, 2).astype(np.int64)
    return ColmapPoints(head["id"], head["X"], head["color"], head["error"], head["length"].astype(np.int64), track)


def _places(starts: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The bytes of the 3D points that begin here, a row for each, and which bytes of the whole belong to none of them."""
    place = starts[:, None] + np.arange(POINT.itemsize)
    others = np.ones(size, np.bool_)
    others[place] = False
    return place, others


def read_rigs(path: Path) -> dict[int, dict[int, Motion | None]]:
    """Read rigs.bin."""
    file, rigs = _Cursor(path), dict[int, dict[int, Motion | None]]()
    for _ in range(file.count("Q", 8, "rigs")):
        rig_id = int(file.take("I", "a rig")[0])
        sensors: dict[int, Motion | None] = {}
        for k in range(file.count("I", 8, f"sensors of rig {rig_id}")):
            kind, sensor_id = (int(value) for value in file.take("iI", "a sensor"))
            pose: Motion | None = STILL
            if k > 0:  # the first one is the reference
                pose = file.motion(f"sensor {sensor_id}") if file.take("B", "a sensor")[0] else None
            if kind == CAMERA_SENSOR:
                sensors[sensor_id] = pose
        if rig_id in rigs:
            raise file.fault(f"rig {rig_id} occurs twice")
        rigs[rig_id] = sensors
    file.close()
    return rigs


def read_frames(path: Path) -> dict[int, ColmapFrame]:
    """Read frames.bin."""
    file, frames = _Cursor(path), dict[int, ColmapFrame]()
    for _ in range(file.count("Q", 8 + 56 + 4, "frames")):
        frame_id, rig_id = (int(value) for value in file.take("II", "a frame"))
        pose = file.motion(f"frame {frame_id}")
        count = file.count("I", 16, f"data of frame {frame_id}")
        data = [file.take("iIQ", "data of a frame") for _ in range(count)]
        if frame_id in frames:
            raise file.fault(f"frame {frame_id} occurs twice")
        images = tuple((int(sensor), int(image)) for kind, sensor, image in data if kind == CAMERA_SENSOR)
        frames[frame_id] = ColmapFrame(rig_id, pose, images)
    file.close()
    return frames


def write_files(model: ColmapModel) -> dict[str, bytes]:
    """The contents of all five files, by name."""
    return {
        "cameras.bin": _entries(
            struct.pack("<IiQQ", i, PARAMETERS[camera.model].number, camera.width, camera.height)
            + struct.pack(f"<{len(camera.parameters)}d", *camera.parameters)
            for i, camera in model.cameras.items()
        ),
        "images.bin": _entries(_image(i, image) for i, image in model.images.items()),
        "points3D.bin": _points(model.points),
        "rigs.bin": _entries(_rig(i, sensors) for i, sensors in model.rigs.items()),
        "frames.bin": _entries(
            struct.pack("<II7dI", i, frame.rig_id, *frame.rig_from_world, len(frame.images))
            + b"".join(struct.pack("<iIQ", CAMERA_SENSOR, *pair) for pair in frame.images)
            for i, frame in model.frames.items()
        ),
    }


def _entries(entries: Iterable[bytes]) -> bytes:
    parts = list(entries)
    return struct.pack("<Q", len(parts)) + b"".join(parts)


def _image(image_id: int, image: ColmapImage) -> bytes:
    seen = np.empty(len(image.x), OBSERVATION)
    seen["x"], seen["point"] = image.x, image.point_id
    name = image.name.encode("utf-8", "surrogateescape").replace(b"\0", b"")
    head = struct.pack("<I7dI", image_id, *image.cam_from_world, image.camera_id)
    return head + name + b"\0" + struct.pack("<Q", len(seen)) + seen.tobytes()


def _rig(rig_id: int, sensors: dict[int, Motion | None]) -> bytes:
    """A rig, whose first sensor is the reference."""
    data = struct.pack("<II", rig_id, len(sensors))
    for k, (sensor_id, pose) in enumerate(sensors.items()):
        data += struct.pack("<iI", CAMERA_SENSOR, sensor_id)
        if k > 0:
            data += b"\0" if pose is None else struct.pack("<B7d", 1, *pose)
    return data


def _points(points: ColmapPoints) -> bytes:
    """Points with their tracks, of which every one has its own length."""
    head = np.empty(len(points.X), POINT)
    head["id"], head["X"], head["color"], head["error"] = points.point_id, points.X, points.color, points.error
    head["length"] = points.track_length
    size = POINT.itemsize + 8 * points.track_length
    data = np.empty(int(size.sum()), np.uint8)
    place, of_track = _places(np.cumsum(size) - size, len(data))
    data[place] = np.frombuffer(head.tobytes(), np.uint8).reshape(-1, POINT.itemsize)
    data[of_track] = np.frombuffer(points.track.astype("<u4").tobytes(), np.uint8)
    return struct.pack("<Q", len(head)) + data.tobytes()
