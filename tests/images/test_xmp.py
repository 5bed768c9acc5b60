"""Positions in XMP packets: both ways in which they are written, in whatever file."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import torch

from torchsfm.images import parse_exif

F64 = torch.float64
HEAD = '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
TAIL = '</x:xmpmeta><?xpacket end="w"?>'


def packet(fields: dict[str, str], *, elements: bool = False) -> bytes:
    """Properties as attributes, as drones write them, or as elements."""
    rows = "".join(f"<{k}>{v}</{k}>" if elements else f' {k}="{v}"' for k, v in fields.items())
    body = f"<rdf:Description>{rows}</rdf:Description>" if elements else f"<rdf:Description {rows}/>"
    rdf = f'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">{body}</rdf:RDF>'
    return (HEAD + rdf + TAIL).encode()


def files(content: bytes) -> dict[str, bytes]:
    """Pictures that hold a packet where each kind has it."""
    picture = np.zeros((8, 8), np.uint8)
    made = {end: bytes(cv2.imencode(end, picture)[1]) for end in (".jpg", ".png", ".webp", ".tif")}
    block = b"http://ns.adobe.com/xap/1.0/\0" + content
    text = b"iTXtXML:com.adobe.xmp\0\0\0\0\0" + content
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    return {
        "jpg": made[".jpg"][:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + made[".jpg"][2:],
        "png": made[".png"][:33] + chunk + made[".png"][33:],
        "webp": made[".webp"] + b"XMP " + struct.pack("<I", len(content)) + content,
        "tif": made[".tif"] + content,
    }


def of_drone(latitude: float, longitude: float, height: float) -> dict[str, str]:
    return {
        "drone-dji:AbsoluteAltitude": f"{height:+.2f}", "drone-dji:RelativeAltitude": "+12.30",
        "drone-dji:GpsLatitude": f"{latitude:+.9f}", "drone-dji:GpsLongitude": f"{longitude:+.9f}",
        "drone-dji:GimbalPitchDegree": "-89.90",
    }  # fmt: skip


def of_exif(latitude: float, longitude: float, height: float) -> dict[str, str]:
    def angle(value: float, sides: str) -> str:
        degrees = int(abs(value))
        return f"{degrees},{(abs(value) - degrees) * 60:.8f}{sides[value < 0]}"

    return {
        "exif:GPSAltitude": f"{round(abs(height) * 100)}/100", "exif:GPSAltitudeRef": str(int(height < 0)),
        "exif:GPSDestLatitude": "1,2.0N", "exif:GPSLatitude": angle(latitude, "NS"),
        "exif:GPSLongitude": angle(longitude, "EW"),
    }  # fmt: skip


def test_both_ways_of_writing_in_every_file(generator: torch.Generator) -> None:
    for _ in range(10):
        u = 2 * torch.rand(3, generator=generator, dtype=F64) - 1
        latitude, longitude, height = (u * torch.tensor([90.0, 180.0, 400.0])).tolist()
        for write in (of_drone, of_exif):
            for elements in (False, True):
                for kind, data in files(packet(write(latitude, longitude, height), elements=elements)).items():
                    exif = parse_exif(data)
                    assert exif.latitude == pytest.approx(latitude, abs=1e-8), (kind, write)
                    assert exif.longitude == pytest.approx(longitude, abs=1e-8), (kind, write)
                    assert exif.altitude == pytest.approx(height, abs=6e-3), (kind, write)


def test_seconds_and_the_misspelt_longitude() -> None:
    found = parse_exif(packet({"exif:GPSLatitude": "55,42,18S", "drone-dji:GpsLongtitude": "13.25"}))
    assert found.latitude == pytest.approx(-(55 + 42 / 60 + 18 / 3600))
    assert (found.longitude, found.altitude) == (13.25, None)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"exif:GPSLatitude": "55,42N"},
        {"drone-dji:GpsLatitude": "+0.000000", "drone-dji:GpsLongitude": "+0.000000", "drone-dji:AbsoluteAltitude": "+1.00"},
        {"drone-dji:GpsLatitude": "95.0", "drone-dji:GpsLongitude": "13.0"},
        {"exif:GPSLatitude": "55,42E", "exif:GPSLongitude": "13,1E"},
        {"drone-dji:GpsLatitude": "nan", "drone-dji:GpsLongitude": "inf"},
        {"drone-dji:GpsLatitude": "1e3000", "drone-dji:GpsLongitude": "13"},
        {"other:Latitude": "55.0", "other:Longitude": "13.0"},
    ],
)
def test_what_is_no_position(fields: dict[str, str]) -> None:
    assert (parse_exif(packet(fields)).latitude, parse_exif(packet(fields)).longitude) == (None, None)


def test_damaged_packets(generator: torch.Generator) -> None:
    data = bytearray(files(packet(of_drone(55.7, 13.2, 80.0)))["jpg"])
    for _ in range(300):
        spoilt = bytearray(data)
        for place in torch.randint(len(data), (8,), generator=generator).tolist():
            spoilt[place] = int(torch.randint(256, (), generator=generator))
        found = parse_exif(bytes(spoilt[: int(torch.randint(len(data), (), generator=generator))]))
        assert (found.latitude is None) == (found.longitude is None)
        assert found.latitude is None or abs(found.latitude) <= 90
    without_height = packet({"drone-dji:GpsLatitude": "5", "drone-dji:GpsLongitude": "6", "drone-dji:AbsoluteAltitude": "1/0"})
    assert parse_exif(without_height).altitude is None
