"""Kapture datasets, version 1.1: a folder of tables with commas, and of each image its key points in binary.

Cameras are those of COLMAP and poses go from the world to the sensor, axes as here; the upper left corner of the image is at
(0, 0) there, so that the centre of the top-left pixel is at (0.5, 0.5), and at (0, 0) here. An image is what a sensor took at a
time; the pose at that time is the sensor's own, or that of a rig that it is a part of.
"""

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from torchsfm.formats.colmap import colmap_parameters, lens_from_colmap
from torchsfm.formats.colmap_model import PARAMETERS, ColmapCamera
from torchsfm.formats.joining import Rows, numbers, reading, running_numbers
from torchsfm.geometry import quaternion_wxyz_from_rotation, rotation_from_quaternion_wxyz
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import write_whole_files
from torchsfm.reconstruction.model.reconstruction import Reconstruction

VERSION = "# kapture format: 1.1"
HALF_PIXEL = 0.5
KIND = "torchsfm"
"""What the key points written here are called."""
TYPES = frozenset({"float16", "float32", "float64", "float", "int16", "int32", "int64", "int", "uint8", "uint16", "uint32"})
"""Of the numbers of key points."""
NESTED = 8
"""Rigs may be parts of rigs, so deep at most."""
Motion = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rotation and translation."""


@on_the_cpu
def write_kapture(reconstruction: Reconstruction, folder: str | Path) -> None:
    """Write a model as a kapture dataset, without its photographs, which belong into `sensors/records_data`.

    A sensor is written for each camera and size of image, with COLMAP's models of cameras; the time of an image is its number.

    Args:
        reconstruction: The model.
        folder: Where to; made if it is not there.

    Raises:
        ValueError: A camera has skew, or a name a comma or line break, begins or ends with blanks, or leads out of its folder,
            for which the format has no place; or the folder holds a dataset with rigs, which would be mixed with this one.
        OSError: A file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_kapture(torchsfm.read_model("model.npz"), "kapture")
        >>> from pathlib import Path
        >>> Path("kapture/sensors/sensors.txt").read_text().splitlines()[0]
        '# kapture format: 1.1'
    """
    folder = Path(folder)
    if (folder / "sensors" / "rigs.txt").exists():
        raise ValueError(f"{folder}: holds another dataset, with rigs; give another folder")
    model = reconstruction.to("cpu", torch.float64)
    if odd := [name for name in model.names if any(c in name for c in ",\n\r") or name.strip() != name or not _inside(name)]:
        raise ValueError(f"kapture cannot hold the name {odd[0]!r}")
    keys = torch.cat([model.camera_index[:, None], model.image_size.to(model.camera_index.dtype)], -1)
    used, sensor = torch.unique(keys, dim=0, return_inverse=True)
    sensors = []
    for k, (camera, width, height) in enumerate(used.tolist()):
        name, _, _, values = colmap_parameters(model.cameras[camera], camera, (width, height), PARAMETERS.keys())
        sensors.append(", ".join([f"sensor{k}", "", "camera", name, str(width), str(height), *map(str, values)]))
    records = [f"{i}, sensor{k}, {name}" for i, (k, name) in enumerate(zip(sensor.tolist(), model.names, strict=True))]
    motions = torch.cat([quaternion_wxyz_from_rotation(model.poses.R), model.poses.t], -1).tolist()
    posed = model.registered.nonzero()[:, 0].tolist()
    trajectories = [", ".join([str(i), f"sensor{int(sensor[i])}", *map(str, motions[i])]) for i in posed]
    color = (model.color.clamp(0, 1) * 255).round().int().tolist()
    points = [", ".join(map(str, X + rgb)) for X, rgb in zip(model.X.tolist(), color, strict=True)]
    seen: dict[int, list[str]] = defaultdict(list)
    for point, view, key in zip(model.point.tolist(), model.view.tolist(), running_numbers(model.view), strict=True):
        seen[point] += [model.names[view], str(key)]
    observations = [", ".join([str(point), KIND, *seen[point]]) for point in sorted(seen)]
    places = folder / "reconstruction" / "keypoints" / KIND
    contents = {
        folder / "sensors" / "sensors.txt": _table("sensor_id, name, sensor_type, [sensor_params]+", sensors),
        folder / "sensors" / "records_camera.txt": _table("timestamp, device_id, image_path", records),
        folder / "sensors" / "trajectories.txt": _table("timestamp, device_id, qw, qx, qy, qz, tx, ty, tz", trajectories),
        folder / "reconstruction" / "points3d.txt": _table("X, Y, Z, R, G, B", points),
        folder / "reconstruction" / "observations.txt": _table(
            "point3d_id, keypoints_type, [image_path, feature_id]*", observations
        ),
        places / "keypoints.txt": _table("name, dtype, dsize", [f"{KIND}, float64, 2"]),
    }
    x = (model.x + HALF_PIXEL).numpy().astype("<f8")
    for i in posed:
        contents[places / f"{model.names[i]}.kpt"] = x[model.view.numpy() == i].tobytes()
    for path in contents:
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole_files(contents)


def _table(header: str, rows: list[str]) -> bytes:
    return "\n".join([VERSION, f"# {header}", *rows, ""]).encode("utf-8", "surrogateescape")


def _inside(name: str) -> bool:
    """Whether a name is that of a file within its folder."""
    path = PurePosixPath(name)
    return bool(path.name) and not path.is_absolute() and ".." not in path.parts and "\0" not in name


@on_the_cpu
def read_kapture(folder: str | Path) -> Reconstruction:
    """Read the cameras, poses, points and observations of a kapture dataset.

    Args:
        folder: The folder in which `sensors` and `reconstruction` are.

    Returns:
        The model, in float64, with the images in the order of the table of records. Points without colours are grey.

    Raises:
        ValueError: A table is none such, or a damaged one, of another version than 1.1, or has cameras that have no equal here;
            or key points are packed in an archive; one line that says why.
        OSError: A file cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_kapture(torchsfm.read_model("model.npz"), "kapture")
        >>> torchsfm.read_kapture("kapture").X.shape
        torch.Size([20, 3])
    """
    folder = Path(folder)
    rows = Rows()
    sensors, about = folder / "sensors", folder / "reconstruction"
    path = sensors / "sensors.txt"
    sizes: list[tuple[int, int]] = []
    camera_of: dict[str, int] = {}
    with reading(path, "kapture's table of sensors, version 1.1"):
        text = path.read_bytes().decode("utf-8", "surrogateescape")
        if text.split("\n", 1)[0].strip() != VERSION:
            raise ValueError(f"wanted the first line {VERSION!r}, got {text[:40]!r}")
        for key, _, kind, *parameters in _rows(path):
            if kind == "camera":
                camera_of[key] = len(sizes)
                name, width, height, *values = parameters
                if name not in PARAMETERS or len(values) != PARAMETERS[name].size:
                    raise ValueError(f"sensor {key} is a {name} of {len(values)} numbers, which has no equal here")
                sizes.append((int(width), int(height)))
                rows.lenses.append(lens_from_colmap(ColmapCamera(name, *sizes[-1], tuple(map(float, values))), key))
    poses = _poses(sensors)
    path = sensors / "records_camera.txt"
    if path.is_file():
        with reading(path, "kapture's table of images"):
            for time, key, name in _rows(path):
                R, t = poses.get((int(time), key), (None, None))
                rows.add_image(name, sizes[camera_of[key]], camera_of[key], R, t)
    path = about / "points3d.txt"
    if path.is_file():
        with reading(path, "kapture's table of points"):
            table = numbers([[float(word) for word in words] for words in _rows(path)] or np.empty((0, 6)), -1, -1)
            if table.shape[1] not in (3, 6):
                raise ValueError(f"points of {table.shape[1]} numbers")
            rows.X, rows.color = table[:, :3], table[:, 3:] / 255 if table.shape[1] == 6 else None
    path = about / "observations.txt"
    if path.is_file():
        with reading(path, "kapture's table of observations"):
            _observe(path, about / "keypoints", rows)
    with reading(folder, "a kapture dataset"):
        return rows.join()


def _rows(path: Path) -> Iterator[list[str]]:
    """The entries of a table, without comments."""
    for line in path.read_bytes().decode("utf-8", "surrogateescape").split("\n"):
        if line.strip() and not line.startswith("#"):
            yield [word.strip() for word in line.split(",")]


def _poses(folder: Path) -> dict[tuple[int, str], Motion]:
    """The poses of sensors at times, those of rigs handed on to what is fixed to them."""
    rigs: dict[str, list[tuple[str, Motion]]] = defaultdict(list)
    path = folder / "rigs.txt"
    if path.is_file():
        with reading(path, "kapture's table of rigs"):
            for rig, key, *values in _rows(path):
                rigs[rig].append((key, _motion(values)))
    poses: dict[tuple[int, str], Motion] = {}
    path = folder / "trajectories.txt"
    if not path.is_file():
        return poses
    with reading(path, "kapture's table of poses"):
        for time, key, *values in _rows(path):
            if not all(values):
                continue  # half a pose is none
            found = [(key, _motion(values))]
            for _ in range(NESTED):
                poses.update({(int(time), device): motion for device, motion in found})
                found = [
                    (part, (R_part @ R, R_part @ t + t_part))
                    for device, (R, t) in found
                    for part, (R_part, t_part) in rigs.get(device, ())
                ]
            if found:
                raise ValueError(f"the rig {key} is a part of itself, or of too many others")
    return poses


def _motion(values: list[str]) -> Motion:
    """Rotation and translation of a row: quaternion w, x, y, z, then a vector."""
    motion = numbers([float(value) for value in values], 7)
    if not 1e-6 < np.linalg.norm(motion[:4]) < 1e6:
        raise ValueError("a pose that is none")
    return rotation_from_quaternion_wxyz(torch.from_numpy(motion[:4])).numpy(), motion[4:]


def _observe(path: Path, folder: Path, rows: Rows) -> None:
    """Fill in the observations."""
    image_of = {name: i for i, name in enumerate(rows.names)}
    places: dict[tuple[str, str], NDArray[np.float64]] = {}
    x, view, point = [], [], []
    for key, kind, *seen in _rows(path):
        for name, number in zip(seen[::2], seen[1::2], strict=True):
            if (kind, name) not in places:
                places[kind, name] = _key_points(folder, kind, name)
            index = int(number)
            if not 0 <= index < len(places[kind, name]):
                raise ValueError(f"there is no key point {index} of {name}")
            x.append(places[kind, name][index])
            view.append(image_of[name])
            point.append(int(key))
    rows.x = np.array(x).reshape(-1, 2) - HALF_PIXEL
    rows.view, rows.point = view, point


def _key_points(folder: Path, kind: str, name: str) -> NDArray[np.float64]:
    """Where the key points of an image are."""
    if not _inside(kind) or not _inside(name):
        raise ValueError(f"the name {name!r} leads out of its folder")
    if (folder / kind / "keypoints.tar").is_file():
        raise ValueError(f"the key points of {kind} are in an archive; unpack keypoints.tar")
    ((_, dtype, size),) = _rows(folder / kind / "keypoints.txt")
    if dtype not in TYPES or not 2 <= int(size) <= 2**16:
        raise ValueError(f"key points of {size} numbers of the type {dtype}")
    data = (folder / kind / f"{name}.kpt").read_bytes()
    values = np.frombuffer(data, np.dtype(dtype).newbyteorder("<")).reshape(-1, int(size))
    return numbers(values[:, :2], -1, 2)
