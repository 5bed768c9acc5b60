"""What a camera wrote beside the pixels: orientation, maker, model, the numbers that give a focal length, and where it was.

The few tags needed are read straight from the bytes (TIFF 6.0; Exif 2.32, JEITA CP-3451; CIPA DC-008), in JPEG, PNG, TIFF and
WebP files; those of HEIC come from what decodes it. Positions also stand in XMP packets. Metadata is often damaged, so nothing
here raises: what cannot be read is absent.
"""

import math
import struct
from dataclasses import dataclass

from torchsfm.images.heif import heif_exif, is_heif
from torchsfm.images.xmp import Position, xmp_position

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8}
_INTEGERS = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i"}
_WANTED = {
    0x0100: "image_width",
    0x0101: "image_height",
    0x0142: "tile_image_width",
    0x0143: "tile_image_height",
    0x010F: "make",
    0x0110: "model",
    0x0112: "orientation",
    0x8769: "exif_offset",
    0x8825: "gps_offset",
    0x920A: "focal_mm",
    0xA405: "focal_35mm",
    0xA002: "width",
    0xA003: "height",
    0xA20E: "plane_x_resolution",
    0xA20F: "plane_y_resolution",
    0xA210: "plane_unit",
}
_OF_GPS = {1: "north", 2: "latitude", 3: "east", 4: "longitude", 5: "below", 6: "altitude"}
"""The tags of the directory of positions, which have numbers of their own."""
Value = str | int | float | tuple[float | None, ...]
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_DIAGONAL = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class Exif:
    """The tags of one photograph; `None` and the empty string stand for absent or senseless values.

    Example:
        >>> from torchsfm.images import Exif
        >>> Exif(focal_35mm=24.0).focal(4000, 3000)  # pixels
        2773.5009811261452
    """

    orientation: int = 1
    """1 to 8: how the stored pixels are to be turned, as Exif numbers it."""
    make: str = ""
    """Who made the camera."""
    model: str = ""
    """What the maker calls it."""
    focal_mm: float | None = None
    """The focal length of the lens, in millimetres."""
    focal_35mm: float | None = None
    """The focal length that gives the same diagonal angle of view on 36 mm x 24 mm film."""
    width: int | None = None
    """The width the camera wrote, before a program scaled or cropped the image."""
    height: int | None = None
    """The height."""
    plane_x_resolution: float | None = None
    """Pixels per millimetre on the sensor along x, for the size the camera wrote."""
    plane_y_resolution: float | None = None
    """The same along y."""
    latitude: float | None = None
    """Where the photograph was taken, degrees of WGS84, northern ones positive; there with the longitude or not at all."""
    longitude: float | None = None
    """The same, eastern ones positive."""
    altitude: float | None = None
    """Height in metres, above sea level or the ellipsoid, as the camera had it."""

    def focal(self, width: int, height: int) -> float | None:
        """The focal length in pixels of an image of the given stored size, or None where the tags do not tell.

        The 35 mm equivalent is taken by the diagonal, as CIPA DCG-001 defines it. A size written by the camera that has another
        aspect than the image means a crop of unknown scale: no focal length is given then.
        """
        long_side, short_side = max(width, height), min(width, height)
        camera_long = long_side
        if self.width and self.height:
            camera_long = max(self.width, self.height)
            camera_short = min(self.width, self.height)
            if abs(camera_long * short_side - camera_short * long_side) > 0.02 * camera_long * long_side:
                return None
        focal = None
        if self.focal_35mm:
            focal = self.focal_35mm / _FILM_DIAGONAL * math.hypot(width, height)
        elif self.focal_mm and self.plane_x_resolution:
            focal = self.focal_mm * self.plane_x_resolution * long_side / camera_long
        # Outside these bounds (about 4 to 165 degrees of view) the tags are wrong more often than the lens is special.
        return focal if focal is not None and 0.13 < focal / long_side < 15 else None


def parse_exif(data: bytes) -> Exif:
    """The Exif tags in the bytes of an image file (JPEG, PNG, TIFF, WebP, HEIC); an empty `Exif` where there are none.

    The position may also come from an XMP packet, as drones write it.

    A HEIC file tells its decoder how to turn the image, which then stands upright, whatever the tag says: its orientation is 1.

    Args:
        data: The whole file, or as much of its head as holds the tags.

    Example:
        >>> import torchsfm
        >>> torchsfm.images.parse_exif(b"no picture").focal_mm is None
        True
    """
    block = _find_block(data)
    tags = read_tags(block) if block is not None else {}

    def number(name: str) -> float | None:
        value = tags.get(name)
        return float(value) if isinstance(value, int | float) and math.isfinite(value) and value > 0 else None

    def integer(name: str) -> int | None:
        value = number(name)
        return None if value is None else int(value)

    def text(name: str) -> str:
        value = tags.get(name)
        return value if isinstance(value, str) else ""

    # A position with a height is worth more than one without, whoever wrote it.
    places = [place for place in (_position(tags), xmp_position(data)) if place is not None]
    latitude, longitude, altitude = max(places, key=lambda place: place[2] is not None, default=(None, None, None))
    orientation = 1 if is_heif(data) else integer("orientation") or 1
    per_unit = _MILLIMETRES.get(integer("plane_unit") or 2)
    x_resolution, y_resolution = number("plane_x_resolution"), number("plane_y_resolution")
    return Exif(
        orientation=orientation if 1 <= orientation <= 8 else 1,
        make=text("make"),
        model=text("model"),
        focal_mm=number("focal_mm"),
        focal_35mm=number("focal_35mm"),
        width=integer("width"),
        height=integer("height"),
        plane_x_resolution=x_resolution / per_unit if x_resolution and per_unit else None,
        plane_y_resolution=y_resolution / per_unit if y_resolution and per_unit else None,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
    )


def _position(tags: dict[str, Value]) -> Position | None:
    """Where the photograph was taken, as the tags say."""
    latitude, longitude = _degrees(tags, "latitude", "north", "S", 90.0), _degrees(tags, "longitude", "east", "W", 180.0)
    # A receiver that does not know writes zeros.
    if latitude is None or longitude is None or (latitude, longitude) == (0, 0):
        return None
    height = tags.get("altitude")
    up = height if isinstance(height, int | float) and math.isfinite(height) else None
    return latitude, longitude, -up if up is not None and tags.get("below") == 1 else up


def _degrees(tags: dict[str, Value], name: str, side: str, negative: str, limit: float) -> float | None:
    """An angle written as degrees, minutes and seconds; None where it is none."""
    parts = tags.get(name)
    if not isinstance(parts, tuple) or not 1 <= len(parts) <= 3:
        return None
    # Minutes or seconds that are absent are 0/0 in some files.
    numbers = [parts[0], *(part or 0.0 for part in parts[1:])]
    if any(n is None or not 0 <= n <= limit for n in numbers):
        return None
    angle = math.fsum((n or 0.0) / 60.0**k for k, n in enumerate(numbers))
    if angle > limit:
        return None
    return -angle if str(tags.get(side, ""))[:1].upper() == negative else angle


def _find_block(data: bytes) -> bytes | None:
    """The TIFF structure that holds the tags."""
    if data[:2] == b"\xff\xd8":
        return _find_in_jpeg(data)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return _find_in_chunks(data, 8, b"eXIf", ">", length_first=True)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        block = _find_in_chunks(data, 12, b"EXIF", "<", length_first=False)
        return block[6:] if block is not None and block[:6] == b"Exif\0\0" else block
    if is_heif(data):
        return heif_exif(data)
    return data if data[:4] in (b"II*\0", b"MM\0*") else None


def _find_in_jpeg(data: bytes) -> bytes | None:
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker in (0xD9, 0xDA):
            return None
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xE1 and data[position + 4 : position + 10] == b"Exif\0\0":
            return data[position + 10 : position + 2 + length]
        position += 2 + length
    return None


def _find_in_chunks(data: bytes, position: int, wanted: bytes, order: str, *, length_first: bool) -> bytes | None:
    while position + 8 <= len(data):
        first, second = data[position : position + 4], data[position + 4 : position + 8]
        name, size = (second, first) if length_first else (first, second)
        (length,) = struct.unpack(order + "I", size)
        if name == wanted:
            return data[position + 8 : position + 8 + length]
        position += 8 + length + (4 if length_first else length % 2)  # PNG: a checksum follows; RIFF: chunks are padded to even
    return None


def read_tags(block: bytes) -> dict[str, Value]:
    """The tags wanted here in a TIFF structure, by name."""
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    tags: dict[str, Value] = {}
    if order is None or len(block) < 8:
        return tags
    (offset,) = struct.unpack_from(order + "I", block, 4)
    _read_directory(block, order, offset, _WANTED, tags)
    for pointer, wanted in (("exif_offset", _WANTED), ("gps_offset", _OF_GPS)):
        further = tags.get(pointer)
        if isinstance(further, int):
            _read_directory(block, order, further, wanted, tags)
    return tags


def _read_directory(block: bytes, order: str, offset: int, wanted: dict[int, str], tags: dict[str, Value]) -> None:
    if offset < 8 or offset + 2 > len(block):
        return
    (count,) = struct.unpack_from(order + "H", block, offset)
    for start in range(offset + 2, min(offset + 2 + 12 * count, len(block) - 11), 12):
        tag, kind, number = struct.unpack_from(order + "HHI", block, start)
        if tag not in wanted or kind not in _SIZES or number == 0:
            continue
        size = _SIZES[kind] * number
        place = start + 8 if size <= 4 else struct.unpack_from(order + "I", block, start + 8)[0]
        if place + size > len(block):
            continue
        value: Value | None = None
        if kind == 2:
            raw = block[place : place + size].split(b"\0")[0]
            value = "".join(c for c in raw.decode("utf-8", "replace") if c.isprintable()).strip()
        elif kind in (5, 10):
            form = order + ("2I" if kind == 5 else "2i")
            pairs = (struct.unpack_from(form, block, place + 8 * k) for k in range(min(number, 3)))
            ratios = tuple(above / below if below else None for above, below in pairs)
            value = ratios if wanted[tag] in ("latitude", "longitude") else ratios[0]
        elif kind in _INTEGERS:
            value = struct.unpack_from(order + _INTEGERS[kind], block, place)[0]
        if value is not None:
            tags.setdefault(wanted[tag], value)  # of a tag that is there twice decoders take the first
