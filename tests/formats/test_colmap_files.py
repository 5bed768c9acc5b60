"""COLMAP's files as they are laid out: read like COLMAP reads them, and nothing in them taken on trust."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_model import make

from torchsfm.formats import read_colmap, write_colmap
from torchsfm.formats.colmap_binary import read_points
from torchsfm.reconstruction import Reconstruction

CAMERAS = "# comment\n3 PINHOLE 640 480 500 510 320 240\n\n1 SIMPLE_RADIAL 640 480 500 320 240 0.1\n"
IMAGES = "# two lines each\n4 1 0 0 0 0 0 5 3 a b.png\n1.5 2.5 7 3 4 -1 5 6 9\n2 0 0 0 2 1 2 3 1 c.png\n8 9 7\n"
POINTS = "7 1 2 3 255 0 51 0.5 4 0 2 0\n9 4 5 6 1 2 3 0.5 4 2\n"
RIGS = "1 2 CAMERA 1 CAMERA 3 1 1 0 0 0 0 0 1\n"
FRAMES = "1 1 1 0 0 0 0 0 4 1 CAMERA 3 4\n2 1 0 0 0 1 1 2 3 2 CAMERA 1 2 CAMERA 3 5\n"


def write_text(folder: Path, **changes: str) -> Path:
    texts = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS} | changes
    for name, text in texts.items():
        (folder / f"{name}.txt").write_bytes(text.encode("utf-8", "surrogateescape"))
    return folder


def one_line(folder: Path, *words: str) -> None:
    """The model is refused in one line that holds the words."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        read_colmap(folder)
    message = str(caught.value)
    assert str(folder) in message
    assert message.isprintable(), message
    for word in words:
        assert word in message


def test_text(tmp_path: Path) -> None:
    for newline in ("\n", "\r\n"):
        for more in ({}, {"rigs": RIGS, "frames": FRAMES}):
            texts = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS} | more
            model = read_colmap(write_text(tmp_path, **{name: text.replace("\n", newline) for name, text in texts.items()}))
            assert model.names == ("c.png", "a b.png")
            assert model.camera_index.tolist() == [0, 1]
            assert model.x.tolist() == [[7.5, 8.5], [1, 2], [4.5, 5.5]]
            assert model.view.tolist() == [0, 1, 1]
            assert model.point.tolist() == [0, 0, 1]
            assert model.X.tolist() == [[1, 2, 3], [4, 5, 6]]
            assert model.color[0].tolist() == [1, 0, 0.2]
            assert model.poses.R[0].diagonal().tolist() == [-1, -1, 1]
            assert model.poses.t.tolist() == [[1, 2, 3], [0, 0, 5]]
            assert model.cameras.K[1].tolist() == [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]
            for name in more:
                (tmp_path / f"{name}.txt").unlink()


def test_text_names_are_any_bytes(tmp_path: Path) -> None:
    assert read_colmap(write_text(tmp_path, images=IMAGES.replace("a b", "caf\udce9"))).names[1] == "caf\udce9.png"


def test_an_image_without_points(tmp_path: Path) -> None:
    for tail in ("", "\n", "\n\n"):
        model = read_colmap(write_text(tmp_path, images="4 1 0 0 0 0 0 5 3 a.png" + tail, points3D=""))
        assert model.num_registered == 1
        assert model.num_observations == 0


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("points3D", "9 4 5 6 1 2 3 0.5 4 2\n", "", "image 4 shows the 3D point 9, which is not there"),
        ("points3D", "4 2", "4 3", "the 3D point 9 has point 3 of image 4"),
        ("points3D", "4 2", "4 1", "the 3D point 9 has point 1 of image 4"),
        ("points3D", "4 2", "4 -1", "the 3D point 9 has point -1 of image 4"),
        ("points3D", "4 2", "5 2", "the 3D point 9 has point 2 of image 5"),
        ("points3D", "4 2", "4", "points3D.txt, line 2: wanted POINT3D_ID"),
        ("points3D", "4 5 6", "4 nan 6", "the 3D point 9 is not finite"),
        ("points3D", "1 2 3 0.5", "1 2 300 0.5", "line 2"),
        ("points3D", "9 4", "7 4", "twice"),
        ("points3D", "9 4", "99999999999999999999 4", "line 2"),
        ("images", "3 a b", "8 a b", "image 4 is of camera 8"),
        ("images", "3 4 -1", "3 4", "images.txt, line 2: wanted IMAGE_ID"),
        ("images", "3 4 -1", "3 x -1", "line 2"),
        ("images", "3 4 -1", "3 inf -1", "image 4"),
        ("images", "2 0 0 0 2", "4 0 0 0 2", "image 4 occurs twice"),
        ("images", "2 0 0 0 2", "2 0 0 0 0", "a pose that is none"),
        ("images", "0 0 5", "0 0 nan", "a pose that is none"),
        ("images", "1 c.png", "", "line 4"),
        ("images", "2 0 0 0 2", "-2 0 0 0 2", "image -2 has a number out of range"),
        ("cameras", "PINHOLE", "CAT", "'CAT', which is unknown"),
        ("cameras", "500 510", "510", "PINHOLE has 4 parameters, got 3"),
        ("cameras", "500 510", "0 510", "camera 3 has a focal length"),
        ("cameras", "500 510", "500 nan", "camera 3 has a focal length"),
        ("cameras", "640 480 500 510", "640 -480 500 510", "camera 3 has images of 640 x -480"),
        ("cameras", "1 SIMPLE", "3 SIMPLE", "3 occurs twice"),
        ("cameras", "PINHOLE", "FOV", "FOV has 5 parameters"),
        ("rigs", "CAMERA 3 1 1 0", "CAMERA 3 1 1", "rigs.txt, line 1"),
        ("rigs", "1 2 CAMERA", "1 1 CAMERA", "rigs.txt, line 1"),
        ("rigs", "1 2 CAMERA", "1 999999999999 CAMERA", "rigs.txt, line 1"),
        ("rigs", "CAMERA 1 CAMERA 3", "IMU 1 CAMERA 3", "frame 2 is of sensor 1"),
        ("rigs", "0 0 1\n", "0 0 2\n", "image 4 has another pose"),
        ("frames", "1 1 1 0", "1 4 1 0", "frame 1 is of rig 4"),
        ("frames", "3 4\n", "3 5\n", "image 5 belongs to two frames"),
        ("frames", "1 1 1 0 0 0 0 0 4 1 CAMERA 3 4\n", "", "image 4 belongs to no frame"),
        ("frames", "0 0 0 1 1 2 3", "0 0 0 1 1 2 4", "image 2 has another pose"),
        ("frames", "CAMERA 3 4", "CAMERA 3", "frames.txt, line 1"),
    ],
)
def test_text_that_is_no_model(name: str, old: str, new: str, words: str, tmp_path: Path) -> None:
    texts = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS, "rigs": RIGS, "frames": FRAMES}
    assert texts[name].count(old) >= 1
    one_line(write_text(tmp_path, **texts | {name: texts[name].replace(old, new, 1)}), words)


@pytest.fixture
def binary(tmp_path: Path) -> Path:
    write_colmap(make(), tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_every_cut_is_seen(name: str, binary: Path) -> None:
    whole = (binary / f"{name}.bin").read_bytes()
    for size in {*range(min(len(whole), 120)), *range(0, len(whole), 97), len(whole) - 1}:
        (binary / f"{name}.bin").write_bytes(whole[:size])
        one_line(binary, f"{name}.bin: truncated")
    (binary / f"{name}.bin").write_bytes(whole + b"\0")
    one_line(binary, f"{name}.bin: too long: 1 bytes")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("count", [2**64 - 1, 2**63, 2**40, 5 * 10**5])
def test_counts_are_checked_against_the_file(name: str, count: int, binary: Path) -> None:
    data = (binary / f"{name}.bin").read_bytes()
    (binary / f"{name}.bin").write_bytes(struct.pack("<Q", count) + data[8:])
    one_line(binary, f"{name}.bin: truncated: {count} ")


def test_counts_within_the_files(binary: Path) -> None:
    for name, place, layout in (
        ("images", 8 + 4 + 56 + 4 + len("a.jpg") + 1, "<Q"),
        ("points3D", 8 + 43, "<Q"),
        ("rigs", 8 + 4, "<I"),
        ("frames", 8 + 8 + 56, "<I"),
    ):
        data = bytearray((binary / f"{name}.bin").read_bytes())
        for count in (2**32 - 1, 2**31):
            struct.pack_into(layout, data, place, count)
            (binary / f"{name}.bin").write_bytes(data)
            one_line(binary, f"{name}.bin: truncated")
        write_colmap(make(), binary)


def test_binary_is_preferred(binary: Path) -> None:
    write_text(binary)
    assert read_colmap(binary).num_points == 30
    (binary / "points3D.bin").unlink()
    assert read_colmap(binary).num_points == 2


def test_models_from_before_there_were_rigs(binary: Path) -> None:
    model = read_colmap(binary)
    for name in ("rigs", "frames"):
        (binary / f"{name}.bin").unlink()
    again = read_colmap(binary)
    assert again.poses.matrix().equal(model.poses.matrix())
    assert again.names == model.names


def same(model: Reconstruction, colmap) -> None:
    """The model is COLMAP's."""
    assert sorted(model.names) == sorted(image.name for image in colmap.images.values())
    ids = sorted(colmap.points3D)
    np.testing.assert_array_equal(model.X.numpy(), [colmap.points3D[i].xyz for i in ids])
    np.testing.assert_array_equal((model.color * 255).round().numpy(), [colmap.points3D[i].color for i in ids])
    for v, image_id in enumerate(sorted(colmap.images)):
        image = colmap.images[image_id]
        np.testing.assert_allclose(model.poses.matrix()[v].numpy(), image.cam_from_world().matrix(), atol=1e-12)
        points = [point for point in image.points2D if point.has_point3D()]
        order = np.argsort([point.point3D_id for point in points], kind="stable")
        mine = model.view == v
        assert [ids[j] for j in model.point[mine].tolist()] == [points[k].point3D_id for k in order]
        np.testing.assert_array_equal(model.x[mine].numpy() + 0.5, [points[k].xy for k in order])


@pytest.mark.reference
@pytest.mark.parametrize("cameras", [1, 3])
def test_what_colmap_writes_is_read(cameras: int, tmp_path: Path) -> None:
    """Rigs of one camera and of three, as text and as binary files."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_cameras_per_rig, options.num_frames_per_rig, options.num_rigs, options.num_points3D = cameras, 4, 2, 50
    colmap = pycolmap.synthesize_dataset(options)
    for kind in ("text", "binary"):
        (tmp_path / kind).mkdir()
        getattr(colmap, f"write_{kind}")(tmp_path / kind)
        same(read_colmap(tmp_path / kind), colmap)
    assert colmap.num_images() == 8 * cameras


@pytest.mark.reference
def test_what_is_written_colmap_reads(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = make()
    write_colmap(model, tmp_path)
    same(replace(read_colmap(tmp_path), names=model.names[:3]), pycolmap.Reconstruction(tmp_path))


def test_the_errors_of_points_are_their_mean_residuals(tmp_path: Path) -> None:
    X = torch.cat([make().X, torch.ones(1, 3, dtype=torch.float64)])
    model = replace(make(), X=X, color=X * 0)
    write_colmap(model, tmp_path)
    points = read_points(tmp_path / "points3D.bin")
    np.testing.assert_allclose(points.error, model.point_errors().numpy(), rtol=1e-12)
    assert points.track_length.tolist() == [3] * 30 + [0]
