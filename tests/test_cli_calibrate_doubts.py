"""What `torchsfm calibrate` says of folders that are not what it takes them for."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from chance import seeded
from command_line import torchsfm
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics, rotation_from_rotvec
from torchsfm.images import save_image
from torchsfm.simulation import render_board

F64 = torch.float64
TURNS = [[0.5, 0.0, 0.1], [-0.5, 0.2, 0.0], [0.1, 0.5, -0.1], [0.0, -0.5, 0.05], [0.35, 0.4, 0.2]]


def photographs(turns: list[list[float]], f: float = 230.0, away: float = 9.0, cx: float = 127.0) -> Tensor:
    """Of a chessboard of 5 x 4 corners."""
    R = rotation_from_rotvec(torch.tensor(turns, dtype=F64))
    t = torch.tensor([0.0, 0.0, away], dtype=F64) - R @ torch.tensor([2.0, 1.5, 0.0], dtype=F64)
    camera = Camera(intrinsics(torch.tensor(f, dtype=F64), torch.tensor([cx, 90.0], dtype=F64)))
    return render_board(Pose(R, t), camera, 5, 4, width=240, height=180, generator=seeded())


def calibrated(images: list[Tensor], folder: Path, *words: str, board: str = "5x4") -> tuple[int, dict[str, Any], str]:
    """Exit status, the report and what the last line on stderr says."""
    folder.mkdir(exist_ok=True)
    for i, image in enumerate(images):
        save_image(folder / f"photo{i}.png", image)
    out = folder / "out"
    code, _, stderr = torchsfm("calibrate", folder, "--board", board, "--previews", 0, *words, "--out", out)
    report = out / "calibration.json"
    return code, json.loads(report.read_text()) if report.exists() else {}, stderr.strip().splitlines()[-1]


def test_the_one_photograph_that_does_not_belong_is_named(tmp_path: Path) -> None:
    images = list(photographs(TURNS))
    mirrored = [*images[:2], images[2].flip(-1), *images[3:]]
    zoomed = [*images[:3], *photographs(TURNS[3:4], 290.0, 11.0), images[4]]
    for name, those in (("mirrored", mirrored), ("zoomed", zoomed)):
        code, record, _ = calibrated(those, tmp_path / name)
        assert code == 0
        assert f"Without photo{3 if name == 'zoomed' else 2}.png they agree" in record["remarks"][0]


def test_another_board_than_was_said_is_told(tmp_path: Path) -> None:
    code, _, said = calibrated(list(photographs(TURNS[:3])), tmp_path, board="6x5")
    assert code == 1
    assert "no photograph shows the whole 6x5 chessboard" in said
    assert said.endswith("3 of 3 seem to show what --board 5x4 stands for")
    code, _, said = calibrated(list(photographs(TURNS[:3])), tmp_path, "--pattern", "circles")
    assert code == 1
    assert said.endswith("3 of 3 seem to show what --board 5x4 --pattern chessboard stands for")


def test_why_photographs_from_one_direction_do_not_do(tmp_path: Path) -> None:
    code, record, said = calibrated(list(photographs([[0.0, 0.0, angle] for angle in (0.0, 0.3, -0.4)])), tmp_path)
    assert code == 1
    assert record["status"] == "DEGENERATE"
    assert "The board turns by" in said
    assert "tilt it" in said
    assert not (tmp_path / "out" / "camera.txt").exists()


def test_little_turned_boards_are_doubtful(tmp_path: Path) -> None:
    turns = [[0.05 * x, 0.05 * y, z] for x, y, z in ((1, 0, 0.1), (-1, 0, 0.3), (0, 1, -0.3), (0, -1, 0.0), (0, 0, 0.5))]
    code, record, _ = calibrated(list(photographs(turns, cx=119.9)), tmp_path, "--camera", "pinhole", "--free", "focal")
    assert code == 0
    focal = record["intrinsics"]["fx"]
    assert abs(focal["value"] - 230) < 5 * focal["sigma"]
    assert any("the focal length is known to" in said and "The board turns by" in said for said in record["remarks"])


def test_a_held_principal_point_is_told(tmp_path: Path) -> None:
    """From one photograph the focal length depends on it more than on noise."""
    code, record, _ = calibrated(list(photographs(TURNS[:1], cx=121.9)), tmp_path, "--camera", "pinhole", "--free", "focal")
    assert code == 0
    (said,) = [said for said in record["remarks"] if "principal point" in said]
    focal = record["intrinsics"]["fx"]
    other = float(said.split("off by another ")[1].split(" px")[0])
    # It is a hundredth of the width off.
    assert abs(focal["value"] - 230) < 5 * focal["sigma"] + 2 * other
    assert other > focal["sigma"]


def test_a_photograph_turned_by_a_quarter_is_told(tmp_path: Path) -> None:
    images = list(photographs(TURNS))
    code, record, _ = calibrated([*images[:4], images[4].transpose(-2, -1).flip(-1)], tmp_path)
    assert code == 0
    assert "as if turned by a quarter" in record["photographs"][4]["problem"]
    assert record["remarks"] == []


@pytest.mark.parametrize("pattern", ["chessboard", "circles"])
def test_a_folder_without_boards_offers_none(tmp_path: Path, pattern: str) -> None:
    code, _, said = calibrated([torch.full((1, 180, 240), 0.5)] * 2, tmp_path, "--pattern", pattern)
    assert code == 1
    assert said.endswith(f"no photograph shows the whole 5x4 {pattern} pattern")
