"""Which files of a folder are images, and which others may have been meant."""

import os
import re
from pathlib import Path

from torchsfm.images.reading import ImageError

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".pbm", ".pnm", ".bmp", ".tif", ".tiff", ".webp"))
"""The file names that `list_images` takes for images."""

OTHERS: dict[str, str] = {
    **dict.fromkeys((".heic", ".heif", ".avif"), "HEIC or AVIF is not read; convert it to JPEG or PNG"),
    **dict.fromkeys(
        (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"),
        "a camera's raw data are not read; develop them to JPEG or PNG",
    ),
    **dict.fromkeys(
        (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp"),
        "a video is not read; save frames of it as images",
    ),
    **dict.fromkeys(
        (".gif", ".jp2", ".jxl", ".exr", ".hdr", ".psd", ".tga"), "this kind of image is not read; convert it to JPEG or PNG"
    ),
}
"""Endings of files that hold pictures but are not read, and what to do about it."""


def list_images(folder: str | os.PathLike[str]) -> list[Path]:
    """The image files in a folder (not in its subfolders), in natural order: `view2.jpg` before `view10.jpg`.

    Raises:
        ImageError: There is no such folder, or it cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> for name in ("view10.png", "view2.png"):
        ...     torchsfm.images.save_image(name, torch.rand(3, 4, 5))
        >>> [path.name for path in torchsfm.list_images(".")]
        ['view2.png', 'view10.png']
    """
    return [path for path in _entries(folder) if path.suffix.lower() in SUFFIXES and path.is_file()]


def list_skipped(folder: str | os.PathLike[str]) -> list[tuple[Path, str]]:
    """What `list_images` passes over though it holds or may hold pictures, each with the reason, in natural order.

    These are files in formats that are not read, videos, subfolders with pictures in them, and names of images behind which
    there is no file.

    Raises:
        ImageError: There is no such folder, or it cannot be read.

    Example:
        >>> from pathlib import Path
        >>> import torchsfm
        >>> Path("film.mp4").touch()
        >>> [path.name for path, reason in torchsfm.images.list_skipped(".")]
        ['film.mp4']
    """
    reasons = ((path, _reason(path)) for path in _entries(folder))
    return [(path, reason) for path, reason in reasons if reason]


def _reason(path: Path) -> str:
    kind = path.suffix.lower()
    if path.is_dir():
        try:
            pictures = sum(entry.suffix.lower() in SUFFIXES or entry.suffix.lower() in OTHERS for entry in path.iterdir())
        except OSError as error:
            return f"a folder that cannot be read ({error.strerror or error})"
        return f"a folder with {pictures} pictures; subfolders are not searched" if pictures else ""
    if kind in SUFFIXES:
        return "" if path.is_file() else "not a file"
    return OTHERS.get(kind, "")


def _entries(folder: str | os.PathLike[str]) -> list[Path]:
    """What is in a folder, hidden things apart, in natural order."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ImageError(f"{folder}: no such folder" if not folder.exists() else f"{folder}: not a folder")
    try:
        return sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=_natural)
    except OSError as error:
        raise ImageError(f"{folder}: cannot be read ({error.strerror or error})") from None


def _natural(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    pieces = re.split(r"(\d+)", path.name.lower())
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces if p], path.name
