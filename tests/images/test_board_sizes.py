import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics, rotation_from_rotvec
from torchsfm.images.board_sizes import chessboard_size, circles_grid_size
from torchsfm.simulation import render_board

F64 = torch.float64


def photograph(columns: int, rows: int, radius: float | None, away: float = 9.0) -> Tensor:
    R = rotation_from_rotvec(torch.tensor([[0.3, 0.2, 0.1]], dtype=F64))
    middle = torch.tensor([(columns - 1) / 2, (rows - 1) / 2, 0.0], dtype=F64)
    t = torch.tensor([[0.0, 0.0, away]], dtype=F64) - R @ middle
    camera = Camera(intrinsics(torch.tensor(300.0, dtype=F64), torch.tensor([149.5, 112.0], dtype=F64)))
    return render_board(Pose(R, t), camera, columns, rows, radius=radius, width=300, height=225, generator=seeded())[0]


@pytest.mark.parametrize(("columns", "rows"), [(6, 4), (4, 6), (5, 5)])
def test_sizes_of_boards(columns: int, rows: int) -> None:
    size = max(columns, rows), min(columns, rows)
    assert chessboard_size(photograph(columns, rows, None)) == size
    assert circles_grid_size(photograph(columns, rows, 0.3)) == size


def test_no_board_and_a_part_of_one_have_no_size() -> None:
    blank = torch.full((1, 225, 300), 0.5, dtype=F64)
    assert chessboard_size(blank) is None
    assert circles_grid_size(blank) is None
    image = photograph(6, 4, 0.3)
    image[:, 85:140, 115:185] = 0.4
    assert circles_grid_size(image) is None
