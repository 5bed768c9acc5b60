from pathlib import Path

import numpy as np
import pytest
import torch
from chance import numpy_seeded, seeded
from torch import Tensor

from torchsfm.autocalibration import calibrate_planes
from torchsfm.geometry import Camera, Pose, Radial, intrinsics, rotation_from_rotvec
from torchsfm.images import detect_chessboard, detect_circles_grid, read_image
from torchsfm.images.plane_grids import grid_homography, grid_in_points
from torchsfm.simulation import render_board

F64 = torch.float64
COLUMNS, ROWS = 5, 4
WIDTH, HEIGHT = 240, 180


def camera() -> Camera:
    K = intrinsics(torch.tensor(230.0, dtype=F64), torch.tensor([121.3, 88.1], dtype=F64))
    return Camera(K, Radial(*torch.tensor([-0.12, 0.04], dtype=F64)))


def views(v: int, stream: int = 0) -> Pose:
    """Boards in front of the camera, turned by up to 35 degrees, the right way up."""
    rng = numpy_seeded(stream)
    turn = torch.tensor(np.concatenate((rng.uniform(-0.6, 0.6, (v, 2)), rng.uniform(-0.3, 0.3, (v, 1))), -1))
    R = rotation_from_rotvec(turn)
    middle = torch.tensor([(COLUMNS - 1) / 2, (ROWS - 1) / 2, 0.0], dtype=F64)
    place = torch.tensor(np.concatenate((rng.uniform(-0.6, 0.6, (v, 2)), rng.uniform(8.5, 9.5, (v, 1))), -1))
    return Pose(R, place - R @ middle)


def points() -> Tensor:
    place = torch.arange(COLUMNS * ROWS)
    return torch.stack((place % COLUMNS, place // COLUMNS), -1).double()


def seen(poses: Pose) -> Tensor:
    """Where the points of the board are in the photographs."""
    X = torch.nn.functional.pad(points(), (0, 1))
    return camera().project(poses.transform(X.expand(*poses.shape, -1, 3)))


def photographs(poses: Pose, radius: float | None) -> Tensor:
    options = {"radius": radius, "width": WIDTH, "height": HEIGHT, "generator": seeded(7)}
    return render_board(poses, camera(), COLUMNS, ROWS, **options)


@pytest.mark.parametrize("circles", [False, True])
def test_points_are_found_where_they_are(circles: bool) -> None:
    poses = views(5)
    images = photographs(poses, 0.35 if circles else None)
    detect = detect_circles_grid if circles else detect_chessboard
    board = detect(images, COLUMNS, ROWS)
    assert board.x.shape == (5, COLUMNS * ROWS, 2)
    assert int(board.found.sum()) >= 4
    x = seen(poses)
    # A chessboard of these numbers, and a grid of circles, looks the same upside down.
    error = torch.minimum(*((board.x - y).norm(dim=-1).square().mean(-1).sqrt() for y in (x, x.flip(-2))))
    assert float(error[board.found].max()) < 0.08
    assert bool((board.x[~board.found] == 0).all())


def test_circles_and_chessboards_calibrate_alike() -> None:
    poses, K = views(8, stream=1), camera().K
    found = []
    # The largest circles are four pixels from each other.
    for detect, radius in ((detect_chessboard, None), (detect_circles_grid, 0.3), (detect_circles_grid, 0.42)):
        board = detect(photographs(poses, radius), COLUMNS, ROWS)
        x, own = board.x, None
        if radius is not None:
            assert board.outlines is not None
            assert board.radius is not None
            x, own = board.outlines, float(board.radius[board.found].median())
            assert abs(own / radius - 1) < 0.01
        result = calibrate_planes(x[board.found], points(), image_size=(float(WIDTH), float(HEIGHT)), radius=own)
        assert int(result.status) == 0
        assert float(result.rms) < 0.08
        focal = result.camera.K[0, 0]
        assert float((focal - K[0, 0]).abs()) < 3 * float(result.deviation[0])
        found.append(float(focal))
    assert max(found) - min(found) < 3.0


def test_a_grid_is_found_among_other_points(generator: torch.Generator) -> None:
    for _ in range(10):
        H = torch.eye(3, dtype=F64) + torch.tensor([[0.2], [0.2], [0.02]]) * torch.randn(3, 3, generator=generator, dtype=F64)
        x = torch.nn.functional.pad(points(), (0, 1), value=1.0) @ H.T
        x = 40 * x[:, :2] / x[:, 2:]
        J = torch.stack([(grid_near(H, points(), step) - x) / 1e-4 for step in torch.eye(2, dtype=F64) * 1e-4], -1)
        order = torch.randperm(len(x) + 6, generator=generator)
        others = x.mean(0) + 400 * torch.nn.functional.normalize(torch.randn(6, 2, generator=generator, dtype=F64), dim=-1)
        every = torch.cat((x, others))[order]
        D = 0.09 * torch.cat((J @ J.mT, J[:6] @ J[:6].mT))[order]
        found = grid_in_points(every, D, COLUMNS, ROWS)
        assert found is not None
        assert set(order[found].tolist()) == set(range(len(x)))
        back = grid_homography(every[found], COLUMNS)
        fit = torch.nn.functional.pad(points(), (0, 1), value=1.0) @ back.T
        assert float((fit[:, :2] / fit[:, 2:] - every[found]).abs().max()) < 1e-6
        assert grid_in_points(every, D, COLUMNS + 1, ROWS) is None
        assert grid_in_points(every, D, COLUMNS, ROWS - 1) is None


def grid_near(H: Tensor, X: Tensor, step: Tensor) -> Tensor:
    y = torch.nn.functional.pad(X + step, (0, 1), value=1.0) @ H.T
    return 40 * y[:, :2] / y[:, 2:]


def test_what_is_not_there_is_not_found(generator: torch.Generator) -> None:
    noise = 0.5 + 0.1 * torch.randn(2, 1, 60, 80, generator=generator, dtype=F64)
    noise[1] = torch.nan
    for detect in (detect_chessboard, detect_circles_grid):
        board = detect(noise, 4, 3)
        assert board.found.tolist() == [False, False]
        assert bool((board.x == 0).all())
    image = photographs(views(1), 0.35)
    assert not bool(detect_circles_grid(image, COLUMNS, ROWS - 1).found)
    assert bool(detect_circles_grid(image, COLUMNS, ROWS, ratio=0.35).found)
    assert not bool(detect_circles_grid(image, COLUMNS, ROWS, ratio=0.2).found)


def test_circles_of_photographs_are_found_and_calibrate(data: Path) -> None:
    files = sorted((data / "calibration" / "circles").glob("*.jpg"))[::4]
    boards = [detect_circles_grid(read_image(f, gray=True, max_size=720).pixels, 4, 3) for f in files]
    assert all(bool(b.found) for b in boards)
    place = torch.arange(12)
    X = 0.09 * torch.stack((place % 4, place // 4), -1).double()
    result = calibrate_planes(torch.stack([b.x for b in boards]).double(), X, image_size=(720.0, 540.0))
    assert int(result.status) == 0
    assert float(result.rms) < 0.15


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image = torch.zeros(1, 40, 40)
    for detect in (detect_chessboard, detect_circles_grid):
        for name, arguments in {"columns": (1, 3), "rows": (3, 1)}.items():
            with pytest.raises(ValueError, match=name):
                detect(image, *arguments)
        with pytest.raises(ValueError, match="image"):
            detect(torch.zeros(2, 40, 40), 4, 3)
    with pytest.raises(ValueError, match="ratio"):
        detect_circles_grid(image, 4, 3, ratio=1.5)
    with pytest.raises(ValueError, match="radius"):
        render_board(views(1), camera(), 4, 3, radius=-1.0)
