"""BAL: the problems of Bundle Adjustment in the Large (Agarwal et al. 2010), as text, plain or packed by gzip or bzip2.

A file holds the numbers of cameras, points and observations; for each observation the camera, the point and x, y; for each
camera nine numbers (rotation vector, translation, focal length, k1, k2); for each point three. The camera looks down its
negative z axis, image y points up, and the principal point is the origin of the image. Here cameras look along positive z and
image y points down: half a turn about the x axis, done here and nowhere else. No number is lost by it, either way.
"""

import bz2
import gzip
import os
import zlib
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torchsfm.formats.joining import cameras_within
from torchsfm.geometry import (
    BundleProblem,
    Camera,
    Pose,
    Radial,
    intrinsics,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import FREE_BYTES, MAX_RATIO, whole_file

OPENERS: dict[str, Any] = {".gz": gzip.open, ".bz2": bz2.open}


@on_the_cpu
def read_bal(path: str | Path) -> BundleProblem:
    """Read a problem of Bundle Adjustment in the Large.

    Args:
        path: Text file; the endings .gz and .bz2 say that it is packed.

    Returns:
        Poses, cameras (one for each view, with `Radial` distortion and principal point 0), points and observations in the
        order of the file, float64. Image points are relative to the principal point.

    Raises:
        ValueError: The file is not a BAL problem, ends too early, has a camera or a point that is not finite, or was packed to
            fill the memory; one line that says where. Image points that are not finite are kept: adjustment leaves them out.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_bal(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "problem.txt")
        >>> problem = torchsfm.read_bal("problem.txt")
        >>> problem.poses.shape, problem.X.shape, problem.x.shape
        (torch.Size([3]), torch.Size([20, 3]), torch.Size([50, 2]))
    """
    path = Path(path)
    words = _unpack(path).split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: not a BAL problem ({str(error)[:80]})") from None
    if len(numbers) < 3 or not _are_counts(numbers[:3]):
        raise ValueError(f"{path}: not a BAL problem (wanted the numbers of cameras, points and observations first)")
    v, n, m = (int(k) for k in numbers[:3])
    wanted = 3 + 4 * m + 9 * v + 3 * n
    if len(numbers) != wanted:
        kind = "truncated" if len(numbers) < wanted else "too long"
        what = f"{v} cameras, {n} points and {m} observations take {wanted} numbers"
        raise ValueError(f"{path}: {kind}: {what}, the file has {len(numbers)}")
    for first, width, count, name in ((3 + 4 * m, 9, v, "camera"), (3 + 4 * m + 9 * v, 3, n, "point")):
        finite = np.isfinite(numbers[first : first + width * count].reshape(count, width)).all(1)
        if not finite.all():
            raise ValueError(f"{path}: {name} {int(finite.argmin())} is not finite")
    observations = numbers[3 : 3 + 4 * m].reshape(m, 4)
    for column, limit, name in ((0, v, "cameras"), (1, n, "points")):
        index = observations[:, column]
        bad = ~((index >= 0) & (index < limit) & (index == np.floor(index)))
        if bad.any():
            first = int(bad.argmax())
            raise ValueError(f"{path}: observation {first}: there is no number {index[first]:g} among {limit} {name}")
    rest = torch.tensor(numbers[3 + 4 * m :])
    camera, X = rest[: 9 * v].reshape(v, 9), rest[9 * v :].reshape(n, 3).clone()
    R = rotation_from_rotvec(camera[:, :3])
    turned = R.isfinite().flatten(1).all(1)
    if not bool(turned.all()):
        raise ValueError(f"{path}: camera {int(turned.int().argmin())} is turned by an angle that is none")
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    seen = torch.tensor(observations)
    view, point = seen[:, 0].long(), seen[:, 1].long()
    return BundleProblem(
        Pose(flip[:, None] * R, flip * camera[:, 3:6]),
        Camera(intrinsics(camera[:, 6], camera.new_zeros(v, 2)), Radial(camera[:, 7].clone(), camera[:, 8].clone())),
        torch.arange(v),
        X,
        seen[:, 2:] * flip[:2],
        view,
        point,
    )


@on_the_cpu
def write_bal(problem: BundleProblem, path: str | Path) -> None:
    """Write a problem as BAL text, with all digits; what `read_bal` then reads projects to the same residuals.

    Cameras that several views share are written once for each of them. Image points are written relative to the principal
    point, which BAL does not have.

    Args:
        problem: Poses, cameras, points and observations; distortion none, `SimpleRadial` or `Radial`.
        path: Text file; the endings .gz and .bz2 pack it.

    Raises:
        ValueError: BAL cannot hold these cameras: skew, pixels that are not square, or other distortion.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_bal(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "problem.txt")
        >>> from pathlib import Path
        >>> Path("problem.txt").read_text().splitlines()[0]  # images, points, observations
        '3 20 50'
    """
    path = Path(path)
    cameras = cameras_within(problem.cameras, Radial)
    if cameras is None:
        raise ValueError(f"problem: BAL holds two radial coefficients, not {type(problem.cameras.distortion).__name__}")
    K = cameras.K.detach().double().cpu()
    if bool((K[:, 0, 1] != 0).any()):
        raise ValueError("problem: BAL has no skew")
    if bool(((K[:, 1, 1] - K[:, 0, 0]).abs() > 1e-9 * K[:, 0, 0].abs()).any()):
        raise ValueError("problem: BAL has one focal length, and these pixels are not square")
    index, view = problem.camera_index.cpu(), problem.view.cpu()
    zero = torch.zeros(len(K), dtype=torch.float64)
    k1, k2 = (getattr(cameras.distortion, name, zero).detach().double().cpu() for name in ("k1", "k2"))
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    R, t = problem.poses.R.detach().double().cpu(), problem.poses.t.detach().double().cpu()
    lens = torch.stack((K[:, 0, 0], k1, k2), -1)[index]
    rows = torch.cat((rotvec_from_rotation(flip[:, None] * R), flip * t, lens), 1)
    x = (problem.x.detach().double().cpu() - K[index, :2, 2][view]) * flip[:2]
    with whole_file(path) as whole, _packing(path.suffix, whole) as file:
        file.write(f"{len(R)} {len(problem.X)} {len(x)}\n".encode())
        pairs = zip(view.tolist(), problem.point.tolist(), x.tolist(), strict=True)
        file.writelines(f"{i} {j} {a!r} {b!r}\n".encode() for i, j, (a, b) in pairs)
        for values in (rows, problem.X.detach().double().cpu()):
            file.writelines(f"{number!r}\n".encode() for number in _flat(values))


def _packing(suffix: str, file: BinaryIO) -> AbstractContextManager[BinaryIO]:
    """A file that packs what is written to it, where the ending of the name asks for that."""
    packed: AbstractContextManager[BinaryIO] = OPENERS[suffix](file, "wb") if suffix in OPENERS else nullcontext(file)
    return packed


def _unpack(path: Path) -> bytes:
    """The text of a file, unpacked if its name says that it is packed.

    Raises:
        ValueError: The archive is damaged, or unpacks to more than any problem does.
    """
    with path.open("rb") as packed:
        if path.suffix not in OPENERS:
            return packed.read()
        limit = max(FREE_BYTES, MAX_RATIO * os.fstat(packed.fileno()).st_size)
        try:
            with OPENERS[path.suffix](packed, "rb") as file:
                text: bytes = file.read(limit + 1)
        except (EOFError, zlib.error, OSError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise
            raise ValueError(f"{path}: damaged archive ({error})") from None
    if len(text) > limit:
        raise ValueError(f"{path}: not a BAL problem (it unpacks to more than {limit} bytes)")
    return text


def _flat(values: Tensor) -> list[float]:
    return list(values.flatten().tolist())


def _are_counts(numbers: npt.NDArray[np.float64]) -> bool:
    return bool(((numbers >= 0) & (numbers < 2**53) & (numbers == np.floor(numbers))).all())
