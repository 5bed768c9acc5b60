import os
import struct
import sys
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from chance import seeded
from exif_blocks import (
    FOCAL,
    FOCAL_35MM,
    HEIGHT,
    MAKE,
    MODEL,
    ORIENTATION,
    UNIT,
    WIDTH,
    X_RESOLUTION,
    Value,
    encode,
    into_jpeg,
    tiff_block,
)
from hypothesis import given
from hypothesis import strategies as st

from torchsfm.images import Exif, ImageError, list_images, list_skipped, parse_exif, read_image, save_image, scale_image
from torchsfm.images.headers import image_size
from torchsfm.images.heif import heif_library
from torchsfm.images.netpbm import decode_netpbm, is_netpbm


def into_png(png: bytes, block: bytes) -> bytes:
    chunk = struct.pack(">I", len(block)) + b"eXIf" + block + struct.pack(">I", zlib.crc32(b"eXIf" + block))
    return png[:33] + chunk + png[33:]  # after IHDR


@pytest.fixture
def picture() -> np.ndarray:
    """Smooth enough to survive JPEG, without any symmetry; blue, green, red."""
    y, x = np.mgrid[:48, :80] / 80
    return np.stack([255 * x, 200 * y + 40 * x, 255 * (1 - x) * (1 - y)], 2).astype(np.uint8)


@pytest.mark.parametrize("white", [255, 65535])
@pytest.mark.parametrize("gray", [False, True])
def test_what_is_transparent_is_black_in_proportion(tmp_path: Path, gray: bool, white: int) -> None:
    drawn = np.full((12, 20, 4), white, dtype=np.uint8 if white == 255 else np.uint16)
    opacity = np.linspace(0, white, 20).round().astype(drawn.dtype)
    drawn[:, :, 3] = opacity
    assert cv2.imwrite(str(tmp_path / "a.png"), drawn)
    pixels = read_image(tmp_path / "a.png", gray=gray).pixels
    assert pixels.shape == (1 if gray else 3, 12, 20)
    torch.testing.assert_close(pixels, torch.from_numpy(opacity / white).float().expand_as(pixels), rtol=0, atol=1e-6)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".ppm"])
def test_lossless_formats_give_the_exact_pixels(tmp_path: Path, picture: np.ndarray, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(encode(picture, suffix))
    photo = read_image(tmp_path / f"a{suffix}")
    assert photo.pixels.dtype == torch.float32
    assert photo.pixels.is_contiguous()
    expected = torch.from_numpy(picture[:, :, ::-1].copy()).permute(2, 0, 1)
    torch.testing.assert_close(photo.pixels, expected.float() / 255, rtol=0, atol=0)
    assert (photo.width, photo.height, photo.size, photo.name) == (80, 48, (80, 48), f"a{suffix}")
    assert photo.focal is None


def test_jpeg_and_webp_come_close(tmp_path: Path, picture: np.ndarray) -> None:
    expected = torch.from_numpy(picture[:, :, ::-1].copy()).permute(2, 0, 1).float() / 255
    for suffix in (".jpg", ".webp"):
        (tmp_path / f"a{suffix}").write_bytes(encode(picture, suffix))
        assert (read_image(tmp_path / f"a{suffix}").pixels - expected).abs().max() < 0.06


def test_gray_is_one_channel_of_luma(tmp_path: Path, picture: np.ndarray) -> None:
    for suffix in (".png", ".ppm"):
        (tmp_path / f"a{suffix}").write_bytes(encode(picture, suffix))
        gray = read_image(tmp_path / f"a{suffix}", gray=True).pixels
        r, g, b = read_image(tmp_path / f"a{suffix}").pixels
        assert gray.shape == (1, 48, 80)
        assert (gray[0] - (0.299 * r + 0.587 * g + 0.114 * b)).abs().max() < 1.01 / 255


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".tif"])
def test_sixteen_bits_are_kept(tmp_path: Path, suffix: str) -> None:
    ramp = torch.linspace(0, 1, 5000, dtype=torch.float64).reshape(1, 50, 100)
    save_image(tmp_path / f"a{suffix}", ramp, bits=16)
    read = read_image(tmp_path / f"a{suffix}", gray=True).pixels
    assert (read.double() - ramp).abs().max() < 0.51 / 65535 + 1e-7
    assert read_image(tmp_path / f"a{suffix}").pixels.shape == (3, 50, 100)


@pytest.mark.parametrize(
    ("data", "white", "values"),
    [
        (b"P5\n4 1\n15\n\x00\x05\x0a\x0f", 15, [0, 5, 10, 15]),
        (b"P5 # a comment\n# and another\n 4 1 15\n\x00\x05\x0a\x0f", 15, [0, 5, 10, 15]),
        (b"P5\n4 1\n255\n \n#!", 255, [32, 10, 35, 33]),  # pixels that look like spaces and comments
        (b"P2\n4 1\n15\n0 5\n10 15\n", 15, [0, 5, 10, 15]),
        (b"P5\n2 1\n1023\n\x01\x00\x03\xff", 1023, [256, 1023]),
        (b"P5\n2 1\n100\n\x64\xff", 100, [100, 100]),  # above the largest value
        (b"P4\n10 1\n\xaa\x40", 1, [0, 1, 0, 1, 0, 1, 0, 1, 1, 0]),
        (b"P1\n# x\n4 1\n1 0\n10", 1, [0, 1, 0, 1]),
        (b"P3\n1 1\n255\n1 2 3\n", 255, [1, 2, 3]),
        (b"P6\n1 1\n255\n\x01\x02\x03", 255, [1, 2, 3]),
    ],
)
def test_portable_maps(data: bytes, white: int, values: list[int]) -> None:
    assert is_netpbm(data)
    array, largest = decode_netpbm(data)
    assert array.flatten().tolist() == values
    assert largest == white


def write_oriented(array: np.ndarray, orientation: int) -> np.ndarray:
    """The array as a camera held that way stores it, from Exif's words for what row 0 and column 0 of the stored array are."""
    row0, column0 = {
        1: ("top", "left"),
        2: ("top", "right"),
        3: ("bottom", "right"),
        4: ("bottom", "left"),
        5: ("left", "top"),
        6: ("right", "top"),
        7: ("right", "bottom"),
        8: ("left", "bottom"),
    }[orientation]
    if row0 in ("left", "right"):
        array = array.swapaxes(0, 1)
    if row0 in ("right", "bottom"):
        array = array[::-1]
    if column0 in ("right", "bottom"):
        array = array[:, ::-1]
    return np.ascontiguousarray(array)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", ["<", ">"])
def test_every_orientation_is_turned_upright(tmp_path: Path, picture: np.ndarray, orientation: int, order: str) -> None:
    stored = write_oriented(picture, orientation)
    block = tiff_block({ORIENTATION: orientation}, {FOCAL_35MM: 28}, order)
    expected = torch.from_numpy(picture[:, :, ::-1].copy()).permute(2, 0, 1).float() / 255
    for name, data in (
        ("a.jpg", into_jpeg(encode(stored, ".jpg"), block)),
        ("a.png", into_png(encode(stored, ".png"), block)),
    ):
        (tmp_path / name).write_bytes(data)
        photo = read_image(tmp_path / name)
        assert photo.size == (80, 48)
        assert (photo.pixels - expected).abs().max() < (0.06 if name == "a.jpg" else 1e-6)
        assert (read_image(tmp_path / name, gray=True).pixels[0].shape) == (48, 80)
        assert photo.focal == pytest.approx(28 / np.hypot(36, 24) * np.hypot(80, 48))


def test_the_tags_of_a_camera(picture: np.ndarray) -> None:
    block = tiff_block({MAKE: "Acme ", MODEL: "Ix 1"}, {FOCAL: (50, 10), WIDTH: 4000, HEIGHT: 3000})
    exif = parse_exif(into_jpeg(encode(picture, ".jpg"), block))
    assert exif == Exif(make="Acme", model="Ix 1", focal_mm=5.0, width=4000, height=3000)
    assert exif.focal(4000, 3000) is None  # millimetres alone do not give pixels


@pytest.mark.parametrize(("unit", "millimetres"), [(2, 25.4), (3, 10.0), (4, 1.0)])
def test_focal_from_the_sensor_resolution(unit: int, millimetres: float) -> None:
    # A 6 mm wide sensor of 4000 pixels behind a 7.5 mm lens: f = 5000 pixels.
    per_unit = round(4000 / 6 * millimetres * 1000)
    tags: dict[int, Value] = {FOCAL: (75, 10), X_RESOLUTION: (per_unit, 1000), UNIT: unit, WIDTH: 4000, HEIGHT: 3000}
    exif = parse_exif(tiff_block({}, tags))
    assert exif.focal(4000, 3000) == pytest.approx(5000, rel=1e-4)
    assert exif.focal(1000, 750) == pytest.approx(1250, rel=1e-4)  # scaled by a program
    assert exif.focal(750, 1000) == pytest.approx(1250, rel=1e-4)  # and turned
    assert exif.focal(1000, 500) is None  # cropped


def test_focal_follows_max_size(tmp_path: Path, picture: np.ndarray) -> None:
    (tmp_path / "a.jpg").write_bytes(into_png(encode(picture, ".png"), tiff_block({}, {FOCAL_35MM: 28})))
    whole, small = read_image(tmp_path / "a.jpg"), read_image(tmp_path / "a.jpg", max_size=40)
    assert small.pixels.shape == (3, 24, 40)
    assert small.size == (80, 48)
    assert whole.focal is not None
    assert small.focal == pytest.approx(whole.focal / 2)
    averaged = torch.nn.functional.avg_pool2d(whole.pixels, 2)
    assert (small.pixels - averaged).abs().max() < 1 / 255
    assert read_image(tmp_path / "a.jpg", max_size=100).pixels.shape == (3, 48, 80)
    with pytest.raises(ValueError, match="max_size"):
        read_image(tmp_path / "a.jpg", max_size=0)


@pytest.mark.parametrize("tags", [{FOCAL_35MM: 0}, {FOCAL_35MM: 65535}, {FOCAL: (5, 0)}, {FOCAL: (5, 1), X_RESOLUTION: (0, 1)}])
def test_senseless_tags_are_absent(tags: dict[int, Value]) -> None:
    assert parse_exif(tiff_block({ORIENTATION: 77}, tags)).focal(4000, 3000) is None
    assert parse_exif(tiff_block({ORIENTATION: 77}, tags)).orientation == 1


GOOD = tiff_block({MAKE: "Acme", ORIENTATION: 6}, {FOCAL: (50, 10), FOCAL_35MM: 35, WIDTH: 40})


@given(
    st.binary(max_size=200),
    st.integers(0, len(GOOD)),
    st.sampled_from([b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*"]),
)
def test_damaged_metadata_never_raises(noise: bytes, cut: int, head: bytes) -> None:
    for data in (
        head + noise,
        GOOD[:cut],
        GOOD[:cut] + noise + GOOD[cut + len(noise) :],
        into_jpeg(b"\xff\xd8" + noise, GOOD[:cut]),
    ):
        exif = parse_exif(data)
        assert 1 <= exif.orientation <= 8
        focal = exif.focal(640, 480)
        assert focal is None or 0 < focal < 1e5


@given(st.binary(max_size=60), st.sampled_from([b"P%d 3 2 255\n", b"P%d\n3 2\n", b"P%d 3"]), st.integers(1, 6))
def test_damaged_maps_raise_only_value_errors(noise: bytes, head: bytes, kind: int) -> None:
    data = head % kind + noise
    if is_netpbm(data):
        with suppress(ValueError):
            array, white = decode_netpbm(data)
            assert array.size > 0
            assert array.max() <= white


def test_phone_photographs(data: Path) -> None:
    photo = read_image(data / "images" / "opensfm_berlin" / "images" / "01.jpg")
    assert photo.size == (3264, 2448)
    # These tags say 35 mm; another program's estimate from the images is 0.87 of the longer side.
    assert photo.focal == pytest.approx(35 / np.hypot(36, 24) * 4080)


def test_bad_files_say_why_in_one_line(tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]) -> None:
    whole = {suffix: encode(picture, suffix) for suffix in (".jpg", ".png", ".ppm", ".webp", ".bmp", ".tif")}
    files = {
        "empty.jpg": (b"", "empty"),
        "text.jpg": (b"not an image at all\n" * 5, "looks like text"),
        "noise.png": (bytes(range(128, 256)) * 3, "unknown"),
        "phone.heic": (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC" if heif_library() is None else "the header names no size"),
        "float.tif": (encode(picture.astype(np.float32), ".tif"), "float32"),
        **{f"half{suffix}": (data[: len(data) // 2], "cut short|damaged") for suffix, data in whole.items()},
        **{f"most{suffix}": (data[:-5], "cut short|damaged") for suffix, data in whole.items() if suffix != ".tif"},
        "header.png": (whole[".png"][:20], "cut short"),
        "middle.png": (whole[".png"][:60] + b"\0" * 40 + whole[".png"][100:], "damaged"),
        "long.pgm": (b"P5 9999 9999 255\n0", "cut short"),
        "huge.pgm": (b"P5 999999999 999999999 255\n0", "999999999 x 999999999 are more than"),
    }
    for name, (data, reason) in files.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ImageError, match=reason) as caught:
            read_image(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
        assert "\n" not in str(caught.value)
    with pytest.raises(ImageError, match="no such file"):
        read_image(tmp_path / "missing.jpg")
    with pytest.raises(ImageError, match="folder"):
        read_image(tmp_path)
    capfd.readouterr()  # the decoders' own complaints


def test_forbidden_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    (tmp_path / "a.png").touch()
    with pytest.raises(ImageError, match=r"cannot be read \(Permission denied"):
        read_image(tmp_path / "a.png")
    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(ImageError, match=r"cannot be read \(Permission denied"):
        list_images(tmp_path)


def test_a_thumbnail_does_not_hide_a_cut(tmp_path: Path, picture: np.ndarray) -> None:
    jpeg = encode(picture, ".jpg")
    with_thumbnail = into_jpeg(jpeg, GOOD + jpeg)
    (tmp_path / "a.jpg").write_bytes(with_thumbnail)
    assert read_image(tmp_path / "a.jpg").size == (48, 80)
    (tmp_path / "b.jpg").write_bytes(with_thumbnail[:-30])
    with pytest.raises(ImageError, match="cut short"):
        read_image(tmp_path / "b.jpg")


def test_a_large_photograph(tmp_path: Path) -> None:
    row = torch.linspace(0, 1, 8000).expand(6000, 8000)
    save_image(tmp_path / "large.jpg", row)
    photo = read_image(tmp_path / "large.jpg", gray=True)
    assert photo.pixels.shape == (1, 6000, 8000)
    assert (photo.pixels[0, 3000] - row[0]).abs().max() < 0.02
    assert read_image(tmp_path / "large.jpg", max_size=1600).pixels.shape == (3, 1200, 1600)


def test_list_images_in_natural_order(tmp_path: Path) -> None:
    for name in ("v10.jpg", "v2.JPG", "v1.png", "a.PGM", "notes.txt", ".hidden.jpg", "V3.jpeg"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder.jpg").mkdir()
    assert [path.name for path in list_images(tmp_path)] == ["a.PGM", "v1.png", "v2.JPG", "V3.jpeg", "v10.jpg"]
    with pytest.raises(ImageError, match="no such folder"):
        list_images(tmp_path / "missing")
    with pytest.raises(ImageError, match="not a folder"):
        list_images(tmp_path / "v1.png")


def test_save_image(tmp_path: Path) -> None:
    values = torch.tensor([[-1.0, 0.0, 0.2], [1.0, 2.0, torch.nan]])
    for suffix in (".png", ".pgm", ".bmp", ".tif"):
        save_image(tmp_path / f"a{suffix}", values)
        expected = torch.tensor([[[0.0, 0.0, 0.2], [1.0, 1.0, 0.0]]])
        torch.testing.assert_close(read_image(tmp_path / f"a{suffix}", gray=True).pixels, expected)
    color = torch.rand(3, 5, 7, generator=seeded(1))
    save_image(tmp_path / "b.png", color)
    assert (read_image(tmp_path / "b.png").pixels - color).abs().max() < 0.51 / 255
    save_image(tmp_path / "b.ppm", values)
    torch.testing.assert_close(read_image(tmp_path / "b.ppm").pixels, expected.expand(3, 2, 3))
    with pytest.raises(ValueError, match=r"\.pgm holds one channel"):
        save_image(tmp_path / "b.pgm", color)
    with pytest.raises(ImageError, match="kind"):
        save_image(tmp_path / "a.nothing", color)
    with pytest.raises(ImageError, match="cannot be written"):
        save_image(tmp_path / "missing" / "a.png", color)
    with pytest.raises(ValueError, match="16 bits"):
        save_image(tmp_path / "a.jpg", color, bits=16)
    with pytest.raises(ValueError, match="wanted 8 or 16"):
        save_image(tmp_path / "a.png", color, bits=12)
    with pytest.raises(ValueError, match="wanted shape"):
        save_image(tmp_path / "a.png", torch.zeros(2, 5, 7))


def test_scale_image() -> None:
    images = torch.tensor([[[1.0, 2.0], [3.0, 5.0]], [[7.0, 7.0], [7.0, 7.0]]], dtype=torch.float64)
    scaled = scale_image(images)
    assert scaled[0].tolist() == [[0, 0.25], [0.5, 1]]
    assert scaled[1].tolist() == [[0, 0], [0, 0]]
    assert scale_image(images[0], low=2.0, high=4.0).tolist() == [[0, 0], [0.5, 1]]
    assert scale_image(images[:0]).shape == (0, 2, 2)


def test_what_may_have_been_meant_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for name in ("b.HEIC", "a.jpg", "notes.txt", ".c.heic", "film.MP4", "raw.cr2", "old.gif"):
        (tmp_path / name).write_bytes(b"x")
    for name in ("more", "empty", "folder.jpg"):
        (tmp_path / name).mkdir()
    for name in ("more/d.jpg", "more/e.heic", "more/notes.txt", "folder.jpg/f.png"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nowhere")
    found = {path.name: reason for path, reason in list_skipped(tmp_path)}
    assert list(found) == ["b.HEIC", "film.MP4", "folder.jpg", "gone.jpg", "more", "old.gif", "raw.cr2"]
    assert "JPEG" in found["b.HEIC"]
    assert "film" in found["film.MP4"]
    assert "2 pictures" in found["more"]
    assert found["gone.jpg"] == "not a file"
    assert [path.name for path in list_images(tmp_path)] == ["a.jpg"]
    assert [path.relative_to(tmp_path).as_posix() for path in list_images(tmp_path, subfolders=True)] == [
        "a.jpg", "folder.jpg/f.png", "more/d.jpg",
    ]  # fmt: skip
    within = [path.relative_to(tmp_path).as_posix() for path, _ in list_skipped(tmp_path, subfolders=True)]
    assert within == ["b.HEIC", "film.MP4", "gone.jpg", "old.gif", "raw.cr2", "more/e.heic"]
    with pytest.raises(ImageError, match="no such folder"):
        list_skipped(tmp_path / "missing")


def sized(suffix: str, width: int, height: int) -> bytes:
    """A small file whose header says that the image is of this size."""
    data = bytearray(encode(np.zeros((8, 8, 3), np.uint8), suffix))
    if suffix == ".png":
        struct.pack_into(">II", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    elif suffix == ".jpg":
        place = data.find(b"\xff\xc0")
        struct.pack_into(">HH", data, place + 5, height, width)
    elif suffix == ".bmp":
        struct.pack_into("<ii", data, 18, width, -height)
    elif suffix == ".tif":
        count = struct.unpack_from("<H", data, struct.unpack_from("<I", data, 4)[0])[0]
        for k in range(count):
            place = struct.unpack_from("<I", data, 4)[0] + 2 + 12 * k
            tag = struct.unpack_from("<H", data, place)[0]
            if tag in (0x100, 0x101):
                struct.pack_into("<HHII", data, place, tag, 4, 1, width if tag == 0x100 else height)
    elif suffix == ".ppm":
        data[:] = data.replace(b"8 8", f"{width} {height}".encode(), 1)
    else:
        # An extended WebP, whose canvas has the size.
        chunk = b"VP8X" + struct.pack("<II", 10, 0) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
        data[4:] = struct.pack("<I", len(data) - 8 + len(chunk)) + b"WEBP" + chunk + data[12:]
    return bytes(data)


KINDS = [".png", ".jpg", ".bmp", ".tif", ".ppm", ".webp"]


@pytest.mark.parametrize("suffix", KINDS)
def test_the_header_gives_the_size(suffix: str) -> None:
    assert image_size(encode(np.zeros((7, 9, 3), np.uint8), suffix)) == (9, 7)
    assert image_size(sized(suffix, 16000, 12001)) == (16000, 12001)
    assert image_size(encode(np.zeros((7, 9), np.uint8), suffix.replace("ppm", "pgm"))) == (9, 7)


def test_the_header_of_other_webp_and_bmp_files() -> None:
    done, lossless = cv2.imencode(".webp", np.zeros((7, 9, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert done
    assert lossless.tobytes()[12:16] == b"VP8L"
    assert image_size(lossless.tobytes()) == (9, 7)
    old = b"BM" + struct.pack("<IHHI", 26 + 28, 0, 0, 26) + struct.pack("<IHHHH", 12, 9, 7, 1, 24)
    assert image_size(old) == (9, 7)


@pytest.mark.parametrize("suffix", KINDS)
def test_a_bomb_is_not_decoded(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"bomb{suffix}"
    size = (16383, 16383) if suffix == ".webp" else (60000, 60000)
    path.write_bytes(sized(suffix, *size))
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(ImageError, match=rf"bomb\{suffix}: {size[0]} x {size[1]} are more than the 1000000 pixels"):
        read_image(path, max_pixels=10**6)
    if suffix != ".webp":
        with pytest.raises(ImageError, match="more than the"):
            read_image(path)


def test_the_limit_can_be_raised(tmp_path: Path, picture: np.ndarray) -> None:
    (tmp_path / "a.png").write_bytes(encode(picture, ".png"))
    with pytest.raises(ImageError, match="80 x 48 are more than the 3839 pixels"):
        read_image(tmp_path / "a.png", max_pixels=3839)
    assert read_image(tmp_path / "a.png", max_pixels=3840).size == (80, 48)
    with pytest.raises(ValueError, match="max_pixels: wanted at least 1"):
        read_image(tmp_path / "a.png", max_pixels=0)


def test_a_file_too_long_for_its_pixels_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.jpg").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(ImageError, match="bytes are more than"):
        read_image(tmp_path / "a.jpg")


def test_a_pipe_does_not_hold_anything_up(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match="not a file"):
        read_image(tmp_path / "a.jpg")


@pytest.mark.parametrize(("width", "height", "part"), [(1600, 1200, 4), (1604, 1204, 4), (1602, 1202, 2), (1601, 1201, 1)])
def test_a_large_jpeg_is_decoded_in_part(
    width: int, height: int, part: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The smaller image is the average of the larger one, without any shift."""
    y, x = np.mgrid[:height, :width]
    pattern = 127 + 60 * np.sin(x / 23) * np.cos(y / 31) + 60 * np.cos((x + 2 * y) / 57)
    (tmp_path / "a.jpg").write_bytes(encode(np.repeat(pattern[:, :, None], 3, 2).round().astype(np.uint8), ".jpg"))
    decoded: list[tuple[int, ...]] = []
    real = cv2.imdecode

    def imdecode(data: np.ndarray, flags: int) -> np.ndarray:
        array = real(data, flags)
        decoded.append(array.shape[:2])
        return array

    monkeypatch.setattr(cv2, "imdecode", imdecode)
    small = read_image(tmp_path / "a.jpg", max_size=400)
    assert decoded == [(height // part, width // part)]
    assert small.size == (width, height)
    expected = cv2.resize(pattern, (small.width, small.height), interpolation=cv2.INTER_AREA) / 255
    for channel in small.pixels.numpy():
        assert np.abs(channel - expected).max() < 4 / 255
    assert read_image(tmp_path / "a.jpg").pixels.shape == (3, height, width)
    assert read_image(tmp_path / "a.jpg", max_size=400, gray=True).pixels.shape == (1, small.height, small.width)


def test_a_second_size_in_the_header_does_not_hide_the_first() -> None:
    first = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in ((0x100, 60000), (0x101, 50000), (0x100, 8)))
    assert image_size(b"II*\0\x08\0\0\0" + struct.pack("<H", 3) + first + bytes(4)) == (60000, 50000)
