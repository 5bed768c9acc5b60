"""VisualSFM's `.nvm` (NVM_V3): text with cameras, points and observations.

A camera is the name of its image, focal length, rotation as quaternion w, x, y, z (world to camera), centre and one number of
radial distortion; y points down, and image points are relative to the principal point, which is the centre of the image. That
number undistorts image points where this library's distort, and there is no equal: files that have it are refused, and none
is written. Blanks in names are written as `"`.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from torchsfm.formats.joining import (
    Lens,
    Rows,
    centred_cameras,
    numbers,
    picture_size,
    reading,
    symmetric_size,
    track_rows,
)
from torchsfm.formats.pictures import registered_only
from torchsfm.geometry import NoDistortion, quaternion_wxyz_from_rotation, rotation_from_quaternion_wxyz
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HEADER = "NVM_V3"


@on_the_cpu
def write_nvm(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write a model as NVM_V3. Images without a pose are left out.

    Args:
        reconstruction: The model, of pinhole cameras.
        path: The file to write.

    Raises:
        ValueError: The format cannot hold these cameras: distortion, a principal point that is not the centre of the image,
            skew, or pixels that are not square; or a name with a tab, a quotation mark or a line break.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> torchsfm.write_nvm(torchsfm.formats.undistorted_model(model, centred=True), "model.nvm")
        >>> from pathlib import Path
        >>> Path("model.nvm").read_text().splitlines()[0]
        'NVM_V3'
    """
    model, f, centre = centred_cameras(registered_only(reconstruction), "NVM", NoDistortion)
    if odd := [name for name in model.names if any(c in name for c in '\n\r\t"') or not name]:
        raise ValueError(f"NVM cannot hold the name {odd[0]!r}")
    motions = np.concatenate([quaternion_wxyz_from_rotation(model.poses.R).numpy(), model.poses.centre.numpy()], 1)
    lines = [HEADER, "", str(len(model.names))]
    for name, camera, row in zip(model.names, model.camera_index.tolist(), motions.tolist(), strict=True):
        lines.append(" ".join([name.replace(" ", '"'), str(float(f[camera])), *map(str, row), "0", "0"]))
    lines += ["", str(model.num_points)]
    x = model.x.numpy() - centre[model.view.numpy()]
    lines += [" ".join(row) for row in track_rows(model, x)]
    with whole_file(path) as file:
        file.write("\n".join([*lines, "", "0", ""]).encode("utf-8", "surrogateescape"))


@on_the_cpu
def read_nvm(path: str | Path) -> Reconstruction:
    """Read the first model of an NVM_V3 file.

    Args:
        path: The file.

    Returns:
        The model, in float64, with a camera for each image. The size of an image is that of its file where it lies beside, else
        the least around the centre that its observations need, as the format does not tell it.

    Raises:
        ValueError: The file is none such, a damaged one, or has radial distortion or the calibration `FixedK`; one line.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.formats.undistorted_model(torchsfm.read_model("model.npz"), centred=True)
        >>> torchsfm.write_nvm(model, "model.nvm")
        >>> torchsfm.read_nvm("model.nvm").X.shape
        torch.Size([20, 3])
    """
    path = Path(path)
    text = path.read_bytes().decode("utf-8", "surrogateescape")
    with reading(path, "an NVM file that can be read"):
        lines = iter([line.strip() for line in text.split("\n") if line.strip() and not line.startswith("#")])
        if next(lines).split() != [HEADER]:
            raise ValueError(f"wanted the first line {HEADER} and nothing else on it")
        names, cameras = [], []
        for _ in range(_count(lines)):
            name, *words = next(lines).split()
            names.append(name.replace('"', " "))
            cameras.append(numbers([float(word) for word in words[:9]], 9))
            if cameras[-1][8] != 0:
                raise ValueError("it has radial distortion in a form that has no equal here")
        X, seen, lengths = [], [], []
        for _ in range(_count(lines)):
            words = next(lines).split()
            X.append([float(word) for word in words[:6]])
            lengths.append(int(words[6]))
            if len(words) != 7 + 4 * lengths[-1]:
                raise ValueError(f"a point of {lengths[-1]} observations has {len(words)} words")
            seen.append(np.array(words[7:], dtype=np.float64).reshape(-1, 4))
        points, table = numbers(X, -1, 6), numbers(np.concatenate([np.empty((0, 4)), *seen]), -1, 4)
        view, x = table[:, 0].astype(np.int64), table[:, 2:]
        if len(view) and not (view.min() >= 0 and view.max() < len(names)):
            raise ValueError(f"there is no image {view.max()} among {len(names)}")
        rows = Rows(X=points[:, :3], color=points[:, 3:] / 255, view=view, point=np.repeat(np.arange(len(X)), lengths))
        centres = np.zeros((len(names), 2))
        for i, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            size = picture_size(path.parent / name) or symmetric_size(x[view == i])
            centres[i] = (np.array(size) - 1) / 2
            rows.lenses.append(Lens((camera[0], camera[0]), (centres[i, 0], centres[i, 1]), NoDistortion))
            if not 1e-6 < np.linalg.norm(camera[1:5]) < 1e6:
                raise ValueError("a pose that is none")
            R = rotation_from_quaternion_wxyz(torch.from_numpy(camera[1:5])).numpy()
            rows.add_image(name, size, i, R, -R @ camera[5:8])
        rows.x = x + centres[view]
        return rows.join()


def _count(lines: Iterator[str]) -> int:
    count = int(next(lines))
    if count < 0:
        raise ValueError("a negative number of entries")
    return count
