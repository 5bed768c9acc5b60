"""Exif tags, and files that have them."""

import struct

import cv2
import numpy as np

MAKE, MODEL, ORIENTATION, EXIF_OFFSET = 0x010F, 0x0110, 0x0112, 0x8769
FOCAL, FOCAL_35MM, WIDTH, HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
X_RESOLUTION, UNIT = 0xA20E, 0xA210

Value = int | str | tuple[int, int]


def directory(tags: dict[int, Value], order: str, offset: int) -> bytes:
    """One TIFF directory at `offset`, its longer values right after it."""
    body = struct.pack(order + "H", len(tags))
    extra, place = b"", offset + 2 + 12 * len(tags) + 4
    for tag, value in sorted(tags.items()):
        if isinstance(value, str):
            raw, kind, count = value.encode() + b"\0", 2, len(value.encode()) + 1
        elif isinstance(value, tuple):
            raw, kind, count = struct.pack(order + "2I", *value), 5, 1
        elif tag == EXIF_OFFSET:
            raw, kind, count = struct.pack(order + "I", value), 4, 1
        else:
            raw, kind, count = struct.pack(order + "H", value), 3, 1
        if len(raw) > 4:
            body += struct.pack(order + "HHII", tag, kind, count, place + len(extra))
            extra += raw + b"\0" * (len(raw) % 2)
        else:
            body += struct.pack(order + "HHI", tag, kind, count) + raw.ljust(4, b"\0")
    return body + b"\0\0\0\0" + extra


def tiff_block(first: dict[int, Value], second: dict[int, Value], order: str = "<") -> bytes:
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    size = len(directory({**first, EXIF_OFFSET: 0}, order, 8))
    start = directory({**first, EXIF_OFFSET: 8 + size}, order, 8)
    return head + start + directory(second, order, 8 + size)


def into_jpeg(jpeg: bytes, block: bytes) -> bytes:
    payload = b"Exif\0\0" + block
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def encode(array: np.ndarray, suffix: str) -> bytes:
    done, data = cv2.imencode(suffix, array)
    assert done
    return bytes(data.tobytes())
