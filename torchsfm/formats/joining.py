"""What readers have in common: cameras of several models become one batch, and rows of a file become a model."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchsfm.geometry import (
    DISTORTION_MODELS,
    Camera,
    Distortion,
    KannalaBrandt,
    Pose,
    intrinsics,
    quaternion_wxyz_from_rotation,
    rotation_from_quaternion_wxyz,
)
from torchsfm.images.exif import parse_exif
from torchsfm.images.headers import image_size
from torchsfm.reconstruction.model.reconstruction import Reconstruction

MAX_SIDE = 2**31
GREY = 0.5
"""Of points whose colour a file does not tell."""


@dataclass(frozen=True)
class Lens:
    """The inside of one camera in pixels, the centre of the top-left pixel at (0, 0)."""

    f: tuple[float, float]
    c: tuple[float, float]
    kind: type[Distortion]
    numbers: Mapping[str, float] = field(default_factory=dict)
    """Of its distortion by their names; those not named are 0."""

    @classmethod
    def simplest(cls, f: tuple[float, float], c: tuple[float, float], numbers: Mapping[str, float]) -> "Lens":
        """With the simplest model of distortion, other than a fisheye's, that has the numbers which are not 0.

        Raises:
            ValueError: No model has them.
        """
        needed = {name for name, value in numbers.items() if value != 0}
        for kind in DISTORTION_MODELS.values():
            if kind is not KannalaBrandt and needed <= set(kind.parameter_names):
                return cls(f, c, kind, {name: numbers[name] for name in needed})
        raise ValueError(f"a camera with distortion {', '.join(sorted(needed))}, which has no equal here")


def join_cameras(lenses: Sequence[Lens]) -> Camera:
    """One batch of cameras, in double precision, of the first distortion model that holds them all.

    Raises:
        ValueError: There is none, or a camera has a focal length that is not positive or a number that is not finite.
    """
    for lens in lenses:
        if not all(map(math.isfinite, (*lens.f, *lens.c, *lens.numbers.values()))) or min(lens.f) <= 0:
            raise ValueError("a camera has a focal length that is not positive, or a number that is not finite")
    if not lenses:
        return Camera(torch.zeros(0, 3, 3, dtype=torch.float64))
    kinds = {lens.kind for lens in lenses}
    common = [model for model in DISTORTION_MODELS.values() if all(model.includes(kind) for kind in kinds)]
    if not common:
        mixed = " and ".join(sorted(kind.__name__ for kind in kinds))
        raise ValueError(f"the model mixes {mixed} cameras, which one batch of cameras cannot hold")
    f = torch.tensor([lens.f for lens in lenses], dtype=torch.float64)
    c = torch.tensor([lens.c for lens in lenses], dtype=torch.float64)
    rows = [[lens.numbers.get(name, 0.0) for name in common[0].parameter_names] for lens in lenses]
    numbers = torch.tensor(rows, dtype=torch.float64)
    return Camera(intrinsics(f[:, 0], c, aspect=f[:, 1] / f[:, 0]), common[0].from_parameters(numbers))


def cameras_within(cameras: Camera, lens: type[Distortion]) -> Camera | None:
    """The same cameras with a model of distortion that others have; None where a number that it lacks is not 0."""
    own = cameras.distortion
    if lens.includes(type(own)):
        return cameras
    names = lens.parameter_names
    if not type(own).includes(lens) or any(bool((getattr(own, k) != 0).any()) for k in set(own.parameter_names) - set(names)):
        return None
    return Camera(cameras.K, lens(**{name: getattr(own, name) for name in names}))


@dataclass
class Rows:
    """What a file says, row by row; `join` makes the model of it."""

    names: list[str] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)
    lenses: list[Lens] = field(default_factory=list)
    camera: list[int] = field(default_factory=list)
    """Which of the lenses took each image."""
    R: list[NDArray[np.float64] | None] = field(default_factory=list)
    """Rotation, world to camera, of each image; None where it has no pose."""
    t: list[NDArray[np.float64]] = field(default_factory=list)
    X: ArrayLike = ()
    color: ArrayLike | None = None
    """Red, green, blue in [0, 1]."""
    x: ArrayLike = ()
    view: ArrayLike = ()
    point: ArrayLike = ()

    def add_image(
        self, name: str, size: tuple[int, int], camera: int, R: NDArray[np.float64] | None, t: NDArray[np.float64] | None
    ) -> None:
        """One more image, with a pose unless that is None."""
        self.names.append(name)
        self.sizes.append(size)
        self.camera.append(camera)
        self.R.append(R if t is not None else None)
        self.t.append(np.zeros(3) if t is None else t)

    def join(self) -> Reconstruction:
        """The model.

        Raises:
            ValueError: A rotation is none, a number is not finite, or an index points at what is not there.
        """
        cameras = join_cameras(self.lenses)
        v = len(self.names)
        registered = torch.tensor([R is not None for R in self.R], dtype=torch.bool)
        R = np.stack([np.eye(3) if R is None else R for R in self.R]) if v else np.empty((0, 3, 3))
        t = np.array(self.t, dtype=np.float64).reshape(v, 3)
        X = np.array(self.X, dtype=np.float64).reshape(-1, 3)
        color = np.full_like(X, GREY) if self.color is None else np.array(self.color, dtype=np.float64).reshape(-1, 3)
        x = np.array(self.x, dtype=np.float64).reshape(-1, 2)
        view, point = (np.array(index, dtype=np.int64).reshape(-1) for index in (self.view, self.point))
        if len(color) != len(X):
            raise ValueError(f"{len(X)} points have {len(color)} colours")
        if not len(x) == len(view) == len(point):
            raise ValueError("observations lack a place, an image or a point")
        camera = np.array(self.camera, dtype=np.int64).reshape(v)
        for what, index, limit in (("camera", camera, len(self.lenses)), ("image", view, v), ("point", point, len(X))):
            if len(index) and not (index.min() >= 0 and index.max() < limit):
                raise ValueError(f"there is no {what} {index.min() if index.min() < 0 else index.max()} among {limit}")
        for what, numbers in (("pose", R), ("pose", t), ("point", X), ("observation", x), ("colour", color)):
            if not np.isfinite(numbers).all():
                raise ValueError(f"a {what} is not finite")
        if any(not 0 < side < MAX_SIDE for size in self.sizes for side in size):
            raise ValueError("an image has a size that is none")
        # An observation in an image without a pose is of no use.
        posed = registered.numpy()[view]
        x, view, point = x[posed], view[posed], point[posed]
        order = np.lexsort((view, point))
        return Reconstruction(
            names=tuple(self.names),
            image_size=torch.tensor(self.sizes, dtype=torch.long).reshape(v, 2),
            cameras=cameras,
            camera_index=torch.from_numpy(camera),
            poses=Pose(nearby_rotation(R), torch.from_numpy(t)),
            registered=registered,
            X=torch.from_numpy(X),
            color=torch.from_numpy(color).clamp(0, 1),
            x=torch.from_numpy(x[order]),
            view=torch.from_numpy(view[order]),
            point=torch.from_numpy(point[order]),
        )


def nearby_rotation(R: NDArray[np.float64]) -> Tensor:
    """Rotations from matrices that are rotations but for the digits of a file.

    Raises:
        ValueError: A matrix is no rotation.
    """
    gap = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max((-2, -1), initial=0)
    if (gap > 1e-3).any() or (np.linalg.det(R) < 0).any():
        raise ValueError("a pose has a matrix that is no rotation")
    return rotation_from_quaternion_wxyz(quaternion_wxyz_from_rotation(torch.from_numpy(R)))


def numbers(values: Any, *shape: int) -> NDArray[np.float64]:
    """Finite numbers of a given shape, where -1 stands for any number of rows.

    Raises:
        ValueError: They are not.
    """
    if isinstance(values, str):
        raise ValueError(f"wanted numbers, got {values[:40]!r}")
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, OverflowError) as error:
        raise ValueError(f"wanted numbers ({str(error)[:60]})") from None
    if shape[:1] == (-1,) and array.size == 0:
        array = array.reshape(0, *shape[1:])
    if array.ndim != len(shape) or any(size not in (-1, found) for size, found in zip(shape, array.shape, strict=True)):
        raise ValueError(f"wanted numbers of shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Say in one line which file is not what it should be."""
    try:
        # What is not finite in the end is found in the end.
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError, StopIteration) as error:
        detail = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: not {what} ({' '.join(detail.split())[:120] or 'it ends too early'})") from None


def centred_cameras(
    model: Reconstruction, format: str, lens: type[Distortion]
) -> tuple[Reconstruction, NDArray[np.float64], NDArray[np.float64]]:
    """A model for a format that has one focal length a camera, and the principal point at the centre of the image.

    Returns:
        The model in double precision, the focal length of each camera, and the centre of each image.

    Raises:
        ValueError: A camera is not so, or has distortion that is no case of `lens`.
    """
    cameras = cameras_within(model.cameras, lens)
    if cameras is None:
        wanted, kind = ", ".join(lens.parameter_names) or "no distortion", type(model.cameras.distortion).__name__
        raise ValueError(f"{format} holds {wanted}, not {kind}; undistorted pictures have none")
    model = replace(model, cameras=cameras).to("cpu", torch.float64)
    K = model.cameras.K[model.camera_index]
    centre = (model.image_size.double() - 1) / 2
    if bool((K[:, 0, 1].abs() > 1e-9 * K[:, 0, 0]).any()) or bool(((K[:, 1, 1] - K[:, 0, 0]).abs() > 1e-9 * K[:, 0, 0]).any()):
        raise ValueError(f"{format} has one focal length a camera, and these pixels are not square")
    if bool(((K[:, :2, 2] - centre).abs() > 1e-6).any()):
        raise ValueError(f"{format} has the principal point at the centre of the image; undistort the pictures, centred")
    return model, model.cameras.K[:, 0, 0].numpy(), centre.numpy()


def running_numbers(view: Tensor) -> list[int]:
    """A number for each observation: how many there were before in the same image."""
    order = torch.argsort(view, stable=True)
    counts = torch.bincount(view)
    number = torch.empty_like(view)
    number[order] = torch.arange(len(view)) - (counts.cumsum(0) - counts)[view[order]]
    return list(number.tolist())


def track_rows(model: Reconstruction, x: NDArray[np.float64]) -> Iterator[tuple[str, str, str]]:
    """Of each point its place, its colour from 0 to 255, and its number of observations with image, number there and place.

    Args:
        model: The model.
        x: The observations in the file's coordinates.
    """
    columns = zip(model.view.tolist(), running_numbers(model.view), x.tolist(), strict=True)
    seen = [f"{view} {key} {a} {b}" for view, key, (a, b) in columns]
    color = (model.color.clamp(0, 1) * 255).round().int().tolist()
    end = 0
    for X, rgb, count in zip(model.X.tolist(), color, model.track_lengths().tolist(), strict=True):
        start, end = end, end + count
        yield " ".join(map(str, X)), " ".join(map(str, rgb)), " ".join([str(count), *seen[start:end]])


def symmetric_size(x: NDArray[np.float64]) -> tuple[int, int]:
    """The least odd size of an image that holds points given relative to its centre."""
    reach = np.abs(x).max(0, initial=0).clip(max=MAX_SIDE / 4)
    return 2 * int(np.ceil(reach[0])) + 1, 2 * int(np.ceil(reach[1])) + 1


def picture_size(path: Path) -> tuple[int, int] | None:
    """Width and height of the upright picture in a file, where there is one."""
    try:
        if not path.is_file():
            return None
        data = path.read_bytes()
    except (OSError, ValueError):
        return None
    size = image_size(data)
    return size if size is None or parse_exif(data).orientation < 5 else size[::-1]
