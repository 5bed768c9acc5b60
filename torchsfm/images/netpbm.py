"""The portable maps: PBM, PGM, PPM, plain and binary, 1 to 16 bits, every largest value (netpbm's pbm(5), pgm(5), ppm(5)).

Decoded here because OpenCV scales some of them by the largest value and others not.
"""

import re
from array import array
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

_GAP = rb"(?:\s|#[^\n]*\n)+"
_BITMAP = re.compile(rb"P([14])" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})\s")
_VALUES = re.compile(rb"P([2356])" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,5})\s")


def is_netpbm(data: bytes) -> bool:
    """Whether the bytes begin as a portable bit, grey or pixel map does."""
    return _BITMAP.match(data) is not None or _VALUES.match(data) is not None


def netpbm_size(data: bytes) -> tuple[int, int] | None:
    """Width and height; None where this is no portable map."""
    header = _BITMAP.match(data) or _VALUES.match(data)
    return None if header is None else (int(header[2]), int(header[3]))


def decode_netpbm(data: bytes) -> tuple[NDArray[Any], float]:
    """Pixels (h, w) or (h, w, 3) in red, green, blue order, uint8 or uint16, and the value that stands for white.

    Raises:
        ValueError: One line: what is wrong with the file.
    """
    if (bitmap := _BITMAP.match(data)) is not None:
        return _decode_bitmap(data[bitmap.end() :], bitmap[1] == b"4", int(bitmap[2]), int(bitmap[3])), 1.0
    header = _VALUES.match(data)
    if header is None:
        raise ValueError("not a portable map")
    kind, width, height, white = (int(group) for group in header.groups())
    if not (width and height and 0 < white < 65536):
        raise ValueError("the header has a zero or a value too large")
    shape = (height, width, 3) if kind in (3, 6) else (height, width)
    count = width * height * (3 if kind in (3, 6) else 1)
    if kind in (5, 6):
        stored = np.dtype(">u2") if white > 255 else np.dtype(np.uint8)
        if len(data) - header.end() < count * stored.itemsize:
            raise ValueError("the image is cut short")
        values = np.frombuffer(data, stored, count, header.end())
    else:
        # One word at a time: as a list they would take many times the memory of the image.
        words = islice(re.finditer(rb"\S+", data[header.end() :]), count)
        try:
            values = np.frombuffer(array("l", (min(int(word[0]), white) for word in words)), np.dtype("l"))
        except ValueError:
            raise ValueError("damaged: a pixel is not a number") from None
        if len(values) < count:
            raise ValueError("the image is cut short")
        if values.min() < 0:
            raise ValueError("damaged: a pixel is negative")
    values = np.minimum(values, white).astype(np.uint16 if white > 255 else np.uint8)
    return values.reshape(shape), float(white)


def _decode_bitmap(body: bytes, packed: bool, width: int, height: int) -> NDArray[Any]:
    """White is 1 here, though a set bit is black in the file."""
    if not (width and height):
        raise ValueError("the header has a zero")
    if packed:
        stride = (width + 7) // 8
        if len(body) < stride * height:
            raise ValueError("the image is cut short")
        rows = np.frombuffer(body, np.uint8, stride * height).reshape(height, stride)
        return np.asarray(1 - np.unpackbits(rows, axis=1)[:, :width])
    digits = re.sub(rb"\s", b"", body)[: width * height]
    if len(digits) < width * height or digits.strip(b"01"):
        raise ValueError("the image is cut short or damaged")
    return np.asarray(1 - (np.frombuffer(digits, np.uint8) - ord("0"))).reshape(height, width)
