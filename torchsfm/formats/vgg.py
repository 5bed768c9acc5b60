"""The multi-view data sets of the Visual Geometry Group, Oxford: points, line segments and cameras of a few views, as text."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.devices import on_the_cpu


@dataclass(frozen=True)
class VggScene:
    """Matched points and line segments of several views, float64, with the cameras and structure published with them.

    Attributes:
        x: Image points; 0 where not visible.
        visible: Which points were matched in which view.
        P: Camera matrices. Signs are as published: det P[:, :3] may be negative.
        X: Points in space.
        segments: Image line segments, end points as (x, y) pairs; 0 where not visible. Ends need not
            correspond between views.
        segments_visible: Which lines were matched in which view.
        L: Line segments in space, their end points.

    Example:
        >>> import os, torchsfm
        >>> files = {"2D/a.000.corners": "320 240", "2D/a.001.corners": "240 240"}
        >>> files |= {"2D/a.nview-corners": "0 0", "3D/a.p3d": "0 0 5"}
        >>> files |= {f"3D/a.00{i}.P": f"400 0 320 {-400 * i} / 0 400 240 0 / 0 0 1 0" for i in range(2)}
        >>> for name, text in files.items():
        ...     os.makedirs(os.path.dirname(name), exist_ok=True)
        ...     with open(name, "w") as file:
        ...         size = file.write(text.replace(" / ", os.linesep))
        ...
        >>> scene = torchsfm.formats.read_vgg(".")
        >>> torchsfm.project_points(scene.P, scene.X)[scene.visible]  # the truth in both images
        tensor([[320., 240.],
                [240., 240.]], dtype=torch.float64)
    """

    x: Float[Tensor, "v n 2"]
    visible: Bool[Tensor, "v n"]
    P: Float[Tensor, "v 3 4"]
    X: Float[Tensor, "n 3"]
    segments: Float[Tensor, "v k 2 2"]
    segments_visible: Bool[Tensor, "v k"]
    L: Float[Tensor, "k 2 3"]


@on_the_cpu
def read_vgg(folder: str | Path) -> VggScene:
    """Read a data set with subfolders 2D and 3D, as "Model House", "Corridor", "Merton College" or "Wadham College".

    Args:
        folder: The folder of one data set. Where no lines come with it, there are none in the result.

    Returns:
        Points, lines and cameras, views in the order of their numbers.

    Raises:
        ValueError: A file is missing or damaged, or holds a number that is not finite; one line that says which.

    Example:
        >>> import os, torchsfm
        >>> files = {"2D/a.000.corners": "320 240", "2D/a.001.corners": "240 240"}
        >>> files |= {"2D/a.nview-corners": "0 0", "3D/a.p3d": "0 0 5"}
        >>> files |= {f"3D/a.00{i}.P": f"400 0 320 {-400 * i} / 0 400 240 0 / 0 0 1 0" for i in range(2)}
        >>> for name, text in files.items():
        ...     os.makedirs(os.path.dirname(name), exist_ok=True)
        ...     with open(name, "w") as file:
        ...         size = file.write(text.replace(" / ", os.linesep))
        >>> scene = torchsfm.formats.read_vgg(".")
        >>> torchsfm.triangulate_points(scene.x, scene.P, visible=scene.visible).model
        tensor([[0., 0., 5.]], dtype=torch.float64)
    """
    folder = Path(folder)
    corners = sorted((folder / "2D").glob("*.corners"))
    cameras = sorted((folder / "3D").glob("*.P")) or sorted((folder / "2D").glob("*.P"))
    if not corners or len(corners) != len(cameras):
        raise ValueError(f"{folder}: wanted as many cameras (*.P) as views (2D/*.corners), got {len(cameras)}, {len(corners)}")
    matrices = [_numbers(path, 4) for path in cameras]
    for path, matrix in zip(cameras, matrices, strict=True):
        if len(matrix) != 3:
            raise ValueError(f"{path}: wanted three rows of four numbers, got {len(matrix)}")
    P = torch.stack(matrices)
    x, visible = _matched(folder, corners, "corners", 2)
    X = _numbers(_single(folder / "3D", "p3d"), 3)
    lines = sorted((folder / "2D").glob("*.lines"))
    if lines:
        ends, seen = _matched(folder, lines, "lines", 4)
        L = _numbers(_single(folder / "3D", "l3d"), 6).reshape(-1, 2, 3)
    else:
        ends, seen = x.new_zeros(len(P), 0, 4), visible[:, :0]
        L = x.new_zeros(0, 2, 3)
    for name, flat, found in (("points", X, visible), ("lines", L, seen)):
        if len(flat) != found.shape[1]:
            raise ValueError(f"{folder}: wanted as many {name} in 3D as in 2D, got {len(flat)} and {found.shape[1]}")
    return VggScene(x, visible, P, X, ends.reshape(*ends.shape[:2], 2, 2), seen, L)


def _single(folder: Path, ending: str) -> Path:
    """The file `name.ending` or `ending` of a folder."""
    found = [*folder.glob(f"*.{ending}"), *folder.glob(ending)]
    if len(found) != 1:
        raise ValueError(f"{folder}: wanted one file *{ending}, got {len(found)}")
    return found[0]


def _numbers(path: Path, columns: int) -> Tensor:
    """The first numbers of every line."""
    try:
        rows = [[float(word) for word in line.split()[:columns]] for line in path.read_text().splitlines() if line.strip()]
        table = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    except (ValueError, UnicodeDecodeError, OSError) as error:
        raise ValueError(f"{path}: wanted {columns} numbers on every line ({error})") from None
    if not np.isfinite(table).all():
        raise ValueError(f"{path}: line {int(np.isfinite(table).all(1).argmin()) + 1} of numbers is not finite")
    return torch.from_numpy(table)


def _matched(folder: Path, paths: list[Path], kind: str, columns: int) -> tuple[Tensor, Tensor]:
    """The features of all views in the order of the table of matches, and which of them there are."""
    table = _single(folder / "2D", f"nview-{kind}")
    index = np.empty((0, len(paths)), np.int64)
    try:
        rows = [[-1 if word == "*" else int(word) for word in line.split()] for line in table.read_text().splitlines()]
        if any(rows):
            index = np.array([row for row in rows if row], dtype=np.int64)
        if index.shape[1:] != (len(paths),):
            raise ValueError(f"got {index.shape[-1]}")
    except (ValueError, OverflowError, OSError) as error:
        raise ValueError(f"{table}: wanted {len(paths)} numbers on every line ({error})") from None
    if (index < -1).any():
        raise ValueError(f"{table}: feature {index.min()} is none")
    columns_of = []
    for path, numbers in zip(paths, torch.from_numpy(index.T.copy()), strict=True):
        features = _numbers(path, columns)
        if len(numbers) and int(numbers.max()) >= len(features):
            raise ValueError(f"{table}: feature {int(numbers.max())} is not in {path.name}, which has {len(features)}")
        padded = torch.cat((features.new_zeros(1, columns), features))
        columns_of.append(padded[numbers.clamp_min(-1) + 1])
    return torch.stack(columns_of), torch.from_numpy(index.T >= 0)
