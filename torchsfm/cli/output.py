"""The output folder: one run at a time writes to it, and the results of a run are there all or none.

Results are written to the subfolder `.writing`. When they are all on the disk it is renamed `.written`, which decides: from
then on the old results go, the folder becomes `.arriving`, and the new ones take their names, the report last. Whatever ends a
run between two of these steps, the next command goes on from there: new results are never found beside old ones.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchsfm.cli.job import UserError
from torchsfm.reconstruction.model.files import HELD, PARTIAL, lock_file

LOCK, WRITING, WRITTEN, ARRIVING = ".lock", ".writing", ".written", ".arriving"
RESULTS = re.compile(
    r"report\.(json|md)|page\.html|(model|points|lines|curves)(-\d+)?\.(npz|ply|txt|json)"
    r"|colmap(-\d+)?/((cameras|frames|images|points3D|rigs)\.bin|unregistered\.txt)"
)
"""The files that a run leaves, as paths within the folder."""


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Make the folder, see that it can be written, and keep other runs away from it until the block ends.

    Raises:
        UserError: It cannot be written, or another run is writing to it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror or error})") from None
    with _locked(folder):
        finish_replacing(folder)
        shutil.rmtree(folder / WRITING, ignore_errors=True)
        # Left by a run that was killed.
        stages = folder / "stages"
        for left in [*folder.glob(f".*{PARTIAL}"), *stages.rglob(f".*{PARTIAL}"), *stages.rglob(f".*{HELD}")]:
            left.unlink(missing_ok=True)
        yield


@contextmanager
def replacing_results(folder: Path) -> Iterator[Path]:
    """A folder to write results to; they replace those of an earlier run when the block ends without an error."""
    writing = folder / WRITING
    writing.mkdir()
    try:
        yield writing
    except BaseException as error:
        shutil.rmtree(writing, ignore_errors=True)
        if isinstance(error, OSError) and error.filename:  # known to the user by the name it would have got
            raise OSError(error.errno, error.strerror, str(error.filename).replace(str(writing), str(folder))) from None
        raise
    writing.rename(folder / WRITTEN)
    finish_replacing(folder)


def finish_replacing(folder: Path) -> None:
    """Give complete results their names, from wherever an earlier command was stopped; nothing where there are none."""
    written, arriving = folder / WRITTEN, folder / ARRIVING
    if written.is_dir():
        for path in sorted(_results(folder), key=_report_last, reverse=True):
            path.unlink()
        written.rename(arriving)
    if arriving.is_dir():
        for path in sorted(_results(arriving), key=_report_last):
            target = folder / path.relative_to(arriving)
            target.parent.mkdir(exist_ok=True)
            os.replace(path, target)
        shutil.rmtree(arriving)
    for path in folder.glob("colmap*"):
        with suppress(OSError):
            path.rmdir()  # emptied


def unfinished(folder: Path) -> bool:
    """Whether results wait for their names."""
    return (folder / WRITTEN).is_dir() or (folder / ARRIVING).is_dir()


def _results(folder: Path) -> list[Path]:
    found = [path for pattern in ("*", "colmap*/*") for path in folder.glob(pattern) if path.is_file()]
    return [path for path in found if RESULTS.fullmatch(path.relative_to(folder).as_posix())]


def _report_last(path: Path) -> tuple[bool, str]:
    return path.name.startswith("report."), path.name


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system takes away from a process that ends in whatever way."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            lock_file(lock)
        except (BlockingIOError, PermissionError):
            owner = os.read(lock, 20).decode("ascii", "replace").strip()
            raise UserError(f"{folder}: another run is writing to it (process {owner}); give another --out, or wait") from None
        except OSError:
            pass  # a file system without locks
        with suppress(OSError):
            os.truncate(lock, 0)
            os.write(lock, f"{os.getpid()}\n".encode())
        yield
    finally:
        os.close(lock)
