"""Files that are there whole or not at all, and archives of arrays that are read without trust."""

import math
import os
import re
import secrets
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

PARTIAL = ".partial"
"""Ending of files that are being written; what a killed process left under it is of no use."""
HELD = ".lock"
"""Ending of files by which processes agree who works on what."""
MAX_RATIO = 200
FREE_BYTES = 2**24
"""An archive may unpack to so many times its size, or to so many bytes: beyond, it was made to fill the memory."""

HEADER = re.compile(
    rb"\x93NUMPY(?:\x01\x00..|[\x02\x03]\x00....)"
    rb"\{'descr': '(?P<type>[<>|](?:b1|[iu][1248]|f[248]|U\d{1,6}))', 'fortran_order': (?P<columns>True|False), "
    rb"'shape': \((?P<shape>(?:\d{1,18}(?:, ?|(?=\))))*)\), \} *\n",
    re.DOTALL,
)
"""What stands before the values of an array of truth values, numbers or text (NumPy's format .npy)."""


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file that takes the name `path` when the block ends; an error or a kill leaves what was there before.

    Raises:
        OSError: The file cannot be written, or the disk is full.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():  # a device or a pipe cannot be replaced
        with path.open("wb") as file:
            yield file
        return
    partial = path.with_name(f".{secrets.token_hex(8)}{PARTIAL}")
    try:
        with partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        partial.unlink(missing_ok=True)


def write_whole_files(contents: Mapping[Path, bytes]) -> None:
    """Write several files, or none of them: they take their names when all are on the disk.

    Raises:
        OSError: A file cannot be written, or the disk is full.
    """
    partials: dict[Path, Path] = {}
    try:
        for path, content in contents.items():
            partials[path] = path.with_name(f".{secrets.token_hex(8)}{PARTIAL}")
            try:
                with partials[path].open("xb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(path)) from None
        for path, partial in partials.items():
            os.replace(partial, path)
    finally:
        for partial in partials.values():
            partial.unlink(missing_ok=True)


@contextmanager
def held_file(path: Path) -> Iterator[bool]:
    """Whether this process, and this block of it alone, holds a file as long as the block lasts; it is made and removed here.

    The system takes it away from a process that ends in whatever way. On a file system without locks everybody holds it.
    """
    descriptor, mine = os.open(path, os.O_RDWR | os.O_CREAT, 0o666), True
    try:
        try:
            lock_file(descriptor)
        except (BlockingIOError, PermissionError):
            mine = False
        except OSError:
            pass
        yield mine
    finally:
        if mine:
            with suppress(OSError):
                path.unlink()
        os.close(descriptor)


def load_arrays(path: Path, wanted: Callable[[str], bool] | None = None) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file, none of them pickled; where it is given, those whose names pass a test.

    Nothing is taken on trust: an array is read after its announced size was found in the file.

    Raises:
        ValueError: The file is no such archive, or a damaged one; one line that says why.
        OSError: It cannot be read.
    """
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        if stream.read(4) not in (b"PK\3\4", b"PK\5\6"):
            raise ValueError("not an archive of arrays")
        try:
            with zipfile.ZipFile(stream) as archive:
                members = archive.infolist()
                if sum(member.file_size for member in members) > max(FREE_BYTES, MAX_RATIO * size):
                    raise ValueError(
                        f"damaged, or made to fill the memory: {size} bytes unpack to more than {MAX_RATIO} times that"
                    )
                names = {member.filename.removesuffix(".npy"): member for member in members}
                chosen = names if wanted is None else filter(wanted, names)
                return {name: _read_array(archive, names[name]) for name in chosen}
        except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError) as error:
            raise ValueError(f"a damaged archive ({' '.join(str(error).split()) or type(error).__name__})") from None
        except OSError:
            # A place before the beginning of the file, from a damaged directory of the archive.
            raise ValueError("a damaged archive") from None


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, whose bytes must be as many as its header says."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"a damaged archive ({member.filename!r} is packed in an unknown way)")
    data = archive.read(member)
    header = HEADER.match(data)
    if header is not None:
        dtype = np.dtype(header["type"].decode())
        shape = [int(size) for size in header["shape"].replace(b",", b" ").split()]
        content = bytearray(data[header.end() :])
        if math.prod(shape) * dtype.itemsize == len(content):
            values = np.frombuffer(content, dtype) if content else np.empty(0, dtype)
            order: Literal["F", "C"] = "F" if header["columns"] == b"True" else "C"
            return values.astype(dtype.newbyteorder("="), copy=False).reshape(shape, order=order)
    raise ValueError(f"a damaged archive ({member.filename!r} is not an array of numbers or text)")


if sys.platform == "win32":
    import msvcrt

    def lock_file(descriptor: int) -> None:
        """Lock an open file for as long as it is open; BlockingIOError or PermissionError where another has done so."""
        # Beyond what is written there: a locked byte cannot be read.
        os.lseek(descriptor, 1024, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        finally:
            os.lseek(descriptor, 0, os.SEEK_SET)
else:
    import fcntl

    def lock_file(descriptor: int) -> None:
        """Lock an open file for as long as it is open; BlockingIOError or PermissionError where another has done so."""
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
