"""PLY: coloured points for MeshLab, CloudCompare, Blender, Open3D and many others."""

from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


@dataclass(frozen=True)
class PointCloud:
    """Points and, where the file has them, colours.

    Example:
        >>> import torch, torchsfm
        >>> X = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
        >>> torchsfm.write_ply(X, "points.ply")
        >>> cloud = torchsfm.read_ply("points.ply")
        >>> cloud.X.equal(X), cloud.color is None  # the file told no colours
        (True, True)
    """

    X: Float[Tensor, "n 3"]
    """The points, in the file's unit."""
    color: Float[Tensor, "n 3"] | None
    """Red, green, blue in [0, 1]."""


@on_the_cpu
def write_ply(
    points: Reconstruction | Float[Tensor, "n 3"], path: str | Path, *, color: Float[Tensor, "n 3"] | None = None
) -> None:
    """Write points as binary little-endian PLY: float or double coordinates as they come, colours in 8 bits.

    A reconstruction also gets an element `camera`, one entry per registered image, after the points, with the properties that
    MeshLab gave it: centre `view_p*`, axes (x right, y up, z backwards), focal length and image size in pixels. Programs that
    know only points pass over it.

    Args:
        points: A model, or points as rows.
        path: File to write; its folder must be there.
        color: Red, green, blue in [0, 1], for points given as a tensor.

    Raises:
        ValueError: `color` does not fit, or is given together with a reconstruction.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.write_ply(torch.zeros(5, 3), "points.ply")
        >>> from pathlib import Path
        >>> Path("points.ply").read_bytes().splitlines()[2]
        b'element vertex 5'
    """
    cameras: npt.NDArray[Any] | None = None
    if isinstance(points, Reconstruction):
        if color is not None:
            raise ValueError("color: wanted none with a reconstruction, which has its own")
        cameras = _camera_records(points)
        X, color = points.X, points.color
    else:
        X = points
        check_tensors(points=(points, "n 3"), color=(color, "?n 3"))
        if points.ndim != 2:
            raise ValueError(f"points: wanted shape (n, 3), got {tuple(points.shape)}")
    real = "<f8" if X.dtype == torch.float64 else "<f4"
    names = [(axis, real) for axis in "xyz"]
    if color is not None:
        names += [(channel, "u1") for channel in ("red", "green", "blue")]
    vertices = np.empty(len(X), dtype=names)
    for i, axis in enumerate("xyz"):
        vertices[axis] = X[:, i].detach().cpu().numpy()
    if color is not None:
        levels = (color.detach().nan_to_num(0).clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()
        for i, channel in enumerate(("red", "green", "blue")):
            vertices[channel] = levels[:, i]
    elements = [("vertex", vertices)] + ([("camera", cameras)] if cameras is not None else [])
    words = {"<f8": "double", "<f4": "float", "|u1": "uchar", "<i4": "int"}
    header = ["ply", "format binary_little_endian 1.0"]
    for name, records in elements:
        header.append(f"element {name} {len(records)}")
        header += [f"property {words[records.dtype[field].str]} {field}" for field in records.dtype.names or ()]
    with whole_file(path) as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for _, records in elements:
            file.write(records.tobytes())


@on_the_cpu
def read_ply(path: str | Path) -> PointCloud:
    """Read the points of a PLY file, ASCII or binary of either byte order.

    Args:
        path: The file.

    Returns:
        The vertices, in float64 if the file has them so, else float32, and their colours if it has red, green and blue
        (integers are divided by the largest number of their type). Other properties and elements are passed over. Points that
        are not finite are kept, as programs write them for places where they measured nothing.

    Raises:
        ValueError: The file is not a PLY file, is damaged, or has no points.
        OSError: The file cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.write_ply(torch.zeros(5, 3), "points.ply", color=torch.ones(5, 3))
        >>> cloud = torchsfm.read_ply("points.ply")
        >>> cloud.X.shape, cloud.color[0]
        (torch.Size([5, 3]), tensor([1., 1., 1.]))
    """
    path = Path(path)
    with path.open("rb") as file:
        try:
            order, elements = _read_header(file)
            for name, count, properties in elements:
                if name == "vertex":
                    return _cloud(_read_records(file, order, count, properties))
                _skip(file, order, count, properties)
        except (ValueError, UnicodeDecodeError, KeyError, IndexError, OverflowError, MemoryError) as error:
            raise ValueError(f"{path} is not a PLY file this can read ({error})") from error
    raise ValueError(f"{path} has no points")


Properties = list[tuple[str, str, str | None]]
"""Name, type of the value, and type of the count for lists."""


def _read_header(file: BinaryIO) -> tuple[str, list[tuple[str, int, Properties]]]:
    if file.readline(16).strip() != b"ply":
        raise ValueError("it does not start with 'ply'")
    order = ""
    elements: list[tuple[str, int, Properties]] = []
    for _ in range(10000):
        line = file.readline(10000)
        words = line.decode("ascii", errors="replace").split()
        if not line:
            raise ValueError("the header has no end")
        match words:
            case ["end_header"]:
                if not order:
                    raise ValueError("the header names no format")
                return order, elements
            case ["format", name, "1.0"] if name in ORDERS:
                order = name
            case ["element", name, count]:
                if int(count) < 0:
                    raise ValueError(f"element {name} has a negative count")
                elements.append((name, int(count), []))
            case ["property", "list", kind, value, name] if elements:
                elements[-1][2].append((name, TYPES[value], TYPES[kind]))
            case ["property", value, name] if elements:
                elements[-1][2].append((name, TYPES[value], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the header has the line {' '.join(words)!r}")
    raise ValueError("the header has no end")


def _read_records(file: BinaryIO, order: str, count: int, properties: Properties) -> npt.NDArray[Any]:
    """Read the points as a structured array."""
    if not {"x", "y", "z"} <= {name for name, _, _ in properties}:
        raise ValueError("its points do not have x, y and z")
    if any(kind is not None for _, _, kind in properties):
        raise ValueError("its points have list properties")
    if order != "ascii":
        dtype = np.dtype([(name, ORDERS[order] + value) for name, value, _ in properties])
        here = file.tell()
        # Before a count from a damaged header takes all memory.
        if file.seek(0, 2) - here < dtype.itemsize * count:
            raise ValueError("it ends within the points")
        file.seek(here)
        return np.frombuffer(file.read(dtype.itemsize * count), dtype, count)
    dtype = np.dtype([(name, value) for name, value, _ in properties])
    # Through float64, which holds all of the types: values out of range must not wrap around.
    values = array("d")
    for _ in range(count):
        words = file.readline().split()
        if len(words) != len(properties):
            raise ValueError("it ends within the points, or a line does not have one number per property")
        values.extend(map(float, words))
    table = np.array(values, dtype=np.float64).reshape(count, len(properties))
    records = np.empty(count, dtype)
    for i, (name, value, _) in enumerate(properties):
        if value[0] in "iu" and not ((table[:, i] >= np.iinfo(value).min) & (table[:, i] <= np.iinfo(value).max)).all():
            raise ValueError(f"a value of {name} is out of range")
        with np.errstate(over="ignore"):
            records[name] = table[:, i]
    return records


def _skip(file: BinaryIO, order: str, count: int, properties: Properties) -> None:
    """Pass over an element before the points."""
    if order == "ascii":
        for _ in range(count):
            if not file.readline():
                raise ValueError("it ends before the points")
        return
    place = file.tell()
    end = file.seek(0, 2)
    if all(kind is None for _, _, kind in properties):
        place += count * sum(np.dtype(value).itemsize for _, value, _ in properties)
        count = 0
    for _ in range(count):
        for _, value, kind in properties:
            number = 1
            if kind is not None:
                file.seek(min(place, end))
                stored = np.dtype(ORDERS[order] + kind)
                number = int(np.frombuffer(file.read(stored.itemsize), stored, 1)[0])
                place += stored.itemsize
            if number < 0:
                raise ValueError("a list has a negative length")
            place += number * np.dtype(value).itemsize
    if place > end:
        raise ValueError("it ends before the points")
    file.seek(place)


def _cloud(records: npt.NDArray[Any]) -> PointCloud:
    fields = records.dtype.names or ()
    wide = any(records.dtype[axis].itemsize == 8 or records.dtype[axis].kind in "iu" for axis in "xyz")
    X = np.stack([records[axis].astype(np.float64 if wide else np.float32) for axis in "xyz"], -1)
    color = None
    for prefix in ("", "diffuse_"):
        channels = [prefix + channel for channel in ("red", "green", "blue")]
        if color is None and set(channels) <= set(fields):
            values = [records[channel].astype(X.dtype) for channel in channels]
            kinds = [records.dtype[channel] for channel in channels]
            scaled = [v / np.iinfo(k).max if k.kind in "iu" else v for v, k in zip(values, kinds, strict=True)]
            color = torch.from_numpy(np.stack(scaled, -1))
    return PointCloud(torch.from_numpy(X), color)


def _camera_records(model: Reconstruction) -> npt.NDArray[Any]:
    """Describe registered images as MeshLab describes cameras, whose y axis is up and whose z axis is backwards."""
    keep = model.registered.nonzero()[:, 0].cpu()
    poses, K = model.poses[keep.to(model.X.device)], model.cameras[model.camera_index][keep.to(model.X.device)].K
    axes = poses.R.detach().cpu() * torch.tensor([[1.0], [-1.0], [-1.0]], dtype=poses.R.dtype)
    columns = torch.cat([poses.centre.detach().cpu(), axes.flatten(1), K[:, 0, :1].detach().cpu()], 1).double().numpy()
    names = [f"view_p{axis}" for axis in "xyz"] + [f"{row}_axis{axis}" for row in "xyz" for axis in "xyz"] + ["focal"]
    records = np.empty(len(keep), [(name, "<f8") for name in names] + [("viewportx", "<i4"), ("viewporty", "<i4")])
    for i, name in enumerate(names):
        records[name] = columns[:, i]
    size = model.image_size[keep.to(model.image_size.device)].cpu().numpy()
    records["viewportx"], records["viewporty"] = size[:, 0], size[:, 1]
    return records
