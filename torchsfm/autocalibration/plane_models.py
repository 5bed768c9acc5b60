"""Which lens took photographs of a board, and whether the board is flat, where no one says: by what explains them."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration.board_shape import BOARD
from torchsfm.autocalibration.calibrate_planes import PlaneCalibration, calibrate_planes
from torchsfm.autocalibration.plane_doubts import DISAGREE
from torchsfm.geometry import DISTORTION_MODELS
from torchsfm.linalg import solve

LENSES = ("radial", "opencv", "fisheye")
"""What is tried, the first one unless another explains the photographs better."""
LIKELIER = 20.0
"""Twice the logarithm of how many times likelier the same points must be by another lens, and by a board that is not flat:
chance gains little by their two to five numbers more."""


def calibrate_unknown_planes(
    x: Tensor, X: Tensor, *, lenses: Sequence[str], boards: Sequence[bool], free: Sequence[str], **options: Any
) -> tuple[str, PlaneCalibration]:
    """The likeliest of calibrations by several lenses, of a flat board and of one that is not.

    The first lens and the first board are taken unless others explain the views better than the noise that the best of all
    leaves, with what views then disagree by, lets chance do. The first says whether the views determine a camera.
    """
    found: list[tuple[int, str, PlaneCalibration]] = []
    for j, board in enumerate(boards):
        for i, lens in enumerate(lenses):
            names = (*free, BOARD) if board else tuple(free)
            model = calibrate_planes(x, X, distortion=DISTORTION_MODELS[lens], free=names, **options)
            found.append(((i > 0) + (j > 0), lens, model))
            if i == j == 0 and _fails(model) and float(model.disagreement) <= DISAGREE:
                return lens, model
    sound = [one for one in found if one[2].status == Status.OK]
    if _fails(found[0][2]):
        # Views that contradict each other may do so for the lens or for the board, if by another one they agree.
        sound = [one for one in sound if float(one[2].disagreement) <= DISAGREE]
    if not sound:
        return found[0][1:]
    noise = min(_variance(model, x) for _, _, model in sound)
    _, lens, model = min(sound, key=lambda one: 2 * float(one[2].cost) + LIKELIER * one[0] * noise)
    return lens, model


def _fails(model: PlaneCalibration) -> bool:
    return bool(model.status not in (Status.OK, Status.NOT_CONVERGED))


def _variance(model: PlaneCalibration, x: Tensor) -> float:
    """Of a coordinate, with what views disagree by."""
    used = int(model.used.sum())
    numbers = 2 * used * x.shape[-2] - len(model.parameter_names) - 6 * used
    return 2 * float(model.cost) / max(numbers, 1) * float(model.disagreement) ** 2


def bend(board: Tensor) -> float:
    """How far the points of a board are from a plane, from the lowest to the highest."""
    away = board - board.mean(0)
    slope, _ = solve(away[:, :2].mT @ away[:, :2], away[:, :2].mT @ away[:, 2:])
    height = away[:, 2] - (away[:, :2] @ slope)[:, 0]
    return float(height.max() - height.min())
