"""Where a photograph was taken, as its XMP packet says: what drones and editors write beside Exif, or in its place.

A packet is text in whatever file (ISO 16684-1), found by looking for its beginning. Positions are read as Exif for XMP writes
them, `55,42.5N`, and as drones do, in degrees. Packets are often damaged: what cannot be read is absent.
"""

import math
import re

LARGEST = 1 << 20
"""Bytes of a packet; larger ones are none."""
_FIELD = re.compile(
    r"\b(?:exif|drone(?:-\w+)?):(?:Gps)?(?P<name>Latitude|Longt?itude|Altitude(?:Ref)?|AbsoluteAltitude)"
    r"(?:\s*=\s*[\"'](?P<value>[^\"'<>]*)[\"']|\s*>(?P<text>[^<]*)<)",
    re.IGNORECASE,
)
"""A property as an attribute or as an element; some drones write `Longtitude`."""
_ALIKE = {"longtitude": "longitude", "absolutealtitude": "altitude"}
_ANGLE = re.compile(r"(\d{1,3}),(\d{1,2}(?:\.\d+)?)(?:,(\d{1,2}(?:\.\d+)?))?([NSEW])")
"""Degrees, minutes and, where minutes are whole, seconds."""
_NUMBER = re.compile(r"([+-]?\d{1,9}(?:\.\d*)?)(?:/(\d{1,9}))?")

Position = tuple[float, float, float | None]
"""Degrees north and east, and metres where a height is known."""


def xmp_position(data: bytes) -> Position | None:
    """The position in the first XMP packet of a file's bytes; None where there is none."""
    start = data.find(b"<rdf:RDF")
    end = data.find(b"</rdf:RDF>", start, start + LARGEST) if start >= 0 else -1
    if end < 0:
        return None
    found: dict[str, str] = {}
    for field in _FIELD.finditer(data[start:end].decode("utf-8", "replace")):
        name = field["name"].lower()
        found.setdefault(_ALIKE.get(name, name), (field["value"] or field["text"] or "").strip())
    latitude, longitude = _degrees(found.get("latitude", ""), "NS", 90.0), _degrees(found.get("longitude", ""), "EW", 180.0)
    # A receiver that does not know writes zeros.
    if latitude is None or longitude is None or (latitude, longitude) == (0, 0):
        return None
    height = _number(found.get("altitude", ""))
    return latitude, longitude, -height if height is not None and found.get("altituderef") == "1" else height


def _degrees(text: str, sides: str, limit: float) -> float | None:
    """An angle, positive to the first of the two sides."""
    angle = _number(text)
    if match := _ANGLE.fullmatch(text.upper()):
        *parts, side = match.groups()
        if side not in sides:
            return None
        angle = math.fsum(float(part or 0) / 60.0**k for k, part in enumerate(parts)) * (1 if side == sides[0] else -1)
    return angle if angle is not None and abs(angle) <= limit else None


def _number(text: str) -> float | None:
    """A number, or a fraction."""
    match = _NUMBER.fullmatch(text)
    if match is None or not float(match[2] or 1):
        return None
    return float(match[1]) / float(match[2] or 1)
