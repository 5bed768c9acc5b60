"""Bundler's `bundle.out` (version 0.3), with `list.txt` of image names beside it: text that many programs after it read.

For each camera the file holds the focal length, k1, k2, R and t; for each point its place, its colour and where it is seen.
The camera looks down its negative z axis, image y points up, and image points are relative to the centre of the image, which is
the principal point. Here cameras look along positive z and image y points down: half a turn about the x axis, done here. A
camera of zeros is an image without a pose.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchsfm.formats.joining import Lens, Rows, centred_cameras, picture_size, reading, symmetric_size, track_rows
from torchsfm.geometry import Radial
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import write_whole_files
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HEADER = "# Bundle file v0.3"
LIST = "list.txt"
TURN = np.diag([1.0, -1.0, -1.0])


@on_the_cpu
def write_bundler(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write a model as Bundler's text, and the names of its images as `list.txt` beside it.

    Args:
        reconstruction: The model. Distortion none, `SimpleRadial` or `Radial`.
        path: The file to write; its folder must be there.

    Raises:
        ValueError: Bundler cannot hold these cameras: a principal point that is not the centre of the image, skew, pixels that
            are not square, or other distortion; or a name with a line break.
        OSError: A file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> torchsfm.write_bundler(torchsfm.formats.undistorted_model(model, centred=True), "bundle.out")
        >>> from pathlib import Path
        >>> Path("bundle.out").read_text().splitlines()[0]
        '# Bundle file v0.3'
    """
    path = Path(path)
    model, f, centre = centred_cameras(reconstruction, "Bundler", Radial)
    if odd := [name for name in model.names if "\n" in name or "\r" in name]:
        raise ValueError(f"list.txt cannot hold the name {odd[0]!r}")
    lens = model.cameras.distortion
    zero = np.zeros(len(f))
    k1, k2 = (getattr(lens, name).numpy() if name in lens.parameter_names else zero for name in ("k1", "k2"))
    R, t = TURN @ model.poses.R.numpy(), model.poses.t.numpy() @ TURN
    lines = [HEADER, f"{len(model.names)} {model.num_points}"]
    for i, (posed, camera) in enumerate(zip(model.registered.tolist(), model.camera_index.tolist(), strict=True)):
        rows = [(f[camera], k1[camera], k2[camera]), *R[i], t[i]] if posed else [np.zeros(3)] * 5
        lines += [" ".join(map(str, map(float, row))) for row in rows]
    x = (model.x.numpy() - centre[model.view.numpy()]) * [1, -1]
    for row in track_rows(model, x):
        lines += row
    names = "".join(f"{name}\n" for name in model.names).encode("utf-8", "surrogateescape")
    text = "\n".join([*lines, ""]).encode("ascii")
    write_whole_files({path.with_name(LIST): names, path: text})


@on_the_cpu
def read_bundler(path: str | Path) -> Reconstruction:
    """Read a model from Bundler's text.

    Args:
        path: The file; names are those of `list.txt` beside it, else numbers.

    Returns:
        The model, in float64, with a camera for each image. The size of an image is that of its file where it lies beside, else
        the least around the centre that its observations need, as the format does not tell it. Colours have 8 bits.

    Raises:
        ValueError: The file is none such, or a damaged one; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.formats.undistorted_model(torchsfm.read_model("model.npz"), centred=True)
        >>> torchsfm.write_bundler(model, "bundle.out")
        >>> torchsfm.read_bundler("bundle.out").X.shape
        torch.Size([20, 3])
    """
    path = Path(path)
    with reading(path, "a Bundler file"):
        header, _, body = path.read_bytes().partition(b"\n")
        if header.strip().decode("ascii", "replace") != HEADER:
            raise ValueError(f"wanted the first line {HEADER!r}")
        table = np.array(body.split(), dtype=np.float64)
        v, n = _counts(table[:2])
        cameras = _part(table, 2, 15 * v).reshape(v, 15)
        place = 2 + 15 * v
        # A point has seven numbers at least: no room is made for more points than there can be.
        _part(table, place, 7 * n)
        head = np.empty((n, 6))
        parts: list[NDArray[np.float64]] = []
        for k in range(n):
            head[k] = _part(table, place, 6)
            (count,) = _counts(_part(table, place + 6, 1))
            parts.append(_part(table, place + 7, 4 * count).reshape(count, 4))
            place += 7 + 4 * count
        if place != len(table):
            raise ValueError(f"{len(table) - place} numbers too many")
        seen = np.concatenate([np.empty((0, 4)), *parts])
        if not np.isfinite(seen).all() or (seen[:, 0] != np.floor(seen[:, 0])).any():
            raise ValueError("an observation is not finite, or of no image")
        view, x = seen[:, 0].astype(np.int64), seen[:, 2:] * [1, -1]
        names = _names(path.with_name(LIST), v)
        rows = Rows(X=head[:, :3], color=head[:, 3:] / 255, view=view, point=np.repeat(np.arange(n), [len(p) for p in parts]))
        centres = np.zeros((v, 2))
        for i, camera in enumerate(cameras):
            size = picture_size(path.parent / names[i]) or symmetric_size(x[view == i])
            centres[i] = (np.array(size) - 1) / 2
            posed = camera[0] != 0
            focal = float(camera[0]) if posed else float(max(size))
            numbers = {"k1": float(camera[1]), "k2": float(camera[2])} if posed else {}
            rows.lenses.append(Lens((focal, focal), (float(centres[i, 0]), float(centres[i, 1])), Radial, numbers))
            R = TURN @ camera[3:12].reshape(3, 3)
            rows.add_image(names[i], size, i, R if posed else None, TURN @ camera[12:] if posed else None)
        if len(view) and not (view.min() >= 0 and view.max() < v):
            raise ValueError(f"there is no image {view.max()} among {v}")
        rows.x = x + centres[view]
        return rows.join()


def _counts(values: NDArray[np.float64]) -> list[int]:
    if not len(values) or not (np.isfinite(values) & (values >= 0) & (values == np.floor(values)) & (values < 2**40)).all():
        raise ValueError("wanted a number of entries")
    return [int(value) for value in values]


def _part(table: NDArray[np.float64], start: int, count: int) -> NDArray[np.float64]:
    if start + count > len(table):
        raise ValueError("it ends too early")
    return table[start : start + count]


def _names(path: Path, count: int) -> list[str]:
    """The names of the images, behind which some programs put a focal length."""
    if not path.is_file():
        return [f"{k:06d}" for k in range(count)]
    lines = path.read_bytes().decode("utf-8", "surrogateescape").split("\n")
    names = [
        re.sub(r"\s+0(\s+\d+(\.\d*)?)?$", "", line.removesuffix("\r")).removeprefix("./") for line in lines if line.strip()
    ]
    if len(names) != count:
        raise ValueError(f"{LIST} names {len(names)} images of {count}")
    return names
