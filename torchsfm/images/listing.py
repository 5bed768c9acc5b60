"""Which files of a folder are images, and which others may have been meant."""

import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from torchsfm.images.heif import MISSING, heif_library
from torchsfm.images.reading import ImageError

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".pbm", ".pnm", ".bmp", ".tif", ".tiff", ".webp"))
"""The file names that `list_images` takes for images."""
FILMS = frozenset((".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp"))
"""The file names of films."""
WRITTEN = frozenset((".lock", ".torchsfm-export"))
"""A folder that holds one of these was written by this library: its pictures are copies."""

OTHERS: dict[str, str] = {
    **dict.fromkeys((".heic", ".heif"), MISSING),
    **dict.fromkeys(
        (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"),
        "a camera's raw data are not read; develop them to JPEG or PNG",
    ),
    **dict.fromkeys(FILMS, "a film among images is not read; give it by itself, or save frames of it as images"),
    **dict.fromkeys(
        (".avif", ".gif", ".jp2", ".jxl", ".exr", ".hdr", ".psd", ".tga"),
        "this kind of image is not read; convert it to JPEG or PNG",
    ),
}
"""Endings of files that hold pictures but are not read, and what to do about it."""


def list_images(folder: str | os.PathLike[str], *, subfolders: bool = False, without: Collection[Path] = ()) -> list[Path]:
    """The image files in a folder, in natural order: `view2.jpg` before `view10.jpg`.

    Args:
        folder: The folder.
        subfolders: Also those in its subfolders, after those of the folder itself; subfolders that hold results of this library
            are left out.
        without: Subfolders to leave out, too.

    Raises:
        ImageError: There is no such folder, or it cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> for name in ("view10.png", "view2.png"):
        ...     torchsfm.images.save_image(name, torch.rand(3, 4, 5))
        >>> [path.name for path in torchsfm.list_images(".")]
        ['view2.png', 'view10.png']
    """
    found = _walk(Path(folder), subfolders, _real(without))
    return [path for path, reason in found if not reason and _is_image(path)]


def list_skipped(
    folder: str | os.PathLike[str], *, subfolders: bool = False, without: Collection[Path] = ()
) -> list[tuple[Path, str]]:
    """What `list_images` passes over though it holds or may hold pictures, each with the reason, in natural order.

    These are files in formats that are not read, films, subfolders with pictures in them that are not searched, and names of
    images behind which there is no file.

    Args:
        folder: The folder.
        subfolders: As in `list_images`.
        without: As in `list_images`.

    Raises:
        ImageError: There is no such folder, or it cannot be read.

    Example:
        >>> from pathlib import Path
        >>> import torchsfm
        >>> Path("film.mp4").touch()
        >>> [path.name for path, reason in torchsfm.images.list_skipped(".")]
        ['film.mp4']
    """
    return [(path, reason) for path, reason in _walk(Path(folder), subfolders, _real(without)) if reason]


def _real(folders: Collection[Path]) -> set[str]:
    return {os.path.realpath(folder) for folder in folders}


def _walk(folder: Path, subfolders: bool, without: set[str]) -> Iterator[tuple[Path, str]]:
    """What is in a folder, and why it is passed over: files first, then what is in subfolders, each once."""
    without = {*without, os.path.realpath(folder)}
    within = []
    for path in _entries(folder):
        if not path.is_dir():
            yield path, _reason(path)
        elif subfolders and os.path.realpath(path) not in without and not any((path / mark).exists() for mark in WRITTEN):
            within.append(path)
        elif reason := _reason_of_folder(path, subfolders):
            yield path, reason
    for path in within:
        try:
            yield from _walk(path, subfolders, without)
        except ImageError as error:
            yield path, str(error).removeprefix(f"{path}: ")


def _is_image(path: Path) -> bool:
    """Whether a file of this name is an image that is read."""
    kind = path.suffix.lower()
    return kind in SUFFIXES or (OTHERS.get(kind) == MISSING and heif_library() is not None)


def _reason(path: Path) -> str:
    if _is_image(path):
        return "" if path.is_file() else "not a file"
    return OTHERS.get(path.suffix.lower(), "")


def _reason_of_folder(path: Path, subfolders: bool) -> str:
    try:
        pictures = sum(entry.suffix.lower() in SUFFIXES or entry.suffix.lower() in OTHERS for entry in path.iterdir())
    except OSError as error:
        return f"a folder that cannot be read ({error.strerror or error})"
    why = "it holds masks or results, or was read before" if subfolders else "subfolders are not searched"
    return f"a folder with {pictures} pictures; {why}" if pictures else ""


def _entries(folder: Path) -> list[Path]:
    """What is in a folder, hidden things apart, in natural order."""
    if not folder.is_dir():
        raise ImageError(f"{folder}: no such folder" if not folder.exists() else f"{folder}: not a folder")
    try:
        return sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=_natural)
    except OSError as error:
        raise ImageError(f"{folder}: cannot be read ({error.strerror or error})") from None


def _natural(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    pieces = re.split(r"(\d+)", path.name.lower())
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces if p], path.name
