"""Frames of a film, each the sharpest of its time."""

import json
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchsfm.images.reading import MAX_PIXELS, ImageError
from torchsfm.linalg.devices import on_the_cpu

RECORD = ".film.json"
"""Beside frames: which film they are of."""
FPS = 2.0
"""Frames a second that are kept."""
SIDE = 640
"""Frames are compared at this longer side: at full size, what makes a difference is often the noise."""
NEAR = 1e-3
"""Rounding of times, as a fraction of the time between two frames."""


@on_the_cpu
def extract_frames(
    film: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    fps: float = FPS,
    quality: int = 95,
    max_pixels: int = MAX_PIXELS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Save frames of a film as JPEG, of each moment the sharpest, to be reconstructed with `sequence=True`.

    Sharpness is the variance of the Laplacian of the grey frame, which motion blur takes away. Frames of the same film that the
    folder already holds are left as they are; those of another film are replaced.

    Args:
        film: A file that OpenCV reads: MP4, MOV, AVI, MKV, ...
        folder: Where to; made if it is not there. It may hold frames of an earlier call, and nothing else.
        fps: Frames a second to keep. More than the film has keeps all.
        quality: JPEG quality.
        max_pixels: A film of larger frames is refused.
        progress: Called with the number of frames read and of all that the film announces.

    Returns:
        The frames in order, named by their number in the film. They are there all or none.

    Raises:
        ImageError: The film is missing, no film, or damaged from the first frame on.
        ValueError: `fps` is not positive, or the folder holds other files.
        OSError: A frame cannot be written.

    Example:
        >>> import cv2, torch, torchsfm
        >>> film = cv2.VideoWriter("walk.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
        >>> g = torch.Generator().manual_seed(0)
        >>> sharp = torch.randint(0, 255, (48, 64, 3), dtype=torch.uint8, generator=g).numpy()
        >>> for number in range(20):  # two seconds; every fifth picture is sharp
        ...     done = film.write(sharp if number % 5 == 3 else cv2.blur(sharp, (5, 5)))
        >>> film.release()
        >>> [path.name for path in torchsfm.images.extract_frames("walk.avi", "frames", fps=2.0)]
        ['frame000003.jpg', 'frame000008.jpg', 'frame000013.jpg', 'frame000018.jpg']
    """
    film, folder = Path(film), Path(folder)
    if not (math.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: wanted a positive number of frames a second, got {fps}")
    if not film.is_file():
        raise ImageError(f"{film}: " + ("not a file" if film.exists() else "no such file"))
    status = film.stat()
    wanted = {"film": film.name, "bytes": status.st_size, "changed": status.st_mtime_ns, "fps": fps, "quality": quality}
    old: dict[str, Any] = {}
    with suppress(OSError, ValueError, TypeError):
        old = dict(json.loads((folder / RECORD).read_bytes()))
    names = old.pop("names", [])
    if old == wanted and all((folder / str(name)).is_file() for name in names):
        return [folder / name for name in names]
    if folder.exists() and (others := {path.name for path in folder.iterdir()} - {RECORD, *names}):
        raise ValueError(f"{folder}: holds {min(others)}, which is no frame of an earlier film; give another folder")
    partial = folder.with_name(f".{secrets.token_hex(8)}.partial")
    partial.mkdir(parents=True)
    try:
        names = [_save(partial, number, frame, quality) for number, frame in _sharpest(film, fps, max_pixels, progress)]
        (partial / RECORD).write_text(json.dumps(wanted | {"names": names}))
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return [folder / name for name in names]


def _sharpest(
    film: Path, fps: float, max_pixels: int, progress: Callable[[int, int], None]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Of each 1 / fps seconds the sharpest frame, with its number in the film."""
    span, best, chosen, number = -1, -1.0, None, -1
    for number, (time, frame, total) in enumerate(_frames(film, max_pixels)):
        progress(number + 1, max(total, number + 1))
        now, sharpness = math.floor(time * fps + NEAR), _sharpness(frame)
        if now > span and chosen is not None:
            yield chosen
            chosen = None
        if chosen is None or sharpness > best:
            best, chosen = sharpness, (number, frame)
        span = now
    if chosen is None:
        raise ImageError(f"{film}: not a film that can be read")
    yield chosen


def _frames(film: Path, max_pixels: int) -> Iterator[tuple[float, NDArray[np.uint8], int]]:
    """All frames of a film, upright, with their time in seconds and the number of all as the file announces it."""
    import cv2

    # Else the decoder prints its own account of what it cannot read.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture()
    try:
        try:
            opened = capture.open(os.fspath(film))
        except cv2.error:
            opened = False
        width, height = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not opened:
            return
        if width * height > max_pixels:
            raise ImageError(f"{film}: {width:g} x {height:g} are more than the {max_pixels} pixels that are read (max_pixels)")
        rate = capture.get(cv2.CAP_PROP_FPS)
        rate = rate if math.isfinite(rate) and 0.1 < rate < 1000 else 25.0
        total = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        time, number = -1 / rate, 0
        while True:
            try:
                there, frame = capture.read()
            except cv2.error:
                there = False
            if not there:
                return
            told = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            # Where the file tells no times, frames come at its rate.
            time = told if math.isfinite(told) and told > time else time + 1 / rate
            number += 1
            yield time, frame, int(total) if math.isfinite(total) and total > 0 else 0
    finally:
        capture.release()
        cv2.utils.logging.setLogLevel(level)


def _sharpness(frame: NDArray[np.uint8]) -> float:
    import cv2

    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    zoom = SIDE / max(gray.shape)
    if zoom < 1:
        gray = cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def _save(folder: Path, number: int, frame: NDArray[np.uint8], quality: int) -> str:
    import cv2

    name = f"frame{number:06d}.jpg"
    done, encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ImageError(f"{folder / name}: cannot be written")
    (folder / name).write_bytes(encoded.tobytes())
    return name
