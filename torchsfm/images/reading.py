"""Image files to tensors and back."""

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.images.exif import parse_exif
from torchsfm.images.headers import guess_contents, image_size, is_complete, is_transparent_png
from torchsfm.images.heif import decode_heif, is_heif
from torchsfm.images.netpbm import decode_netpbm, is_netpbm

MAX_PIXELS = 2**28
"""More pixels than any camera takes; read all the same, they would fill several gigabytes."""
BYTES_PER_PIXEL = 20
FREE_BYTES = 2**26
"""No image file needs more for each pixel, and for what it holds beside them."""

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
    """A file could not be read as an image; the message is one line that names the file and the reason.

    Example:
        >>> import torchsfm
        >>> torchsfm.read_image("nothing.jpg")
        Traceback (most recent call last):
            ...
        torchsfm.images.reading.ImageError: nothing.jpg: no such file
    """


@dataclass(frozen=True)
class Photograph:
    """An image with what its file says of the camera.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.images.save_image("view.png", torch.rand(3, 48, 64))
        >>> photograph = torchsfm.read_image("view.png", max_size=32)
        >>> photograph.name, photograph.size, (photograph.width, photograph.height)  # of the file, and as read
        ('view.png', (64, 48), (32, 24))
        >>> photograph.focal is None  # the file does not tell it
        True
    """

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


def pixels_of(image: Photograph | Float[Tensor, "*channels h w"]) -> Float[Tensor, "*channels h w"]:
    """The values of an image, which may come with what its file says of the camera or without."""
    return image.pixels if isinstance(image, Photograph) else image


def read_image(
    path: str | os.PathLike[str], *, gray: bool = False, max_size: int | None = None, max_pixels: int = MAX_PIXELS
) -> Photograph:
    """Read one image file.

    JPEG, PNG, PGM and PPM (8 and 16 bits), TIFF, BMP, WebP, and HEIC with the extra `heic`. The orientation in the Exif tags is
    applied, so that the image stands upright. What is transparent in a PNG or HEIC is black in proportion, as colours there are
    those of the whole pixel; that of other kinds is dropped.

    Args:
        path: The file.
        gray: One channel (luma) instead of red, green and blue.
        max_size: Scale the image down so that its longer side has at most this many pixels; `focal` is scaled with it. A JPEG
            of at least twice the size is not decoded in full where its sides allow it.
        max_pixels: An image that has more pixels by its header is refused, as a small file can hold more than the memory does.

    Returns:
        The image with float32 pixels in [0, 1], upright.

    Raises:
        ImageError: The file is missing, unreadable, empty, cut short, too large, or no image.
        ValueError: `max_size` or `max_pixels` is not positive.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.images.save_image("view.png", torch.rand(3, 48, 64))
        >>> photograph = torchsfm.read_image("view.png", max_size=32)
        >>> photograph.pixels.shape, photograph.size, photograph.focal
        (torch.Size([3, 24, 32]), (64, 48), None)
    """
    for name, value in (("max_size", max_size), ("max_pixels", max_pixels)):
        if value is not None and value < 1:
            raise ValueError(f"{name}: wanted at least 1, got {value}")
    path = Path(path)
    data = _read_bytes(path, max_pixels)
    stored = _stored_size(data, path, max_pixels)
    # A part that divides both sides, so that every pixel of the smaller image is as many of the larger one.
    parts = [part for part in (8, 4, 2) if max_size and max(stored) >= part * max_size and not any(n % part for n in stored)]
    part = max(parts, default=1) if data[:3] == b"\xff\xd8\xff" else 1  # of other kinds the whole is decoded in any case
    array, white = _decode(data, path, gray=gray, part=part)
    if array.shape[:2] != (stored[1] // part, stored[0] // part):
        raise ImageError(f"{path}: damaged, the header says {stored[0]} x {stored[1]}, not {array.shape[1]} x {array.shape[0]}")
    exif = parse_exif(data)
    focal = exif.focal(*stored)
    array = _TURNS[exif.orientation](array)
    size = stored if exif.orientation < 5 else stored[::-1]
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

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.images.save_image("grey.png", torch.rand(48, 64), bits=16)
        >>> torchsfm.read_image("grey.png", gray=True).pixels.shape
        torch.Size([1, 48, 64])
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

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.images.scale_image(torch.tensor([[2.0, 3.0], [4.0, 6.0]]))
        tensor([[0.0000, 0.2500],
                [0.5000, 1.0000]])
    """
    check_tensors(image=(image, "h>=1 w>=1"))
    check_options(low=(low, "?float"), high=(high, "?float"))
    bottom = image.amin((-2, -1), keepdim=True) if low is None else torch.full_like(image[..., :1, :1], low)
    top = image.amax((-2, -1), keepdim=True) if high is None else torch.full_like(image[..., :1, :1], high)
    spread = top - bottom
    usable = spread > 0
    return ((image - bottom) / torch.where(usable, spread, 1)).clamp(0, 1) * usable


def _read_bytes(path: Path, max_pixels: int) -> bytes:
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise ImageError(f"{path}: a folder, not an image")
        if not stat.S_ISREG(status.st_mode):  # a pipe, say, that nobody may ever write to
            raise ImageError(f"{path}: not a file")
        if status.st_size > BYTES_PER_PIXEL * max_pixels + FREE_BYTES:
            raise ImageError(f"{path}: {status.st_size} bytes are more than {max_pixels} pixels take (max_pixels)")
        data = path.read_bytes()
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not data:
        raise ImageError(f"{path}: the file is empty")
    return data


def _stored_size(data: bytes, path: Path, max_pixels: int) -> tuple[int, int]:
    """Width and height by the header, of a file that is an image as far as its header says."""
    complete = True if is_netpbm(data) else is_complete(data)
    if complete is None:
        raise ImageError(f"{path}: not an image of a known kind ({guess_contents(data)})")
    if not complete:
        raise ImageError(f"{path}: the image is cut short")
    size = image_size(data)
    if size is None or min(size) < 1:
        raise ImageError(f"{path}: damaged, the header names no size")
    if size[0] * size[1] > max_pixels:
        raise ImageError(f"{path}: {size[0]} x {size[1]} are more than the {max_pixels} pixels that are read (max_pixels)")
    return size


def _decode(data: bytes, path: Path, *, gray: bool, part: int) -> tuple[NDArray[Any], float]:
    """Pixels (h, w) or (h, w, 3) in red, green, blue order as stored, and the value that stands for white.

    A JPEG comes smaller by `part`: 1, 2, 4 or 8.
    """
    import cv2

    if is_netpbm(data):
        try:
            values, white = decode_netpbm(data)
        except ValueError as error:
            raise ImageError(f"{path}: {error}") from None
        if gray:
            return cv2.cvtColor(values, cv2.COLOR_RGB2GRAY) if values.ndim == 3 else values, white
        return values if values.ndim == 3 else np.repeat(values[:, :, None], 3, 2), white
    if is_heif(data):
        try:
            upright = decode_heif(data)
        except ValueError as error:
            raise ImageError(f"{path}: damaged, cannot be decoded ({' '.join(str(error).split())[:200]})") from None
        return cv2.cvtColor(upright, cv2.COLOR_RGB2GRAY) if gray else upright, 255.0
    opaque = not is_transparent_png(data)
    flags = cv2.IMREAD_ANYDEPTH | (cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR)
    if part > 1:
        flags = getattr(cv2, f"IMREAD_REDUCED_{'GRAYSCALE' if gray else 'COLOR'}_{part}")
    flags = flags | cv2.IMREAD_IGNORE_ORIENTATION if opaque else cv2.IMREAD_UNCHANGED
    try:
        array = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"{path}: cannot be decoded ({' '.join(str(error).split())[:200]})") from None
    if array is None or array.size == 0:
        raise ImageError(f"{path}: damaged, cannot be decoded")
    if array.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path}: pixels of type {array.dtype}; 8 or 16 bit integers are wanted")
    white = 255.0 if array.dtype == np.uint8 else 65535.0
    if array.ndim == 3 and array.shape[2] == 4:
        array = np.rint(array[:, :, :3] * (array[:, :, 3:] / white)).astype(array.dtype)
        array = cv2.cvtColor(array, cv2.COLOR_BGR2GRAY) if gray else array
    return array if gray else array[:, :, ::-1], white
