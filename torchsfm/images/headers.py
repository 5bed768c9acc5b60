"""What the first bytes of an image file say, before anything is decoded: the size, and whether all of the image is there."""

from torchsfm.images.exif import read_tags
from torchsfm.images.heif import MISSING, heif_library, heif_size, is_heif
from torchsfm.images.netpbm import netpbm_size


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of the stored image; None where the file is of no kind known here, or does not say."""
    if data[:3] == b"\xff\xd8\xff":
        return _jpeg_size(data)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return (_big(data[16:20]), _big(data[20:24])) if len(data) >= 24 else None
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _webp_size(data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        # What is decoded is a whole tile at least.
        tags = read_tags(data)
        sides = [(tags.get(name), tags.get(f"tile_{name}", 0)) for name in ("image_width", "image_height")]
        found = [max(side, tile) for side, tile in sides if isinstance(side, int) and isinstance(tile, int)]
        return (found[0], found[1]) if len(found) == 2 else None
    if data[:2] == b"BM" and len(data) >= 26:
        if _little(data[14:18]) == 12:
            return _little(data[18:20]), _little(data[20:22])
        # A negative height says that the rows come from the top.
        return _little(data[18:22]), abs(int.from_bytes(data[22:26], "little", signed=True))
    return heif_size(data) if is_heif(data) else netpbm_size(data)


def is_transparent_png(data: bytes) -> bool:
    """Whether this is a PNG whose pixels have an opacity each."""
    return data[:8] == b"\x89PNG\r\n\x1a\n" and data[25:26] in (b"\4", b"\6")


def is_complete(data: bytes) -> bool | None:
    """Whether the file holds all of its image; None where it is no image known here."""
    if data[:3] == b"\xff\xd8\xff":
        # Inside the coded data 0xff is always followed by 0 or a restart mark.
        return data.find(b"\xff\xd9", _jpeg_segments(data)[-1][1]) >= 0
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        position = 8
        while position + 12 <= len(data):
            if data[position + 4 : position + 8] == b"IEND":
                return True
            position += 12 + _big(data[position : position + 4])
        return False
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return len(data) >= 8 + _little(data[4:8])
    if data[:4] in (b"II*\0", b"MM\0*"):
        return True
    if data[:2] == b"BM":
        return len(data) >= _little(data[2:6])
    return True if is_heif(data) and heif_library() is not None else None


def guess_contents(data: bytes) -> str:
    """What a file that is no image may be."""
    if is_heif(data):
        return MISSING
    if data[4:8] == b"ftyp":
        return (
            "a sequence of images, or AVIF: convert it to JPEG or PNG" if data[8:11] in (b"hev", b"msf", b"avi") else "a film"
        )
    head = data[:512]
    text = sum(byte in b"\t\n\r" or 32 <= byte < 127 for byte in head) > 0.95 * len(head)
    return "it looks like text" if text else "unknown contents"


def _jpeg_segments(data: bytes) -> list[tuple[int, int]]:
    """Marker and place of each segment before the coded data, and of those data or the end."""
    segments, position = [], 2
    while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] != 0xDA:
        if data[position + 1] == 0xFF:  # a fill byte
            position += 1
            continue
        segments.append((data[position + 1], position))
        position += 2 + _big(data[position + 2 : position + 4])
    return [*segments, (0xDA, position)]


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    for marker, place in _jpeg_segments(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and place + 9 <= len(data):
            return _big(data[place + 7 : place + 9]), _big(data[place + 5 : place + 7])
    return None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if len(data) < 30:
        return None
    if kind == b"VP8 ":
        return _little(data[26:28]) & 0x3FFF, _little(data[28:30]) & 0x3FFF
    if kind == b"VP8L":
        bits = _little(data[21:25])
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return (_little(data[24:27]) + 1, _little(data[27:30]) + 1) if kind == b"VP8X" else None


def _big(data: bytes) -> int:
    return int.from_bytes(data, "big")


def _little(data: bytes) -> int:
    return int.from_bytes(data, "little")
