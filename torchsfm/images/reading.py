"""Image files to tensors and back."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchsfm.images.exif import parse_exif
from torchsfm.images.netpbm import decode_netpbm, is_netpbm

_TURNS: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a[::-1].swapaxes(0, 1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a[:, ::-1].swapaxes(0, 1),
}


class ImageError(ValueError):
    """A file could not be read as an image; the message is one line that names the file and the reason."""


@dataclass(frozen=True)
class Photograph:
    """An image with what its file says of the camera."""

    pixels: Float[Tensor, "c h w"]
    """Values in [0, 1], upright; three channels red, green, blue, or one channel grey."""
    name: str
    """The file's name without its folder."""
    focal: float | None = None
    """Focal length in pixels of this image, from the Exif tags; None where they do not tell. A guess, often off by 5 %."""
    make: str = ""
    """The camera's maker, as the camera wrote it."""
    model: str = ""
    """The camera's model, as the camera wrote it."""
    size: tuple[int, int] = (0, 0)
    """Width and height of the upright image in the file, before any `max_size`."""

    @property
    def width(self) -> int:
        """Columns of this image."""
        return int(self.pixels.shape[-1])

    @property
    def height(self) -> int:
        """Rows of this image."""
        return int(self.pixels.shape[-2])


def read_image(path: str | os.PathLike[str], *, gray: bool = False, max_size: int | None = None) -> Photograph:
    """Read one image file.

    JPEG, PNG, PGM and PPM (8 and 16 bits), TIFF, BMP and WebP. The orientation in the Exif tags is applied, so that the image
    stands upright. Transparency is dropped.

    Args:
        path: The file.
        gray: One channel (luma) instead of red, green and blue.
        max_size: Scale the image down so that its longer side has at most this many pixels; `focal` is scaled with it.

    Returns:
        The image with float32 pixels in [0, 1], upright.

    Raises:
        ImageError: The file is missing, unreadable, empty, cut short, or no image.
        ValueError: `max_size` is not positive.
    """
    if max_size is not None and max_size < 1:
        raise ValueError(f"max_size: wanted at least 1, got {max_size}")
    path = Path(path)
    data = _read_bytes(path)
    array, white = _decode(data, path, gray=gray)
    exif = parse_exif(data)
    focal = exif.focal(array.shape[1], array.shape[0])
    array = _TURNS[exif.orientation](array)
    size = (array.shape[1], array.shape[0])
    if max_size is not None and max(size) > max_size:
        import cv2

        scale = max_size / max(size)
        small = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
        array = cv2.resize(np.ascontiguousarray(array), small, interpolation=cv2.INTER_AREA)
        focal = None if focal is None else focal * scale
    array = array[None] if array.ndim == 2 else array.transpose(2, 0, 1)
    pixels = torch.from_numpy(np.ascontiguousarray(array)).to(torch.float32).div_(white)
    return Photograph(pixels=pixels, name=path.name, focal=focal, make=exif.make, model=exif.model, size=size)


def save_image(
    path: str | os.PathLike[str], image: Float[Tensor, "*channels h w"], *, bits: int = 8, quality: int = 95
) -> None:
    """Write an image; the file name's ending says the format (PNG, JPEG, PGM, PPM, TIFF, ...).

    Args:
        path: The file to write. Its folder must exist.
        image: One grey image `(h, w)` or `(1, h, w)`, or red, green, blue `(3, h, w)`; values are clamped to [0, 1].
        bits: 8, or 16 where the format can hold it.
        quality: JPEG quality.

    Raises:
        ValueError: The shape or an option is wrong.
        ImageError: The file cannot be written.
    """
    import cv2

    path = Path(path)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[0] not in (1, 3)):
        raise ValueError(f"image: wanted shape (h, w), (1, h, w) or (3, h, w), got {tuple(image.shape)}")
    if bits not in (8, 16):
        raise ValueError(f"bits: wanted 8 or 16, got {bits}")
    suffix = path.suffix.lower()
    if bits == 16 and suffix not in (".png", ".pgm", ".ppm", ".pbm", ".pnm", ".tif", ".tiff"):
        raise ValueError(f"bits: {suffix or 'this format'} does not hold 16 bits")
    if suffix == ".pgm" and image.ndim == 3 and image.shape[0] == 3:
        raise ValueError(f"image: .pgm holds one channel, got shape {tuple(image.shape)}")
    if suffix == ".ppm":
        image = image.reshape(-1, *image.shape[-2:]).expand(3, *image.shape[-2:])
    values = image.detach().to("cpu", torch.float64).nan_to_num().clamp(0, 1).mul(2**bits - 1).round().numpy()
    array = values.astype(np.uint8 if bits == 8 else np.uint16)
    if array.ndim == 3:
        array = array[0] if array.shape[0] == 1 else array.transpose(1, 2, 0)[:, :, ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in (".jpg", ".jpeg") else []
    try:
        done, encoded = cv2.imencode(suffix or "?", np.ascontiguousarray(array), options)
    except cv2.error:
        done = False
    if not done:
        raise ImageError(f"{path}: cannot write an image of this kind under the ending '{path.suffix}'")
    try:
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        raise ImageError(f"{path}: cannot be written ({error.strerror or error})") from None


def scale_image(image: Float[Tensor, "*batch h w"], *, low: float | None = None, high: float | None = None) -> Tensor:
    """Stretch values so that `low` becomes 0 and `high` becomes 1, clamped.

    Args:
        image: Images with any number of leading dimensions.
        low: The value that becomes 0; each image's smallest where not given.
        high: The value that becomes 1; each image's largest where not given.

    Returns:
        Images in [0, 1]. An image of one value, or of `low >= high`, becomes 0 everywhere.
    """
    bottom = image.amin((-2, -1), keepdim=True) if low is None else torch.full_like(image[..., :1, :1], low)
    top = image.amax((-2, -1), keepdim=True) if high is None else torch.full_like(image[..., :1, :1], high)
    spread = top - bottom
    usable = spread > 0
    return ((image - bottom) / torch.where(usable, spread, 1)).clamp(0, 1) * usable


def _read_bytes(path: Path) -> bytes:
    if path.is_dir():
        raise ImageError(f"{path}: a folder, not an image")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not data:
        raise ImageError(f"{path}: the file is empty")
    return data


def _decode(data: bytes, path: Path, *, gray: bool) -> tuple[NDArray[Any], float]:
    """Pixels (h, w) or (h, w, 3) in red, green, blue order as stored, and the value that stands for white."""
    import cv2

    if is_netpbm(data):
        try:
            values, white = decode_netpbm(data)
        except ValueError as error:
            raise ImageError(f"{path}: {error}") from None
        if gray:
            return cv2.cvtColor(values, cv2.COLOR_RGB2GRAY) if values.ndim == 3 else values, white
        return values if values.ndim == 3 else np.repeat(values[:, :, None], 3, 2), white
    complete = _is_complete(data)
    if complete is None:
        raise ImageError(f"{path}: not an image of a known kind ({_guess(data)})")
    if not complete:
        raise ImageError(f"{path}: the image is cut short")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION | (cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR)
    try:
        array = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"{path}: cannot be decoded ({' '.join(str(error).split())[:200]})") from None
    if array is None or array.size == 0:
        raise ImageError(f"{path}: damaged, cannot be decoded")
    if array.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path}: pixels of type {array.dtype}; 8 or 16 bit integers are wanted")
    return array if gray else array[:, :, ::-1], 255.0 if array.dtype == np.uint8 else 65535.0


def _is_complete(data: bytes) -> bool | None:
    """Whether the file holds all of its image; None where it is no image known here."""
    if data[:3] == b"\xff\xd8\xff":
        position = 2
        while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] != 0xDA:
            fill = data[position + 1] == 0xFF
            position += 1 if fill else 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        return data.find(b"\xff\xd9", position) >= 0  # inside the coded data 0xff is always followed by 0 or a restart mark
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        position = 8
        while position + 12 <= len(data):
            if data[position + 4 : position + 8] == b"IEND":
                return True
            position += 12 + int.from_bytes(data[position : position + 4], "big")
        return False
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    if data[:4] in (b"II*\0", b"MM\0*"):
        return True
    if data[:2] == b"BM":
        return len(data) >= int.from_bytes(data[2:6], "little")
    return None


def _guess(data: bytes) -> str:
    if data[4:8] == b"ftyp":
        return "HEIC or AVIF: convert it to JPEG or PNG"
    head = data[:512]
    text = sum(byte in b"\t\n\r" or 32 <= byte < 127 for byte in head) > 0.95 * len(head)
    return "it looks like text" if text else "unknown contents"
