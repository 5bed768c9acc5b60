"""Trajectories for tools of SLAM such as evo: where the cameras were, in the text forms of TUM and KITTI.

Both hold world from camera. TUM: `timestamp x y z qx qy qz qw` a line; KITTI: the twelve numbers of a 3x4 matrix, row by row.
"""

from collections.abc import Iterable
from pathlib import Path

import torch

from torchsfm.geometry import quaternion_wxyz_from_rotation
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction


@on_the_cpu
def write_tum(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the poses in the form of TUM, with the number of the image as its time; images without a pose have no line.

    Args:
        reconstruction: The model with the poses.
        path: The file to write.

    Raises:
        OSError: The file cannot be written.

    Example:
        >>> from pathlib import Path
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_tum(torchsfm.read_model("model.npz"), "poses.txt")
        >>> len(Path("poses.txt").read_text().splitlines()[0].split())  # time, centre, quaternion x y z w
        8
    """
    poses, registered = reconstruction.poses, reconstruction.registered
    quaternion = quaternion_wxyz_from_rotation(poses.R.mT.double())
    rows = torch.cat([poses.centre.double(), quaternion[:, 1:], quaternion[:, :1]], 1)[registered]
    times = registered.nonzero()[:, 0].tolist()
    _write(path, [(float(time), *row) for time, row in zip(times, rows.tolist(), strict=True)])


@on_the_cpu
def write_kitti(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the poses in the form of KITTI, a line for each image that has one; the lines tell no names and no times.

    Args:
        reconstruction: The model with the poses.
        path: The file to write.

    Raises:
        OSError: The file cannot be written.

    Example:
        >>> from pathlib import Path
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_kitti(torchsfm.read_model("model.npz"), "poses.txt")
        >>> len(Path("poses.txt").read_text().splitlines()[0].split())  # a row for each image: [R | t] of world from camera
        12
    """
    poses = reconstruction.poses
    rows = torch.cat([poses.R.mT, poses.centre[..., None]], -1).double()[reconstruction.registered]
    _write(path, rows.flatten(1).tolist())


def _write(path: str | Path, rows: Iterable[Iterable[float]]) -> None:
    with whole_file(path) as file:
        file.writelines(" ".join(map(str, row)).encode() + b"\n" for row in rows)
