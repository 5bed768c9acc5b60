"""Photographs of telephones, HEIC, where the package pillow-heif is installed (the extra `heic`)."""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

BRANDS = frozenset((b"heic", b"heix", b"heim", b"heis", b"mif1"))
"""What a file says of itself that holds a still image coded by HEVC."""
MISSING = "HEIC is read where pillow-heif is installed (pip install 'torchsfm[heic]'); or convert it to JPEG or PNG"


def is_heif(data: bytes) -> bool:
    """Whether the first bytes of a file are those of HEIC."""
    return data[4:8] == b"ftyp" and data[8:12] in BRANDS


def heif_library() -> Any:
    """The package that reads HEIC; None where it is not installed."""
    try:
        import pillow_heif
    except ImportError:
        return None
    return pillow_heif


def heif_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of the upright image; None where the file does not say, or nothing reads it."""
    image = _opened(data)
    return None if image is None else (int(image.size[0]), int(image.size[1]))


def heif_exif(data: bytes) -> bytes | None:
    """The TIFF structure of the Exif tags."""
    image = _opened(data)
    block = b"" if image is None else bytes(image.info.get("exif") or b"")
    start = min((place for mark in (b"II*\0", b"MM\0*") if (place := block.find(mark, 0, 16)) >= 0), default=-1)
    return None if start < 0 else block[start:]


def decode_heif(data: bytes) -> NDArray[np.uint8]:
    """Pixels (h, w, 3), red, green, blue, turned upright as the file says; what is transparent is black in proportion.

    Raises:
        ValueError: The file is damaged.
    """
    image = _opened(data)
    if image is None:
        raise ValueError("damaged")
    try:
        array = np.asarray(image)
    except (RuntimeError, EOFError, OSError, SyntaxError) as error:
        raise ValueError(str(error)) from None
    if array.ndim == 2:
        return np.repeat(array[:, :, None], 3, 2)
    opaque = array[:, :, :3]
    return opaque if array.shape[2] == 3 else np.rint(opaque * (array[:, :, 3:] / 255)).astype(np.uint8)


def _opened(data: bytes) -> Any:
    """The image in a file, not decoded yet; None where that fails."""
    library = heif_library()
    if library is None:
        return None
    try:
        image = library.open_heif(io.BytesIO(data))
        # A file may open and hold no image.
        return image if image.size else None
    except (ValueError, RuntimeError, EOFError, OSError, SyntaxError, KeyError, IndexError):
        return None
