import json
import shutil
from pathlib import Path

import pytest
import torch
from chance import seeded
from command_line import torchsfm

from torchsfm.cli.inputs import read_intrinsics
from torchsfm.geometry import Camera, KannalaBrandt, Pose, Radial, intrinsics, rotation_from_rotvec
from torchsfm.images import read_image, save_image
from torchsfm.simulation import render_board

F64 = torch.float64
TURNS = [[0.5, 0.0, 0.1], [-0.5, 0.2, 0.0], [0.1, 0.5, -0.1], [0.0, -0.5, 0.05], [0.35, 0.4, 0.2]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of a chessboard of 5 x 4 inner corners, and one of a wall, one of another size and one that is no image."""
    folder = tmp_path_factory.mktemp("photographs")
    R = rotation_from_rotvec(torch.tensor(TURNS, dtype=F64))
    t = torch.tensor([0.0, 0.0, 9.0], dtype=F64) - R @ torch.tensor([2.0, 1.5, 0.0], dtype=F64)
    K = intrinsics(torch.tensor(230.0, dtype=F64), torch.tensor([119.0, 91.0], dtype=F64))
    camera = Camera(K, Radial(*torch.tensor([-0.1, 0.0], dtype=F64)))
    images = render_board(Pose(R, t), camera, 5, 4, width=240, height=180, generator=seeded())
    for i, image in enumerate(images):
        save_image(folder / f"board{i}.png", image)
    save_image(folder / "wall.png", torch.full((1, 180, 240), 0.5))
    save_image(folder / "small.png", images[0][:, 10:170, 10:230])
    (folder / "broken.png").write_bytes(b"no image")
    return folder


def test_camera_report_and_pictures_are_written(folder: Path, tmp_path: Path) -> None:
    code, stdout, _ = torchsfm(
        "calibrate", folder, "--board", "5x4", "--size", 0.03, "--out", tmp_path / "out", "--previews", 2
    )
    assert code == 0
    record = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert record["status"] == "OK"
    focal = record["intrinsics"]["fx"]
    assert abs(focal["value"] - 230) < 5 * focal["sigma"] + 0.3
    assert 0 < focal["sigma"] < 5
    assert record["rms"] < 0.1
    by_name = {p["name"]: p for p in record["photographs"]}
    assert [by_name[f"board{i}.png"]["used"] for i in range(5)] == [True] * 5
    assert not by_name["wall.png"]["used"]
    assert "not found" in by_name["wall.png"]["problem"]
    assert not by_name["broken.png"]["used"]
    assert by_name["broken.png"]["problem"]
    assert "220 x 160" in by_name["small.png"]["problem"]
    K = read_intrinsics(tmp_path / "out" / "camera.txt")
    assert float(K[0, 0]) == pytest.approx(focal["value"])
    assert len(list((tmp_path / "out" / "undistorted").glob("*.png"))) == 2
    assert read_image(tmp_path / "out" / "undistorted" / "board0.png").pixels.std() > 0.1
    assert "| fx |" in stdout
    assert (tmp_path / "out" / "calibration.md").read_text().startswith("# Calibration: OK")


def test_what_cannot_be_calibrated_ends_in_a_line(folder: Path, tmp_path: Path) -> None:
    code, _, stderr = torchsfm("calibrate", folder / "wall.png", "--board", "5x4", "--out", tmp_path / "a")
    assert code == 1
    assert "5x4" in stderr
    code, _, stderr = torchsfm("calibrate", folder / "board0.png", "--board", "5x4", "--out", tmp_path / "b")
    assert code == 1
    assert "do not determine" in stderr
    assert "One photograph" in stderr
    assert not (tmp_path / "b" / "camera.txt").exists()
    wrong = {"--board": "5", "--camera": "fisheye-9", "--size": "0", "--free": "focal,nothing"}
    for option, value in wrong.items():
        words = {"--board": "5x4"} | {option: value}
        code, _, stderr = torchsfm("calibrate", folder, *(w for pair in words.items() for w in pair), "--out", tmp_path / "c")
        assert code == 2
        assert option.strip("-") in stderr
        assert len(stderr.strip().splitlines()) <= 2


def photographs(folder: Path, camera: Camera, away: float, name: str) -> list[Path]:
    """Photographs of the board from five directions, the middle of it in front."""
    R = rotation_from_rotvec(torch.tensor(TURNS, dtype=F64))
    t = torch.tensor([0.0, 0.0, away], dtype=F64) - R @ torch.tensor([2.0, 1.5, 0.0], dtype=F64)
    images = render_board(Pose(R, t), camera, 5, 4, width=240, height=180, generator=seeded())
    paths = [folder / f"{name}{i}.png" for i in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        save_image(path, image)
    return paths


def pinhole(f: float) -> Camera:
    return Camera(intrinsics(torch.tensor(f, dtype=F64), torch.tensor([119.0, 91.0], dtype=F64)))


def test_photographs_given_twice_are_told_and_count_once(tmp_path: Path) -> None:
    """Deviations were smaller by the square root of two."""
    once = photographs(tmp_path, pinhole(230.0), 9.0, "a")
    records = []
    again = [shutil.copy(path, tmp_path / f"z{path.name}") for path in once]
    held = ("--board", "5x4", "--camera", "pinhole", "--free", "focal", "--previews", 0)
    for name, files in (("once", once), ("twice", once + again)):
        code, _, _ = torchsfm("calibrate", *files, *held, "--out", tmp_path / name)
        assert code == 0
        records.append(json.loads((tmp_path / name / "calibration.json").read_text()))
    assert [p["used"] for p in records[1]["photographs"]] == [True] * 5 + [False] * 5
    assert [p["problem"] for p in records[1]["photographs"][5:]] == [f"is {p.name} once more" for p in once]
    sigma = [record["intrinsics"]["fx"]["sigma"] for record in records]
    assert sigma[1] == pytest.approx(sigma[0], rel=1e-4)


def test_two_zooms_are_doubtful(tmp_path: Path) -> None:
    files = photographs(tmp_path, pinhole(230.0), 9.0, "near") + photographs(tmp_path, pinhole(245.0), 9.5, "far")
    code, stdout, _ = torchsfm("calibrate", *files, "--board", "5x4", "--out", tmp_path / "out", "--previews", 0)
    assert code == 0
    record = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert record["disagreement"] > 2.5
    assert "Doubtful: the photographs contradict each other" in stdout
    focal = record["intrinsics"]["fx"]
    assert abs(focal["value"] - 237.5) < 5 * focal["sigma"]


def test_a_fisheye_is_told_from_a_polynomial(tmp_path: Path) -> None:
    K = pinhole(90.0).K
    wide = Camera(K, KannalaBrandt(*torch.zeros(4, dtype=F64)))
    files = photographs(tmp_path, wide, 3.2, "wide")
    code, stdout, _ = torchsfm("calibrate", *files, "--board", "5x4", "--out", tmp_path / "out", "--previews", 1)
    assert code == 0
    record = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert record["camera"] == "fisheye"
    assert record["remarks"] == []
    focal = record["intrinsics"]["fx"]
    assert abs(focal["value"] - 90) < 5 * focal["sigma"]
    code, stdout, _ = torchsfm(
        "calibrate", *files, "--board", "5x4", "--out", tmp_path / "held", "--previews", 0, "--camera", "simple_radial"
    )
    assert code == 0
    assert "lens: simple_radial" in stdout
    assert "Doubtful: a lens of the kind fisheye explains" in stdout
