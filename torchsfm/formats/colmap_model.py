"""What COLMAP's files hold, and the rules by which the files of one model agree.

A model is three tables, cameras, images and 3D points; newer versions add rigs (sensors that are fixed to each other) and
frames (a rig at one time), from which the poses of the images follow. Each table is a file, all of them binary or all text; see
https://colmap.github.io/format.html.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchsfm.geometry import Pose, rotation_from_quaternion_wxyz

NO_POINT = -1
"""Stands for the 3D point of an image point that has none."""
CAMERA_SENSOR = 0
MAX_SIZE = 2**31
Motion = tuple[float, ...]
"""A rotation as quaternion w, x, y, z, then a translation."""
STILL: Motion = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Parameters(NamedTuple):
    """What a camera of COLMAP holds besides the principal point."""

    number: int
    """Of the model, in binary files."""
    focals: int
    """Focal lengths, in front of the principal point."""
    lens: tuple[str, ...]
    """Numbers behind it."""

    @property
    def size(self) -> int:
        """All numbers."""
        return self.focals + 2 + len(self.lens)


PARAMETERS: dict[str, Parameters] = {
    "SIMPLE_PINHOLE": Parameters(0, 1, ()),
    "PINHOLE": Parameters(1, 2, ()),
    "SIMPLE_RADIAL": Parameters(2, 1, ("k1",)),
    "RADIAL": Parameters(3, 1, ("k1", "k2")),
    "OPENCV": Parameters(4, 2, ("k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": Parameters(5, 2, ("k1", "k2", "k3", "k4")),
    "FULL_OPENCV": Parameters(6, 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "FOV": Parameters(7, 2, ("omega",)),
    "SIMPLE_RADIAL_FISHEYE": Parameters(8, 1, ("k1",)),
    "RADIAL_FISHEYE": Parameters(9, 1, ("k1", "k2")),
    "THIN_PRISM_FISHEYE": Parameters(10, 2, ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
    "RAD_TAN_THIN_PRISM_FISHEYE": Parameters(11, 2, ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3")),
    "SIMPLE_DIVISION": Parameters(12, 1, ("k",)),
    "DIVISION": Parameters(13, 2, ("k",)),
    "SIMPLE_FISHEYE": Parameters(14, 1, ()),
    "FISHEYE": Parameters(15, 2, ()),
    "EUCM": Parameters(16, 2, ("alpha", "beta")),
}


@dataclass(frozen=True)
class ColmapCamera:
    """One camera."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """One image that has a pose."""

    camera_id: int
    name: str
    cam_from_world: Motion
    x: NDArray[np.float64]
    """Image points (n, 2), the centre of the top-left pixel at (0.5, 0.5)."""
    point_id: NDArray[np.int64]
    """The 3D point of each of them (n,), or `NO_POINT`."""


@dataclass(frozen=True)
class ColmapPoints:
    """All 3D points, and the image points of each in one long table."""

    point_id: NDArray[np.int64]
    X: NDArray[np.float64]
    color: NDArray[np.uint8]
    error: NDArray[np.float64]
    track_length: NDArray[np.int64]
    track: NDArray[np.int64]
    """Image number and number of the image point within the image (m, 2), point by point."""


@dataclass(frozen=True)
class ColmapFrame:
    """A rig at one time, and the images that it took: sensor number and image number."""

    rig_id: int
    rig_from_world: Motion
    images: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class ColmapModel:
    """All tables, by the numbers that COLMAP gives; a rig has the motion `sensor_from_rig` of each of its cameras, if known."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: ColmapPoints
    rigs: dict[int, dict[int, Motion | None]] = field(default_factory=dict)
    frames: dict[int, ColmapFrame] = field(default_factory=dict)


def check_model(model: ColmapModel) -> None:
    """See that the tables agree with each other.

    Raises:
        ValueError: One points at an entry that is not there, or two say different things; one line that names them.
    """
    points = model.points
    numbers = np.unique(points.point_id)
    if (points.point_id < 0).any() or len(numbers) != len(points.point_id):
        raise ValueError("the number of a 3D point is negative or occurs twice")
    if not np.isfinite(points.X).all():
        raise ValueError(f"the 3D point {points.point_id[~np.isfinite(points.X).all(1)][0]} is not finite")
    for camera_id, camera in model.cameras.items():
        if not np.isfinite(camera.parameters).all() or min(camera.parameters[: PARAMETERS[camera.model].focals]) <= 0:
            raise ValueError(f"camera {camera_id} has a focal length that is not positive, or a parameter that is not finite")
        if not (0 <= camera.width < MAX_SIZE and 0 <= camera.height < MAX_SIZE):
            raise ValueError(f"camera {camera_id} has images of {camera.width} x {camera.height} pixels")
    for image_id, image in model.images.items():
        if image.camera_id not in model.cameras:
            raise ValueError(f"image {image_id} is of camera {image.camera_id}, which is not there")
        if not 0 <= image_id < 2**32 or not np.isfinite(image.x).all():
            raise ValueError(f"image {image_id} has a number out of range, or an image point that is not finite")
        place = np.searchsorted(numbers, image.point_id).clip(max=max(len(numbers) - 1, 0))
        unknown = (image.point_id != NO_POINT) & (numbers[place] != image.point_id if len(numbers) else True)
        if unknown.any():
            raise ValueError(f"image {image_id} shows the 3D point {image.point_id[unknown][0]}, which is not there")
    _check_tracks(model)
    if model.rigs or model.frames:
        _check_frames(model)


def _check_tracks(model: ColmapModel) -> None:
    """What the track of a point says, the image must say too."""
    image_ids = np.array(sorted(model.images), dtype=np.int64)
    counts = np.array([len(model.images[i].x) for i in image_ids.tolist()], dtype=np.int64)
    said = np.concatenate([np.empty(0, np.int64), *(model.images[i].point_id for i in image_ids.tolist())])
    point_id = np.repeat(model.points.point_id, model.points.track_length)
    image, index = model.points.track.T
    row = np.searchsorted(image_ids, image).clip(max=max(len(image_ids) - 1, 0))
    known = image_ids[row] == image if len(image_ids) else np.zeros(len(image), np.bool_)
    known[known] &= (index[known] >= 0) & (index[known] < counts[row[known]])
    known[known] &= said[(np.cumsum(counts) - counts)[row[known]] + index[known]] == point_id[known]
    if not known.all():
        first = int(known.argmin())
        raise ValueError(
            f"the 3D point {point_id[first]} has point {index[first]} of image {image[first]} in its track, which is not there"
            " or shows another"
        )


def _check_frames(model: ColmapModel) -> None:
    """The pose of an image is the one of its frame, moved to its camera."""
    placed: dict[int, tuple[Motion, Motion | None]] = {}
    for frame_id, frame in model.frames.items():
        if frame.rig_id not in model.rigs:
            raise ValueError(f"frame {frame_id} is of rig {frame.rig_id}, which is not there")
        for sensor_id, image_id in frame.images:
            if sensor_id not in model.rigs[frame.rig_id]:
                raise ValueError(f"frame {frame_id} is of sensor {sensor_id}, which rig {frame.rig_id} does not have")
            if image_id in placed:
                raise ValueError(f"image {image_id} belongs to two frames")
            placed[image_id] = frame.rig_from_world, model.rigs[frame.rig_id][sensor_id]
    if missing := sorted(set(model.images) - set(placed)):
        raise ValueError(f"image {missing[0]} belongs to no frame")
    known = [(i, rig, sensor) for i, (rig, sensor) in placed.items() if sensor is not None and i in model.images]
    if not known:
        return
    found = poses([model.images[i].cam_from_world for i, _, _ in known])
    wanted = poses([sensor for _, _, sensor in known]) @ poses([rig for _, rig, _ in known])
    gap = torch.maximum(
        (found.R - wanted.R).abs().amax((1, 2)),
        (found.t - wanted.t).abs().amax(1) / (1 + wanted.t.abs().amax(1)),
    )
    if float(gap.max()) > 1e-6:
        raise ValueError(f"image {known[int(gap.argmax())][0]} has another pose in the table of images than by its frame")


def poses(motions: list[Any]) -> Pose:
    """Motions as poses."""
    table = torch.tensor(motions, dtype=torch.float64).reshape(-1, 7)
    return Pose(rotation_from_quaternion_wxyz(table[:, :4]), table[:, 4:])


def motion(values: list[float] | tuple[float, ...]) -> Motion:
    """Seven numbers as a motion.

    Raises:
        ValueError: One is not finite, or the quaternion is zero.
    """
    if not all(map(math.isfinite, values)) or not 1e-6 < math.hypot(*values[:4]) < 1e6:
        raise ValueError("a pose that is none")
    return tuple(values)
