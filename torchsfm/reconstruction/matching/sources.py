"""What the user gives for photographs: folders, image files, and text files that list images."""

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchsfm.images import FILMS, SUFFIXES, ImageError, list_images, list_skipped
from torchsfm.reconstruction.messages import ReconstructionError, describe_skipped

LONGEST_LIST = 2**24
"""Bytes of a text file that lists images: some hundred thousand names."""
Source = str | Path | Sequence[str | Path]


@dataclass(frozen=True)
class Sources:
    """Photographs by file and name.

    Attributes:
        folder: Where they lie: each under its name.
        files: Where each is.
        names: What to call each: its path from the folder on, with slashes.
        skipped: What was passed over in their folders, with the reason.
    """

    folder: Path
    files: tuple[Path, ...]
    names: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, images: Source, without: Collection[str | Path] = (), *, least: int = 2) -> "Sources":
        """What there is behind folders, image files and lists.

        Folders are searched with all their subfolders. A list is a text file with the path of an image on each line, from the
        folder of the list on; `#` begins a comment. Names begin at the only folder given or the folder of the only list, else
        at the folder that all images have in common.

        Args:
            images: One of these, or several in order.
            without: Folders in which nothing is looked for.
            least: How many images there must be.

        Raises:
            ReconstructionError: There are fewer images than that, one is given twice, or something is not there.
        """
        given = [Path(images)] if isinstance(images, str | Path) else [Path(path) for path in images]
        files: list[Path] = []
        skipped: list[tuple[Path, str]] = []
        hidden = [Path(folder) for folder in without]
        for path in given:
            if path.is_dir() or (len(given) == 1 and not path.exists()):
                try:
                    found = list_images(path, subfolders=True, without=hidden)
                    passed = list_skipped(path, subfolders=True, without=hidden)
                except ImageError as error:
                    raise ReconstructionError(str(error)) from None
                if not found:
                    others = "".join(f"; not read: {text}" for text in describe_skipped(_named(passed, path)))
                    raise ReconstructionError(f"{path}: no images in this folder{others}")
                files += found
                skipped += passed
            else:
                files += _listed(path) if _is_list(path) else [path]
        if not files:
            raise ReconstructionError("no images given")
        if len(files) < least:
            raise ReconstructionError(f"{files[0]}: one image is not enough, two views are the least")
        for path in files:
            if not path.is_file():
                raise ReconstructionError(f"{path}: no such file")
            if path.suffix.lower() in FILMS:
                raise ReconstructionError(f"{path}: a film; give it by itself, or save frames of it as images")
        full = [os.path.abspath(path) for path in files]
        if len(set(full)) < len(full):
            twice = next(path for i, path in enumerate(full) if path in full[:i])
            raise ReconstructionError(f"{twice}: given twice")
        folder = _common_folder(full, given)
        names = tuple(Path(os.path.relpath(path, folder)).as_posix() for path in full)
        return cls(folder, tuple(files), names, _named(skipped, folder))


def _named(skipped: Sequence[tuple[Path, str]], folder: Path) -> tuple[tuple[str, str], ...]:
    return tuple((Path(os.path.relpath(path, folder)).as_posix(), reason) for path, reason in skipped)


def _common_folder(full: list[str], given: list[Path]) -> Path:
    """The only folder that was given, or that of the only list, where all files are in it; else the deepest that holds all."""
    if len(given) == 1:
        folder = given[0] if given[0].is_dir() else given[0].parent
        if all(Path(path).is_relative_to(os.path.abspath(folder)) for path in full):
            return folder
    try:
        return Path(os.path.commonpath([os.path.dirname(path) for path in full]))
    except ValueError:
        raise ReconstructionError(f"{full[0]}: on another drive than other images") from None


def _is_list(path: Path) -> bool:
    """Whether a file is text that lists images, and not an image that is damaged."""
    if path.suffix.lower() in SUFFIXES | FILMS or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return b"\0" not in file.read(4096)
    except OSError:
        return False


def _listed(path: Path) -> list[Path]:
    """The images that a text file lists."""
    try:
        if path.stat().st_size > LONGEST_LIST:
            raise ReconstructionError(f"{path}: too large for a list of images")
        text = path.read_bytes().decode("utf-8", "surrogateescape")
    except OSError as error:
        raise ReconstructionError(f"{path}: cannot be read ({error.strerror or error})") from None
    files = []
    for number, line in enumerate(text.removeprefix("\ufeff").split("\n"), start=1):
        name = line.strip()
        if not name or name.startswith("#"):
            continue
        files.append(path.parent / name)
        if not files[-1].is_file():
            raise ReconstructionError(f"{path}, line {number}: no such file: {name[:200]!r}")
    if not files:
        raise ReconstructionError(f"{path}: lists no images")
    return files
