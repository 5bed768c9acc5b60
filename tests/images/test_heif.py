"""HEIC, where its reader is installed; where it is not, what a user is told."""

import io
import struct
import sys
from pathlib import Path

import pytest
import torch

from torchsfm.images import ImageError, list_images, parse_exif, read_image

EXIF = (
    b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<H", 3)
    + struct.pack("<HHI", 0x0112, 3, 1) + b"\6\0\0\0"  # a quarter turn, which the encoder hands on to the decoder
    + struct.pack("<HHI", 0x010F, 2, 4) + b"Acme"
    + struct.pack("<HHI", 0x8769, 4, 1) + struct.pack("<I", 50) + bytes(4)
    + struct.pack("<H", 1) + struct.pack("<HHI", 0xA405, 3, 1) + struct.pack("<HH", 28, 0) + bytes(4)
)  # fmt: skip


def picture(width: int = 96, height: int = 64) -> torch.Tensor:
    """Smooth, red at the left and green at the bottom."""
    row, column = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    return torch.stack([1 - column, row, torch.full_like(row, 0.3)])


def heic(path: Path, pixels: torch.Tensor, **options: object) -> Path:
    """The picture as HEIC."""
    library = pytest.importorskip("pillow_heif")
    values = (255 * pixels).round().byte().permute(1, 2, 0).contiguous()
    mode = {1: "L", 3: "RGB", 4: "RGBA"}[values.shape[2]]
    data = io.BytesIO()
    library.encode(mode, (values.shape[1], values.shape[0]), values.numpy().tobytes(), data, quality=95, **options)
    path.write_bytes(data.getvalue())
    return path


def test_pixels_are_turned_once_and_tags_read(tmp_path: Path) -> None:
    path = heic(tmp_path / "a.HEIC", picture(), exif=EXIF)
    photo = read_image(path)
    assert photo.size == (photo.width, photo.height) == (64, 96)
    torch.testing.assert_close(photo.pixels, picture().rot90(-1, (1, 2)), rtol=0, atol=0.05)
    assert photo.make == "Acme"
    assert photo.focal == pytest.approx(28 / 43.2666153 * (96**2 + 64**2) ** 0.5)
    assert parse_exif(path.read_bytes()).orientation == 1
    gray = read_image(path, gray=True)
    assert gray.pixels.shape == (1, 96, 64)
    small = read_image(path, max_size=48)
    assert (small.width, small.height, small.size) == (32, 48, (64, 96))
    assert list_images(tmp_path) == [path]


def test_transparent_parts_are_black(tmp_path: Path) -> None:
    opacity = torch.ones(1, 64, 96)
    opacity[:, :, :48] = 0
    photo = read_image(heic(tmp_path / "a.heic", torch.cat([picture(), opacity])))
    assert float(photo.pixels[:, :, :40].max()) < 0.05
    torch.testing.assert_close(photo.pixels[:, :, 60:], picture()[:, :, 60:], rtol=0, atol=0.05)


def test_damaged_files(tmp_path: Path) -> None:
    path = heic(tmp_path / "a.heic", picture())
    data = path.read_bytes()
    for size in (0, 12, 100, len(data) // 2, len(data) - 5):
        path.write_bytes(data[:size])
        with pytest.raises(ImageError) as caught:
            read_image(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
    path.write_bytes(data)
    with pytest.raises(ImageError, match="96 x 64 are more than the 100 pixels"):
        read_image(path, max_pixels=100)


def test_without_the_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    assert list_images(tmp_path) == []
    with pytest.raises(ImageError, match=r"pip install 'torchsfm\[heic\]'"):
        read_image(tmp_path / "a.heic")
