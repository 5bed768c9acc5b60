import contextlib
import struct

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchsfm.formats import read_ply, write_ply
from torchsfm.geometry import Camera, Pose, Radial, random_rotation
from torchsfm.reconstruction.model.reconstruction import Reconstruction

ASCII = """ply
format ascii 1.0
comment made by hand
element camera 1
property float focal
property list uchar int numbers
element vertex 2
property uchar red
property float x
property double y
property int z
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
500 2 1 1
255 1.5 -2 3 0 51
0 0.25 1e3 -7 102 255
3 0 1 0
"""


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip(dtype, count, tmp_path, generator):
    X = torch.randn(count, 3, generator=generator, dtype=dtype)
    color = torch.randint(0, 256, (count, 3), generator=generator).to(dtype) / 255
    write_ply(X, tmp_path / "a.ply", color=color)
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.X.equal(X)
    assert cloud.color.dtype == dtype
    torch.testing.assert_close(cloud.color, color, rtol=0, atol=1e-7)
    write_ply(X, tmp_path / "b.ply")
    cloud = read_ply(tmp_path / "b.ply")
    assert cloud.X.equal(X)
    assert cloud.color is None


def test_the_bytes_are_those_of_the_format(tmp_path):
    """Against the format's description, not against the reader."""
    write_ply(torch.tensor([[1.0, 2.0, 3.0]]), tmp_path / "a.ply", color=torch.tensor([[0.0, 2.0, 0.5]]))
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert header.decode() == (
        "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    )
    assert body == struct.pack("<fffBBB", 1, 2, 3, 0, 255, 128)


def test_ascii(tmp_path):
    for end in ("\n", "\r\n"):
        (tmp_path / "a.ply").write_bytes(ASCII.replace("\n", end).encode())
        cloud = read_ply(tmp_path / "a.ply")
        assert cloud.X.tolist() == [[1.5, -2, 3], [0.25, 1000, -7]]
        torch.testing.assert_close(cloud.color, torch.tensor([[1, 0, 0.2], [0, 0.4, 1]], dtype=torch.float64))


@pytest.mark.parametrize(("name", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_with_a_list_before_the_points(name, order, tmp_path):
    header = ASCII[: ASCII.index("end_header\n") + 11].replace("ascii", name)
    body = struct.pack(order + "fB2i", 500, 2, 1, 1)
    body += struct.pack(order + "BfdiBB", 255, 1.5, -2, 3, 0, 51) + struct.pack(order + "BfdiBB", 0, 0.25, 1e3, -7, 102, 255)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.X.tolist() == [[1.5, -2, 3], [0.25, 1000, -7]]
    torch.testing.assert_close(cloud.color, torch.tensor([[1, 0, 0.2], [0, 0.4, 1]], dtype=torch.float64))


def test_a_reconstruction_brings_its_cameras(tmp_path, generator):
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]).repeat(2, 1, 1)
    pose = Pose(random_rotation(3, generator=generator), torch.randn(3, 3, generator=generator))
    empty = torch.zeros(0, dtype=torch.long)
    model = Reconstruction(
        names=("a", "b", "c"),
        image_size=torch.tensor([[640, 480]] * 3),
        cameras=Camera(K, Radial(torch.zeros(2), torch.zeros(2))),
        camera_index=torch.tensor([0, 1, 0]),
        poses=pose,
        registered=torch.tensor([True, False, True]),
        X=torch.randn(4, 3, generator=generator),
        color=torch.ones(4, 3),
        x=torch.zeros(0, 2),
        view=empty,
        point=empty,
    )
    write_ply(model, tmp_path / "a.ply")
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.X.equal(model.X)
    data = (tmp_path / "a.ply").read_bytes()
    assert b"element camera 2\n" in data
    record = struct.unpack("<13d2i", data[-112:])
    centre, rows = pose.centre[2].tolist(), pose.R[2].flatten().tolist()
    assert record[:3] == pytest.approx(centre)
    assert record[3:12] == pytest.approx(rows[:3] + [-value for value in rows[3:]])
    assert record[12:] == (500, 640, 480)
    with pytest.raises(ValueError, match="color"):
        write_ply(model, tmp_path / "a.ply", color=torch.zeros(4, 3))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no ply\n",
        "ply\n",
        "ply\nend_header\n",
        "ply\nformat ascii 2.0\nend_header\n",
        "ply\nformat ascii 1.0\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex -1\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 3\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n",
        ASCII[:-20],
        ASCII.replace("1.5", "one"),
        ASCII.replace("255 1.5", "256 1.5"),
        ASCII.replace("vertex 2", "vertex 99999999999999"),
        ASCII.replace("ascii", "binary_little_endian").replace("vertex 2", "vertex 99999999999999"),
        ASCII.replace("property float x", "property list uchar float x"),
    ],
)
def test_damaged_files_are_refused_by_name(text, tmp_path):
    (tmp_path / "bad.ply").write_text(text if text != ASCII[:-20] else text[: text.rindex("0 0.25") + 3])
    with pytest.raises(ValueError, match=r"bad\.ply"):
        read_ply(tmp_path / "bad.ply")


@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=12), st.integers(0, len(ASCII)), st.integers(0, 12), st.booleans())
def test_any_damage_gives_points_or_a_value_error(tmp_path, patch, position, removed, binary):
    data = (ASCII.replace("ascii", "binary_big_endian") if binary else ASCII).encode()
    path = tmp_path / "bad.ply"
    path.write_bytes(data[:position] + patch + data[position + removed :])
    with contextlib.suppress(ValueError):
        cloud = read_ply(path)
        assert cloud.X.shape[1:] == (3,)


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_are_named(tmp_path):
    with pytest.raises(ValueError, match="points: wanted shape"):
        write_ply(torch.zeros(3, 2), tmp_path / "a.ply")
    with pytest.raises(ValueError, match="points: wanted shape"):
        write_ply(torch.zeros(2, 5, 3), tmp_path / "a.ply")
    with pytest.raises(ValueError, match="color: wanted n = 5"):
        write_ply(torch.zeros(5, 3), tmp_path / "a.ply", color=torch.zeros(4, 3))
