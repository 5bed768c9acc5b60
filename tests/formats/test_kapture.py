"""Kapture: a dataset written by hand after its documentation, its own program's view of ours, and what is none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_model
import torch
from command_line import assert_one_line, torchsfm

from torchsfm.formats import read_kapture, read_model, write_kapture
from torchsfm.geometry import BrownConrady
from torchsfm.reconstruction import Reconstruction

TABLES = {
    "sensors/sensors.txt": """# kapture format: 1.1
# sensor_device_id, name, sensor_type, [sensor_params]+
cam01, Hero7, camera, OPENCV, 800, 600, 700, 710, 400.5, 300.5, 0.01, 0.002, 0.0003, 0
phone0, gs9, camera, SIMPLE_PINHOLE, 640,480, 500 , 320.5, 240.5

lidar0, , lidar
""",
    "sensors/rigs.txt": """# kapture format: 1.1
# rig_device_id, sensor_device_id, qw, qx, qy, qz, tx, ty, tz
rig, phone0, 0.7071067811865476, 0, 0, 0.7071067811865476, 10, 0, 0
rig, lidar0, 1, 0, 0, 0, 0, 0, 0
""",
    "sensors/trajectories.txt": """# kapture format: 1.1
# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz
0000, cam01, 1, 0, 0, 0, 0, 0, 0
0001, rig, 1, 0, 0, 0, 1, 2, 3
0002, cam01, , , , , , ,
""",
    "sensors/records_camera.txt": """# kapture format: 1.1
# timestamp, device_id, image_path
0000, cam01, mapping/cam_01/00001.jpg
0001, phone0, query 1.jpg
0002, cam01, mapping/cam_01/00002.jpg
""",
    "reconstruction/points3d.txt": """# kapture format: 1.1
# X, Y, Z, R, G, B
2.13521, 4.23587, 1.8745, 0, 0, 0
2.14789, 6.21458, 1.4578, 133, 42, 255
""",
    "reconstruction/observations.txt": """# kapture format: 1.1
# point3d_id, keypoints_type, [image_path, feature_id]*
0, r2d2, mapping/cam_01/00001.jpg, 1, query 1.jpg, 0
1, SIFT, mapping/cam_01/00001.jpg, 0
1, r2d2, mapping/cam_01/00001.jpg, 0
""",
    "reconstruction/keypoints/r2d2/keypoints.txt": "# kapture format: 1.1\n# name, dtype, dsize\nr2d2, float32, 3\n",
    "reconstruction/keypoints/SIFT/keypoints.txt": "# kapture format: 1.1\n# name, dtype, dsize\nSIFT, float64, 4\n",
}
POINTS = {
    "r2d2/mapping/cam_01/00001.jpg.kpt": np.array([[10, 20, 1], [30.5, 40.25, 2]], "<f4"),
    "r2d2/query 1.jpg.kpt": np.array([[0.5, 0.5, 7]], "<f4"),
    "SIFT/mapping/cam_01/00001.jpg.kpt": np.array([[11, 21, 0, 0]], "<f8"),
}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two sensors, a rig that one is a part of, two kinds of key points, and an image without a pose."""
    folder = tmp_path / "dataset"
    for name, text in TABLES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name, values in POINTS.items():
        path = folder / "reconstruction" / "keypoints" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(values.tobytes())
    return folder


def test_a_dataset_is_read_as_its_documentation_says(dataset: Path) -> None:
    model = read_kapture(dataset)
    assert model.names == ("mapping/cam_01/00001.jpg", "query 1.jpg", "mapping/cam_01/00002.jpg")
    assert model.registered.tolist() == [True, True, False]
    assert model.image_size.tolist() == [[800, 600], [640, 480], [800, 600]]
    assert model.camera_index.tolist() == [0, 1, 0]
    assert isinstance(model.cameras.distortion, BrownConrady)
    assert model.cameras.K[0].tolist() == [[700, 0, 400], [0, 710, 300], [0, 0, 1]]
    assert model.cameras.K[1].tolist() == [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
    assert float(model.cameras.distortion.p1[0]) == 0.0003
    # The sensor turns what the rig moved, and moves it on.
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    torch.testing.assert_close(model.poses.R[1], turn, rtol=0, atol=1e-12)
    torch.testing.assert_close(model.poses.t[1], turn @ torch.tensor([1.0, 2, 3]).double() + torch.tensor([10.0, 0, 0]))
    assert model.X[1].tolist() == [2.14789, 6.21458, 1.4578]
    torch.testing.assert_close(model.color[1] * 255, torch.tensor([133.0, 42, 255]).double())
    seen = sorted(zip(model.point.tolist(), model.view.tolist(), model.x.tolist(), strict=True))
    assert seen == [(0, 0, [30.0, 39.75]), (0, 1, [0.0, 0.0]), (1, 0, [9.5, 19.5]), (1, 0, [10.5, 20.5])]
    assert read_model(dataset).names == model.names
    status, text, _ = torchsfm("info", dataset)
    assert status == 0
    assert "query 1.jpg" in text


@pytest.mark.parametrize("lens", ["pinhole", "radial", "opencv", "fisheye"])
def test_a_model_comes_back(lens: str, tmp_path: Path) -> None:
    model = small_model.make(lens)
    model = replace(model, names=("a.jpg", "in/b ä.jpg", "in/\udce9/c.jpg", "d.jpg"))
    write_kapture(model, tmp_path / "new" / "set")
    again = read_model(tmp_path / "new" / "set")
    assert again.names == model.names
    for name in ("registered", "image_size", "camera_index", "view", "point"):
        assert getattr(again, name).equal(getattr(model, name))
    for name in ("X", "x"):
        torch.testing.assert_close(getattr(again, name), getattr(model, name), rtol=0, atol=1e-9)
    torch.testing.assert_close(again.projections(), model.projections(), rtol=0, atol=1e-9)
    torch.testing.assert_close(again.color, model.color, rtol=0, atol=0.5 / 255 + 1e-9)


def test_convert_writes_it_by_name(tmp_path: Path) -> None:
    small_model.make().save(tmp_path / "model.npz")
    assert torchsfm("convert", tmp_path / "model.npz", tmp_path / "set", "--to", "kapture")[0] == 0
    assert torchsfm("convert", tmp_path / "set", tmp_path / "back.npz")[0] == 0
    assert Reconstruction.load(tmp_path / "back.npz").num_points == 30


@pytest.mark.parametrize("name", ["a,b.jpg", "a\nb", " a.jpg", "../a.jpg", "/a.jpg", ""])
def test_names_that_have_no_place(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot hold the name"):
        write_kapture(replace(small_model.make(), names=(name, "b", "c", "d")), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_two_datasets_are_not_mixed(dataset: Path) -> None:
    with pytest.raises(ValueError, match="another dataset, with rigs"):
        write_kapture(small_model.make(), dataset)
    assert (dataset / "sensors/sensors.txt").read_text() == TABLES["sensors/sensors.txt"]


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("sensors/sensors.txt", "format: 1.1", "format: 1.0", "wanted the first line"),
        ("sensors/sensors.txt", "SIMPLE_PINHOLE", "UNKNOWN_CAMERA", "no equal here"),
        ("sensors/sensors.txt", "SIMPLE_PINHOLE", "PINHOLE", "PINHOLE of 3 numbers"),
        ("sensors/sensors.txt", "OPENCV", "FOV", "no equal here"),
        ("sensors/sensors.txt", "640", "-640", "size that is none"),
        ("sensors/rigs.txt", "rig, lidar0", "rig, rig", "part of itself"),
        ("sensors/rigs.txt", "0.7071067811865476", "0", "a pose that is none"),
        ("sensors/trajectories.txt", "1, 2, 3", "1, nan, 3", "not finite"),
        ("sensors/records_camera.txt", "phone0", "phone9", "phone9"),
        ("reconstruction/points3d.txt", "1.8745, 0", "0", "points"),
        ("reconstruction/observations.txt", "query 1.jpg, 0", "query 1.jpg, 1", "there is no key point 1"),
        ("reconstruction/observations.txt", "query 1.jpg, 0", "query 1.jpg", "observations"),
        ("reconstruction/observations.txt", "1, SIFT", "2, SIFT", "there is no point 2"),
        ("reconstruction/observations.txt", "query 1.jpg", "../../sensors/x", "leads out of its folder"),
        ("reconstruction/keypoints/r2d2/keypoints.txt", "float32", "object", "type object"),
        ("reconstruction/keypoints/r2d2/keypoints.txt", "3\n", "4\n", "observations"),
    ],
)
def test_damaged_datasets_are_refused(name: str, old: str, new: str, words: str, dataset: Path) -> None:
    assert old in TABLES[name]
    (dataset / name).write_text(TABLES[name].replace(old, new))
    with pytest.raises(ValueError, match=words) as caught:
        read_kapture(dataset)
    assert str(dataset) in str(caught.value)
    status, _, stderr = torchsfm("info", dataset)
    assert status == 2
    assert_one_line(stderr, words)


def test_archives_of_key_points_are_told(dataset: Path) -> None:
    (dataset / "reconstruction/keypoints/r2d2/keypoints.tar").touch()
    with pytest.raises(ValueError, match=r"unpack keypoints\.tar"):
        read_kapture(dataset)


@pytest.mark.reference
def test_kapture_reads_ours(tmp_path: Path) -> None:
    """Its own program sees the same images, poses, points and key points, and projects to the same places."""
    csv = pytest.importorskip("kapture.io.csv")
    features = pytest.importorskip("kapture.io.features")
    model = small_model.make("radial")
    write_kapture(model, tmp_path)
    found = csv.kapture_from_dir(str(tmp_path))
    records = found.records_camera.items()
    names = {name: (time, device) for time, seen in records for device, name in seen.items()}
    assert set(names) == set(model.names)
    X = found.points3d.as_array()[:, :3]
    assert np.allclose(X, model.X.numpy(), rtol=0, atol=1e-12)
    count = 0
    for point, kinds in found.observations.items():
        for kind, seen in kinds.items():
            for name, number in seen:
                time, device = names[name]
                pose = found.trajectories[time][device]
                Y = pose.transform_points(X[point : point + 1])[0]
                f, cx, cy, k1, k2 = found.sensors[device].camera_params[2:]
                x, y = Y[0] / Y[2], Y[1] / Y[2]
                radial = 1 + k1 * (x * x + y * y) + k2 * (x * x + y * y) ** 2
                row = (model.point == point) & (model.view == model.names.index(name))
                ours = model.projections()[row][0].numpy()
                assert np.abs(np.array([f * radial * x + cx, f * radial * y + cy]) - 0.5 - ours).max() < 1e-6
                path = features.get_keypoints_fullpath(kind, str(tmp_path), name)
                places = features.image_keypoints_from_file(path, found.keypoints[kind].dtype, found.keypoints[kind].dsize)
                assert np.abs(places[number] - 0.5 - model.x[row][0].numpy()).max() < 1e-9
                count += 1
    assert count == model.num_observations
