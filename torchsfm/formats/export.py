"""A folder that another program can be pointed at: the model in its format, and the pictures that it wants beside it."""

import json
import os
import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from torchsfm.formats.bundler import write_bundler
from torchsfm.formats.colmap import SPLATTING, write_colmap
from torchsfm.formats.gltf import write_gltf
from torchsfm.formats.nerfstudio import write_nerfstudio
from torchsfm.formats.nvm import write_nvm
from torchsfm.formats.openmvg import write_openmvg
from torchsfm.formats.opensfm import write_opensfm
from torchsfm.formats.pictures import picture_names, registered_only, undistorted_model, write_pictures
from torchsfm.formats.ply import write_ply
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import PARTIAL
from torchsfm.reconstruction.model.reconstruction import Reconstruction

PICTURES = "images"
MARK = ".torchsfm-export"
"""Lists the files of an export, so that another one may replace them, and nothing else."""
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Target:
    """A program, and what it wants."""

    what: str
    """In a few words."""
    write: Callable[[Reconstruction, Path], None]
    """Writes a model into a folder."""
    pictures: bool = False
    """Whether it wants pictures, which then are undistorted if not asked for otherwise."""
    centred: bool = False
    """Whether its cameras have their principal point at the centre of the picture."""
    paths: bool = False
    """Whether it looks for pictures under their names from the folder on, and not in `images`."""


def _in(name: str, write: Callable[[Reconstruction, Path], None]) -> Callable[[Reconstruction, Path], None]:
    """Write to a place in the folder."""

    def write_there(model: Reconstruction, folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write(model, folder / name)

    return write_there


TARGETS: dict[str, Target] = {
    "gsplat": Target(
        "undistorted pictures in images/, sparse/0/ with PINHOLE cameras (also for 3DGS and its kin)",
        _in("sparse/0", partial(write_colmap, models=SPLATTING)),
        pictures=True,
    ),
    "nerfstudio": Target(
        "undistorted pictures in images/, transforms.json, points.ply", _in("transforms.json", write_nerfstudio), pictures=True
    ),
    "colmap": Target("sparse/0/, binary", _in("sparse/0", write_colmap)),
    "colmap-text": Target("sparse/0/, text", _in("sparse/0", partial(write_colmap, text=True))),
    "openmvg": Target("sfm_data.json", _in("sfm_data.json", write_openmvg)),
    "opensfm": Target("reconstruction.json and tracks.csv", _in("reconstruction.json", write_opensfm)),
    "bundler": Target(
        "undistorted pictures in images/, bundle.out and list.txt",
        _in("bundle.out", write_bundler),
        pictures=True,
        centred=True,
        paths=True,
    ),
    "nvm": Target(
        "undistorted pictures in images/, model.nvm", _in("model.nvm", write_nvm), pictures=True, centred=True, paths=True
    ),
    "blender": Target("undistorted pictures in images/, model.glb", _in("model.glb", write_gltf), pictures=True, centred=True),
    "meshlab": Target("points.ply with cameras", _in("points.ply", write_ply)),
}
"""The programs by name."""


@on_the_cpu
def export_model(
    model: Reconstruction,
    target: str,
    out: str | Path,
    *,
    images: str | Path | None = None,
    undistort: bool | None = None,
    alpha: float = 0.0,
    centred: bool = False,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Write a folder for another program: the model in its format, with the pictures that it wants.

    The folder is there whole or not at all. An earlier export in it is replaced; one that holds anything else is left alone.

    Args:
        model: The model. Images without a pose are left out where pictures are written.
        target: The name of a program in `TARGETS`.
        out: The folder to write.
        images: The folder in which the photographs lie under their names.
        undistort: Write pictures without distortion, and the model as pinhole cameras; False for pictures as they are. By
            default where the program wants pictures.
        alpha: How much of the old pictures the undistorted ones show: 0 crops to what is full, 1 keeps all, with black borders.
        centred: Put principal points at the centre of the undistorted pictures.
        progress: Called with the number of pictures written and of all.

    Returns:
        The folder.

    Raises:
        ValueError: There is no such program, its format cannot hold the model (undistorted it might), photographs are wanted
            and not given or are not the model's, or the folder holds other files.
        OSError: A file cannot be read or written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> folder = torchsfm.export_model(model, "colmap", "for_colmap", undistort=False)  # without pictures
        >>> folder.is_dir()
        True
    """
    if target not in TARGETS:
        raise ValueError(f"target: there is no {target!r} among {', '.join(TARGETS)}")
    chosen, out = TARGETS[target], Path(out)
    undistort = chosen.pictures if undistort is None else undistort
    if (chosen.pictures or undistort) and images is None:
        raise ValueError(f"{target} wants pictures: say in which folder the photographs lie")
    check_replaceable(out)
    partial_folder = out.parent / f".{secrets.token_hex(8)}{PARTIAL}"
    partial_folder.mkdir(parents=True)
    try:
        if images is not None and (chosen.pictures or undistort):
            model = registered_only(model)
            posed = undistorted_model(model, alpha=alpha, centred=centred or chosen.centred) if undistort else model
            renamed = replace(posed, names=picture_names(model.names, kept=not undistort))
            # What the format cannot hold is found before the work with the pictures.
            named = tuple(f"{PICTURES}/{name}" for name in renamed.names) if chosen.paths else renamed.names
            chosen.write(replace(renamed, names=named), partial_folder)
            write_pictures(model, renamed if undistort else None, Path(images), partial_folder / PICTURES, progress)
        else:
            chosen.write(model, partial_folder)
        files = sorted(path.relative_to(partial_folder).as_posix() for path in partial_folder.rglob("*") if path.is_file())
        (partial_folder / MARK).write_text(json.dumps(files))
        _replace(out, partial_folder)
    finally:
        shutil.rmtree(partial_folder, ignore_errors=True)
    return out


def check_replaceable(folder: Path) -> None:
    """See that a folder is not there, is empty, or holds an earlier export and nothing else.

    Raises:
        ValueError: It holds other files.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ValueError(f"{folder}: not a folder")
    ours = {MARK}
    with suppress(OSError, ValueError, TypeError):
        ours |= set(json.loads((folder / MARK).read_bytes()))
    for path in folder.rglob("*"):
        if not path.is_dir() and path.relative_to(folder).as_posix() not in ours:
            raise ValueError(f"{folder}: holds {path.relative_to(folder)}, which is of no earlier export; give another folder")


def _replace(folder: Path, new: Path) -> None:
    """Put a finished folder in the place of another."""
    if not folder.exists():
        os.replace(new, folder)
        return
    old = new.with_name(new.name + ".old")
    os.replace(folder, old)
    try:
        os.replace(new, folder)
    except OSError:
        os.replace(old, folder)
        raise
    shutil.rmtree(old, ignore_errors=True)
