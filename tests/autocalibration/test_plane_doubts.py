from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import calibrate_planes
from torchsfm.autocalibration.plane_doubts import DISAGREE, foreign_views, shift_by_centre, turn_of_board
from torchsfm.autocalibration.plane_models import calibrate_unknown_planes
from torchsfm.geometry import Camera, Radial, intrinsics, rotation_from_rotvec

F64 = torch.float64
TURNS = torch.tensor(
    [[0.5, 0.0, 0.1], [-0.5, 0.2, 0.0], [0.1, 0.5, -0.1], [0.0, -0.5, 0.05], [0.35, 0.4, 0.2], [-0.4, -0.35, 0.1],
     [0.4, -0.3, 0.3], [-0.2, 0.45, -0.3], [0.3, 0.1, 0.0]], dtype=F64
)  # fmt: skip
X = torch.stack(torch.meshgrid(torch.arange(8), torch.arange(6), indexing="xy"), -1).reshape(-1, 2).to(F64)
SIZE = (640.0, 480.0)


def seen(generator: torch.Generator, focals: Sequence[float], board: Tensor = X, turns: Tensor = TURNS) -> Tensor:
    """The board from directions, by these focal lengths, with 0.05 px of noise."""
    points = []
    for f, turn in zip(focals, turns[: len(focals)], strict=True):
        R = rotation_from_rotvec(turn)
        flat = torch.nn.functional.pad(board, (0, 1))
        t = torch.tensor([0.3, -0.2, 10.0], dtype=F64) - R @ flat.mean(0)
        K = intrinsics(torch.tensor(f, dtype=F64), torch.tensor([325.0, 236.0], dtype=F64))
        points.append(Camera(K, Radial(*torch.tensor([-0.1, 0.02], dtype=F64))).project(flat @ R.mT + t))
    x = torch.stack(points)
    return x + 0.05 * torch.randn(x.shape, generator=generator, dtype=F64)


@pytest.mark.parametrize(
    ("focals", "foreign"),
    [
        ([480.0] * 4 + [560.0] + [480.0] * 4, [4]),
        ([480.0] * 2 + [560.0] + [480.0] * 2, [2]),
        ([560.0] * 2 + [480.0] * 6 + [560.0], [0, 1, 8]),
        ([480.0, 560.0] * 4, []),
        ([480.0] * 9, []),
    ],
    ids=["one", "of five", "three", "half of them", "none"],
)
def test_views_of_another_camera_are_named(generator: torch.Generator, focals: list[float], foreign: list[int]) -> None:
    x = seen(generator, focals)
    options: dict[str, Any] = {"image_size": SIZE}
    found = calibrate_planes(x, X, **options)
    assert (float(found.disagreement) > DISAGREE) == (len(set(focals)) > 1)
    assert foreign_views(x, X, found, **options) == foreign


def test_copies_are_not_named(generator: torch.Generator) -> None:
    x = seen(generator, [480.0] * 4 + [560.0] + [480.0] * 4)
    x = torch.cat((x, x[4:5]))
    found = calibrate_planes(x, X, image_size=SIZE)
    assert found.copy_of[9] == 4
    assert foreign_views(x, X, found, image_size=SIZE) == [4]


def test_how_far_a_board_turns(generator: torch.Generator) -> None:
    found = calibrate_planes(seen(generator, [480.0, 480.0]), X, image_size=SIZE, free=("focal",))
    normals = rotation_from_rotvec(TURNS[:2])[..., 2]
    assert turn_of_board(found) == pytest.approx(float(torch.rad2deg(torch.acos(normals[0] @ normals[1]))), abs=1.0)
    alike = seen(generator, [480.0] * 3, turns=torch.tensor([[0.0, 0.0, angle] for angle in (0.0, 0.5, 1.0)], dtype=F64))
    assert turn_of_board(calibrate_planes(alike, X, image_size=SIZE)) < 3.0


def test_what_the_middle_of_the_image_takes_from_one_view(generator: torch.Generator) -> None:
    """The principal point is 5.5 and 3.5 px off the middle, of which no deviation knows."""
    x = seen(generator, [480.0])
    options: dict[str, Any] = {"image_size": SIZE, "free": ("focal",)}
    found = calibrate_planes(x, X, **options)
    shift = shift_by_centre(x, X, found, **options)
    assert shift > float(found.deviation[0])
    assert abs(float(found.camera.K[0, 0]) - 480) < 5 * float(found.deviation[0]) + 2 * shift


def test_a_board_of_rectangles_is_not_taken_for_too_few_views(generator: torch.Generator) -> None:
    """They had no start by squares, and the shape of the board was not tried."""
    x = seen(generator, [480.0] * 9, X * torch.tensor([1.2, 1.0], dtype=F64))
    free = ("focal", "aspect", "principal_point")
    assert calibrate_planes(x, X, image_size=SIZE, free=free).status == Status.DEGENERATE
    _, found = calibrate_unknown_planes(x, X, lenses=["radial"], boards=(False, True), free=free, image_size=SIZE)
    assert found.status == Status.OK
    assert float(found.board_shape[0]) == pytest.approx(0.2, abs=1e-3)
    assert abs(float(found.camera.K[0, 0]) - 480) < 5 * float(found.deviation[0])


@pytest.mark.parametrize(("sets", "views"), [(100, 9), (400, 3)])
def test_views_by_noise_contradict_each_other_by_as_much(generator: torch.Generator, sets: int, views: int) -> None:
    """The mean of 900 to 1200 squares, each of six numbers or less, is 1 to a few hundredths.

    Of three views each draws what they share a third of the way along, which counts.
    """
    x = torch.stack([seen(generator, [480.0] * views) for _ in range(sets)])
    found = calibrate_planes(x, X, image_size=SIZE)
    assert float(found.view_disagreement.square().mean()) == pytest.approx(1, abs=0.2)


def test_the_view_of_another_camera_contradicts_most(generator: torch.Generator) -> None:
    """By what the squares shrink by where its camera is its own, which is what the others say of it without it."""
    x = seen(generator, [480.0] * 4 + [484.0] + [480.0] * 4)
    x = torch.cat((x, x[4:5]))
    found = calibrate_planes(x, X, image_size=SIZE)
    assert found.view_disagreement.argmax() == 4
    assert found.view_disagreement[9] == found.view_disagreement[4]
    out = torch.ones(10, len(X), dtype=torch.bool)
    out[[4, 9]] = False
    without = calibrate_planes(x, X, image_size=SIZE, visible=out)
    one = torch.zeros(10, len(X), dtype=torch.bool)
    one[4] = True
    own = 2 * float(found.cost - without.cost)
    # By itself the view leaves noise.
    numbers = 2 * len(X) - 6 - 6
    variance = 2 * float(without.cost) / (8 * (2 * len(X) - 6) - 6)
    assert float(found.view_disagreement[4]) ** 2 == pytest.approx((own / variance - numbers) / 6, rel=0.4)


def test_another_lens_does_not_save_views_that_contradict_each_other(generator: torch.Generator) -> None:
    """Of two zooms far apart a fisheye had a focal length, where the usual lens had none."""
    x = seen(generator, [480.0, 765.0] * 4 + [480.0])
    free = ("focal", "aspect", "principal_point")
    usual = calibrate_planes(x, X, image_size=SIZE, free=free)
    assert usual.status == Status.DEGENERATE
    assert float(usual.disagreement) > DISAGREE
    _, found = calibrate_unknown_planes(
        x, X, lenses=["radial", "opencv", "fisheye"], boards=(False, True), free=free, image_size=SIZE
    )
    assert found.status == Status.DEGENERATE
