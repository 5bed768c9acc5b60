"""The pictures that go with a model: undistorted with its cameras, or as they were taken."""

import os
import shutil
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import Camera
from torchsfm.images import ImageError, Photograph, parse_exif, read_image, save_image, undistort_images, undistorted_cameras
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.parts import with_images
from torchsfm.reconstruction.model.reconstruction import Reconstruction

KEPT = frozenset((".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm"))
"""Endings under which new pictures are saved; the others become PNG."""
BATCH_VALUES = 2**26
"""Pixels, of all channels, that are worked on at once."""


def registered_only(model: Reconstruction) -> Reconstruction:
    """The model without the images that have no pose."""
    return with_images(model, model.registered)


@on_the_cpu
def undistorted_model(model: Reconstruction, *, alpha: float = 0.0, centred: bool = False) -> Reconstruction:
    """The model as pinhole cameras in the same places would have found it.

    Args:
        model: The model.
        alpha: How much of the old pictures is to be seen, see `undistorted_cameras`.
        centred: Put principal points at the centre of the pictures.

    Returns:
        The same points, lines and poses, a camera for each camera and size of image, and the observations where they come to
        lie; image points outside of the new pictures are left out. Images without a pose are left out, too, and measured
        ellipses, which are other ones in the new pictures.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.formats.undistorted_model(torchsfm.read_model("model.npz"))
        >>> type(model.cameras.distortion).__name__
        'NoDistortion'
    """
    model = registered_only(model)
    keys = torch.cat([model.camera_index[:, None], model.image_size.to(model.camera_index.dtype)], -1)
    used, index = torch.unique(keys, dim=0, return_inverse=True)
    lenses = model.cameras[used[:, 0]]
    pinholes, size = undistorted_cameras(lenses, used[:, 1:], alpha=alpha, centred=centred)
    camera = index[model.view]
    x, there = _moved(model.x[:, None], lenses[camera], pinholes[camera])
    x = x[:, 0]
    shown = there & ((x >= -0.5) & (x < size[camera] - 0.5)).all(-1)
    lines = model.lines
    if lines is not None:
        ends, there = _moved(lines.x, lenses[index[lines.view]], pinholes[index[lines.view]])
        lines = replace(lines, x=ends).seen_where(there)
    conics = None if model.conics is None else model.conics.seen_where(torch.zeros_like(model.conics.view, dtype=torch.bool))
    curves = model.curves
    if curves is not None:
        arcs, there = _moved(curves.arcs(), lenses[index[curves.view]], pinholes[index[curves.view]])
        curves = curves.shown_as(arcs).seen_where(there)
    return replace(
        model, cameras=pinholes, camera_index=index, image_size=size[index], x=x[shown], view=model.view[shown],
        point=model.point[shown], lines=lines, conics=conics, curves=curves,
    )  # fmt: skip


def _moved(x: Float[Tensor, "k n 2"], lenses: Camera, pinholes: Camera) -> tuple[Float[Tensor, "k n 2"], Bool[Tensor, "k"]]:
    """Image points where other cameras in the same place show them, and where these show all of a row."""
    d, valid = lenses.unproject(x)
    return pinholes.project(d), (valid & (d[..., 2] > 0)).all(-1)


def picture_names(names: tuple[str, ...], *, kept: bool) -> tuple[str, ...]:
    """The names of new pictures: those of the photographs, with the ending `.png` where theirs cannot be kept.

    Raises:
        ValueError: A name leads out of the folder of the pictures, or two become one.
    """
    found = []
    for name in names:
        path = PurePosixPath(name.replace(os.sep, "/"))
        if path.is_absolute() or ".." in path.parts or not path.name or "\0" in name:
            raise ValueError(f"the image name {name!r} leads out of its folder")
        found.append(str(path if kept or path.suffix.lower() in KEPT else path.with_name(path.name + ".png")))
    if len(set(found)) < len(found):
        raise ValueError(f"two images have the name {next(name for i, name in enumerate(found) if name in found[:i])!r}")
    return tuple(found)


def write_pictures(
    model: Reconstruction,
    target: Reconstruction | None,
    source: Path,
    folder: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the pictures of a model, all upright.

    Args:
        model: The model, of which each image has a pose.
        target: What `undistorted_model` made of it, under the names of the new pictures; None to leave the pictures as they
            are.
        source: The folder in which the photographs lie under their names.
        folder: Where to; made if it is not there.
        progress: Called with the number of pictures written and of all.

    Raises:
        ImageError: A photograph is not there, cannot be read, or has another size than the model says.
        OSError: A picture cannot be written.
    """
    names = model.names if target is None else target.names
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    done = 0
    cameras = torch.zeros(len(names), dtype=torch.long) if target is None else target.camera_index
    groups: dict[int, list[int]] = defaultdict(list)
    for i, camera in enumerate(cameras.tolist()):
        groups[camera].append(i)
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        for camera, group in groups.items():
            width, height = model.image_size[group[0]].tolist()
            count = max(1, BATCH_VALUES // (3 * width * height))
            for batch in (group[k : k + count] for k in range(0, len(group), count)):
                if target is None:
                    list(pool.map(lambda i: _copy(source / names[i], folder / names[i], model.image_size[i].tolist()), batch))
                else:
                    read = pool.map(lambda i: _read(source / model.names[i], model.image_size[i].tolist()).pixels, batch)
                    lens = model.cameras[int(model.camera_index[group[0]])]
                    size = tuple(target.image_size[group[0]].tolist())
                    pictures = undistort_images(torch.stack(list(read)), lens, target.cameras[camera], size)
                    list(pool.map(lambda i, pixels: save_image(folder / names[i], pixels), batch, pictures))
                done += len(batch)
                progress(done, len(names))


def _read(path: Path, size: list[int]) -> Photograph:
    """A photograph, which must be as large as the model says."""
    photograph = read_image(path)
    if list(photograph.size) != size:
        raise ImageError(f"{path}: {photograph.width} x {photograph.height} pixels, in the model {size[0]} x {size[1]}")
    return photograph


def _copy(path: Path, target: Path, size: list[int]) -> None:
    """A photograph as it is where it stands upright, else turned."""
    photograph = _read(path, size)
    if parse_exif(path.read_bytes()).orientation == 1:
        shutil.copyfile(path, target)
    else:
        save_image(target, photograph.pixels)
