"""libmv problems: the binary files of Ceres' libmv bundle adjuster, made from Blender's camera tracker.

Layout, packed: one byte for the order of bytes ("v" little, "V" big endian), one for the unit of the markers ("P" pixels, "N"
normalised coordinates, with intrinsics to match); the intrinsics that all images share, eight floats (focal length, principal
point x, y, k1, k2, k3, p1, p2); the number of cameras, and for each its image number, R column by column and t; the number of
points, and for each its track number and X; the number of markers, and for each its image, its track, x and y. Integers and
floats have 32 bits.
"""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torchsfm.geometry import BrownConrady, BundleProblem, Camera, Pose, intrinsics
from torchsfm.linalg.devices import on_the_cpu


@on_the_cpu
def read_libmv(path: str | Path) -> BundleProblem:
    """Read a libmv problem: many frames of one camera.

    Args:
        path: Binary file.

    Returns:
        One camera with Brown-Conrady distortion, shared by all views; views and points in the order of the file, float64. The
        numbers are the file's, of single precision. Markers whose image has no camera or whose track has no point are left out.

    Raises:
        ValueError: The file is not a libmv problem, ends too early, or has a camera or point that is none; one line that says
            where. Markers that are not finite are kept: adjustment leaves them out.
        OSError: It cannot be read.

    Example:
        >>> import struct, torchsfm
        >>> data = b"vP" + struct.pack("<8f", 800, 320, 240, 0, 0, 0, 0, 0)  # focal length, principal point, k1, k2, k3, p1, p2
        >>> data += struct.pack("<2i12f", 1, 7, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 5)  # one camera, of image 7: R by columns, t
        >>> data += struct.pack("<2i3f", 1, 3, 0, 0, 0)  # one point, of track 3, at the origin
        >>> data += struct.pack("<3i2f", 1, 7, 3, 321, 240)  # one marker: image, track, pixels
        >>> with open("problem.bin", "wb") as file:
        ...     size = file.write(data)
        >>> problem = torchsfm.formats.read_libmv("problem.bin")
        >>> problem.x, problem.poses.centre + 0.0
        (tensor([[321., 240.]], dtype=torch.float64), tensor([[ 0.,  0., -5.]], dtype=torch.float64))
    """
    path = Path(path)
    data = path.read_bytes()
    if data[:1] not in (b"v", b"V") or data[1:2] not in (b"P", b"N"):
        raise ValueError(f"{path}: not a libmv problem (wanted the letter v or V first, then P or N)")
    order = "<" if data[:1] == b"v" else ">"
    (first,), offset = _take(path, data, 2, 1, [("intrinsics", "f4", 8)], order, "the intrinsics")
    tables = []
    for name, fields in (
        ("cameras", [("image", "i4"), ("R", "f4", (3, 3)), ("t", "f4", 3)]),
        ("points", [("track", "i4"), ("X", "f4", 3)]),
        ("markers", [("image", "i4"), ("track", "i4"), ("x", "f4", 2)]),
    ):
        (count,), offset = _take(path, data, offset, 1, [("count", "i4")], order, f"the number of {name}")
        table, offset = _take(path, data, offset, int(count["count"]), fields, order, name)
        tables.append(table)
    if offset != len(data):
        raise ValueError(f"{path}: too long: {len(data) - offset} bytes after the markers")
    cameras, points, markers = tables
    for name, numbers in (("image", cameras["image"]), ("track", points["track"])):
        if len(np.unique(numbers)) != len(numbers):
            raise ValueError(f"{path}: {name} numbers occur twice")
    lens = first["intrinsics"]
    if not np.isfinite(lens).all():
        raise ValueError(f"{path}: the intrinsics are not finite")
    # In double precision, where no product of two such numbers is too large.
    sound = np.isfinite(cameras["R"]).all((1, 2)) & np.isfinite(cameras["t"]).all(1)
    R = np.where(sound[:, None, None], cameras["R"], 0).astype(np.float64)
    sound &= (np.abs(R @ R.swapaxes(1, 2) - np.eye(3)) < 1e-3).all((1, 2)) & (np.linalg.det(R) > 0)
    for name, good in (("camera", sound), ("point", np.isfinite(points["X"]).all(1))):
        if not good.all():
            raise ValueError(f"{path}: {name} {int(good.argmin())} is not finite, or its R no rotation")
    view, has_view = _find(cameras["image"], markers["image"])
    point, has_point = _find(points["track"], markers["track"])
    keep = has_view & has_point
    f, cx, cy, k1, k2, k3, p1, p2 = _tensor(lens).unbind()
    return BundleProblem(
        Pose(_tensor(cameras["R"]).mT.contiguous(), _tensor(cameras["t"])),
        Camera(
            intrinsics(f[None], torch.stack((cx, cy))[None]),
            BrownConrady(k1[None], k2[None], p1[None], p2[None], k3[None]),
        ),
        torch.zeros(len(cameras), dtype=torch.int64),
        _tensor(points["X"]),
        _tensor(markers["x"][keep]),
        torch.from_numpy(view[keep]),
        torch.from_numpy(point[keep]),
    )


def _take(
    path: Path, data: bytes, offset: int, count: int, fields: list[Any], order: str, what: str
) -> tuple[npt.NDArray[Any], int]:
    """Records at an offset, and the offset after them."""
    record = np.dtype(fields).newbyteorder(">" if order == ">" else "<")
    end = offset + count * record.itemsize
    if count < 0:
        raise ValueError(f"{path}: the number of {what} is negative ({count})")
    if end > len(data):
        raise ValueError(f"{path}: truncated: {what} end at byte {end}, the file at {len(data)}")
    return np.frombuffer(data, record, count, offset), end


def _find(numbers: npt.NDArray[Any], wanted: npt.NDArray[Any]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Where each wanted number stands, and whether it is there at all."""
    if not len(numbers):
        return np.zeros(len(wanted), np.int64), np.zeros(len(wanted), np.bool_)
    sorter = np.argsort(numbers, kind="stable")
    place = sorter[np.searchsorted(numbers, wanted, sorter=sorter).clip(max=len(numbers) - 1)]
    return place.astype(np.int64), numbers[place] == wanted


def _tensor(values: npt.NDArray[Any]) -> Tensor:
    with np.errstate(invalid="ignore"):  # there are NaN that warn when they are copied
        return torch.from_numpy(values.astype(np.float64))
